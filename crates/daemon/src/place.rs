//! From the image to the table and to the robot: where an object lies, in millimetres.
//!
//! In: an object in pixels, and a calibrated camera or the overhead view of the configuration. Out: its [`Place`].
//! Pure functions; nothing here knows frames, files or robots.
//!
//! The centroid of an object is placed on one plane z = `object_height_mm` for all objects: an outline that lies higher
//! seems to lie farther out. The yaw is that of the longer side of the object's box. A line has no direction, so it is
//! kept in (-90, 90] degrees.

use samsod::shadow::ObjectRegion;
use samsod_camera::nalgebra::{Isometry3, Point3, Vector3};
use samsod_camera::{Camera, ProjectionError};
use samsod_robot::Pose;
use serde::Serialize;

use crate::config::ViewConfig;

/// Half the length of the image line by which the size of a pixel is measured, px. The ends stay inside the image.
const HALF_STEP_PX: f64 = 0.5;

/// Height of the camera that stands for a view, mm: so high that parallax is below what a pixel shows.
const VIEW_HEIGHT_MM: f64 = 1e6;

/// A place on a plane parallel to the table.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PlanePose {
    /// mm.
    pub x_mm: f64,
    /// mm.
    pub y_mm: f64,
    /// mm.
    pub z_mm: f64,
    /// About z, counter-clockwise seen from above, degrees: of an object, which has no direction, in (-90, 90]; of a part
    /// in (-180, 180].
    pub yaw_deg: f64,
}

impl PlanePose {
    /// The same in another frame, whose z axis is up too.
    pub fn moved(&self, to_from_here: &Isometry3<f64>) -> Self {
        let point = to_from_here * Point3::new(self.x_mm, self.y_mm, self.z_mm);
        let (sin, cos) = self.yaw_deg.to_radians().sin_cos();
        let along = to_from_here.rotation * Vector3::new(cos, sin, 0.0);
        Self { x_mm: point.x, y_mm: point.y, z_mm: point.z, yaw_deg: along.y.atan2(along.x).to_degrees() + 0.0 }
    }
}

/// Where an object lies and how large it is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// In the world: the table is z = 0.
    pub world: PlanePose,
    /// In the base frame of the robot, if it is known where the robot stands.
    pub base: Option<PlanePose>,
    /// Longer and shorter side of its box on the plane, mm.
    pub size_mm: [f64; 2],
}

/// What an object is placed by: its centroid and its box, px.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImagePlace {
    /// Centroid (u, v), px.
    pub centroid_px: [f64; 2],
    /// Longer and shorter side of its box, px.
    pub size_px: [f64; 2],
    /// Direction of the longer side, radians counter-clockwise on the screen from image right.
    pub angle_rad: f64,
}

impl From<&ObjectRegion> for ImagePlace {
    fn from(object: &ObjectRegion) -> Self {
        let found = &object.oriented_box;
        Self {
            centroid_px: object.centroid.map(f64::from),
            size_px: [found.length_px, found.width_px].map(f64::from),
            angle_rad: f64::from(found.angle_rad),
        }
    }
}

/// How pixels become millimetres.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Source {
    Camera(Camera),
    /// Table and robot base are one frame.
    View(ViewConfig),
}

/// Places objects on one plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placer {
    source: Source,
    height_mm: f64,
}

impl Placer {
    /// Places by a calibrated camera, on the plane z = `height_mm`.
    ///
    /// # Errors
    /// [`ProjectionError`] when the middle of the image does not see the plane.
    pub fn with_camera(camera: Camera, height_mm: f64) -> Result<Self, ProjectionError> {
        let [u, v] = camera.intrinsics().size_px().map(|side| (f64::from(side) - 1.0) / 2.0);
        camera.world_from_image([u, v], height_mm)?;
        Ok(Self { source: Source::Camera(camera), height_mm })
    }

    /// Places by the overhead view, whose table is the frame of the robot. The view knows no parallax: `height_mm` only
    /// becomes z.
    pub fn with_view(view: ViewConfig, height_mm: f64) -> Self {
        Self { source: Source::View(view), height_mm }
    }

    /// The only size of image that can be placed, px; `None` when there is no such limit.
    pub fn image_size_px(&self) -> Option<[u32; 2]> {
        match &self.source {
            Source::Camera(camera) => Some(camera.intrinsics().size_px()),
            Source::View(_) => None,
        }
    }

    /// Whether places are known at the robot, too.
    pub fn knows_base(&self) -> bool {
        self.base_from_world().is_some()
    }

