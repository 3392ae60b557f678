//! Recordings: every stage of every frame, every command and what became of it, in MCAP files.
//!
//! [`Recorder`] takes what happens from the threads of the service and never makes the vision thread wait: a frame
//! is copied into a recycled buffer and written by a thread of its own; when that thread lags behind by
//! `queue_frames`, frames are dropped and counted. Commands are never dropped: [`Recorder::log_command`] returns when
//! the command is written and handed to the operating system, so that no command leaves before it is in the file. (It
//! survives the death of the process, not a loss of power.)
//!
//! A disk that is full, fails or hangs is told at once, and what then happens to the robot is told by
//! [`OnLogFailure`]; meanwhile a new file is tried again and again, so that a disk that has come back is used.
//!
//! [`survey`] and [`frames`] read recordings, whole or cut off; [`recover`] makes a whole one of what is left;
//! [`made_with()`] says what one was made with.
//!
//! | topic | message | when |
//! |---|---|---|
//! | `/camera/image` | `foxglove.CompressedImage` (png, jpeg) or `foxglove.RawImage` (rgb8) | each frame |
//! | `/segment/labels` | `foxglove.RawImage`, mono16; 32FC1 (whole numbers) beyond 65 536 labels | each frame |
//! | `/saliency` | `foxglove.RawImage`, mono8 (255 S) or 32FC1 | each frame |
//! | `/regions` | `foxglove.ImageAnnotations`, outline and number of each region | each frame |
//! | `/detections` | `foxglove.ImageAnnotations`, outline, name, score and axis of each detection | each frame |
//! | `/masks` | `foxglove.RawImage`, mono8, codes of [`masks`](crate::masks) | each frame |
//! | `/outlines` | `foxglove.ImageAnnotations`, outline, number and place of each object | each frame |
//! | `/places` | `foxglove.PosesInFrame` in `world`, metres | each frame that is placed |
//! | `/tf` | `foxglove.FrameTransforms`, `world` in `robot_base` | each frame placed at the robot |
//! | `/scene` | `samsod.Scene` (JSON), figures of each region, object and detection | each frame |
//! | `/stage/timings` | `samsod.StageTimings` (JSON), ms | each frame |
//! | `/pick/target` | `foxglove.PoseInFrame`, metres | each command that moves the tool |
//! | `/robot/command`, `/robot/outcome` | `samsod.Command`, `samsod.Outcome` (JSON) | each command; each news of it |
//! | `/robot/state` | `samsod.RobotState` (JSON) | as polled |
//! | `/robot/pick`, `/robot/fault` | `samsod.Pick`, `samsod.Fault` (JSON) | each pick; each fault |
//! | `/robot/wire` | `samsod.Wire` (JSON) | bytes to and from a controller over a network |
//! | `/log` | `foxglove.Log` | as it happens |
//!
//! Times are nanoseconds since the Unix epoch; everything that belongs to a frame carries the frame's own time.

mod detections;
mod disk;
mod frame_reader;
mod live;
mod messages;
mod objects;
mod reader;
mod recorder;
mod retention;
mod stage_messages;
mod trouble;
mod writer;

#[cfg(test)]
mod failing_disk;
#[cfg(test)]
mod recover_tests;
#[cfg(test)]
mod tests;

use std::path::PathBuf;

pub use samsod_recording::{Loss, ReadError, RecoverError, RecoveredTopic, Recovery, recover, recovered_path};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

pub(crate) use detections::DetectionMessage;
#[cfg(test)]
pub(crate) use disk::faults;
pub use frame_reader::made_with;
pub(crate) use frame_reader::{FrameReader, RecordedFrame, Target, mask_codes, targets};
pub(crate) use live::LiveView;
pub use live::{FoxgloveConfig, LiveViewError};
pub use messages::LogLevel;
pub(crate) use messages::{RegionMessage, SceneMessage};
pub(crate) use objects::ObjectMessage;
pub use reader::{FrameStages, SeenDetection, StageStatistics, Survey, TopicSurvey, frames, survey};
pub(crate) use recorder::RecorderView;
pub use recorder::{CommandRecord, FrameRecord, OutcomeRecord, Recorder};
pub(crate) use stage_messages::stage_messages;
pub(crate) use trouble::Trouble;

/// What is recorded and where.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RecorderConfig {
    /// Folder of the recordings; it is made if it does not exist.
    pub folder: PathBuf,
    /// Frames that may wait for the writer before further ones are dropped; at least 1. Each costs 6 bytes a pixel,
    /// and one more for the pixels of the boxes of objects and of their shadows.
    pub queue_frames: usize,
    /// How the camera image is written.
    pub image_encoding: ImageEncoding,
    /// Quality of `jpeg`, 1 to 100.
    pub jpeg_quality: u8,
    /// How the saliency map is written.
    pub saliency_encoding: SaliencyEncoding,
    /// Size from which on a new file is begun, MiB; at least 16.
    pub max_file_mib: u64,
    /// Age from which on a new file is begun, minutes; with 0, size alone decides.
    pub max_file_minutes: u64,
    /// Recordings of this cell are deleted so many days after they were last written to; with 0, never.
    pub keep_days: u64,
    /// Recordings of this cell are deleted, oldest first, while together they are larger, MiB; with 0, never. Otherwise at
    /// least `max_file_mib`.
    pub keep_mib: u64,
    /// Free space of the file system below which frames are no longer written, MiB. It is left to commands and lines.
    pub min_free_mib: u64,
    /// What the robot does while recording fails or is short of space.
    pub on_log_failure: OnLogFailure,
}

