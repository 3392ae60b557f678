//! Recordings written and read back.

use std::path::Path;
use std::time::{Duration, Instant};

use image::RgbImage;
use samsod::Scene;
use samsod::recognize::{Detection, ImagePose, Method};
use samsod::saliency::{SaliencyMap, Threshold, salient_regions};
use samsod::segment::{Partition, RgbView};
use samsod::shadow::{Mask, MaskRun, ObjectRegion, OrientedBox};
use samsod_robot::{AbortReason, Command, CommandId, GripperCommand, Motion, Outcome, Pose};

use super::*;
use crate::ending::Deadlines;
use crate::masks::Shown;
use crate::place::{Place, PlanePose};

pub(super) const START_NS: u64 = 1_700_000_000_000_000_000;

/// A frame of noise with one salient square, labelled by rows of `label`.
pub(super) fn frame(width: u32, height: u32, label: impl Fn(u32, u32) -> u32) -> (RgbImage, Scene) {
    let mut state = 1u32;
    let image = RgbImage::from_fn(width, height, |_, _| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        image::Rgb([(state >> 24) as u8, (state >> 16) as u8, (state >> 8) as u8])
    });
    let labels: Vec<u32> =
        (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).map(|(x, y)| label(x, y)).collect();
    let saliency = labels.iter().map(|&l| if l == 1 { 0.75 } else { 0.001 }).collect();
    let partition = Partition::from_labels(&view(&image), labels).unwrap();
    let saliency = SaliencyMap::from_values(width, height, saliency).unwrap();
    let regions = salient_regions(&saliency, &partition, Threshold::Value(0.5)).unwrap();
    let objects = regions.iter().map(|_| object()).collect();
    (image, Scene { partition, saliency, regions, objects, ..Scene::default() })
}

/// The lower four rows of the square; the upper one is its shadow.
fn object() -> ObjectRegion {
    let rows = |rows: std::ops::Range<u32>| {
        Mask::from_runs(&rows.map(|y| MaskRun { y, start: 4, end: 9 }).collect::<Vec<_>>())
    };
    ObjectRegion {
        region: 0,
        mask: rows(4..8).unwrap(),
        shadow: rows(3..4),
        outline: vec![[4, 4], [8, 4], [8, 7], [4, 7]],
        holes: vec![vec![[6, 5], [6, 6]]],
        area: 20,
        centroid: [6.0, 5.5],
        oriented_box: OrientedBox { center_px: [6.0, 5.5], length_px: 5.0, width_px: 4.0, angle_rad: 0.0 },
        axis_rad: 0.0,
    }
}

fn place() -> Place {
    let world = PlanePose { x_mm: 10.0, y_mm: -20.0, z_mm: 5.0, yaw_deg: 0.0 };
    Place { world, base: None, size_mm: [2.0, 1.6] }
}

pub(super) fn square(x: u32, y: u32) -> u32 {
    u32::from((4..9).contains(&x) && (3..8).contains(&y))
}

fn view(image: &RgbImage) -> RgbView<'_> {
    RgbView::from_raw(image.width(), image.height(), image.as_raw().as_slice()).unwrap()
}

pub(super) fn log(recorder: &Recorder, sequence: u64, image: &RgbImage, scene: &Scene) -> bool {
    recorder.log_frame(&FrameRecord {
        timestamp_ns: START_NS + sequence * 45_000_000,
        sequence,
        camera: "overhead",
        image: &view(image),
        scene,
        places: Some(&[Some(place())]),
        base_from_world: None,
        other_times: &[("transport", Duration::from_micros(80))],
    })
}

/// Logs a frame as often as it takes until the writer has room.
pub(super) fn log_surely(recorder: &Recorder, sequence: u64, image: &RgbImage, scene: &Scene) {
    while !log(recorder, sequence, image, scene) {
        std::thread::sleep(Duration::from_millis(1));
    }
}

fn motion() -> Command {
    Command::Move(Motion::Linear { target: Pose::gripper_down(400.0, 20.0, 150.0, 0.3), speed_mm_s: 100.0 })
}

pub(super) fn log_motion(recorder: &Recorder, id: u64) -> Result<(), RecordError> {
    recorder.log_command(&CommandRecord {
        id: CommandId(id),
        timestamp_ns: START_NS + id,
        frame_sequence: Some(1),
        frame_timestamp_ns: Some(START_NS),
        phase: None,
        part: None,
        command: &motion(),
    })
}

