//! Kinematics of the arm: which joint angles put the tool at a pose, and whether the way there can be gone.
//!
//! Input: poses `base_from_tool` in millimetres and radians. Output: [`Joints`], or the reason why there are none. The
//! closed solution for arms with a spherical wrist comes from `rs-opw-kinematics`; limits, the choice among the up to eight
//! solutions and the paths are made here.
//!
//! The joints are named as Yaskawa names them: S turns the base, L leans the lower arm forward, U raises the upper arm, R, B
//! and T are the wrist. With all at zero the lower arm stands up and the upper arm and the tool point forward.

use std::f64::consts::{FRAC_PI_2, TAU};
use std::time::Duration;

use glam::DVec3;
use rs_opw_kinematics::kinematic_traits::Kinematics;
use rs_opw_kinematics::kinematics_impl::OPWKinematics;
use rs_opw_kinematics::parameters::opw_kinematics::Parameters;
use rs_opw_kinematics::pose::Pose as OpwPose;

use crate::{MotionError, Pose};

/// Angles of the joints S, L, U, R, B, T, rad.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Joints(pub [f64; 6]);

/// One joint of an arm.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Joint {
    name: &'static str,
    /// Least and greatest angle, rad.
    range_rad: [f64; 2],
    /// Greatest speed, rad/s.
    speed_rad_s: f64,
}

/// Distance between the points of a line at which the arm is looked at, mm.
const LINE_STEP_MM: f64 = 4.0;
/// The same for a turn, rad.
const LINE_STEP_RAD: f64 = 0.05;
/// A line that a joint slows down by more than this passes a singularity: the arm cannot follow it.
const MOST_STRETCH: f64 = 8.0;
/// Greatest speed at which the tool turns on a line, rad/s: that of the slowest joint of the wrist.
const TURN_SPEED_RAD_S: f64 = 3.48;

/// An arm with its limits and a tool.
///
/// ```
/// use samsod_robot::{ArmModel, Joints, Pose};
/// let arm = ArmModel::mh5(100.0);
/// let above = Pose::gripper_down(450.0, 120.0, 250.0, 0.5);
/// let joints = arm.joints_at(&above, &Joints([0.0; 6]))?;
/// assert!(arm.tool_at(&joints).distance_mm(&above) < 1e-6);
/// assert!(arm.joints_at(&Pose::gripper_down(900.0, 0.0, 250.0, 0.0), &joints).is_err());
/// # Ok::<(), samsod_robot::MotionError>(())
/// ```
#[derive(Debug, Clone, Copy)]
pub struct ArmModel {
    kinematics: OPWKinematics,
    parameters: Parameters,
    joints: [Joint; 6],
}

impl ArmModel {
    /// A Yaskawa Motoman MH5 with the tool centre point `tool_length_mm` straight out of its flange. The base frame lies
    /// at the foot of the arm.
    ///
    /// Dimensions, limits and speeds are those of the public ROS-Industrial description of the arm.
    pub fn mh5(tool_length_mm: f64) -> Self {
        let parameters = Parameters {
            a1: 88.0,
            a2: -40.0,
            b: 0.0,
            c1: 330.0,
            c2: 310.0,
            c3: 305.0,
            c4: 86.5 + tool_length_mm,
            offsets: [0.0, 0.0, -FRAC_PI_2, 0.0, 0.0, 0.0],
            // U raises the upper arm where the model counts downwards; R, B and T turn the other way round, too.
            sign_corrections: [1, 1, -1, -1, -1, -1],
            dof: 6,
        };
        let joint = |name, [least, most]: [f64; 2], speed_rad_s| Joint {
            name,
            range_rad: [least.to_radians(), most.to_radians()],
            speed_rad_s,
        };
        let joints = [
            joint("joint S", [-170.0, 170.0], 2.96),
            joint("joint L", [-65.0, 150.0], 2.96),
            joint("joint U", [-58.0, 184.6], 2.96),
            joint("joint R", [-190.0, 190.0], 3.48),
            joint("joint B", [-125.0, 125.0], 3.48),
            joint("joint T", [-360.0, 360.0], 6.97),
        ];
        Self { kinematics: OPWKinematics::new(parameters), parameters, joints }
    }

