//! Tells the program what it was built from: a number over all sources that a scene depends on, and the versions of the
//! dependencies. It is the same in every build of the same sources, with or without git, and another after any change.

use std::fs;
use std::path::{Path, PathBuf};

/// Below the root of the workspace.
const SOURCES: [&str; 8] = [
    "Cargo.lock",
    "src",
    "crates/camera/src",
    "crates/segment/src",
    "crates/saliency/src",
    "crates/shadow/src",
    "crates/recognize/src",
    "crates/daemon/src",
];

fn main() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let mut files = Vec::new();
    for source in SOURCES {
        let path = root.join(source);
        println!("cargo::rerun-if-changed={}", path.display());
        collect(&path, &mut files);
    }
    files.sort();
    let mut hash = Fnv::new();
    for file in &files {
        // Paths from the root on, so that the place of the workspace does not matter.
        let name = file.strip_prefix(&root).unwrap_or(file).to_string_lossy().into_owned();
        for bytes in [name.into_bytes(), fs::read(file).unwrap_or_default()] {
            hash.add(&(bytes.len() as u64).to_le_bytes());
            hash.add(&bytes);
        }
    }
    println!("cargo::rustc-env=SAMSOD_BUILD={:016x}", hash.0);
}

fn collect(path: &Path, files: &mut Vec<PathBuf>) {
    match fs::read_dir(path) {
        Ok(entries) => entries.flatten().for_each(|entry| collect(&entry.path(), files)),
        Err(_) => files.push(path.to_owned()),
    }
}

/// FNV-1a in 64 bits: tells sources apart, and nobody has a reason to forge them.
struct Fnv(u64);

impl Fnv {
    fn new() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }

    fn add(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.0 = (self.0 ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }
}
