//! Teaching a part from the page: look at the table, then store what lies there.
//!
//! `POST /teach/look` takes the newest frame and finds the part in it, as `samsod teach` does; frame and mask are kept until the
//! next look. `POST /teach` makes the part of them in the catalogue of the cell. It is recognised from the next start on.

use std::path::{Path, PathBuf};
use std::sync::{Arc, PoisonError};

use axum::body::Bytes;
use axum::extract::State;
use axum::http::StatusCode;
use axum::response::Response;
use image::{GrayImage, RgbImage};
use samsod::recognize::{self, Part, TeachError};
use serde::{Deserialize, Serialize};

use super::Shared;
use super::answer::{Failure, body, json};
use super::outline::simplified;
use super::shown::Raw;
use crate::catalogue::symmetry_text;
use crate::inspect::InspectError;
use crate::picture::mask_outlines;
use crate::teach::{TeachCommandError, find_part};

/// How far a line that is drawn may lie beside the border, px.
const OUTLINE_TOLERANCE_PX: f64 = 0.8;

/// Heights of parts, and openings of the gripper, mm: what the catalogue takes.
const HEIGHTS_MM: [f64; 2] = [0.01, 5000.0];
const WIDTHS_MM: [f64; 2] = [0.0, 5000.0];
/// Most characters of a name.
const LONGEST_NAME: usize = 64;

/// What was found at the last look.
#[derive(Debug)]
pub(crate) struct Looked {
    frame: u64,
    image: RgbImage,
    mask: GrayImage,
}

#[derive(Debug, Serialize)]
struct LookJson {
    frame: u64,
    area_px: u32,
    x_px: u32,
    y_px: u32,
    width_px: u32,
    height_px: u32,
    outlines_px: Vec<Vec<[f64; 2]>>,
}

pub(crate) async fn look(State(shared): State<Shared>) -> Result<Response, Failure> {
    let shown = shared.window().current().await.ok_or_else(Failure::no_frame)?;
    let (frame, raw) = (shown.frame, shown.raw()?);
    let answer = shared.at_work(move |shared| find(&shared, frame, &raw)).await?;
    Ok(json(&answer))
}

fn find(shared: &Shared, frame: u64, raw: &Arc<Raw>) -> Result<LookJson, Failure> {
    let placer = shared.placer().ok_or_else(|| {
        Failure::conflict("the cell has neither [camera] file nor [view]: a part is learnt in millimetres")
    })?;
    let [width, height] = raw.size_px;
    let image = RgbImage::from_raw(width, height, raw.rgb.clone()).ok_or_else(Failure::no_frame)?;
    let mask = find_part(Path::new("the picture"), shared.config(), &image, placer).map_err(|e| match e {
        TeachCommandError::NoObject { .. } => {
            Failure::conflict("no object is seen; put the part alone on a table of another colour")
        }
        TeachCommandError::SeveralObjects { found, .. } => Failure::conflict(format!(
            "{} objects of notable size are seen; leave the part alone on the table",
            found.len()
        )),
        TeachCommandError::Image(e @ InspectError::OtherCamera { .. }) => Failure::conflict(e.to_string()),
        e => Failure::new(StatusCode::INTERNAL_SERVER_ERROR, e.to_string()),
    })?;
    let pixels = samsod::shadow::Mask::from_runs(&runs(&mask))
        .ok_or_else(|| Failure::conflict("no object is seen; put the part alone on the table"))?;
    let bbox = pixels.bbox();
    let lines = mask_outlines(&pixels).into_iter().map(|outline| {
        let points: Vec<[f64; 2]> = outline.iter().map(|point| point.map(f64::from)).collect();
        simplified(&points, OUTLINE_TOLERANCE_PX)
    });
    let answer = LookJson {
        frame,
        area_px: pixels.area(),
        x_px: bbox.x,
        y_px: bbox.y,
        width_px: bbox.width,
        height_px: bbox.height,
        outlines_px: lines.collect(),
    };
    *shared.looked().lock().unwrap_or_else(PoisonError::into_inner) = Some(Looked { frame, image, mask });
    Ok(answer)
}

