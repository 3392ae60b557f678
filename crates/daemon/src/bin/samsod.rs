//! `samsod`: the operator's command line.
//!
//! Exit codes: 0 done, 1 error, 2 wrong arguments, 3 done, but the recording has lost data.

use std::collections::BTreeMap;
use std::io::{self, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use clap::{Args, CommandFactory, Parser, Subcommand};
use image::ImageFormat;
use samsod::recognize::{Detection, Method};
use samsod_daemon::calibrate::{self, CalibrateArguments};
use samsod_daemon::caption::{self, Captions};
use samsod_daemon::catalogue;
use samsod_daemon::config::Config;
use samsod_daemon::control::{self, Request};
use samsod_daemon::emulate::{self, EmulateArguments};
use samsod_daemon::generate;
use samsod_daemon::inspect::{self, Inspection};
use samsod_daemon::masks::Shown;
use samsod_daemon::picture;
use samsod_daemon::place::{Placer, PlanePose};
use samsod_daemon::publish::{self, Event, PublishOptions};
use samsod_daemon::recording::{self, FrameStages, Survey};
use samsod_daemon::replay::{self, ReplayOptions};
use samsod_daemon::teach::{self, TeachArguments};
use samsod_daemon::twin::{self, RunEvent, TwinArguments, TwinCommand, TwinRunArguments};
use samsod_frame::FrameServiceConfig;
use samsod_robot::SequenceState;
use signal_hook::consts::{SIGINT, SIGTERM};

/// It was done as far as it could be, but data is lost.
const DATA_LOST: u8 = 3;

/// Width of a tile of a contact sheet, px.
const TILE_WIDTH: u32 = 360;

type Error = Box<dyn std::error::Error>;

/// Look into a robot cell's vision: send it images, inspect one, read what it recorded.
///
/// Exit codes: 0 done, 1 error, 2 wrong arguments, 3 done, but the recording has lost data.
#[derive(Debug, Parser)]
#[command(name = "samsod", version, verbatim_doc_comment)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Send a folder of images to a running samsodd, as a camera would.
    Publish(PublishArguments),
    /// Run the vision chain on one image; write pictures of its stages and a JSON file.
    Inspect(InspectArguments),
    // What these say of themselves stands with their arguments.
    Calibrate(CalibrateArguments),
    Teach(TeachArguments),
    /// Check a catalogue of parts and list it.
    Catalogue(CatalogueArguments),
    Emulate(EmulateArguments),
    /// How the robot of a running samsodd and its work stand.
    Status(CellArguments),
    /// Make the robot of a running samsodd stand, until it is resumed.
    Hold(CellArguments),
    /// Begin anew from home, after a fault has been looked at.
    Resume(ResumeArguments),
    /// Begin anew from home, with an empty jig in place of the full one.
    NewJig(CellArguments),
    /// List what is in a recording: topics, counts, times of the stages.
    Recording(RecordingArguments),
    /// Make a whole recording of what is left of one that was cut off or damaged; the original stays as it is.
    Recover(RecoverArguments),
    Replay(ReplayArguments),
    Twin(TwinArguments),
    /// Write the manual pages and shell completions of samsod and samsodd to a folder: `man/` and `completions/`.
    #[command(hide = true)]
    Generate(GenerateArguments),
}

#[derive(Debug, Args)]
struct GenerateArguments {
    /// The folder; it is made if it does not exist.
    dir: PathBuf,
}