impl Default for RecorderConfig {
    fn default() -> Self {
        Self {
            folder: PathBuf::from("recordings"),
            queue_frames: 4,
            image_encoding: ImageEncoding::default(),
            jpeg_quality: 90,
            saliency_encoding: SaliencyEncoding::default(),
            max_file_mib: 4096,
            max_file_minutes: 60,
            keep_days: 0,
            keep_mib: 0,
            min_free_mib: 2048,
            on_log_failure: OnLogFailure::default(),
        }
    }
}

impl RecorderConfig {
    /// Checks every number.
    ///
    /// # Errors
    /// [`RecordError::Config`] names the key, its value and what is allowed.
    pub fn check(&self) -> Result<(), RecordError> {
        let least_kept = if self.keep_mib == 0 { 0 } else { self.max_file_mib };
        let keys: [(&'static str, u64, std::ops::RangeInclusive<u64>, &'static str); 6] = [
            ("queue_frames", self.queue_frames as u64, 1..=64, "1 to 64"),
            ("jpeg_quality", self.jpeg_quality.into(), 1..=100, "1 to 100"),
            ("max_file_mib", self.max_file_mib, 16..=1 << 30, "16 to 1073741824"),
            ("max_file_minutes", self.max_file_minutes, 0..=525_600, "0 to 525600"),
            ("keep_days", self.keep_days, 0..=36_500, "0 to 36500"),
            ("keep_mib", self.keep_mib, least_kept..=1 << 40, "0, or max_file_mib to 1099511627776"),
        ];
        match keys.into_iter().find(|(_, value, allowed, _)| !allowed.contains(value)) {
            Some((key, value, _, allowed)) => Err(RecordError::Config { key, value, allowed }),
            None => Ok(()),
        }
    }
}

/// What the robot does while recording fails or is short of space.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum OnLogFailure {
    /// It ends the motion in flight and is held. When the recording is well again, an operator resumes it.
    #[default]
    Hold,
    /// It goes on; commands that are not recorded are counted and told.
    Continue,
}

/// How the camera image is written; docs/recording.md has the figures.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ImageEncoding {
    /// Lossless, fast deflate: 1.3 MB for 1078 x 958.
    #[default]
    Png,
    /// Lossy, 4:2:0: a sixth of the space of PNG.
    Jpeg,
    /// Bytes as they came, in lz4 chunks: twice the space of PNG.
    Raw,
}

/// How the saliency map is written.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub enum SaliencyEncoding {
    /// One byte a pixel, 255 S rounded: what a viewer needs. `/scene` has the exact mean of each region.
    #[default]
    #[serde(rename = "mono8")]
    Mono8,
    /// The map as it was computed; it hardly compresses: 4.1 MB for 1078 x 958.
    #[serde(rename = "32FC1")]
    Float32,
}

/// Why something could not be recorded.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordError {
    /// A number of the configuration is out of range.
    #[error("{key} = {value}; allowed is {allowed}")]
    Config {
        /// The key.
        key: &'static str,
        /// Its value.
        value: u64,
        /// What is allowed.
        allowed: &'static str,
    },
    /// The folder cannot be made or written to.
    #[error("cannot write recordings to {}: {cause}", path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// What the system said.
        #[source]
        cause: std::io::Error,
    },
    /// A file could not be written any further.
    #[error("recording {} failed: {cause}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system said.
        cause: String,
    },
    /// A command is not taken while the recording is not as it should be.
    #[error("{cause}")]
    Held {
        /// What is wrong with it.
        cause: String,
    },
    /// A message cannot be encoded.
    #[error("cannot encode a message on {topic}: {cause}")]
    Encode {
        /// The topic.
        topic: &'static str,
        /// Why.
        cause: String,
    },
    /// The writer thread could not be started or is gone.
    #[error("the writer of recording {} is gone: {cause}", path.display())]
    Writer {
        /// The file.
        path: PathBuf,
        /// What is known.
        cause: String,
    },
}

/// What a recording holds so far.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RecordingSummary {
    /// The files, in their order.
    pub files: Vec<PathBuf>,
    /// Frames in them.
    pub frames_written: u64,
    /// Frames lost because the writer lagged behind.
    pub frames_dropped: u64,
    /// Frames left out because the file system was nearly full, or lost to a failure to write.
    pub frames_not_written: u64,
    /// Commands in them.
    pub commands: u64,
    /// Commands that were given without being in them: `on_log_failure = "continue"`.
    pub commands_not_written: u64,
    /// Robot states and log lines lost because the writer lagged behind.
    pub lines_dropped: u64,
    /// Lines of any kind lost to a failure to write.
    pub lines_not_written: u64,
    /// How often writing has failed.
    pub failures: u64,
    /// Older recordings that were deleted: `keep_days`, `keep_mib`.
    pub files_deleted: u64,
    /// Size of the files, bytes.
    pub bytes: u64,
}

impl RecordingSummary {
    /// Whether anything is missing that a recording promises. Frames that were dropped because the writer lagged behind are
    /// counted, and not promised.
    pub fn has_lost_data(&self) -> bool {
        let Self { frames_not_written, commands_not_written, lines_not_written, failures, .. } = *self;
        frames_not_written + commands_not_written + lines_not_written + failures > 0
    }
}

impl std::fmt::Display for RecordingSummary {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "{} frames ({} dropped, {} not written), {} commands, {:.1} MB",
            self.frames_written,
            self.frames_dropped,
            self.frames_not_written,
            self.commands,
            self.bytes as f64 / 1e6
        )?;
        for (count, what) in [
            (self.commands_not_written, "commands not written"),
            (self.lines_not_written, "lines not written"),
            (self.failures, "failures to write"),
            (self.files_deleted, "old recordings deleted"),
        ] {
            if count > 0 {
                write!(f, ", {count} {what}")?;
            }
        }
        self.files.iter().try_for_each(|file| write!(f, "\n  {}", file.display()))
    }
}
