//! `samsod catalogue`: what is in a catalogue, and everything that is wrong with it.
//!
//! In: the folder of a catalogue. Out: its parts, and an error for each that cannot be used. The service stops at the first.

use std::fs;
use std::path::{Path, PathBuf};

use samsod::recognize::{
    Catalogue, CatalogueError, PART_FILE, Part, RecognizeError, RecognizeParams, Recognizer, Symmetry,
};

/// What a folder holds.
#[derive(Debug)]
pub struct Listing {
    /// The parts that can be used, by the names of their folders.
    pub catalogue: Catalogue,
    /// Number of local features of each of them, with the parameters that hold when nothing else is configured.
    pub features: Vec<usize>,
    /// Why others cannot.
    pub errors: Vec<CatalogueError>,
    /// Folders without a part.
    pub passed_over: Vec<PathBuf>,
}

/// Why a folder could not be listed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ListError {
    /// The folder itself cannot be read.
    #[error(transparent)]
    Catalogue(#[from] CatalogueError),
    /// Nothing can be computed of its parts.
    #[error(transparent)]
    Recognize(#[from] RecognizeError),
}

/// Reads all parts of a folder, and goes on after errors. What recognition computes of a part is kept in its folder, so
/// that the service starts faster.
///
/// # Errors
/// [`ListError`]: the folder as a whole. What is wrong with single parts is in the listing.
pub fn list(folder: &Path) -> Result<Listing, ListError> {
    let unreadable = |source| CatalogueError::Read { path: folder.to_owned(), source };
    let mut folders = Vec::new();
    for entry in fs::read_dir(folder).map_err(unreadable)? {
        let path = entry.map_err(unreadable)?.path();
        if path.is_dir() {
            folders.push(path);
        }
    }
    folders.sort();
    let (mut catalogue, mut errors, mut passed_over) = (Catalogue::default(), Vec::new(), Vec::new());
    for path in folders {
        if !path.join(PART_FILE).is_file() {
            passed_over.push(path);
            continue;
        }
        errors.extend(Part::read(&path).and_then(|part| catalogue.add(part)).err());
    }
    if catalogue.parts().is_empty() {
        if errors.is_empty() {
            errors.push(CatalogueError::Empty { path: folder.to_owned() });
        }
        return Ok(Listing { catalogue, features: Vec::new(), errors, passed_over });
    }
    let recognizer = Recognizer::new(catalogue, RecognizeParams::default())?;
    let features = recognizer.features().to_vec();
    Ok(Listing { catalogue: recognizer.catalogue().clone(), features, errors, passed_over })
}

impl std::fmt::Display for Listing {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let parts = self.catalogue.parts();
        // As long as the longest name.
        let width = parts.iter().map(|part| part.name.chars().count()).max().unwrap_or(0).max(4);
        writeln!(
            f,
            "{:<width$} {:>9} {:>9} {:>15} {:>9} {:>8} {:>8} {:>11} {:>8} {:>9}",
            "part",
            "height mm",
            "grasp mm",
            "at mm",
            "angle deg",
            "outline",
            "picture",
            "template px",
            "features",
            "triangles"
        )?;
        for (part, features) in parts.iter().zip(&self.features) {
            let (grasp, symmetry) = (&part.grasp, &part.symmetry);
            let (columns, rows) = part.template.image.dimensions();
            let triangles = part.mesh.as_ref().map_or("-".to_owned(), |mesh| mesh.triangles().len().to_string());
            let [x, y] = grasp.offset_mm;
            writeln!(
                f,
                "{:<width$} {:>9.1} {:>9.1} {x:>7.1} {y:>7.1} {:>9.1} {:>8} {:>8} {:>11} {features:>8} {triangles:>9}",
                part.name,
                part.height_mm,
                grasp.width_mm,
                grasp.angle_rad.to_degrees(),
                order(symmetry.shape_order),
                order(symmetry.appearance_order),
                format!("{columns} x {rows}"),
            )?;
        }
        for path in &self.passed_over {
            writeln!(f, "{} is passed over: it has no {PART_FILE}", path.display())?;
        }
        write!(f, "{} parts, {} errors", parts.len(), self.errors.len())
    }
}

/// An order of symmetry as people say it.
fn order(order: u32) -> String {
    match order {
        0 => "round".to_owned(),
        1 => "none".to_owned(),
        n => format!("{n}-fold"),
    }
}

/// Both orders of a symmetry.
pub(crate) fn symmetry_text(symmetry: &Symmetry) -> String {
    format!("outline {}, picture {}", order(symmetry.shape_order), order(symmetry.appearance_order))
}