#[derive(Debug, Args)]
struct PublishArguments {
    /// Folder of PNG and JPEG images, sent in the order of their names.
    dir: PathBuf,
    /// Frames a second, 0.001 to 1000.
    #[arg(long, value_name = "HZ", default_value_t = 10.0)]
    rate: f64,
    /// End after so many frames; more than there are images need --loop.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
    /// Begin again after the last image.
    #[arg(long = "loop")]
    repeat: bool,
    /// Name of the cell.
    #[arg(long, value_name = "NAME", conflicts_with = "config")]
    cell: Option<String>,
    /// Configuration of samsodd; tells the cell and where it is found.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Folder of the transport's bookkeeping files, as in the configuration of samsodd.
    #[arg(long, value_name = "DIR", conflicts_with = "config")]
    root_path: Option<PathBuf>,
    /// Name of the camera.
    #[arg(long, value_name = "NAME", default_value = "publish")]
    camera: String,
    /// How long to wait for samsodd, seconds.
    #[arg(long, value_name = "S", default_value_t = 10)]
    wait: u64,
}

#[derive(Debug, Args)]
struct InspectArguments {
    /// The image, PNG or JPEG.
    image: PathBuf,
    /// Folder for the results.
    #[arg(long, value_name = "DIR", default_value = ".")]
    out: PathBuf,
    /// Configuration of samsodd; its vision parameters are used, and its [camera] or [view].
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Camera file of `samsod calibrate`, in place of that of the configuration: places objects in millimetres.
    #[arg(long, value_name = "FILE")]
    camera: Option<PathBuf>,
    /// Folder of a catalogue of parts, in place of that of the configuration: names objects.
    #[arg(long, value_name = "DIR")]
    catalogue: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct CatalogueArguments {
    /// Its folder, with a folder for each part.
    dir: PathBuf,
}

/// Which samsodd.
#[derive(Debug, Args)]
struct CellArguments {
    /// Name of the cell.
    #[arg(long, value_name = "NAME", conflicts_with = "config")]
    cell: Option<String>,
    /// Configuration of samsodd; tells the cell and where it is found.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Folder of the transport's bookkeeping files, as in the configuration of samsodd.
    #[arg(long, value_name = "DIR", conflicts_with = "config")]
    root_path: Option<PathBuf>,
}

impl CellArguments {
    fn service(self) -> Result<FrameServiceConfig, Error> {
        Ok(match &self.config {
            Some(file) => Config::read_without_catalogue(file)?.service(),
            None => {
                let name = self.cell.unwrap_or_else(|| Config::default().cell.name);
                FrameServiceConfig { root_path: self.root_path, ..FrameServiceConfig::for_cell(name) }
            }
        })
    }
}

#[derive(Debug, Args)]
struct ResumeArguments {
    #[command(flatten)]
    cell: CellArguments,
    /// The gripper is empty: what it may have held has been taken out by hand.
    #[arg(long)]
    gripper_is_empty: bool,
}

#[derive(Debug, Args)]
struct RecordingArguments {
    /// The recording, MCAP.
    file: PathBuf,
    /// Draw a contact sheet into this PNG file: frame, partitions, saliency, regions, objects with
    /// their shadows and, if a catalogue was there, parts with names and angles; a row for each frame.
    #[arg(long, value_name = "PNG")]
    sheet: Option<PathBuf>,
    /// Rows of the contact sheet, spread over the recording.
    #[arg(long, value_name = "N", default_value_t = 6, requires = "sheet",
          value_parser = clap::value_parser!(u16).range(1..=100))]
    frames: u16,
}

#[derive(Debug, Args)]
struct RecoverArguments {
    /// The recording, MCAP.
    file: PathBuf,
    /// The new file, which must not exist; without it FILE-recovered.mcap, beside the old one.
    #[arg(long, value_name = "OUT")]
    out: Option<PathBuf>,
}

/// Feed the frames of a recording through the vision chain again and compare every stage with what was recorded.
///
/// The recording says with which configuration, camera file and catalogue it was made; these are used. The same build then finds
/// the same, byte for byte, whatever the number of threads; of another build or configuration a table says what has changed.
///
/// Exit codes: 0 every stage is the same, 1 something differs or an error, 2 wrong arguments, 3 every stage is the same, but the
/// recording is cut off or damaged.
#[derive(Debug, Args)]
#[command(verbatim_doc_comment)]
struct ReplayArguments {
    /// The recording, MCAP.
    file: PathBuf,
    /// Another configuration than that of the recording: shows what it changes.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Folder of the catalogue, where it lies elsewhere than when the recording was made.
    #[arg(long, value_name = "DIR")]
    catalogue: Option<PathBuf>,
    /// Threads of the vision chain; without it as many as there are cores.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: Option<u16>,
}