    /// Where the tool is with the joints at these angles.
    pub fn tool_at(&self, joints: &Joints) -> Pose {
        let pose = self.kinematics.forward(&joints.0);
        Pose::from_parts(pose.translation, pose.rotation)
    }

    /// The angles that put the tool at a pose: of all that the limits allow, those that are reached soonest from `near`.
    ///
    /// # Errors
    /// [`MotionError::Target`] for a pose of numbers that are none, [`MotionError::OutOfReach`] with what is too far.
    pub fn joints_at(&self, target: &Pose, near: &Joints) -> Result<Joints, MotionError> {
        target.check()?;
        let pose = OpwPose::from_parts(target.position(), target.rotation());
        let solutions = self.kinematics.inverse_continuing(&pose, &near.0);
        let mut best: Option<(f64, Joints)> = None;
        // What is told if every solution bends a joint too far: the one that does so least.
        let mut least_beyond: Option<(f64, usize, f64)> = None;
        for solution in solutions {
            let mut joints = [0.0; 6];
            let mut beyond: Option<(f64, usize, f64)> = None;
            for (i, joint) in self.joints.iter().enumerate() {
                match nearest_turn(solution[i], near.0[i], joint.range_rad) {
                    Some(angle) => joints[i] = angle,
                    None => {
                        let [least, most] = joint.range_rad;
                        let by = (least - solution[i]).max(solution[i] - most);
                        if beyond.is_none_or(|(worst, ..)| by > worst) {
                            beyond = Some((by, i, solution[i]));
                        }
                    }
                }
            }
            match beyond {
                Some(beyond) => {
                    if least_beyond.is_none_or(|(least, ..)| beyond.0 < least) {
                        least_beyond = Some(beyond);
                    }
                }
                None => {
                    let joints = Joints(joints);
                    let seconds = self.least_seconds(near, &joints);
                    if best.is_none_or(|(soonest, _)| seconds < soonest) {
                        best = Some((seconds, joints));
                    }
                }
            }
        }
        match (best, least_beyond) {
            (Some((_, joints)), _) => Ok(joints),
            (None, Some((_, i, angle))) => {
                let [least, most] = self.joints[i].range_rad.map(f64::to_degrees);
                let (quantity, value) = (self.joints[i].name, angle.to_degrees());
                Err(MotionError::OutOfReach { target: *target, quantity, value, least, most, unit: "deg" })
            }
            (None, None) => Err(self.too_far(target)),
        }
    }

    /// Why there is no solution at all: the wrist would lie beyond both arms, or inside them.
    fn too_far(&self, target: &Pose) -> MotionError {
        let p = &self.parameters;
        let wrist = target.position() - target.rotation() * DVec3::Z * p.c4;
        let value = (wrist.x.hypot(wrist.y) - p.a1).hypot(wrist.z - p.c1);
        let upper = p.a2.hypot(p.c3);
        MotionError::OutOfReach {
            target: *target,
            quantity: "the distance of the wrist from joint L",
            value,
            least: (p.c2 - upper).abs(),
            most: p.c2 + upper,
            unit: "mm",
        }
    }

    /// Time between two positions with every joint at its greatest speed, s.
    fn least_seconds(&self, from: &Joints, to: &Joints) -> f64 {
        let times =
            self.joints.iter().zip(from.0.iter().zip(to.0)).map(|(joint, (a, b))| (b - a).abs() / joint.speed_rad_s);
        times.fold(0.0, f64::max)
    }

    /// Plans a joint motion (MOVJ): every joint from its angle to the target's, all arriving together.
    ///
    /// `speed_fraction` is the share of the greatest joint speed, in (0, 1].
    ///
    /// # Errors
    /// [`MotionError::Speed`], or as [`joints_at`](Self::joints_at).
    pub fn plan_joint(&self, from: &Joints, target: &Pose, speed_fraction: f64) -> Result<ArmPath, MotionError> {
        check_speed(speed_fraction, 1.0, "of the greatest speed")?;
        let to = self.joints_at(target, from)?;
        Ok(self.turn(from, &to, *target, speed_fraction))
    }

