//! Which part is picked next, and by which way: section 5.3 of the paper, before anything moves.
//!
//! Input: what the camera has seen ([`Sight`]), the assembly list with its jig slots, and what lies in the jig already. Output: a
//! [`Pick`] with every pose of it, or the reason for each part that is passed over.
//!
//! A part is picked when a way to grip it is free: the open fingers, and the body of the gripper above them, keep a clearance from
//! every other thing that is as high, here and at the slot; every pose can be reached. Ways to grip are the grasps of the part
//! in their order, each from behind as well, and from every side that looks the same. A part without a free way waits: picking
//! another may free it.

use std::f64::consts::{PI, TAU};
use std::time::Duration;

use glam::DVec2;
use serde::{Deserialize, Serialize};

use crate::{ArmModel, Convex, GripperShape, Joints, Limits, Motion, MotionError, Pose, PoseError};

/// One way to grip a part, in the axes of the part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grasp {
    /// Where the gripper closes, from the origin of the part, mm.
    pub offset_mm: [f64; 2],
    /// Direction of the gripper's x axis, rad; it closes across.
    pub angle_rad: f64,
    /// Width of the part there, mm.
    pub width_mm: f64,
}

/// Something on the table that the camera has found, in the base frame of the robot.
#[derive(Debug, Clone, PartialEq)]
pub struct SeenPart {
    /// What it is; `None` when that is not known.
    pub name: Option<String>,
    /// How sure that is, in [0, 1].
    pub score: f64,
    /// Its origin on the table, mm.
    pub at_mm: [f64; 2],
    /// Its turn, rad.
    pub yaw_rad: f64,
    /// Height of the table there, mm.
    pub z_mm: f64,
    /// Its height, mm.
    pub height_mm: f64,
    /// Its outline seen from above, in its own axes (of what is not known: where it lies, with origin and turn 0).
    pub outline_mm: Convex,
    /// The ways to grip it, the best first; none for what is not known, and for what lies where nothing is to be picked.
    pub grasps: Vec<Grasp>,
    /// It looks the same after this share of a turn; 0 for a round part.
    pub symmetry_order: u32,
}

impl SeenPart {
    fn outline(&self) -> Convex {
        self.outline_mm.moved(self.at_mm, self.yaw_rad)
    }
}

/// What one frame has shown.
#[derive(Debug, Clone, PartialEq)]
pub struct Sight {
    /// Number of the frame.
    pub frame: u64,
    /// When it was taken, on the clock of the robot.
    pub taken_at: Duration,
    /// Every part and every unknown thing in it.
    pub parts: Vec<SeenPart>,
}

/// One line of the assembly list: a part, and where its origin goes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct JigSlot {
    /// Name of the part in the catalogue.
    pub part: String,
    /// Where the origin of the part goes, base frame, mm.
    pub x_mm: f64,
    /// See `x_mm`.
    pub y_mm: f64,
    /// Height of the surface that it is put on, base frame, mm.
    #[serde(default)]
    pub z_mm: f64,
    /// How the part is turned there, rad.
    #[serde(default, rename = "yaw_deg", with = "crate::degrees")]
    #[cfg_attr(feature = "schema", schemars(with = "f64"))]
    pub yaw_rad: f64,
}

/// What the planner must know of the cell.
#[derive(Debug, Clone)]
pub struct Planner {
    /// The assembly list, in its order.
    pub order: Vec<JigSlot>,
    /// The gripper.
    pub gripper: GripperShape,
    /// Least distance that the gripper keeps from what it shall not touch, mm.
    pub clearance_mm: f64,
    /// Height of the tool on its way, over the table, mm.
    pub safe_height_mm: f64,
    /// Least score of what is picked.
    pub score_min: f64,
    /// The arm, if it is known: then what cannot be reached is found before anything moves.
    pub arm: Option<ArmModel>,
    /// Limits of the cell, if it has some: what they forbid is found before anything is gripped.
    pub limits: Option<Limits>,
}

/// What lies in a slot already.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Filled {
    outline: Convex,
    top_mm: f64,
}

/// One part and the way it is taken.
#[derive(Debug, Clone, PartialEq)]
pub struct Pick {
    /// Which line of the assembly list.
    pub slot: usize,
    /// Name of the part.
    pub part: String,
    /// Index in the sight.
    pub seen: usize,
    /// How sure it is that it is this part, in [0, 1].
    pub score: f64,
    /// The tool over the part, at the safe height.
    pub above: Pose,
    /// The tool where the gripper closes: at half the height of the part over the table.
    pub grasp: Pose,
    /// The tool over the slot, at the safe height.
    pub above_slot: Pose,
    /// The tool where the gripper lets go.
    pub release: Pose,
    pub(crate) fills: Filled,
}

