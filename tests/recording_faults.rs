//! samsodd on disks that are full or read-only, and killed: real processes, a file system of their own.
//!
//! The file system is a small tmpfs in a mount namespace of its own, which takes root. Who is not root is told so, and nothing is
//! tested. A disk that hangs is in `crates/daemon/src/service/tests.rs`.

#![allow(clippy::expect_used, clippy::panic, clippy::unwrap_used, reason = "helpers of tests fail by panicking")]

mod support;

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

use support::{Ended, HTTP, Process, TestCell, address_of, get, send, wait_for};

/// The arm is quick: what it does or not shows soon.
const QUICK: (&str, &str) = ("robot.simulated", "clock_rate = 100.0");

/// A tmpfs where a cell records to, in a namespace that lives as long as this does.
struct SmallDisk {
    holder: Process,
    folder: PathBuf,
}

impl SmallDisk {
    /// None, and a word about it, where mounting is not permitted.
    fn new(cell: &TestCell, options: &str) -> Option<Self> {
        let allowed = Command::new("unshare").args(["-m", "mount", "-t", "tmpfs", "none", "/mnt"]).output();
        if !allowed.is_ok_and(|output| output.status.success()) {
            eprintln!("NOT TESTED: mounting a tmpfs takes root and a kernel that lets it (unshare -m)");
            return None;
        }
        let folder = cell.path("recordings");
        fs::create_dir_all(&folder).unwrap();
        let mut command = Command::new("unshare");
        let script = "mount -t tmpfs -o \"$1\" none \"$2\" && exec sleep 1000";
        command.args(["-m", "sh", "-c", script, "sh", options]).arg(&folder);
        let disk = Self { holder: Process::spawn(command), folder };
        wait_for("mounted tmpfs", || {
            let mounts = fs::read_to_string(format!("/proc/{}/mounts", disk.holder.id())).unwrap();
            mounts.contains(disk.folder.to_str().unwrap()).then_some(())
        });
        Some(disk)
    }

    /// A command that sees the disk.
    fn command(&self, program: &Path) -> Command {
        let mut command = Command::new("nsenter");
        command.args(["-m", "-t", &self.holder.id().to_string()]).arg(program);
        command
    }

    fn spawn_daemon(&self, config: &Path) -> Process {
        let mut command = self.command(Path::new(env!("CARGO_BIN_EXE_samsodd")));
        command.arg("--config").arg(config);
        Process::spawn(command)
    }

    fn samsod(&self, arguments: &[&str]) -> Ended {
        let mut command = self.command(Path::new(env!("CARGO_BIN_EXE_samsod")));
        command.args(arguments);
        Process::spawn(command).wait()
    }

    fn remount(&self, options: &str) -> bool {
        let mut command = self.command(Path::new("mount"));
        command.args(["-o", &format!("remount,{options}")]).arg(&self.folder);
        command.output().unwrap().status.success()
    }

    /// A path of the disk as this process sees it.
    fn seen(&self, name: &str) -> PathBuf {
        PathBuf::from(format!("/proc/{}/root{}/{name}", self.holder.id(), self.folder.display()))
    }

    /// Takes up so many MiB, or as many as there are.
    fn fill(&self, mib: u64) {
        let mut file = fs::File::create(self.seen("filler")).unwrap();
        for _ in 0..mib << 8 {
            if file.write_all(&[1; 4096]).is_err() {
                return;
            }
        }
    }

    fn empty(&self) {
        fs::remove_file(self.seen("filler")).unwrap();
    }

    /// The recordings, as those who see the disk name them.
    fn recordings(&self) -> Vec<String> {
        let names = fs::read_dir(self.seen("")).unwrap().map(|entry| entry.unwrap().file_name());
        let mut names: Vec<_> = names.map(|name| name.into_string().unwrap()).collect();
        names.retain(|name| name.ends_with(".mcap"));
        // The first has no number.
        names.sort_by_key(|name| (name.len(), name.clone()));
        names.into_iter().map(|name| self.folder.join(name).display().to_string()).collect()
    }
}

/// Code, and state and detail of a part.
fn part(address: &str, part: &str) -> (u16, String, String) {
    let (code, body) = get(address, "/healthz");
    let health: serde_json::Value = serde_json::from_str(&body).expect("JSON");
    let of = |key: &str| health["parts"][part][key].as_str().unwrap_or_default().to_owned();
    (code, of("state"), of("detail"))
}

fn metric(address: &str, name: &str) -> f64 {
    let (_, text) = get(address, "/metrics");
    let line = text.lines().find(|line| line.strip_prefix(name).is_some_and(|rest| rest.starts_with(' ')));
    line.unwrap_or_else(|| panic!("{name}: {text}")).rsplit_once(' ').unwrap().1.parse().unwrap()
}

const SENT: &str = "samsod_commands_sent_total";
const WRITTEN: &str = "samsod_recorder_frames_total{result=\"written\"}";
const PROCESSED: &str = "samsod_frames_processed_total";

