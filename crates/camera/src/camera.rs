//! A camera that knows where it hangs: image, table and robot.

use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

use crate::intrinsics::{IntrinsicParams, Intrinsics, IntrinsicsError};
use crate::projection::ProjectionError;

/// Least sine of the angle between a ray and a plane for the two to be said to meet.
const LEAST_SINE: f64 = 1e-6;
/// Half the length of the image line whose ends are mapped when an angle is, px.
const HALF_STEP_PX: f64 = 0.5;

/// A calibrated camera in its cell.
///
/// `a_from_b` maps coordinates of frame b to those of frame a. Frames: *image*, pixels (u right, v down, centres at
/// integers); *camera*, mm (x right, y down, z forward); *world*, mm (right-handed, the table is z = 0, z up); *base*,
/// mm, of the robot. Angles are radians; yaw turns about z, counter-clockwise seen from above.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    intrinsics: Intrinsics,
    world_from_camera: Isometry3<f64>,
    base_from_world: Option<Isometry3<f64>>,
}

impl Camera {
    /// A camera at a pose (translations in mm) and, where it is known, that of the table in the robot's base frame.
    ///
    /// # Errors
    /// [`ProjectionError::NotFinite`] for a pose with NaN or infinities.
    pub fn new(
        intrinsics: Intrinsics,
        world_from_camera: Isometry3<f64>,
        base_from_world: Option<Isometry3<f64>>,
    ) -> Result<Self, ProjectionError> {
        for (what, pose) in
            [("world_from_camera", Some(&world_from_camera)), ("base_from_world", base_from_world.as_ref())]
        {
            let Some(pose) = pose else { continue };
            let values: Vec<f64> = pose.translation.vector.iter().chain(pose.rotation.coords.iter()).copied().collect();
            if values.iter().any(|v| !v.is_finite()) {
                return Err(ProjectionError::NotFinite { what, values });
            }
        }
        Ok(Self { intrinsics, world_from_camera, base_from_world })
    }

    /// An ideal camera that looks straight down, image right along world x and image up along world y.
    ///
    /// On the table it is the affine view `x = (u - origin[0]) mm_per_px`, `y = (origin[1] - v) mm_per_px` at any
    /// `camera_height_mm`; what stands on the table is seen with the parallax of that height.
    ///
    /// # Arguments
    /// * `size_px` - width and height of the image
    /// * `mm_per_px` - size of a pixel on the table
    /// * `origin_px` - the pixel above the origin of the world; it may lie outside the image
    /// * `camera_height_mm` - height of the camera over the table
    ///
    /// # Errors
    /// Numbers that make no [`Intrinsics`]: the focal length is `camera_height_mm / mm_per_px`.
    pub fn overhead(
        size_px: [u32; 2],
        mm_per_px: f64,
        origin_px: [f64; 2],
        camera_height_mm: f64,
    ) -> Result<Self, IntrinsicsError> {
        let [width_px, height_px] = size_px;
        let focal_px = camera_height_mm / mm_per_px;
        let [cx_px, cy_px] = size_px.map(|side| (f64::from(side) - 1.0) / 2.0);
        let intrinsics = Intrinsics::new(IntrinsicParams {
            width_px,
            height_px,
            fx_px: focal_px,
            fy_px: focal_px,
            cx_px,
            cy_px,
            k1: 0.0,
            k2: 0.0,
            p1: 0.0,
            p2: 0.0,
            k3: 0.0,
        })?;
        let finite = |key, value: f64| {
            let error = IntrinsicsError::Value { key, value, allowed: "a finite number".to_owned() };
            if value.is_finite() { Ok(value) } else { Err(error) }
        };
        let at = Translation3::new(
            finite("origin_px[0]", (cx_px - origin_px[0]) * mm_per_px)?,
            finite("origin_px[1]", (origin_px[1] - cy_px) * mm_per_px)?,
            finite("camera_height_mm", camera_height_mm)?,
        );
        let looks_down = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
        Ok(Self { intrinsics, world_from_camera: Isometry3::from_parts(at, looks_down), base_from_world: None })
    }

    /// Focal lengths, principal point and lens.
    pub fn intrinsics(&self) -> &Intrinsics {
        &self.intrinsics
    }

    /// Pose of the camera over the table.
    pub fn world_from_camera(&self) -> &Isometry3<f64> {
        &self.world_from_camera
    }

    /// Pose of the world in the base frame of the robot, if it is known.
    pub fn base_from_world(&self) -> Option<&Isometry3<f64>> {
        self.base_from_world.as_ref()
    }

