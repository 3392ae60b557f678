//! What samsodd has recorded, recovered: whole, cut off, damaged. Other files are in crates/recording.

use std::path::{Path, PathBuf};

use super::tests::{config, frame, log_motion, log_surely, square};
use super::*;

/// All that is in a recording, in its order.
type Content = Vec<(String, u64, Vec<u8>)>;

fn content(path: &Path) -> Content {
    let bytes = std::fs::read(path).unwrap();
    let messages = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap);
    messages.map(|m| (m.channel.topic.clone(), m.log_time, m.data.into_owned())).collect()
}

/// Three frames, a command between them.
fn record(folder: &Path) -> PathBuf {
    let (image, scene) = frame(16, 12, square);
    let recorder = Recorder::start(&config(folder), "demo").unwrap();
    for sequence in 0..3 {
        log_surely(&recorder, sequence, &image, &scene);
        log_motion(&recorder, sequence).unwrap();
    }
    recorder.finish().unwrap().files.remove(0)
}

/// Recovers these bytes; the original is not touched, and what comes of it is whole.
fn recovered(bytes: &[u8]) -> (Recovery, Content) {
    let folder = tempfile::tempdir_in("/dev/shm").unwrap();
    let (file, out) = (folder.path().join("damaged.mcap"), folder.path().join("out.mcap"));
    std::fs::write(&file, bytes).unwrap();
    let recovery = recover(&file, &out).unwrap();
    assert_eq!(std::fs::read(&file).unwrap(), bytes);
    let survey = survey(&out).unwrap();
    assert_eq!((survey.damage, survey.bytes), (None, recovery.bytes_recovered));
    (recovery, content(&out))
}

#[test]
fn a_whole_recording_is_recovered_as_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let path = record(folder.path());
    let (recovery, found) = recovered(&std::fs::read(&path).unwrap());
    assert_eq!(found, content(&path));
    assert!(recovery.was_closed && !recovery.has_lost_data(), "{recovery:?}");
    assert_eq!((recovery.attachments, recovery.metadata), (0, 1));
    let topic = |name: &str| recovery.topics.iter().find(|t| t.name == name).unwrap().recovered;
    assert_eq!((topic("/camera/image"), topic("/robot/command"), topic("/robot/outcome")), (3, 3, 0));
}

#[test]
fn of_a_recording_that_is_cut_off_everything_before_the_cut_is_recovered() {
    let folder = tempfile::tempdir().unwrap();
    let path = record(folder.path());
    let (bytes, whole) = (std::fs::read(&path).unwrap(), content(&path));
    let mut most = 0;
    for length in (8..bytes.len()).step_by(173) {
        let (recovery, found) = recovered(&bytes[..length]);
        assert!(found.iter().zip(&whole).all(|(a, b)| a == b), "{length}: not what was recorded");
        assert!(!recovery.was_closed && found.len() >= most, "more bytes, fewer messages: {length}");
        most = found.len();
    }
    assert_eq!(most, whole.len());
}

#[test]
fn topics_whose_description_is_damaged_are_known_from_the_index() {
    let folder = tempfile::tempdir().unwrap();
    let path = record(folder.path());
    let bytes = std::fs::read(&path).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let mut damaged = bytes.clone();
    // One bit may be one that the compression does not need.
    let chunk = summary.chunk_indexes[0].compressed_data_offset().unwrap() as usize;
    damaged[chunk + 9..chunk + 41].iter_mut().for_each(|byte| *byte ^= 0x5a);
    let (recovery, found) = recovered(&damaged);
    assert_eq!(found, content(&path), "the first chunk describes, and holds no message");
    assert_eq!(recovery.losses.len(), 1, "{recovery:?}");

    // Without an index nobody knows what the messages are: told, and nothing is made up.
    let end = mcap::read::footer(&bytes).unwrap().summary_start as usize - 13;
    let (recovery, found) = recovered(&damaged[..end]);
    assert!(found.is_empty() && recovery.losses.len() > 1, "{recovery:?}");
    assert!(recovery.losses.iter().any(|loss| loss.what.contains("whose description is lost")), "{recovery:?}");
}

#[test]
fn a_recording_that_is_written_to_is_left_alone() {
    let folder = tempfile::tempdir().unwrap();
    let recorder = Recorder::start(&config(folder.path()), "running").unwrap();
    let out = folder.path().join("new.mcap");
    let error = recover(recorder.path(), &out).unwrap_err();
    assert!(matches!(error, RecoverError::InUse { .. }), "{error}");
    let path = recorder.path().to_path_buf();
    recorder.finish().unwrap();
    assert!(!recover(&path, &out).unwrap().has_lost_data());
}

#[test]
fn small_files_may_hold_large_pictures() {
    // One colour packs so well that the file is smaller than a single of its messages.
    let folder = tempfile::tempdir().unwrap();
    let image = image::RgbImage::from_pixel(1000, 800, image::Rgb([90, 90, 90]));
    let (_, scene) = frame(1000, 800, square);
    let recorder = Recorder::start(&config(folder.path()), "demo").unwrap();
    log_surely(&recorder, 1, &image, &scene);
    let path = recorder.finish().unwrap().files.remove(0);
    assert!(std::fs::metadata(&path).unwrap().len() < 1_600_000, "labels have two bytes a pixel");
    let (frames, damage) = frames(&path, 1).unwrap();
    assert_eq!((frames.len(), damage), (1, None));
    assert_eq!(frames[0].labels.len(), 800_000);
    assert!(!recover(&path, &recovered_path(&path)).unwrap().has_lost_data());
}
