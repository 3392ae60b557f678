//! What is known of a command.

use serde::{Deserialize, Serialize};

/// What is known of a command. The reasons are for people; decisions are taken on the variant alone.
///
/// ```text
/// NotExecuted                    the robot did nothing; the command may be given again under a new id
/// Accepted -> Done               the robot does it, then has done it
/// Accepted -> Aborted            it stood still before the end
/// Unknown                        the bytes left, no answer came: never repeated, an operator must look
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "outcome", rename_all = "snake_case")]
pub enum Outcome {
    /// Nothing was executed, for certain.
    NotExecuted {
        /// Why.
        reason: String,
    },
    /// The controller took the command and is executing it.
    Accepted,
    /// The command was executed to its end.
    Done,
    /// The command was taken but not executed to its end; the robot stands somewhere on the way.
    Aborted {
        /// Why.
        reason: AbortReason,
    },
    /// It cannot be said whether the command was executed, is being executed or was not.
    Unknown {
        /// Why.
        reason: String,
    },
}

impl Outcome {
    /// Whether nothing more will become known by polling.
    pub fn is_final(&self) -> bool {
        !matches!(self, Self::Accepted)
    }
}

impl std::fmt::Display for Outcome {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::NotExecuted { reason } => write!(f, "not executed: {reason}"),
            Self::Accepted => write!(f, "accepted"),
            Self::Done => write!(f, "done"),
            Self::Aborted { reason } => write!(f, "aborted: {reason}"),
            Self::Unknown { reason } => write!(f, "unknown: {reason}"),
        }
    }
}

/// Why a motion ended before its target.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, thiserror::Error)]
#[serde(tag = "kind", rename_all = "snake_case")]
#[non_exhaustive]
pub enum AbortReason {
    /// The emergency stop was pressed.
    #[error("emergency stop")]
    EmergencyStop,
    /// Servo power went off.
    #[error("servo power off")]
    ServoOff,
    /// The controller raised an alarm.
    #[error("alarm {code}")]
    Alarm {
        /// Code of the alarm as the controller counts it.
        code: u32,
    },
    /// Hold was switched on, by command, from outside or at the pendant.
    #[error("hold")]
    Hold,
    /// The controller left remote or play mode.
    #[error("left remote mode")]
    NotRemote,
    /// It stood still short of the target without a reason that the controller told.
    #[error("stopped {remaining_um} um short of the target")]
    StoppedShort {
        /// Distance that was left, in micrometres so that reasons can be compared.
        remaining_um: u64,
    },
    /// It was not done when it should have been, and was put on hold.
    #[error("not done after {waited_ms} ms, allowed were {allowed_ms} ms")]
    Timeout {
        /// Time since the start, ms.
        waited_ms: u64,
        /// Time allowed, ms.
        allowed_ms: u64,
    },
    /// The controller runs a job that was not asked for.
    #[error("the controller runs the job {job} instead")]
    OtherJob {
        /// Name of that job.
        job: String,
    },
}