    /// Plans a joint motion to angles rather than to a pose (PMOVJ).
    ///
    /// # Errors
    /// [`MotionError::Speed`]; [`MotionError::OutOfReach`] with the first joint that would have to turn too far.
    pub fn plan_turn(&self, from: &Joints, to: &Joints, speed_fraction: f64) -> Result<ArmPath, MotionError> {
        check_speed(speed_fraction, 1.0, "of the greatest speed")?;
        let target = self.tool_at(to);
        for (joint, angle) in self.joints.iter().zip(to.0) {
            let ([least, most], value) = (joint.range_rad.map(f64::to_degrees), angle.to_degrees());
            // Written so that NaN is refused.
            if !(least..=most).contains(&value) {
                let quantity = joint.name;
                return Err(MotionError::OutOfReach { target, quantity, value, least, most, unit: "deg" });
            }
        }
        Ok(self.turn(from, to, target, speed_fraction))
    }

    fn turn(&self, from: &Joints, to: &Joints, target: Pose, speed_fraction: f64) -> ArmPath {
        let seconds = self.least_seconds(from, to) / speed_fraction;
        ArmPath { lasts: duration(seconds), ends: [self.tool_at(from), target], joints: vec![*from, *to], line: false }
    }

    /// Plans a linear motion (MOVL): the tool along the straight line, its rotation along the shortest way.
    ///
    /// The tool goes at `speed_mm_s`, slower where a joint could not follow.
    ///
    /// # Errors
    /// [`MotionError::Speed`]; as [`joints_at`](Self::joints_at) for the worst point on the way; [`MotionError::Singular`] where a
    /// joint would have to turn much faster than it can, or to leap.
    pub fn plan_line(
        &self,
        from: &Joints,
        target: &Pose,
        speed_mm_s: f64,
        speed_max_mm_s: f64,
    ) -> Result<ArmPath, MotionError> {
        check_speed(speed_mm_s, speed_max_mm_s, "mm/s")?;
        target.check()?;
        let start = self.tool_at(from);
        let (distance, angle) = (start.distance_mm(target), start.angle_rad(target));
        let steps = (distance / LINE_STEP_MM).max(angle / LINE_STEP_RAD).ceil().max(1.0);
        // No arm is that long; the target is out of reach and says so itself.
        if steps > 1e5 {
            return Err(self.too_far(target));
        }
        let seconds = (distance / speed_mm_s).max(angle / TURN_SPEED_RAD_S);
        let step_seconds = seconds / steps;
        let mut joints = vec![*from];
        let (mut last, mut stretch) = (*from, 1.0f64);
        for i in 1..=steps as usize {
            let pose = if i == steps as usize { *target } else { between(&start, target, i as f64 / steps) };
            let next = self.joints_at(&pose, &last)?;
            for (joint, (a, b)) in self.joints.iter().zip(last.0.iter().zip(next.0)) {
                let turn = (b - a).abs();
                let needed = turn / joint.speed_rad_s / step_seconds.max(1e-9);
                // A tool that stands still while a joint turns by more than rounding is at a singularity, too.
                if turn > 1e-6 && needed > MOST_STRETCH {
                    return Err(MotionError::Singular {
                        target: *target,
                        at_mm: [pose.x_mm, pose.y_mm, pose.z_mm],
                        joint: joint.name,
                        needed_deg_s: (turn / step_seconds.max(1e-9)).to_degrees(),
                        most_deg_s: joint.speed_rad_s.to_degrees(),
                    });
                }
                stretch = stretch.max(needed);
            }
            joints.push(next);
            last = next;
        }
        Ok(ArmPath { lasts: duration(seconds * stretch), ends: [start, *target], joints, line: true })
    }
}

/// A motion that has been planned: where tool and joints are at any time of it.
#[derive(Debug, Clone)]
pub struct ArmPath {
    lasts: Duration,
    ends: [Pose; 2],
    /// At equal steps of time from start to end.
    joints: Vec<Joints>,
    line: bool,
}

impl ArmPath {
    /// Time from start to end.
    pub fn lasts(&self) -> Duration {
        self.lasts
    }