pub(super) fn config(folder: &Path) -> RecorderConfig {
    // Tests must pass on a nearly full disk.
    RecorderConfig { folder: folder.to_path_buf(), min_free_mib: 0, ..RecorderConfig::default() }
}

pub(super) fn count(survey: &Survey, topic: &str) -> u64 {
    survey.topics.iter().find(|t| t.name == topic).unwrap_or_else(|| panic!("{topic} is missing")).messages
}

#[test]
fn every_stage_of_a_frame_reads_back_as_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let (image, scene) = frame(40, 24, square);
    for (i, image_encoding) in [ImageEncoding::Png, ImageEncoding::Raw, ImageEncoding::Jpeg].into_iter().enumerate() {
        let saliency_encoding = if i == 0 { SaliencyEncoding::Mono8 } else { SaliencyEncoding::Float32 };
        let config = RecorderConfig { image_encoding, saliency_encoding, ..config(folder.path()) };
        let recorder = Recorder::start(&config, &format!("cell {i}")).unwrap();
        for sequence in 0..3 {
            log_surely(&recorder, sequence, &image, &scene);
        }
        let path = recorder.path().to_path_buf();
        let summary = recorder.finish().unwrap();
        assert_eq!((summary.frames_written, summary.files), (3, vec![path.clone()]));
        assert_eq!(summary.bytes, std::fs::metadata(&path).unwrap().len());

        let (frames, damage) = frames(&path, 2).unwrap();
        assert_eq!((frames.len(), damage), (2, None), "{image_encoding:?}");
        assert_eq!(frames[1].timestamp_ns, START_NS + 2 * 45_000_000);
        for frame in frames {
            if image_encoding == ImageEncoding::Jpeg {
                assert_eq!(frame.image.dimensions(), image.dimensions());
            } else {
                assert_eq!(frame.image, image, "{image_encoding:?} must be lossless");
            }
            assert_eq!(frame.labels, scene.partition.labels());
            let error =
                frame.saliency.iter().zip(scene.saliency.values()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(error <= if i == 0 { 0.5 / 255.0 + 1e-6 } else { 0.0 }, "saliency off by {error}");
            assert_eq!(frame.outlines.len(), 1);
            assert_eq!(frame.outlines[0].len(), 16, "the border of a 5 x 5 square");
            assert!(frame.outlines[0].iter().all(|&[x, y]| square(x, y) == 1));
            let expected = |pixel: usize| match (square(pixel as u32 % 40, pixel as u32 / 40), pixel / 40) {
                (0, _) => Shown::Table,
                (_, 3) => Shown::Shadow(0),
                _ => Shown::Object(0),
            };
            assert_eq!(frame.masks.len(), 40 * 24);
            assert!(frame.masks.iter().enumerate().all(|(i, &code)| Shown::from_code(code) == expected(i)));
            assert_eq!(frame.object_outlines, [vec![[4, 4], [8, 4], [8, 7], [4, 7]], vec![[6, 5], [6, 6]]]);
        }
    }
}

#[test]
fn topics_times_and_outcomes_are_listed() {
    let folder = tempfile::tempdir().unwrap();
    let (image, mut scene) = frame(40, 24, square);
    let recorder = Recorder::start(&config(folder.path()), "demo").unwrap();
    for ms in 1..=4u64 {
        scene.times.segment = Duration::from_millis(ms);
        scene.times.saliency = Duration::from_millis(10);
        log_surely(&recorder, ms, &image, &scene);
    }
    log_motion(&recorder, 1).unwrap();
    for outcome in [Outcome::Accepted, Outcome::Aborted { reason: AbortReason::Alarm { code: 4107 } }] {
        let record = OutcomeRecord { id: CommandId(1), timestamp_ns: START_NS, outcome: &outcome };
        recorder.log_outcome(&record).unwrap();
    }
    recorder.log_text(LogLevel::Warning, START_NS, "test", "a line").unwrap();
    let path = recorder.path().to_path_buf();
    recorder.finish().unwrap();

    let survey = survey(&path).unwrap();
    assert_eq!(survey.damage, None);
    for (topic, messages) in [
        ("/camera/image", 4),
        ("/segment/labels", 4),
        ("/saliency", 4),
        ("/regions", 4),
        ("/detections", 4),
        ("/masks", 4),
        ("/outlines", 4),
        ("/places", 4),
        ("/tf", 0),
        ("/scene", 4),
        ("/stage/timings", 4),
        ("/pick/target", 1),
        ("/robot/command", 1),
        ("/robot/outcome", 2),
        ("/robot/state", 0),
        ("/log", 1),
    ] {
        assert_eq!(count(&survey, topic), messages, "{topic}");
    }
    assert_eq!((survey.frames, survey.commands, survey.regions), (4, 1, 4));
    assert_eq!((survey.objects, survey.placed), (4, 4));
    assert_eq!(survey.outcomes.into_iter().collect::<Vec<_>>(), [("aborted".to_string(), 1)]);
    let stages: Vec<&str> = survey.stages.iter().map(|s| s.stage.as_str()).collect();
    assert_eq!(stages, ["transport", "segment", "saliency", "regions", "shadow", "recognize", "total"]);
    let segment = &survey.stages[1];
    assert_eq!((segment.frames, segment.p50_ms, segment.p99_ms, segment.max_ms), (4, 2.0, 4.0, 4.0));
    assert_eq!((survey.stages[6].p50_ms, survey.stages[6].max_ms), (12.0, 14.0));
}

