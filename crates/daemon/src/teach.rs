//! `samsod teach`: a part for the catalogue from one picture.
//!
//! In: a picture with the part alone on the table, its camera, and its shape if there is a model. Out: the folder of the
//! part. The vision chain finds the part in the picture, unless a mask says where it is.

use std::path::{Path, PathBuf};

use clap::Args;
use image::{GrayImage, RgbImage};
use samsod::Cell;
use samsod::recognize::{Lesson, Part, TeachError, teach};
use samsod::shadow::ObjectRegion;

use crate::catalogue::symmetry_text;
use crate::config::{Config, ConfigError};
use crate::inspect::{self, InspectError};
use crate::place::Placer;

/// The catalogue when nothing else is said.
const DEFAULT_CATALOGUE: &str = "parts";
/// Objects with less than this share of the pixels of the largest are crumbs.
const NOTABLE_SHARE: f64 = 0.1;

/// Teach the catalogue a part, from a picture with the part alone on the table.
///
/// Writes the folder CATALOGUE/NAME with part.toml, template.png, mask.png and, with --stl, model.stl. STEP files are
/// converted to STL first: docs/catalogue.md says how.
#[derive(Debug, Args)]
#[command(verbatim_doc_comment)]
pub struct TeachArguments {
    /// The picture, PNG or JPEG, as the camera took it.
    pub image: PathBuf,
    /// Name of the part: letters, digits, _ and -.
    #[arg(long, value_name = "NAME")]
    pub name: String,
    /// Shape of the part: STL, mm, z up, lying as the part lies.
    #[arg(long, value_name = "FILE")]
    pub stl: Option<PathBuf>,
    /// Folder of the catalogue, made if it is not there; by default that of the configuration, else parts.
    #[arg(long, value_name = "DIR")]
    pub catalogue: Option<PathBuf>,
    /// Camera file of `samsod calibrate`, in place of that of the configuration.
    #[arg(long, value_name = "FILE", required_unless_present = "config")]
    pub camera: Option<PathBuf>,
    /// Configuration of samsodd: its `[camera]` or `[view]`, its vision parameters, its catalogue.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Image of the size of the picture, more than 127 on the part; instead of looking for the part.
    #[arg(long, value_name = "FILE")]
    pub mask: Option<PathBuf>,
    /// Height of the part as it lies, mm; by default that of the shape.
    #[arg(long, value_name = "H", allow_negative_numbers = true, required_unless_present = "stl")]
    pub height_mm: Option<f64>,
    /// Opening of the gripper at the part, mm; by default the shorter side of the part from above.
    #[arg(long, value_name = "W", allow_negative_numbers = true)]
    pub grasp_width_mm: Option<f64>,
    /// Replace a part of that name.
    #[arg(long)]
    pub force: bool,
}

/// Why a part was not taught.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TeachCommandError {
    /// The configuration, the camera file or a parameter cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// A picture cannot be read, or is not of the camera.
    #[error(transparent)]
    Image(#[from] InspectError),
    /// The configuration knows no camera.
    #[error(
        "{} has neither [camera] file nor [view]: a part needs the camera that sees it; give --camera FILE",
        path.display()
    )]
    NoCamera {
        /// The configuration.
        path: PathBuf,
    },
    /// Nothing lies on the table.
    #[error(
        "{}: no object was found; put the part alone on a table of another colour, or say with --mask where it is",
        path.display()
    )]
    NoObject {
        /// The picture.
        path: PathBuf,
    },
    /// More than the part lies on the table.
    #[error(
        "{}: {} objects of notable size were found:{}\nleave the part alone on the table, or say with --mask where it is; \
         samsod inspect shows what was seen",
        path.display(),
        found.len(),
        lines(found)
    )]
    SeveralObjects {
        /// The picture.
        path: PathBuf,
        /// Pixels and centroid of each, largest first.
        found: Vec<(u32, [f32; 2])>,
    },
    /// The part itself cannot be taught.
    #[error("{}: {cause}", path.display())]
    Teach {
        /// The picture.
        path: PathBuf,
        /// Why.
        cause: TeachError,
    },
}

fn lines(found: &[(u32, [f32; 2])]) -> String {
    found.iter().map(|(area, [x, y])| format!("\n  {area} px about ({x:.0}, {y:.0})")).collect()
}

