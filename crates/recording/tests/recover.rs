//! Files that were cut off, damaged, or are no recordings.

#![allow(clippy::unwrap_used, clippy::panic, reason = "helpers of tests fail by panicking")]

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::{Path, PathBuf};

use mcap::records::MessageHeader;
use samsod_recording::{Messages, ReadError, RecoverError, Recovery, recover, recovered_path};
use tempfile::TempDir;

const START_NS: u64 = 1_700_000_000_000_000_000;

/// All that is in a recording, in its order.
type Content = Vec<(String, u64, Vec<u8>)>;

fn content(path: &Path) -> Content {
    let bytes = std::fs::read(path).unwrap();
    let messages = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap);
    messages.map(|m| (m.channel.topic.clone(), m.log_time, m.data.into_owned())).collect()
}

/// The messages up to the first damage, and what that is.
fn read(path: &Path) -> Result<(Content, Option<String>), ReadError> {
    let mut messages = Messages::open(path)?;
    let mut all = Vec::new();
    while let Some(message) = messages.next()? {
        match message {
            Ok(m) => all.push((m.channel.topic.clone(), m.log_time, m.data.into_owned())),
            Err(damage) => return Ok((all, Some(damage))),
        }
    }
    Ok((all, None))
}

/// Two topics, one without a schema; an attachment, metadata and a private record; many small chunks, or none.
fn other_program(compression: Option<mcap::Compression>, use_chunks: bool) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    let options = mcap::WriteOptions::new().profile("other").compression(compression).use_chunks(use_chunks);
    let mut writer = options.chunk_size(Some(64)).create(&mut bytes).unwrap();
    let about = BTreeMap::from([("by".to_owned(), "hand".to_owned())]);
    let schema = writer.add_schema("Text", "jsonschema", b"{}").unwrap();
    let with = writer.add_channel(schema, "/with", "json", &about).unwrap();
    let without = writer.add_channel(0, "/without", "raw", &BTreeMap::new()).unwrap();
    for number in 0..12u32 {
        let channel_id = if number % 3 == 0 { without } else { with };
        let time = START_NS + u64::from(number);
        let header = MessageHeader { channel_id, sequence: number, log_time: time, publish_time: time + 1 };
        writer
            .write_to_known_channel(&header, format!("{{\"number\": {number}, \"is\": \"text\"}}").as_bytes())
            .unwrap();
        if number == 5 {
            writer.write_metadata(&mcap::records::Metadata { name: "about".into(), metadata: about.clone() }).unwrap();
            let attachment = mcap::Attachment {
                log_time: 1,
                create_time: 2,
                name: "camera.toml".into(),
                media_type: "text/plain".into(),
                data: b"[intrinsics]"[..].into(),
            };
            writer.attach(&attachment).unwrap();
            writer.write_private_record(0x90, b"of our own", Default::default()).unwrap();
        }
    }
    writer.finish().unwrap();
    drop(writer);
    bytes.into_inner()
}

/// A folder with a file to try things on.
struct Bench {
    folder: TempDir,
}

impl Bench {
    fn new() -> Self {
        Self { folder: tempfile::tempdir_in("/dev/shm").unwrap() }
    }

    fn file(&self) -> PathBuf {
        self.folder.path().join("damaged.mcap")
    }

    fn out(&self) -> PathBuf {
        self.folder.path().join("damaged-recovered.mcap")
    }

    /// What becomes of these bytes.
    fn recover(&self, bytes: &[u8]) -> Result<(Recovery, Content), RecoverError> {
        std::fs::write(self.file(), bytes).unwrap();
        let recovered = recover(&self.file(), &self.out());
        assert_eq!(std::fs::read(self.file()).unwrap(), bytes, "the original is not touched");
        match recovered {
            Ok(recovery) => {
                let found = content(&self.out());
                assert_eq!(recovery.messages(), found.len() as u64);
                assert_eq!(read(&self.out()).unwrap(), (found.clone(), None));
                assert_eq!(std::fs::metadata(self.out()).unwrap().len(), recovery.bytes_recovered);
                std::fs::remove_file(self.out()).unwrap();
                Ok((recovery, found))
            }
            Err(error) => {
                assert!(!self.out().exists(), "{error}");
                Err(error)
            }
        }
    }
}

