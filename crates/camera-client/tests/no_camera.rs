//! `samsod-camera` without a camera: what is printed, and what is refused.

#![allow(clippy::unwrap_used, reason = "helpers of tests fail by panicking, too")]

use std::fs;
use std::process::{Command, Output};

fn samsod_camera(config: &str, arguments: &[&str]) -> Output {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("camera-client.toml");
    fs::write(&path, config).unwrap();
    let program = env!("CARGO_BIN_EXE_samsod-camera");
    Command::new(program).args(["--config", path.to_str().unwrap()]).args(arguments).output().unwrap()
}

#[test]
fn the_configuration_in_force_is_printed() {
    let printed = samsod_camera("[camera]\nexposure_us = 1500.0\n", &["--check-config"]);
    assert!(printed.status.success(), "{printed:?}");
    let text = String::from_utf8(printed.stdout).unwrap();
    for line in ["exposure_us = 1500.0", "packet_size = \"auto\"", "silent_after_ms = 1500", "trigger = \"off\""] {
        assert!(text.lines().any(|l| l == line), "{line}: {text}");
    }
    let again = samsod_camera(&text, &["--check-config"]);
    assert_eq!(String::from_utf8(again.stdout).unwrap(), text, "what it prints is a configuration");
}

#[test]
fn a_wrong_configuration_is_refused_with_code_2() {
    let refused = samsod_camera("[camera]\nbuffers = 1\n", &[]);
    assert_eq!(refused.status.code(), Some(2), "{refused:?}");
    let told = String::from_utf8(refused.stderr).unwrap();
    assert!(told.contains("[camera] buffers = 1; allowed: 2 to 64"), "{told}");
}

#[test]
#[cfg(not(feature = "v4l"))]
fn a_driver_that_was_not_built_is_refused_with_code_2() {
    let refused = samsod_camera("[camera]\ndriver = \"v4l\"\n", &[]);
    assert_eq!(refused.status.code(), Some(2), "{refused:?}");
    let told = String::from_utf8(refused.stderr).unwrap();
    assert!(
        told.contains("[camera] driver = \"v4l\"; allowed: ") && told.contains("as this program was built"),
        "{told}"
    );
}
