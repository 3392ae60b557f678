//! `samsod emulate`: a robot controller without a robot, for those who have none and for tests.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use clap::{Args, Subcommand};
use samsod_robot::emulator::{EmptyTable, Emulator, EmulatorConfig, EmulatorError, FaultScript};
use samsod_robot::{GripperShape, PartTable, PartTableError, PickTolerance, ScaledClock, Workpieces};

use crate::config::{Config, ConfigError};

/// Stand in for a robot controller, as a real server on the network.
#[derive(Debug, Args)]
pub struct EmulateArguments {
    #[command(subcommand)]
    kind: Kind,
}

#[derive(Debug, Subcommand)]
enum Kind {
    /// A Yaskawa controller over its Ethernet Server protocol. Prints where it listens, and runs until SIGINT or SIGTERM.
    Motoman(MotomanArguments),
}

#[derive(Debug, Args)]
struct MotomanArguments {
    /// Where it listens; port 0 takes a free one.
    #[arg(long, value_name = "HOST:PORT", default_value = "127.0.0.1:10080")]
    listen: String,
    /// A table of parts that its gripper can pick; it is replaced at every pick.
    #[arg(long, value_name = "FILE")]
    table: Option<PathBuf>,
    /// Configuration of samsodd: the home and the gripper of the robot, and how far off a pick may be.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Write every command with its time to this file, one line of JSON each.
    #[arg(long, value_name = "FILE")]
    journal: Option<PathBuf>,
    /// Make things go wrong: a fault script, TOML; docs/robot.md says how.
    #[arg(long, value_name = "FILE")]
    faults: Option<PathBuf>,
}

/// Why there is no emulated controller.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EmulateError {
    /// The configuration cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The table cannot be used.
    #[error(transparent)]
    Table(#[from] PartTableError),
    /// The fault script cannot be read.
    #[error("fault script {}: {cause}", path.display())]
    Script {
        /// The file.
        path: PathBuf,
        /// Why.
        cause: String,
    },
    /// The emulator cannot be started.
    #[error(transparent)]
    Emulator(#[from] EmulatorError),
}

/// Runs until `stop` is set. `listening` is told the address once it is taken.
///
/// # Errors
/// [`EmulateError`]
pub fn run(
    arguments: &EmulateArguments,
    stop: &AtomicBool,
    listening: impl FnOnce(std::net::SocketAddr),
) -> Result<usize, EmulateError> {
    let Kind::Motoman(arguments) = &arguments.kind;
    let robot = match &arguments.config {
        Some(file) => Some(Config::read_without_catalogue(file)?.robot),
        None => None,
    };
    let script = match &arguments.faults {
        Some(path) => {
            let fail = |cause: String| EmulateError::Script { path: path.clone(), cause };
            let text = std::fs::read_to_string(path).map_err(|e| fail(e.to_string()))?;
            toml::from_str(&text).map_err(|e| fail(e.to_string()))?
        }
        None => FaultScript::default(),
    };
    let mut config = EmulatorConfig {
        listen: arguments.listen.clone(),
        journal_file: arguments.journal.clone(),
        script,
        ..EmulatorConfig::default()
    };
    let (mut gripper, mut tolerance) = (GripperShape::default(), PickTolerance::default());
    if let Some(robot) = robot {
        (gripper, tolerance) = (robot.gripper, robot.simulated.pick_tolerance);
        (config.home, config.tool_length_mm) = (robot.home, robot.tool_length_mm);
        config.gripper_time_ms = robot.simulated.gripper_time_ms;
    }
    let table = arguments.table.as_ref().map(|path| PartTable::open(path, gripper, tolerance)).transpose()?;
    let workpieces: Box<dyn Workpieces> = match table.clone() {
        Some(table) => Box::new(table),
        None => Box::new(EmptyTable),
    };
    let emulator = Emulator::start(config, ScaledClock::new(1.0), workpieces)?;
    listening(emulator.address());
    while !stop.load(Ordering::Relaxed) {
        std::thread::sleep(Duration::from_millis(50));
    }
    let commands = emulator.stop().len();
    match table.and_then(|table| table.failure()) {
        Some(failure) => Err(failure.into()),
        None => Ok(commands),
    }
}