/// Whether all of `part` stands in `whole`, in the same order.
fn is_part_of(part: &Content, whole: &Content) -> bool {
    let mut rest = whole.iter();
    part.iter().all(|message| rest.any(|other| other == message))
}

#[test]
fn everything_of_other_programs_is_kept_too() {
    for (compression, use_chunks) in
        [(None, false), (None, true), (Some(mcap::Compression::Lz4), true), (Some(mcap::Compression::Zstd), true)]
    {
        let bench = Bench::new();
        let bytes = other_program(compression, use_chunks);
        std::fs::write(bench.file(), &bytes).unwrap();
        let recovery = recover(&bench.file(), &bench.out()).unwrap();
        assert!(recovery.was_closed && !recovery.has_lost_data(), "{recovery:?}");
        assert_eq!((recovery.messages(), recovery.attachments, recovery.metadata), (12, 1, 1));
        assert_eq!(content(&bench.out()), content(&bench.file()));
        let (old, new) = (bytes, std::fs::read(bench.out()).unwrap());
        let summary = |bytes: &[u8]| mcap::Summary::read(bytes).unwrap().unwrap();
        assert_eq!((summary(&new).channels, summary(&new).schemas), (summary(&old).channels, summary(&old).schemas));
        let index = &summary(&new).attachment_indexes[0];
        let attachment = mcap::read::attachment(&new, index).unwrap();
        assert_eq!((attachment.name.as_str(), &*attachment.data), ("camera.toml", &b"[intrinsics]"[..]));
        let index = &summary(&new).metadata_indexes[0];
        assert_eq!(mcap::read::metadata(&new, index).unwrap().metadata["by"], "hand");
        let records = mcap::read::LinearReader::new(&new).unwrap().map(Result::unwrap);
        let is_private =
            |r: &mcap::records::Record<'_>| matches!(r, mcap::records::Record::Unknown { opcode: 0x90, .. });
        assert_eq!(records.filter(is_private).count(), 1);
        assert!(new.windows(5).any(|bytes| bytes == b"other"), "the profile");
    }
}

#[test]
fn whatever_is_cut_off_the_rest_is_recovered_byte_by_byte() {
    let bench = Bench::new();
    for (compression, use_chunks) in
        [(None, false), (None, true), (Some(mcap::Compression::Lz4), true), (Some(mcap::Compression::Zstd), true)]
    {
        let bytes = other_program(compression, use_chunks);
        std::fs::write(bench.file(), &bytes).unwrap();
        let whole = content(&bench.file());
        let data_end = {
            let summary = mcap::read::footer(&bytes).unwrap().summary_start;
            summary as usize - 9 - 4
        };
        let mut most = 0;
        for length in 0..bytes.len() {
            match bench.recover(&bytes[..length]) {
                Ok((recovery, found)) => {
                    assert!(length >= 8 && !recovery.was_closed, "{length}");
                    assert!(found.iter().zip(&whole).all(|(a, b)| a == b), "{length}: not what was recorded");
                    assert!(found.len() >= most || length > data_end, "more bytes, fewer messages: {length}");
                    most = most.max(found.len());
                    assert!(recovery.has_lost_data() || found.len() <= whole.len());
                    if length >= data_end {
                        assert_eq!(found.len(), whole.len(), "{length}");
                        assert!(!recovery.has_lost_data() || length < data_end + 13, "{length}: {recovery:?}");
                    }
                    let lost: u64 = recovery.losses.iter().map(|loss| loss.bytes).sum();
                    assert!(lost <= length as u64, "{recovery:?}");
                    let (before, damage) = read(&bench.file()).unwrap();
                    assert!(damage.is_some() && before.len() <= found.len(), "{length}");
                }
                Err(error) => {
                    assert!(
                        length < 8 && matches!(error, RecoverError::Read(ReadError::NoRecording { .. })),
                        "{error}"
                    );
                }
            }
        }
        assert_eq!(most, whole.len());
    }
}

