//! What the service did, as it is told at its end.

use std::fmt;
use std::time::Duration;

use samsod_frame::{FrameCounts, ReceiveError};

use crate::commander::CommandCounts;
use crate::durations::Durations;
use crate::recording::{RecordError, RecordingSummary};

/// Why the service ended.
#[derive(Debug)]
pub enum End {
    /// The number of frames it was asked for is done.
    Frames,
    /// It was told to by a signal.
    Stopped,
    /// The shared memory failed.
    Failed(ReceiveError),
}

/// What the service did.
#[derive(Debug)]
pub struct Report {
    /// Name of the cell.
    pub cell: String,
    /// Why it ended.
    pub end: End,
    /// From ready to end.
    pub elapsed: Duration,
    /// Frames as the subscriber counts them.
    pub frames: FrameCounts,
    /// Frames and stages as vision counts them.
    pub vision: VisionCounts,
    /// Commands, or why none is given.
    pub commands: Result<CommandCounts, NotCommanded>,
    /// The recording, or what its writer met.
    pub recording: Result<RecordingSummary, RecordError>,
    /// Parts of the catalogue, in a cell that has one.
    pub parts: Option<usize>,
    pub(crate) times: Vec<(&'static str, Durations)>,
}

/// Why the robot gets no commands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum NotCommanded {
    /// `[robot] controller = "none"`.
    #[error("no robot")]
    NoRobot,
    /// Nothing takes pixels to millimetres.
    #[error("neither [camera] file nor [view] is given")]
    NoCamera,
    /// The camera file does not say where the robot stands.
    #[error("the camera file has no [base]: touch points of the table with `samsod calibrate touch`")]
    NoBase,
}

/// What vision did with the frames it was handed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct VisionCounts {
    /// Frames inspected.
    pub processed: u64,
    /// Frames larger than the configuration allows.
    pub too_large: u64,
    /// Frames of another size than the calibrated camera's.
    pub wrong_size: u64,
    /// Frames on which the vision chain reported an error.
    pub failed: u64,
    /// Frames on which the vision chain panicked.
    pub panicked: u64,
    /// Salient regions found.
    pub regions: u64,
    /// Objects found.
    pub objects: u64,
    /// Objects with a place on the table.
    pub placed: u64,
    /// Parts recognised.
    pub recognized: u64,
    /// Objects that are no part of the catalogue, or not for certain.
    pub unknown: u64,
}

impl Report {
    /// Median and 99th percentile of a stage (`transport`, `segment`, ..), if any frame went through it.
    pub fn stage(&self, name: &str) -> Option<(Duration, Duration)> {
        let (_, times) = self.times.iter().find(|(stage, times)| *stage == name && times.count() > 0)?;
        Some((times.quantile(0.5), times.quantile(0.99)))
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let end = match &self.end {
            End::Frames => "all frames done".to_owned(),
            End::Stopped => "stopped".to_owned(),
            End::Failed(e) => format!("failed: {e}"),
        };
        let (frames, vision) = (&self.frames, &self.vision);
        writeln!(f, "cell {}: {end} after {:.1} s", self.cell, self.elapsed.as_secs_f64())?;
        writeln!(
            f,
            "frames     received {}  processed {}  dropped {}  rejected {}  failed {}",
            frames.received,
            vision.processed,
            frames.dropped,
            frames.rejected + vision.too_large + vision.wrong_size,
            vision.failed + vision.panicked
        )?;
        let per_frame = |count: u64| count as f64 / vision.processed.max(1) as f64;
        writeln!(f, "regions    {} ({:.1} a frame)", vision.regions, per_frame(vision.regions))?;
        let (objects, placed) = (vision.objects, vision.placed);
        writeln!(f, "objects    {objects} ({:.1} a frame), {placed} placed in mm", per_frame(objects))?;
        if let Some(parts) = self.parts {
            let (recognized, unknown) = (vision.recognized, vision.unknown);
            writeln!(f, "parts      {recognized} recognised, {unknown} unknown; the catalogue has {parts}")?;
        }
        writeln!(f, "stage      {:>12} {:>12} {:>12}", "median ms", "p99 ms", "max ms")?;
        for (stage, times) in self.times.iter().filter(|(_, times)| times.count() > 0) {
            let ms = |d: Duration| d.as_secs_f64() * 1e3;
            let (median, p99) = (times.quantile(0.5), times.quantile(0.99));
            writeln!(f, "{stage:<10} {:>12.3} {:>12.3} {:>12.3}", ms(median), ms(p99), ms(times.max()))?;
        }
        match &self.commands {
            Ok(c) => writeln!(
                f,
                "commands   sent {}  done {}  not executed {}  aborted {}  unknown {}",
                c.sent, c.done, c.not_executed, c.aborted, c.unknown
            )?,
            Err(reason) => writeln!(f, "commands   none, {reason}")?,
        }
        match &self.recording {
            Ok(summary) => write!(f, "recording  {summary}"),
            Err(e) => write!(f, "recording  incomplete: {e}"),
        }
    }
}
