//! The soak: samsodd at 22 frames a second for as long as it is told, then restarts by SIGKILL at random moments.
//!
//! ```text
//! SAMSOD_SOAK_SECONDS    of the first part, default 20
//! SAMSOD_SOAK_RESTARTS   of the second part, default 6: in each, one to three of daemon, client and subscriber are killed
//! SAMSOD_SOAK_SEED       of the random moments, default from the clock; it is printed
//! ```
//!
//! `make soak` runs it for an hour in release. The last line is the result, and the exit code is 0 only if
//!
//! - every frame that the client has sent is counted as processed or dropped;
//! - resident memory, of daemon and client, has grown by no more than 1 %, file handles and files of shared memory by none: the
//!   median of the last tenth of the samples against that of the tenth that follows a warm-up, which is the first quarter. Less
//!   than ten minutes are all warm-up: 25 % are allowed there, and only a gross leak is found;
//! - after each kill the next start worked, without anything being cleaned up by hand;
//! - everything that was flushed can be read: each command that the controller has got is in the recording, in its order, and
//!   as many frames as samsodd had told to be written just before it was killed.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "a test fails by panicking")]

mod support;

use std::collections::BTreeSet;
use std::env;
use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::thread;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use samsod_daemon::recording::recovered_path;
use samsod_frame::{FrameServiceConfig, SceneSubscriber};
use samsod_robot::ScaledClock;
use samsod_robot::emulator::{CommandResult, EmptyTable, Emulator, EmulatorConfig, JournalEntry};
use support::{HTTP, Process, TestCell, WATCHDOG, address_of, metric, samsod, test_data};

/// Frames a second of the client.
const RATE_HZ: u64 = 22;
/// Growth of memory that is none, percent.
const FLAT_PERCENT: f64 = 1.0;
/// The same for a run that is shorter than [`LONG_S`].
const SHORT_FLAT_PERCENT: f64 = 25.0;
const LONG_S: u64 = 600;
/// Set for the process that has a `/dev/shm` of its own.
const INSIDE: &str = "SAMSOD_SOAK_INSIDE";
/// The argument with which this program is a reader of scenes.
const SUBSCRIBER: &str = "--subscriber";

