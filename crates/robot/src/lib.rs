//! Robot controllers: what the daemon may ask of a robot, and what it then knows.
//!
//! [`Controller`] is the seam between the vision daemon and a robot. It is shaped for controllers that
//! *accept* a motion in milliseconds and *execute* it in seconds (Yaskawa Ethernet Server, FANUC RMI and alike):
//!
//! ```text
//! start_motion(id, motion) -> accepted          the answer of the controller to the command
//! poll(id)                 -> Accepted, Accepted, .. , Done | Aborted | Unknown
//! ```
//!
//! Three rules hold for every implementation and are tested by one conformance suite (`tests/conformance.rs`):
//!
//! 1. **Nothing is sent twice.** The caller numbers its commands with a growing [`CommandId`], which it has written
//!    to its log before; a controller refuses an id that it has seen.
//! 2. **What is not known is called [`Outcome::Unknown`].** A command whose bytes left and whose answer did not come
//!    is neither repeated nor assumed.
//! 3. **After a fault nothing moves by itself.** An emergency stop, alarm, loss of servo power or remote, or an unknown
//!    outcome is latched; only [`Controller::resume`], an operator's act, clears it, and it reads the position first.
//!
//! [`follow`] is the plain way to see a command through to its end.
//!
//! # Controllers
//!
//! [`Simulated`] is a controller without a robot: an MH5 that moves at finite speed on a [`Clock`] that a test may drive.
//! [`Motoman`] drives Yaskawa controllers over TCP; every byte passes a [`WireLog`] before it leaves. With the feature `emulator`
//! there is such a controller without a robot, too: a TCP server that answers as the real one does and has faults by script. It
//! is no part of the daemon.
//!
//! Decorators go around any of them: [`Limited`] refuses what is outside the [`Limits`] of the cell, [`Disarmed`] refuses every
//! motion, [`HoldSwitch`] puts a robot in motion on hold when somebody asks for it from another thread ([`HoldReason`] says who).
//!
//! # Pick and place
//!
//! ```text
//! Sight, JigSlots -Planner-> Pick -Sequence-> commands -HoldSwitch, Limited-> Controller
//!                                      |
//!                                 SequenceLog: every command before it is given, every outcome, pick and fault
//! ```
//!
//! [`Planner`] says which part of a [`Sight`] is picked next and by which way, or why each is [passed over](PassedOver): the
//! [gripper](GripperShape) must find room between the [outlines](Convex) of everything else, and the arm must reach every pose.
//! [`Sequence`] makes the picks, latches what goes wrong as a [`SequenceFault`] that says what the gripper may hold, and goes on
//! only after [`Sequence::resume`]. [`ArmModel`] is the arm behind both: [`Joints`] for poses, and whether the way between two
//! can be gone. [`PartTable`] has the parts that a simulated gripper meets ([`Workpieces`]): it counts picks, misses and
//! collisions, and can live in a file.
//!
//! Nothing here is a safety device: emergency stop, guards and speed limits belong to the robot's safety circuit.
//!
//! Units: millimetres, radians, seconds ([`std::time::Duration`]). Poses are `base_from_tool`: they take tool
//! coordinates to the robot's base frame (right-handed, z up).
//!
//! ```
//! use std::time::Duration;
//! use samsod_robot::{
//!     Clock, CommandId, Controller, FollowOptions, ManualClock, Motion, Outcome, Simulated, SimulatedConfig, follow,
//! };
//!
//! let clock = ManualClock::new();
//! let mut robot = Simulated::new(SimulatedConfig::default(), clock.clone())?;
//! robot.connect()?;
//! let mut target = robot.position()?;
//! target.z_mm -= 100.0;
//! let motion = Motion::Linear { target, speed_mm_s: 50.0 };
//! robot.start_motion(CommandId(1), &motion)?;
//! let end = follow(&mut robot, &clock, CommandId(1), &FollowOptions::for_motion(100.0, 50.0), |_| ());
//! assert_eq!(end, Outcome::Done);
//! assert!(clock.now() >= Duration::from_secs(2)); // 100 mm at 50 mm/s
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod clock;
mod command;
mod controller;
mod convex;
mod degrees;
#[cfg(feature = "emulator")]
pub mod emulator;
mod follow;
mod gripper_shape;
mod hold_reason;
mod hold_switch;
mod kinematics;
mod limits;
pub mod motoman;
mod outcome;
mod part_table;
mod plan;
mod pose;
mod sequence;
mod simulated;
mod status;
mod wire_log;
mod workpieces;

pub use clock::{Clock, ManualClock, MonotonicClock, ScaledClock};
pub use command::{Command, CommandId, GripperCommand, Motion};
pub use controller::{
    ConnectError, Controller, GripperError, HoldError, MotionError, PollError, PositionError, ResumeError, StatusError,
};
pub use convex::Convex;
pub use follow::{FollowOptions, follow};
pub use gripper_shape::GripperShape;
pub use hold_reason::HoldReason;
pub use hold_switch::HoldSwitch;
pub use kinematics::{ArmModel, ArmPath, Joints};
pub use limits::{Disarmed, Limited, Limits, SharedLimits, Sighting};
pub use motoman::{Motoman, MotomanConfig, MotomanConfigError};
pub use outcome::{AbortReason, Outcome};
pub use part_table::{
    Collider, CollisionRecord, PartTable, PartTableError, PickRecord, PickTolerance, TablePart, TableState, Whereabouts,
};
pub use plan::{Grasp, JigSlot, PassedOver, Pick, Planner, Reason, SeenPart, Sight};
pub use pose::{Pose, PoseError};
pub use sequence::{
    GripperHolds, Phase, PickReport, PickResult, Purpose, Sequence, SequenceFault, SequenceLog, SequenceOptions,
    SequenceResumeError, SequenceState,
};
pub use simulated::{Fault, Panel, Simulated, SimulatedConfig, SimulatedConfigError};
pub use status::{GripperState, NotReady, Progress, RobotState, Status};
pub use wire_log::{NoWireLog, WireLog};
pub use workpieces::Workpieces;
