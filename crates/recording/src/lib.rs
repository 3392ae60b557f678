//! MCAP files that may be damaged: read record by record, and made whole again.
//!
//! Input: a file, by samsod or anybody. Output: its messages up to the first damage ([`Messages`]), or a new file with everything
//! that can be read of it ([`recover`]). No bytes bring a panic about, and none ask for more memory than the file can fill.

mod messages;
mod records;
mod recover;

use std::fs::File;
use std::path::PathBuf;

pub use messages::Messages;
pub use recover::{Loss, RecoverError, RecoveredTopic, Recovery, recover, recovered_path};

/// Why a file cannot be read as a recording.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReadError {
    /// The file cannot be opened or read.
    #[error("cannot read {}: {cause}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        #[source]
        cause: std::io::Error,
    },
    /// The file is no MCAP file.
    #[error("{} is no MCAP recording: {cause}", path.display())]
    NoRecording {
        /// The file.
        path: PathBuf,
        /// What was found.
        cause: String,
    },
    /// A message is not what its schema says.
    #[error("{}: message {number} on {topic} cannot be decoded: {cause}", path.display())]
    Message {
        /// The file.
        path: PathBuf,
        /// The topic.
        topic: String,
        /// Number of the message on its topic, from 0.
        number: u64,
        /// Why.
        cause: String,
    },
}

/// Whether somebody writes to a recording at the moment: whoever does, holds a lock of the file.
pub fn is_in_use(file: &File) -> bool {
    matches!(file.try_lock_shared(), Err(std::fs::TryLockError::WouldBlock))
}

/// The error of the library with its causes: that the disk is full stands in the last of them.
pub fn cause_of(error: &mcap::McapError) -> String {
    let mut cause = error.to_string();
    let mut source = std::error::Error::source(error);
    while let Some(deeper) = source {
        cause += &format!(": {deeper}");
        source = deeper.source();
    }
    cause
}