/// Teaches a part and tells what was written.
///
/// # Errors
/// [`TeachCommandError`]; the catalogue is then as it was.
pub fn run(arguments: &TeachArguments) -> Result<String, TeachCommandError> {
    let mut config = match &arguments.config {
        // Its catalogue may be empty: this is how a part gets into it.
        Some(file) => Config::read_without_catalogue(file)?,
        None => Config::default(),
    };
    if let Some(file) = &arguments.camera {
        (config.camera.file, config.view) = (Some(file.clone()), None);
    }
    let path = &arguments.image;
    let placer = config
        .placer()?
        .ok_or_else(|| TeachCommandError::NoCamera { path: arguments.config.clone().unwrap_or_default() })?;
    let frame = inspect::load(path)?;
    let mask = match &arguments.mask {
        Some(mask) => image::imageops::grayscale(&inspect::load(mask)?),
        None => find_part(path, &config, &frame, &placer)?,
    };
    let (width, height) = frame.dimensions();
    let camera = placer.camera([width, height]).ok_or_else(|| {
        let [camera_width, camera_height] = placer.image_size_px().unwrap_or_default();
        InspectError::OtherCamera { path: path.clone(), width, height, camera_width, camera_height }
    })?;
    let catalogue = arguments.catalogue.clone().or(config.catalogue.folder);
    let catalogue = catalogue.unwrap_or_else(|| PathBuf::from(DEFAULT_CATALOGUE));
    let lesson = Lesson {
        name: &arguments.name,
        frame: &frame,
        mask: &mask,
        camera: &camera,
        model: arguments.stl.as_deref(),
        height_mm: arguments.height_mm,
        grasp_width_mm: arguments.grasp_width_mm,
    };
    let part = teach(&catalogue, &lesson, arguments.force);
    let part = part.map_err(|cause| TeachCommandError::Teach { path: path.clone(), cause })?;
    Ok(told(&part))
}

/// The mask of the only object of notable size. `path` is what messages call the picture.
pub(crate) fn find_part(
    path: &Path,
    config: &Config,
    frame: &RgbImage,
    placer: &Placer,
) -> Result<GrayImage, TeachCommandError> {
    let mut cell = Cell::new(config.vision()).map_err(InspectError::from)?;
    let scene = inspect::look(path, frame, &mut cell, Some(placer))?;
    let mut notable: Vec<&ObjectRegion> = scene.objects.iter().collect();
    notable.sort_by_key(|object| std::cmp::Reverse(object.area));
    let largest = notable.first().map_or(0, |object| object.area);
    notable.retain(|object| f64::from(object.area) >= NOTABLE_SHARE * f64::from(largest));
    match notable.as_slice() {
        [] => Err(TeachCommandError::NoObject { path: path.to_owned() }),
        [object] => Ok(object.mask.to_image(frame.width(), frame.height())),
        several => {
            let found = several.iter().map(|object| (object.area, object.centroid)).collect();
            Err(TeachCommandError::SeveralObjects { path: path.to_owned(), found })
        }
    }
}

/// What a person wants to check.
fn told(part: &Part) -> String {
    let (grasp, template) = (&part.grasp, &part.template);
    let ([x, y], [at_x, at_y]) = (grasp.offset_mm, template.origin_mm);
    let (columns, rows) = template.image.dimensions();
    let shape = match &part.mesh {
        Some(mesh) => format!("{} triangles, {:.1} mm high", mesh.triangles().len(), mesh.height_mm()),
        None => "none: the part is recognised by its picture alone".to_owned(),
    };
    format!(
        "taught     {} in {}\n\
         height     {:.1} mm\n\
         grasp      {:.1} mm wide, about ({x:.1}, {y:.1}) mm, turned by {:.1} deg\n\
         symmetry   {}\n\
         template   {columns} x {rows} px; origin at ({at_x:.1}, {at_y:.1}) mm on the table, yaw {:.1} deg\n\
         shape      {shape}\n",
        part.name,
        part.folder.display(),
        part.height_mm,
        grasp.width_mm,
        grasp.angle_rad.to_degrees(),
        symmetry_text(&part.symmetry),
        template.yaw_rad.to_degrees(),
    )
}
