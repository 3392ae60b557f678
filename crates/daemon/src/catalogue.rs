//! `samsod catalogue`: what is in a catalogue, and everything that is wrong with it.
//!
//! In: the folder of a catalogue. Out: its parts, and an error for each that cannot be used. The service stops at the first.

use std::fs;
use std::path::{Path, PathBuf};

use samsod::recognize::{CatalogueError, PART_FILE, Part, Symmetry};

/// What a folder holds.
#[derive(Debug)]
pub struct Listing {
    /// The parts that can be used, by the names of their folders.
    pub parts: Vec<Part>,
    /// Why others cannot.
    pub errors: Vec<CatalogueError>,
    /// Folders without a part.
    pub passed_over: Vec<PathBuf>,
}

/// Reads all parts of a folder, and goes on after errors.
///
/// # Errors
/// The folder itself cannot be read.
pub fn list(folder: &Path) -> Result<Listing, CatalogueError> {
    let unreadable = |source| CatalogueError::Read { path: folder.to_owned(), source };
    let mut folders = Vec::new();
    for entry in fs::read_dir(folder).map_err(unreadable)? {
        let path = entry.map_err(unreadable)?.path();
        if path.is_dir() {
            folders.push(path);
        }
    }
    folders.sort();
    let mut listing = Listing { parts: Vec::new(), errors: Vec::new(), passed_over: Vec::new() };
    for path in folders {
        if !path.join(PART_FILE).is_file() {
            listing.passed_over.push(path);
            continue;
        }
        match Part::read(&path) {
            Ok(part) => listing.add(part),
            Err(error) => listing.errors.push(error),
        }
    }
    if listing.parts.is_empty() && listing.errors.is_empty() {
        listing.errors.push(CatalogueError::Empty { path: folder.to_owned() });
    }
    Ok(listing)
}

impl Listing {
    fn add(&mut self, part: Part) {
        match self.parts.iter().find(|other| other.name == part.name) {
            Some(other) => {
                let (first, second) = (other.folder.join(PART_FILE), part.folder.join(PART_FILE));
                self.errors.push(CatalogueError::Twice { name: part.name, first, second });
            }
            None => self.parts.push(part),
        }
    }
}

impl std::fmt::Display for Listing {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // As long as the longest name.
        let width = self.parts.iter().map(|part| part.name.chars().count()).max().unwrap_or(0).max(4);
        writeln!(
            f,
            "{:<width$} {:>9} {:>9} {:>15} {:>9} {:>8} {:>8} {:>11} {:>9}",
            "part", "height mm", "grasp mm", "at mm", "angle deg", "outline", "picture", "template px", "triangles"
        )?;
        for part in &self.parts {
            let (grasp, symmetry) = (&part.grasp, &part.symmetry);
            let (columns, rows) = part.template.image.dimensions();
            let triangles = part.mesh.as_ref().map_or("-".to_owned(), |mesh| mesh.triangles().len().to_string());
            let [x, y] = grasp.offset_mm;
            writeln!(
                f,
                "{:<width$} {:>9.1} {:>9.1} {x:>7.1} {y:>7.1} {:>9.1} {:>8} {:>8} {:>11} {triangles:>9}",
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
        write!(f, "{} parts, {} errors", self.parts.len(), self.errors.len())
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
