//! From a camera that comes and goes to a stream of frames that goes on.
//!
//! Input: a [`ClientConfig`]. Output: frames in shared memory, and [`Event`]s of what happens on the way.

use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use samsod_frame::{CameraId, FramePublisher, FrameServiceConfig, ServiceError};

use crate::Advice;
use crate::config::{ClientConfig, ConfigError, refused};
use crate::gaps::Gaps;
use crate::source::{CameraError, Grabbed, Sink, Source};

/// How often a wait looks whether it should end.
const TICK: Duration = Duration::from_millis(50);

/// What came of a camera since the client was started, in frames. Each frame of the camera is in one of the first three.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Counts {
    /// Sent to the cell.
    pub sent: u64,
    /// Not sent, because something of them was missing.
    pub incomplete: u64,
    /// Never seen: gaps in the numbers of the camera, while it was there.
    pub missing: u64,
    /// How often the camera was set up.
    pub connected: u64,
}

/// What happens on the way.
#[derive(Debug)]
#[non_exhaustive]
pub enum Event<'a> {
    /// The camera is set up; frames may come.
    Connected {
        /// Which camera.
        camera: &'a str,
        /// Time since it was found to be gone, or since the start.
        after: Duration,
    },
    /// The first frame since the camera was set up.
    Flowing {
        /// Time since the camera was found to be gone, or since the start.
        after: Duration,
    },
    /// The camera is not there; it is looked for.
    Gone {
        /// What is known.
        error: &'a CameraError,
        /// Whether it was there before.
        was_there: bool,
    },
    /// A frame was sent.
    Sent,
    /// A frame was not sent.
    Incomplete {
        /// The camera's number of it; 0 where it has none.
        camera_frame: u64,
        /// What is missing.
        reason: &'a str,
    },
    /// Frames that never came lie before the last one.
    Missing {
        /// How many.
        frames: u64,
    },
    /// Time for a word.
    Status {
        /// What came so far.
        counts: Counts,
        /// What could be better, if a frame was looked at.
        advice: Option<&'a Advice>,
    },
}

/// Why the client ended.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RunError {
    /// A value that cannot be, or that the camera does not take.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The shared memory cannot be used.
    #[error(transparent)]
    Service(#[from] ServiceError),
    /// A frame cannot be sent.
    #[error(transparent)]
    Send(#[from] samsod_frame::SendError),
}

/// Sends frames until `stop` is set.
///
/// # Errors
/// [`RunError`]. A camera that is not there is none: it is looked for until it comes.
pub fn run(config: &ClientConfig, stop: &AtomicBool, events: &mut dyn FnMut(&Event<'_>)) -> Result<Counts, RunError> {
    config.check()?;
    let mut client = Client {
        config,
        stop,
        events,
        publisher: None,
        counts: Counts::default(),
        gaps: Gaps::default(),
        gone_since: Instant::now(),
        reported: Instant::now(),
    };
    client.run()?;
    Ok(client.counts)
}

struct Client<'a> {
    config: &'a ClientConfig,
    stop: &'a AtomicBool,
    events: &'a mut dyn FnMut(&Event<'_>),
    /// It stays when the camera goes, so that numbers of frames go on.
    publisher: Option<Port>,
    counts: Counts,
    gaps: Gaps,
    gone_since: Instant,
    reported: Instant,
}

struct Port {
    publisher: FramePublisher,
    frame_bytes: usize,
    slots: usize,
}