    /// The pixel at which a point of the world, mm, is seen; it may lie outside the image.
    ///
    /// # Errors
    /// [`ProjectionError`]: not finite, not in front of the camera, outside of the lens model.
    pub fn image_from_world(&self, point_mm: [f64; 3]) -> Result<[f64; 2], ProjectionError> {
        if point_mm.iter().any(|c| !c.is_finite()) {
            return Err(ProjectionError::NotFinite { what: "point", values: point_mm.to_vec() });
        }
        let in_camera = self.world_from_camera.inverse_transform_point(&Point3::from(point_mm));
        if in_camera.z <= 0.0 {
            return Err(ProjectionError::BehindCamera { point_mm });
        }
        self.intrinsics.image_from_ray([in_camera.x / in_camera.z, in_camera.y / in_camera.z])
    }

    /// The point of the plane z = `height_mm` that is seen at a pixel of the image, mm.
    ///
    /// Give the height at which the outline lies that was seen: on the table its shadow, on a part its upper edge.
    ///
    /// # Errors
    /// [`ProjectionError`]: not finite, outside the image, plane behind the camera or parallel to the ray.
    pub fn world_from_image(&self, pixel: [f64; 2], height_mm: f64) -> Result<[f64; 3], ProjectionError> {
        let [u, v] = pixel;
        if !(u.is_finite() && v.is_finite() && height_mm.is_finite()) {
            return Err(ProjectionError::NotFinite { what: "pixel and height", values: vec![u, v, height_mm] });
        }
        if !self.intrinsics.contains(pixel) {
            let [width_px, height_px] = self.intrinsics.size_px();
            return Err(ProjectionError::OutsideImage { u, v, width_px, height_px });
        }
        self.plane_from_image(pixel, height_mm)
    }

    /// [`Self::world_from_image`] for pixels that may lie a little outside the image.
    fn plane_from_image(&self, pixel: [f64; 2], height_mm: f64) -> Result<[f64; 3], ProjectionError> {
        let [x, y] = self.intrinsics.ray_from_image(pixel)?;
        let direction = self.world_from_camera.rotation * Vector3::new(x, y, 1.0);
        let origin = self.world_from_camera.translation.vector;
        let distance = (height_mm - origin.z) / direction.z;
        if direction.z.abs() < LEAST_SINE * direction.norm() || !distance.is_finite() || distance <= 0.0 {
            return Err(ProjectionError::NoIntersection { u: pixel[0], v: pixel[1], height_mm });
        }
        let point = origin + direction * distance;
        // The height as it was asked for, without rounding.
        Ok([point.x, point.y, height_mm])
    }

    /// [`Self::world_from_image`] in the base frame of the robot, mm.
    ///
    /// # Errors
    /// Those of [`Self::world_from_image`], and [`ProjectionError::NoBase`].
    pub fn base_from_image(&self, pixel: [f64; 2], height_mm: f64) -> Result<[f64; 3], ProjectionError> {
        let base_from_world = self.base_from_world.ok_or(ProjectionError::NoBase)?;
        let point = base_from_world * Point3::from(self.world_from_image(pixel, height_mm)?);
        Ok([point.x, point.y, point.z])
    }

    /// The yaw in the world, in (-pi, pi], of a line that runs through a pixel in the direction
    /// `image_angle_rad` = atan2(dv, du), on the plane z = `height_mm`.
    ///
    /// The two ends of a line one pixel long are mapped. Under a camera that looks straight down with image right
    /// along world x, this is minus the image angle: rows run downwards.
    ///
    /// # Errors
    /// Those of [`Self::world_from_image`].
    pub fn world_yaw_from_image_angle(
        &self,
        pixel: [f64; 2],
        image_angle_rad: f64,
        height_mm: f64,
    ) -> Result<f64, ProjectionError> {
        let direction = self.direction_from_image_angle(pixel, image_angle_rad, height_mm)?;
        Ok(direction.y.atan2(direction.x))
    }

    /// [`Self::world_yaw_from_image_angle`] about the z axis of the robot's base.
    ///
    /// # Errors
    /// Those of [`Self::world_from_image`], and [`ProjectionError::NoBase`].
    pub fn base_yaw_from_image_angle(
        &self,
        pixel: [f64; 2],
        image_angle_rad: f64,
        height_mm: f64,
    ) -> Result<f64, ProjectionError> {
        let base_from_world = self.base_from_world.ok_or(ProjectionError::NoBase)?;
        let direction =
            base_from_world.rotation * self.direction_from_image_angle(pixel, image_angle_rad, height_mm)?;
        Ok(direction.y.atan2(direction.x))
    }

