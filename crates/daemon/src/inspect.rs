//! `samsod inspect`: the vision chain on one image file.
//!
//! In: an image file, the chain and, if there is one, what places objects. Out, in a folder and named after the image:
//!
//! ```text
//! NAME-detections.png   with a catalogue: the image with outline, name and angle of each part, and what is unknown
//! NAME-objects.png      the image with the outline and the number of each object, objects and shadows tinted
//! NAME-regions.png      the image with the outline and the id of each region
//! NAME-partitions.png   the proto-object partitions in their mean colours, borders white
//! NAME-saliency.png     the square root of the saliency, its greatest value white
//! NAME.json             figures of each region, object and detection, and the time of each stage
//! ```

use std::path::{Path, PathBuf};
use std::time::Duration;

use image::{ImageFormat, RgbImage};
use samsod::segment::RgbView;
use samsod::{Cell, CellError, Scene};
use samsod_camera::nalgebra::Isometry3;
use serde::Serialize;

use crate::caption::{self, Arrow, Captions};
use crate::place::{ImagePlace, Place, Placer};
use crate::recording::{DetectionMessage, ObjectMessage, RegionMessage, SceneMessage};
use crate::{masks, picture};

/// Why an image could not be inspected.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum InspectError {
    /// The file cannot be read.
    #[error("cannot read {}: {cause}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        #[source]
        cause: std::io::Error,
    },
    /// The file is no image, or a broken one.
    #[error("{} is no PNG or JPEG image that can be read: {cause}", path.display())]
    NoImage {
        /// The file.
        path: PathBuf,
        /// What the decoder said.
        #[source]
        cause: image::ImageError,
    },
    /// The image has more pixels than memory has addresses.
    #[error("{} has {width} x {height} pixels, too many to address", path.display())]
    Size {
        /// The file.
        path: PathBuf,
        /// Its width, px.
        width: u32,
        /// Its height, px.
        height: u32,
    },
    /// The image is not of the camera that is to place its objects.
    #[error(
        "{} has {width} x {height} pixels, the camera of the camera file has {camera_width} x {camera_height}",
        path.display()
    )]
    OtherCamera {
        /// The file.
        path: PathBuf,
        /// Its width, px.
        width: u32,
        /// Its height, px.
        height: u32,
        /// Width of the camera's image, px.
        camera_width: u32,
        /// Height of the camera's image, px.
        camera_height: u32,
    },
    /// The chain refused the parameters or the image.
    #[error(transparent)]
    Cell(#[from] CellError),
    /// A result cannot be written.
    #[error("cannot write {}: {cause}", path.display())]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        cause: String,
    },
}

/// What was found and where it was written.
#[derive(Debug, Clone)]
pub struct Inspection {
    /// The scene.
    pub scene: Scene,
    /// The place, if it has one, of each object; empty when nothing was given to place them.
    pub places: Vec<Option<Place>>,
    /// The files, in the order of the module documentation.
    pub files: Vec<PathBuf>,
}

/// What is written as JSON.
#[derive(Serialize)]
struct Report<'a> {
    image: &'a str,
    #[serde(flatten)]
    scene: SceneMessage<'a>,
    times_ms: std::collections::BTreeMap<&'a str, f64>,
}

/// Inspects the image at `path` and writes the results into `folder`, which is made if it does not exist.
///
/// # Arguments
/// * `cell` - the chain; its camera is set to that of `placer`
/// * `placer` - what takes objects to the table; without it they have places in the image only
///
/// # Errors
/// [`InspectError`]; each variant names the file.
pub fn run(path: &Path, folder: &Path, cell: &mut Cell, placer: Option<&Placer>) -> Result<Inspection, InspectError> {
    let image = load(path)?;
    let scene = look(path, &image, cell, placer)?;
    let places = placer.map_or(Vec::new(), |placer| {
        scene.objects.iter().map(|object| placer.place(&ImagePlace::from(object)).ok()).collect()
    });

    let write_error = |path: &Path, cause: String| InspectError::Write { path: path.to_path_buf(), cause };
    std::fs::create_dir_all(folder).map_err(|e| write_error(folder, e.to_string()))?;
    let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let mut files = Vec::new();
    let detections = cell.catalogue().map(|_| ("detections", detections(&image, &scene)));
    let others = [
        ("objects", objects(&image, &scene)),
        ("regions", annotated(&image, &scene)),
        ("partitions", partitions(&scene)),
        ("saliency", saliency(&scene)),
    ];
    for (name, picture) in detections.into_iter().chain(others) {
        let file = folder.join(format!("{stem}-{name}.png"));
        picture.save_with_format(&file, ImageFormat::Png).map_err(|e| write_error(&file, e.to_string()))?;
        files.push(file);
    }
    let file = folder.join(format!("{stem}.json"));
    let base_from_world = placer.and_then(Placer::base_from_world);
    let text = report(&path.to_string_lossy(), &scene, &places, base_from_world.as_ref());
    let text = text.map_err(|e| write_error(&file, e.to_string()))?;
    std::fs::write(&file, text).map_err(|e| write_error(&file, e.to_string()))?;
    files.push(file);
    Ok(Inspection { scene, places, files })
}

