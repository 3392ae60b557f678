//! The catalogue: a folder of parts, each a folder of its own.
//!
//! ```text
//! DIR/flange/part.toml      module `part_file`
//! DIR/flange/template.png   the part alone, cut from a frame
//! DIR/flange/mask.png       of the same size, more than 127 on the part
//! DIR/flange/model.stl      optional: its shape, mm
//! DIR/flange/descriptors    made by samsod: what was computed from the others
//! ```

use std::fs;
use std::path::{Path, PathBuf};

use image::{GrayImage, RgbImage};
use samsod_camera::{Camera, Intrinsics, IntrinsicsError, PoseError, ProjectionError, pose_from_rows};

use crate::mesh::{Mesh, MeshError};
use crate::part_file::{PartFile, Symmetry};

/// Name of the file that says what a part is.
pub const PART_FILE: &str = "part.toml";
/// Name of the picture of a part.
pub const TEMPLATE_FILE: &str = "template.png";
/// Name of the mask of that picture.
pub const MASK_FILE: &str = "mask.png";
/// Name of the shape of a part.
pub const MODEL_FILE: &str = "model.stl";
/// Longest side of a template, px.
const MAX_TEMPLATE_PX: u32 = 4096;
/// Fewest pixels of a mask.
const MIN_MASK_PX: usize = 50;
/// Greatest height of a part, and width of a grasp, mm.
const MAX_LENGTH_MM: f64 = 5_000.0;
/// Highest order of a symmetry; what repeats more often counts as round.
const MAX_SYMMETRY: u32 = 360;

/// Why a catalogue cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CatalogueError {
    /// A file or folder cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The folder has no part in it.
    #[error("{}: no part in it (a folder with {PART_FILE}); `samsod teach` makes one", path.display())]
    Empty {
        /// The folder.
        path: PathBuf,
    },
    /// The file is no TOML, lacks a key, or has one that is not known.
    #[error("{}: {message}", path.display())]
    Parse {
        /// The file.
        path: PathBuf,
        /// Where and what.
        message: String,
    },
    /// A number or name is not allowed.
    #[error("{}: {key} is {value}; allowed: {allowed}", path.display())]
    Value {
        /// The file.
        path: PathBuf,
        /// Section and key.
        key: &'static str,
        /// The value.
        value: String,
        /// What is allowed.
        allowed: String,
    },
    /// Two parts have one name.
    #[error("{} and {}: both are named {name}; every part needs a name of its own", first.display(), second.display())]
    Twice {
        /// The name.
        name: String,
        /// The one file.
        first: PathBuf,
        /// The other.
        second: PathBuf,
    },
    /// A picture cannot be read.
    #[error("{}: {source}", path.display())]
    Image {
        /// The file.
        path: PathBuf,
        /// Why.
        source: image::ImageError,
    },
    /// The mask does not fit its picture.
    #[error("{}: {} x {} px, but {TEMPLATE_FILE} beside it has {} x {} px", path.display(), mask[0], mask[1], template[0], template[1])]
    MaskSize {
        /// The mask.
        path: PathBuf,
        /// Its width and height, px.
        mask: [u32; 2],
        /// Those of the picture.
        template: [u32; 2],
    },
    /// The mask has hardly any pixel.
    #[error("{}: {pixels} px are set (more than 127); a part needs at least {MIN_MASK_PX}", path.display())]
    MaskEmpty {
        /// The mask.
        path: PathBuf,
        /// Pixels set.
        pixels: usize,
    },
    /// The camera of the template is impossible.
    #[error("{}: [camera.intrinsics] {source}", path.display())]
    Intrinsics {
        /// The file.
        path: PathBuf,
        /// Why.
        source: IntrinsicsError,
    },
    /// The pose of that camera is none.
    #[error("{}: [camera] world_from_camera_mm: {source}", path.display())]
    Pose {
        /// The file.
        path: PathBuf,
        /// Why.
        source: PoseError,
    },
    /// The origin of the part cannot be seen in its template.
    #[error("{}: [template] origin_px: {source}", path.display())]
    Origin {
        /// The file.
        path: PathBuf,
        /// Why.
        source: ProjectionError,
    },
    /// The shape cannot be used.
    #[error(transparent)]
    Mesh(#[from] MeshError),
    /// The height of the part and that of its shape differ.
    #[error("{}: height_mm is {height_mm}, but {MODEL_FILE} beside it is {model_mm} mm high; allowed is a difference of 10 %", path.display())]
    Height {
        /// The file.
        path: PathBuf,
        /// Height of the part, mm.
        height_mm: f64,
        /// Height of its shape, mm.
        model_mm: f64,
    },
}