fn main() -> ExitCode {
    let result = match Arguments::parse().command {
        Command::Publish(arguments) => publish(arguments),
        Command::Inspect(arguments) => inspect(&arguments),
        Command::Calibrate(arguments) => calibrate(&arguments),
        Command::Teach(arguments) => teach(&arguments),
        Command::Catalogue(arguments) => list(&arguments),
        Command::Emulate(arguments) => emulate(&arguments),
        Command::Status(cell) => control(cell, Request::Status),
        Command::Hold(cell) => control(cell, Request::Hold),
        Command::Resume(ResumeArguments { cell, gripper_is_empty }) => {
            control(cell, Request::Resume { gripper_is_empty })
        }
        Command::NewJig(cell) => control(cell, Request::NewJig),
        Command::Recording(arguments) => recording(&arguments),
        Command::Recover(arguments) => recover(&arguments),
        Command::Replay(arguments) => replay(&arguments),
        Command::Twin(arguments) => twin(&arguments),
        Command::Generate(GenerateArguments { dir }) => {
            generate::generate(&Arguments::command(), &dir).map(|()| ExitCode::SUCCESS).map_err(Into::into)
        }
    };
    result.unwrap_or_else(|error| {
        eprintln!("samsod: {error}");
        ExitCode::FAILURE
    })
}

/// Prints to standard output; a reader that has gone away is no failure.
fn print(text: &str) {
    let mut out = io::stdout().lock();
    let _ = out.write_all(text.as_bytes()).and_then(|()| out.flush());
}

/// Set by SIGINT and SIGTERM.
fn stop_on_signals() -> io::Result<Arc<AtomicBool>> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM] {
        signal_hook::flag::register(signal, Arc::clone(&stop))?;
    }
    Ok(stop)
}

fn publish(arguments: PublishArguments) -> Result<ExitCode, Error> {
    let service = match &arguments.config {
        Some(file) => Config::read(file)?.service(),
        None => {
            let name = arguments.cell.unwrap_or_else(|| Config::default().cell.name);
            FrameServiceConfig { root_path: arguments.root_path, ..FrameServiceConfig::for_cell(name) }
        }
    };
    let options = PublishOptions {
        folder: arguments.dir,
        service,
        rate_hz: arguments.rate,
        count: arguments.count,
        repeat: arguments.repeat,
        wait: Duration::from_secs(arguments.wait),
        camera: arguments.camera,
    };
    let stop = stop_on_signals()?;
    // A line that is written over is for people only.
    let live = io::stderr().is_terminal();
    let summary = publish::run(&options, &stop, &mut |event| match event {
        Event::Waiting { images } => eprintln!("{images} images; waiting for samsodd"),
        Event::Skipped { path, reason } => eprintln!("{} is left out: {reason}", path.display()),
        Event::Sent(progress) if live => {
            let planned = progress.planned.map_or(String::new(), |n| format!(" of {n}"));
            eprint!("\r{}{planned} frames sent, {:.1} s ", progress.sent, progress.elapsed.as_secs_f64());
        }
        _ => {}
    });
    if live {
        eprintln!();
    }
    print(&format!("{}\n", summary?));
    Ok(ExitCode::SUCCESS)
}

fn emulate(arguments: &EmulateArguments) -> Result<ExitCode, Error> {
    let stop = stop_on_signals()?;
    let commands = emulate::run(arguments, &stop, |address| eprintln!("listening on {address}"))?;
    print(&format!("{commands} commands\n"));
    Ok(ExitCode::SUCCESS)
}

