//! A full `/dev/shm`: who finds no room in it says so at its start; who has started goes on.
//!
//! Needs root, to have a `/dev/shm` of its own; otherwise it says so and passes.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail by panicking")]

mod support;

use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::process::Command;

use support::{Process, TestCell, test_data};

fn is_root() -> bool {
    let is_root = fs::metadata("/proc/self").unwrap().uid() == 0;
    if !is_root {
        eprintln!("skipped: only root can mount a /dev/shm");
    }
    is_root
}

/// samsodd with a `/dev/shm` of this size, MiB.
fn daemon_in(cell: &TestCell, size_mib: u32, config: &Path) -> Process {
    let mut command = Command::new("unshare");
    let mount = format!("mount -t tmpfs -o size={size_mib}m none /dev/shm && exec \"$@\"");
    command.args(["--mount", "/bin/sh", "-c", &mount, "sh", env!("CARGO_BIN_EXE_samsodd"), "--config"]);
    command.arg(config).current_dir(cell.path("."));
    Process::spawn(command)
}

/// A program in the `/dev/shm` of that daemon.
fn beside(daemon: &Process, program: &str, arguments: &[&str]) -> Process {
    let mut command = Command::new("nsenter");
    command.args(["--mount", "--target", &daemon.id().to_string(), program]).args(arguments);
    Process::spawn(command)
}

#[test]
fn no_room_is_told_at_the_start() {
    if !is_root() {
        return;
    }
    let cell = TestCell::new();
    let ended = daemon_in(&cell, 1, &cell.config(&[])).wait();
    assert_eq!(ended.status.code(), Some(1), "{ended:?}");
    assert!(ended.stderr.contains("bytes are needed in /dev/shm, "), "{ended:?}");
    assert!(ended.stderr.contains("--shm-size"), "{ended:?}");
}

#[test]
fn a_client_without_room_says_so_and_one_that_has_its_memory_goes_on() {
    if !is_root() {
        return;
    }
    let cell = TestCell::new();
    let config = cell.config(&[]);
    let config = config.to_str().unwrap();
    let daemon = daemon_in(&cell, 32, Path::new(config));
    daemon.wait_for_line("ready, waiting for frames");
    let samsod = env!("CARGO_BIN_EXE_samsod");
    // Frames of 3 MB, 17 times.
    let (large, small) = (test_data("cell"), cell.images(3));
    let refused = beside(&daemon, samsod, &["publish", large.to_str().unwrap(), "--config", config]).wait();
    assert_eq!(refused.status.code(), Some(1), "{refused:?}");
    assert!(refused.stderr.contains("test-cell/frames") && refused.stderr.contains("/dev/shm"), "{refused:?}");

    let arguments = ["publish", small.to_str().unwrap(), "--config", config, "--loop", "--rate", "50"];
    let client = beside(&daemon, samsod, &arguments);
    daemon.wait_for_line("frames from a new client");
    let fill = beside(&daemon, "/bin/sh", &["-c", "cat /dev/zero >/dev/shm/fill"]).wait();
    assert!(fill.stderr.contains("No space left"), "{fill:?}");
    let late = beside(&daemon, samsod, &arguments).wait();
    assert_eq!(late.status.code(), Some(1), "{late:?}");
    for _ in 0..20 {
        daemon.wait_for_line("command ended");
    }
    client.terminate().assert_success();
    daemon.terminate().assert_success();
}
