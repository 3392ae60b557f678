//! `samsod replay`: the frames of a recording through the chain again, every stage compared with what was recorded.
//!
//! In: a recording that says what it was made with, or a configuration. Out: a [`Replay`]: of every stage how many frames differ,
//! and by how much. Times are not compared.
//!
//! Messages are made as the recorder makes them and compared byte by byte; only where bytes differ are they taken apart. The same
//! program with the same configuration gives the same bytes, whatever the number of threads and whatever came before a frame.

mod compare;

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};
use samsod::segment::RgbView;
use samsod::{Cell, CellError, Scene};
use samsod_robot::Pose;

pub use self::compare::{Stage, StageComparison};
use crate::config::{Config, ConfigError};
use crate::config_changes::config_changes;
use crate::made_with::{MadeWith, build};
use crate::pick;
use crate::place::{ImagePlace, Place, Placer};
use crate::recording::{
    self, FrameReader, FrameRecord, ReadError, RecordError, RecordedFrame, SaliencyEncoding, Target, stage_messages,
};

/// How a recording is replayed.
#[derive(Debug, Clone, Default)]
pub struct ReplayOptions {
    /// Another configuration than that of the recording.
    pub config: Option<PathBuf>,
    /// Another folder for the catalogue than that of the configuration.
    pub catalogue: Option<PathBuf>,
    /// Threads of the vision chain; 0 takes all cores.
    pub threads: usize,
}

/// Why a recording cannot be replayed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReplayError {
    /// The file cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// The file does not say what it was made with.
    #[error("{} does not say with what configuration it was made; give it by --config", path.display())]
    NoConfiguration {
        /// The file.
        path: PathBuf,
    },
    /// The configuration cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The catalogue of the configuration cannot be read.
    #[error("{cause}; --catalogue names another folder")]
    Catalogue {
        /// Why.
        cause: ConfigError,
    },
    /// The chain refused a frame or its parameters.
    #[error("frame {number}: {cause}")]
    Cell {
        /// Which, from 0.
        number: u64,
        /// Why.
        cause: CellError,
    },
    /// A frame is not of the camera.
    #[error(
        "frame {number} is {width} x {height} px; the camera of [camera] file has {camera_width} x {camera_height} px"
    )]
    OtherCamera {
        /// Which, from 0.
        number: u64,
        /// Its width, px.
        width: u32,
        /// Its height, px.
        height: u32,
        /// Width of the camera's image, px.
        camera_width: u32,
        /// Height of the camera's image, px.
        camera_height: u32,
    },
    /// A frame has more pixels than memory has addresses.
    #[error("frame {number} is {width} x {height} px, too many to address")]
    Size {
        /// Which, from 0.
        number: u64,
        /// Its width, px.
        width: u32,
        /// Its height, px.
        height: u32,
    },
    /// What was found cannot be written as it was recorded.
    #[error(transparent)]
    Encode(#[from] RecordError),
    /// The threads cannot be started.
    #[error("cannot start {threads} threads: {cause}")]
    Threads {
        /// How many.
        threads: usize,
        /// Why.
        cause: ThreadPoolBuildError,
    },
    /// Interrupted.
    #[error("interrupted")]
    Interrupted,
}

/// What came of it.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Replay {
    /// The file.
    pub file: PathBuf,
    /// What it was made with, if it says so.
    pub made_with: Option<MadeWith>,
    /// What configuration, camera file and catalogue have otherwise than those of the recording, in words.
    pub set_up_otherwise: Vec<String>,
    /// Threads of the vision chain.
    pub threads: usize,
    /// Frames replayed.
    pub frames: u64,
    /// Frames of which at least one stage differs.
    pub differ: u64,
    /// Frames of which messages are missing; the stages that are there are compared.
    pub incomplete: u64,
    /// Frames recorded as JPEG: what was seen were other pixels.
    pub inexact: u64,
    /// The stages in their order.
    pub stages: Vec<StageComparison>,
    /// Whether places to go to are compared; not in a cell with an assembly list, where they follow from the robot, too.
    pub compares_targets: bool,
    /// Why the file is not whole, if it is not.
    pub damage: Option<String>,
}

impl Replay {
    /// Whether every stage of every frame is the same.
    pub fn is_same(&self) -> bool {
        self.differ == 0
    }

    /// Whether the recording was made by the same program.
    pub fn is_same_build(&self) -> bool {
        self.made_with.as_ref().is_some_and(|with| with.build == build())
    }
}

