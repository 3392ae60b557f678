//! Parts made of boxes, and pictures of them, for tests.
//!
//! Pictures are made by intersecting the viewing ray of every sample with the boxes: nothing of the recognition is used.

use std::fs;
use std::path::{Path, PathBuf};

use image::{GrayImage, Luma, Rgb, RgbImage};
use samsod_camera::nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use samsod_camera::{Camera, IntrinsicParams, Intrinsics};
use samsod_segment::RgbView;
use samsod_shadow::{Mask, MaskRun, ObjectRegion, OrientedBox};

use crate::pose_fit::Pose;
use crate::{Grasp, Mesh, Part, Symmetry, Template};

/// Corners of a box, lowest and highest x, y and z, mm.
pub(crate) type Block = [[f32; 3]; 2];

/// A flat L: no turn and no mirror image is the same.
pub(crate) const FLAT_L: [Block; 2] =
    [[[-30.0, -20.0, 0.0], [30.0, 0.0, 4.0]], [[-30.0, 0.0, 0.0], [-12.0, 25.0, 4.0]]];

pub(crate) const TABLE: [u8; 3] = [90, 90, 90];
pub(crate) const PAINT: [u8; 3] = [200, 160, 60];

const SIZE: [u32; 2] = [420, 360];

/// A camera at a height, its axis tilted about the x axis of the world towards +y, over the place from which it sees the
/// origin in the middle.
fn camera_of(height_mm: f64, tilt_deg: f64, k1: f64, k2: f64) -> Camera {
    let [width_px, height_px] = SIZE;
    let intrinsics = Intrinsics::new(IntrinsicParams {
        width_px,
        height_px,
        fx_px: 800.0,
        fy_px: 800.0,
        cx_px: 208.3,
        cy_px: 181.4,
        k1,
        k2,
        p1: 0.0,
        p2: 0.0,
        k3: 0.0,
    })
    .unwrap();
    let tilt = tilt_deg.to_radians();
    let looks = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI + tilt);
    let at = Translation3::new(0.0, -height_mm * tilt.tan(), height_mm);
    Camera::new(intrinsics, Isometry3::from_parts(at, looks), None).unwrap()
}

/// Straight down from 500 mm: 0.625 mm a pixel on the table.
pub(crate) fn overhead() -> Camera {
    camera_of(500.0, 0.0, 0.0, 0.0)
}

/// Tilted by 12 degrees, with a lens that bends lines.
pub(crate) fn tilted() -> Camera {
    camera_of(500.0, 12.0, -0.25, 0.12)
}

/// Vertices and triangles of some boxes.
fn triangles(blocks: &[Block]) -> Vec<[[f32; 3]; 3]> {
    const FACES: [[usize; 4]; 6] = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let of = |block: &Block| {
        let block = *block;
        let corner = move |i: usize| [block[i & 1][0], block[i >> 1 & 1][1], block[i >> 2 & 1][2]];
        FACES.into_iter().flat_map(move |[a, b, c, d]| [[a, b, c].map(corner), [a, c, d].map(corner)])
    };
    blocks.iter().flat_map(of).collect()
}

/// A binary STL of some triangles, which says that it has `count`.
pub(crate) fn binary_stl(triangles: &[[[f32; 3]; 3]], count: u32) -> Vec<u8> {
    let mut bytes = vec![b' '; 80];
    bytes.extend(count.to_le_bytes());
    for triangle in triangles {
        bytes.extend([0u8; 12]);
        bytes.extend(triangle.iter().flatten().flat_map(|c| c.to_le_bytes()));
        bytes.extend([0u8; 2]);
    }
    bytes
}

/// The STL file of some boxes.
pub(crate) fn write_stl(blocks: &[Block], path: &Path) {
    let triangles = triangles(blocks);
    fs::write(path, binary_stl(&triangles, triangles.len() as u32)).unwrap();
}

/// Some boxes as they are read from an STL file.
pub(crate) fn mesh(blocks: &[Block]) -> Mesh {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("model.stl");
    write_stl(blocks, &path);
    Mesh::read(&path).unwrap()
}

