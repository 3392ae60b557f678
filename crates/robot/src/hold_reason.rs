//! Who wants a robot to stand, and why.

use serde::{Deserialize, Serialize};

/// Why a robot is held; it stands until an operator resumes it.
///
/// ```
/// use samsod_robot::HoldReason;
/// assert_eq!(HoldReason::Operator.to_string(), "hold by an operator");
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum HoldReason {
    /// An operator has asked for it.
    Operator,
    /// The vision chain panicked: what it did not see, the robot cannot stay clear of.
    VisionPanic,
    /// Its commands would not be recorded.
    Recording,
}

impl std::fmt::Display for HoldReason {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Operator => "hold by an operator",
            Self::VisionPanic => "hold after a panic of the vision chain",
            Self::Recording => "hold because nothing is recorded",
        })
    }
}