#[test]
fn no_bit_that_flips_makes_up_a_message_or_goes_unnoticed() {
    let bench = Bench::new();
    for compression in [None, Some(mcap::Compression::Lz4), Some(mcap::Compression::Zstd)] {
        let bytes = other_program(compression, true);
        std::fs::write(bench.file(), &bytes).unwrap();
        let whole = content(&bench.file());
        let data_end = mcap::read::footer(&bytes).unwrap().summary_start as usize - 9 - 4;
        let mut recovered = 0;
        let mut trials = 0;
        for at in 0..bytes.len() {
            let mut flipped = bytes.clone();
            flipped[at] ^= 1 << (at % 8);
            match bench.recover(&flipped) {
                Ok((recovery, found)) => {
                    let topics: Vec<&str> = whole.iter().map(|(topic, ..)| topic.as_str()).collect();
                    // A name outside of a chunk has no checksum of its own; the whole file then says that something is wrong.
                    let is_known = found.iter().all(|(topic, ..)| topics.contains(&topic.as_str()));
                    assert!(is_part_of(&found, &whole) || !is_known, "byte {at}: made up");
                    assert!(found.len() == whole.len() || recovery.has_lost_data(), "byte {at}: lost unnoticed");
                    if at < data_end {
                        assert!(recovery.has_lost_data(), "byte {at}: {recovery:?}");
                    }
                    recovered += found.len();
                    trials += 1;
                }
                Err(error) => assert!(at < 8, "byte {at}: {error}"),
            }
            // Neither hang nor panic; what they say is for them.
            let _ = read(&bench.file());
        }
        assert!(
            recovered * 10 > trials * whole.len() * 5,
            "most is still there: {recovered} of {trials} x {}",
            whole.len()
        );
    }
}

#[test]
fn a_damaged_chunk_is_passed_over_and_its_index_tells_what_was_in_it() {
    let bench = Bench::new();
    let bytes = other_program(Some(mcap::Compression::Zstd), true);
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    // The second: the first describes the topics.
    let index = &summary.chunk_indexes[1];
    let at = index.compressed_data_offset().unwrap() + index.compressed_size / 2;
    let mut damaged = bytes.clone();
    damaged[at as usize] ^= 0x10;
    let (recovery, found) = bench.recover(&damaged).unwrap();
    let [loss] = &recovery.losses[..] else { panic!("{recovery:?}") };
    assert_eq!((loss.at, loss.bytes), (index.chunk_start_offset, index.chunk_length));
    assert!(loss.what.starts_with("a damaged chunk: "), "{loss:?}");
    let lost: u64 = recovery.topics.iter().map(|topic| topic.lost).sum();
    assert!(lost > 0 && lost + recovery.messages() == 12, "{recovery:?}");
    std::fs::write(bench.file(), &bytes).unwrap();
    assert!(is_part_of(&found, &content(&bench.file())));
    assert!(found.last() == content(&bench.file()).last(), "what comes after it is there");
}

#[test]
fn what_is_no_recording_in_use_or_there_already_is_refused() {
    let bench = Bench::new();
    for (bytes, what) in [
        (&b""[..], "it is empty"),
        (b"not a recording", "it begins with \"not a re\""),
        (b"\x89MCAP", "not with the magic of MCAP"),
        (b"\x89PNG\r\n\x1a\n", "not with the magic of MCAP"),
    ] {
        let error = bench.recover(bytes).unwrap_err().to_string();
        assert!(error.contains(what) && error.contains("damaged.mcap"), "{error}");
        let error = read(&bench.file()).unwrap_err().to_string();
        assert!(error.contains(what), "{error}");
    }
    let folder = bench.folder.path();
    let error = recover(folder, &bench.out()).unwrap_err().to_string();
    assert!(error.contains("it is a folder"), "{error}");
    assert!(read(folder).unwrap_err().to_string().contains("it is a folder"));
    let missing = recover(&folder.join("missing.mcap"), &bench.out()).unwrap_err().to_string();
    assert!(missing.contains("missing.mcap: No such file"), "{missing}");

    std::fs::write(bench.file(), other_program(None, true)).unwrap();
    for out in [bench.out(), folder.to_path_buf(), bench.file()] {
        if out == bench.out() {
            std::fs::write(&out, "there already").unwrap();
        }
        let error = recover(&bench.file(), &out).unwrap_err().to_string();
        assert!(error.contains("File exists") && error.contains(out.to_str().unwrap()), "{error}");
    }
    assert_eq!(std::fs::read_to_string(bench.out()).unwrap(), "there already");

    let written = std::fs::File::open(bench.file()).unwrap();
    written.lock().unwrap();
    let error = recover(&bench.file(), &folder.join("new.mcap")).unwrap_err();
    assert!(matches!(error, RecoverError::InUse { .. }), "{error}");
    drop(written);
    assert!(!recover(&bench.file(), &folder.join("new.mcap")).unwrap().has_lost_data());
    assert_eq!(recovered_path(Path::new("/a/left.mcap")), Path::new("/a/left-recovered.mcap"));
}