/// Asks a running samsodd, and prints how the robot then stands.
fn control(cell: CellArguments, request: Request) -> Result<ExitCode, Error> {
    let report = control::ask(&cell.service()?, request)?;
    let mut text = format!("controller   {}\n", report.controller);
    text += &match &report.sequence {
        None => "sequence     none, it goes above what it sees\n".to_owned(),
        Some(SequenceState::FromHome) => "sequence     begins from home\n".to_owned(),
        Some(SequenceState::Ready) => "sequence     at work\n".to_owned(),
        Some(SequenceState::Complete) => "sequence     the jig is full\n".to_owned(),
        Some(SequenceState::Stopped { holds }) => format!("sequence     stopped; {holds}\n"),
        Some(SequenceState::Faulted(fault)) => format!("sequence     stands until resumed: {fault}\n"),
    };
    if let Some(reason) = &report.waits_for {
        text += &format!("waits        {reason}\n");
    }
    if let Some(position) = &report.position {
        text += &format!("tool         {position}\n");
    }
    if !report.filled.is_empty() {
        let filled = report.filled.iter().filter(|filled| **filled).count();
        text += &format!("jig          {filled} of {} slots filled\n", report.filled.len());
    }
    for reason in &report.passed_over {
        text += &format!("passed over  {reason}\n");
    }
    print(&text);
    Ok(ExitCode::SUCCESS)
}

fn inspect(arguments: &InspectArguments) -> Result<ExitCode, Error> {
    let mut config = match &arguments.config {
        Some(file) => Config::read_without_catalogue(file)?,
        None => Config::default(),
    };
    if let Some(file) = &arguments.camera {
        (config.camera.file, config.view) = (Some(file.clone()), None);
    }
    if let Some(folder) = &arguments.catalogue {
        config.catalogue.folder = Some(folder.clone());
    }
    let placer = config.placer()?;
    let mut cell = config.make_cell()?;
    let inspection = inspect::run(&arguments.image, &arguments.out, &mut cell, placer.as_ref())?;
    let scene = &inspection.scene;
    let (partitions, regions, objects) = (scene.partition.len(), scene.regions.len(), scene.objects.len());
    let mut text = format!("{partitions} partitions, {regions} regions, {objects} objects\n");
    if !scene.regions.is_empty() {
        text += &format!("{:>6} {:>9} {:>9} {:>17}\n", "region", "area px", "saliency", "centroid px");
    }
    for (id, region) in scene.regions.iter().enumerate() {
        let [x, y] = region.centroid;
        text += &format!("{id:>6} {:>9} {:>9.4} {x:>8.1} {y:>8.1}\n", region.area, region.mean_saliency);
    }
    text += &object_table(&inspection, placer.as_ref());
    if cell.catalogue().is_some() {
        text += &detection_table(&inspection, placer.is_some());
    }
    for (stage, time) in scene.times.stages() {
        text += &format!("{stage:<10} {:>8.2} ms\n", time.as_secs_f64() * 1e3);
    }
    for file in &inspection.files {
        text += &format!("{}\n", file.display());
    }
    print(&text);
    Ok(ExitCode::SUCCESS)
}

