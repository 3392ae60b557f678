//! The thread that looks at the pulses: it tells the log once when a part is not as it should be, and once when it is again,
//! and tells systemd that the service is ready, alive, ending.
//!
//! systemd's watchdog is fed only while no part is stuck: then systemd ends the service and starts it anew. Outside of systemd
//! (no `NOTIFY_SOCKET`) only the log is told.

use std::io;
use std::sync::mpsc::{self, RecvTimeoutError, SyncSender};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use sd_notify::NotifyState;
use tracing::{error, info, warn};

use crate::health::{Grade, Health, SharedMonitor};

/// How often the pulses are looked at; more often if systemd wants to hear more often.
const LOOK_INTERVAL: Duration = Duration::from_millis(250);
/// However impatient systemd is.
const SHORTEST_INTERVAL: Duration = Duration::from_millis(5);
/// How often the line of `systemctl status` is renewed.
const STATUS_INTERVAL: Duration = Duration::from_secs(10);

/// The thread while it runs.
#[derive(Debug)]
pub(crate) struct Supervisor {
    stop: Option<SyncSender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Supervisor {
    /// Begins to look, and tells systemd that the service is ready.
    pub(crate) fn start(monitor: SharedMonitor) -> io::Result<Self> {
        let (stop, stopped) = mpsc::sync_channel::<()>(0);
        let watchdog = sd_notify::watchdog_enabled();
        // Three times within systemd's patience, as it advises twice or more.
        let interval =
            watchdog.map_or(LOOK_INTERVAL, |patience| LOOK_INTERVAL.min(patience / 3).max(SHORTEST_INTERVAL));
        let look = move || {
            let mut told = Told::default();
            let mut last_status = None::<Instant>;
            loop {
                let health = monitor.health();
                let has_changed = told.tell(&health);
                if has_changed || last_status.is_none_or(|last| last.elapsed() >= STATUS_INTERVAL) {
                    last_status = Some(Instant::now());
                    notify(&[NotifyState::Status(&status_line(&monitor, &health))]);
                }
                if watchdog.is_some() && !health.is_stuck() {
                    notify(&[NotifyState::Watchdog]);
                }
                if !matches!(stopped.recv_timeout(interval), Err(RecvTimeoutError::Timeout)) {
                    return;
                }
            }
        };
        let thread = thread::Builder::new().name("supervisor".to_owned()).spawn(look)?;
        notify(&[NotifyState::Ready]);
        Ok(Self { stop: Some(stop), thread: Some(thread) })
    }

    /// Tells systemd that the service ends. It is still looked at: what ends can be stuck, too.
    pub(crate) fn is_ending(&self) {
        notify(&[NotifyState::Stopping]);
    }
}

impl Drop for Supervisor {
    fn drop(&mut self) {
        drop(self.stop.take());
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            error!("the supervisor panicked");
        }
    }
}

fn notify(states: &[NotifyState<'_>]) {
    // A service manager that does not listen any more is no reason to end; a watchdog that it misses, it sees itself.
    if let Err(error) = sd_notify::notify(states) {
        tracing::debug!(%error, "systemd was not told");
    }
}

fn status_line(monitor: &SharedMonitor, health: &Health) -> String {
    let counts = monitor.counts();
    let (processed, dropped) = (counts.vision.processed, counts.frames.dropped);
    let parts = health.parts.all().map(|(name, part)| format!("{name} {}", part.state));
    format!("{}; {processed} frames processed, {dropped} dropped", parts.join(", "))
}

/// What the log was told last of each part: nothing while it is fine.
#[derive(Debug, Default)]
struct Told([Option<(&'static str, Instant)>; 4]);

impl Told {
    /// Tells what is new; whether anything was.
    fn tell(&mut self, health: &Health) -> bool {
        let mut has_changed = false;
        for (told, (part, now)) in self.0.iter_mut().zip(health.parts.all()) {
            let is_new = told.map(|(state, _)| state) != (now.grade != Grade::Fine).then_some(now.state);
            if !is_new {
                continue;
            }
            has_changed = true;
            let (state, pulse_age_ms, detail) = (now.state, now.pulse_age_ms, now.detail.as_deref());
            match now.grade {
                Grade::Fine => {
                    if let Some((was, since)) = told.take() {
                        info!(part, was, state, after_s = since.elapsed().as_secs_f64(), "part is well again");
                    }
                }
                Grade::Ill => warn!(part, state, pulse_age_ms, detail, "part is not well"),
                Grade::Stuck => error!(part, state, pulse_age_ms, detail, "part is stuck"),
            }
            if now.grade != Grade::Fine {
                *told = Some((state, Instant::now()));
            }
        }
        has_changed
    }
}
