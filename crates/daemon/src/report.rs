//! What the service did, as it is told at its end.

use std::fmt;
use std::time::Duration;

use samsod_frame::{FrameCounts, ReceiveError};

use samsod_robot::{PickResult, SequenceFault, SequenceState};

use crate::commander::RobotReport;
use crate::durations::Durations;
use crate::recording::{RecordError, RecordingSummary};

/// Why the service ended.
#[derive(Debug)]
pub enum End {
    /// The number of frames it was asked for is done.
    Frames,
    /// It was told to by a signal.
    Stopped,
    /// Every slot of the jig is filled.
    JigFull,
    /// The robot stands until an operator resumes.
    RobotFault(SequenceFault),
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
    /// How the robot and its work stand, or why it is not commanded.
    pub robot: Result<RobotReport, NotCommanded>,
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
    /// Frames that vision was at when the service had to end.
    pub unfinished: u64,
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
            End::JigFull => "the jig is full".to_owned(),
            End::RobotFault(fault) => format!("the robot stands: {fault}"),
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
            vision.failed + vision.panicked + vision.unfinished
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
        match &self.robot {
            Ok(robot) => write_robot(f, robot)?,
            Err(reason) => writeln!(f, "commands   none, {reason}")?,
        }
        match &self.recording {
            Ok(summary) => write!(f, "recording  {summary}"),
            Err(e) => write!(f, "recording  incomplete: {e}"),
        }
    }
}

fn write_robot(f: &mut fmt::Formatter<'_>, robot: &RobotReport) -> fmt::Result {
    let c = &robot.commands;
    writeln!(
        f,
        "commands   sent {}  done {}  not executed {}  aborted {}  unknown {}",
        c.sent, c.done, c.not_executed, c.aborted, c.unknown
    )?;
    if robot.sequence.is_none() {
        return Ok(());
    }
    for pick in &robot.picks {
        let (slot, part) = (pick.slot + 1, &pick.part);
        let result = match &pick.result {
            PickResult::Placed => "placed".to_owned(),
            PickResult::Missed => "missed".to_owned(),
            PickResult::NotReached { reason } => format!("not reached: {reason}"),
        };
        let (score, gap, waited, took) = (pick.score, pick.gap_ms, pick.waited_ms, pick.took_ms);
        writeln!(
            f,
            "slot {slot:>2}    {part:<16} score {score:.2}  frame to command {gap:>6.0} ms  waited {waited:>6.0} ms  took {took:>6.0} ms  {result}"
        )?;
    }
    let (filled, slots) = (robot.filled.iter().filter(|filled| **filled).count(), robot.filled.len());
    writeln!(f, "jig        {filled} of {slots} slots filled")?;
    let spread = |name: &str, values: &mut Vec<f64>, f: &mut fmt::Formatter<'_>| {
        values.sort_by(f64::total_cmp);
        let at = |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
        if values.is_empty() {
            return Ok(());
        }
        writeln!(f, "{name:<10} {:>12.1} ms median {:>12.1} ms p99", at(0.5), at(0.99))
    };
    spread("gap", &mut robot.picks.iter().map(|pick| pick.gap_ms).collect(), f)?;
    spread("waited", &mut robot.picks.iter().map(|pick| pick.waited_ms).collect(), f)?;
    spread("a part", &mut robot.picks.iter().map(|pick| pick.took_ms).collect(), f)?;
    for reason in &robot.passed_over {
        writeln!(f, "passed over  {reason}")?;
    }
    match &robot.sequence {
        Some(SequenceState::Faulted(fault)) => writeln!(f, "fault      {fault}"),
        Some(SequenceState::Stopped { holds }) => writeln!(f, "stopped    {holds}"),
        _ => Ok(()),
    }
}
