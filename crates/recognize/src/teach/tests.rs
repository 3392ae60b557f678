//! Parts taught and read back.

use samsod_camera::nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use samsod_camera::{IntrinsicParams, Intrinsics};

use super::*;
use crate::Symmetry;

const SIZE: [u32; 2] = [320, 240];

/// Straight down from 400 mm: half a millimetre a pixel on the table.
fn camera() -> Camera {
    let [width_px, height_px] = SIZE;
    let intrinsics = Intrinsics::new(IntrinsicParams {
        width_px,
        height_px,
        fx_px: 800.0,
        fy_px: 800.0,
        cx_px: 160.0,
        cy_px: 120.0,
        k1: 0.0,
        k2: 0.0,
        p1: 0.0,
        p2: 0.0,
        k3: 0.0,
    })
    .unwrap();
    let down = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
    Camera::new(intrinsics, Isometry3::from_parts(Translation3::new(0.0, 0.0, 400.0), down), None).unwrap()
}

/// A bar of 80 x 40 px about (200, 90), turned by an angle counter-clockwise on the screen.
fn bar(angle_deg: f64) -> (RgbImage, GrayImage) {
    let (sin, cos) = angle_deg.to_radians().sin_cos();
    let mask = GrayImage::from_fn(SIZE[0], SIZE[1], |x, y| {
        let (dx, dy) = (f64::from(x) - 200.0, 90.0 - f64::from(y));
        let inside = (dx * cos + dy * sin).abs() < 40.0 && (dy * cos - dx * sin).abs() < 20.0;
        Luma([if inside { 200 } else { 100 }])
    });
    let frame = RgbImage::from_fn(SIZE[0], SIZE[1], |x, y| image::Rgb([mask.get_pixel(x, y)[0]; 3]));
    (frame, mask)
}

/// An ASCII STL of a box of 40 x 20 mm, 10 mm high, about the origin and on the table.
fn box_stl(folder: &Path) -> PathBuf {
    let corner = |i: usize| [[-20.0, 20.0][i & 1], [-10.0, 10.0][i >> 1 & 1], [0.0, 10.0][i >> 2 & 1]];
    let faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let mut text = "solid box\n".to_owned();
    for [a, b, c, d] in faces {
        for triangle in [[a, b, c], [a, c, d]] {
            text += "facet normal 0 0 0\nouter loop\n";
            for i in triangle {
                let [x, y, z] = corner(i);
                text += &format!("vertex {x} {y} {z}\n");
            }
            text += "endloop\nendfacet\n";
        }
    }
    let path = folder.join("box.stl");
    fs::write(&path, text + "endsolid box\n").unwrap();
    path
}

struct Bench {
    folder: tempfile::TempDir,
    frame: RgbImage,
    mask: GrayImage,
    camera: Camera,
}

impl Bench {
    fn new(angle_deg: f64) -> Self {
        let (frame, mask) = bar(angle_deg);
        Self { folder: tempfile::tempdir().unwrap(), frame, mask, camera: camera() }
    }

    fn parts(&self) -> PathBuf {
        self.folder.path().join("parts")
    }

    fn lesson(&self) -> Lesson<'_> {
        Lesson {
            name: "bar",
            frame: &self.frame,
            mask: &self.mask,
            camera: &self.camera,
            model: None,
            height_mm: Some(20.0),
            grasp_width_mm: None,
        }
    }

    /// What lies in the catalogue.
    fn names(&self) -> Vec<String> {
        let Ok(entries) = fs::read_dir(self.parts()) else { return Vec::new() };
        entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
    }
}

#[test]
fn a_part_without_a_shape_has_its_origin_under_its_centroid_and_is_gripped_across() {
    for angle_deg in [0.0, 30.0, 90.0, 110.0] {
        let bench = Bench::new(angle_deg);
        let part = teach(&bench.parts(), &bench.lesson(), false).unwrap();
        // The plane at 20 mm: 0.475 mm a pixel.
        let [x, y] = part.template.origin_mm;
        assert!((x - 40.0 * 0.475).abs() < 0.3 && (y - 30.0 * 0.475).abs() < 0.3, "{:?}", part.template.origin_mm);
        assert_eq!((part.template.yaw_rad, part.height_mm), (0.0, 20.0));
        let grasp = part.grasp;
        assert!((grasp.width_mm - 40.0 * 0.475).abs() < 0.8, "{angle_deg}: {grasp:?}");
        let off = (grasp.angle_rad.to_degrees() - angle_deg).rem_euclid(180.0);
        assert!(off.min(180.0 - off) < 1.5, "{angle_deg}: {grasp:?}");
        assert!(grasp.offset_mm.iter().all(|c| c.abs() < 0.5), "{grasp:?}");
        assert_eq!(part.symmetry.appearance_order, 2, "{angle_deg}");
        let [left, top] = part.template.crop_px;
        let (first, _, _) = bench.mask.enumerate_pixels().filter(|(_, _, v)| v[0] > 127).min_by_key(|p| p.0).unwrap();
        assert_eq!(left, first - MARGIN_PX);
        assert_eq!(part.template.image.get_pixel(0, 0), bench.frame.get_pixel(left, top));
        assert_eq!(Catalogue::read(&bench.parts()).unwrap().parts(), [part]);
        assert_eq!(bench.names(), ["bar"]);
    }
}

