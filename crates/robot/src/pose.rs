//! A pose of the tool in the base frame of the robot.

use glam::{DQuat, DVec3, EulerRot};
use serde::{Deserialize, Serialize};

/// `base_from_tool`: position of the tool centre point in the base frame, and the rotation of the tool.
///
/// The rotation is R = Rz(rz) Ry(ry) Rx(rx): roll, pitch and yaw about the fixed axes of the base, as Yaskawa and
/// FANUC controllers count them. A gripper that points straight down has `rx_rad` = pi. Written out, angles are in
/// degrees:
///
/// ```
/// let pose = samsod_robot::Pose::gripper_down(400.0, 0.0, 250.0, std::f64::consts::FRAC_PI_2);
/// assert_eq!(
///     serde_json::to_string(&pose)?,
///     r#"{"x_mm":400.0,"y_mm":0.0,"z_mm":250.0,"rx_deg":180.0,"ry_deg":0.0,"rz_deg":90.0}"#
/// );
/// # Ok::<(), serde_json::Error>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Pose {
    /// Position along the base's x axis, mm.
    pub x_mm: f64,
    /// Position along the base's y axis, mm.
    pub y_mm: f64,
    /// Position along the base's z axis (up), mm.
    pub z_mm: f64,
    /// Rotation about the base's x axis, rad.
    #[serde(rename = "rx_deg", with = "crate::degrees")]
    #[cfg_attr(feature = "schema", schemars(with = "f64"))]
    pub rx_rad: f64,
    /// Rotation about the base's y axis, rad.
    #[serde(rename = "ry_deg", with = "crate::degrees")]
    #[cfg_attr(feature = "schema", schemars(with = "f64"))]
    pub ry_rad: f64,
    /// Rotation about the base's z axis (yaw, counter-clockwise seen from above), rad.
    #[serde(rename = "rz_deg", with = "crate::degrees")]
    #[cfg_attr(feature = "schema", schemars(with = "f64"))]
    pub rz_rad: f64,
}

/// Why numbers are no pose.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PoseError {
    /// A value is NaN or infinite.
    #[error("{field} of a pose is {value}; it must be a finite number")]
    NotFinite {
        /// The field.
        field: &'static str,
        /// Its value.
        value: f64,
    },
}

impl Pose {
    /// A pose whose gripper points straight down, turned by `yaw_rad` counter-clockwise seen from above.
    pub fn gripper_down(x_mm: f64, y_mm: f64, z_mm: f64, yaw_rad: f64) -> Self {
        Self { x_mm, y_mm, z_mm, rx_rad: std::f64::consts::PI, ry_rad: 0.0, rz_rad: yaw_rad }
    }

    /// Checks that every value is a finite number.
    ///
    /// # Errors
    /// [`PoseError::NotFinite`] names the first field that is not.
    pub fn check(&self) -> Result<(), PoseError> {
        let fields = [
            ("x_mm", self.x_mm),
            ("y_mm", self.y_mm),
            ("z_mm", self.z_mm),
            ("rx_rad", self.rx_rad),
            ("ry_rad", self.ry_rad),
            ("rz_rad", self.rz_rad),
        ];
        match fields.into_iter().find(|(_, value)| !value.is_finite()) {
            Some((field, value)) => Err(PoseError::NotFinite { field, value }),
            None => Ok(()),
        }
    }

    /// Straight distance between the two tool centre points, mm.
    pub fn distance_mm(&self, other: &Self) -> f64 {
        self.position().distance(other.position())
    }

    /// Angle of the one rotation that takes this orientation to the other, rad in [0, pi].
    pub fn angle_rad(&self, other: &Self) -> f64 {
        self.rotation().angle_between(other.rotation())
    }

    /// The rotation as a unit quaternion (x, y, z, w).
    pub fn quaternion_xyzw(&self) -> [f64; 4] {
        self.rotation().to_array()
    }

    pub(crate) fn position(&self) -> DVec3 {
        DVec3::new(self.x_mm, self.y_mm, self.z_mm)
    }

    pub(crate) fn rotation(&self) -> DQuat {
        DQuat::from_euler(EulerRot::ZYX, self.rz_rad, self.ry_rad, self.rx_rad)
    }

    pub(crate) fn from_parts(position: DVec3, rotation: DQuat) -> Self {
        let (rz_rad, ry_rad, rx_rad) = rotation.to_euler(EulerRot::ZYX);
        Self { x_mm: position.x, y_mm: position.y, z_mm: position.z, rx_rad, ry_rad, rz_rad }
    }
}

impl std::fmt::Display for Pose {
    /// Millimetres and degrees: this is for people.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "({:.1}, {:.1}, {:.1}) mm, ({:.1}, {:.1}, {:.1}) deg",
            self.x_mm,
            self.y_mm,
            self.z_mm,
            self.rx_rad.to_degrees(),
            self.ry_rad.to_degrees(),
            self.rz_rad.to_degrees()
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::{FRAC_PI_2, PI};

    #[test]
    fn rotation_is_yaw_after_pitch_after_roll_about_fixed_axes() {
        let pose = Pose { x_mm: 0.0, y_mm: 0.0, z_mm: 0.0, rx_rad: 0.3, ry_rad: -0.7, rz_rad: 1.9 };
        let product = DQuat::from_rotation_z(1.9)
            * DQuat::from_rotation_y(-0.7)
            * DQuat::from_rotation_x(0.3)
            * DVec3::new(1., 2., 3.);
        assert!((pose.rotation() * DVec3::new(1., 2., 3.)).distance(product) < 1e-12);
    }

    #[test]
    fn a_gripper_that_points_down_has_its_z_axis_down_and_yaws_counter_clockwise() {
        let pose = Pose::gripper_down(1.0, 2.0, 3.0, FRAC_PI_2);
        assert!((pose.rotation() * DVec3::Z).distance(-DVec3::Z) < 1e-12);
        assert!((pose.rotation() * DVec3::X).distance(DVec3::Y) < 1e-12);
        assert!((pose.angle_rad(&Pose::gripper_down(9.0, 9.0, 9.0, -FRAC_PI_2)) - PI).abs() < 1e-9);
    }

    #[test]
    fn a_value_that_is_no_number_is_named() {
        let mut pose = Pose::gripper_down(1.0, 2.0, 3.0, 0.0);
        pose.y_mm = f64::NAN;
        assert_eq!(pose.check().unwrap_err().to_string(), "y_mm of a pose is NaN; it must be a finite number");
    }
}
