//! Scenes: what the daemon saw, for clients on the same machine.
//!
//! This crate carries bytes and does not look into them. The daemon writes one compact JSON object a frame; the
//! header says of which frame, so that a client can join a scene to the picture it came from.

use std::mem::{align_of, offset_of, size_of};
use std::time::{Duration, Instant};

use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use iceoryx2::sample::Sample;

use crate::service::{Ipc, Topic, TopicLimits};
use crate::{FrameServiceConfig, ReceiveError, SendError, ServiceError};

/// Scenes that wait for a subscriber before the oldest is overwritten: small, so there may be many.
const BUFFERED: usize = 8;
/// Scenes a subscriber may hold at a time.
const BORROWED: usize = 2;

/// How the payload of a scene is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum SceneEncoding {
    /// One UTF-8 JSON object. Header value 1.
    Json = 1,
}

/// What travels in front of every scene: 24 bytes, native byte order, alignment 8.
///
/// | offset | size | field | unit |
/// |---|---|---|---|
/// | 0 | 8 | `sequence` | that of the frame |
/// | 8 | 8 | `timestamp_ns` | that of the frame, ns since the Unix epoch |
/// | 16 | 4 | `encoding` | 1 JSON |
/// | 20 | 4 | `reserved` | 0 |
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ZeroCopySend)]
#[type_name("SamsodSceneHeaderV1")]
#[repr(C)]
pub struct SceneHeader {
    /// Number of the frame that the scene was found in.
    pub sequence: u64,
    /// Timestamp of that frame, ns since the Unix epoch.
    pub timestamp_ns: u64,
    /// Value of a [`SceneEncoding`].
    pub encoding: u32,
    /// 0.
    pub reserved: u32,
}

const _: () = {
    assert!(size_of::<SceneHeader>() == 24 && align_of::<SceneHeader>() == 8);
    assert!(offset_of!(SceneHeader, timestamp_ns) == 8 && offset_of!(SceneHeader, encoding) == 16);
};

fn open(config: &FrameServiceConfig) -> Result<Topic<SceneHeader>, ServiceError> {
    Topic::open(config, "scenes", &TopicLimits { buffer: BUFFERED, borrowed: BORROWED })
}

/// Sends the scenes of a cell.
#[derive(Debug)]
pub struct ScenePublisher {
    port: Publisher<Ipc, [u8], SceneHeader>,
    notifier: Notifier<Ipc>,
    topic: Topic<SceneHeader>,
    max_bytes: usize,
}

impl ScenePublisher {
    /// Joins a cell as the publisher of its scenes.
    ///
    /// # Errors
    /// [`ServiceError`].
    pub fn open(config: &FrameServiceConfig) -> Result<Self, ServiceError> {
        let topic = open(config)?;
        let port = topic.publisher(config.max_scene_bytes, 1)?;
        let notifier = topic.notifier()?;
        Ok(Self { port, notifier, topic, max_bytes: config.max_scene_bytes })
    }

    /// Sends one scene, a JSON object, copied into shared memory.
    ///
    /// # Returns
    /// To how many subscribers it went.
    ///
    /// # Errors
    /// [`SendError::TooLarge`] above `max_scene_bytes`, [`SendError::Transport`].
    pub fn send(&mut self, sequence: u64, timestamp_ns: u64, json: &[u8]) -> Result<usize, SendError> {
        if json.len() > self.max_bytes {
            return Err(SendError::TooLarge { bytes: json.len(), max: self.max_bytes, key: "max_scene_bytes" });
        }
        let slot = self.port.loan_slice_uninit(json.len()).map_err(|e| self.topic.send_error(e))?;
        let mut sample = slot.write_from_slice(json);
        *sample.user_header_mut() =
            SceneHeader { sequence, timestamp_ns, encoding: SceneEncoding::Json as u32, reserved: 0 };
        let recipients = sample.send().map_err(|e| self.topic.send_error(e))?;
        self.notifier.notify().map_err(|e| self.topic.send_error(e))?;
        Ok(recipients)
    }
}

/// Receives the scenes of a cell, in order.
#[derive(Debug)]
pub struct SceneSubscriber {
    port: Subscriber<Ipc, [u8], SceneHeader>,
    listener: Listener<Ipc>,
    topic: Topic<SceneHeader>,
}

impl SceneSubscriber {
    /// Joins a cell as a reader of its scenes.
    ///
    /// # Errors
    /// [`ServiceError`], e.g. when all places are taken.
    pub fn open(config: &FrameServiceConfig) -> Result<Self, ServiceError> {
        let topic = open(config)?;
        let listener = topic.listener()?;
        let port = topic.subscriber()?;
        Ok(Self { port, listener, topic })
    }

    /// Waits for the next scene, asleep until one is sent, at most for `timeout`.
    ///
    /// # Returns
    /// `None` when none came in time, or when a signal woke the thread earlier.
    ///
    /// # Errors
    /// [`ReceiveError::TooManyHeld`], [`ReceiveError::Transport`].
    pub fn wait(&mut self, timeout: Duration) -> Result<Option<SceneMessage>, ReceiveError> {
        let deadline = Instant::now().checked_add(timeout);
        loop {
            if let Some(sample) = self.port.receive().map_err(|e| self.topic.receive_error(e))? {
                return Ok(Some(SceneMessage { header: *sample.user_header(), sample }));
            }
            if !self.topic.sleep(&self.listener, deadline)? {
                return Ok(None);
            }
        }
    }
}

/// A scene in shared memory. Its slot is free again when it is dropped.
#[derive(Debug)]
pub struct SceneMessage {
    sample: Sample<Ipc, [u8], SceneHeader>,
    header: SceneHeader,
}

impl SceneMessage {
    /// Of which frame it is, and how it is written.
    pub fn header(&self) -> &SceneHeader {
        &self.header
    }

    /// The scene: for [`SceneEncoding::Json`] one JSON object.
    pub fn bytes(&self) -> &[u8] {
        self.sample.payload()
    }
}
