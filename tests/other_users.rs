//! Other users of the machine: they can neither read frames nor send them, nor command the robot, nor take the place of samsodd
//! before it is started.
//!
//! Needs root, to be two other users; otherwise it says so and passes.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "helpers of tests fail by panicking")]

mod support;

use std::fs;
use std::os::unix::fs::{MetadataExt, PermissionsExt, chown};
use std::path::{Path, PathBuf};
use std::process::Command;

use support::{Ended, Process, TestCell};

/// The user of samsodd, and one who has no business with it. Neither needs a name.
const OWNER: u32 = 65_533;
const STRANGER: u32 = 65_534;

/// A cell in a folder that everybody may enter, with programs that everybody may run.
struct OpenCell {
    cell: TestCell,
}

impl OpenCell {
    /// None without root.
    fn new() -> Option<Self> {
        if fs::metadata("/proc/self").unwrap().uid() != 0 {
            eprintln!("skipped: only root can be other users");
            return None;
        }
        let cell = TestCell::new();
        let folder = cell.path(".");
        chown(&folder, Some(OWNER), Some(OWNER)).unwrap();
        fs::set_permissions(&folder, fs::Permissions::from_mode(0o755)).unwrap();
        for (name, program) in [("samsod", env!("CARGO_BIN_EXE_samsod")), ("samsodd", env!("CARGO_BIN_EXE_samsodd"))] {
            fs::copy(program, cell.path(name)).unwrap();
            fs::set_permissions(cell.path(name), fs::Permissions::from_mode(0o755)).unwrap();
        }
        Some(Self { cell })
    }

    fn spawn(&self, user: u32, program: &Path, arguments: &[&str]) -> Process {
        let mut command = Command::new("setpriv");
        command.args([format!("--reuid={user}"), format!("--regid={user}"), "--clear-groups".to_owned()]);
        command.arg(program).args(arguments).current_dir(self.cell.path("."));
        Process::spawn(command)
    }

    fn samsod(&self, user: u32, arguments: &[&str]) -> Ended {
        self.spawn(user, &self.cell.path("samsod"), arguments).wait()
    }

    fn daemon(&self, config: &Path) -> Process {
        self.spawn(OWNER, &self.cell.path("samsodd"), &["--config", config.to_str().unwrap()])
    }

    /// Runs a line of shell.
    fn shell(&self, user: u32, line: &str) -> Ended {
        self.spawn(user, Path::new("/bin/sh"), &["-c", line]).wait()
    }
}

/// All files below a folder.
fn files_below(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    entries.flat_map(|path| if path.is_dir() { files_below(&path) } else { vec![path] }).collect()
}

#[test]
fn others_can_neither_read_nor_send_nor_command() {
    let Some(open) = OpenCell::new() else { return };
    let cell = &open.cell;
    let config = cell.config(&[]);
    let config_text = config.to_str().unwrap();
    let daemon = open.daemon(&config);
    daemon.wait_for_line("ready, waiting for frames");
    let images = cell.images(3);
    let images = images.to_str().unwrap();
    let client = open.spawn(OWNER, &cell.path("samsod"), &["publish", images, "--config", config_text, "--loop"]);
    daemon.wait_for_line("frames from a new client");
    daemon.wait_for_line("command");

    // What is served to this user is refused to the other.
    let status = open.samsod(OWNER, &["status", "--config", config_text]);
    status.assert_success();
    for command in ["status", "hold", "resume", "new-jig"] {
        let refused = open.samsod(STRANGER, &[command, "--config", config_text]);
        assert!(!refused.status.success(), "{command}: {refused:?}");
        assert!(refused.stderr.contains("Permission denied"), "{command}: {refused:?}");
    }
    let refused = open.samsod(STRANGER, &["publish", images, "--config", config_text, "--count", "1", "--wait", "1"]);
    assert!(!refused.status.success(), "{refused:?}");
    assert!(refused.stderr.contains("it belongs to user 65533, and this is user 65534"), "{refused:?}");

    // Programs of the other user may be anything: what counts is what the system lets them open.
    let in_shared_memory = fs::read_dir("/dev/shm").unwrap().map(|entry| entry.unwrap().path());
    let of_owner = |path: &PathBuf| fs::metadata(path).is_ok_and(|metadata| metadata.uid() == OWNER);
    let mut files: Vec<PathBuf> = in_shared_memory.filter(of_owner).collect();
    assert!(files.len() >= 4, "frames, scenes and their books: {files:?}");
    for folder in ["shm", "recordings"] {
        let below = files_below(&cell.path(folder));
        assert!(!below.is_empty(), "{folder}");
        files.extend(below);
    }
    for file in &files {
        let name = file.display();
        for (what, line) in [("read", format!("cat '{name}' >/dev/null")), ("write", format!("echo >>'{name}'"))] {
            let refused = open.shell(STRANGER, &line);
            assert!(!refused.status.success(), "{name}: another user may {what} it");
        }
    }
    for folder in ["shm", "recordings"] {
        let listed = open.shell(STRANGER, &format!("ls '{}'", cell.path(folder).display()));
        assert!(!listed.status.success(), "{folder}: {listed:?}");
    }

    // Nothing of it has come through.
    let status = open.samsod(OWNER, &["status", "--config", config_text]);
    assert!(!status.stdout.contains("hold"), "{status:?}");
    client.terminate().assert_success();
    let ended = daemon.terminate();
    ended.assert_success();
    assert_eq!(ended.stderr.matches("frames from a new client").count(), 0, "only the one that was seen");
}