/// How a gripper takes a part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grasp {
    /// Opening of the gripper at the part, mm.
    pub width_mm: f64,
    /// Where it closes, from the origin of the part and in its axes, mm.
    pub offset_mm: [f64; 2],
    /// Direction of the gripper's x axis, along its fingers, in the axes of the part, rad.
    pub angle_rad: f64,
}

/// The picture of a part, and where the part lay in it.
#[derive(Debug, Clone, PartialEq)]
pub struct Template {
    /// The picture.
    pub image: RgbImage,
    /// More than 127 on the part; of the same size.
    pub mask: GrayImage,
    /// The camera that took the frame that the picture was cut from.
    pub camera: Camera,
    /// Where in that frame, px.
    pub crop_px: [u32; 2],
    /// Origin of the part on the table (x, y), mm, in the world of that camera.
    pub origin_mm: [f64; 2],
    /// Yaw of the part there, rad.
    pub yaw_rad: f64,
}

/// A part of the catalogue.
#[derive(Debug, Clone, PartialEq)]
pub struct Part {
    /// Its name.
    pub name: String,
    /// The folder that it was read from.
    pub folder: PathBuf,
    /// Height over the table, as it lies, mm.
    pub height_mm: f64,
    /// How it is gripped.
    pub grasp: Grasp,
    /// Which turns give the same.
    pub symmetry: Symmetry,
    /// Its picture.
    pub template: Template,
    /// Its shape, if a model was given.
    pub mesh: Option<Mesh>,
}

/// Parts that can be recognised.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Catalogue {
    parts: Vec<Part>,
}

impl Catalogue {
    /// Reads all parts of a folder, in the order of their names. Folders without `part.toml` are passed over.
    ///
    /// # Errors
    /// [`CatalogueError`]: no part, a file that is missing or wrong, two parts with one name.
    pub fn read(folder: &Path) -> Result<Self, CatalogueError> {
        let unreadable = |source| CatalogueError::Read { path: folder.to_owned(), source };
        let mut folders = Vec::new();
        for entry in fs::read_dir(folder).map_err(unreadable)? {
            let path = entry.map_err(unreadable)?.path();
            if path.join(PART_FILE).is_file() {
                folders.push(path);
            }
        }
        folders.sort();
        if folders.is_empty() {
            return Err(CatalogueError::Empty { path: folder.to_owned() });
        }
        let mut catalogue = Self::default();
        for folder in folders {
            catalogue.add(Part::read(&folder)?)?;
        }
        Ok(catalogue)
    }

    /// Adds a part behind the others.
    ///
    /// # Errors
    /// [`CatalogueError::Twice`]: there is a part of that name.
    pub fn add(&mut self, part: Part) -> Result<(), CatalogueError> {
        if let Some(other) = self.part(&part.name) {
            let (first, second) = (other.folder.join(PART_FILE), part.folder.join(PART_FILE));
            return Err(CatalogueError::Twice { name: part.name, first, second });
        }
        self.parts.push(part);
        Ok(())
    }

    /// The parts.
    pub fn parts(&self) -> &[Part] {
        &self.parts
    }

    /// The part of a name.
    pub fn part(&self, name: &str) -> Option<&Part> {
        self.parts.iter().find(|part| part.name == name)
    }

    /// The same catalogue without some parts; names that are not there change nothing.
    pub fn without(&self, names: &[&str]) -> Self {
        Self { parts: self.parts.iter().filter(|part| !names.contains(&part.name.as_str())).cloned().collect() }
    }
}