    /// Pose of the world in the base frame of the robot, mm, if it is known.
    pub fn base_from_world(&self) -> Option<Isometry3<f64>> {
        match &self.source {
            Source::Camera(camera) => camera.base_from_world().copied(),
            Source::View(_) => Some(Isometry3::identity()),
        }
    }

    /// The camera that takes images of a size, px, for those who need rays and not places; `None` for a size that it does
    /// not have.
    pub fn camera(&self, size_px: [u32; 2]) -> Option<Camera> {
        match &self.source {
            Source::Camera(camera) => (camera.intrinsics().size_px() == size_px).then_some(*camera),
            Source::View(view) => Camera::overhead(size_px, view.mm_per_px, view.origin_px, VIEW_HEIGHT_MM).ok(),
        }
    }

    /// Where an object lies.
    ///
    /// # Errors
    /// [`ProjectionError`] when the ray of its centroid does not meet the plane, or it lies outside the image.
    pub fn place(&self, object: &ImagePlace) -> Result<Place, ProjectionError> {
        match &self.source {
            Source::Camera(camera) => self.by_camera(camera, object),
            Source::View(view) => {
                let [u, v] = object.centroid_px;
                let [x_mm, y_mm] = view.table_from_image(u, v);
                // The view has no rotation: counter-clockwise on the screen is counter-clockwise from above.
                let world = PlanePose { x_mm, y_mm, z_mm: self.height_mm, yaw_deg: line_deg(object.angle_rad) };
                Ok(Place { world, base: Some(world), size_mm: object.size_px.map(|side| side * view.mm_per_px) })
            }
        }
    }

    fn by_camera(&self, camera: &Camera, object: &ImagePlace) -> Result<Place, ProjectionError> {
        let (pixel, height) = (object.centroid_px, self.height_mm);
        // Rows run downwards, so counter-clockwise on the screen is a negative atan2(dv, du).
        let image_angle = -object.angle_rad;
        let pose =
            |[x_mm, y_mm, z_mm]: [f64; 3], yaw_rad: f64| PlanePose { x_mm, y_mm, z_mm, yaw_deg: line_deg(yaw_rad) };
        let world = pose(
            camera.world_from_image(pixel, height)?,
            camera.world_yaw_from_image_angle(pixel, image_angle, height)?,
        );
        let base = match camera.base_from_world() {
            None => None,
            Some(_) => Some(pose(
                camera.base_from_image(pixel, height)?,
                camera.base_yaw_from_image_angle(pixel, image_angle, height)?,
            )),
        };
        let across = image_angle + std::f64::consts::FRAC_PI_2;
        let [length_px, width_px] = object.size_px;
        let size_mm = [
            length_px * mm_per_px(camera, pixel, image_angle, height)?,
            width_px * mm_per_px(camera, pixel, across, height)?,
        ];
        Ok(Place { world, base, size_mm })
    }

    /// The tool over a place, gripper down, `height_mm` above the table, in the base frame of the robot; `None` when it is
    /// not known where the robot stands.
    pub fn tool_above(&self, place: &Place, height_mm: f64) -> Option<Pose> {
        self.tool([place.world.x_mm, place.world.y_mm], place.base?.yaw_deg, height_mm)
    }

    /// The tool over a point of the table, its x axis at a yaw of the base frame of the robot; `None` when it is not known
    /// where the robot stands.
    pub fn tool(&self, [x_mm, y_mm]: [f64; 2], base_yaw_deg: f64, height_mm: f64) -> Option<Pose> {
        let point = self.base_from_world()? * Point3::new(x_mm, y_mm, height_mm);
        Some(Pose::gripper_down(point.x, point.y, point.z, base_yaw_deg.to_radians()))
    }
}

/// Size of a pixel on the plane at a pixel, in a direction of the image, mm.
fn mm_per_px(camera: &Camera, pixel: [f64; 2], image_angle_rad: f64, height_mm: f64) -> Result<f64, ProjectionError> {
    let (dv, du) = image_angle_rad.sin_cos();
    // A centroid lies at or inside the centres of the outermost pixels.
    let end = |sign: f64| {
        let step = sign * HALF_STEP_PX;
        camera.world_from_image([pixel[0] + step * du, pixel[1] + step * dv], height_mm)
    };
    let (from, to) = (end(-1.0)?, end(1.0)?);
    Ok((to[0] - from[0]).hypot(to[1] - from[1]) / (2.0 * HALF_STEP_PX))
}

/// Angles nearer to -90 degrees are taken for 90: boxes of upright objects must not turn about by rounding.
const ROUNDING_DEG: f64 = 1e-4;

