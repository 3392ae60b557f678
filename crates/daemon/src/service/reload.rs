//! A new configuration for a service that runs.
//!
//! In: the file, read again when somebody asks (SIGHUP). Out: what vision and robot go on with, from one frame to the next.
//!
//! ```text
//! asked -> read and checked, the chain made (a thread of its own; frames go on)
//!       -> the robot takes its part when no motion and no pick is under way; until then it is shown nothing new
//!       -> vision takes its part before the next frame, which begins a new file of the recording
//! ```
//!
//! A file that is wrong is refused, and so is one that changes a key that needs a restart: what is in force is always one file
//! as a whole.

use std::mem;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{self, Receiver, TryRecvError};
use std::thread;

use samsod_robot::Limits;
use tracing::{error, info};

use super::{Vision, task_of};
use crate::commander::{Commander, RobotSettings};
use crate::config::{Config, ConfigError, ControllerKind};
use crate::config_changes::{ConfigChange, config_changes};
use crate::interest::Interest;
use crate::made_with::MadeWith;
use crate::place::Placer;

/// Keys and sections that may change while the service runs; every other one needs a restart.
const RELOADED: [&str; 19] = [
    "camera",
    "catalogue",
    "frames.max_height_px",
    "frames.max_width_px",
    "jig.unknown_height_mm",
    "recognize",
    "regions",
    "robot.clearance_mm",
    "robot.grasp_height_mm",
    "robot.gripper_timeout_ms",
    "robot.joint_speed_fraction",
    "robot.limits",
    "robot.linear_speed_mm_s",
    "robot.motion_timeout_ms",
    "robot.poll_interval_ms",
    "robot.safe_height_mm",
    "saliency",
    "segment",
    "shadow",
];

/// Who asks for a new configuration, and where it stands.
#[derive(Debug, Clone)]
pub struct Reload {
    /// Set when the file is to be read again; cleared when that begins.
    pub asked: Arc<AtomicBool>,
    /// The file.
    pub file: PathBuf,
}

/// Why a new configuration is not taken.
#[derive(Debug, thiserror::Error)]
enum ReloadError {
    /// The file is wrong, or what it names.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// It changes what cannot change while the service runs.
    #[error("these need a restart, so nothing was changed: {}", list(.0))]
    NeedsRestart(Vec<ConfigChange>),
    /// The robot would have to be begun, or ended.
    #[error(
        "[camera] or [view]: whether it is known where the robot stands cannot change while the service runs; that needs a \
         restart, so nothing was changed"
    )]
    RobotPlace,
    /// The thread that reads it ended by itself.
    #[error("reading it has panicked")]
    Panicked,
    /// The thread that reads it cannot be started.
    #[error("cannot start the reload thread: {0}")]
    Thread(std::io::Error),
}

fn list(changes: &[ConfigChange]) -> String {
    changes.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
}

/// A configuration that is ready to be gone on with.
pub(super) struct Prepared {
    config: Config,
    pub(super) vision: Vision,
    pub(super) made_with: Arc<MadeWith>,
    /// What is otherwise than before, in words.
    pub(super) changes: Vec<String>,
    robot: Option<RobotSettings>,
}

/// What came of reading the file; nothing if it says what is in force.
type Made = Result<Option<Box<Prepared>>, ReloadError>;

enum Stage {
    Rests,
    Reads(Receiver<Made>),
    WaitsForRobot(Box<Prepared>, Receiver<()>),
}

/// Watches for requests, and sees them through.
pub(super) struct Reloader {
    reload: Reload,
    /// What is in force.
    config: Config,
    made_with: Arc<MadeWith>,
    interest: Arc<Interest>,
    stage: Stage,
    pub(super) counts: ReloadCounts,
}

/// What became of the requests.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct ReloadCounts {
    pub(crate) done: u64,
    pub(crate) refused: u64,
}

impl Reloader {
    pub(super) fn new(reload: Reload, config: &Config, made_with: Arc<MadeWith>, interest: Arc<Interest>) -> Self {
        let counts = ReloadCounts::default();
        Self { reload, config: config.clone(), made_with, interest, stage: Stage::Rests, counts }
    }

