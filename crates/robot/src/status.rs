//! What a controller says of itself.

use serde::{Deserialize, Serialize};

use crate::{Outcome, Pose};

/// State of the gripper as far as it can be told.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GripperState {
    /// Nobody has told it anything yet, or the last command to it has an unknown outcome.
    #[default]
    Unknown,
    /// On its way.
    Moving,
    /// Open.
    Open,
    /// Closed; no sensor says whether on something.
    Closed,
    /// Closed on something, as its sensor says.
    Holding,
    /// Closed on nothing, as its sensor says.
    Empty,
}

/// Status of a controller, one flag for each condition that decides whether it may move.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Status {
    /// Takes commands from a host.
    pub remote: bool,
    /// In play mode, not in teach.
    pub play: bool,
    /// Servo power is on.
    pub servo_on: bool,
    /// Executing a motion or a job.
    pub running: bool,
    /// Hold by command of a host.
    pub hold_command: bool,
    /// Hold by an outside signal.
    pub hold_external: bool,
    /// Hold by the pendant.
    pub hold_pendant: bool,
    /// The emergency stop is pressed.
    pub emergency_stop: bool,
    /// Code of the alarm or error that stands, if any.
    pub alarm: Option<u32>,
    /// Why the controller object refuses to move until [`Controller::resume`](crate::Controller::resume), if it does.
    pub latched: Option<String>,
    /// State of the gripper.
    pub gripper: GripperState,
}

impl Status {
    /// Checks that a motion may start.
    ///
    /// # Errors
    /// The first reason why not, the gravest first.
    pub fn check_ready(&self) -> Result<(), NotReady> {
        if self.emergency_stop {
            return Err(NotReady::EmergencyStop);
        }
        if let Some(code) = self.alarm {
            return Err(NotReady::Alarm { code });
        }
        if let Some(reason) = &self.latched {
            return Err(NotReady::Latched { reason: reason.clone() });
        }
        if !self.remote {
            return Err(NotReady::NotRemote);
        }
        if !self.play {
            return Err(NotReady::Teach);
        }
        if !self.servo_on {
            return Err(NotReady::ServoOff);
        }
        for (held, by) in
            [(self.hold_command, "command"), (self.hold_external, "external signal"), (self.hold_pendant, "pendant")]
        {
            if held {
                return Err(NotReady::Hold { by });
            }
        }
        if self.running {
            return Err(NotReady::Running);
        }
        Ok(())
    }
}

/// Why a controller may not start a motion.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum NotReady {
    /// The emergency stop is pressed.
    #[error("the emergency stop is pressed")]
    EmergencyStop,
    /// An alarm or error stands.
    #[error("alarm {code} stands")]
    Alarm {
        /// Its code.
        code: u32,
    },
    /// A fault is latched.
    #[error("a fault is latched ({reason}); an operator must resume")]
    Latched {
        /// What happened.
        reason: String,
    },
    /// The controller does not take commands from a host.
    #[error("the controller is not in remote mode")]
    NotRemote,
    /// The controller is in teach mode.
    #[error("the controller is in teach mode")]
    Teach,
    /// Servo power is off.
    #[error("servo power is off")]
    ServoOff,
    /// The controller is on hold.
    #[error("the controller is on hold by {by}")]
    Hold {
        /// By what: command, external signal or pendant.
        by: &'static str,
    },
    /// A motion or job is running.
    #[error("a motion or job is running")]
    Running,
    /// The controller has not been reached yet.
    #[error("the controller is not connected: {cause}")]
    NotConnected {
        /// Why not.
        cause: String,
    },
}

/// Status and position, read together.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RobotState {
    /// What the controller says of itself.
    pub status: Status,
    /// `base_from_tool`.
    pub position: Pose,
}

/// Answer to [`Controller::poll`](crate::Controller::poll).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// What is known of the command: `Accepted` while it runs, then `Done`, `Aborted` or `Unknown`.
    pub outcome: Outcome,
    /// The state that this was concluded from.
    pub state: RobotState,
}
