//! The shape of a parallel gripper with two fingers, as it matters above a table.
//!
//! The tool centre point lies between the finger tips. The fingers move along the tool's y axis and are as wide as said along
//! its x axis; the gripper closes across, as docs/catalogue.md defines the grasp angle.

use serde::{Deserialize, Serialize};

use crate::{Convex, Pose};

/// A parallel gripper with two fingers.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct GripperShape {
    /// Distance of the open fingers, mm.
    pub opening_mm: f64,
    /// Thickness of a finger in the direction in which it moves, mm.
    pub finger_thickness_mm: f64,
    /// Width of a finger across that direction, mm.
    pub finger_width_mm: f64,
    /// Height above the finger tips to which a finger may be taken for alone; higher things meet the body, mm.
    pub finger_length_mm: f64,
    /// Sides of the body above the fingers, along the tool's x and y axis, mm.
    pub body_mm: [f64; 2],
}

impl Default for GripperShape {
    /// A small pneumatic gripper.
    fn default() -> Self {
        Self {
            opening_mm: 80.0,
            finger_thickness_mm: 6.0,
            finger_width_mm: 12.0,
            finger_length_mm: 60.0,
            body_mm: [60.0, 110.0],
        }
    }
}

impl GripperShape {
    /// Checks that every length is one.
    ///
    /// # Errors
    /// Key, value, and what is allowed.
    pub fn check(&self) -> Result<(), (&'static str, f64, &'static str)> {
        let lengths = [
            ("opening_mm", self.opening_mm),
            ("finger_thickness_mm", self.finger_thickness_mm),
            ("finger_width_mm", self.finger_width_mm),
            ("finger_length_mm", self.finger_length_mm),
            ("body_mm", self.body_mm[0]),
            ("body_mm", self.body_mm[1]),
        ];
        match lengths.into_iter().find(|(_, value)| !(*value > 0.0 && *value <= 1000.0)) {
            Some((key, value)) => Err((key, value, "above 0, at most 1000")),
            None => Ok(()),
        }
    }

    /// Where the two fingers stand on the plane of the table with the tool at a pose and this distance between them.
    pub fn fingers(&self, tool: &Pose, distance_mm: f64) -> [Convex; 2] {
        let yaw = yaw_rad(tool);
        let (sin, cos) = yaw.sin_cos();
        let off = (distance_mm + self.finger_thickness_mm) / 2.0;
        [1.0, -1.0].map(|side| {
            let centre = [tool.x_mm - sin * off * side, tool.y_mm + cos * off * side];
            Convex::rectangle(centre, [self.finger_width_mm, self.finger_thickness_mm], yaw)
        })
    }

    /// Where the body stands above them.
    pub fn body(&self, tool: &Pose) -> Convex {
        Convex::rectangle([tool.x_mm, tool.y_mm], self.body_mm, yaw_rad(tool))
    }
}

/// Direction of the tool's x axis in the plane of the table, rad.
pub(crate) fn yaw_rad(tool: &Pose) -> f64 {
    let x = tool.rotation() * glam::DVec3::X;
    x.y.atan2(x.x)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fingers_stand_across_the_x_axis_of_the_tool() {
        let gripper = GripperShape { finger_thickness_mm: 5.0, finger_width_mm: 10.0, ..GripperShape::default() };
        let [left, right] = gripper.fingers(&Pose::gripper_down(100.0, 50.0, 0.0, 0.0), 30.0);
        let range = |finger: &Convex, angle| finger.extent_mm(angle).unwrap().map(|v| (v * 1e6).round() / 1e6);
        let y = std::f64::consts::FRAC_PI_2;
        assert_eq!((range(&left, 0.0), range(&left, y)), ([95.0, 105.0], [65.0, 70.0]));
        assert_eq!((range(&right, 0.0), range(&right, y)), ([95.0, 105.0], [30.0, 35.0]));
    }
}
