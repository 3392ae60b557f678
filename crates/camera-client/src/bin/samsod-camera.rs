//! `samsod-camera`: the frames of a camera into the shared memory of a cell.

use std::io;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use clap::Parser;
use samsod_camera_client::{ClientConfig, Counts, Event, RunError, run};
use signal_hook::consts::{SIGINT, SIGTERM};
use tracing::{debug, error, info, warn};
use tracing_subscriber::EnvFilter;

/// Sends the frames of a GigE Vision, USB3 Vision or V4L2 camera to samsodd, and goes on when the camera comes back.
///
/// SIGTERM and SIGINT end it. Exit codes: 0 ended as asked, 1 the shared memory of the cell cannot be used, 2 bad configuration or
/// arguments, also a value that the camera does not take.
#[derive(Debug, Parser)]
#[command(name = "samsod-camera", version, verbatim_doc_comment)]
struct Arguments {
    /// Which camera, how it is set, and which cell gets its frames, TOML.
    #[arg(long, value_name = "FILE", required_unless_present = "list")]
    config: Option<PathBuf>,
    /// Print the configuration in force as TOML, and end.
    #[arg(long)]
    check_config: bool,
    /// Print the GigE Vision and USB3 Vision cameras that answer, and end.
    #[arg(long)]
    list: bool,
}

fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info"));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(io::stderr).init();
    if arguments.list {
        return list();
    }
    let Some(path) = arguments.config else { return ExitCode::from(2) };
    let config = match ClientConfig::read(&path) {
        Ok(config) => config,
        Err(e) => {
            error!("{e}");
            return ExitCode::from(2);
        }
    };
    if arguments.check_config {
        return match toml::to_string(&config) {
            Ok(text) => {
                print!("{text}");
                ExitCode::SUCCESS
            }
            Err(e) => {
                error!(error = %e, "the configuration cannot be printed");
                ExitCode::from(1)
            }
        };
    }
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGTERM, SIGINT] {
        if let Err(e) = signal_hook::flag::register(signal, Arc::clone(&stop)) {
            error!(error = %e, "signals cannot be taken");
            return ExitCode::from(1);
        }
    }
    let mut log = Log::default();
    match run(&config, &stop, &mut |event| log.tell(event)) {
        Ok(counts) => {
            info!(sent = counts.sent, incomplete = counts.incomplete, missing = counts.missing, "ended");
            ExitCode::SUCCESS
        }
        Err(e) => {
            error!("{e}");
            ExitCode::from(if matches!(e, RunError::Config(_)) { 2 } else { 1 })
        }
    }
}

fn list() -> ExitCode {
    #[cfg(feature = "aravis")]
    {
        let cameras = samsod_camera_client::list_cameras();
        for camera in &cameras {
            println!("{}  {}  {}  {}", camera.id, camera.model, camera.address, camera.protocol);
        }
        if cameras.is_empty() {
            warn!("no camera answers; is it powered, in the same network, and free of other clients?");
        }
        ExitCode::SUCCESS
    }
    #[cfg(not(feature = "aravis"))]
    {
        error!("this program was built without the feature aravis; cameras of the kernel are /dev/video*");
        ExitCode::from(2)
    }
}

/// Lines of the journal: each thing when it begins, and not for every frame.
#[derive(Default)]
struct Log {
    /// Incomplete and missing frames since the last line about them.
    bad: u64,
    last_bad: Option<Instant>,
    last: Option<(Instant, Counts)>,
}

impl Log {
    /// Between two lines about bad frames.
    const BAD_EVERY: Duration = Duration::from_secs(1);

    fn tell(&mut self, event: &Event<'_>) {
        match event {
            Event::Connected { camera, after } => info!(camera, after_ms = after.as_millis(), "camera set up"),
            Event::Flowing { after } => info!(after_ms = after.as_millis(), "frames flow"),
            Event::Gone { error, was_there: true } => warn!(%error, "camera is gone; it is looked for"),
            Event::Gone { error, .. } => warn!(%error, "no camera; it is looked for"),
            Event::Sent => {}
            Event::Incomplete { camera_frame, reason } => {
                debug!(camera_frame, reason, "frame not sent");
                self.bad(1, reason);
            }
            Event::Missing { frames } => self.bad(*frames, "they never came"),
            Event::Status { counts, advice } => {
                let rate_hz = self
                    .last
                    .map_or(0.0, |(at, then)| (counts.sent - then.sent) as f64 / at.elapsed().as_secs_f64().max(1e-3));
                self.last = Some((Instant::now(), *counts));
                let advice = advice.map(ToString::to_string).unwrap_or_default();
                let Counts { sent, incomplete, missing, connected } = *counts;
                info!(sent, incomplete, missing, connected, rate_hz = format!("{rate_hz:.1}"), advice, "status");
            }
            _ => {}
        }
    }

    fn bad(&mut self, frames: u64, reason: &str) {
        self.bad += frames;
        if self.last_bad.is_none_or(|at| at.elapsed() >= Self::BAD_EVERY) {
            warn!(frames = self.bad, last_reason = reason, "frames lost between the camera and here");
            self.bad = 0;
            self.last_bad = Some(Instant::now());
        }
    }
}