    /// Goes on as far as it can without waiting. Call it between two frames; what it returns is to be gone on with at once.
    pub(super) fn step(&mut self, vision: &Vision, commander: Option<&Commander>) -> Option<Prepared> {
        loop {
            match mem::replace(&mut self.stage, Stage::Rests) {
                Stage::Rests => {
                    if !self.reload.asked.swap(false, Ordering::SeqCst) {
                        return None;
                    }
                    info!(file = %self.reload.file.display(), "the configuration is read again");
                    match self.begin(vision.base_from_world.is_some()) {
                        Ok(made) => self.stage = Stage::Reads(made),
                        Err(e) => self.refuse(&e),
                    }
                    return None;
                }
                Stage::Reads(made) => match made.try_recv() {
                    Err(TryRecvError::Empty) => {
                        self.stage = Stage::Reads(made);
                        return None;
                    }
                    Err(TryRecvError::Disconnected) => self.refuse(&ReloadError::Panicked),
                    Ok(Err(e)) => self.refuse(&e),
                    Ok(Ok(None)) => {
                        info!(configuration = self.made_with.digest(), "the configuration has not changed");
                        self.counts.done += 1;
                    }
                    Ok(Ok(Some(mut prepared))) => match (commander, prepared.robot.take()) {
                        (Some(commander), Some(settings)) => {
                            info!("the new configuration waits until no motion and no pick is under way");
                            self.stage = Stage::WaitsForRobot(prepared, commander.change(settings));
                        }
                        _ => return Some(self.take(*prepared)),
                    },
                },
                Stage::WaitsForRobot(prepared, taken) => match taken.try_recv() {
                    Err(TryRecvError::Empty) => {
                        self.stage = Stage::WaitsForRobot(prepared, taken);
                        return None;
                    }
                    // A robot thread that has ended moves nothing any more.
                    Ok(()) | Err(TryRecvError::Disconnected) => return Some(self.take(*prepared)),
                },
            }
        }
    }

    fn take(&mut self, prepared: Prepared) -> Prepared {
        self.config = prepared.config.clone();
        self.made_with = Arc::clone(&prepared.made_with);
        self.counts.done += 1;
        prepared
    }

    fn refuse(&mut self, reason: &ReloadError) {
        self.counts.refused += 1;
        let configuration = self.made_with.digest();
        error!(file = %self.reload.file.display(), configuration, %reason, "the configuration is refused; the old one stays");
    }

    fn begin(&self, knows_base: bool) -> Result<Receiver<Made>, ReloadError> {
        let (sender, made) = mpsc::sync_channel(1);
        let (file, config, made_with) = (self.reload.file.to_owned(), self.config.clone(), Arc::clone(&self.made_with));
        let interest = Arc::clone(&self.interest);
        let run = move || {
            // The service may have ended meanwhile.
            let _ = sender.send(prepare(&file, &config, &made_with, interest, knows_base));
        };
        thread::Builder::new().name("reload".to_owned()).spawn(run).map_err(ReloadError::Thread)?;
        Ok(made)
    }
}

/// Reads a file and makes all that follows from it.
fn prepare(file: &Path, old: &Config, made_with: &MadeWith, interest: Arc<Interest>, knew_base: bool) -> Made {
    let config = Config::read(file)?;
    let changes = config_changes(old, &config).map_err(ConfigError::Print)?;
    let fixed: Vec<_> = changes.iter().filter(|change| !is_reloaded(&change.key)).cloned().collect();
    if !fixed.is_empty() {
        return Err(ReloadError::NeedsRestart(fixed));
    }
    let placer = config.placer()?;
    let base_from_world = placer.as_ref().and_then(Placer::base_from_world);
    if config.robot.controller != ControllerKind::None && knew_base != base_from_world.is_some() {
        return Err(ReloadError::RobotPlace);
    }
    let vision = Vision::new(&config, placer, interest)?;
    let now = MadeWith::new(&config, vision.catalogue.as_ref())?;
    if now.is_set_up_as(made_with) {
        return Ok(None);
    }
    let mut words: Vec<String> = changes.iter().map(ToString::to_string).collect();
    if now.camera != made_with.camera && !changes.iter().any(|change| change.key == "camera.file") {
        words.push("[camera] file: what stands in it".to_owned());
    }
    words.extend(made_with.other_parts(&now.catalogue));
    let limits: Limits = config.robot.limits;
    let robot = Some(RobotSettings { limits, task: task_of(&config, base_from_world) });
    Ok(Some(Box::new(Prepared { config, vision, made_with: Arc::new(now), changes: words, robot })))
}

/// Whether a key may change while the service runs.
fn is_reloaded(key: &str) -> bool {
    // A view is a section that may be missing as a whole.
    RELOADED
        .iter()
        .chain(&["view"])
        .any(|name| key.strip_prefix(name).is_some_and(|rest| rest.is_empty() || rest.starts_with('.')))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_told_from_those_that_only_begin_alike() {
        for key in ["segment.range_bandwidth", "robot.limits.score_min", "view.mm_per_px", "robot.clearance_mm"] {
            assert!(is_reloaded(key), "{key}");
        }
        for key in
            ["recording.folder", "robot.armed", "robot.simulated.clock_rate", "cell.name", "jig.order", "segments.a"]
        {
            assert!(!is_reloaded(key), "{key}");
        }
    }

    #[test]
    fn every_key_named_is_one() {
        let all = toml::Value::try_from(Config::default()).unwrap();
        for name in RELOADED {
            let found = name.split('.').try_fold(&all, |value, part| value.get(part));
            assert!(found.is_some(), "{name}");
        }
    }
}
