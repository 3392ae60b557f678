//! An emulated Motoman controller: a TCP server that answers as the Ethernet Server of a real one does.
//!
//! For tests and demonstrations without a robot. It keeps the state of a controller (remote, play, servo, hold, alarm,
//! running, place, joints, inputs, variables, jobs), moves the arm of an MH5 at the commanded speed on a [`Clock`] that a test
//! may drive, works a gripper among [`Workpieces`], has [faults](FaultScript) by script, and keeps a
//! [journal](JournalEntry) of every command.
//!
//! ```
//! use samsod_robot::emulator::{EmptyTable, Emulator, EmulatorConfig};
//! use samsod_robot::{Controller, ManualClock, Motoman, MotomanConfig, NoWireLog};
//!
//! let clock = ManualClock::new();
//! let emulator = Emulator::start(EmulatorConfig::default(), clock.clone(), Box::new(EmptyTable))?;
//! let config = MotomanConfig { address: emulator.address().to_string(), ..Default::default() };
//! let mut robot = Motoman::new(config, clock, Box::new(NoWireLog))?;
//! robot.connect()?;
//! assert!(robot.status()?.servo_on);
//! assert_eq!(emulator.journal()[0].command, "RSTATS");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod config;
mod connection;
mod journal;
mod machine;
mod request;
mod script;

use std::collections::{HashMap, HashSet};
use std::fs::File;
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

pub use config::{EmulatorConfig, EmulatorError};
use journal::Journal;
pub use journal::{CommandResult, JournalEntry};
use machine::Machine;
pub use request::{DATA_MAX, HEADER_MAX, Incoming, IncomingError, RequestParser};
pub use script::{FaultKind, FaultPhase, FaultRule, FaultScript, FaultScriptError};

use crate::{Clock, Fault, Pose, Workpieces};

/// A table with nothing on it.
#[derive(Debug, Clone, Copy, Default)]
pub struct EmptyTable;

impl Workpieces for EmptyTable {
    fn passes(&mut self, _tool: &Pose) {}

    fn close(&mut self, _tool: &Pose) -> bool {
        false
    }

    fn open(&mut self, _tool: &Pose) {}
}

/// A running emulator. It ends, with all its threads, when it is dropped.
pub struct Emulator {
    shared: Arc<Shared>,
    address: SocketAddr,
    acceptor: Option<JoinHandle<()>>,
}

/// What the threads share.
struct Shared {
    config: EmulatorConfig,
    address: SocketAddr,
    machine: Mutex<Machine>,
    script: Mutex<FaultScript>,
    journal: Mutex<Journal>,
    connections: Mutex<Connections>,
    /// Local ports of second clients, which no fault is to meet.
    second_clients: Mutex<HashSet<u16>>,
    stopping: Mutex<bool>,
    stop: Condvar,
    /// Commands whose header has come and that are not at their end.
    in_progress: AtomicUsize,
}

#[derive(Default)]
struct Connections {
    last: u64,
    open: HashMap<u64, Arc<TcpStream>>,
    threads: Vec<JoinHandle<()>>,
}

/// A poisoned lock only says that another thread panicked; what is behind it is valid after every statement.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Shared {
    /// Waits in real time; `false` when the emulator is ending.
    fn wait(&self, time: Duration) -> bool {
        let end = Instant::now() + time;
        let mut stopping = lock(&self.stopping);
        while !*stopping {
            let Some(left) = end.checked_duration_since(Instant::now()).filter(|left| !left.is_zero()) else {
                return true;
            };
            stopping = self.stop.wait_timeout(stopping, left).unwrap_or_else(PoisonError::into_inner).0;
        }
        false
    }
}

