//! Frames of industrial cameras into the shared memory of a cell.
//!
//! Input: a GigE Vision or USB3 Vision camera (through Aravis, feature `aravis`) or one of the kernel's (`/dev/video*`, feature
//! `v4l`), and a [`ClientConfig`]. Output: its whole frames, in order, through [`samsod_frame::FramePublisher`], with the camera's
//! own numbers and clock in the header.
//!
//! # What holds
//!
//! - A frame of which anything is missing never leaves the client: it is counted and told.
//! - A camera that is gone is looked for until it is back, and set up anew then; nothing else has to be started again. The
//!   publisher stays, so that numbers of frames go on.
//! - A value that the camera does not take ends the client, with the name of the key, the value and what is allowed.
//!
//! Frames of a GenICam camera are received where they are sent from: Aravis writes packets into the slot of shared memory. Frames
//! of the kernel are copied or converted once.

// What only one of the drivers uses.
#![cfg_attr(not(all(feature = "aravis", feature = "v4l")), allow(dead_code))]

mod advice;
mod config;
mod gaps;
mod run;
mod source;

#[cfg(feature = "aravis")]
mod genicam;
#[cfg(feature = "v4l")]
mod video;
#[cfg(any(feature = "v4l", test))]
mod yuyv;

pub use advice::{Advice, AdviceError, Exposure};
pub use config::{
    AutoOr, CameraSection, CellSection, ClientConfig, ConfigError, Driver, GigeSection, ReconnectSection, ReportSection,
};
#[cfg(feature = "aravis")]
pub use genicam::{FoundCamera, list_cameras};
pub use run::{Counts, Event, RunError, run};
pub use source::CameraError;
