//! The configuration file of `samsodd`: TOML, one section for each part of the service.
//!
//! Input: a file. Output: a checked [`Config`]. Every key has a default and its unit in its name; a key that is not
//! known, or a value out of range, is an error that names the key, the value and what is allowed.
//! `examples/cell.toml` shows every section.

use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

use samsod::recognize::RecognizeParams;
use samsod::saliency::SaliencyParams;
use samsod::segment::SegmentParams;
use samsod::shadow::ShadowParams;
use samsod::{Cell, CellError, CellParams, RegionParams};
use samsod_camera::{CameraFile, CameraFileError, ProjectionError};
use samsod_frame::{FrameServiceConfig, MAX_SIDE_PX, ServiceError};
use samsod_robot::{MonotonicClock, Simulated, SimulatedConfig, SimulatedConfigError};
use serde::{Deserialize, Serialize};

use crate::place::Placer;
use crate::recording::{RecordError, RecorderConfig};

/// All that `samsodd` is told.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Which cell is served.
    pub cell: CellConfig,
    /// Frames in, scenes out.
    pub frames: FramesConfig,
    /// Mean shift and partitions.
    pub segment: SegmentParams,
    /// Saliency.
    pub saliency: SaliencyParams,
    /// Salient regions.
    pub regions: RegionParams,
    /// Separation of objects from their shadows.
    pub shadow: ShadowParams,
    /// Recognition of the objects.
    pub recognize: RecognizeParams,
    /// From the image to the table, and to the robot.
    pub camera: CameraConfig,
    /// Instead of a camera file: a camera that looks straight down.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub view: Option<ViewConfig>,
    /// Commands to the robot.
    pub robot: RobotConfig,
    /// The recording.
    pub recording: RecorderConfig,
    /// Messages on standard error.
    pub log: LogConfig,
}

/// `[cell]`
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CellConfig {
    /// Its name, by which frame clients find the service.
    pub name: String,
}

impl Default for CellConfig {
    fn default() -> Self {
        Self { name: "cell".to_owned() }
    }
}

/// `[frames]`
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FramesConfig {
    /// Folder of the transport's bookkeeping files, the same for all participants.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub root_path: Option<PathBuf>,
    /// Widest frame that is processed, px.
    pub max_width_px: u32,
    /// Highest frame that is processed, px.
    pub max_height_px: u32,
    /// Frames that wait before the oldest is overwritten.
    pub buffer_frames: usize,
    /// Subscribers of frames, and of scenes, at a time; the service is one of them.
    pub max_subscribers: usize,
    /// Largest scene that is published, bytes; the smallest regions are left out of a larger one.
    pub max_scene_bytes: usize,
}

impl Default for FramesConfig {
    fn default() -> Self {
        let FrameServiceConfig { buffer_frames, max_subscribers, max_scene_bytes, .. } = FrameServiceConfig::default();
        Self {
            root_path: None,
            max_width_px: 8192,
            max_height_px: 8192,
            buffer_frames,
            max_subscribers,
            max_scene_bytes,
        }
    }
}

/// `[camera]`: from pixels to millimetres.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CameraConfig {
    /// What `samsod calibrate` wrote, relative to the folder of the configuration; absolute once it was read.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub file: Option<PathBuf>,
    /// Height of the plane on which centroids are placed, mm above the table, for all objects alike.
    pub object_height_mm: f64,
}

/// `[view]`: the substitute for a camera file, a camera that looks straight down.
///
/// Table and robot base are one frame here, z up, and heights do not shift what is seen:
///
/// ```text
/// x_mm = (u - origin_px[0]) * mm_per_px        u right, v down, in the image
/// y_mm = (origin_px[1] - v) * mm_per_px
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ViewConfig {
    /// Size of a pixel on the table, mm.
    pub mm_per_px: f64,
    /// The pixel (u, v) above the origin of the table, px; it may lie outside the image.
    pub origin_px: [f64; 2],
}

impl Default for ViewConfig {
    fn default() -> Self {
        Self { mm_per_px: 0.4, origin_px: [-625.0, 479.0] }
    }
}

impl ViewConfig {
    /// The point of the table (x, y) under a pixel, mm.
    pub fn table_from_image(&self, u: f64, v: f64) -> [f64; 2] {
        [(u - self.origin_px[0]) * self.mm_per_px, (self.origin_px[1] - v) * self.mm_per_px]
    }
}

