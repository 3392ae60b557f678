//! The entry point of the fuzz target, over the kept corpus and random headers: what a stable compiler can run.

// A test says what went wrong best by stopping there.
#![allow(clippy::unwrap_used, clippy::panic)]

#[path = "../../../fuzz/frame_entry_points.rs"]
mod entry_points;

use std::path::Path;

use proptest::prelude::*;

#[test]
fn the_corpus_holds() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus/frame");
    let mut files = 0;
    for file in std::fs::read_dir(folder).unwrap() {
        let bytes = std::fs::read(file.unwrap().path()).unwrap();
        entry_points::frame(&bytes);
        // Cut off anywhere, and with any bit of the header flipped.
        (0..bytes.len()).for_each(|at| entry_points::frame(&bytes[..at]));
        for bit in 0..8 * bytes.len().min(80) {
            let mut changed = bytes.clone();
            changed[bit / 8] ^= 1 << (bit % 8);
            entry_points::frame(&changed);
        }
        files += 1;
    }
    assert!(files >= 5, "only {files} files");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 3000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_header_holds(
        sides in (0..40u32, 0..40u32),
        stride in prop_oneof![4 => 0..130u32, 1 => any::<u32>()],
        format in 0..10u32,
        name in prop::collection::vec(prop_oneof![3 => Just(0u8), 1 => any::<u8>()], 32),
        payload in prop::collection::vec(any::<u8>(), 0..5000),
    ) {
        let numbers = [sides.0, sides.1, stride, format].map(u32::to_le_bytes).concat();
        entry_points::frame(&[&[0; 16][..], &numbers, &name, &[0; 16], &payload].concat());
    }

    #[test]
    fn any_bytes_hold(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        entry_points::frame(&bytes);
    }
}
