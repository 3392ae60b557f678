//! What can be asked of a robot: motions and the gripper.

use serde::{Deserialize, Serialize};

use crate::Pose;

/// Number of a command; the caller counts up and never uses one twice, so that the log and the controller speak of
/// the same command.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct CommandId(pub u64);

impl std::fmt::Display for CommandId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "#{}", self.0)
    }
}

/// One motion of the tool. Speeds are of the kind that controllers take for that motion.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "motion", rename_all = "snake_case")]
pub enum Motion {
    /// Every joint at once, the slowest deciding; the path of the tool is no straight line (MOVJ).
    Joint {
        /// Where the tool goes.
        target: Pose,
        /// Share of the greatest joint speed, in (0, 1].
        speed_fraction: f64,
    },
    /// The tool on a straight line (MOVL).
    Linear {
        /// Where the tool goes.
        target: Pose,
        /// Speed of the tool centre point, mm/s, greater than 0.
        speed_mm_s: f64,
    },
}

impl Motion {
    /// Where the tool goes.
    pub fn target(&self) -> &Pose {
        match self {
            Self::Joint { target, .. } | Self::Linear { target, .. } => target,
        }
    }
}

/// What the gripper is told.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GripperCommand {
    /// Open it fully.
    Open,
    /// Close it until it holds or is shut.
    Close,
}

/// Any command, as it is written to the recording before it is sent.
///
/// ```
/// use samsod_robot::{Command, GripperCommand};
/// let line = serde_json::to_string(&Command::Gripper { gripper: GripperCommand::Open })?;
/// assert_eq!(line, r#"{"command":"gripper","gripper":"open"}"#);
/// # Ok::<(), serde_json::Error>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "command", rename_all = "snake_case")]
pub enum Command {
    /// A motion of the tool.
    Move(Motion),
    /// The gripper.
    Gripper {
        /// What it is told.
        gripper: GripperCommand,
    },
    /// Hold on or off.
    Hold {
        /// Whether the robot is to stand.
        on: bool,
    },
}

impl Command {
    /// Where the tool goes, if the command moves it.
    pub fn target(&self) -> Option<&Pose> {
        match self {
            Self::Move(motion) => Some(motion.target()),
            Self::Gripper { .. } | Self::Hold { .. } => None,
        }
    }
}
