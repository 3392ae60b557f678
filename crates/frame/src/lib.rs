//! The shared-memory contract between frame clients, the daemon and the readers of its scenes.
//!
//! A frame client writes a picture straight into a slot of shared memory ([`FramePublisher::loan`]) and sends it;
//! every subscriber reads it where it was written. There is no broker: processes meet by the name of the cell.
//! Transport is iceoryx2; two services are opened per cell, each beside an event service of the same name that
//! wakes the waiting side:
//!
//! | service | payload | user header | direction |
//! |---|---|---|---|
//! | `samsod/<cell>/frames` | `[u8]`: the rows of the picture | [`FrameHeader`] | client -> daemon |
//! | `samsod/<cell>/scenes` | `[u8]`: compact JSON of what the frame showed | [`SceneHeader`] | daemon -> local clients |
//!
//! A publisher sends, then notifies event id [`SENT_EVENT`]. Publishers may be written in any language with an
//! iceoryx2 binding: the headers are plain C structures whose offsets are documented and tested.
//!
//! # What holds
//!
//! - Nothing in a header is believed: [`FrameLayout::check`] compares every field with the length of the payload
//!   before a pixel is read, and names the field, its value and what is allowed.
//! - The latest frame wins. A slow subscriber never slows the publisher: the oldest waiting frame is overwritten, and
//!   [`FrameSubscriber::counts`] says how many were lost, from gaps in the sequence numbers.
//! - A subscriber cannot write to a frame: its mapping is read-only.
//! - What a killed process left behind is removed when the next participant starts.
//!
//! # Limits
//!
//! All participants of a cell run under one user id, and a root path that another user could write to is refused. Shared memory
//! lives in `/dev/shm`; a publisher takes `(buffer + borrowed) * subscribers + 1` slots ([`FrameServiceConfig::slots`]) of its
//! largest frame when it is opened, or is refused: a page that is missing later would end the process by a signal. A container's
//! default of 64 MB is soon too small.

mod convert;
mod frames;
mod half_made;
mod header;
mod room;
mod root;
mod scenes;
mod service;

pub use frames::{Frame, FrameCounts, FrameLoan, FramePublisher, FrameSlot, FrameSubscriber, PublisherId};
pub use header::{CameraId, FrameError, FrameHeader, FrameLayout, MAX_SIDE_PX, MAX_STRIDE_BYTES, PixelFormat};
pub use scenes::{SceneEncoding, SceneHeader, SceneMessage, ScenePublisher, SceneSubscriber};
pub use service::{FrameServiceConfig, ReceiveError, SENT_EVENT, SendError, ServiceError, unix_time_ns};

/// A borrowed, packed 8-bit RGB image: `width * height * 3` bytes, rows from top to bottom without padding.
pub type RgbView<'a> = image::ImageBuffer<image::Rgb<u8>, &'a [u8]>;