#[test]
fn parts_read_back_with_their_names_angles_and_outlines_and_are_counted() {
    let folder = tempfile::tempdir().unwrap();
    let (image, mut scene) = frame(40, 24, square);
    let detection = |name: Option<&str>, angle_deg: f64| Detection {
        region: 0,
        objects: vec![0],
        name: name.map(str::to_owned),
        method: Method::Shape,
        score: 0.8,
        margin: 0.2,
        image: ImagePose { origin_px: [6.0, 5.0], angle_rad: angle_deg.to_radians() },
        world: None,
        mask: object().mask,
    };
    scene.detections = vec![detection(Some("washer"), 30.0), detection(None, 0.0), detection(Some("nut"), -90.0)];
    let recorder = Recorder::start(&config(folder.path()), "demo").unwrap();
    for sequence in 0..2 {
        log_surely(&recorder, sequence, &image, &scene);
    }
    let path = recorder.finish().unwrap().files.remove(0);
    let survey = survey(&path).unwrap();
    assert_eq!((survey.recognized, survey.unknown), (4, 2));
    let (frames, _) = frames(&path, 2).unwrap();
    for frame in frames {
        let seen: Vec<_> = frame.detections.iter().map(|d| (d.name.as_deref(), d.angle_deg.round())).collect();
        assert_eq!(seen, [(Some("washer"), 30.0), (None, 0.0), (Some("nut"), -90.0)]);
        for detection in &frame.detections {
            assert_eq!(detection.outlines.len(), 1);
            assert_eq!(detection.outlines[0].len(), 14, "the border of 5 x 4 pixels");
        }
        let [from, to] = frame.detections[2].arrow[0];
        assert!(from == [6.0, 5.0] && (to[0] - 6.0).abs() < 1e-9 && to[1] > 6.0, "down: {to:?}");
        assert_eq!(frame.detections[1].arrow.len(), 1, "an axis, no arrow");
    }
}

#[test]
fn a_command_is_in_the_file_when_log_command_returns() {
    let folder = tempfile::tempdir().unwrap();
    let (image, scene) = frame(400, 300, square);
    let recorder = Recorder::start(&config(folder.path()), "demo").unwrap();
    for id in 1..=5 {
        log(&recorder, id, &image, &scene);
        log_motion(&recorder, id).unwrap();
        // What a killed process would leave behind.
        let copy = folder.path().join("copy.mcap");
        std::fs::copy(recorder.path(), &copy).unwrap();
        let left = survey(&copy).unwrap();
        assert_eq!((left.commands, count(&left, "/pick/target")), (id, id));
        assert!(left.damage.is_some(), "an unfinished file must say so");
    }
}

#[test]
fn frames_that_do_not_fit_are_dropped_and_counted_and_commands_are_not() {
    let folder = tempfile::tempdir().unwrap();
    let (image, scene) = frame(640, 480, square);
    let recorder = Recorder::start(&RecorderConfig { queue_frames: 1, ..config(folder.path()) }, "demo").unwrap();
    let taken = (0..60).filter(|&sequence| log(&recorder, sequence, &image, &scene)).count() as u64;
    log_motion(&recorder, 1).unwrap();
    let summary = recorder.finish().unwrap();
    assert_eq!((summary.frames_written, summary.frames_dropped), (taken, 60 - taken));
    assert_eq!((summary.commands, summary.frames_not_written), (1, 0));
    let survey = survey(&summary.files[0]).unwrap();
    assert_eq!((survey.frames, survey.commands), (taken, 1));
    assert!(survey.frames_dropped <= 60 - taken);
}

