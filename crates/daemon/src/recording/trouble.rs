//! Why a recording takes nothing at the moment.

use std::fmt;
use std::time::Duration;

/// How long a command waits for the disk.
pub(super) const COMMAND_PATIENCE: Duration = Duration::from_secs(5);

/// Why frames, or nothing at all, are recorded at the moment; it may go away.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Trouble {
    /// A write has failed, and no file could be begun anew yet.
    Failed {
        /// What the system said.
        cause: String,
    },
    /// The disk has taken nothing for longer than a command waits.
    Stuck {
        /// Since the last write that came through, ms.
        for_ms: u64,
    },
    /// Less is free than is to be kept free: frames are left out.
    ShortOfSpace {
        /// Free space, MiB.
        free_mib: u64,
        /// `min_free_mib`.
        least_mib: u64,
    },
}

impl fmt::Display for Trouble {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Failed { cause } => write!(f, "recording has failed: {cause}"),
            Self::Stuck { for_ms } => write!(f, "recording is stuck: the disk has taken nothing for {for_ms} ms"),
            Self::ShortOfSpace { free_mib, least_mib } => {
                write!(f, "recording is short of space: {free_mib} MiB free, [recording] min_free_mib = {least_mib}")
            }
        }
    }
}
