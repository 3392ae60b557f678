//! Verifying the calibration from the page: a board on the table, and how far off its corners are.
//!
//! The same measurement as `samsod calibrate verify`, on the newest frame.

use std::path::PathBuf;
use std::sync::Arc;

use axum::body::Bytes;
use axum::extract::State;
use axum::http::StatusCode;
use axum::response::Response;
use image::{RgbImage, imageops};
use samsod_camera::calibrate::{Board, CalibrateError, Markers, Spread, View, check_on_table, find_corners};
use serde::{Deserialize, Serialize};

use super::Shared;
use super::answer::{Failure, body, json};
use super::shown::Raw;

/// Fewest corners from which something is measured.
const LEAST_CORNERS: usize = 6;
/// Thickest board, mm.
const THICKEST_MM: f64 = 200.0;

/// The board that lies on the table.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct BoardBody {
    /// Inner corners in a row, and rows of them.
    columns: u32,
    rows: u32,
    square_mm: f64,
    #[serde(default)]
    board_thickness_mm: f64,
    /// Of a ChArUco board.
    markers: Option<MarkersBody>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct MarkersBody {
    marker_mm: f64,
    dictionary: String,
}

#[derive(Debug, Serialize)]
struct VerifiedJson {
    frame: u64,
    corners: usize,
    corners_px: Vec<[f64; 2]>,
    /// Distance of each corner from its place on the board after the best rigid fit.
    position_mm: SpreadJson,
    /// Error of the distance of every pair of corners.
    distance_mm: SpreadJson,
    reprojection_px: SpreadJson,
    /// By how much lengths come out too long.
    scale_error_percent: f64,
    /// Angle between board and table by the image alone.
    tilt_deg: f64,
}

#[derive(Debug, Serialize)]
struct SpreadJson {
    mean: f64,
    rms: f64,
    max: f64,
}

impl From<Spread> for SpreadJson {
    fn from(Spread { mean, rms, max }: Spread) -> Self {
        Self { mean, rms, max }
    }
}

pub(crate) async fn verify(State(shared): State<Shared>, bytes: Bytes) -> Result<Response, Failure> {
    let asked: BoardBody = body(&bytes)?;
    let (board, thickness_mm) = board(&asked)?;
    let shown = shared.window().current().await.ok_or_else(Failure::no_frame)?;
    let (frame, raw) = (shown.frame, shown.raw()?);
    let answer = shared.at_work(move |shared| measure(&shared, frame, &raw, &board, thickness_mm)).await?;
    Ok(json(&answer))
}

fn board(asked: &BoardBody) -> Result<(Board, f64), Failure> {
    let wrong = |e: CalibrateError| Failure::wrong(e.to_string());
    let markers = match &asked.markers {
        Some(markers) => {
            let dictionary = markers.dictionary.parse().map_err(wrong)?;
            Some(Markers { marker_mm: markers.marker_mm, dictionary })
        }
        None => None,
    };
    let thickness_mm = asked.board_thickness_mm;
    // NaN is in no range.
    if !(0.0..=THICKEST_MM).contains(&thickness_mm) {
        return Err(Failure::wrong(format!("board_thickness_mm is {thickness_mm}; allowed: 0 to {THICKEST_MM}")));
    }
    let board = Board::new(asked.columns, asked.rows, asked.square_mm, markers).map_err(wrong)?;
    Ok((board, thickness_mm))
}

fn measure(
    shared: &Shared,
    frame: u64,
    raw: &Arc<Raw>,
    board: &Board,
    thickness_mm: f64,
) -> Result<VerifiedJson, Failure> {
    if shared.config().camera.file.is_none() {
        return Err(Failure::conflict("the cell has no calibrated camera: [camera] file is not set"));
    }
    let camera = shared.placer().and_then(|placer| placer.camera(raw.size_px));
    let camera = camera.ok_or_else(|| Failure::conflict("the frame has not the size of the calibrated camera's"))?;
    let [width, height] = raw.size_px;
    let image = RgbImage::from_raw(width, height, raw.rgb.clone()).ok_or_else(Failure::no_frame)?;
    let failed = |e: CalibrateError| Failure::new(StatusCode::INTERNAL_SERVER_ERROR, e.to_string());
    let corners = find_corners(&imageops::grayscale(&image), board).map_err(failed)?;
    if corners.len() < LEAST_CORNERS {
        return Err(Failure::conflict(format!(
            "the board is not seen ({board}); it must lie flat and whole in the picture, without glare"
        )));
    }
    let view = View { path: PathBuf::from("the frame"), size_px: raw.size_px, corners };
    let check = check_on_table(&camera, &view, board, thickness_mm).map_err(|e| Failure::conflict(e.to_string()))?;
    Ok(VerifiedJson {
        frame,
        corners: view.corners.len(),
        corners_px: view.corners.iter().map(|corner| corner.px).collect(),
        scale_error_percent: check.scale_error * 100.0,
        tilt_deg: check.tilt_rad().to_degrees(),
        position_mm: check.position_mm.into(),
        distance_mm: check.distance_mm.into(),
        reprojection_px: check.reprojection_px.into(),
    })
}