/// Which controller gets the commands.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ControllerKind {
    /// An arm without a robot.
    #[default]
    Simulated,
    /// None: nothing is commanded.
    None,
}

/// `[robot]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RobotConfig {
    /// `"simulated"` or `"none"`.
    pub controller: ControllerKind,
    /// Share of the greatest joint speed, above 0, at most 1.
    pub joint_speed_fraction: f64,
    /// Height of the tool over an object, mm above the table.
    pub safe_height_mm: f64,
    /// Height at which a part would be grasped, mm above the table; published with the scene.
    pub grasp_height_mm: f64,
    /// Greatest time for one motion, ms; a robot that is not there by then is put on hold.
    pub motion_timeout_ms: u64,
    /// Shape, speeds and home of the simulated arm.
    pub simulated: SimulatedConfig,
}

impl Default for RobotConfig {
    fn default() -> Self {
        Self {
            controller: ControllerKind::default(),
            joint_speed_fraction: 0.5,
            safe_height_mm: 300.0,
            grasp_height_mm: 20.0,
            motion_timeout_ms: 30_000,
            simulated: SimulatedConfig::default(),
        }
    }
}

/// `[log]`
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LogConfig {
    /// `"error"`, `"warn"`, `"info"`, `"debug"` or `"trace"`; the environment variable `RUST_LOG` goes before it.
    pub level: Level,
}

/// From which gravity on messages are shown.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Level {
    /// Lost data and failures.
    Error,
    /// And what was recovered from.
    Warn,
    /// And the events of the service.
    #[default]
    Info,
    /// And every frame.
    Debug,
    /// Everything.
    Trace,
}

impl fmt::Display for Level {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Error => "error",
            Self::Warn => "warn",
            Self::Info => "info",
            Self::Debug => "debug",
            Self::Trace => "trace",
        })
    }
}

