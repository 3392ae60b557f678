//! The twin as a camera client: frames of the table as it lies, through shared memory, until it is told to stop.

use std::fmt;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use samsod_frame::{CameraId, FramePublisher, FrameServiceConfig, PixelFormat, unix_time_ns};
use samsod_robot::{PartTableError, TableState};

use super::{Composed, Twin, TwinError};
use crate::publish::{LINGER, PublishError, RATE_HZ, sleep_until, wait_for_subscriber};

/// What is published, and how fast.
#[derive(Debug, Clone, PartialEq)]
pub struct RunOptions {
    /// The table file.
    pub table: PathBuf,
    /// Which cell gets the frames.
    pub service: FrameServiceConfig,
    /// Frames a second, 0.001 to 1000.
    pub rate_hz: f64,
    /// How many frames; without it, until it is stopped.
    pub count: Option<u64>,
    /// How long to wait for the first subscriber.
    pub wait: Duration,
    /// Name of the camera, at most 31 bytes.
    pub camera: String,
}

/// What happens on the way.
#[derive(Debug)]
pub enum RunEvent<'a> {
    /// The first table is composed and a subscriber is waited for.
    Waiting,
    /// The table has changed and was composed anew.
    Changed {
        /// Parts in view, and those drawn anew.
        composed: Composed,
        /// Parts in the file.
        parts: usize,
        /// What that took.
        took: Duration,
    },
    /// The table cannot be used, and no frame is sent until it can: told once.
    Withheld {
        /// Why.
        reason: &'a TwinError,
    },
    /// A frame was sent.
    Sent {
        /// Frames sent so far.
        sent: u64,
        /// Time from the first frame.
        elapsed: Duration,
    },
}

/// What was sent.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct RunSummary {
    /// Frames sent.
    pub sent: u64,
    /// Tables composed, the first included.
    pub tables: u64,
    /// Frames that were not sent because the table could not be used.
    pub withheld: u64,
    /// Frames that were late by more than a period.
    pub late: u64,
    /// Time from the first frame to the last.
    pub elapsed: Duration,
}

impl fmt::Display for RunSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = self.elapsed.as_secs_f64();
        let rate = if self.sent > 1 && seconds > 0.0 { (self.sent - 1) as f64 / seconds } else { 0.0 };
        let Self { sent, tables, withheld, late, .. } = self;
        write!(
            f,
            "{sent} frames of {tables} tables sent in {seconds:.1} s ({rate:.1} Hz); {late} late, {withheld} withheld"
        )
    }
}

/// Publishes frames of the table until `count` are sent or `stop` is set.
///
/// The time of a frame is taken before the table is read, as that of a camera is before what it sees: a part that was taken
/// by then is not in it. A table that cannot be used later on ends nothing; no frame is sent meanwhile, as none would be true.
///
/// # Errors
/// [`TwinError`]: a table that cannot be used at the start, and what [`crate::publish::run`] fails by.
pub fn run(
    twin: &mut Twin,
    options: &RunOptions,
    stop: &AtomicBool,
    events: &mut dyn FnMut(&RunEvent<'_>),
) -> Result<RunSummary, TwinError> {
    // NaN is in no range. A period beyond the least rate would not fit into a duration.
    if !(RATE_HZ.0..=RATE_HZ.1).contains(&options.rate_hz) {
        return Err(PublishError::Rate { rate_hz: options.rate_hz }.into());
    }
    let camera = CameraId::new(&options.camera).map_err(PublishError::Camera)?;
    let mut summary = RunSummary::default();
    let mut shown = Vec::new();
    update(twin, options, &mut shown, &mut summary, events)?;
    let [width, height] = twin.size_px();
    let bytes = width as usize * height as usize * 3;
    let service = FrameServiceConfig { max_frame_bytes: bytes, ..options.service.clone() };
    let mut publisher = FramePublisher::open(&service, camera).map_err(PublishError::from)?;
    events(&RunEvent::Waiting);
    if !wait_for_subscriber(&publisher, &options.service.cell, options.wait, stop)? {
        return Ok(summary);
    }

    let period = Duration::from_secs_f64(1.0 / options.rate_hz);
    let (mut first, mut due, mut is_withheld) = (None, Instant::now(), false);
    while options.count.is_none_or(|count| summary.sent < count) && sleep_until(due, stop) {
        let timestamp_ns = unix_time_ns();
        match update(twin, options, &mut shown, &mut summary, events) {
            Ok(()) => is_withheld = false,
            Err(reason) => {
                if !is_withheld {
                    events(&RunEvent::Withheld { reason: &reason });
                }
                is_withheld = true;
                summary.withheld += 1;
            }
        }
        if !is_withheld {
            let mut loan = publisher.loan(width, height, PixelFormat::Rgb8).map_err(PublishError::from)?;
            twin.expose(summary.sent, loan.pixels());
            loan.set_timestamp_ns(timestamp_ns);
            loan.send().map_err(PublishError::from)?;
            let now = Instant::now();
            summary.sent += 1;
            summary.elapsed = now - *first.get_or_insert(now);
            events(&RunEvent::Sent { sent: summary.sent, elapsed: summary.elapsed });
        }
        due += period;
        if Instant::now() > due {
            // Late by more than a period: go on from here rather than send a burst.
            summary.late += 1;
            due = Instant::now();
        }
    }
    if !stop.load(Ordering::Relaxed) {
        sleep_until(Instant::now() + LINGER, stop);
    }
    Ok(summary)
}

/// Reads the table, and composes it if it has changed.
///
/// # Arguments
/// * `shown` - the file whose table the twin shows; empty, which no table is, at first
fn update(
    twin: &mut Twin,
    options: &RunOptions,
    shown: &mut Vec<u8>,
    summary: &mut RunSummary,
    events: &mut dyn FnMut(&RunEvent<'_>),
) -> Result<(), TwinError> {
    let path = &options.table;
    // Some kilobytes. Times of files are too coarse to tell whether one was replaced.
    let bytes =
        std::fs::read(path).map_err(|source| PartTableError::Read { path: path.clone(), cause: source.to_string() })?;
    if !bytes.is_empty() && bytes == *shown {
        return Ok(());
    }
    let start = Instant::now();
    let table = TableState::parse(path, &bytes)?;
    let composed = twin.compose(&table)?;
    *shown = bytes;
    summary.tables += 1;
    events(&RunEvent::Changed { composed, parts: table.parts.len(), took: start.elapsed() });
    Ok(())
}