impl Client<'_> {
    fn run(&mut self) -> Result<(), RunError> {
        let first_pause = Duration::from_millis(self.config.reconnect.pause_ms);
        let longest_pause = Duration::from_millis(self.config.reconnect.longest_pause_ms);
        let mut pause = first_pause;
        let mut last_reason = String::new();
        while !self.is_told_to_stop() {
            let delivered = self.counts.sent;
            let (error, was_there) = match open(self.config) {
                Ok(mut source) => match self.deliver(source.as_mut()) {
                    Ok(()) => break,
                    Err(e) => (e, true),
                },
                Err(e) => (e, false),
            };
            let error = match error {
                CameraError::Setting(e) => return Err(e.into()),
                CameraError::Send(e) => return Err(e.into()),
                CameraError::Gone { .. } => error,
            };
            if self.counts.sent > delivered {
                pause = first_pause;
            }
            // Once for each reason: it may be looked for all night.
            let reason = error.to_string();
            if was_there || reason != last_reason {
                (self.events)(&Event::Gone { error: &error, was_there });
                last_reason = reason;
            }
            self.sleep(pause);
            pause = (pause * 2).min(longest_pause);
        }
        Ok(())
    }

    /// Sends frames until told to stop.
    fn deliver(&mut self, source: &mut dyn Source) -> Result<(), CameraError> {
        let mut port = match self.publisher.take() {
            Some(port) if port.frame_bytes >= source.frame_bytes() && port.slots >= source.slots() => port,
            other => {
                // The old one first: there is room for two publishers in a cell, and one may be a client that takes over.
                drop(other);
                self.open_port(source)?
            }
        };
        self.counts.connected += 1;
        self.gaps.begin_anew();
        (self.events)(&Event::Connected { camera: &source.describe(), after: self.gone_since.elapsed() });
        let result = self.pump(source, &mut port.publisher);
        if result.is_err() {
            self.gone_since = Instant::now();
        }
        self.publisher = Some(port);
        result
    }

    fn open_port(&self, source: &dyn Source) -> Result<Port, CameraError> {
        let (frame_bytes, slots) = (source.frame_bytes(), source.slots());
        let service = FrameServiceConfig { max_frame_bytes: frame_bytes, ..self.config.service() };
        let camera = CameraId::new(&self.config.camera.name).map_err(ConfigError::Name)?;
        let publisher = FramePublisher::open_with_slots(&service, camera, slots).map_err(ConfigError::Cell)?;
        Ok(Port { publisher, frame_bytes, slots })
    }

    fn pump(&mut self, source: &mut dyn Source, publisher: &mut FramePublisher) -> Result<(), CameraError> {
        let mut sink = Sink { publisher, look: self.config.report.advice, advice: None, scratch: Vec::new() };
        let mut is_first = true;
        while !self.is_told_to_stop() {
            match source.next(&mut sink, TICK)? {
                Grabbed::Frame { camera_frame } => {
                    self.follow(camera_frame);
                    self.counts.sent += 1;
                    if std::mem::take(&mut is_first) {
                        (self.events)(&Event::Flowing { after: self.gone_since.elapsed() });
                    }
                    (self.events)(&Event::Sent);
                }
                Grabbed::Incomplete { camera_frame, reason } => {
                    self.follow(camera_frame);
                    self.counts.incomplete += 1;
                    (self.events)(&Event::Incomplete { camera_frame, reason: &reason });
                }
                Grabbed::Nothing => {}
            }
            if self.reported.elapsed() >= Duration::from_secs(self.config.report.every_s) {
                self.reported = Instant::now();
                (self.events)(&Event::Status { counts: self.counts, advice: sink.advice.as_ref() });
                sink.advice = None;
                sink.look = self.config.report.advice;
            }
        }
        Ok(())
    }

    fn follow(&mut self, camera_frame: u64) {
        if camera_frame == 0 {
            return;
        }
        let frames = self.gaps.before(camera_frame);
        if frames > 0 {
            self.counts.missing += frames;
            (self.events)(&Event::Missing { frames });
        }
    }

    fn is_told_to_stop(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    fn sleep(&self, pause: Duration) {
        let until = Instant::now() + pause;
        while !self.is_told_to_stop() {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return;
            }
            thread::sleep(left.min(TICK));
        }
    }
}

/// The camera of a configuration, set up.
fn open(config: &ClientConfig) -> Result<Box<dyn Source>, CameraError> {
    match config.camera.driver {
        #[cfg(feature = "aravis")]
        crate::Driver::Genicam => Ok(Box::new(crate::genicam::Genicam::open(config)?)),
        #[cfg(feature = "v4l")]
        crate::Driver::V4l => Ok(Box::new(crate::video::Video::open(config)?)),
        #[allow(unreachable_patterns, reason = "with all features, each driver is there")]
        driver => {
            let built = [("genicam", cfg!(feature = "aravis")), ("v4l", cfg!(feature = "v4l"))];
            let built: Vec<_> = built.iter().filter(|(_, built)| *built).map(|(name, _)| format!("{name:?}")).collect();
            let allowed = match built.is_empty() {
                true => "none: it was built without the features aravis and v4l".to_owned(),
                false => format!("{}, as this program was built", built.join(" and ")),
            };
            Err(refused("[camera] driver", format!("{:?}", driver.to_string()), allowed).into())
        }
    }
}
