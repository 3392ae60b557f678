//! Boards drawn as a known camera would see them.

use image::GrayImage;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use opencv::core::{Mat, Size};
use opencv::prelude::*;

use super::find::charuco_layout;
use super::*;
use crate::camera::Camera;
use crate::intrinsics::{IntrinsicParams, Intrinsics};

const TRUTH: IntrinsicParams = IntrinsicParams {
    width_px: 640,
    height_px: 480,
    fx_px: 800.0,
    fy_px: 806.0,
    cx_px: 322.0,
    cy_px: 236.5,
    k1: -0.15,
    k2: 0.05,
    p1: 0.0,
    p2: 0.0,
    k3: 0.0,
};
/// Pixels of the drawn board for a square.
const SQUARE_PX: u32 = 60;
/// White around the board, squares.
const MARGIN: f64 = 0.5;

/// The whole board as it is printed: columns + 1 by rows + 1 squares, x right and y up.
fn print_of(board: &Board) -> GrayImage {
    let (width, height) = ((board.columns() + 1) * SQUARE_PX, (board.rows() + 1) * SQUARE_PX);
    let Some(markers) = board.markers() else {
        // The square up and right of corner 0 is black.
        return GrayImage::from_fn(width, height, |x, y| {
            let (column, row) = (x / SQUARE_PX, (height - 1 - y) / SQUARE_PX);
            image::Luma([if (column + row) % 2 == 0 { 15 } else { 240 }])
        });
    };
    let mut drawn = Mat::default();
    let mut layout = charuco_layout(board, markers).unwrap();
    layout.draw(Size::new(width as i32, height as i32), &mut drawn, 0, 1).unwrap();
    GrayImage::from_raw(width, height, drawn.data_typed::<u8>().unwrap().to_vec()).unwrap()
}

/// The image of the board at a pose, three by three rays a pixel.
fn image_of(board: &Board, print: &GrayImage, camera_from_board: &Isometry3<f64>) -> GrayImage {
    let camera = Camera::new(Intrinsics::new(TRUTH).unwrap(), camera_from_board.inverse(), None).unwrap();
    let square = board.square_mm();
    let level = |u: f64, v: f64| {
        let Ok([x, y, _]) = camera.world_from_image([u, v], 0.0) else { return 90.0 };
        let (x, y) = (x / square + 1.0, y / square + 1.0);
        let (columns, rows) = (f64::from(board.columns() + 1), f64::from(board.rows() + 1));
        if !(-MARGIN..columns + MARGIN).contains(&x) || !(-MARGIN..rows + MARGIN).contains(&y) {
            return 90.0;
        }
        let side = f64::from(SQUARE_PX);
        // Outside of the print `as` gives 0 or a pixel that there is not.
        let pixel = (x >= 0.0 && y < rows)
            .then(|| print.get_pixel_checked((x * side) as u32, ((rows - y) * side) as u32))
            .flatten();
        pixel.map_or(240.0, |p| f64::from(p.0[0]))
    };
    GrayImage::from_fn(TRUTH.width_px, TRUTH.height_px, |x, y| {
        let mut sum = 0.0;
        for (i, j) in (0..3).flat_map(|i| (0..3).map(move |j| (i, j))) {
            let offset = |k: i32| (f64::from(k) - 1.0) / 3.0;
            sum += level(f64::from(x) + offset(i), f64::from(y) + offset(j));
        }
        image::Luma([(sum / 9.0).round() as u8])
    })
}

/// The board with its middle `distance_mm` before the camera, the face towards it.
fn pose(board: &Board, distance_mm: f64, shift_mm: [f64; 2], tilt: [f64; 2], roll: f64) -> Isometry3<f64> {
    let middle = board.corner_mm(board.corners() - 1).unwrap().map(|c| -c / 2.0);
    let towards = UnitQuaternion::from_euler_angles(std::f64::consts::PI + tilt[0], tilt[1], roll);
    let at = Translation3::new(shift_mm[0], shift_mm[1], distance_mm);
    Isometry3::from_parts(at, towards) * Translation3::new(middle[0], middle[1], 0.0)
}

fn poses(board: &Board) -> Vec<Isometry3<f64>> {
    vec![
        pose(board, 420.0, [0.0, 0.0], [0.0, 0.0], 0.1),
        pose(board, 400.0, [35.0, -20.0], [0.5, 0.0], 0.0),
        pose(board, 400.0, [-35.0, 20.0], [-0.5, 0.1], 0.4),
        pose(board, 410.0, [-30.0, -25.0], [0.1, 0.6], -0.3),
        pose(board, 410.0, [30.0, 25.0], [0.0, -0.6], 3.0),
        pose(board, 450.0, [-50.0, 0.0], [0.4, 0.4], 1.6),
    ]
}

fn view(board: &Board, print: &GrayImage, pose: &Isometry3<f64>) -> View {
    let image = image_of(board, print, pose);
    let corners = find_corners(&image, board).unwrap();
    View { path: "drawn".into(), size_px: [TRUTH.width_px, TRUTH.height_px], corners }
}

/// Where a corner is seen by the true camera.
fn truth(board: &Board, pose: &Isometry3<f64>, index: u32) -> [f64; 2] {
    let [x, y] = board.corner_mm(index).unwrap();
    let point = pose * Point3::new(x, y, 0.0);
    Intrinsics::new(TRUTH).unwrap().image_from_ray([point.x / point.z, point.y / point.z]).unwrap()
}

fn boards() -> [Board; 2] {
    let markers = Markers { marker_mm: 14.0, dictionary: "5x5_50".parse().unwrap() };
    [Board::new(9, 6, 20.0, None).unwrap(), Board::new(8, 6, 20.0, Some(markers)).unwrap()]
}