/// What the chain sees in an image, after checking that it is of the camera that is to place it.
pub(crate) fn look(
    path: &Path,
    image: &RgbImage,
    cell: &mut Cell,
    placer: Option<&Placer>,
) -> Result<Scene, InspectError> {
    let (width, height) = image.dimensions();
    if let Some([camera_width, camera_height]) = placer.and_then(Placer::image_size_px)
        && (width, height) != (camera_width, camera_height)
    {
        let path = path.to_path_buf();
        return Err(InspectError::OtherCamera { path, width, height, camera_width, camera_height });
    }
    let view = RgbView::from_raw(width, height, image.as_raw().as_slice()).ok_or_else(|| InspectError::Size {
        path: path.to_path_buf(),
        width,
        height,
    })?;
    cell.set_camera(placer.and_then(|placer| placer.camera([width, height])));
    Ok(cell.inspect(&view)?)
}

/// Reads an image file.
pub(crate) fn load(path: &Path) -> Result<RgbImage, InspectError> {
    let bytes = std::fs::read(path).map_err(|cause| InspectError::Read { path: path.to_path_buf(), cause })?;
    // By content, not by name.
    let image = image::load_from_memory(&bytes);
    Ok(image.map_err(|cause| InspectError::NoImage { path: path.to_path_buf(), cause })?.into_rgb8())
}

/// The image with the outline and the id of each region.
pub fn annotated(image: &RgbImage, scene: &Scene) -> RgbImage {
    let mut picture = image.clone();
    let labels = scene.partition.labels();
    for (id, region) in scene.regions.iter().enumerate() {
        for outline in picture::region_outlines(image.width(), region, |i| labels[i]) {
            picture::draw_outline(&mut picture, &outline, picture::region_colour(id), 2);
        }
    }
    // After all outlines, so that none crosses an id; two pixels a dot where a camera frame has 1000 pixels.
    let scale = (image.width() / 500).max(1);
    for (id, region) in scene.regions.iter().enumerate() {
        let [x, y] = region.centroid;
        picture::draw_number(&mut picture, id, x as u32, y as u32, scale);
    }
    picture
}

/// The image with objects and shadows tinted, and the outline and the number of each object.
pub fn objects(image: &RgbImage, scene: &Scene) -> RgbImage {
    let mut picture = image.clone();
    let mut codes = Vec::new();
    masks::paint(image.dimensions(), &scene.objects, &mut codes);
    picture::tint_masks(&mut picture, &codes);
    for (id, object) in scene.objects.iter().enumerate() {
        for outline in picture::object_outlines(object) {
            picture::draw_outline(&mut picture, &outline, picture::region_colour(id), 2);
        }
    }
    let scale = (image.width() / 500).max(1);
    for (id, object) in scene.objects.iter().enumerate() {
        let [x, y] = object.centroid;
        picture::draw_number(&mut picture, id, x as u32, y as u32, scale);
    }
    picture
}

/// The image with the outline, the name and the angle of each detection.
pub fn detections(image: &RgbImage, scene: &Scene) -> RgbImage {
    let mut picture = image.clone();
    for (id, detection) in scene.detections.iter().enumerate() {
        let colour = picture::region_colour(id);
        for outline in picture::mask_outlines(&detection.mask) {
            picture::draw_outline(&mut picture, &outline, colour, 2);
        }
        for line in Arrow::of(detection).lines() {
            caption::draw_line(&mut picture, line, colour, 2);
        }
    }
    // After all outlines, so that none crosses a name.
    let (mut captions, scale) = (Captions::default(), (image.width() / 500).max(1));
    for (id, detection) in scene.detections.iter().enumerate() {
        let bbox = detection.mask.bbox();
        let at = [f64::from(bbox.x) + f64::from(bbox.width) / 2.0, f64::from(bbox.y)];
        let text = caption::short(detection.name.as_deref(), detection.image.angle_rad.to_degrees());
        captions.draw(&mut picture, &text, at, picture::region_colour(id), scale);
    }
    picture
}

fn partitions(scene: &Scene) -> RgbImage {
    let means: Vec<[f32; 3]> = scene.partition.objects().iter().map(|object| object.mean).collect();
    let labels = scene.partition.labels();
    picture::partition_picture(scene.partition.width(), scene.partition.height(), &means, |i| labels[i])
}

fn saliency(scene: &Scene) -> RgbImage {
    let values = scene.saliency.values();
    picture::saliency_picture(scene.saliency.width(), scene.saliency.height(), |i| values[i])
}

fn report(
    image: &str,
    scene: &Scene,
    places: &[Option<Place>],
    base_from_world: Option<&Isometry3<f64>>,
) -> Result<String, serde_json::Error> {
    let milliseconds = |time: Duration| time.as_secs_f64() * 1e3;
    let report = Report {
        image,
        scene: SceneMessage {
            sequence: 0,
            camera: "file",
            width_px: scene.partition.width(),
            height_px: scene.partition.height(),
            partitions: scene.partition.len(),
            regions: scene.regions.iter().enumerate().map(|(id, r)| RegionMessage::new(id, r)).collect(),
            objects: ObjectMessage::all(&scene.objects, places),
            detections: DetectionMessage::all(&scene.detections, base_from_world),
        },
        times_ms: scene.times.stages().into_iter().map(|(stage, time)| (stage, milliseconds(time))).collect(),
    };
    serde_json::to_string_pretty(&report)
}