/// The angle of a line without direction, degrees in (-90, 90].
fn line_deg(angle_rad: f64) -> f64 {
    let turned = angle_rad.to_degrees().rem_euclid(180.0);
    // Adding 0 makes -0 a 0.
    (if turned > 90.0 + ROUNDING_DEG { turned - 180.0 } else { turned.min(90.0) }) + 0.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use samsod_camera::nalgebra::{Translation3, UnitQuaternion};
    use samsod_camera::{IntrinsicParams, Intrinsics};
    use std::f64::consts::PI;

    fn intrinsics() -> Intrinsics {
        Intrinsics::new(IntrinsicParams {
            width_px: 1078,
            height_px: 958,
            fx_px: 1600.0,
            fy_px: 1590.0,
            cx_px: 541.2,
            cy_px: 476.6,
            k1: -0.118,
            k2: 0.094,
            p1: 0.001,
            p2: -0.0007,
            k3: 0.0,
        })
        .unwrap()
    }

    /// 25 degrees off the vertical, turned by 12 degrees, with a lens; the robot stands elsewhere and is turned by 30.
    fn tilted() -> Camera {
        let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 12f64.to_radians())
            * UnitQuaternion::from_euler_angles(PI + 25f64.to_radians(), 0.0, 0.0);
        let world_from_camera = Isometry3::from_parts(Translation3::new(60.0, -380.0, 850.0), rotation);
        let base_from_world = Isometry3::from_parts(
            Translation3::new(400.0, -120.0, 15.0),
            UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 30f64.to_radians()),
        );
        Camera::new(intrinsics(), world_from_camera, Some(base_from_world)).unwrap()
    }

    /// What a camera sees of a small bar on the plane z: its middle and its two ends, projected.
    fn seen(camera: &Camera, [x, y, z]: [f64; 3], yaw_deg: f64, size_mm: [f64; 2]) -> ImagePlace {
        let (sin, cos) = yaw_deg.to_radians().sin_cos();
        let at = |along: f64, across: f64| {
            camera.image_from_world([x + along * cos - across * sin, y + along * sin + across * cos, z]).unwrap()
        };
        let between = |a: [f64; 2], b: [f64; 2]| [b[0] - a[0], b[1] - a[1]];
        let [half_length, half_width] = size_mm.map(|side| side / 2.0);
        let [du, dv] = between(at(-half_length, 0.0), at(half_length, 0.0));
        let [cu, cv] = between(at(0.0, -half_width), at(0.0, half_width));
        // On the screen, up is against the rows.
        ImagePlace { centroid_px: at(0.0, 0.0), size_px: [du.hypot(dv), cu.hypot(cv)], angle_rad: (-dv).atan2(du) }
    }

    fn angle_between_lines(a_deg: f64, b_deg: f64) -> f64 {
        line_deg((a_deg - b_deg).to_radians()).abs()
    }

    #[test]
    fn what_a_tilted_distorted_camera_sees_is_placed_where_it_lies() {
        let camera = tilted();
        for height_mm in [0.0, 18.0] {
            let placer = Placer::with_camera(camera, height_mm).unwrap();
            for (x, y) in [(0.0, 0.0), (-150.0, 90.0), (140.0, 160.0), (-90.0, -110.0), (180.0, -60.0)] {
                for yaw_deg in [-80.0, -35.0, 0.0, 20.0, 65.0, 90.0] {
                    let place = placer.place(&seen(&camera, [x, y, height_mm], yaw_deg, [24.0, 10.0])).unwrap();
                    let (world, base) = (place.world, place.base.unwrap());
                    let message = format!("({x}, {y}, {height_mm}) yaw {yaw_deg}: {place:?}");
                    assert!((world.x_mm - x).hypot(world.y_mm - y) < 1e-6, "{message}");
                    assert_eq!(world.z_mm, height_mm);
                    assert!(angle_between_lines(world.yaw_deg, yaw_deg) < 0.1, "{message}");
                    assert!(world.yaw_deg > -90.0 && world.yaw_deg <= 90.0, "{message}");
                    // Turned by 30 degrees about z, then moved.
                    let (sin, cos) = 30f64.to_radians().sin_cos();
                    let at = [400.0 + x * cos - y * sin, -120.0 + x * sin + y * cos];
                    assert!((base.x_mm - at[0]).hypot(base.y_mm - at[1]) < 1e-6, "{message}");
                    assert!((base.z_mm - height_mm - 15.0).abs() < 1e-9, "{message}");
                    assert!(angle_between_lines(base.yaw_deg, yaw_deg + 30.0) < 0.1, "{message}");
                    // The box of a bar that is not seen from above is no longer a rectangle; what is measured in its
                    // directions is.
                    assert!((place.size_mm[0] - 24.0).abs() < 0.1, "{message}");

                    let tool = placer.tool_above(&place, 300.0).unwrap();
                    assert!((tool.x_mm - at[0]).hypot(tool.y_mm - at[1]) < 1e-6 && (tool.z_mm - 315.0).abs() < 1e-9);
                    let expected = Pose::gripper_down(0.0, 0.0, 0.0, (yaw_deg + 30.0).to_radians());
                    let off = tool.angle_rad(&expected).to_degrees();
                    assert!(off.min(180.0 - off) < 0.1, "{message}: the tool is turned by {off}");
                }
            }
        }
    }

    #[test]
    fn counter_clockwise_on_the_screen_is_counter_clockwise_from_above_for_camera_and_view() {
        let view = ViewConfig { mm_per_px: 0.5625, origin_px: [541.2, 476.6] };
        let down = Isometry3::from_parts(
            Translation3::new(0.0, 0.0, 900.0),
            UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI),
        );
        let ideal =
            Intrinsics::new(IntrinsicParams { fy_px: 1600.0, ..*intrinsics().without_distortion().params() }).unwrap();
        let camera = Placer::with_camera(Camera::new(ideal, down, None).unwrap(), 0.0).unwrap();
        let view = Placer::with_view(view, 0.0);
        let object = ImagePlace { centroid_px: [700.0, 200.0], size_px: [80.0, 20.0], angle_rad: 0.5 };
        let (by_camera, by_view) = (camera.place(&object).unwrap(), view.place(&object).unwrap());
        for place in [by_camera, by_view] {
            assert!((place.world.x_mm - 158.8 * 0.5625).abs() < 1e-6, "{place:?}");
            assert!((place.world.y_mm - 276.6 * 0.5625).abs() < 1e-6, "{place:?}");
            assert!((place.world.yaw_deg.to_radians() - 0.5).abs() < 1e-6, "{place:?}");
            assert!((place.size_mm[0] - 45.0).abs() < 1e-6 && (place.size_mm[1] - 11.25).abs() < 1e-6, "{place:?}");
        }
        // The view is given in the frame of the robot; a camera without [base] knows no robot.
        assert_eq!((by_view.base, by_camera.base), (Some(by_view.world), None));
        assert!(view.knows_base() && !camera.knows_base());
        assert_eq!(camera.tool_above(&by_camera, 300.0), None);
        assert_eq!((camera.image_size_px(), view.image_size_px()), (Some([1078, 958]), None));
        let tool = view.tool_above(&by_view, 300.0).unwrap();
        assert_eq!((tool.x_mm, tool.y_mm, tool.z_mm), (by_view.world.x_mm, by_view.world.y_mm, 300.0));
        assert!(tool.angle_rad(&Pose::gripper_down(0.0, 0.0, 0.0, 0.5)) < 1e-6);
    }

    #[test]
    fn the_outermost_pixels_have_a_place_and_what_lies_beyond_has_none() {
        let placer = Placer::with_camera(tilted(), 0.0).unwrap();
        let at = |u, v| placer.place(&ImagePlace { centroid_px: [u, v], size_px: [1.0, 1.0], angle_rad: 0.8 });
        for (u, v) in [(0.0, 0.0), (1077.0, 0.0), (0.0, 957.0), (1077.0, 957.0)] {
            assert!(at(u, v).is_ok(), "{:?}", at(u, v));
        }
        assert!(matches!(at(1079.0, 3.0), Err(ProjectionError::OutsideImage { .. })));
        // A plane above the camera is not seen.
        assert!(matches!(Placer::with_camera(tilted(), 2000.0), Err(ProjectionError::NoIntersection { .. })));
    }

    #[test]
    fn a_line_has_no_direction() {
        for (angle, expected) in [
            (0.0, 0.0),
            (PI, 0.0),
            (-PI / 2.0, 90.0),
            (PI / 2.0, 90.0),
            (f64::from(std::f32::consts::FRAC_PI_2), 90.0),
            (3.0, 171.887_338_539_246_97 - 180.0),
            (-0.1, -5.729_577_951_308_232),
        ] {
            assert!((line_deg(angle) - expected).abs() < 1e-9, "{angle}: {}", line_deg(angle));
            assert!(line_deg(angle) <= 90.0);
        }
    }
}