impl fmt::Display for Replay {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "recording      {}", self.file.display())?;
        match &self.made_with {
            Some(with) => writeln!(f, "made by        samsod {}, build {}", with.version, with.build)?,
            None => writeln!(f, "made by        it does not say")?,
        }
        let same = if self.is_same_build() { ", the same" } else { "" };
        writeln!(f, "replayed by    samsod {}, build {}{same}", env!("CARGO_PKG_VERSION"), build())?;
        writeln!(f, "threads        {}", self.threads)?;
        if self.made_with.is_some() && self.set_up_otherwise.is_empty() {
            writeln!(f, "configuration  that of the recording")?;
        }
        for change in &self.set_up_otherwise {
            writeln!(f, "configuration  {change}")?;
        }
        if self.inexact > 0 {
            writeln!(
                f,
                "note           {} frames are recorded as JPEG: the recorded pixels are not those that were seen, so a \
                 difference tells nothing of the program",
                self.inexact
            )?;
        }
        if self.incomplete > 0 {
            writeln!(f, "note           of {} frames messages are missing", self.incomplete)?;
        }
        if !self.compares_targets {
            writeln!(f, "note           targets of the assembly follow from the robot, too, and are not compared")?;
        }
        if self.is_same() {
            return writeln!(f, "{} frames, every stage the same", self.frames);
        }
        writeln!(f, "{:<12} {:>8} {:>8}  by how much", "stage", "frames", "differ")?;
        for stage in &self.stages {
            writeln!(f, "{stage}")?;
        }
        writeln!(f, "{} frames, {} differ", self.frames, self.differ)
    }
}

/// Replays a recording as far as it goes. `progress` is told after each frame how many there were, and says whether to go on.
///
/// # Errors
/// [`ReplayError`]
pub fn run(path: &Path, options: &ReplayOptions, progress: &mut dyn FnMut(u64) -> bool) -> Result<Replay, ReplayError> {
    let made_with = recording::made_with(path)?;
    let (mut chain, set_up_otherwise, compares_targets) = set_up(path, options, made_with.as_ref())?;
    let targets = if compares_targets { recording::targets(path)? } else { BTreeMap::new() };
    let mut replay = Replay {
        file: path.to_owned(),
        made_with,
        set_up_otherwise,
        threads: chain.pool.current_num_threads(),
        stages: StageComparison::all(),
        compares_targets,
        ..Replay::default()
    };
    let mut reader = FrameReader::open(path)?;
    while let Some(frame) = reader.next()? {
        let number = replay.frames;
        let seen = chain.see(&frame, number)?;
        let of_frame = targets.get(&frame.timestamp_ns).map_or(&[][..], Vec::as_slice);
        let differs = compare::compare(&frame, &seen, of_frame, &mut replay.stages);
        replay.frames += 1;
        replay.differ += u64::from(differs);
        replay.incomplete += u64::from(!frame.is_whole);
        replay.inexact += u64::from(!frame.is_exact);
        if !progress(replay.frames) {
            return Err(ReplayError::Interrupted);
        }
    }
    replay.damage = reader.damage().map(str::to_owned);
    Ok(replay)
}

/// The chain, what it has otherwise than the recording, and whether the robot goes straight to what is seen.
fn set_up(
    path: &Path,
    options: &ReplayOptions,
    made_with: Option<&MadeWith>,
) -> Result<(Chain, Vec<String>, bool), ReplayError> {
    let recorded = made_with.map(|with| Config::from_toml(&with.configuration, path));
    let mut config = match (&options.config, &recorded) {
        (Some(file), _) => Config::read_without_catalogue(file)?,
        (None, Some(Ok(config))) => config.clone(),
        (None, None) => return Err(ReplayError::NoConfiguration { path: path.to_owned() }),
        (None, Some(Err(_))) => {
            return Err(recorded
                .and_then(Result::err)
                .map_or_else(|| ReplayError::NoConfiguration { path: path.to_owned() }, ReplayError::Config));
        }
    };
    if let Some(folder) = &options.catalogue {
        config.catalogue.folder = Some(folder.clone());
    }
    // The camera file itself may lie elsewhere, or be another by now.
    let kept = made_with.and_then(|with| with.camera.as_deref()).filter(|_| options.config.is_none());
    let placer = match kept {
        Some(camera) => config.placer_with(camera)?,
        None => config.placer()?,
    };
    let cell = config.make_cell().map_err(|cause| match cause {
        cause @ ConfigError::Catalogue(_) => ReplayError::Catalogue { cause },
        cause => ReplayError::Config(cause),
    })?;
    let mut otherwise = Vec::new();
    if let (Some(with), Some(Ok(recorded))) = (made_with, &recorded) {
        let changes = config_changes(recorded, &config).map_err(ConfigError::Print)?;
        // Where files lie says nothing: what is in them does.
        let places = ["camera.file", "catalogue.folder"];
        let changes = changes.iter().filter(|change| !places.contains(&change.key.as_str()) && is_seen_by(&change.key));
        otherwise.extend(changes.map(ToString::to_string));
        if kept.is_none() {
            let now = MadeWith::new(&config, None)?;
            if now.camera != with.camera {
                otherwise.push("[camera] file: another camera file than that of the recording".to_owned());
            }
        }
        otherwise.extend(with.other_parts(&MadeWith::parts_of(cell.catalogue())?));
    }
    let threads = options.threads;
    let pool = ThreadPoolBuilder::new().num_threads(threads).build();
    let pool = pool.map_err(|cause| ReplayError::Threads { threads, cause })?;
    let safe_height_mm = config.robot.safe_height_mm;
    let chain = Chain { cell, placer, safe_height_mm, scene: Scene::default(), camera_size: None, pool };
    Ok((chain, otherwise, config.jig.order.is_empty()))
}