/// Whether a ray from `near` to `far` meets a box.
fn meets([low, high]: &Block, near: [f64; 3], far: [f64; 3]) -> bool {
    let (mut first, mut last) = (f64::NEG_INFINITY, f64::INFINITY);
    for axis in 0..3 {
        let (low, high) = (f64::from(low[axis]), f64::from(high[axis]));
        let along = far[axis] - near[axis];
        if along.abs() < 1e-12 {
            if !(low..=high).contains(&near[axis]) {
                return false;
            }
            continue;
        }
        let ends = [(low - near[axis]) / along, (high - near[axis]) / along];
        first = first.max(ends[0].min(ends[1]));
        last = last.min(ends[0].max(ends[1]));
    }
    first <= last
}

/// Share of every pixel that some boxes at a pose cover, by 4 x 4 rays.
fn coverage(blocks: &[Block], camera: &Camera, pose: &Pose) -> Vec<(u32, u32, f64)> {
    let corners = triangles(blocks).into_iter().flatten();
    let seen: Vec<[f64; 2]> = corners.map(|c| camera.image_from_world(pose.world_from_part(c)).unwrap()).collect();
    let [width, height] = camera.intrinsics().size_px();
    let range = |axis: usize, size: u32| {
        let least = seen.iter().map(|p| p[axis]).fold(f64::INFINITY, f64::min) - 3.0;
        let most = seen.iter().map(|p| p[axis]).fold(f64::NEG_INFINITY, f64::max) + 3.0;
        least.max(0.0) as u32..(most.max(0.0) as u32).min(size)
    };
    let top = blocks.iter().map(|b| f64::from(b[1][2])).fold(1.0, f64::max);
    let (sin, cos) = pose.yaw_rad.sin_cos();
    let in_part = |[x, y, z]: [f64; 3]| {
        let (dx, dy) = (x - pose.x_mm, y - pose.y_mm);
        [cos * dx + sin * dy, cos * dy - sin * dx, z]
    };
    let mut pixels = Vec::new();
    for y in range(1, height) {
        for x in range(0, width) {
            let mut hits = 0;
            for sample in 0..16u32 {
                let at = |i: u32| (f64::from(i) + 0.5) / 4.0 - 0.5;
                let pixel = [f64::from(x) + at(sample % 4), f64::from(y) + at(sample / 4)];
                let Ok(near) = camera.world_from_image(pixel, top) else { continue };
                let Ok(far) = camera.world_from_image(pixel, 0.0) else { continue };
                hits += u32::from(blocks.iter().any(|block| meets(block, in_part(near), in_part(far))));
            }
            if hits > 0 {
                pixels.push((x, y, f64::from(hits) / 16.0));
            }
        }
    }
    pixels
}

/// A plain table.
pub(crate) fn table() -> RgbImage {
    RgbImage::from_pixel(SIZE[0], SIZE[1], Rgb(TABLE))
}

/// Paints boxes at a pose into a picture.
pub(crate) fn paint(image: &mut RgbImage, blocks: &[Block], camera: &Camera, pose: &Pose) {
    for (x, y, share) in coverage(blocks, camera, pose) {
        let below = image.get_pixel(x, y).0;
        let mixed = |i: usize| (f64::from(below[i]) * (1.0 - share) + f64::from(PAINT[i]) * share).round() as u8;
        image.put_pixel(x, y, Rgb([0, 1, 2].map(mixed)));
    }
}

/// Writes on the plane at the height of a part at a pose: `shade` says how bright a place in the frame of the part is, mm; `None`
/// leaves what is there.
pub(crate) fn write_on(
    image: &mut RgbImage,
    camera: &Camera,
    (pose, height_mm): (&Pose, f64),
    shade: impl Fn(f64, f64) -> Option<u8>,
) {
    let (sin, cos) = pose.yaw_rad.sin_cos();
    for (x, y, pixel) in image.enumerate_pixels_mut() {
        let below = pixel.0.map(f64::from);
        let mut sum = [0.0; 3];
        for sample in 0..16u32 {
            let at = |i: u32| (f64::from(i) + 0.5) / 4.0 - 0.5;
            let seen = [f64::from(x) + at(sample % 4), f64::from(y) + at(sample / 4)];
            let [wx, wy, _] = camera.world_from_image(seen, height_mm).unwrap();
            let (dx, dy) = (wx - pose.x_mm, wy - pose.y_mm);
            let written = shade(cos * dx + sin * dy, cos * dy - sin * dx).map(f64::from);
            (0..3).for_each(|i| sum[i] += written.unwrap_or(below[i]) / 16.0);
        }
        *pixel = Rgb(sum.map(|c| c.round() as u8));
    }
}