fn main() -> ExitCode {
    let arguments: Vec<String> = env::args().skip(1).collect();
    if let [first, root, cell] = &arguments[..]
        && first == SUBSCRIBER
    {
        subscribe(Path::new(root), cell);
        return ExitCode::SUCCESS;
    }
    // What a test program without tests of its own is asked by cargo.
    let is_named = |filter: &String| filter.starts_with('-') || "soak".contains(filter.as_str());
    if arguments.iter().any(|argument| argument == "--list") || !arguments.iter().all(is_named) {
        return ExitCode::SUCCESS;
    }
    if env::var_os(INSIDE).is_none()
        && let Some(code) = run_inside()
    {
        return code;
    }
    let clock = SystemTime::now().duration_since(UNIX_EPOCH).map_or(1, |time| time.as_nanos() as u64);
    let seed = number("SAMSOD_SOAK_SEED", clock);
    let soak = soak(number("SAMSOD_SOAK_SECONDS", 20).max(10));
    let restarts = restarts(number("SAMSOD_SOAK_RESTARTS", 6), seed);
    let is_well = soak.is_well() && restarts.is_well();
    println!("{soak}; {restarts}");
    if is_well { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// Runs this program with a `/dev/shm` of its own, so that every file there is of this cell; none if that cannot be had: then
/// files of others that come meanwhile are counted, too.
fn run_inside() -> Option<ExitCode> {
    let mount = "mount -t tmpfs -o size=1g none /dev/shm && exec \"$@\"";
    let inside = |program: &Path| {
        let mut command = Command::new("unshare");
        command.args(["--mount", "--map-root-user", "/bin/sh", "-c", mount, "sh"]).arg(program);
        command.env(INSIDE, "1");
        command
    };
    inside(Path::new("/bin/true")).output().ok().filter(|probe| probe.status.success())?;
    let status = inside(&env::current_exe().ok()?).status().ok()?;
    Some(ExitCode::from(u8::try_from(status.code().unwrap_or(1)).unwrap_or(1)))
}

fn number(name: &str, default: u64) -> u64 {
    match env::var(name) {
        Ok(text) => text.parse().unwrap_or_else(|_| panic!("{name} = {text:?}; a whole number is allowed")),
        Err(_) => default,
    }
}

/// Reads scenes until it is killed, and tells each.
fn subscribe(root: &Path, cell: &str) {
    let config = FrameServiceConfig { root_path: Some(root.to_owned()), ..FrameServiceConfig::for_cell(cell) };
    let mut scenes = SceneSubscriber::open(&config).expect("scenes");
    loop {
        if let Some(scene) = scenes.wait(Duration::from_secs(1)).expect("scenes") {
            eprintln!("scene {}", scene.header().sequence);
        }
    }
}

fn spawn_subscriber(cell: &TestCell) -> Process {
    let mut command = Command::new(env::current_exe().expect("this program"));
    command.arg(SUBSCRIBER).arg(cell.path("shm")).arg(&cell.service.cell);
    Process::spawn(command)
}

/// The text of `/metrics`; empty if nobody answers.
fn metrics(address: &str) -> String {
    let ask = || -> std::io::Result<String> {
        let mut stream = TcpStream::connect(address)?;
        stream.set_read_timeout(Some(WATCHDOG))?;
        write!(stream, "GET /metrics HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n")?;
        let mut answer = String::new();
        stream.read_to_string(&mut answer)?;
        Ok(answer)
    };
    ask().unwrap_or_default()
}

// The first part.

struct Soak {
    sent: u64,
    processed: u64,
    /// Dropped, rejected or failed: counted all the same.
    dropped: u64,
    /// Growth of whichever process has grown more.
    memory_percent: f64,
    /// What is allowed.
    flat_percent: f64,
    /// Growth of file handles and of files of shared memory.
    grown: Vec<String>,
}

impl Soak {
    fn unaccounted(&self) -> i64 {
        self.sent as i64 - self.processed as i64 - self.dropped as i64
    }

    fn is_well(&self) -> bool {
        self.unaccounted() == 0
            && self.processed > 0
            && self.memory_percent <= self.flat_percent
            && self.grown.is_empty()
    }
}

impl std::fmt::Display for Soak {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { sent, processed, dropped, memory_percent, .. } = self;
        write!(f, "frames {sent} = processed {processed} + dropped {dropped}, unaccounted {}; ", self.unaccounted())?;
        write!(f, "memory {memory_percent:+.1} %")
    }
}

/// One look at everything that must not grow.
struct Sample {
    daemon_kib: u64,
    client_kib: u64,
    handles: usize,
    files: usize,
}

/// One number of a sample.
type Look = fn(&Sample) -> f64;

fn soak(seconds: u64) -> Soak {
    let (cell, before) = (TestCell::new(), shared_memory());
    let config = cell.config(&[
        HTTP,
        // Small files, of which the oldest are removed: an hour would fill the disk.
        ("recording", "max_file_mib = 16\nkeep_mib = 64"),
    ]);
    let daemon = cell.spawn_daemon(&config, &[]);
    let address = address_of(&daemon);
    let subscriber = spawn_subscriber(&cell);
    let count = RATE_HZ * seconds;
    let (rate, frames) = (RATE_HZ.to_string(), count.to_string());
    let mut client = cell.spawn_client(&test_data("cell"), &["--rate", &rate, "--loop", "--count", &frames]);
    daemon.wait_for_line("frames from a new client");

    let interval = Duration::from_millis(if seconds < 600 { 100 } else { 1000 });
    let mut samples = Vec::new();
    while !client.has_ended() {
        samples.push(Sample {
            daemon_kib: resident_kib(daemon.id()),
            client_kib: resident_kib(client.id()),
            handles: handles(daemon.id()) + handles(client.id()),
            files: files(&cell, &before).len(),
        });
        for process in [&daemon, &subscriber] {
            process.lines();
        }
        thread::sleep(interval);
    }
    // The last samples may be of a client that was ending.
    samples.truncate(samples.len() - samples.len() / 50 - 1);
    let client = client.wait();
    client.assert_success();
    let sent: u64 = client.stdout.split_whitespace().next().unwrap().parse().unwrap();
    assert_eq!(sent, count, "{}", client.stdout);
    // Until the last of them is done with; one that never is shows in what is unaccounted for.
    let deadline = Instant::now() + Duration::from_secs(10);
    let is_done = || {
        let text = metrics(&address);
        let value = |name: &str| metric(&text, name).unwrap_or(0.0) as u64;
        value("samsod_frames_processed_total") + value("samsod_frames_dropped_total") >= sent
    };
    while !is_done() && Instant::now() < deadline {
        thread::sleep(interval);
    }
    let ended = daemon.terminate();
    ended.assert_success();
    let counts = ["processed", "dropped", "rejected", "failed"].map(|name| ended.count("frames", name));
    let [processed, dropped, rejected, failed] = counts;
    let recorded = ended.stdout.lines().find(|line| line.starts_with("recording")).unwrap_or_default().to_owned();
    println!(
        "soak: {seconds} s, {sent} frames sent at {RATE_HZ} Hz; processed {processed}, dropped {dropped}, rejected {rejected}, failed {failed}"
    );
    println!("soak: {recorded}");
    subscriber.kill();

    let (mut memory_percent, mut grown) = (f64::NEG_INFINITY, Vec::new());
    let rows: [(&str, Look); 4] = [
        ("daemon, KiB", |sample| sample.daemon_kib as f64),
        ("client, KiB", |sample| sample.client_kib as f64),
        ("file handles", |sample| sample.handles as f64),
        ("shared-memory files", |sample| sample.files as f64),
    ];
    for (name, value) in rows {
        let (early, late) = early_and_late(&samples, value);
        let percent = (late - early) / early * 100.0;
        println!("soak: {name}: {early} early, {late} late, {percent:+.2} %; {} samples", samples.len());
        if name.ends_with("KiB") {
            memory_percent = memory_percent.max(percent);
        } else if late > early {
            grown.push(name.to_owned());
        }
    }
    let flat_percent = if seconds >= LONG_S { FLAT_PERCENT } else { SHORT_FLAT_PERCENT };
    Soak { sent, processed, dropped: dropped + rejected + failed, memory_percent, flat_percent, grown }
}

/// Medians of the tenth of the samples after the first quarter, and of the last tenth.
fn early_and_late(samples: &[Sample], value: Look) -> (f64, f64) {
    let (begin, tenth) = (samples.len() / 4, (samples.len() / 10).max(1));
    let median = |samples: &[Sample]| {
        let mut values: Vec<f64> = samples.iter().map(value).collect();
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    (median(&samples[begin..begin + tenth]), median(&samples[samples.len() - tenth..]))
}

fn resident_kib(process: u32) -> u64 {
    let status = fs::read_to_string(format!("/proc/{process}/status")).unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    line.and_then(|rest| rest.split_whitespace().next()?.parse().ok()).unwrap_or(0)
}

fn handles(process: u32) -> usize {
    fs::read_dir(format!("/proc/{process}/fd")).map_or(0, Iterator::count)
}

/// The files of the transport in `/dev/shm`.
fn shared_memory() -> BTreeSet<PathBuf> {
    let entries = fs::read_dir("/dev/shm").into_iter().flatten().flatten().map(|entry| entry.path());
    entries.filter(|path| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with("iox2_"))).collect()
}

/// Files of the transport of a cell: those in its folder, and those in `/dev/shm` that were not there before.
fn files(cell: &TestCell, before: &BTreeSet<PathBuf>) -> BTreeSet<PathBuf> {
    let mut found: BTreeSet<PathBuf> = shared_memory().difference(before).cloned().collect();
    let mut folders = vec![cell.path("shm")];
    while let Some(folder) = folders.pop() {
        for path in fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path()) {
            if path.is_dir() {
                folders.push(path);
            } else {
                found.insert(path);
            }
        }
    }
    found
}

