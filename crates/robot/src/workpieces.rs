//! What surrounds a robot that is not there: the things its gripper meets.
//!
//! A simulated arm and the emulated controller tell a [`Workpieces`] where the tool passes and what the gripper does;
//! it answers whether something is held. Without one the gripper closes on nothing.

use crate::Pose;

/// The things on the table of a simulated cell, as its gripper meets them. Poses are `base_from_tool`.
pub trait Workpieces: Send {
    /// The tool passes here, or stands here. Called along every motion at steps of a few millimetres, in order.
    fn passes(&mut self, tool: &Pose);

    /// The gripper has closed at `tool`. Returns whether it now holds something.
    fn close(&mut self, tool: &Pose) -> bool;

    /// The gripper has opened at `tool`: what it held is let go there.
    fn open(&mut self, tool: &Pose);
}