    fn direction_from_image_angle(
        &self,
        pixel: [f64; 2],
        image_angle_rad: f64,
        height_mm: f64,
    ) -> Result<Vector3<f64>, ProjectionError> {
        if !image_angle_rad.is_finite() {
            return Err(ProjectionError::NotFinite { what: "image angle", values: vec![image_angle_rad] });
        }
        self.world_from_image(pixel, height_mm)?;
        let (dv, du) = image_angle_rad.sin_cos();
        let end = |sign: f64| {
            let step = sign * HALF_STEP_PX;
            self.plane_from_image([pixel[0] + step * du, pixel[1] + step * dv], height_mm)
        };
        let (from, to) = (end(-1.0)?, end(1.0)?);
        Ok(Vector3::new(to[0] - from[0], to[1] - from[1], 0.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::intrinsics::tests::PARAMS;
    use proptest::prelude::*;
    use std::f64::consts::{FRAC_PI_2, PI};

    fn looking_down(x: f64, y: f64, z: f64, tilt: [f64; 2], roll: f64) -> Isometry3<f64> {
        let rotation = UnitQuaternion::from_euler_angles(PI + tilt[0], tilt[1], roll);
        Isometry3::from_parts(Translation3::new(x, y, z), rotation)
    }

    fn nominal() -> Camera {
        Camera::new(Intrinsics::new(PARAMS).unwrap(), looking_down(0.0, 0.0, 900.0, [0.0; 2], 0.0), None).unwrap()
    }

    #[test]
    fn the_pixel_under_the_camera_is_under_the_camera_and_parallax_moves_what_stands_higher() {
        let camera = nominal();
        let [x, y, z] = camera.world_from_image([541.2, 476.6], 30.0).unwrap();
        assert!(x.abs() < 1e-9 && y.abs() < 1e-9 && z == 30.0, "{x} {y} {z}");
        // Image right is world x, image up world y.
        let [x, y, _] = camera.world_from_image([641.2, 376.6], 0.0).unwrap();
        assert!((x - 900.0 / 16.0).abs() < 0.2 && (y - 900.0 / 15.9).abs() < 0.2, "{x} {y}");
        let [higher, ..] = camera.world_from_image([641.2, 376.6], 90.0).unwrap();
        assert!((higher - 0.9 * x).abs() < 1e-9, "{higher} {x}");
    }

    #[test]
    fn the_overhead_camera_is_the_affine_view_on_the_table() {
        let camera = Camera::overhead([1078, 958], 0.4, [-625.0, 479.0], 1e6).unwrap();
        for [u, v] in [[0.0, 0.0], [1077.0, 957.0], [530.25, 12.5]] {
            let [x, y, _] = camera.world_from_image([u, v], 0.0).unwrap();
            assert!((x - (u + 625.0) * 0.4).abs() < 1e-8 && (y - (479.0 - v) * 0.4).abs() < 1e-8, "{x} {y}");
            // From a kilometre, a part of 30 mm is seen without parallax to 0.03 mm.
            let [high, ..] = camera.world_from_image([u, v], 30.0).unwrap();
            assert!((high - x).abs() < 0.03);
        }
        for (mm_per_px, origin, height) in
            [(0.0, 0.0, 1e6), (f64::NAN, 0.0, 1e6), (0.4, f64::NAN, 1e6), (0.4, 0.0, -1.0)]
        {
            assert!(Camera::overhead([1078, 958], mm_per_px, [origin, 0.0], height).is_err());
        }
    }

    #[test]
    fn what_cannot_be_seen_is_an_error_that_says_why() {
        let camera = nominal();
        let message = |result: Result<[f64; 3], ProjectionError>| result.unwrap_err().to_string();
        assert_eq!(
            message(camera.world_from_image([1078.0, 3.0], 0.0)),
            "pixel (1078, 3) lies outside the image of 1078 x 958 px"
        );
        assert!(message(camera.world_from_image([f64::NAN, 3.0], 0.0)).contains("not finite"));
        assert!(message(camera.world_from_image([5.0, 3.0], f64::INFINITY)).contains("not finite"));
        assert_eq!(
            message(camera.world_from_image([5.0, 3.0], 1000.0)),
            "the plane z = 1000 mm is parallel to the ray of pixel (5, 3) or behind the camera"
        );
        assert!(message(camera.world_from_image([5.0, 3.0], 900.0)).contains("z = 900 mm"));
        assert!(message(camera.base_from_image([5.0, 3.0], 0.0)).contains("samsod calibrate touch"));
        assert_eq!(
            camera.image_from_world([1.0, 2.0, 950.0]).unwrap_err().to_string(),
            "point (1, 2, 950) mm does not lie in front of the camera"
        );
        assert!(camera.image_from_world([1.0, f64::NAN, 0.0]).is_err());
        assert!(matches!(camera.image_from_world([9e5, 0.0, 0.0]), Err(ProjectionError::OutsideLens { .. })));

        // A camera that looks along the table: the horizon has no point.
        let level = Isometry3::from_parts(
            Translation3::new(0.0, 0.0, 100.0),
            UnitQuaternion::from_euler_angles(-FRAC_PI_2, 0.0, 0.0),
        );
        let camera = Camera::new(camera.intrinsics().without_distortion(), level, None).unwrap();
        assert!(matches!(camera.world_from_image([5.0, 476.6], 0.0), Err(ProjectionError::NoIntersection { .. })));
        assert!(matches!(camera.world_from_image([5.0, 300.0], 0.0), Err(ProjectionError::NoIntersection { .. })));
        assert!(camera.world_from_image([5.0, 600.0], 0.0).is_ok());

        let nowhere = Isometry3::translation(f64::NAN, 0.0, 0.0);
        assert!(
            Camera::new(*camera.intrinsics(), level, Some(nowhere))
                .unwrap_err()
                .to_string()
                .contains("base_from_world")
        );
    }

    #[test]
    fn an_image_angle_is_turned_into_yaw_in_the_world_and_at_the_robot() {
        let turned = Isometry3::new(Vector3::new(400.0, 0.0, 0.0), Vector3::new(0.0, 0.0, FRAC_PI_2));
        let camera = Camera { base_from_world: Some(turned), ..nominal() };
        let yaw = camera.world_yaw_from_image_angle([541.2, 476.6], -0.5, 0.0).unwrap();
        // fx and fy differ by 0.6 %, which turns a line of 30 degrees by 0.15.
        assert!((yaw - 0.5).abs() < 0.004, "{yaw}");
        let at_robot = camera.base_yaw_from_image_angle([541.2, 476.6], -0.5, 0.0).unwrap();
        assert!((at_robot - yaw - FRAC_PI_2).abs() < 1e-12, "{at_robot}");
        // The corner of the image is a pixel too.
        assert!(camera.world_yaw_from_image_angle([-0.5, -0.5], 2.0, 0.0).is_ok());
        assert!(camera.world_yaw_from_image_angle([-1.5, -0.5], 2.0, 0.0).is_err());
        assert!(camera.world_yaw_from_image_angle([5.0, 5.0], f64::NAN, 0.0).is_err());
        let [x, y, z] = camera.base_from_image([541.2, 476.6], 10.0).unwrap();
        assert!((x - 400.0).abs() < 1e-9 && y.abs() < 1e-9 && (z - 10.0).abs() < 1e-9, "{x} {y} {z}");
    }

    proptest! {
        #[test]
        fn a_point_on_a_plane_comes_back_from_its_pixel_and_a_yaw_from_its_image(
            u in 0.0f64..1077.0, v in 0.0f64..957.0, height in -50.0f64..200.0, yaw in -3.1f64..3.1,
            tilt_x in -0.6f64..0.6, tilt_y in -0.6f64..0.6, roll in -3.0f64..3.0,
        ) {
            let pose = looking_down(30.0, -20.0, 900.0, [tilt_x, tilt_y], roll);
            let camera = Camera::new(Intrinsics::new(PARAMS).unwrap(), pose, None).unwrap();
            let point = camera.world_from_image([u, v], height).unwrap();
            let pixel = camera.image_from_world(point).unwrap();
            prop_assert!((pixel[0] - u).hypot(pixel[1] - v) < 1e-7, "{u} {v} {pixel:?}");
            let ahead = [point[0] + 1e-3 * yaw.cos(), point[1] + 1e-3 * yaw.sin(), height];
            let ahead = camera.image_from_world(ahead).unwrap();
            let angle = (ahead[1] - pixel[1]).atan2(ahead[0] - pixel[0]);
            let found = camera.world_yaw_from_image_angle([u, v], angle, height).unwrap();
            let difference = (found - yaw + PI).rem_euclid(2.0 * PI) - PI;
            prop_assert!(difference.abs() < 1e-4, "{yaw} {found}");
        }
    }
}
