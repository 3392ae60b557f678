//! Finding the corners of a board in an image.

use std::path::{Path, PathBuf};

use image::GrayImage;
use nalgebra::{Matrix2, Vector2};
use opencv::core::{Mat, Point2f, Ptr, Size, TermCriteria, TermCriteria_Type, ToInputArray, Vector, no_array};
use opencv::{aruco, calib3d, imgproc};
use rayon::prelude::*;

use super::board::{Board, Markers};
use super::{CalibrateError, LEAST_CORNERS};

/// Window of the refinement as a share of the distance to the next corner.
const WINDOW_SHARE: f64 = 0.3;
/// Least and most of its half side, px.
const LEAST_WINDOW_PX: i32 = 2;
const MOST_WINDOW_PX: i32 = 30;

/// A corner of the board and where it was seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Corner {
    /// Which, as [`Board::corner_mm`] counts.
    pub index: u32,
    /// Where in the image, px.
    pub px: [f64; 2],
}

/// An image in which the board was found.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// The file.
    pub path: PathBuf,
    /// Width and height of the image, px.
    pub size_px: [u32; 2],
    /// The corners, by ascending index.
    pub corners: Vec<Corner>,
}

/// The PNG and JPEG files of a folder, by name.
///
/// # Errors
/// [`CalibrateError::Read`] and, if there is none, [`CalibrateError::NoImages`].
pub fn image_files(folder: &Path) -> Result<Vec<PathBuf>, CalibrateError> {
    let failed = |source| CalibrateError::Read { path: folder.into(), source };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(failed)? {
        let path = entry.map_err(failed)?.path();
        let extension = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        if ["png", "jpg", "jpeg"].contains(&extension.as_str()) && path.is_file() {
            files.push(path);
        }
    }
    if files.is_empty() {
        return Err(CalibrateError::NoImages { path: folder.into() });
    }
    files.sort();
    Ok(files)
}

/// Looks for the board in many files at once, in their order.
pub fn find_views(files: &[PathBuf], board: &Board) -> Vec<Result<View, CalibrateError>> {
    files.par_iter().map(|file| find_view(file, board)).collect()
}

/// Looks for the board in a file.
///
/// # Errors
/// [`CalibrateError::Read`], [`CalibrateError::NoImage`], [`CalibrateError::NoBoard`].
pub fn find_view(path: &Path, board: &Board) -> Result<View, CalibrateError> {
    let bytes = std::fs::read(path).map_err(|source| CalibrateError::Read { path: path.into(), source })?;
    // By content, not by name.
    let image = image::load_from_memory(&bytes);
    let image = image.map_err(|source| CalibrateError::NoImage { path: path.into(), source })?.into_luma8();
    let corners = find_corners(&image, board)?;
    if corners.len() < LEAST_CORNERS {
        return Err(CalibrateError::NoBoard { path: path.into(), board: board.to_string() });
    }
    Ok(View { path: path.into(), size_px: image.dimensions().into(), corners })
}

/// The corners of the board in an image; none if it is not found. A chessboard is found with all its corners or not at
/// all; of a ChArUco board some may be hidden.
///
/// # Errors
/// [`CalibrateError::OpenCv`].
pub fn find_corners(image: &GrayImage, board: &Board) -> Result<Vec<Corner>, CalibrateError> {
    let (width, height) = image.dimensions();
    if width < 32 || height < 32 {
        return Ok(Vec::new());
    }
    let pixels = Mat::new_rows_cols_with_bytes::<u8>(height as i32, width as i32, image.as_raw())?;
    match board.markers() {
        Some(markers) => charuco(&pixels, board, markers),
        None => chessboard(&pixels, image, board),
    }
}

fn chessboard(pixels: &impl ToInputArray, image: &GrayImage, board: &Board) -> Result<Vec<Corner>, CalibrateError> {
    let size = Size::new(board.columns() as i32, board.rows() as i32);
    let mut found = Vector::<Point2f>::new();
    let flags = calib3d::CALIB_CB_ADAPTIVE_THRESH | calib3d::CALIB_CB_NORMALIZE_IMAGE;
    if !calib3d::find_chessboard_corners(pixels, size, &mut found, flags)? {
        // Slower, and it finds some boards that the first misses.
        if !calib3d::find_chessboard_corners_sb(pixels, size, &mut found, calib3d::CALIB_CB_NORMALIZE_IMAGE)? {
            return Ok(Vec::new());
        }
    }
    if found.len() != board.corners() as usize {
        return Ok(Vec::new());
    }
    let coarse: Vec<[f64; 2]> = found.iter().map(|p| [f64::from(p.x), f64::from(p.y)]).collect();
    Ok(ordered(refined(pixels, &coarse, WINDOW_SHARE)?, image, board))
}

/// The corners to a fraction of a pixel (OpenCV's `cornerSubPix`: every gradient in a window is to be at right angles to
/// the line from the corner), each in a window whose half side is a share of the distance to the nearest other corner.
fn refined(
    pixels: &impl ToInputArray,
    corners: &[[f64; 2]],
    window_share: f64,
) -> Result<Vec<[f64; 2]>, CalibrateError> {
    let criteria = TermCriteria::new(TermCriteria_Type::COUNT as i32 | TermCriteria_Type::EPS as i32, 60, 1e-4)?;
    let mut refined = Vec::with_capacity(corners.len());
    for (index, [x, y]) in corners.iter().enumerate() {
        let others = corners.iter().enumerate().filter(|(other, _)| *other != index);
        let nearest = others.map(|(_, c)| (c[0] - x).hypot(c[1] - y)).fold(f64::INFINITY, f64::min);
        let half = ((window_share * nearest) as i32).clamp(LEAST_WINDOW_PX, MOST_WINDOW_PX);
        let mut point: Vector<Point2f> = [Point2f::new(*x as f32, *y as f32)].into_iter().collect();
        imgproc::corner_sub_pix(pixels, &mut point, Size::new(half, half), Size::new(-1, -1), criteria)?;
        let point = point.get(0)?;
        refined.push([f64::from(point.x), f64::from(point.y)]);
    }
    Ok(refined)
}