impl Emulator {
    /// Starts a controller that stands at home with servo power on, in remote and play.
    ///
    /// # Errors
    /// [`EmulatorError`]
    pub fn start(
        config: EmulatorConfig,
        clock: impl Clock + 'static,
        workpieces: Box<dyn Workpieces>,
    ) -> Result<Self, EmulatorError> {
        let joints = config.check()?;
        let cannot = |cause| EmulatorError::Listen { listen: config.listen.clone(), cause };
        let listener = TcpListener::bind(&config.listen).map_err(cannot)?;
        let address = listener.local_addr().map_err(cannot)?;
        let file = match &config.journal_file {
            Some(path) => {
                Some(File::create(path).map_err(|cause| EmulatorError::Journal { path: path.clone(), cause })?)
            }
            None => None,
        };
        let shared = Arc::new(Shared {
            address,
            machine: Mutex::new(Machine::new(config.clone(), joints, Arc::new(clock), workpieces)),
            script: Mutex::new(config.script.clone()),
            journal: Mutex::new(Journal::new(file)),
            connections: Mutex::default(),
            second_clients: Mutex::default(),
            stopping: Mutex::new(false),
            stop: Condvar::new(),
            in_progress: AtomicUsize::new(0),
            config,
        });
        let acceptor = {
            let shared = Arc::clone(&shared);
            std::thread::spawn(move || accept(&listener, &shared))
        };
        Ok(Self { shared, address, acceptor: Some(acceptor) })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Every command so far, in the order in which their headers came.
    pub fn journal(&self) -> Vec<JournalEntry> {
        lock(&self.shared.journal).entries.clone()
    }

    /// Ends it, and gives the journal: nothing is executed any more.
    pub fn stop(mut self) -> Vec<JournalEntry> {
        self.end();
        self.journal()
    }

    /// Replaces what is left of the script.
    ///
    /// # Errors
    /// [`FaultScriptError`]
    pub fn set_script(&self, script: FaultScript) -> Result<(), FaultScriptError> {
        script.check()?;
        *lock(&self.shared.script) = script;
        Ok(())
    }

    /// Makes something go wrong.
    pub fn inject(&self, fault: Fault) {
        let at_next =
            |phase| FaultRule { command: Some("acting".into()), nth: 1, phase, share: 0.0, what: FaultKind::Close };
        let kind = match fault {
            Fault::EmergencyStop => FaultKind::EmergencyStop,
            Fault::ServoOff => FaultKind::ServoOff,
            Fault::Alarm(code) => FaultKind::Alarm { code },
            Fault::ExternalHold => FaultKind::ExternalHold,
            Fault::Teach => FaultKind::Teach,
            Fault::StopShort => FaultKind::StopShort,
            Fault::Stall => FaultKind::Stall,
            Fault::Disconnect => return self.disconnect(),
            Fault::LoseNextCommand => return lock(&self.shared.script).faults.push(at_next(FaultPhase::Header)),
            Fault::LoseNextAnswer => return lock(&self.shared.script).faults.push(at_next(FaultPhase::Answer)),
        };
        let mut machine = lock(&self.shared.machine);
        machine.update();
        machine.suffer(kind);
    }

    /// Puts everything right at the robot: releases the stop and outside holds, resets the alarm, turns to play and
    /// remote, switches the servo on. A motion that has stalled is given up; hold by command stays.
    pub fn restore(&self) {
        lock(&self.shared.machine).restore();
    }

    /// How many motions the robot has begun.
    pub fn motions_begun(&self) -> u64 {
        lock(&self.shared.machine).motions_begun
    }

    /// Whether no command is being worked on: one that is [delayed](FaultKind::Delay) is executed even when its host has
    /// given up long ago.
    pub fn is_idle(&self) -> bool {
        self.shared.in_progress.load(Ordering::SeqCst) == 0
    }

    /// Where the tool is.
    pub fn position(&self) -> Pose {
        lock(&self.shared.machine).update()
    }

    /// Breaks every connection.
    fn disconnect(&self) {
        for stream in lock(&self.shared.connections).open.values() {
            // It may have ended by itself.
            let _ = stream.shutdown(Shutdown::Both);
        }
    }

    fn end(&mut self) {
        let Some(acceptor) = self.acceptor.take() else { return };
        *lock(&self.shared.stopping) = true;
        self.shared.stop.notify_all();
        // Wakes the acceptor, which then sees that it is to end. If nobody can connect any more it has ended.
        let _ = TcpStream::connect_timeout(&reachable(self.address), Duration::from_secs(1));
        let _ = acceptor.join();
        self.disconnect();
        let threads = std::mem::take(&mut lock(&self.shared.connections).threads);
        for thread in threads {
            let _ = thread.join();
        }
    }
}

impl Drop for Emulator {
    fn drop(&mut self) {
        self.end();
    }
}

/// An address that one can connect to: who listens on every interface is reached on the loopback.
fn reachable(mut address: SocketAddr) -> SocketAddr {
    if address.ip().is_unspecified() {
        address.set_ip(if address.is_ipv4() { [127, 0, 0, 1].into() } else { std::net::Ipv6Addr::LOCALHOST.into() });
    }
    address
}

fn accept(listener: &TcpListener, shared: &Arc<Shared>) {
    for stream in listener.incoming() {
        if *lock(&shared.stopping) {
            return;
        }
        // A connection that is gone before it was taken is nobody's loss.
        let Ok(stream) = stream else { continue };
        let stream = Arc::new(stream);
        let mut connections = lock(&shared.connections);
        connections.last += 1;
        let number = connections.last;
        connections.open.insert(number, Arc::clone(&stream));
        connections.threads.retain(|thread| !thread.is_finished());
        let shared = Arc::clone(shared);
        connections.threads.push(std::thread::spawn(move || {
            connection::serve(&shared, &stream, number);
            lock(&shared.connections).open.remove(&number);
        }));
    }
}