/// A part that is not picked now.
#[derive(Debug, Clone, PartialEq)]
pub struct PassedOver {
    /// Which line of the assembly list.
    pub slot: usize,
    /// Name of the part.
    pub part: String,
    /// Why.
    pub reason: Reason,
}

/// Why a part is not picked now.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum Reason {
    /// The frame does not show it.
    #[error("it is not seen")]
    NotSeen,
    /// Nothing is picked where it lies.
    #[error("it lies outside the region of interest")]
    Outside,
    /// It may be something else.
    #[error("its score is {score:.2}; needed is {least:.2}")]
    Doubtful {
        /// Its score.
        score: f64,
        /// The least that is picked.
        least: f64,
    },
    /// Its pose has a value that is no number.
    #[error("its place: {0}")]
    Pose(#[from] PoseError),
    /// The fingers would meet something beside it.
    #[error("{by} is in the way of the gripper, {gap_mm:.1} mm from it; needed are {needed_mm:.1} mm")]
    Blocked {
        /// What.
        by: String,
        /// Distance, below 0 when they would overlap, mm.
        gap_mm: f64,
        /// Least distance, mm.
        needed_mm: f64,
    },
    /// It is wider than the gripper opens.
    #[error(
        "it is {width_mm:.1} mm wide where it is gripped; the gripper opens {opening_mm:.1} mm and needs {clearance_mm:.1} mm on either side"
    )]
    TooWide {
        /// Its width, mm.
        width_mm: f64,
        /// Opening of the gripper, mm.
        opening_mm: f64,
        /// Clearance on either side, mm.
        clearance_mm: f64,
    },
    /// Over something high it would not pass at the safe height.
    #[error(
        "the safe height of {safe_height_mm:.1} mm is too low to carry it over {over}: {needed_mm:.1} mm are needed"
    )]
    SafeHeight {
        /// The safe height, mm.
        safe_height_mm: f64,
        /// What is that high.
        over: String,
        /// What would be needed, mm.
        needed_mm: f64,
    },
    /// The arm cannot get there.
    #[error("{at}: {cause}")]
    OutOfReach {
        /// Where.
        at: &'static str,
        /// Why.
        cause: Box<MotionError>,
    },
    /// The gripper has closed on nothing, or it could not be gone to, again and again.
    #[error("it was missed, or not reached, {times} times")]
    Missed {
        /// How often.
        times: u32,
    },
}

impl Planner {
    /// The first part of the assembly list that can be picked, and why those before it are passed over; without a pick, why each
    /// is. `filled` has what lies in each slot, `missed` how often each was missed; `tool` is where the tool is now.
    pub(crate) fn choose(
        &self,
        sight: &Sight,
        filled: &[Option<Filled>],
        missed: &[u32],
        tool: &Pose,
    ) -> (Option<Pick>, Vec<PassedOver>) {
        const MOST_MISSES: u32 = 3;
        let mut passed_over = Vec::new();
        for (slot, line) in self.order.iter().enumerate() {
            if filled.get(slot).is_some_and(Option::is_some) {
                continue;
            }
            let pass = |reason| PassedOver { slot, part: line.part.clone(), reason };
            let times = missed.get(slot).copied().unwrap_or(0);
            if times >= MOST_MISSES {
                passed_over.push(pass(Reason::Missed { times }));
                continue;
            }
            let mut why = Reason::NotSeen;
            let named = sight.parts.iter().enumerate().filter(|(_, part)| part.name.as_deref() == Some(&line.part));
            let mut candidates: Vec<_> = named.filter(|(_, part)| !self.lies_in_jig(part)).collect();
            candidates.sort_by(|(_, a), (_, b)| b.score.total_cmp(&a.score));
            for (seen, part) in candidates {
                match self.way(slot, line, seen, part, sight, filled, tool) {
                    Ok(pick) => return (Some(pick), passed_over),
                    Err(reason) => why = reason,
                }
            }
            passed_over.push(pass(why));
        }
        (None, passed_over)
    }

    /// A part that was put down already may still be seen.
    fn lies_in_jig(&self, part: &SeenPart) -> bool {
        let at = DVec2::from(part.at_mm);
        let slots = self.order.iter().filter(|slot| part.name.as_ref() == Some(&slot.part));
        let radius = part.outline_mm.corners_mm().iter().map(|&p| DVec2::from(p).length()).fold(0.0, f64::max);
        slots.into_iter().any(|slot| DVec2::new(slot.x_mm, slot.y_mm).distance(at) < radius.max(5.0))
    }

