//! `samsodd`: the vision service of a robot cell.

use std::io::{self, Write};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use clap::Parser;
use rustix::fs::Mode;
use rustix::process::umask;
use samsod_daemon::config::{Config, LogConfig};
use samsod_daemon::config_schema;
use samsod_daemon::daemon_arguments::DaemonArguments;
use samsod_daemon::journal::{self, Journal};
use samsod_daemon::service::{self, End, Reload, RunOptions, StartError};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::flag;
use tracing::{error, info};
use tracing_subscriber::EnvFilter;
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

/// The service started and then failed, or could not start.
const FAILED: u8 = 1;
/// The configuration is wrong; also what clap ends with on wrong arguments.
const BAD_CONFIG: u8 = 2;
/// It ended as asked, but the recording lacks something.
const DATA_LOST: u8 = 3;
/// Another samsodd serves the cell.
const CELL_TAKEN: u8 = 4;
/// The robot stands until an operator resumes.
const ROBOT_FAULT: u8 = 5;
/// A second signal came before it had ended.
const IMPATIENT: i32 = 130;

fn main() -> ExitCode {
    // Frames are in what it writes, and whoever may write to its socket moves the robot: nothing of it is for others.
    umask(Mode::RWXG | Mode::RWXO);
    let arguments = DaemonArguments::parse();
    if arguments.config_schema {
        return print(&config_schema::text(), ExitCode::SUCCESS);
    }
    // Without a schema to print, clap has seen to it that there is one.
    let file = arguments.config.unwrap_or_default();
    let config = match Config::read(&file) {
        Ok(config) => config,
        Err(e) => return fail(BAD_CONFIG, &e),
    };
    if arguments.check_config {
        return match config.to_toml() {
            Ok(text) => print(&text, ExitCode::SUCCESS),
            Err(e) => fail(BAD_CONFIG, &e),
        };
    }
    start_log(config.log);
    let (stop, reload) = match (catch_signals(), catch_reload()) {
        (Ok(stop), Ok(reload)) => (stop, reload),
        (Err(e), _) | (_, Err(e)) => return fail(FAILED, &e),
    };
    let options = RunOptions { frames: arguments.frames, until_jig_is_full: arguments.until_jig_is_full };
    match service::run_with_reload(&config, options, &stop, Some(Reload { asked: reload, file })) {
        Ok(report) => {
            let code = match (&report.end, &report.recording) {
                (End::Failed(_), _) => ExitCode::from(FAILED),
                (End::RobotFault(_), _) => ExitCode::from(ROBOT_FAULT),
                (_, Err(_)) => ExitCode::from(DATA_LOST),
                (_, Ok(recording)) if recording.has_lost_data() => ExitCode::from(DATA_LOST),
                _ => ExitCode::SUCCESS,
            };
            print(&format!("{report}\n"), code)
        }
        Err(e @ StartError::Stopped) => {
            info!("{e}");
            ExitCode::SUCCESS
        }
        Err(StartError::Lock(e @ service::LockError::Taken { .. })) => fail(CELL_TAKEN, &e),
        Err(e) => fail(FAILED, &e),
    }
}

fn fail(code: u8, error: &dyn std::error::Error) -> ExitCode {
    if tracing::dispatcher::has_been_set() {
        error!("{error}");
    } else {
        eprintln!("samsodd: {error}");
    }
    ExitCode::from(code)
}

/// Prints to standard output; a reader that has gone away is no failure of the service.
fn print(text: &str, code: ExitCode) -> ExitCode {
    let mut out = io::stdout().lock();
    let _ = out.write_all(text.as_bytes()).and_then(|()| out.flush());
    code
}

fn start_log(config: LogConfig) {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new(config.level.to_string()));
    let stream = std::env::var("JOURNAL_STREAM").ok();
    if journal::is_standard_error(stream.as_deref())
        && let Ok(journal) = Journal::open("samsodd")
    {
        return tracing_subscriber::registry().with(filter).with(journal).init();
    }
    let colours = io::IsTerminal::is_terminal(&io::stderr());
    tracing_subscriber::fmt().with_env_filter(filter).with_ansi(colours).with_writer(io::stderr).init();
}

/// Set by SIGHUP: the configuration is to be read again.
fn catch_reload() -> io::Result<Arc<AtomicBool>> {
    let reload = Arc::new(AtomicBool::new(false));
    flag::register(SIGHUP, Arc::clone(&reload))?;
    Ok(reload)
}

fn catch_signals() -> io::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGTERM, SIGINT] {
        // In this order: the first signal finds the flag unset and sets it, the second finds it set.
        flag::register_conditional_shutdown(signal, IMPATIENT, Arc::clone(&stop))?;
        flag::register(signal, Arc::clone(&stop))?;
    }
    Ok(stop)
}