    /// Where the motion ends, `base_from_tool`.
    pub fn target(&self) -> &Pose {
        &self.ends[1]
    }

    /// The joints when `share` of the time, in [0, 1], has passed.
    pub fn joints(&self, share: f64) -> Joints {
        let last = self.joints.len().saturating_sub(1);
        let at = share.clamp(0.0, 1.0) * last as f64;
        let i = (at as usize).min(last);
        let (a, b) = (self.joints[i], self.joints[(i + 1).min(last)]);
        let part = at - i as f64;
        Joints(std::array::from_fn(|k| a.0[k] + (b.0[k] - a.0[k]) * part))
    }

    /// The tool when `share` of the time, in [0, 1], has passed: on a line exactly on it, at the end exactly the target.
    pub fn tool(&self, arm: &ArmModel, share: f64) -> Pose {
        let [from, to] = &self.ends;
        if share >= 1.0 {
            *to
        } else if self.line {
            between(from, to, share.max(0.0))
        } else {
            arm.tool_at(&self.joints(share))
        }
    }
}

/// On the straight line, and on the shortest rotation.
pub(crate) fn between(from: &Pose, to: &Pose, share: f64) -> Pose {
    Pose::from_parts(from.position().lerp(to.position(), share), from.rotation().slerp(to.rotation(), share))
}

fn check_speed(value: f64, at_most: f64, unit: &'static str) -> Result<(), MotionError> {
    // Written so that NaN is refused.
    if value > 0.0 && value <= at_most { Ok(()) } else { Err(MotionError::Speed { value, above: 0.0, at_most, unit }) }
}

fn duration(seconds: f64) -> Duration {
    Duration::try_from_secs_f64(seconds).unwrap_or(Duration::MAX)
}

