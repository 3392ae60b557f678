//! What is fuzzed of a host's requests: any bytes go in, and what must hold for all of them is asserted.
//!
//! Shared by the target of cargo-fuzz and by `crates/robot/tests/any_bytes.rs`, which needs no nightly compiler.

use samsod_robot::emulator::{DATA_MAX, Incoming, RequestParser};

/// Bytes from a host.
pub(crate) fn request(bytes: &[u8]) {
    let (mut whole, mut parts) = (RequestParser::new(), Vec::new());
    let fault = whole.feed(bytes, &mut parts);
    let (mut cut, mut single) = (RequestParser::new(), Vec::new());
    let single_fault = bytes.iter().try_for_each(|byte| cut.feed(&[*byte], &mut single));
    assert_eq!((&fault, &parts), (&single_fault, &single), "it must not matter how bytes are cut");
    let mut announced = 0;
    for (number, part) in parts.iter().enumerate() {
        match part {
            Incoming::Start { keep_alive } => {
                assert!(number == 0 && (*keep_alive == -1 || (1..=32767).contains(keep_alive)));
            }
            Incoming::Header { size, .. } => {
                assert!(announced == 0 && *size <= DATA_MAX);
                announced = *size;
            }
            Incoming::Data(data) => {
                assert!(announced > 0 && data.len() == announced, "{} bytes of {announced}", data.len());
                announced = 0;
            }
        }
    }
}
