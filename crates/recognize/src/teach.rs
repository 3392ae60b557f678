//! Teaching: from a picture of a part alone to its folder in a catalogue.
//!
//! In: a frame, the mask of the part in it, the camera, and the shape of the part if there is a model. Out: the folder that
//! [`Part::read`] reads. It is made beside its place and checked there, then renamed: it is there whole or not at all.
//!
//! With a shape, origin and axes of the part are those of the shape, laid over the mask. Without, the origin is the
//! centroid of the mask on the plane of the part's height, and the axes are those of the world: the part is taught as
//! lying at yaw 0.

use std::fs;
use std::path::{Path, PathBuf};

use image::{GrayImage, ImageFormat, Luma, RgbImage, imageops};
use samsod_camera::{Camera, ProjectionError, rows_from_pose};

use crate::align::align_mesh;
use crate::catalogue::{Catalogue, CatalogueError, MASK_FILE, MODEL_FILE, PART_FILE, Part, TEMPLATE_FILE, check_name};
use crate::mesh::{Mesh, MeshError};
use crate::part_file::{CameraRecord, PartFile, TemplateRecord};
use crate::symmetry::find_symmetry;

/// What of the frame is kept round the part, px.
const MARGIN_PX: u32 = 16;
/// Fewest pixels of a part.
const MIN_PART_PX: usize = 50;
/// Heights of parts, mm.
const HEIGHTS_MM: [f64; 2] = [0.01, 5_000.0];
/// Openings of grippers, mm.
const WIDTHS_MM: [f64; 2] = [0.0, 5_000.0];
/// Greatest difference between the height that is given and that of the shape, as a share.
const HEIGHT_TOLERANCE: f64 = 0.1;
/// Directions in which the width of a part without a shape is measured: steps of half a degree over a right angle.
const BOX_STEPS: u32 = 180;

/// What a part is taught from.
#[derive(Debug, Clone, Copy)]
pub struct Lesson<'a> {
    /// Name of the part, and of its folder.
    pub name: &'a str,
    /// A frame in which the part lies.
    pub frame: &'a RgbImage,
    /// More than 127 on the part; of the size of the frame.
    pub mask: &'a GrayImage,
    /// The camera that took the frame, with its pose over the table.
    pub camera: &'a Camera,
    /// STL file of its shape: mm, z up, lying as the part lies.
    pub model: Option<&'a Path>,
    /// Height of the part as it lies, mm; by default that of the shape, and needed without one.
    pub height_mm: Option<f64>,
    /// Opening of the gripper at the part, mm; by default the shorter side of the shape seen from above, or of the smallest
    /// rectangle round the mask.
    pub grasp_width_mm: Option<f64>,
}

/// Why a part was not taught.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TeachError {
    /// The part is there already.
    #[error("{} is there already and was not changed; --force replaces it", path.display())]
    Exists {
        /// Its folder.
        path: PathBuf,
    },
    /// Another folder of the catalogue holds a part of that name.
    #[error("{}: is named {name} already; every part needs a name of its own", path.display())]
    NameTaken {
        /// The name.
        name: String,
        /// The file that has it.
        path: PathBuf,
    },
    /// The frame is not of the camera.
    #[error(
        "the picture has {frame:?} px, the camera {camera:?} px; a picture of that camera is needed, not cropped or scaled"
    )]
    CameraSize {
        /// Width and height of the frame, px.
        frame: [u32; 2],
        /// Those of the camera's image.
        camera: [u32; 2],
    },
    /// The mask is not of the frame.
    #[error("the mask has {mask:?} px, the picture {frame:?} px; both must have the same size")]
    MaskSize {
        /// Width and height of the mask, px.
        mask: [u32; 2],
        /// Those of the frame.
        frame: [u32; 2],
    },
    /// The mask has hardly any pixel.
    #[error("{pixels} px of the mask are set (more than 127); a part needs at least {MIN_PART_PX}")]
    MaskEmpty {
        /// Pixels set.
        pixels: usize,
    },
    /// The part is not seen whole.
    #[error("the part reaches the border of the picture at ({x}, {y}) px; it must be seen whole")]
    Cut {
        /// A pixel of the mask on the border.
        x: u32,
        /// Its row.
        y: u32,
    },
    /// Nothing says how high the part is.
    #[error("how high the part is is not known: give its height (--height-mm) or its shape (--stl)")]
    NoHeight,
    /// A length is out of range.
    #[error("{key} is {value} mm; allowed: {least} to {most}")]
    Length {
        /// Which length.
        key: &'static str,
        /// The value, mm.
        value: f64,
        /// The least that is allowed, mm.
        least: f64,
        /// The most that is allowed, mm.
        most: f64,
    },
    /// The height and that of the shape differ.
    #[error("the height is {height_mm} mm, but {} is {model_mm:.2} mm high; allowed is a difference of 10 %", path.display())]
    Height {
        /// The model.
        path: PathBuf,
        /// The height given, mm.
        height_mm: f64,
        /// Height of the shape, mm.
        model_mm: f64,
    },
    /// The shape cannot be used.
    #[error(transparent)]
    Mesh(#[from] MeshError),
    /// The shape does not fit what is seen.
    #[error(
        "{} does not fit the {pixels} px of the mask: is it the shape of this part, lying as it lies, and the camera that of the picture?",
        path.display()
    )]
    NoFit {
        /// The model.
        path: PathBuf,
        /// Pixels of the mask.
        pixels: usize,
    },
    /// The camera does not see the plane of the part's height there.
    #[error("the part has no place at a height of {height_mm} mm: {source}")]
    Place {
        /// Height of the part, mm.
        height_mm: f64,
        /// Why.
        source: ProjectionError,
    },
    /// The name is none, or what was written is no part.
    #[error(transparent)]
    Catalogue(#[from] CatalogueError),
    /// The folder cannot be written.
    #[error("cannot write {}: {cause}", path.display())]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// What was said.
        cause: String,
    },
}