/// The angle plus or minus whole turns that lies in the range and nearest to `near`.
fn nearest_turn(angle: f64, near: f64, [least, most]: [f64; 2]) -> Option<f64> {
    // Rounding of a pose that was reached at a limit.
    const SLACK_RAD: f64 = 1e-9;
    let turns = [-2.0, -1.0, 0.0, 1.0, 2.0].map(|n| angle + n * TAU);
    let allowed = turns.into_iter().filter(|a| (least - SLACK_RAD..=most + SLACK_RAD).contains(a));
    allowed.min_by(|a, b| (a - near).abs().total_cmp(&(b - near).abs()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::f64::consts::PI;

    const REST: Joints = Joints([0.0; 6]);

    #[test]
    fn with_all_joints_at_zero_the_arm_is_as_long_as_the_data_sheet_says() {
        let tool = ArmModel::mh5(0.0).tool_at(&REST);
        // 88 forward to L, 305 and 86.5 along the upper arm; 330 up to L, 310 up to U, 40 up to the axis of the upper arm.
        assert!(tool.position().distance(DVec3::new(88.0 + 305.0 + 86.5, 0.0, 330.0 + 310.0 + 40.0)) < 1e-9, "{tool}");
        assert!((tool.rotation() * DVec3::Z).distance(DVec3::X) < 1e-9, "the tool points forward");
        let longer = ArmModel::mh5(120.0).tool_at(&REST);
        assert!((longer.x_mm - tool.x_mm - 120.0).abs() < 1e-9);
    }

    #[test]
    fn joints_turn_the_way_of_the_pendant() {
        let arm = ArmModel::mh5(0.0);
        let moved = |i: usize| {
            let mut joints = REST;
            joints.0[i] = 0.1;
            arm.tool_at(&joints)
        };
        let rest = arm.tool_at(&REST);
        assert!(moved(0).y_mm > 1.0, "S+ turns counter-clockwise");
        assert!(moved(1).x_mm > rest.x_mm + 1.0 && moved(1).z_mm < rest.z_mm - 1.0, "L+ leans forward");
        assert!(moved(2).z_mm > rest.z_mm + 1.0, "U+ raises the upper arm");
        assert!(moved(4).z_mm > rest.z_mm + 1.0, "B+ raises the flange");
    }

    #[test]
    fn what_cannot_be_reached_says_by_what() {
        let arm = ArmModel::mh5(100.0);
        let far = arm.joints_at(&Pose::gripper_down(900.0, 0.0, 100.0, 0.0), &REST).unwrap_err().to_string();
        assert!(far.contains("the distance of the wrist from joint L is 81") && far.contains("617.6 mm"), "{far}");
        let behind = arm.joints_at(&Pose::gripper_down(-500.0, -1.0, 200.0, 0.0), &REST);
        let behind = behind.unwrap_err().to_string();
        assert!(behind.contains("joint") && behind.contains("deg"), "{behind}");
    }

    #[test]
    fn a_line_through_the_axis_of_the_wrist_is_refused_as_singular() {
        let arm = ArmModel::mh5(0.0);
        // Tool straight forward along the upper arm: R and T turn about one axis there.
        let ahead =
            |y_mm: f64, z_mm: f64| Pose { x_mm: 440.0, y_mm, z_mm, rx_rad: 0.0, ry_rad: FRAC_PI_2, rz_rad: 0.0 };
        let start = arm.joints_at(&ahead(-60.0, 680.2), &REST).unwrap();
        let refused = arm.plan_line(&start, &ahead(60.0, 680.2), 1000.0, 1500.0).unwrap_err();
        assert!(matches!(refused, MotionError::Singular { .. }), "{refused}");
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 256, failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn joints_give_back_the_pose_within_their_limits(
            x in 250.0..650.0f64, y in -250.0..250.0f64, z in 0.0..400.0f64, yaw in -PI..PI,
        ) {
            let arm = ArmModel::mh5(100.0);
            let pose = Pose::gripper_down(x, y, z, yaw);
            let Ok(joints) = arm.joints_at(&pose, &REST) else {
                let reach = (x.hypot(y) - 88.0).hypot(z + 186.5 - 330.0);
                prop_assert!(!(260.0..=540.0).contains(&reach), "{pose} should be in reach");
                return Ok(());
            };
            let back = arm.tool_at(&joints);
            prop_assert!(back.distance_mm(&pose) < 1e-6 && back.angle_rad(&pose) < 1e-6, "{back} of {pose}");
            for (angle, joint) in joints.0.iter().zip(arm.joints) {
                let [least, most] = joint.range_rad;
                prop_assert!((least - 1e-6..=most + 1e-6).contains(angle), "{} {angle}", joint.name);
            }
        }

        #[test]
        fn a_line_keeps_to_the_straight_and_no_joint_exceeds_its_speed(
            x in 330.0..520.0f64, y in -200.0..200.0f64, z in 40.0..300.0f64, yaw in -1.5..1.5f64, speed in 20.0..1200.0f64,
        ) {
            let arm = ArmModel::mh5(100.0);
            let start = arm.joints_at(&Pose::gripper_down(420.0, 0.0, 250.0, 0.0), &REST).unwrap();
            let target = Pose::gripper_down(x, y, z, yaw);
            let path = arm.plan_line(&start, &target, speed, 1500.0).unwrap();
            let from = arm.tool_at(&start);
            let steps = 200;
            let dt = path.lasts().as_secs_f64() / f64::from(steps);
            let mut last = path.joints(0.0);
            for i in 1..=steps {
                let share = f64::from(i) / f64::from(steps);
                let (tool, joints) = (path.tool(&arm, share), path.joints(share));
                let off = from.distance_mm(&tool) + tool.distance_mm(&target) - from.distance_mm(&target);
                prop_assert!(off < 1e-6, "{off} mm off the line");
                // The joints are looked up between sampled points, so they follow the line closely, not exactly.
                prop_assert!(arm.tool_at(&joints).distance_mm(&tool) < 0.5);
                for (joint, (a, b)) in arm.joints.iter().zip(last.0.iter().zip(joints.0)) {
                    prop_assert!((b - a).abs() / dt <= joint.speed_rad_s * 1.000_1, "{} too fast", joint.name);
                }
                last = joints;
            }
            let time_at_speed = from.distance_mm(&target) / speed;
            prop_assert!(path.lasts().as_secs_f64() >= time_at_speed * 0.999_9);
        }
    }
}
