//! What a camera is to this client: something that has frames, and may go away.

use std::time::Duration;

use samsod_frame::{FrameHeader, FrameLayout, FramePublisher, FrameSlot, SendError};

use crate::{Advice, ConfigError};

/// A camera that is set up and delivers.
pub(crate) trait Source {
    /// Bytes of a frame; a publisher must have slots of that size.
    fn frame_bytes(&self) -> usize;

    /// Slots of shared memory that it holds at a time.
    fn slots(&self) -> usize;

    /// Who it is, for the log.
    fn describe(&self) -> String;

    /// Waits for what comes next, at most for `timeout`.
    fn next(&mut self, sink: &mut Sink<'_>, timeout: Duration) -> Result<Grabbed, CameraError>;
}

/// What came from a camera.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Grabbed {
    /// A whole frame; it was sent.
    Frame {
        /// The camera's number of it; 0 where it has none.
        camera_frame: u64,
    },
    /// A frame of which something is missing; it was not sent.
    Incomplete {
        /// The camera's number of it; 0 where it has none.
        camera_frame: u64,
        /// What is missing.
        reason: String,
    },
    /// Nothing in time.
    Nothing,
}

/// Why a camera does not deliver.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CameraError {
    /// It is not there, or not any more; it may come back.
    #[error("{camera}: {reason}")]
    Gone {
        /// Which one.
        camera: String,
        /// What is known.
        reason: String,
    },
    /// It does not take a value of the configuration; another try would not help.
    #[error(transparent)]
    Setting(#[from] ConfigError),
    /// A frame could not be sent.
    #[error(transparent)]
    Send(#[from] SendError),
}

/// Where whole frames go.
pub(crate) struct Sink<'a> {
    pub(crate) publisher: &'a mut FramePublisher,
    /// Whether the next frame is to be looked at.
    pub(crate) look: bool,
    pub(crate) advice: Option<Advice>,
    /// Reused from frame to frame.
    pub(crate) scratch: Vec<u8>,
}

impl Sink<'_> {
    /// Sends a slot that nobody else writes to any more.
    pub(crate) fn send(&mut self, mut slot: FrameSlot, header: FrameHeader) -> Result<(), SendError> {
        if self.look {
            self.look = false;
            let layout = FrameLayout::check(&header, slot.len())?;
            self.advice = layout.rgb(slot.bytes(), &mut self.scratch).and_then(|view| Advice::of(&view).ok());
        }
        self.publisher.send_slot(slot, header).map(|_| ())
    }
}
