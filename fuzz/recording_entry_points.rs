//! What is fuzzed of recordings: any bytes as a file, and what must hold for all of them.
//!
//! Shared by the targets of cargo-fuzz and by `crates/recording/tests/any_bytes.rs`, which needs no nightly compiler.

use std::fs;
use std::path::Path;

use samsod_recording::{Messages, ReadError, RecoverError, recover};

/// Messages in their order: topic, time, data.
type Content = Vec<(String, u64, Vec<u8>)>;

/// Messages that can be read, and whether all is well.
fn messages(path: &Path) -> Option<(Content, bool)> {
    let mut messages = match Messages::open(path) {
        Ok(messages) => messages,
        Err(ReadError::NoRecording { .. }) => return None,
        Err(error) => unreachable!("{error}"),
    };
    let mut all = Vec::new();
    loop {
        match messages.next() {
            Ok(None) => return Some((all, true)),
            Ok(Some(Ok(m))) => all.push((m.channel.topic.clone(), m.log_time, m.data.into_owned())),
            Ok(Some(Err(_damage))) => {
                assert!(matches!(messages.next(), Ok(None)), "nothing comes after damage");
                return Some((all, false));
            }
            Err(error) => unreachable!("{error}"),
        }
    }
}

/// Bytes as a recording, in a folder that may be written to.
pub(crate) fn recording(bytes: &[u8], folder: &Path) {
    let (file, out) = (folder.join("file.mcap"), folder.join("out.mcap"));
    let Ok(()) = fs::write(&file, bytes) else { unreachable!("the folder can be written to") };
    let read = messages(&file);
    match (read, recover(&file, &out)) {
        (None, Err(RecoverError::Read(ReadError::NoRecording { .. }))) => assert!(!out.exists()),
        (Some((read, _)), Ok(recovery)) => {
            let Some((recovered, true)) = messages(&out) else { unreachable!("what was recovered is whole") };
            assert_eq!(recovery.messages(), recovered.len() as u64);
            // What is whole loses nothing, and loses nothing the second time.
            assert!(recovery.has_lost_data() || recovered.len() >= read.len(), "{recovery:?}");
            let again = folder.join("again.mcap");
            let Ok(second) = recover(&out, &again) else { unreachable!("it was just read") };
            assert!(!second.has_lost_data() && second.was_closed, "{second:?}");
            assert_eq!(second.messages(), recovery.messages());
            let _ = fs::remove_file(again);
            let _ = fs::remove_file(out);
        }
        (read, recovered) => unreachable!("{read:?} {recovered:?}"),
    }
}