#[test]
fn corners_are_found_with_their_numbers_and_the_camera_with_its_place() {
    for board in boards() {
        let print = print_of(&board);
        let mut views = Vec::new();
        for pose in poses(&board) {
            let view = view(&board, &print, &pose);
            assert_eq!(view.corners.len(), board.corners() as usize, "{board}");
            let mut sum = 0.0;
            for corner in &view.corners {
                let [u, v] = truth(&board, &pose, corner.index);
                let error = (corner.px[0] - u).hypot(corner.px[1] - v);
                assert!(error < 0.4, "{board}: corner {} is off by {error} px", corner.index);
                sum += error;
            }
            assert!(sum / f64::from(board.corners()) < 0.15, "{board}: off by {} px", sum / f64::from(board.corners()));
            views.push(view);
        }
        let solution = calibrate(&views, &board).unwrap();
        let p = solution.intrinsics.params();
        assert!((p.fx_px - 800.0).abs() < 2.4 && (p.fy_px - 806.0).abs() < 2.4, "{board}: {solution:?}");
        assert!((p.cx_px - 322.0).abs() < 2.0 && (p.cy_px - 236.5).abs() < 2.0, "{board}: {solution:?}");
        assert!(solution.mean_error_px < 0.1, "{board}: {}", solution.mean_error_px);

        // The camera over a table on which the board lies: above it, and to the millimetre.
        let seen = board_pose(&solution.intrinsics, &views[0], &board).unwrap();
        let world = world_from_camera(&seen, 2.0);
        let expected = Translation3::new(0.0, 0.0, 2.0) * poses(&board)[0].inverse();
        assert!((world.translation.vector - expected.translation.vector).norm() < 2.0, "{world} {expected}");
        assert!((world.rotation * Vector3::z()).z < -0.99, "{world}");
        let camera = Camera::new(solution.intrinsics, world, None).unwrap();
        let check = check_on_table(&camera, &views[0], &board, 2.0).unwrap();
        assert!(check.position_mm.max < 0.15 && check.scale_error.abs() < 1e-3, "{check:?}");
        assert!(check.tilt_rad() < 1e-3 && (check.world_from_board.translation.z - 2.0).abs() < 0.1, "{check:?}");
    }
}

#[test]
fn of_a_charuco_board_some_corners_may_be_hidden_and_of_a_chessboard_none() {
    for board in boards() {
        let print = print_of(&board);
        let pose = &poses(&board)[0];
        let mut image = image_of(&board, &print, pose);
        let [u, _] = truth(&board, pose, board.columns() / 2);
        for (_, _, pixel) in image.enumerate_pixels_mut().filter(|(x, ..)| f64::from(*x) > u) {
            *pixel = image::Luma([90]);
        }
        let corners = find_corners(&image, &board).unwrap();
        if board.markers().is_none() {
            assert!(corners.is_empty(), "{corners:?}");
            continue;
        }
        assert!((LEAST_CORNERS..board.corners() as usize).contains(&corners.len()), "{}", corners.len());
        for corner in corners {
            let [u, v] = truth(&board, pose, corner.index);
            assert!((corner.px[0] - u).hypot(corner.px[1] - v) < 0.3, "{corner:?} ({u}, {v})");
        }
    }
}

#[test]
fn views_that_leave_the_camera_open_are_refused() {
    let board = boards()[0];
    let view_of = |pose: &Isometry3<f64>| View {
        path: "drawn".into(),
        size_px: [640, 480],
        corners: (0..board.corners())
            .map(|index| {
                let [u, v] = truth(&board, pose, index);
                // A little noise, the same in every run.
                let noise = |i: u32| f64::from((index * 7919 + i * 104_729) % 101) / 101.0 - 0.5;
                Corner { index, px: [u + 0.2 * noise(1), v + 0.2 * noise(2)] }
            })
            .collect(),
    };
    // All parallel to the image: nearer and larger are the same.
    let flat: Vec<View> = (0..6).map(|i| view_of(&pose(&board, 420.0, [f64::from(i), 2.0], [0.0, 0.0], 0.0))).collect();
    let refusal = calibrate(&flat, &board).map(|_| ()).unwrap_err().to_string();
    assert!(refusal.contains("no camera: the board is tilted alike in all images"), "{refusal}");

    let mut mixed: Vec<View> = poses(&board).iter().map(view_of).collect();
    assert!(calibrate(&mixed, &board).is_ok());
    mixed[3].corners.reverse();
    for (index, corner) in (0..).zip(&mut mixed[3].corners) {
        corner.index = (index * 5) % board.corners();
    }
    let refusal = calibrate(&mixed, &board).map(|_| ()).unwrap_err().to_string();
    assert!(refusal.contains("the solution is no camera"), "{refusal}");
    assert!(matches!(calibrate(&mixed[..3], &board), Err(CalibrateError::TooFewViews { found: 3, .. })));
    mixed[1].size_px = [480, 640];
    assert!(matches!(calibrate(&mixed, &board), Err(CalibrateError::Sizes { .. })));

    let mut line = view_of(&poses(&board)[0]);
    line.corners.truncate(9);
    let intrinsics = Intrinsics::new(TRUTH).unwrap();
    assert!(board_pose(&intrinsics, &line, &board).is_err(), "corners on a line");
    line.size_px = [1280, 960];
    assert!(board_pose(&intrinsics, &line, &board).unwrap_err().to_string().contains("[1280, 960] px"));
}

#[test]
fn an_image_without_a_board_has_no_corners() {
    for board in boards() {
        for image in [GrayImage::new(8, 8), GrayImage::from_pixel(200, 160, image::Luma([120]))] {
            assert!(find_corners(&image, &board).unwrap().is_empty());
        }
    }
}