/// A part that was taught with something written on it.
pub(crate) fn written_part(blocks: &[Block], symmetry: Symmetry, shade: impl Fn(f64, f64) -> Option<u8>) -> Part {
    let mut part = part("written", blocks, true);
    let mut image = table();
    let pose = Pose { x_mm: 0.0, y_mm: 0.0, yaw_rad: 0.0 };
    paint(&mut image, blocks, &overhead(), &pose);
    write_on(&mut image, &overhead(), (&pose, part.height_mm), shade);
    let ([x, y], (width, height)) = (part.template.crop_px, part.template.image.dimensions());
    part.template.image = image::imageops::crop_imm(&image, x, y, width, height).to_image();
    Part { symmetry, ..part }
}

/// Some boxes as a part that was taught lying in the middle, at yaw 0, under [`overhead`].
pub(crate) fn part(name: &str, blocks: &[Block], with_mesh: bool) -> Part {
    let camera = overhead();
    let pose = Pose { x_mm: 0.0, y_mm: 0.0, yaw_rad: 0.0 };
    let mut image = table();
    paint(&mut image, blocks, &camera, &pose);
    let mut mask = GrayImage::new(SIZE[0], SIZE[1]);
    for (x, y, _) in coverage(blocks, &camera, &pose).into_iter().filter(|pixel| pixel.2 > 0.5) {
        mask.put_pixel(x, y, Luma([255]));
    }
    let [x, y, width, height] = [120, 100, 180, 160];
    let cut = |x, y| image::imageops::crop_imm(&image, x, y, width, height).to_image();
    Part {
        name: name.to_owned(),
        folder: PathBuf::new(),
        height_mm: blocks.iter().map(|b| f64::from(b[1][2])).fold(0.0, f64::max),
        grasp: Grasp { width_mm: 20.0, offset_mm: [0.0; 2], angle_rad: 0.0 },
        symmetry: Symmetry { shape_order: 1, appearance_order: 1 },
        template: Template {
            image: cut(x, y),
            mask: image::imageops::crop_imm(&mask, x, y, width, height).to_image(),
            camera,
            crop_px: [x, y],
            origin_mm: [0.0, 0.0],
            yaw_rad: 0.0,
        },
        mesh: with_mesh.then(|| mesh(blocks)),
    }
}

/// A picture as frames are taken.
pub(crate) fn view(image: &RgbImage) -> RgbView<'_> {
    RgbView::from_raw(image.width(), image.height(), image.as_raw().as_slice()).unwrap()
}

/// The mask of a rectangle.
pub(crate) fn rectangle([x, y, width, height]: [u32; 4]) -> Mask {
    let runs: Vec<MaskRun> = (y..y + height).map(|y| MaskRun { y, start: x, end: x + width }).collect();
    Mask::from_runs(&runs).unwrap()
}

/// An object of a region; without an outline.
pub(crate) fn object(region: usize, mask: Mask, shadow: Option<Mask>) -> ObjectRegion {
    let b = mask.bbox();
    let center = [(b.x + b.right()) as f32 / 2.0, (b.y + b.bottom()) as f32 / 2.0];
    ObjectRegion {
        region,
        area: mask.area(),
        centroid: center,
        oriented_box: OrientedBox {
            center_px: center,
            length_px: b.width.max(b.height) as f32,
            width_px: b.width.min(b.height) as f32,
            angle_rad: 0.0,
        },
        axis_rad: 0.0,
        outline: Vec::new(),
        holes: Vec::new(),
        mask,
        shadow,
    }
}