/// Makes the folder of a part in a catalogue, which is made too if it does not exist.
///
/// # Arguments
/// * `overwrite` - whether a part of that name may be replaced
///
/// # Errors
/// [`TeachError`]; the catalogue is then as it was.
pub fn teach(catalogue: &Path, lesson: &Lesson<'_>, overwrite: bool) -> Result<Part, TeachError> {
    check_name(catalogue, lesson.name)?;
    let folder = catalogue.join(lesson.name);
    if folder.exists() && !overwrite {
        return Err(TeachError::Exists { path: folder });
    }
    check_name_is_free(catalogue, &folder, lesson.name)?;
    let crop = Crop::of(lesson)?;
    let mesh = lesson.model.map(Mesh::read).transpose()?;
    let file = describe(lesson, &crop, mesh.as_ref())?;

    fs::create_dir_all(catalogue).map_err(|e| unwritable(catalogue, e))?;
    // A folder below it, since a part half made and one half replaced must not be taken for parts of the catalogue.
    let workshop =
        tempfile::Builder::new().prefix(".teach-").tempdir_in(catalogue).map_err(|e| unwritable(catalogue, e))?;
    let made = workshop.path().join("made");
    write(&made, lesson, &crop, &file)?;
    Part::read(&made)?;
    let former = workshop.path().join("former");
    let replaces = folder.exists();
    if replaces {
        fs::rename(&folder, &former).map_err(|e| unwritable(&folder, e))?;
    }
    if let Err(e) = fs::rename(&made, &folder) {
        if replaces {
            fs::rename(&former, &folder).map_err(|e| unwritable(&folder, e))?;
        }
        return Err(unwritable(&folder, e));
    }
    Ok(Part::read(&folder)?)
}

fn unwritable(path: &Path, cause: impl ToString) -> TeachError {
    TeachError::Write { path: path.to_owned(), cause: cause.to_string() }
}

/// A part of that name in a folder of another name would make the catalogue unreadable.
fn check_name_is_free(catalogue: &Path, folder: &Path, name: &str) -> Result<(), TeachError> {
    // A catalogue that is not there, or is wrong elsewhere, has no such part that could be told.
    let Ok(known) = Catalogue::read(catalogue) else { return Ok(()) };
    match known.part(name).filter(|part| part.folder != folder) {
        Some(part) => Err(TeachError::NameTaken { name: name.to_owned(), path: part.folder.join(PART_FILE) }),
        None => Ok(()),
    }
}

/// The part cut from its frame.
struct Crop {
    image: RgbImage,
    mask: GrayImage,
    at_px: [u32; 2],
    pixels: usize,
}