/// The objects, with their places where there are any.
fn object_table(inspection: &Inspection, placer: Option<&Placer>) -> String {
    if inspection.scene.objects.is_empty() {
        return String::new();
    }
    let mut text = format!("{:>6} {:>6} {:>9} {:>17} {:>15}", "object", "region", "area px", "centroid px", "size px");
    if placer.is_some() {
        text += &format!(" {:>26} {:>7} {:>15}", "world mm", "yaw deg", "size mm");
    }
    if placer.is_some_and(Placer::knows_base) {
        text += &format!(" {:>26} {:>7}", "base mm", "yaw deg");
    }
    text.push('\n');
    let pose = |at: &PlanePose| format!(" {:>8.1} {:>8.1} {:>8.1} {:>7.1}", at.x_mm, at.y_mm, at.z_mm, at.yaw_deg);
    let size = |length: f64, width: f64| format!(" {length:>7.1} {width:>7.1}");
    for (id, object) in inspection.scene.objects.iter().enumerate() {
        let ([u, v], found) = (object.centroid, &object.oriented_box);
        text += &format!("{id:>6} {:>6} {:>9} {u:>8.1} {v:>8.1}", object.region, object.area);
        text += &size(found.length_px.into(), found.width_px.into());
        match inspection.places.get(id) {
            Some(Some(place)) => {
                let [length, width] = place.size_mm;
                text += &format!("{}{}", pose(&place.world), size(length, width));
                text += &place.base.as_ref().map_or(String::new(), pose);
            }
            Some(None) => text += "  not on the plane",
            None => {}
        }
        text.push('\n');
    }
    text
}

/// What the objects are.
fn detection_table(inspection: &Inspection, is_placed: bool) -> String {
    let detections = &inspection.scene.detections;
    let known = detections.iter().filter(|detection| detection.name.is_some()).count();
    let mut text = format!("{known} parts recognised, {} unknown\n", detections.len() - known);
    if detections.is_empty() {
        return text;
    }
    let name = |detection: &Detection| detection.name.clone().unwrap_or_else(|| "unknown".to_owned());
    let width = detections.iter().map(|d| name(d).chars().count()).max().unwrap_or(0);
    text += &format!(
        "{:<width$} {:>6} {:>6} {:>6} {:>9} {:>17} {:>9}",
        "part", "score", "margin", "method", "objects", "origin px", "angle deg"
    );
    text += &if is_placed { format!(" {:>17} {:>7}\n", "world mm", "yaw deg") } else { "\n".to_owned() };
    for detection in detections {
        let [u, v] = detection.image.origin_px;
        let objects: Vec<String> = detection.objects.iter().map(usize::to_string).collect();
        // The names of the configuration.
        let method = match detection.method {
            Method::Sift => "sift",
            Method::Shape => "shape",
            Method::Best => "best",
        };
        text += &format!(
            "{:<width$} {:>6.3} {:>6.3} {method:>6} {:>9} {u:>8.1} {v:>8.1} {:>9.1}",
            name(detection),
            detection.score,
            detection.margin,
            objects.join(","),
            detection.image.angle_rad.to_degrees(),
        );
        if let Some(world) = &detection.world {
            text += &format!(" {:>8.1} {:>8.1} {:>7.1}", world.x_mm, world.y_mm, world.yaw_rad.to_degrees());
        }
        text.push('\n');
    }
    text
}

fn teach(arguments: &TeachArguments) -> Result<ExitCode, Error> {
    print(&teach::run(arguments)?);
    Ok(ExitCode::SUCCESS)
}