    #[allow(clippy::too_many_arguments)]
    fn way(
        &self,
        slot: usize,
        line: &JigSlot,
        seen: usize,
        part: &SeenPart,
        sight: &Sight,
        filled: &[Option<Filled>],
        tool: &Pose,
    ) -> Result<Pick, Reason> {
        Pose::gripper_down(part.at_mm[0], part.at_mm[1], part.z_mm + part.height_mm, part.yaw_rad).check()?;
        // Written so that NaN is refused.
        if !(self.score_min..=1.0).contains(&part.score) {
            return Err(Reason::Doubtful { score: part.score, least: self.score_min });
        }
        if part.grasps.is_empty() {
            return Err(Reason::Outside);
        }
        let obstacles: Vec<Obstacle<'_>> = self.obstacles(seen, sight, filled);
        // The tool holds the part at half its height.
        let below_tool = part.height_mm / 2.0;
        if let Some(highest) = obstacles.iter().max_by(|a, b| a.top_mm.total_cmp(&b.top_mm)) {
            let needed_mm = highest.top_mm - part.z_mm + below_tool + self.clearance_mm;
            if needed_mm > self.safe_height_mm {
                let (safe_height_mm, over) = (self.safe_height_mm, highest.name.to_owned());
                return Err(Reason::SafeHeight { safe_height_mm, over, needed_mm });
            }
        }
        let mut first = None;
        for grasp in &part.grasps {
            for way in self.ways(line, part, grasp, tool) {
                match self.grip(slot, line, seen, part, grasp.width_mm, &way, &obstacles, tool) {
                    Ok(pick) => return Ok(pick),
                    // Of the best grasp, from the nearest side: the other ways are the substitutes.
                    Err(reason) => first = first.or(Some(reason)),
                }
            }
        }
        Err(first.unwrap_or(Reason::NotSeen))
    }

