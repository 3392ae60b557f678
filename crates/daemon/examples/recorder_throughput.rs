//! What recording costs: every image encoding on real frames, as fast as the recorder takes them and then at the
//! camera's rate.
//!
//! ```text
//! cargo run --release -p samsod-daemon --example recorder_throughput -- IMAGES_FOLDER [RECORDINGS_FOLDER]
//! ```
//!
//! Columns: frames a second when never waiting; processor time a frame of the whole process, that is of the copy and of the
//! writer; size a frame; what `log_frame` costs the vision thread; the longest wait of a command among frames.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use image::RgbImage;
use samsod::segment::RgbView;
use samsod::{Cell, CellParams, Scene};
use samsod_daemon::recording::{CommandRecord, FrameRecord, ImageEncoding, Recorder, RecorderConfig, SaliencyEncoding};
use samsod_robot::{Command, CommandId, GripperCommand};

type Error = Box<dyn std::error::Error>;

const FRAMES: u64 = 220;
const PERIOD: Duration = Duration::from_nanos(1_000_000_000 / 22);

fn main() -> Result<(), Error> {
    let mut arguments = std::env::args_os().skip(1).map(PathBuf::from);
    let images = arguments.next().ok_or("which folder of images?")?;
    let folder = arguments.next().unwrap_or_else(std::env::temp_dir);
    let frames = load(&images)?;
    println!(
        "{:<6} {:<7} {:>9} {:>12} {:>9} {:>12} {:>12} {:>12} {:>8}",
        "image", "map", "frames/s", "cpu ms/frame", "MB/frame", "copy ms p50", "cmd ms p50", "cmd ms max", "dropped"
    );
    for (image, saliency) in [
        (ImageEncoding::Raw, SaliencyEncoding::Mono8),
        (ImageEncoding::Png, SaliencyEncoding::Mono8),
        (ImageEncoding::Png, SaliencyEncoding::Float32),
        (ImageEncoding::Jpeg, SaliencyEncoding::Mono8),
    ] {
        measure(&folder, &frames, image, saliency)?;
    }
    if let Some(line) = std::fs::read_to_string("/proc/self/status")?.lines().find(|l| l.starts_with("VmHWM")) {
        println!("{line} (with {} frames and scenes in memory)", frames.len());
    }
    Ok(())
}

fn load(folder: &Path) -> Result<Vec<(RgbImage, Scene)>, Error> {
    let mut paths: Vec<_> = std::fs::read_dir(folder)?.map(|e| e.map(|e| e.path())).collect::<Result<_, _>>()?;
    paths.sort();
    let mut cell = Cell::new(CellParams::default())?;
    let step = (paths.len() / 12).max(1);
    let mut frames = Vec::new();
    for path in paths.iter().step_by(step).take(12) {
        let image = image::open(path)?.into_rgb8();
        let scene = cell.inspect(&view(&image)?)?;
        frames.push((image, scene));
    }
    Ok(frames)
}

fn view(image: &RgbImage) -> Result<RgbView<'_>, Error> {
    Ok(RgbView::from_raw(image.width(), image.height(), image.as_raw().as_slice()).ok_or("size")?)
}

fn measure(
    folder: &Path,
    frames: &[(RgbImage, Scene)],
    image_encoding: ImageEncoding,
    saliency_encoding: SaliencyEncoding,
) -> Result<(), Error> {
    let config =
        RecorderConfig { folder: folder.to_path_buf(), image_encoding, saliency_encoding, ..Default::default() };
    // First as fast as it goes.
    let recorder = Recorder::start(&config, "throughput")?;
    let (start, processor) = (Instant::now(), processor_time()?);
    for (sequence, (image, scene)) in (0..FRAMES).zip(frames.iter().cycle()) {
        while !log(&recorder, sequence, image, scene)? {
            std::thread::sleep(Duration::from_micros(200));
        }
    }
    let summary = recorder.finish()?;
    let (elapsed, processor) = (start.elapsed(), processor_time()? - processor);
    remove(&summary.files)?;

    // Then at the rate of the camera, with a command after every frame.
    let recorder = Recorder::start(&config, "throughput")?;
    let (mut copies, mut commands) = (Vec::new(), Vec::new());
    let begin = Instant::now();
    for (sequence, (image, scene)) in (0..FRAMES / 4).zip(frames.iter().cycle()) {
        let due = begin + PERIOD * sequence as u32;
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
        let at = Instant::now();
        log(&recorder, sequence, image, scene)?;
        copies.push(at.elapsed());
        let at = Instant::now();
        recorder.log_command(&CommandRecord {
            id: CommandId(sequence),
            timestamp_ns: sequence,
            frame_sequence: Some(sequence),
            frame_timestamp_ns: None,
            phase: None,
            part: None,
            command: &Command::Gripper { gripper: GripperCommand::Open },
        })?;
        commands.push(at.elapsed());
    }
    let paced = recorder.finish()?;
    remove(&paced.files)?;
    copies.sort();
    commands.sort();
    let ms = |time: Option<&Duration>| time.map_or(0.0, |t| t.as_secs_f64() * 1e3);
    println!(
        "{:<6} {:<7} {:>9.1} {:>12.2} {:>9.3} {:>12.2} {:>12.2} {:>12.2} {:>8}",
        format!("{image_encoding:?}").to_lowercase(),
        format!("{saliency_encoding:?}").to_lowercase(),
        FRAMES as f64 / elapsed.as_secs_f64(),
        processor.as_secs_f64() * 1e3 / FRAMES as f64,
        summary.bytes as f64 / 1e6 / FRAMES as f64,
        ms(copies.get(copies.len() / 2)),
        ms(commands.get(commands.len() / 2)),
        ms(commands.last()),
        paced.frames_dropped
    );
    Ok(())
}

fn log(recorder: &Recorder, sequence: u64, image: &RgbImage, scene: &Scene) -> Result<bool, Error> {
    Ok(recorder.log_frame(&FrameRecord {
        timestamp_ns: 1_700_000_000_000_000_000 + sequence * PERIOD.as_nanos() as u64,
        sequence,
        camera: "throughput",
        image: &view(image)?,
        scene,
        places: None,
        base_from_world: None,
        other_times: &[],
    }))
}

fn remove(files: &[PathBuf]) -> Result<(), Error> {
    files.iter().try_for_each(std::fs::remove_file).map_err(Error::from)
}

/// Processor time of this process, from the kernel's ticks of 10 ms.
fn processor_time() -> Result<Duration, Error> {
    let stat = std::fs::read_to_string("/proc/self/stat")?;
    // The name, in brackets, may hold spaces.
    let fields = stat.rsplit_once(')').ok_or("no name")?.1;
    let ticks: Vec<u64> = fields.split_whitespace().skip(11).take(2).map(str::parse).collect::<Result<_, _>>()?;
    Ok(Duration::from_millis(ticks.iter().sum::<u64>() * 10))
}