// The second part.

struct Restarts {
    count: u64,
    failed: u64,
    lost: u64,
}

impl Restarts {
    fn is_well(&self) -> bool {
        self.failed == 0 && self.lost == 0
    }
}

impl std::fmt::Display for Restarts {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "restarts {}, failed {}, records lost {}", self.count, self.failed, self.lost)
    }
}

/// Random numbers that are the same for the same seed.
struct Random(u64);

impl Random {
    fn below(&mut self, end: u64) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) % end
    }
}

/// One life of samsodd, with a controller of its own: what that was told must be in the recordings of this life.
struct Life {
    daemon: Process,
    controller: Emulator,
    address: Option<String>,
    /// What it has said lately.
    said: Vec<String>,
}

impl Life {
    fn begin(cell: &TestCell) -> Self {
        let controller = Emulator::start(EmulatorConfig::default(), ScaledClock::new(1.0), Box::new(EmptyTable))
            .expect("controller");
        let config = cell.config(&[
            HTTP,
            ("robot", "controller = \"motoman\"\narmed = true\njoint_speed_fraction = 1.0"),
            ("robot.motoman", &format!("address = \"{}\"", controller.address())),
        ]);
        Self { daemon: cell.spawn_daemon(&config, &[]), controller, address: None, said: Vec::new() }
    }

