//! Shapes whose symmetry is known, and the bundled parts.

use std::f64::consts::TAU;
use std::path::Path;

use image::{GrayImage, Luma, Rgb, RgbImage};

use super::*;
use crate::Catalogue;

const SIDE: u32 = 160;
/// Off the pixel grid: a part never lies on it.
const CENTRE: [f64; 2] = [79.3, 80.6];

/// A mask of what `inside` says of a point, in px from the centre.
fn mask(inside: impl Fn(f64, f64) -> bool) -> GrayImage {
    GrayImage::from_fn(SIDE, SIDE, |x, y| {
        Luma([if inside(f64::from(x) - CENTRE[0], f64::from(y) - CENTRE[1]) { 255 } else { 0 }])
    })
}

/// A grey part with dark marks, and the centroid of its mask.
fn found(inside: impl Fn(f64, f64) -> bool, mark: impl Fn(f64, f64) -> bool) -> (u32, u32) {
    let mask = mask(inside);
    let image = RgbImage::from_fn(SIDE, SIDE, |x, y| {
        let noise = ((x * 7 + y * 13) % 5) as u8;
        let is_mark = mark(f64::from(x) - CENTRE[0], f64::from(y) - CENTRE[1]);
        let grey = if is_mark {
            60
        } else if mask.get_pixel(x, y)[0] > 0 {
            150
        } else {
            90
        };
        Rgb([grey + noise; 3])
    });
    let centre = Plane::of_mask(&mask).centroid().unwrap();
    let symmetry = find_symmetry(&image, &mask, None, centre);
    (symmetry.shape_order, symmetry.appearance_order)
}

fn nowhere(_: f64, _: f64) -> bool {
    false
}

fn polygon(corners: f64) -> impl Fn(f64, f64) -> bool {
    move |x, y| {
        let segment = TAU / corners;
        let angle = (y.atan2(x) + 0.3).rem_euclid(segment) - segment / 2.0;
        x.hypot(y) * angle.cos() < 37.0
    }
}

fn spot(at: [f64; 2]) -> impl Fn(f64, f64) -> bool {
    move |x, y| (x - at[0]).hypot(y - at[1]) < 6.0
}

#[test]
fn outlines_have_their_order() {
    for corners in [3.0, 4.0, 5.0, 6.0, 8.0] {
        assert_eq!(found(polygon(corners), nowhere), (corners as u32, corners as u32), "{corners} corners");
    }
    assert_eq!(found(|x, y| x.hypot(y) < 55.0, nowhere), (0, 0), "a disc");
    assert_eq!(found(|x, y| (20.0..55.0).contains(&x.hypot(y)), nowhere), (0, 0), "a ring");
    assert_eq!(found(|x, y| x.abs() < 60.0 && y.abs() < 25.0, nowhere), (2, 2), "a rectangle");
    let angle = |x: f64, y: f64| (x.abs() < 50.0 && y.abs() < 50.0) && (x < -20.0 || y > 20.0);
    assert_eq!(found(angle, nowhere), (1, 1), "an angle");
    // A disc with a flat: nearly round is not round.
    assert_eq!(found(|x, y| x.hypot(y) < 55.0 && x < 45.0, nowhere), (1, 1), "a disc with a flat");
}

#[test]
fn marks_take_symmetry_away() {
    let disc = |x: f64, y: f64| x.hypot(y) < 55.0;
    assert_eq!(found(disc, spot([24.0, 5.0])), (0, 1), "one mark on a disc");
    let opposite = |x: f64, y: f64| spot([24.0, 5.0])(x, y) || spot([-24.0, -5.0])(x, y);
    assert_eq!(found(disc, opposite), (0, 2), "two on a disc");
    assert_eq!(found(polygon(6.0), opposite), (6, 2), "two on a hexagon");
    assert_eq!(found(polygon(5.0), opposite), (5, 1), "two on a pentagon");
    assert_eq!(found(disc, |x, y| x.hypot(y) < 8.0), (0, 0), "one in the middle");
}

/// The bundled parts say in part.toml what they were modelled with.
#[test]
fn bundled_parts_have_the_symmetry_that_they_were_modelled_with() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/parts");
    let catalogue = Catalogue::read(&folder).unwrap();
    assert_eq!(catalogue.parts().len(), 20);
    let mut wrong = Vec::new();
    for part in catalogue.parts() {
        let template = &part.template;
        let top = [template.origin_mm[0], template.origin_mm[1], part.height_mm];
        let [u, v] = template.camera.image_from_world(top).unwrap();
        let origin_px = [u - f64::from(template.crop_px[0]), v - f64::from(template.crop_px[1])];
        for mesh in [part.mesh.as_ref(), None] {
            let found = find_symmetry(&template.image, &template.mask, mesh, origin_px);
            let mut expected = part.symmetry;
            if part.name == "terminal_block" {
                // Its lettering is five pixels high: too small to be told from its turned self.
                expected.appearance_order = 2;
            }
            if found != expected {
                wrong.push(format!("{}, with its shape {}: {found:?}", part.name, mesh.is_some()));
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn a_shape_beside_its_axis_has_no_symmetry() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/parts");
    let nut = std::fs::read(folder.join("hex_nut/model.stl")).unwrap();
    let moved = tempfile::NamedTempFile::with_suffix(".stl").unwrap();
    let mut bytes = nut.clone();
    // Binary STL: after 84 bytes, 50 a triangle, of which the first 12 are the normal.
    for triangle in bytes[84..].chunks_exact_mut(50) {
        for x in [12, 24, 36] {
            let value: f32 = f32::from_le_bytes(triangle[x..x + 4].try_into().unwrap()) + 10.0;
            triangle[x..x + 4].copy_from_slice(&value.to_le_bytes());
        }
    }
    std::fs::write(moved.path(), bytes).unwrap();
    assert!(silhouette(&Mesh::read(&folder.join("hex_nut/model.stl")).unwrap()).is_some());
    assert!(silhouette(&Mesh::read(moved.path()).unwrap()).is_none());
}
