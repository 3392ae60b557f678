#![no_main]

#[path = "../recording_entry_points.rs"]
mod entry_points;

use std::path::PathBuf;
use std::sync::OnceLock;

/// In memory, of this process alone: a disk would be the slowest part.
static FOLDER: OnceLock<PathBuf> = OnceLock::new();

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let folder = FOLDER.get_or_init(|| {
        let folder = PathBuf::from(format!("/dev/shm/samsod-fuzz-{}", std::process::id()));
        std::fs::create_dir_all(&folder).expect("a folder");
        folder
    });
    entry_points::recording(bytes, folder);
});