    /// Frames that samsodd says are written.
    fn written(&mut self) -> u64 {
        for line in self.daemon.lines() {
            if let Some((_, address)) = line.split_once("health and metrics address=") {
                self.address = Some(address.to_owned());
            }
            self.said.truncate(50);
            self.said.insert(0, line);
        }
        let text = self.address.as_deref().map(metrics).unwrap_or_default();
        metric(&text, "samsod_recorder_frames_total{result=\"written\"}").unwrap_or(0.0) as u64
    }

    /// Kills it, and tells how many records are lost of those that were flushed.
    fn kill(mut self, cell: &TestCell) -> u64 {
        let written = self.written();
        self.daemon.kill();
        let told = self.controller.stop();
        let (mut frames, mut sent) = (0, Vec::new());
        for file in cell.recordings() {
            // 3 when something at its end was cut off.
            let (read, whole) = (samsod(&["recover", file.to_str().expect("text")]), recovered_path(&file));
            // A file without its first bytes holds nothing yet.
            let is_read = matches!(read.status.code(), Some(0 | 3));
            if is_read {
                count_in(&whole, &mut frames, &mut sent);
                fs::remove_file(&whole).expect("what was recovered");
            } else {
                println!("restarts: {} is not read: {}", file.display(), read.stderr);
            }
            fs::remove_file(&file).expect("a recording that was read");
        }
        let lost = written.saturating_sub(frames) + missing(&told, &sent);
        if lost > 0 {
            println!(
                "restarts: {written} frames were written, {frames} are there; the controller was told {told:?}, recorded is {sent:?}"
            );
        }
        lost
    }
}

/// Counts the frames of a recording up to where it was cut, and collects what was sent to the controller.
fn count_in(file: &Path, frames: &mut u64, sent: &mut Vec<String>) {
    let bytes = fs::read(file).expect("recording");
    let options = mcap::read::Options::IgnoreEndMagic;
    let Ok(stream) = mcap::MessageStream::new_with_options(&bytes, options.into()) else { return };
    for message in stream.map_while(Result::ok) {
        match message.channel.topic.as_str() {
            // The last message of a frame.
            "/stage/timings" => *frames += 1,
            "/robot/wire" => {
                let line: serde_json::Value = serde_json::from_slice(&message.data).expect("JSON");
                if line["direction"] == "sent" {
                    sent.push(line["bytes"].as_str().expect("text").to_owned());
                }
            }
            _ => {}
        }
    }
}

/// How many commands a controller was told that were not recorded before, in their order.
fn missing(told: &[JournalEntry], sent: &[String]) -> u64 {
    let mut sent = sent.iter();
    let mut is_sent = |expected: &str| sent.any(|line| line.starts_with(expected));
    let mut missing = 0;
    for entry in told {
        let header = format!("HOSTCTRL_REQUEST {} ", entry.command);
        let is_whole = entry.result != CommandResult::HeaderOnly;
        let data = entry.data.as_deref().filter(|data| is_whole && !data.is_empty());
        missing += u64::from(!is_sent(&header) || !data.is_none_or(&mut is_sent));
    }
    missing
}

