//! samsodd under systemd: standard error is the journal, and events go there with their fields.

#![allow(clippy::expect_used, clippy::unwrap_used, clippy::panic, reason = "helpers of tests fail by panicking")]

mod support;

use std::collections::BTreeMap;
use std::os::unix::net::UnixDatagram;
use std::process::Command;
use std::sync::mpsc;
use std::thread;

use support::{Process, TestCell, WATCHDOG, json, messages, send};

/// Fields of an entry; values have no line feeds in this test.
fn fields(entry: &str) -> BTreeMap<String, String> {
    entry.lines().filter_map(|line| line.split_once('=')).map(|(k, v)| (k.to_owned(), v.to_owned())).collect()
}

#[test]
fn frame_command_and_outcome_are_found_by_their_ids() {
    // Another journal than that of the machine: the socket is put in its place for samsodd alone.
    let may_mount = Command::new("unshare").args(["-m", "true"]).output().is_ok_and(|output| output.status.success());
    if !may_mount {
        eprintln!("left out: no mount namespace can be made here (unshare -m); that takes root");
        return;
    }
    let cell = TestCell::new();
    let path = cell.path("journal");
    let journal = UnixDatagram::bind(&path).unwrap();
    let (sender, entries) = mpsc::channel();
    // Ends with the test program, or when the test is over and something more comes in.
    thread::spawn(move || {
        let mut buffer = vec![0; 1 << 18];
        while let Ok(length) = journal.recv(&mut buffer) {
            if sender.send(String::from_utf8_lossy(&buffer[..length]).into_owned()).is_err() {
                return;
            }
        }
    });
    // As systemd does: the stream's device and inode in JOURNAL_STREAM.
    let script = "mount -t tmpfs tmpfs /run && mkdir -p /run/systemd/journal && touch /run/systemd/journal/socket && \
                  mount --bind \"$1\" /run/systemd/journal/socket && \
                  JOURNAL_STREAM=$(stat -L -c %d:%i /proc/self/fd/2) exec \"$2\" --config \"$3\"";
    let mut command = Command::new("unshare");
    command.args(["-m", "--", "/bin/sh", "-c", script, "sh"]);
    command.arg(&path).arg(env!("CARGO_BIN_EXE_samsodd")).arg(cell.config(&[]));
    let daemon = Process::spawn(command);
    let mut seen = Vec::new();
    let mut wait_for = |message: &str| {
        loop {
            let entry = entries.recv_timeout(WATCHDOG).unwrap_or_else(|e| panic!("{message}: {e}; {seen:#?}"));
            let fields = fields(&entry);
            seen.push(entry);
            if fields["MESSAGE"].starts_with(message) {
                return fields;
            }
        }
    };
    let ready = wait_for("ready, waiting for frames");
    assert_eq!((ready["SYSLOG_IDENTIFIER"].as_str(), ready["PRIORITY"].as_str()), ("samsodd", "6"), "{ready:?}");
    assert_eq!(ready["SAMSOD_CELL"], "test-cell");
    let mut publisher = cell.publisher();
    send(&mut publisher, 3);
    let client = wait_for("frames from a new client");
    assert_eq!((client["SAMSOD_FRAME"].as_str(), client["SAMSOD_CAMERA"].as_str()), ("0", "test"), "{client:?}");
    let given = wait_for("command given");
    let ended = wait_for("command ended");
    for entry in [&given, &ended] {
        assert_eq!((entry["SAMSOD_FRAME"].as_str(), entry["SAMSOD_COMMAND"].as_str()), ("0", "1"), "{entry:?}");
    }
    assert!(given["MESSAGE"].starts_with("command given command=1 frame=0 target=("), "{given:?}");
    assert_eq!(ended["SAMSOD_OUTCOME"], "done");
    let last = daemon.terminate();
    last.assert_success();
    assert_eq!(last.stderr, "", "everything has gone to the journal");
    // The same ids as in the recording.
    let command = &json(&messages(&cell.recordings()[0]), "/robot/command")[0];
    assert_eq!((&command["id"], &command["frame_sequence"]), (&1.into(), &0.into()));
}

#[test]
fn anywhere_else_the_same_line_goes_to_standard_error() {
    let cell = TestCell::new();
    let mut command = Command::new(env!("CARGO_BIN_EXE_samsodd"));
    // Left over from the unit that started the shell: another stream than ours.
    command.arg("--config").arg(cell.config(&[])).env("JOURNAL_STREAM", "8:12345");
    let daemon = Process::spawn(command);
    daemon.wait_for_line("ready, waiting for frames");
    let mut publisher = cell.publisher();
    send(&mut publisher, 3);
    daemon.wait_for_line("command given command=1 frame=0 target=(");
    daemon.wait_for_line("command ended command=1 frame=0 outcome=done");
    daemon.terminate().assert_success();
}