/// Runs of a mask image, row by row.
fn runs(mask: &GrayImage) -> Vec<samsod::shadow::MaskRun> {
    let mut runs = Vec::new();
    for (y, row) in mask.rows().enumerate() {
        let mut start = None;
        for (x, is_set) in row.map(|pixel| pixel[0] > 127).chain([false]).enumerate() {
            match (start, is_set) {
                (None, true) => start = Some(x as u32),
                (Some(first), false) => {
                    runs.push(samsod::shadow::MaskRun { y: y as u32, start: first, end: x as u32 });
                    start = None;
                }
                _ => {}
            }
        }
    }
    runs
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct TeachBody {
    /// That of the last look.
    frame: u64,
    name: String,
    height_mm: f64,
    grasp_width_mm: Option<f64>,
    #[serde(default)]
    replace: bool,
}

#[derive(Debug, Serialize)]
struct TaughtJson {
    name: String,
    folder: PathBuf,
    height_mm: f64,
    grasp_width_mm: f64,
    grasp_offset_mm: [f64; 2],
    grasp_angle_deg: f64,
    symmetry: String,
    /// When the part is recognised.
    in_force: &'static str,
}

pub(crate) async fn teach(State(shared): State<Shared>, bytes: Bytes) -> Result<Response, Failure> {
    let lesson: TeachBody = body(&bytes)?;
    lesson.check()?;
    let answer = shared.at_work(move |shared| store(&shared, &lesson)).await?;
    Ok(json(&answer))
}

impl TeachBody {
    fn check(&self) -> Result<(), Failure> {
        let allowed = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
        if !(1..=LONGEST_NAME).contains(&self.name.len()) || !self.name.chars().all(allowed) {
            let name = &self.name;
            return Err(Failure::wrong(format!(
                "name is {name:?}; allowed: 1 to {LONGEST_NAME} letters, digits, _ and -"
            )));
        }
        let lengths =
            [("height_mm", Some(self.height_mm), HEIGHTS_MM), ("grasp_width_mm", self.grasp_width_mm, WIDTHS_MM)];
        for (key, value, [least, most]) in lengths {
            if let Some(value) = value.filter(|value| !(least..=most).contains(value)) {
                return Err(Failure::wrong(format!("{key} is {value}; allowed: {least} to {most}")));
            }
        }
        Ok(())
    }
}

fn store(shared: &Shared, lesson: &TeachBody) -> Result<TaughtJson, Failure> {
    let catalogue = shared.config().catalogue.folder.as_deref();
    let catalogue = catalogue.ok_or_else(|| {
        Failure::conflict("the configuration names no [catalogue] folder in which the part could be stored")
    })?;
    let looked = shared.looked().lock().unwrap_or_else(PoisonError::into_inner);
    let looked = looked.as_ref().filter(|looked| looked.frame == lesson.frame).ok_or_else(|| {
        Failure::new(StatusCode::GONE, format!("frame {} is not that of the last look; look anew", lesson.frame))
    })?;
    let camera = shared.placer().and_then(|placer| placer.camera(looked.image.dimensions().into()));
    let camera = camera.ok_or_else(|| Failure::conflict("the picture is not of the camera of the cell"))?;
    let taught = recognize::teach(
        catalogue,
        &recognize::Lesson {
            name: &lesson.name,
            frame: &looked.image,
            mask: &looked.mask,
            camera: &camera,
            model: None,
            height_mm: Some(lesson.height_mm),
            grasp_width_mm: lesson.grasp_width_mm,
        },
        lesson.replace,
    );
    let Part { name, folder, height_mm, grasp, symmetry, .. } = taught.map_err(|e| match e {
        TeachError::Exists { .. } => Failure::conflict(format!(
            "the catalogue has a part {:?} already; replace it or choose another name",
            lesson.name
        )),
        e @ TeachError::NameTaken { .. } => Failure::conflict(e.to_string()),
        e @ TeachError::Write { .. } => Failure::new(StatusCode::INTERNAL_SERVER_ERROR, e.to_string()),
        e => Failure::wrong(e.to_string()),
    })?;
    tracing::info!(part = name, folder = %folder.display(), frame = lesson.frame, "a part was taught from the page");
    Ok(TaughtJson {
        name,
        folder,
        height_mm,
        grasp_width_mm: grasp.width_mm,
        grasp_offset_mm: grasp.offset_mm,
        grasp_angle_deg: grasp.angle_rad.to_degrees() + 0.0,
        symmetry: symmetry_text(&symmetry),
        in_force: "from the next start of samsodd on",
    })
}