/// Whether scenes and targets follow from a key.
fn is_seen_by(key: &str) -> bool {
    let sections = ["segment", "saliency", "regions", "shadow", "recognize", "catalogue", "camera", "view"];
    sections.iter().any(|section| key == *section || key.starts_with(&format!("{section}.")))
        || key == "robot.safe_height_mm"
}

/// The vision chain as the service runs it.
struct Chain {
    cell: Cell,
    placer: Option<Placer>,
    safe_height_mm: f64,
    scene: Scene,
    camera_size: Option<[u32; 2]>,
    pool: ThreadPool,
}

/// What the chain has found in a frame.
struct Seen<'a> {
    scene: &'a Scene,
    /// As the recorder writes it.
    messages: Vec<(&'static str, Vec<u8>)>,
    /// Where a robot without an assembly list is sent.
    target: Option<Pose>,
}

impl Chain {
    fn see(&mut self, frame: &RecordedFrame, number: u64) -> Result<Seen<'_>, ReplayError> {
        let (width, height) = frame.image.dimensions();
        let size = [width, height];
        if let Some([camera_width, camera_height]) = self.placer.as_ref().and_then(Placer::image_size_px)
            && size != [camera_width, camera_height]
        {
            return Err(ReplayError::OtherCamera { number, width, height, camera_width, camera_height });
        }
        if self.camera_size != Some(size) {
            self.cell.set_camera(self.placer.as_ref().and_then(|placer| placer.camera(size)));
            self.camera_size = Some(size);
        }
        let image = RgbView::from_raw(width, height, frame.image.as_raw().as_slice());
        let image = image.ok_or(ReplayError::Size { number, width, height })?;
        let (cell, scene) = (&mut self.cell, &mut self.scene);
        self.pool.install(|| cell.inspect_into(&image, scene)).map_err(|cause| ReplayError::Cell { number, cause })?;
        let scene = &self.scene;
        let places: Option<Vec<Option<Place>>> = self
            .placer
            .as_ref()
            .map(|placer| scene.objects.iter().map(|object| placer.place(&ImagePlace::from(object)).ok()).collect());
        let base_from_world = self.placer.as_ref().and_then(Placer::base_from_world);
        // Where a region of interest was drawn is not known.
        let pick = match (self.cell.catalogue(), &base_from_world) {
            (None, _) => pick::best_object(&scene.objects, places.as_deref().unwrap_or_default(), |_| true),
            (Some(catalogue), Some(base)) => pick::best_part(&scene.detections, catalogue, base, |_| true),
            (Some(_), None) => None,
        };
        let target = pick.and_then(|p| self.placer.as_ref()?.tool(p.at_mm, p.base_yaw_deg, self.safe_height_mm));
        let record = FrameRecord {
            timestamp_ns: frame.timestamp_ns,
            // Of a frame whose figures are missing nobody knows it, and nothing is compared with it.
            sequence: frame.scene().and_then(|scene| scene["sequence"].as_u64()).unwrap_or_default(),
            camera: &frame.camera,
            image: &image,
            scene,
            places: places.as_deref(),
            base_from_world: base_from_world.as_ref(),
            other_times: &[],
        };
        let encoding = if frame.has_float_saliency() { SaliencyEncoding::Float32 } else { SaliencyEncoding::Mono8 };
        Ok(Seen { scene, messages: stage_messages(&record, encoding)?, target })
    }
}