#[test]
fn attachments_and_chunks_that_lie_about_their_lengths_are_damage() {
    let bench = Bench::new();
    let record = |opcode: u8, body: &[u8]| [&[opcode][..], &(body.len() as u64).to_le_bytes(), body].concat();
    let file = |records: &[Vec<u8>]| [mcap::MAGIC.to_vec(), record(1, &[0; 8]), records.concat()].concat();
    let name = |length: u32| length.to_le_bytes();
    // Names and data that reach beyond the record, and one without room for its checksum.
    let short = [&[0; 16][..], &name(0), &name(0), &0u64.to_le_bytes()].concat();
    let long_name = [&[0; 16][..], &name(u32::MAX), &name(0), &[0; 12]].concat();
    let long_data = [&[0; 16][..], &name(0), &name(0), &u64::MAX.to_le_bytes(), &[0; 4]].concat();
    for body in [&short[..], &long_name, &long_data, b"", &[0; 19]] {
        let (recovery, _) = bench.recover(&file(&[record(9, body)])).unwrap();
        assert!(recovery.has_lost_data() && recovery.attachments == 0, "{recovery:?}");
        let _ = read(&bench.file());
    }
    // Names of four gigabytes: nobody asks for the memory.
    let name_and_map = [&name(u32::MAX)[..], &name(0)].concat();
    let map = [&name(0)[..], &name(u32::MAX), &name(u32::MAX)].concat();
    let schema = [&[1, 0][..], &name(u32::MAX), &name(0), &name(0)].concat();
    let channel = [&[1, 0, 0, 0][..], &name(0), &name(u32::MAX), &name(0)].concat();
    for (opcode, body) in [(12, &name_and_map[..]), (12, &map), (3, &schema), (4, &channel), (8, &[255; 60])] {
        let (recovery, _) = bench.recover(&file(&[record(opcode, body)])).unwrap();
        assert!(recovery.has_lost_data() && recovery.metadata == 0, "{opcode}: {recovery:?}");
        let (messages, damage) = read(&bench.file()).unwrap();
        assert!(messages.is_empty() && damage.is_some());
    }
    // A record that is longer than the chunk around it, which is not compressed.
    let inner = [&[5u8][..], &1000u64.to_le_bytes(), &[0; 30]].concat();
    let size = inner.len() as u64;
    let chunk = [&[0; 16][..], &size.to_le_bytes(), &[0; 4], &name(0), &size.to_le_bytes(), &inner].concat();
    let (recovery, _) = bench.recover(&file(&[record(6, &chunk), vec![0; 2000]])).unwrap();
    assert!(recovery.losses[0].what.contains("reaches beyond its end"), "{recovery:?}");
    assert!(read(&bench.file()).unwrap().1.unwrap().contains("reaches beyond its end"));
    // A chunk that promises more than any memory holds.
    for compression in ["zstd", "lz4", ""] {
        let data = [0u8; 64];
        let length = name(compression.len() as u32);
        let head = [&[0; 16][..], &u64::MAX.to_le_bytes(), &[0; 4], &length, compression.as_bytes()].concat();
        let chunk = [&head[..], &u64::MAX.to_le_bytes(), &data].concat();
        let (recovery, _) = bench.recover(&file(&[record(6, &chunk)])).unwrap();
        assert!(recovery.has_lost_data(), "{compression}: {recovery:?}");
        assert!(read(&bench.file()).unwrap().1.is_some());
    }
}