#[test]
fn at_an_end_that_cannot_wait_frames_are_let_go_and_lines_are_written() {
    let folder = tempfile::tempdir().unwrap();
    let (image, scene) = frame(640, 480, square);
    let recorder = Recorder::start(&RecorderConfig { queue_frames: 64, ..config(folder.path()) }, "demo").unwrap();
    let taken = (0..64).filter(|&sequence| log(&recorder, sequence, &image, &scene)).count() as u64;
    recorder.log_text(LogLevel::Warning, START_NS, "test", "the last word").unwrap();
    let (now, later) = (Instant::now(), Instant::now() + Duration::from_secs(600));
    let summary = recorder.end(&|| Some(Deadlines { robot: now, frames: now, writer: later })).unwrap();
    assert_eq!(summary.frames_written + summary.frames_not_written, taken);
    assert!(summary.frames_not_written > 0, "{summary}");
    let survey = survey(&summary.files[0]).unwrap();
    assert_eq!((survey.damage.as_ref(), survey.frames), (None, summary.frames_written));
    assert_eq!(survey.topics.iter().find(|topic| topic.name == "/log").unwrap().messages, 1);
    assert!(!log(&recorder, 65, &image, &scene), "nothing is recorded any more");
}

#[test]
fn a_writer_that_hangs_is_not_waited_for() {
    let folder = tempfile::tempdir().unwrap();
    let (image, scene) = frame(640, 480, square);
    let recorder = Recorder::start(&RecorderConfig { queue_frames: 64, ..config(folder.path()) }, "demo").unwrap();
    for sequence in 0..64 {
        log(&recorder, sequence, &image, &scene);
    }
    let (now, later) = (Instant::now(), Instant::now() + Duration::from_secs(600));
    let refused = recorder.end(&|| Some(Deadlines { robot: now, frames: later, writer: now })).unwrap_err().to_string();
    assert!(refused.contains("it was still writing when samsodd had to end"), "{refused}");
}

#[test]
fn a_recorder_that_is_dropped_closes_its_file() {
    let folder = tempfile::tempdir().unwrap();
    let recorder = Recorder::start(&config(folder.path()), "demo").unwrap();
    let path = recorder.path().to_path_buf();
    let record = CommandRecord {
        id: CommandId(1),
        timestamp_ns: START_NS,
        frame_sequence: None,
        frame_timestamp_ns: None,
        phase: None,
        part: None,
        command: &Command::Gripper { gripper: GripperCommand::Open },
    };
    recorder.log_command(&record).unwrap();
    drop(recorder);
    let survey = survey(&path).unwrap();
    assert_eq!((survey.damage, survey.commands), (None, 1));
}

#[test]
fn a_folder_that_cannot_be_written_to_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let taken = folder.path().join("taken");
    std::fs::write(&taken, "a file").unwrap();
    for path in [taken.clone(), taken.join("below")] {
        let error = Recorder::start(&config(&path), "demo").unwrap_err();
        assert!(error.to_string().contains(path.to_str().unwrap()), "{error}");
    }
    let error = Recorder::start(&RecorderConfig { queue_frames: 0, ..config(folder.path()) }, "demo").unwrap_err();
    assert_eq!(error.to_string(), "queue_frames = 0; allowed is 1 to 64");
}

#[test]
fn file_names_carry_the_cell_and_stay_in_the_folder() {
    let folder = tempfile::tempdir().unwrap();
    let recorder = Recorder::start(&config(folder.path()), "../left cell").unwrap();
    let name = recorder.path().file_name().unwrap().to_str().unwrap().to_string();
    assert!(name.starts_with("___left_cell-20") && name.ends_with("Z.mcap"), "{name}");
    assert_eq!(recorder.path().parent(), Some(folder.path()));
}