/// Counts the corners as [`Board`] does: right-handed with z towards the camera and, if the board tells its two ends
/// apart (one side odd, the other even), a black square at corner 0.
fn ordered(mut found: Vec<[f64; 2]>, image: &GrayImage, board: &Board) -> Vec<Corner> {
    let columns = board.columns() as usize;
    let (first, right, down) = (found[0], found[columns - 1], found[found.len() - columns]);
    let across = (right[0] - first[0]) * (down[1] - first[1]) - (right[1] - first[1]) * (down[0] - first[0]);
    // Rows run downwards in the image, where x right and y down turn clockwise: z would point into the board.
    if across > 0.0 {
        found = found.chunks(columns).rev().flatten().copied().collect();
    }
    // Positive if squares of the colour of the first are darker than the others.
    let mut darkness = 0.0;
    for row in 0..board.rows() as usize - 1 {
        for column in 0..columns - 1 {
            let at = row * columns + column;
            let corners = [found[at], found[at + 1], found[at + columns], found[at + columns + 1]];
            let centre = [0, 1].map(|i| corners.iter().map(|c| c[i]).sum::<f64>() / 4.0);
            let [x, y] = centre.map(|c| c.round().max(0.0) as u32);
            let level = image.get_pixel_checked(x, y).map_or(0.0, |p| f64::from(p.0[0]));
            darkness += if (row + column) % 2 == 0 { -level } else { level };
        }
    }
    let ends_differ = (board.columns() + board.rows()) % 2 == 1;
    if ends_differ && darkness < 0.0 {
        found.reverse();
    }
    found.into_iter().zip(0..).map(|(px, index)| Corner { index, px }).collect()
}

fn charuco(pixels: &impl ToInputArray, board: &Board, markers: &Markers) -> Result<Vec<Corner>, CalibrateError> {
    let dictionary = aruco::get_predefined_dictionary_i32(markers.dictionary.id())?;
    let layout = charuco_layout(board, markers)?;
    let parameters = aruco::DetectorParameters::create()?;
    let (mut outlines, mut ids) = (Vector::<Vector<Point2f>>::new(), Vector::<i32>::new());
    aruco::detect_markers(pixels, &dictionary, &mut outlines, &mut ids, &parameters, &mut no_array())?;
    if ids.is_empty() {
        return Ok(Vec::new());
    }
    let (mut found, mut numbers) = (Vector::<Point2f>::new(), Vector::<i32>::new());
    aruco::interpolate_corners_charuco_def(&outlines, &ids, pixels, &layout, &mut found, &mut numbers)?;
    // OpenCV 4.6 puts them half a pixel too far right and down; refined, they are where those of a chessboard would be.
    // The window must not reach the markers.
    let margin_share = (1.0 - markers.marker_mm / board.square_mm()) / 2.0;
    let coarse: Vec<[f64; 2]> = found.iter().map(|p| [f64::from(p.x), f64::from(p.y)]).collect();
    let exact = refined(pixels, &coarse, WINDOW_SHARE.min(margin_share))?;
    let mut corners: Vec<Corner> = numbers
        .iter()
        .zip(exact)
        .map(|(number, px)| Corner { index: number.unsigned_abs(), px })
        .filter(|corner| corner.index < board.corners())
        .collect();
    // OpenCV counts rows from the top of the print since 4.6 and from its bottom before.
    if is_mirrored(&corners, board) {
        for corner in &mut corners {
            let (row, column) = (corner.index / board.columns(), corner.index % board.columns());
            corner.index = (board.rows() - 1 - row) * board.columns() + column;
        }
        corners.sort_by_key(|corner| corner.index);
    }
    Ok(corners)
}

/// Whether the corners are counted so that z points into the board: the sign of the linear part of the best affine map
/// from the board to the image, whose rows run downwards.
fn is_mirrored(corners: &[Corner], board: &Board) -> bool {
    let pairs: Vec<_> = corners
        .iter()
        .filter_map(|corner| Some((Vector2::from(board.corner_mm(corner.index)?), Vector2::from(corner.px))))
        .collect();
    let count = pairs.len().max(1) as f64;
    let (mut board_mean, mut image_mean) = (Vector2::zeros(), Vector2::zeros());
    for (on_board, in_image) in &pairs {
        board_mean += on_board / count;
        image_mean += in_image / count;
    }
    // The map is this times the inverse of the scatter on the board, whose determinant is positive.
    let covariance: Matrix2<f64> = pairs.iter().map(|(b, i)| (i - image_mean) * (b - board_mean).transpose()).sum();
    covariance.determinant() > 0.0
}

/// OpenCV's description of a ChArUco board.
pub(super) fn charuco_layout(board: &Board, markers: &Markers) -> Result<Ptr<aruco::CharucoBoard>, CalibrateError> {
    let dictionary = aruco::get_predefined_dictionary_i32(markers.dictionary.id())?;
    Ok(aruco::CharucoBoard::create(
        board.columns() as i32 + 1,
        board.rows() as i32 + 1,
        board.square_mm() as f32,
        markers.marker_mm as f32,
        &dictionary,
    )?)
}