/// Why a configuration is not accepted.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file is no TOML, or has a key or a type that is not known.
    #[error("{}: {message}", path.display())]
    Parse {
        /// The file.
        path: PathBuf,
        /// Where and what, with what is allowed.
        message: String,
    },
    /// A value is out of range.
    #[error("{key} is {value}; allowed: {allowed}")]
    Value {
        /// Section and key.
        key: &'static str,
        /// The value given.
        value: String,
        /// What is allowed.
        allowed: String,
    },
    /// A value of `[cell]` or `[frames]` is out of range.
    #[error("{section} {0}", section = section_of(.0))]
    Frames(#[from] ServiceError),
    /// A value of `[segment]`, `[saliency]`, `[regions]` or `[shadow]` is out of range.
    #[error("vision: {0}")]
    Vision(#[from] CellError),
    /// Both ways from the image to the table are given.
    #[error(
        "[camera] file = {} and [view] are both given; a camera file knows where the camera hangs, so remove [view], or \
         [camera] file to go on with the view",
        file.display()
    )]
    CameraAndView {
        /// The camera file.
        file: PathBuf,
    },
    /// The camera file cannot be used.
    #[error("[camera] file: {0}")]
    Camera(#[from] CameraFileError),
    /// The plane of the objects is not seen.
    #[error("[camera] object_height_mm = {object_height_mm}: {cause}")]
    Plane {
        /// The height, mm.
        object_height_mm: f64,
        /// Why.
        cause: ProjectionError,
    },
    /// No frame of the size of the camera would be processed.
    #[error(
        "[camera] file {} is of a camera of {width_px} x {height_px} px, larger than [frames] max_width_px x max_height_px \
         = {max_width_px} x {max_height_px}",
        file.display()
    )]
    CameraSize {
        /// The camera file.
        file: PathBuf,
        /// Width of its image, px.
        width_px: u32,
        /// Height of its image, px.
        height_px: u32,
        /// Widest frame that is processed, px.
        max_width_px: u32,
        /// Highest frame that is processed, px.
        max_height_px: u32,
    },
    /// A value of `[robot.simulated]` is out of range.
    #[error("[robot.simulated] {0}")]
    Simulated(#[from] SimulatedConfigError),
    /// A value of `[recording]` is out of range.
    #[error("[recording] {0}")]
    Recording(#[from] RecordError),
    /// The configuration cannot be written as TOML.
    #[error("cannot print the configuration: {0}")]
    Print(#[from] toml::ser::Error),
}

impl Config {
    /// Reads and checks a file.
    ///
    /// # Errors
    /// [`ConfigError`], with the file, the key, the value and what is allowed.
    pub fn read(path: &Path) -> Result<Self, ConfigError> {
        let text = fs::read_to_string(path).map_err(|source| ConfigError::Read { path: path.to_owned(), source })?;
        let mut config: Self = toml::from_str(&text)
            .map_err(|e| ConfigError::Parse { path: path.to_owned(), message: e.to_string().trim_end().to_owned() })?;
        if let Some(file) = &mut config.camera.file {
            let beside = path.parent().unwrap_or(Path::new("")).join(&*file);
            // What is printed must mean the same from any folder.
            *file = std::path::absolute(&beside).unwrap_or(beside);
        }
        config.check()?;
        Ok(config)
    }

    /// What places objects in millimetres; `None` when neither a camera file nor a view is given. Reads the camera file.
    ///
    /// # Errors
    /// Both are given; the camera file cannot be used.
    pub fn placer(&self) -> Result<Option<Placer>, ConfigError> {
        let CameraConfig { file, object_height_mm } = &self.camera;
        let height_mm = *object_height_mm;
        let file = match (file, self.view) {
            (Some(file), Some(_)) => return Err(ConfigError::CameraAndView { file: file.clone() }),
            (None, view) => return Ok(view.map(|view| Placer::with_view(view, height_mm))),
            (Some(file), None) => file,
        };
        let camera = CameraFile::read_camera(file)?;
        let [width_px, height_px] = camera.intrinsics().size_px();
        let FramesConfig { max_width_px, max_height_px, .. } = self.frames;
        if width_px > max_width_px || height_px > max_height_px {
            let file = file.clone();
            return Err(ConfigError::CameraSize { file, width_px, height_px, max_width_px, max_height_px });
        }
        let placer = Placer::with_camera(camera, height_mm);
        placer.map(Some).map_err(|cause| ConfigError::Plane { object_height_mm: height_mm, cause })
    }

    /// The configuration in force as TOML, every key with its value. A key that is not set, which TOML cannot express,
    /// stands in a comment at the head of its section, with what is done without it.
    ///
    /// # Errors
    /// [`ConfigError::Print`].
    pub fn to_toml(&self) -> Result<String, ConfigError> {
        let mut text = String::new();
        if self.view.is_none() {
            let without = if self.camera.file.is_some() {
                "[camera] file takes its place"
            } else {
                "and no [camera] file: objects have no place in mm, and the robot is not commanded"
            };
            text += &format!("# [view] mm_per_px, origin_px: not set, {without}\n\n");
        }
        for line in toml::to_string(self)?.lines() {
            text += line;
            text.push('\n');
            for (_, key, without) in self.unset().iter().filter(|(section, ..)| *section == line) {
                text += &format!("# {key}: not set, {without}\n");
            }
        }
        Ok(text)
    }

    /// The keys without a value: section, key, and what is done without it.
    fn unset(&self) -> Vec<(&'static str, &'static str, &'static str)> {
        let segment = &self.segment;
        let optional = [
            (
                self.camera.file.is_none(),
                "[camera]",
                "file",
                if self.view.is_some() { "[view] takes its place" } else { "samsod calibrate writes one" },
            ),
            (self.frames.root_path.is_none(), "[frames]", "root_path", "that of iceoryx2, /tmp/iceoryx2"),
            (
                segment.spatial_bandwidth_px.is_none(),
                "[segment]",
                "spatial_bandwidth_px",
                "a ninetieth of the longer side, at least 3",
            ),
            (
                segment.min_area_px.is_none(),
                "[segment]",
                "min_area_px",
                "three quarters of the squared spatial bandwidth",
            ),
            (
                self.shadow.min_object_area_px.is_none(),
                "[shadow]",
                "min_object_area_px",
                "two thirds of [segment] min_area_px",
            ),
        ];
        optional
            .into_iter()
            .filter_map(|(is_unset, section, key, without)| is_unset.then_some((section, key, without)))
            .collect()
    }

    /// Checks every value.
    ///
    /// # Errors
    /// The first value out of range.
    pub fn check(&self) -> Result<(), ConfigError> {
        self.service().check()?;
        for (key, value) in
            [("[frames] max_width_px", self.frames.max_width_px), ("[frames] max_height_px", self.frames.max_height_px)]
        {
            within(key, f64::from(value), 1.0, f64::from(MAX_SIDE_PX))?;
        }
        Cell::new(self.vision())?;
        if let Some(view) = &self.view {
            within("[view] mm_per_px", view.mm_per_px, 0.001, 1000.0)?;
            for value in view.origin_px {
                within("[view] origin_px", value, -1e6, 1e6)?;
            }
        }
        within("[camera] object_height_mm", self.camera.object_height_mm, -1000.0, 5000.0)?;
        self.placer()?;
        let robot = &self.robot;
        within("[robot] joint_speed_fraction", robot.joint_speed_fraction, 0.001, 1.0)?;
        within("[robot] grasp_height_mm", robot.grasp_height_mm, 0.0, 5000.0)?;
        // The robot moves freely at this height: it lies above what it grips and above the plane of the objects.
        let least_mm = robot.grasp_height_mm.max(self.camera.object_height_mm);
        within("[robot] safe_height_mm", robot.safe_height_mm, least_mm, 5000.0)?;
        within("[robot] motion_timeout_ms", robot.motion_timeout_ms as f64, 100.0, 600_000.0)?;
        Simulated::new(robot.simulated.clone(), MonotonicClock::new())?;
        Ok(self.recording.check()?)
    }

    /// The shared memory that the service takes part in.
    pub fn service(&self) -> FrameServiceConfig {
        FrameServiceConfig {
            cell: self.cell.name.clone(),
            root_path: self.frames.root_path.clone(),
            buffer_frames: self.frames.buffer_frames,
            max_subscribers: self.frames.max_subscribers,
            max_scene_bytes: self.frames.max_scene_bytes,
            ..FrameServiceConfig::default()
        }
    }

    /// The parameters of the vision chain.
    pub fn vision(&self) -> CellParams {
        CellParams {
            segment: self.segment.clone(),
            saliency: self.saliency.clone(),
            regions: self.regions,
            shadow: self.shadow.clone(),
            recognize: self.recognize.clone(),
        }
    }
}

/// Where the value stands that a [`ServiceError`] is about.
fn section_of(error: &ServiceError) -> &'static str {
    match error {
        ServiceError::CellName { .. } => "[cell]",
        _ => "[frames]",
    }
}

fn within(key: &'static str, value: f64, min: f64, max: f64) -> Result<(), ConfigError> {
    // NaN is in no range.
    if (min..=max).contains(&value) {
        return Ok(());
    }
    Err(ConfigError::Value { key, value: value.to_string(), allowed: format!("{min} to {max}") })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Config, ConfigError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cell.toml");
        fs::write(&path, text).unwrap();
        Config::read(&path)
    }

    #[test]
    fn an_empty_file_is_the_defaults_and_they_print_and_read_back() {
        let config = read("").unwrap();
        assert_eq!(config, Config::default());
        // An angle may change in its last digit on the way through degrees.
        let again = read(&config.to_toml().unwrap()).unwrap();
        let robot = RobotConfig { simulated: config.robot.simulated.clone(), ..again.robot.clone() };
        assert_eq!(Config { robot, ..again }, config);
    }

    #[test]
    fn every_key_is_printed_one_without_a_value_in_a_comment() {
        let text = Config::default().to_toml().unwrap();
        // A pose has no optional keys, and refuses a missing one before an unknown one.
        let is_section = |line: &&str| line.starts_with('[') && *line != "[robot.simulated.home]";
        let sections = text.lines().filter(is_section).collect::<Vec<_>>();
        assert_eq!(sections.len(), 11, "{sections:?}");
        for section in sections {
            let (_, part) = text.split_once(&format!("{section}\n")).unwrap();
            let part = part.split("\n[").next().unwrap();
            // What is said of an unknown key names all that are known.
            let refusal = read(&format!("{section}\nno_such_key = 1\n")).unwrap_err().to_string();
            let (_, known) = refusal.split_once("expected ").unwrap_or_else(|| panic!("{refusal}"));
            for key in known.split('`').skip(1).step_by(2) {
                let starts = [format!("{key} = "), format!("# {key}: not set, ")];
                let is_section = text.contains(&format!(".{key}]\n"));
                assert!(
                    is_section || part.lines().any(|line| starts.iter().any(|start| line.starts_with(start))),
                    "{section} {key}: {text}"
                );
            }
        }
        assert!(text.contains("[segment]\n# spatial_bandwidth_px: not set, a ninetieth of the longer side"), "{text}");

        // One that is set is no comment, and reads back.
        let set = "[frames]\nroot_path = \"/tmp/a\"\n[segment]\nspatial_bandwidth_px = 12.0\nmin_area_px = 48\n\
                   [shadow]\nmin_object_area_px = 30\n[view]\n";
        let config = read(set).unwrap();
        let text = config.to_toml().unwrap();
        let comments: Vec<&str> = text.lines().filter(|line| line.contains('#')).collect();
        assert_eq!(comments, ["# file: not set, [view] takes its place"], "{text}");
        let again = read(&text).unwrap();
        assert_eq!((again.frames, again.segment, again.shadow), (config.frames, config.segment, config.shadow));
    }

    #[test]
    fn the_example_is_accepted() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/cell.toml");
        let config = Config::read(&path).unwrap();
        assert_eq!(config.cell.name, "demo");
        // The corners of a camera frame lie within reach of the simulated arm.
        let arm = || Simulated::new(config.robot.simulated.clone(), MonotonicClock::new()).unwrap();
        for (u, v) in [(0.0, 0.0), (1077.0, 0.0), (0.0, 957.0), (1077.0, 957.0)] {
            let [x, y] = config.view.unwrap().table_from_image(u, v);
            let mut arm = arm();
            samsod_robot::Controller::connect(&mut arm).unwrap();
            let target = samsod_robot::Pose::gripper_down(x, y, config.robot.safe_height_mm, 0.0);
            let motion = samsod_robot::Motion::Joint { target, speed_fraction: 0.5 };
            samsod_robot::Controller::start_motion(&mut arm, samsod_robot::CommandId(1), &motion).unwrap();
        }
    }

    #[test]
    fn a_view_is_printed_when_it_is_given_and_named_when_it_is_not() {
        let text = Config::default().to_toml().unwrap();
        assert!(text.starts_with("# [view] mm_per_px, origin_px: not set, and no [camera] file: objects"), "{text}");
        let text = read("[view]\nmm_per_px = 0.5").unwrap().to_toml().unwrap();
        assert!(text.contains("[view]\nmm_per_px = 0.5\norigin_px = [-625.0, 479.0]\n"), "{text}");
        assert!(!text.contains("# [view]"), "{text}");
        assert_eq!(read(&text).unwrap().view, Some(ViewConfig { mm_per_px: 0.5, ..ViewConfig::default() }));
    }

    const CAMERA: &str = "[intrinsics]\nwidth_px = 1078\nheight_px = 958\nfx_px = 1600.0\nfy_px = 1600.0\n\
        cx_px = 541.2\ncy_px = 476.6\nk1 = 0.0\nk2 = 0.0\np1 = 0.0\np2 = 0.0\nk3 = 0.0\n";
    const WORLD: &str = "[world]\nworld_from_camera_mm = [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], \
        [0.0, 0.0, -1.0, 900.0], [0.0, 0.0, 0.0, 1.0]]\n";

    /// A configuration with a camera file beside it.
    fn read_with_camera(text: &str, camera: &str) -> Result<Config, ConfigError> {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("camera.toml"), camera).unwrap();
        let path = folder.path().join("cell.toml");
        fs::write(&path, text).unwrap();
        let config = Config::read(&path)?;
        assert_eq!(config.camera.file, Some(std::path::absolute(folder.path().join("camera.toml")).unwrap()));
        // What is printed means the same elsewhere, while the file is there.
        let elsewhere = tempfile::tempdir().unwrap();
        let printed = elsewhere.path().join("printed.toml");
        fs::write(&printed, config.to_toml().unwrap()).unwrap();
        assert_eq!(Config::read(&printed).unwrap().camera, config.camera);
        assert!(config.placer()?.unwrap().image_size_px() == Some([1078, 958]));
        Ok(config)
    }

    #[test]
    fn a_camera_file_lies_beside_the_configuration_and_is_checked_with_it() {
        let whole = format!("{CAMERA}{WORLD}");
        let with = |keys: &str| format!("[camera]\nfile = \"camera.toml\"\n{keys}\n");
        let config = read_with_camera(&with("object_height_mm = 12.5"), &whole).unwrap();
        assert_eq!((config.camera.object_height_mm, config.view), (12.5, None));
        for (text, camera, parts) in [
            (with(""), CAMERA.to_owned(), vec!["[camera] file: ", "camera.toml: there is no [world]"]),
            (with(""), whole.replace("fx_px = 1600.0", "fx_px = -1.0"), vec!["camera.toml: [intrinsics] fx_px"]),
            (with(""), "[intrinsics]\n".to_owned(), vec!["[camera] file: ", "camera.toml", "missing field `width_px`"]),
            (with("[view]"), whole.clone(), vec!["[camera] file = ", "camera.toml and [view] are both given"]),
            (
                with("[frames]\nmax_height_px = 900"),
                whole.clone(),
                vec!["1078 x 958 px", "max_height_px", "8192 x 900"],
            ),
            (with("object_height_mm = 950.0"), whole.clone(), vec!["object_height_mm = 950: the plane z = 950 mm is"]),
            (with("object_height_mm = nan"), whole.clone(), vec!["[camera] object_height_mm is NaN"]),
            ("[camera]\nfile = \"none.toml\"".to_owned(), whole.clone(), vec!["cannot read ", "none.toml"]),
        ] {
            let refusal = read_with_camera(&text, &camera).unwrap_err().to_string();
            for part in parts {
                assert!(refusal.contains(part), "{text:?}: {refusal}");
            }
        }
    }

    #[test]
    fn refusals_name_the_key_the_value_and_what_is_allowed() {
        for (text, parts) in [
            ("[segmnt]", vec!["unknown field `segmnt`", "expected one of", "`segment`"]),
            ("[view]\nmm_per_pixel = 1.0", vec!["unknown field `mm_per_pixel`", "`mm_per_px`"]),
            ("[view]\nmm_per_px = \"wide\"", vec!["invalid type: string \"wide\"", "mm_per_px", "line 2"]),
            ("[cell", vec!["cell.toml", "line 1"]),
            ("[camera]\nfiles = \"a\"", vec!["unknown field `files`", "`file`", "`object_height_mm`"]),
            ("[view]\nmm_per_px = -1.0", vec!["[view] mm_per_px is -1; allowed: 0.001 to 1000"]),
            ("[view]\nmm_per_px = nan", vec!["[view] mm_per_px is NaN"]),
            ("[view]\norigin_px = [0.0, inf]", vec!["[view] origin_px is inf"]),
            ("[frames]\nmax_width_px = 0", vec!["[frames] max_width_px is 0; allowed: 1 to 16384"]),
            ("[frames]\nbuffer_frames = 0", vec!["[frames] buffer_frames is 0; 1 to 64 are allowed"]),
            ("[cell]\nname = \"a b\"", vec!["[cell] cell name \"a b\" must be"]),
            ("[segment]\nrange_bandwidth = nan", vec!["range_bandwidth = NaN; allowed are 1 to 255"]),
            ("[saliency]\nmethod = \"slow\"", vec!["unknown variant `slow`", "`fast`", "`exact`"]),
            ("[regions]\nthreshold = -1.0", vec!["-1"]),
            ("[shadow]\nobject_side = \"bright\"", vec!["unknown variant `bright`", "`paper`", "`evidence`"]),
            (
                "[shadow]\nmin_object_area_px = 0",
                vec!["vision: shadow: min_object_area_px = 0; allowed are 1 to 4294967295"],
            ),
            ("[robot]\ncontroller = \"motoman\"", vec!["unknown variant `motoman`", "`simulated`"]),
            ("[robot]\njoint_speed_fraction = 1.5", vec!["joint_speed_fraction is 1.5; allowed: 0.001 to 1"]),
            ("[robot]\nsafe_height_mm = 5.0", vec!["[robot] safe_height_mm is 5; allowed: 20 to 5000"]),
            ("[camera]\nobject_height_mm = 400.0", vec!["[robot] safe_height_mm is 300; allowed: 400 to 5000"]),
            ("[recording]\nqueue_frames = 0", vec!["[recording] queue_frames = 0; allowed is 1 to 64"]),
            ("[robot.simulated]\nreach_max_mm = -2.0", vec!["[robot.simulated] reach_max_mm is -2"]),
            (
                "[robot.simulated]\nbase_turn_max_deg = 200.0",
                vec!["[robot.simulated] base_turn_max_deg is 200; it must be above 0 and below 180"],
            ),
            ("[frames]\nroot_path = \"here\"", vec!["[frames] root_path here: it must be absolute"]),
        ] {
            let refusal = read(text).unwrap_err().to_string();
            for part in parts {
                assert!(refusal.contains(part), "{text:?}: {refusal}");
            }
        }
        let missing = Config::read(Path::new("/no/such/cell.toml")).unwrap_err().to_string();
        assert!(missing.starts_with("cannot read /no/such/cell.toml: "), "{missing}");
    }
}