fn restarts(count: u64, seed: u64) -> Restarts {
    println!("restarts: seed {seed}");
    let mut random = Random(seed);
    let (cell, before) = (TestCell::new(), shared_memory());
    let images = cell.images(8);
    let rate = RATE_HZ.to_string();
    let spawn_client = || cell.spawn_client(&images, &["--rate", &rate, "--loop", "--wait", "120"]);
    let (mut life, mut client, mut subscriber) = (Life::begin(&cell), spawn_client(), spawn_subscriber(&cell));
    let mut kills = [0_u64; 3];
    let mut result = Restarts { count: 0, failed: 0, lost: 0 };
    if !works(&mut life, &mut client, &mut subscriber) {
        return Restarts { failed: 1, ..result };
    }
    while result.count < count {
        result.count += 1;
        thread::sleep(Duration::from_millis(random.below(400)));
        let victims = 1 + random.below(7);
        if victims & 1 != 0 {
            kills[0] += 1;
            result.lost += life.kill(&cell);
            life = Life::begin(&cell);
        }
        if victims & 2 != 0 {
            kills[1] += 1;
            client.kill();
            client = spawn_client();
        }
        if victims & 4 != 0 {
            kills[2] += 1;
            subscriber.kill();
            subscriber = spawn_subscriber(&cell);
        }
        // Every third time the next kill meets those that are just starting.
        let is_waited_for = random.below(3) > 0 || result.count == count;
        if is_waited_for && !works(&mut life, &mut client, &mut subscriber) {
            result.failed += 1;
            return result;
        }
    }
    let [daemons, clients, subscribers] = kills;
    println!("restarts: killed daemon {daemons}, client {clients}, subscriber {subscribers} times");
    let in_use = files(&cell, &before).len();
    subscriber.kill();
    client.terminate().assert_success();
    life.daemon.terminate().assert_success();
    // Of those that were killed: whoever starts next takes it away. What was killed before it was complete has to be ten
    // seconds old for that.
    let deadline = Instant::now() + WATCHDOG;
    let left = loop {
        cell.start_daemon(&[]).terminate().assert_success();
        let left: Vec<_> = files(&cell, &before).into_iter().filter(|path| !may_stay(path)).collect();
        if left.is_empty() || Instant::now() > deadline {
            break left;
        }
        thread::sleep(Duration::from_secs(1));
    };
    println!("restarts: {in_use} files of shared memory at the end, {} after it", left.len());
    if !left.is_empty() {
        println!("restarts: left behind: {left:#?}");
        result.failed += 1;
    }
    result
}

/// The lock of the cell stays, and is harmless, and so does the operator's token of a daemon that was killed.
fn may_stay(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "lock" || extension == "token")
}

/// Whether frames of this client go through this daemon to this subscriber; none of them may end by itself.
fn works(life: &mut Life, client: &mut Process, subscriber: &mut Process) -> bool {
    subscriber.lines();
    let mut scenes = 0;
    let deadline = Instant::now() + WATCHDOG;
    while scenes < 3 {
        scenes += subscriber.lines().iter().filter(|line| line.starts_with("scene ")).count();
        let processes = [("daemon", &mut life.daemon), ("client", &mut *client), ("subscriber", &mut *subscriber)];
        let ended: Vec<_> =
            processes.into_iter().filter_map(|(name, process)| process.has_ended().then_some(name)).collect();
        if !ended.is_empty() || Instant::now() > deadline {
            println!("restarts: {ended:?} ended by itself, or no scenes came; {scenes} came");
            life.written();
            println!("restarts: the daemon, latest first: {:#?}", life.said);
            for (name, process) in [("client", &*client), ("subscriber", &*subscriber)] {
                println!("restarts: the {name}: {:#?}", process.lines());
            }
            return false;
        }
        life.written();
        thread::sleep(Duration::from_millis(5));
    }
    true
}