impl Crop {
    fn of(lesson: &Lesson<'_>) -> Result<Self, TeachError> {
        let frame: [u32; 2] = lesson.frame.dimensions().into();
        let mask: [u32; 2] = lesson.mask.dimensions().into();
        let camera = lesson.camera.intrinsics().size_px();
        if frame != camera {
            return Err(TeachError::CameraSize { frame, camera });
        }
        if mask != frame {
            return Err(TeachError::MaskSize { mask, frame });
        }
        let [mut left, mut top, mut right, mut bottom] = [u32::MAX, u32::MAX, 0, 0];
        let mut pixels = 0;
        for (x, y, _) in lesson.mask.enumerate_pixels().filter(|(_, _, value)| value[0] > 127) {
            if x == 0 || y == 0 || x + 1 == frame[0] || y + 1 == frame[1] {
                return Err(TeachError::Cut { x, y });
            }
            (left, top, right, bottom) = (left.min(x), top.min(y), right.max(x), bottom.max(y));
            pixels += 1;
        }
        if pixels < MIN_PART_PX {
            return Err(TeachError::MaskEmpty { pixels });
        }
        let [x, y] = [left, top].map(|first| first.saturating_sub(MARGIN_PX));
        let width = (right + 1 + MARGIN_PX).min(frame[0]) - x;
        let height = (bottom + 1 + MARGIN_PX).min(frame[1]) - y;
        let mut cut = imageops::crop_imm(lesson.mask, x, y, width, height).to_image();
        cut.pixels_mut().for_each(|Luma([value])| *value = if *value > 127 { 255 } else { 0 });
        let image = imageops::crop_imm(lesson.frame, x, y, width, height).to_image();
        Ok(Self { image, mask: cut, at_px: [x, y], pixels })
    }

    /// The pixels of the part, as (u, v) of the frame.
    fn part_px(&self) -> impl Iterator<Item = [f64; 2]> {
        let inside = self.mask.enumerate_pixels().filter(|(_, _, value)| value[0] > 127);
        inside.map(|(x, y, _)| [f64::from(x + self.at_px[0]), f64::from(y + self.at_px[1])])
    }

    fn centroid_px(&self) -> [f64; 2] {
        let sum = self.part_px().fold([0.0; 2], |[su, sv], [u, v]| [su + u, sv + v]);
        sum.map(|s| s / self.pixels as f64)
    }
}

/// What `part.toml` says.
fn describe(lesson: &Lesson<'_>, crop: &Crop, mesh: Option<&Mesh>) -> Result<PartFile, TeachError> {
    let model_mm = mesh.map(|mesh| f64::from(mesh.height_mm()));
    let height_mm = lesson.height_mm.or(model_mm).ok_or(TeachError::NoHeight)?;
    let height_mm = within("the height", thousandths(height_mm), HEIGHTS_MM)?;
    if let (Some(path), Some(model_mm)) = (lesson.model, model_mm)
        && (model_mm - height_mm).abs() > HEIGHT_TOLERANCE * height_mm
    {
        return Err(TeachError::Height { path: path.to_owned(), height_mm, model_mm });
    }
    let no_place = |source| TeachError::Place { height_mm, source };
    let ([x_mm, y_mm], yaw_rad) = match (mesh, lesson.model) {
        (Some(mesh), Some(path)) => align_mesh(mesh, &crop.image, &crop.mask, lesson.camera, crop.at_px)
            .ok_or_else(|| TeachError::NoFit { path: path.to_owned(), pixels: crop.pixels })?,
        _ => {
            let [x, y, _] = lesson.camera.world_from_image(crop.centroid_px(), height_mm).map_err(no_place)?;
            ([x, y], 0.0)
        }
    };
    let [u, v] = lesson.camera.image_from_world([x_mm, y_mm, height_mm]).map_err(no_place)?;
    let origin_px = [u - f64::from(crop.at_px[0]), v - f64::from(crop.at_px[1])];
    let span = match mesh {
        Some(mesh) => Span::of_mesh(mesh),
        None => Span::of_mask(lesson.camera, crop, height_mm, [x_mm, y_mm]).map_err(no_place)?,
    };
    let grasp_width_mm = thousandths(lesson.grasp_width_mm.unwrap_or(span.width_mm));
    Ok(PartFile {
        name: lesson.name.to_owned(),
        height_mm,
        grasp_width_mm: within("the grasp width", grasp_width_mm, WIDTHS_MM)?,
        grasp_offset_mm: span.middle_mm.map(thousandths),
        grasp_angle_deg: thousandths(span.angle_rad.to_degrees()),
        symmetry: find_symmetry(&crop.image, &crop.mask, mesh, origin_px),
        template: TemplateRecord { crop_px: crop.at_px, origin_px, angle_deg: yaw_rad.to_degrees() },
        camera: CameraRecord {
            world_from_camera_mm: rows_from_pose(lesson.camera.world_from_camera()),
            intrinsics: *lesson.camera.intrinsics().params(),
        },
    })
}

fn within(key: &'static str, value: f64, [least, most]: [f64; 2]) -> Result<f64, TeachError> {
    if (least..=most).contains(&value) { Ok(value) } else { Err(TeachError::Length { key, value, least, most }) }
}

/// Rounded: a file that people read and edit.
fn thousandths(value: f64) -> f64 {
    // Adding 0 makes -0 a 0.
    (value * 1000.0).round() / 1000.0 + 0.0
}

