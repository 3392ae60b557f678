//! The entry point of the fuzz target, over the kept corpus and what random changes make of it: what a stable compiler can run.

// A test says what went wrong best by stopping there.
#![allow(clippy::unwrap_used, clippy::panic)]

#[path = "../../../fuzz/recording_entry_points.rs"]
mod entry_points;

use std::path::Path;

use proptest::prelude::*;

fn corpus() -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus/recording");
    let files = std::fs::read_dir(folder).unwrap().map(|file| std::fs::read(file.unwrap().path()).unwrap());
    files.collect()
}

#[test]
fn the_corpus_holds() {
    let folder = tempfile::tempdir().unwrap();
    let all = corpus();
    assert!(all.len() >= 6, "only {} files", all.len());
    all.iter().for_each(|bytes| entry_points::recording(bytes, folder.path()));
}

/// What damage does: bytes changed, cut out, repeated, put in.
fn damaged() -> impl Strategy<Value = Vec<u8>> {
    let all = corpus();
    let change = (any::<prop::sample::Index>(), any::<prop::sample::Index>(), any::<u8>(), 0..5u8);
    (prop::sample::select(all), prop::collection::vec(change, 1..6)).prop_map(|(mut bytes, changes)| {
        for (at, to, byte, kind) in changes {
            if bytes.is_empty() {
                return bytes;
            }
            let (at, to) = (at.index(bytes.len()), to.index(bytes.len()));
            let (from, until) = (at.min(to), at.max(to));
            match kind {
                0 => bytes[at] = byte,
                1 => bytes[at] ^= 1 << (byte % 8),
                2 => bytes.truncate(at.max(8)),
                3 => drop(bytes.drain(from..until.min(from + 40))),
                _ => {
                    let part = bytes[from..until.min(from + 200)].to_vec();
                    bytes.splice(at..at, part);
                }
            }
        }
        bytes
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_damage_holds(bytes in damaged()) {
        let folder = tempfile::tempdir_in("/dev/shm").unwrap();
        entry_points::recording(&bytes, folder.path());
    }

    #[test]
    fn any_bytes_behind_the_magic_hold(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let folder = tempfile::tempdir_in("/dev/shm").unwrap();
        entry_points::recording(&[b"\x89MCAP0\r\n", &bytes[..]].concat(), folder.path());
    }
}