#[test]
fn a_place_that_a_stranger_has_taken_first_is_not_used() {
    let Some(open) = OpenCell::new() else { return };
    let cell = &open.cell;
    let config = cell.config(&[]);
    let root = cell.path("shm");
    fs::create_dir(&root).unwrap();
    chown(&root, Some(STRANGER), Some(STRANGER)).unwrap();
    fs::set_permissions(&root, fs::Permissions::from_mode(0o777)).unwrap();
    let ended = open.daemon(&config).wait();
    assert_eq!(ended.status.code(), Some(1), "{ended:?}");
    let expected = format!("root_path {}: it belongs to user 65534, and this is user 65533", root.display());
    assert!(ended.stderr.contains(&expected), "{ended:?}");
    assert_eq!(fs::read_dir(&root).unwrap().count(), 0, "nothing is put there");

    // One's own folder that everybody may write to is no better.
    chown(&root, Some(OWNER), Some(OWNER)).unwrap();
    let ended = open.daemon(&config).wait();
    assert_eq!(ended.status.code(), Some(1), "{ended:?}");
    assert!(ended.stderr.contains("others may write to it (mode 777)"), "{ended:?}");
    fs::set_permissions(&root, fs::Permissions::from_mode(0o700)).unwrap();
    let daemon = open.daemon(&config);
    daemon.wait_for_line("ready, waiting for frames");
    daemon.terminate().assert_success();
}

#[test]
fn names_in_tmp_that_a_stranger_has_taken_are_told() {
    let Some(open) = OpenCell::new() else { return };
    // Without a root path the lock and the socket lie in /tmp.
    let name = format!("squat-{}", std::process::id());
    let config = open.cell.path("tmp.toml");
    let recordings = open.cell.path("recordings");
    fs::write(&config, format!("[cell]\nname = \"{name}\"\n[recording]\nfolder = {recordings:?}\n[view]\n")).unwrap();
    let (lock, socket) = (format!("/tmp/samsod-{name}.lock"), format!("/tmp/samsod-{name}.sock"));
    open.shell(STRANGER, &format!("umask 0; echo 1 >'{lock}'")).assert_success();
    let ended = open.daemon(&config).wait();
    fs::remove_file(&lock).unwrap();
    assert_eq!(ended.status.code(), Some(1), "{ended:?}");
    assert!(ended.stderr.contains(&lock), "{ended:?}");

    open.shell(STRANGER, &format!("umask 0; echo 1 >'{socket}'")).assert_success();
    let ended = open.daemon(&config).wait();
    let asked = open.samsod(OWNER, &["status", "--cell", &name]);
    fs::remove_file(&socket).unwrap();
    // The daemon's own lock stays.
    let _ = fs::remove_file(&lock);
    assert_eq!(ended.status.code(), Some(1), "{ended:?}");
    assert!(ended.stderr.contains(&format!("cannot open the operator's socket {socket}")), "{ended:?}");
    assert!(!asked.status.success(), "{asked:?}");
    assert!(asked.stderr.contains("belongs to user 65534, not to this user"), "{asked:?}");
}