/// Frames that are in no recording.
fn lost(address: &str) -> f64 {
    let of = |result: &str| metric(address, &format!("samsod_recorder_frames_total{{result=\"{result}\"}}"));
    of("not_written") + of("dropped")
}

/// Sends frames one after the other, and sees each come out of the vision chain.
struct Client {
    publisher: samsod_frame::FramePublisher,
    scenes: support::Scenes,
    sent: u32,
}

impl Client {
    fn new(cell: &TestCell) -> Self {
        Self { publisher: cell.publisher(), scenes: cell.scenes(), sent: 0 }
    }

    fn send(&mut self, count: u32) {
        for _ in 0..count {
            send(&mut self.publisher, self.sent);
            self.scenes.of_frame(self.sent.into());
            self.sent += 1;
        }
    }

    /// Sends until a number has grown, or changed.
    fn send_until(&mut self, what: &str, mut condition: impl FnMut() -> bool) {
        wait_for(what, || {
            self.send(1);
            condition().then_some(())
        });
    }
}

#[test]
fn a_disk_that_is_nearly_full_holds_the_robot_and_vision_goes_on() {
    let cell = TestCell::new();
    let Some(disk) = SmallDisk::new(&cell, "size=32m") else { return };
    let config = cell.config(&[HTTP, QUICK]);
    let text = fs::read_to_string(&config).unwrap().replace("min_free_mib = 0", "min_free_mib = 8");
    fs::write(&config, text).unwrap();
    let daemon = disk.spawn_daemon(&config);
    let address = address_of(&daemon);
    let mut client = Client::new(&cell);
    client.send_until("a command", || metric(&address, SENT) >= 1.0);

    // Nobody sends a frame: the loss is told all the same.
    disk.fill(27);
    let line = daemon.wait_for_line("part is not well");
    assert!(line.contains("part=\"recorder\"") && line.contains("short of space"), "{line}");
    let (code, state, detail) = part(&address, "recorder");
    assert_eq!((code, state.as_str()), (503, "short of space"));
    assert!(detail.ends_with("MiB free, [recording] min_free_mib = 8"), "{detail}");
    let held = wait_for("a robot that is held", || {
        let (_, state, detail) = part(&address, "robot");
        (state == "faulted" && !detail.is_empty()).then_some(detail)
    });
    assert!(held.contains("recording is short of space") && !held.contains("by an operator"), "{held}");
    assert_eq!(metric(&address, "samsod_part_ok{part=\"recorder\"}"), 0.0);
    let cell_file = config.to_str().unwrap();
    let status = support::samsod(&["status", "--config", cell_file]);
    assert!(status.stdout.contains("recording is short of space"), "{status:?}");
    let refused = support::samsod(&["resume", "--config", cell_file]);
    assert_eq!(refused.status.code(), Some(1), "{refused:?}");
    assert!(refused.stderr.contains("held while recording is short of space"), "{refused:?}");

    let (sent, before) = (metric(&address, SENT), lost(&address));
    client.send(20);
    let frames = f64::from(client.sent);
    wait_for("vision that goes on", || (metric(&address, PROCESSED) == frames).then_some(()));
    wait_for("frames counted as lost", || (lost(&address) == before + 20.0).then_some(()));
    assert_eq!(metric(&address, SENT), sent, "the robot is given nothing");

    disk.empty();
    daemon.wait_for_line("space again: frames are recorded");
    wait_for("well again", || (part(&address, "recorder").1 != "short of space").then_some(()));
    // It does not begin by itself.
    client.send(5);
    assert_eq!(metric(&address, SENT), sent);
    support::samsod(&["resume", "--config", cell_file]).assert_success();
    client.send_until("a command after the resume", || metric(&address, SENT) > sent);
    let ended = daemon.terminate();
    assert_eq!(ended.status.code(), Some(3), "frames are missing: {ended:?}");
    let files = disk.recordings();
    let listed = disk.samsod(&["recording", &files[0]]);
    assert_eq!((files.len(), listed.status.code()), (1, Some(0)), "{listed:?}");
}

