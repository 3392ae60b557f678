//! The entry points of the fuzz targets, over the kept corpus and random bytes: what a stable compiler can run.

// A test says what went wrong best by stopping there.
#![allow(clippy::unwrap_used, clippy::panic)]

#[path = "../../../fuzz/reply_entry_points.rs"]
mod replies;
#[path = "../../../fuzz/request_entry_points.rs"]
mod requests;

use std::path::Path;

use proptest::collection::vec;
use proptest::prelude::*;

fn over_the_corpus(name: &str, entry_point: fn(&[u8])) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fuzz/corpus").join(name);
    let mut files = 0;
    for file in std::fs::read_dir(folder).unwrap() {
        let bytes = std::fs::read(file.unwrap().path()).unwrap();
        entry_point(&bytes);
        // Cut off anywhere, and with any byte changed.
        for at in 0..bytes.len().min(200) {
            entry_point(&bytes[..at]);
            let mut changed = bytes.clone();
            changed[at] ^= 0x2d;
            entry_point(&changed);
        }
        files += 1;
    }
    assert!(files >= 7, "only {files} files in the corpus of {name}");
}

#[test]
fn the_corpus_of_replies_holds() {
    over_the_corpus("reply", replies::reply);
}

#[test]
fn the_corpus_of_requests_holds() {
    over_the_corpus("request", requests::request);
}

/// Pieces of the protocol in any order, and any bytes between them.
fn stream() -> impl Strategy<Value = Vec<u8>> {
    let pieces = [
        "OK:",
        "OK: HOLD",
        "NG: no",
        "ERROR: ",
        "(2010)",
        "0000",
        "\r\n",
        "\r",
        "\n",
        ",",
        "192,64",
        "400.5",
        "-",
        "nan",
        "CONNECT Robot_access Keep-Alive:",
        "-1",
        "2",
        "HOSTCTRL_REQUEST ",
        "HOLD",
        " ",
        "1",
    ];
    let piece = prop_oneof![
        6 => prop::sample::select(pieces.to_vec()).prop_map(|piece| piece.as_bytes().to_vec()),
        1 => vec(any::<u8>(), 1..6),
    ];
    vec(piece, 0..40).prop_map(|pieces| pieces.concat())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 3000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_stream_holds(bytes in stream()) {
        replies::reply(&bytes);
        requests::request(&bytes);
    }

    #[test]
    fn any_conversation_of_a_host_holds(rest in stream()) {
        let start = b"CONNECT Robot_access Keep-Alive:-1\r\n";
        requests::request(&[&start[..], &rest].concat());
    }

    #[test]
    fn any_bytes_hold(bytes in vec(any::<u8>(), 0..3000)) {
        replies::reply(&bytes);
        requests::request(&bytes);
    }
}