/// The shorter side of a part seen from above, across which it is gripped, in the axes of the part.
struct Span {
    /// Its length, mm.
    width_mm: f64,
    /// The middle of the part's box, mm.
    middle_mm: [f64; 2],
    /// Direction of the longer side, along which the fingers lie, rad.
    angle_rad: f64,
}

impl Span {
    /// Of the box along the axes of the shape.
    fn of_mesh(mesh: &Mesh) -> Self {
        Self::along(mesh.vertices().iter().map(|v| [f64::from(v[0]), f64::from(v[1])]), 0.0)
    }

    /// Of the smallest rectangle round the mask, on the plane of the part's height.
    fn of_mask(camera: &Camera, crop: &Crop, height_mm: f64, origin_mm: [f64; 2]) -> Result<Self, ProjectionError> {
        let from_origin = |pixel| {
            let [x, y, _] = camera.world_from_image(pixel, height_mm)?;
            Ok([x - origin_mm[0], y - origin_mm[1]])
        };
        // The outer corners of the first and the last pixel of every row are all that can touch a rectangle.
        let mut ends: Vec<[f64; 2]> = Vec::new();
        let pixels: Vec<[f64; 2]> = crop.part_px().collect();
        for row in pixels.chunk_by(|a, b| a[1] == b[1]) {
            let sides = [(row.first(), -0.5), (row.last(), 0.5)];
            for (&[u, v], side) in sides.into_iter().filter_map(|(pixel, side)| Some((pixel?, side))) {
                ends.extend([[u + side, v - 0.5], [u + side, v + 0.5]]);
            }
        }
        let points = ends.into_iter().map(from_origin).collect::<Result<Vec<_>, _>>()?;
        let turned = |step: u32| {
            let angle_rad = std::f64::consts::FRAC_PI_2 * f64::from(step) / f64::from(BOX_STEPS);
            let extent = extent(points.iter().copied(), angle_rad);
            (extent[0].1 - extent[0].0) * (extent[1].1 - extent[1].0)
        };
        let best = (0..BOX_STEPS).min_by(|&a, &b| turned(a).total_cmp(&turned(b))).unwrap_or(0);
        let angle_rad = std::f64::consts::FRAC_PI_2 * f64::from(best) / f64::from(BOX_STEPS);
        Ok(Self::along(points.into_iter(), angle_rad))
    }

    /// Of the box whose sides lie at an angle and across it.
    fn along(points: impl Iterator<Item = [f64; 2]>, angle_rad: f64) -> Self {
        let [along, across] = extent(points, angle_rad);
        let (sin, cos) = angle_rad.sin_cos();
        let (a, b) = ((along.0 + along.1) / 2.0, (across.0 + across.1) / 2.0);
        let middle_mm = [a * cos - b * sin, a * sin + b * cos];
        let (length, width) = (along.1 - along.0, across.1 - across.0);
        if width <= length {
            Self { width_mm: width, middle_mm, angle_rad }
        } else {
            Self { width_mm: length, middle_mm, angle_rad: angle_rad + std::f64::consts::FRAC_PI_2 }
        }
    }
}

/// Least and greatest coordinate along an angle and across it.
fn extent(points: impl Iterator<Item = [f64; 2]>, angle_rad: f64) -> [(f64, f64); 2] {
    let (sin, cos) = angle_rad.sin_cos();
    let none = (f64::INFINITY, f64::NEG_INFINITY);
    points.fold([none; 2], |[along, across], [x, y]| {
        let wider = |(least, most): (f64, f64), at: f64| (least.min(at), most.max(at));
        [wider(along, x * cos + y * sin), wider(across, y * cos - x * sin)]
    })
}

/// Writes the files of a part.
fn write(folder: &Path, lesson: &Lesson<'_>, crop: &Crop, file: &PartFile) -> Result<(), TeachError> {
    fs::create_dir(folder).map_err(|e| unwritable(folder, e))?;
    let path = folder.join(PART_FILE);
    let text = toml::to_string(file).map_err(|e| unwritable(&path, e))?;
    fs::write(&path, text).map_err(|e| unwritable(&path, e))?;
    let path = folder.join(TEMPLATE_FILE);
    crop.image.save_with_format(&path, ImageFormat::Png).map_err(|e| unwritable(&path, e))?;
    let path = folder.join(MASK_FILE);
    crop.mask.save_with_format(&path, ImageFormat::Png).map_err(|e| unwritable(&path, e))?;
    if let Some(model) = lesson.model {
        let path = folder.join(MODEL_FILE);
        fs::copy(model, &path).map_err(|e| unwritable(&path, e))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests;