fn list(arguments: &CatalogueArguments) -> Result<ExitCode, Error> {
    let listing = catalogue::list(&arguments.dir)?;
    print(&format!("{listing}\n"));
    for error in &listing.errors {
        eprintln!("samsod: {error}");
    }
    Ok(if listing.errors.is_empty() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn calibrate(arguments: &CalibrateArguments) -> Result<ExitCode, Error> {
    print(&calibrate::run(arguments)?);
    Ok(ExitCode::SUCCESS)
}

fn twin(arguments: &TwinArguments) -> Result<ExitCode, Error> {
    match &arguments.command {
        TwinCommand::Run(arguments) => run_twin(arguments)?,
        TwinCommand::Table(arguments) => print(&twin::table(arguments)?),
        TwinCommand::Picture(arguments) => {
            twin::picture(arguments)?;
            print(&format!("{}\n", arguments.out.display()));
        }
        TwinCommand::Score(arguments) => {
            let score = twin::Score::read(&arguments.table)?;
            print(&format!("{score}\n"));
            if !score.is_perfect() {
                return Ok(ExitCode::FAILURE);
            }
        }
    }
    Ok(ExitCode::SUCCESS)
}

fn run_twin(arguments: &TwinRunArguments) -> Result<(), Error> {
    let stop = stop_on_signals()?;
    let (mut twin, options) = twin::prepare_run(arguments)?;
    // A line that is written over is for people only.
    let live = io::stderr().is_terminal();
    let begin = if live { "\r" } else { "" };
    let summary = twin::run(&mut twin, &options, &stop, &mut |event| match event {
        RunEvent::Waiting => eprintln!("waiting for samsodd"),
        RunEvent::Changed { composed, parts, took } => {
            let (in_view, drawn, ms) = (composed.in_view, composed.drawn, took.as_secs_f64() * 1e3);
            eprintln!("{begin}{in_view} of {parts} parts are in view, {drawn} drawn anew; {ms:.0} ms");
        }
        RunEvent::Withheld { reason } => eprintln!("{begin}no frame is sent until the table can be used: {reason}"),
        RunEvent::Sent { sent, elapsed } if live => eprint!("\r{sent} frames sent, {:.1} s ", elapsed.as_secs_f64()),
        RunEvent::Sent { .. } => {}
    });
    if live {
        eprintln!();
    }
    print(&format!("{}\n", summary?));
    Ok(())
}

fn recording(arguments: &RecordingArguments) -> Result<ExitCode, Error> {
    let survey = recording::survey(&arguments.file)?;
    print(&table(&arguments.file, &survey));
    if let Some(out) = &arguments.sheet {
        let (frames, _) = recording::frames(&arguments.file, arguments.frames.into())?;
        if frames.is_empty() {
            return Err(format!("{} has no frame to draw", arguments.file.display()).into());
        }
        let mut rows: Vec<_> = frames.iter().map(row).collect();
        // A recording without a catalogue has no names to show.
        if survey.recognized + survey.unknown > 0 {
            rows.iter_mut().zip(&frames).for_each(|(row, frame)| row.push(parts(frame)));
        }
        let sheet = picture::contact_sheet(&rows, TILE_WIDTH);
        sheet.save_with_format(out, ImageFormat::Png).map_err(|e| format!("cannot write {}: {e}", out.display()))?;
        print(&format!("sheet      {} frames in {}\n", frames.len(), out.display()));
    }
    match survey.damage {
        None => Ok(ExitCode::SUCCESS),
        Some(damage) => {
            eprintln!("samsod: {} is not complete, listed is what can be read: {damage}", arguments.file.display());
            Ok(ExitCode::from(DATA_LOST))
        }
    }
}

fn recover(arguments: &RecoverArguments) -> Result<ExitCode, Error> {
    let file = &arguments.file;
    let out = arguments.out.clone().unwrap_or_else(|| recording::recovered_path(file));
    let recovery = recording::recover(file, &out)?;
    let megabytes = |bytes: u64| bytes as f64 / 1e6;
    let mut text = format!(
        "recording  {}, {:.1} MB{}\nrecovered  {}, {:.1} MB: {} messages, {} metadata, {} attachments\n",
        file.display(),
        megabytes(recovery.bytes),
        if recovery.was_closed { "" } else { ", was not closed" },
        out.display(),
        megabytes(recovery.bytes_recovered),
        recovery.messages(),
        recovery.metadata,
        recovery.attachments
    );
    text += &format!("\n{:<18} {:>9} {:>9}\n", "topic", "recovered", "lost");
    for topic in &recovery.topics {
        text += &format!("{:<18} {:>9} {:>9}\n", topic.name, topic.recovered, topic.lost);
    }
    for loss in &recovery.losses {
        text += &format!("lost       {} bytes at {}: {}\n", loss.bytes, loss.at, loss.what);
    }
    print(&text);
    if !recovery.has_lost_data() {
        return Ok(ExitCode::SUCCESS);
    }
    let (places, bytes) = (recovery.losses.len(), recovery.losses.iter().map(|loss| loss.bytes).sum::<u64>());
    eprintln!("samsod: {} is not whole: {places} damaged places, {bytes} bytes could not be read", file.display());
    Ok(ExitCode::from(DATA_LOST))
}

fn replay(arguments: &ReplayArguments) -> Result<ExitCode, Error> {
    let options = ReplayOptions {
        config: arguments.config.clone(),
        catalogue: arguments.catalogue.clone(),
        threads: arguments.threads.unwrap_or_default().into(),
    };
    let stop = stop_on_signals()?;
    // A line that is written over is for people only.
    let live = io::stderr().is_terminal();
    let replay = replay::run(&arguments.file, &options, &mut |frames| {
        if live {
            eprint!("\r{frames} frames ");
        }
        !stop.load(Ordering::Relaxed)
    });
    if live {
        eprintln!();
    }
    let replay = replay?;
    print(&replay.to_string());
    if let Some(damage) = &replay.damage {
        eprintln!("samsod: {} is not complete, replayed is what can be read: {damage}", arguments.file.display());
    }
    Ok(match (replay.is_same(), &replay.damage) {
        (false, _) => ExitCode::FAILURE,
        (true, Some(_)) => ExitCode::from(DATA_LOST),
        (true, None) => ExitCode::SUCCESS,
    })
}

/// One row of the sheet: the camera image, the partitions, the saliency, and on the image the regions and the objects.
fn row(frame: &FrameStages) -> Vec<image::RgbImage> {
    let (width, height) = frame.image.dimensions();
    let mut tiles = vec![frame.image.clone()];
    // A stage that is missing, as in the last frame of a damaged file, is left dark.
    let missing = || image::RgbImage::new(width, height);
    tiles.push(if frame.labels.is_empty() {
        missing()
    } else {
        let label = |i: usize| frame.labels[i];
        picture::partition_picture(width, height, &picture::mean_colours(&frame.image, label), label)
    });
    tiles.push(if frame.saliency.is_empty() {
        missing()
    } else {
        picture::saliency_picture(width, height, |i| frame.saliency[i])
    });
    let mut regions = frame.image.clone();
    // Two pixels of the tile.
    let thickness = (2 * width).div_ceil(TILE_WIDTH);
    for (i, outline) in frame.outlines.iter().enumerate() {
        picture::draw_outline(&mut regions, outline, picture::region_colour(i), thickness);
    }
    tiles.push(regions);
    tiles.push(if frame.masks.is_empty() { missing() } else { objects(frame) });
    tiles
}

/// The image with objects and shadows tinted, outlines and numbers.
fn objects(frame: &FrameStages) -> image::RgbImage {
    let mut picture = frame.image.clone();
    picture::tint_masks(&mut picture, &frame.masks);
    let (width, height) = picture.dimensions();
    // One pixel of the tile: small objects must not drown in their outlines.
    let thickness = width.div_ceil(TILE_WIDTH);
    // The uppermost pixel of each object, where its outer outline begins.
    let mut tops: BTreeMap<usize, [u32; 2]> = BTreeMap::new();
    for outline in &frame.object_outlines {
        let Some(&[x, y]) = outline.first().filter(|&&[x, y]| x < width && y < height) else { continue };
        let Shown::Object(index) = Shown::from_code(frame.masks[y as usize * width as usize + x as usize]) else {
            continue;
        };
        picture::draw_outline(&mut picture, outline, picture::region_colour(index), thickness);
        tops.entry(index).or_insert([x, y]);
    }
    // Dots that are still told apart on the tile, above the object, and inside the picture.
    let scale = (3 * width).div_ceil(2 * TILE_WIDTH);
    let margin = 4 * scale;
    for (index, [x, y]) in tops {
        let x = x.clamp(margin, width.saturating_sub(margin).max(margin));
        picture::draw_number(&mut picture, index, x, y.saturating_sub(margin).max(margin), scale);
    }
    picture
}

/// The image in the size of a tile with the outline, the name and the angle of every part.
fn parts(frame: &FrameStages) -> image::RgbImage {
    let mut picture = frame.image.clone();
    let (width, height) = picture.dimensions();
    let thickness = (2 * width).div_ceil(TILE_WIDTH);
    for (i, detection) in frame.detections.iter().enumerate() {
        for outline in &detection.outlines {
            picture::draw_outline(&mut picture, outline, picture::region_colour(i), thickness);
        }
        for line in &detection.arrow {
            caption::draw_line(&mut picture, *line, picture::region_colour(i), thickness);
        }
    }
    // Letters are drawn on the tile itself, where they stay sharp.
    let mut tile = picture::tile(&picture, TILE_WIDTH);
    let share = f64::from(TILE_WIDTH) / f64::from(width.max(1));
    let mut captions = Captions::default();
    for (i, detection) in frame.detections.iter().enumerate() {
        let points = || detection.outlines.iter().flatten();
        let (Some(left), Some(right)) = (points().map(|p| p[0]).min(), points().map(|p| p[0]).max()) else { continue };
        let top = points().map(|p| p[1]).min().unwrap_or(0).min(height);
        let at = [f64::from(left + right) / 2.0 * share, f64::from(top) * share];
        let text = caption::short(detection.name.as_deref(), detection.angle_deg);
        captions.draw(&mut tile, &text, at, picture::region_colour(i), 1);
    }
    tile
}

fn table(file: &Path, survey: &Survey) -> String {
    let seconds = match (survey.first_ns, survey.last_ns) {
        (Some(first), Some(last)) => (last - first) as f64 / 1e9,
        _ => 0.0,
    };
    let mut text = format!(
        "recording  {}\nlength     {seconds:.3} s, {:.1} MB{}\n",
        file.display(),
        survey.bytes as f64 / 1e6,
        if survey.damage.is_some() { ", NOT COMPLETE" } else { "" }
    );
    text += &format!("frames     {}, {} dropped by the recorder\n", survey.frames, survey.frames_dropped);
    let per_frame = survey.objects as f64 / survey.frames.max(1) as f64;
    text += &format!(
        "found      {} salient regions, {} objects ({per_frame:.1} a frame), {} placed in mm\n",
        survey.regions, survey.objects, survey.placed
    );
    if survey.recognized + survey.unknown > 0 {
        text += &format!("parts      {} recognised, {} unknown\n", survey.recognized, survey.unknown);
    }
    let outcomes: Vec<String> = survey.outcomes.iter().map(|(name, n)| format!("{name} {n}")).collect();
    text += &format!("commands   {}", survey.commands);
    text += &if outcomes.is_empty() { "\n".to_string() } else { format!(": {}\n", outcomes.join(", ")) };

    text += &format!("\n{:<18} {:<26} {:<9} {:>9} {:>11}\n", "topic", "schema", "encoding", "messages", "MB");
    for topic in &survey.topics {
        text += &format!(
            "{:<18} {:<26} {:<9} {:>9} {:>11.3}\n",
            topic.name,
            topic.schema,
            topic.encoding,
            topic.messages,
            topic.bytes as f64 / 1e6
        );
    }
    if !survey.stages.is_empty() {
        text += &format!("\n{:<10} {:>8} {:>10} {:>10} {:>10}\n", "stage", "frames", "p50 ms", "p99 ms", "max ms");
    }
    for stage in &survey.stages {
        text += &format!(
            "{:<10} {:>8} {:>10.3} {:>10.3} {:>10.3}\n",
            stage.stage, stage.frames, stage.p50_ms, stage.p99_ms, stage.max_ms
        );
    }
    text
}