#[test]
fn a_full_file_is_followed_by_a_further_one_and_both_are_whole() {
    let folder = tempfile::tempdir().unwrap();
    let (image, scene) = frame(1200, 900, square);
    let small = RecorderConfig { max_file_mib: 16, image_encoding: ImageEncoding::Raw, ..config(folder.path()) };
    let recorder = Recorder::start(&small, "demo").unwrap();
    for sequence in 0..8 {
        log_surely(&recorder, sequence, &image, &scene);
    }
    log_motion(&recorder, 1).unwrap();
    let summary = recorder.finish().unwrap();
    assert_eq!(summary.files.len(), 2, "{summary}");
    let surveys: Vec<Survey> = summary.files.iter().map(|file| survey(file).unwrap()).collect();
    assert!(surveys.iter().all(|s| s.damage.is_none()));
    assert_eq!(surveys.iter().map(|s| s.frames).sum::<u64>(), 8);
    assert_eq!(surveys.iter().map(|s| s.commands).sum::<u64>(), 1);
    assert_eq!(surveys.iter().map(|s| s.bytes).sum::<u64>(), summary.bytes);
}

#[test]
fn a_nearly_full_disk_costs_frames_but_no_commands() {
    let folder = tempfile::tempdir().unwrap();
    let (image, scene) = frame(40, 24, square);
    let full =
        RecorderConfig { min_free_mib: 1 << 40, on_log_failure: OnLogFailure::Continue, ..config(folder.path()) };
    let recorder = Recorder::start(&full, "demo").unwrap();
    assert!(log(&recorder, 1, &image, &scene));
    log_motion(&recorder, 1).unwrap();
    let summary = recorder.finish().unwrap();
    assert_eq!((summary.frames_written, summary.frames_not_written, summary.commands), (0, 1, 1));
    assert!(summary.has_lost_data());

    // Whoever wants the robot held gives none; what is known of the robot is written all the same.
    let recorder = Recorder::start(&RecorderConfig { on_log_failure: OnLogFailure::Hold, ..full }, "held").unwrap();
    let refusal = log_motion(&recorder, 1).unwrap_err().to_string();
    assert!(refusal.starts_with("recording is short of space: "), "{refusal}");
    assert!(refusal.ends_with("[recording] min_free_mib = 1099511627776"), "{refusal}");
    recorder.log_text(LogLevel::Error, START_NS, "robot", &refusal).unwrap();
    let summary = recorder.finish().unwrap();
    let survey = survey(&summary.files[0]).unwrap();
    assert_eq!((summary.commands, survey.commands, count(&survey, "/log")), (0, 0, 1));
}

#[test]
fn more_labels_than_16_bits_are_kept_apart() {
    let folder = tempfile::tempdir().unwrap();
    let (image, scene) = frame(300, 250, |x, y| y * 300 + x);
    assert!(scene.partition.len() > 1 << 16);
    let recorder = Recorder::start(&config(folder.path()), "demo").unwrap();
    log_surely(&recorder, 1, &image, &scene);
    let summary = recorder.finish().unwrap();
    let (frames, _) = frames(&summary.files[0], 1).unwrap();
    assert_eq!(frames[0].labels, scene.partition.labels());
}

#[test]
fn every_truncation_and_many_bit_flips_are_survived() {
    let folder = tempfile::tempdir().unwrap();
    let (image, scene) = frame(40, 24, square);
    let recorder = Recorder::start(&config(folder.path()), "demo").unwrap();
    for sequence in 0..3 {
        log_surely(&recorder, sequence, &image, &scene);
    }
    let path = recorder.finish().unwrap().files.remove(0);
    let whole = std::fs::read(&path).unwrap();
    let mut most = 0;
    for length in (0..whole.len()).step_by(97) {
        std::fs::write(&path, &whole[..length]).unwrap();
        match survey(&path) {
            Ok(left) => {
                assert!(left.damage.is_some(), "{length} of {} bytes pass for whole", whole.len());
                assert!(left.frames >= most, "more bytes, fewer frames");
                most = left.frames;
            }
            Err(error) => assert!(matches!(error, ReadError::NoRecording { .. }), "{error}"),
        }
    }
    assert_eq!(most, 3);
    for at in (0..whole.len()).step_by(53) {
        let mut bytes = whole.clone();
        bytes[at] ^= 0x40;
        std::fs::write(&path, &bytes).unwrap();
        // Whatever it says, it must not panic, hang or ask for more memory than there is.
        let _ = frames(&path, 3);
    }
}