#[test]
fn a_shape_gives_height_and_grasp_and_is_kept() {
    let bench = Bench::new(0.0);
    let model = box_stl(bench.folder.path());
    let lesson = Lesson { model: Some(&model), height_mm: None, ..bench.lesson() };
    let part = teach(&bench.parts(), &lesson, false).unwrap();
    assert_eq!((part.height_mm, part.grasp.width_mm, part.grasp.offset_mm), (10.0, 20.0, [0.0; 2]));
    assert_eq!(part.symmetry, Symmetry { shape_order: 2, appearance_order: 2 });
    assert_eq!(part.mesh.unwrap().triangles().len(), 12);
    assert_eq!(fs::read(part.folder.join(MODEL_FILE)).unwrap(), fs::read(&model).unwrap());
    let refused = teach(&bench.parts(), &Lesson { height_mm: Some(12.0), ..lesson }, true).unwrap_err().to_string();
    assert!(refused.contains("the height is 12 mm, but") && refused.contains("box.stl is 10.00 mm high"), "{refused}");
    let wide = teach(&bench.parts(), &Lesson { grasp_width_mm: Some(33.0), ..lesson }, true).unwrap();
    assert_eq!(wide.grasp.width_mm, 33.0);
}

#[test]
fn what_cannot_be_taught_says_why_and_leaves_nothing() {
    let bench = Bench::new(0.0);
    let lesson = bench.lesson();
    let small = GrayImage::new(8, 8);
    let none = GrayImage::new(SIZE[0], SIZE[1]);
    let all = GrayImage::from_pixel(SIZE[0], SIZE[1], Luma([255]));
    let cropped = RgbImage::new(100, 100);
    let no_stl = bench.folder.path().join("none.stl");
    for (lesson, expected) in [
        (Lesson { name: "a b", ..lesson }, "name is \"a b\"; allowed: 1 to 64 letters, digits, _ and -"),
        (Lesson { name: "../bar", ..lesson }, "name is \"../bar\""),
        (Lesson { height_mm: None, ..lesson }, "give its height (--height-mm) or its shape (--stl)"),
        (Lesson { height_mm: Some(f64::NAN), ..lesson }, "the height is NaN mm; allowed: 0.01 to 5000"),
        (Lesson { grasp_width_mm: Some(-1.0), ..lesson }, "the grasp width is -1 mm; allowed: 0 to 5000"),
        (Lesson { height_mm: Some(400.0), ..lesson }, "the part has no place at a height of 400 mm: "),
        (Lesson { mask: &small, ..lesson }, "the mask has [8, 8] px, the picture [320, 240] px"),
        (Lesson { mask: &none, ..lesson }, "0 px of the mask are set (more than 127); a part needs at least 50"),
        (Lesson { mask: &all, ..lesson }, "the part reaches the border of the picture at (0, 0) px"),
        (Lesson { frame: &cropped, ..lesson }, "the picture has [100, 100] px, the camera [320, 240] px"),
        (Lesson { model: Some(&no_stl), ..lesson }, "none.stl"),
    ] {
        let refused = teach(&bench.parts(), &lesson, false).unwrap_err().to_string();
        assert!(refused.contains(expected), "{expected}: {refused}");
        assert_eq!(bench.names(), [""; 0], "{expected}");
    }
}

#[test]
fn a_part_is_replaced_only_when_told_to_and_then_whole() {
    let bench = Bench::new(0.0);
    teach(&bench.parts(), &bench.lesson(), false).unwrap();
    // What others have put there goes with the former part: it was computed from it.
    fs::write(bench.parts().join("bar/descriptors"), "old").unwrap();
    let higher = Lesson { height_mm: Some(25.0), ..bench.lesson() };
    let refused = teach(&bench.parts(), &higher, false).unwrap_err().to_string();
    assert!(refused.ends_with("bar is there already and was not changed; --force replaces it"), "{refused}");
    assert_eq!(Part::read(&bench.parts().join("bar")).unwrap().height_mm, 20.0);
    assert_eq!(teach(&bench.parts(), &higher, true).unwrap().height_mm, 25.0);
    assert!(!bench.parts().join("bar/descriptors").exists());
    // One that fails leaves the former.
    let wrong = Lesson { grasp_width_mm: Some(f64::INFINITY), ..bench.lesson() };
    teach(&bench.parts(), &wrong, true).unwrap_err();
    assert_eq!(Part::read(&bench.parts().join("bar")).unwrap().height_mm, 25.0);
    assert_eq!(bench.names(), ["bar"]);
}

#[test]
fn a_name_that_another_folder_has_is_refused() {
    let bench = Bench::new(0.0);
    teach(&bench.parts(), &bench.lesson(), false).unwrap();
    fs::rename(bench.parts().join("bar"), bench.parts().join("elsewhere")).unwrap();
    let refused = teach(&bench.parts(), &bench.lesson(), true).unwrap_err().to_string();
    assert!(refused.contains("elsewhere/part.toml: is named bar already"), "{refused}");
}