impl Part {
    /// Reads the folder of a part.
    ///
    /// # Errors
    /// [`CatalogueError`], with the file, the value and what is allowed.
    pub fn read(folder: &Path) -> Result<Self, CatalogueError> {
        let path = folder.join(PART_FILE);
        let text = fs::read_to_string(&path).map_err(|source| CatalogueError::Read { path: path.clone(), source })?;
        let file: PartFile = toml::from_str(&text).map_err(|error| CatalogueError::Parse {
            path: path.clone(),
            message: error.to_string().trim_end().to_owned(),
        })?;
        check_name(&path, &file.name)?;
        let within = |key, value: f64, [least, most]: [f64; 2]| {
            let allowed = || format!("{least} to {most}");
            let error =
                || CatalogueError::Value { path: path.clone(), key, value: value.to_string(), allowed: allowed() };
            if (least..=most).contains(&value) { Ok(value) } else { Err(error()) }
        };
        let height_mm = within("height_mm", file.height_mm, [0.01, MAX_LENGTH_MM])?;
        let grasp = Grasp {
            width_mm: within("grasp_width_mm", file.grasp_width_mm, [0.0, MAX_LENGTH_MM])?,
            offset_mm: [
                within("grasp_offset_mm[0]", file.grasp_offset_mm[0], [-MAX_LENGTH_MM, MAX_LENGTH_MM])?,
                within("grasp_offset_mm[1]", file.grasp_offset_mm[1], [-MAX_LENGTH_MM, MAX_LENGTH_MM])?,
            ],
            angle_rad: within("grasp_angle_deg", file.grasp_angle_deg, [-360.0, 360.0])?.to_radians(),
        };
        let orders = [0.0, f64::from(MAX_SYMMETRY)];
        within("symmetry.shape_order", f64::from(file.symmetry.shape_order), orders)?;
        within("symmetry.appearance_order", f64::from(file.symmetry.appearance_order), orders)?;
        let yaw_rad = within("template.angle_deg", file.template.angle_deg, [-360.0, 360.0])?.to_radians();

        let image = read_image(&folder.join(TEMPLATE_FILE))?.into_rgb8();
        let mask_path = folder.join(MASK_FILE);
        let mask = read_image(&mask_path)?.into_luma8();
        if mask.dimensions() != image.dimensions() {
            let (mask, template) = (mask.dimensions().into(), image.dimensions().into());
            return Err(CatalogueError::MaskSize { path: mask_path, mask, template });
        }
        let pixels = mask.iter().filter(|&&value| value > 127).count();
        if pixels < MIN_MASK_PX {
            return Err(CatalogueError::MaskEmpty { path: mask_path, pixels });
        }
        let intrinsics = Intrinsics::new(file.camera.intrinsics)
            .map_err(|source| CatalogueError::Intrinsics { path: path.clone(), source })?;
        let world_from_camera = pose_from_rows(&file.camera.world_from_camera_mm)
            .map_err(|source| CatalogueError::Pose { path: path.clone(), source })?;
        let no_origin = |source| CatalogueError::Origin { path: path.clone(), source };
        let camera = Camera::new(intrinsics, world_from_camera, None).map_err(no_origin)?;
        let crop_px = file.template.crop_px;
        let [u, v] = [0, 1].map(|axis| file.template.origin_px[axis] + f64::from(crop_px[axis]));
        let [x_mm, y_mm, _] = camera.world_from_image([u, v], height_mm).map_err(no_origin)?;

        let model = folder.join(MODEL_FILE);
        let mesh = if model.exists() { Some(Mesh::read(&model)?) } else { None };
        if let Some(mesh) = &mesh {
            let model_mm = f64::from(mesh.height_mm());
            if (model_mm - height_mm).abs() > 0.1 * height_mm {
                return Err(CatalogueError::Height { path, height_mm, model_mm });
            }
        }
        let template = Template { image, mask, camera, crop_px, origin_mm: [x_mm, y_mm], yaw_rad };
        let (name, symmetry) = (file.name, file.symmetry);
        Ok(Self { name, folder: folder.to_owned(), height_mm, grasp, symmetry, template, mesh })
    }
}

/// A name is that of a folder, a topic and a key: letters, digits, `_` and `-`.
pub(crate) fn check_name(path: &Path, name: &str) -> Result<(), CatalogueError> {
    let allowed = |c: char| c.is_alphanumeric() || c == '_' || c == '-';
    if (1..=64).contains(&name.chars().count()) && name.chars().all(allowed) {
        return Ok(());
    }
    Err(CatalogueError::Value {
        path: path.to_owned(),
        key: "name",
        value: format!("{name:?}"),
        allowed: "1 to 64 letters, digits, _ and -".to_owned(),
    })
}

fn read_image(path: &Path) -> Result<image::DynamicImage, CatalogueError> {
    let mut reader = image::ImageReader::open(path)
        .map_err(|source| CatalogueError::Read { path: path.to_owned(), source })?
        .with_guessed_format()
        .map_err(|source| CatalogueError::Read { path: path.to_owned(), source })?;
    let mut limits = image::Limits::default();
    limits.max_image_width = Some(MAX_TEMPLATE_PX);
    limits.max_image_height = Some(MAX_TEMPLATE_PX);
    reader.limits(limits);
    reader.decode().map_err(|source| CatalogueError::Image { path: path.to_owned(), source })
}