#[test]
fn a_full_disk_loses_the_recording_and_a_robot_that_goes_on_says_so() {
    let cell = TestCell::new();
    let Some(disk) = SmallDisk::new(&cell, "size=16m") else { return };
    let config = cell.config(&[("recording", "on_log_failure = \"continue\""), HTTP, QUICK]);
    let daemon = disk.spawn_daemon(&config);
    let address = address_of(&daemon);
    let mut client = Client::new(&cell);
    client.send_until("a command", || metric(&address, SENT) >= 1.0);
    disk.fill(1024);
    client.send_until("a failure", || part(&address, "recorder").1 == "failed");
    let line = daemon.wait_for_line("recording has failed");
    assert!(line.contains("No space left on device"), "{line}");
    let (code, _, detail) = part(&address, "recorder");
    assert!(code == 503 && detail.contains("No space left on device"), "{code} {detail}");
    let sent = metric(&address, SENT);
    client.send_until("commands that go on", || metric(&address, SENT) >= sent + 3.0);
    daemon.wait_for_line("a command is given that is not recorded");
    assert!(metric(&address, "samsod_recorder_commands_not_written_total") >= 3.0);
    assert_eq!(metric(&address, "samsod_robot_latched"), 0.0);
    let frames = f64::from(client.sent);
    wait_for("vision that goes on", || (metric(&address, PROCESSED) == frames).then_some(()));

    // Read-only it is no better, and another word.
    wait_for("a read-only disk", || disk.remount("ro").then_some(()));
    let line = daemon.wait_for_line("Read-only file system");
    assert!(line.contains("still nothing is recorded"), "{line}");
    let sent = metric(&address, SENT);
    client.send_until("commands that go on", || metric(&address, SENT) > sent);
    assert!(disk.remount("rw"));
    disk.empty();
    daemon.wait_for_line("recording again");
    let written = metric(&address, WRITTEN);
    client.send_until("frames that are written", || metric(&address, WRITTEN) > written);
    let ended = daemon.terminate();
    assert_eq!(ended.status.code(), Some(3), "{ended:?}");
    assert!(ended.stdout.contains("commands not written"), "{ended:?}");

    let files = disk.recordings();
    assert_eq!(files.len(), 2, "{files:?}");
    let cut = disk.samsod(&["recording", &files[0]]);
    assert_eq!(cut.status.code(), Some(3), "{cut:?}");
    let recovered = disk.samsod(&["recover", &files[0]]);
    assert!(matches!(recovered.status.code(), Some(0 | 3)), "{recovered:?}");
    let whole = disk.samsod(&["recording", &files[0].replace(".mcap", "-recovered.mcap")]);
    assert_eq!(whole.status.code(), Some(0), "{whole:?}");
    let frames = |ended: &Ended| ended.stdout.lines().find(|line| line.starts_with("frames ")).map(str::to_owned);
    assert_eq!((frames(&whole), frames(&whole).is_some()), (frames(&cut), true), "{whole:?} {cut:?}");
    disk.samsod(&["recording", &files[1]]).assert_success();
}

#[test]
fn a_read_only_disk_is_refused_at_the_start_unless_the_robot_goes_on_anyway() {
    let cell = TestCell::new();
    let Some(disk) = SmallDisk::new(&cell, "size=16m,ro") else { return };
    let ended = disk.spawn_daemon(&cell.config(&[])).wait();
    assert_eq!(ended.status.code(), Some(1), "{ended:?}");
    assert!(ended.stderr.contains("Read-only file system"), "{ended:?}");
    assert!(ended.stderr.contains(cell.path("recordings").to_str().unwrap()), "{ended:?}");

    let config = cell.config(&[("recording", "on_log_failure = \"continue\""), HTTP, QUICK]);
    let daemon = disk.spawn_daemon(&config);
    let address = address_of(&daemon);
    let (code, state, detail) = part(&address, "recorder");
    assert_eq!((code, state.as_str()), (503, "failed"), "{detail}");
    let mut client = Client::new(&cell);
    client.send_until("a command", || metric(&address, SENT) >= 1.0);
    assert!(disk.remount("rw"));
    daemon.wait_for_line("recording again");
    client.send_until("frames that are written", || metric(&address, WRITTEN) > 0.0);
    assert_eq!(daemon.terminate().status.code(), Some(3));
    disk.samsod(&["recording", &disk.recordings()[0]]).assert_success();
}

#[test]
fn what_a_killed_samsodd_leaves_is_made_whole() {
    let cell = TestCell::new();
    let daemon = cell.spawn_daemon(&cell.config(&[HTTP, QUICK]), &[]);
    let address = address_of(&daemon);
    let mut client = Client::new(&cell);
    client.send_until("frames and a command", || metric(&address, WRITTEN) >= 3.0 && metric(&address, SENT) >= 1.0);
    let sent = metric(&address, SENT);
    let file = cell.recordings().remove(0);
    let name = file.to_str().unwrap();
    let refused = support::samsod(&["recover", name]);
    assert_eq!(refused.status.code(), Some(1), "{refused:?}");
    assert!(refused.stderr.contains("is being recorded to"), "{refused:?}");
    daemon.kill();

    let out = cell.path("whole.mcap");
    let recovered = support::samsod(&["recover", name, "--out", out.to_str().unwrap()]);
    assert!(matches!(recovered.status.code(), Some(0 | 3)), "{recovered:?}");
    assert!(recovered.stdout.contains(", was not closed"), "{recovered:?}");
    support::assert_closed(&out);
    let messages = support::messages(&out);
    assert!(support::count(&messages, "/robot/command") as f64 >= sent, "a command is in it before it is given");
    assert!(support::count(&messages, "/camera/image") >= 3);
    let again = support::samsod(&["recover", name, "--out", out.to_str().unwrap()]);
    assert_eq!(again.status.code(), Some(1), "{again:?}");
    assert!(again.stderr.contains("whole.mcap") && again.stderr.contains("File exists"), "{again:?}");
}