    /// Everything that may be in the way: what is seen beside the part, and what lies in the jig.
    fn obstacles<'a>(&self, seen: usize, sight: &'a Sight, filled: &[Option<Filled>]) -> Vec<Obstacle<'a>> {
        let others = sight.parts.iter().enumerate().filter(|(i, _)| *i != seen);
        let seen = others.map(|(_, part)| Obstacle {
            name: part.name.as_deref().unwrap_or("something unknown"),
            outline: part.outline(),
            top_mm: part.z_mm + part.height_mm,
        });
        let jig = filled.iter().flatten().map(|filled| Obstacle {
            name: "a part in the jig",
            outline: filled.outline.clone(),
            top_mm: filled.top_mm,
        });
        seen.chain(jig).collect()
    }

    /// Every way to grip a part by one grasp, the one with the least turn of the tool first.
    ///
    /// From a side that looks the same the part has other axes, turned by as much, and may be put down by those; a gripper that
    /// is turned by half a turn grips as well.
    fn ways(&self, line: &JigSlot, part: &SeenPart, grasp: &Grasp, tool: &Pose) -> Vec<Way> {
        // A round part looks the same from everywhere; twelve sides are as good as all.
        let sides = if part.symmetry_order == 0 { 12 } else { part.symmetry_order };
        let now = crate::gripper_shape::yaw_rad(tool);
        let offset = DVec2::from(grasp.offset_mm);
        let slot_at = DVec2::new(line.x_mm, line.y_mm) + DVec2::from_angle(line.yaw_rad).rotate(offset);
        let mut ways = Vec::new();
        for side in 0..sides {
            let axes = part.yaw_rad + f64::from(side) * TAU / f64::from(sides);
            let at = DVec2::from(part.at_mm) + DVec2::from_angle(axes).rotate(offset);
            for turn in [0.0, PI] {
                let (yaw, slot_yaw) = (axes + grasp.angle_rad + turn, line.yaw_rad + grasp.angle_rad + turn);
                ways.push(Way { at, yaw: wrapped(yaw), slot_at, slot_yaw: wrapped(slot_yaw) });
            }
        }
        ways.sort_by(|a, b| wrapped(a.yaw - now).abs().total_cmp(&wrapped(b.yaw - now).abs()));
        ways
    }

    #[allow(clippy::too_many_arguments)]
    fn grip(
        &self,
        slot: usize,
        line: &JigSlot,
        seen: usize,
        part: &SeenPart,
        width_mm: f64,
        way: &Way,
        obstacles: &[Obstacle<'_>],
        tool: &Pose,
    ) -> Result<Pick, Reason> {
        let clearance_mm = self.clearance_mm;
        let opening_mm = self.gripper.opening_mm;
        let too_wide = |width_mm| Reason::TooWide { width_mm, opening_mm, clearance_mm };
        if width_mm + 2.0 * clearance_mm > opening_mm {
            return Err(too_wide(width_mm));
        }
        let height = part.height_mm / 2.0;
        let pose = |at: DVec2, z_mm, yaw| Pose::gripper_down(at.x, at.y, z_mm, yaw);
        let grasp = pose(way.at, part.z_mm + height, way.yaw);
        let outline = part.outline();
        let fingers = self.gripper.fingers(&grasp, opening_mm);
        if let Some(gap) = fingers.iter().map(|finger| finger.gap_mm(&outline)).find(|gap| *gap <= 0.0) {
            return Err(too_wide(opening_mm - 2.0 * gap));
        }
        self.is_free(&grasp, obstacles)?;

        let release = pose(way.slot_at, line.z_mm + height, way.slot_yaw);
        let placed = part.outline_mm.moved([line.x_mm, line.y_mm], line.yaw_rad);
        for obstacle in obstacles.iter().filter(|obstacle| obstacle.top_mm > line.z_mm + 0.5) {
            let gap_mm = placed.gap_mm(&obstacle.outline);
            if gap_mm < 0.0 {
                return Err(Reason::Blocked { by: obstacle.name.to_owned(), gap_mm, needed_mm: 0.0 });
            }
        }
        // The gripper opens there, so the open fingers need their room.
        self.is_free(&release, obstacles)?;

        let above = Pose { z_mm: part.z_mm + self.safe_height_mm, ..grasp };
        let above_slot = Pose { z_mm: line.z_mm.max(part.z_mm) + self.safe_height_mm, ..release };
        self.can_reach([("above the part", &above), ("at the part", &grasp)])?;
        self.can_reach([("above the jig slot", &above_slot), ("at the jig slot", &release)])?;
        self.is_allowed([("above the part", tool, &above), ("at the part", &above, &grasp)])?;
        self.is_allowed([("above the jig slot", &above, &above_slot), ("at the jig slot", &above_slot, &release)])?;
        let fills = Filled { outline: placed, top_mm: line.z_mm + part.height_mm };
        let (part, score) = (line.part.clone(), part.score);
        Ok(Pick { slot, part, seen, score, above, grasp, above_slot, release, fills })
    }

    /// Whether the open gripper keeps its clearance from all that is as high as it stands.
    fn is_free(&self, tool: &Pose, obstacles: &[Obstacle<'_>]) -> Result<(), Reason> {
        let needed_mm = self.clearance_mm;
        let fingers = self.gripper.fingers(tool, self.gripper.opening_mm);
        let body = self.gripper.body(tool);
        for obstacle in obstacles {
            let finger = fingers.iter().filter(|_| obstacle.top_mm > tool.z_mm - needed_mm);
            let body = Some(&body).filter(|_| obstacle.top_mm > tool.z_mm + self.gripper.finger_length_mm - needed_mm);
            let gap_mm = finger.chain(body).map(|shape| shape.gap_mm(&obstacle.outline)).fold(f64::INFINITY, f64::min);
            if gap_mm < needed_mm {
                return Err(Reason::Blocked { by: obstacle.name.to_owned(), gap_mm, needed_mm });
            }
        }
        Ok(())
    }

    /// Whether the limits of the cell allow two motions. Speeds are those of the configuration, which has been checked.
    fn is_allowed(&self, motions: [(&'static str, &Pose, &Pose); 2]) -> Result<(), Reason> {
        let Some(limits) = &self.limits else { return Ok(()) };
        for (at, from, target) in motions {
            let slow = Motion::Linear { target: *target, speed_mm_s: limits.linear_speed_max_mm_s };
            let allowed = limits.allow(from, &slow, None, Duration::ZERO);
            allowed.map_err(|cause| Reason::OutOfReach { at, cause: Box::new(cause) })?;
        }
        Ok(())
    }

    /// Whether the arm can stand at the first pose, and go from there to the second on a line.
    fn can_reach(&self, [(at_first, first), (at_second, second)]: [(&'static str, &Pose); 2]) -> Result<(), Reason> {
        let Some(arm) = &self.arm else { return Ok(()) };
        let fail = |at| move |cause| Reason::OutOfReach { at, cause: Box::new(cause) };
        let joints = arm.joints_at(first, &Joints([0.0; 6])).map_err(fail(at_first))?;
        arm.plan_line(&joints, second, 100.0, 100.0).map_err(fail(at_second))?;
        Ok(())
    }
}

/// One way to grip a part: where the gripper closes and how it is turned, there and at the slot.
struct Way {
    at: DVec2,
    yaw: f64,
    slot_at: DVec2,
    slot_yaw: f64,
}

struct Obstacle<'a> {
    name: &'a str,
    outline: Convex,
    top_mm: f64,
}

/// The same angle in (-pi, pi].
fn wrapped(angle: f64) -> f64 {
    let turns = ((angle - PI) / TAU).ceil();
    angle - turns * TAU
}
