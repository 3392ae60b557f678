//! The configuration file of `samsodd`: TOML, one section for each part of the service.
//!
//! Input: a file. Output: a checked [`Config`]. Every key has a default and its unit in its name; a key that is not
//! known, or a value out of range, is an error that names the key, the value and what is allowed.
//! `examples/cell.toml` shows every section.

use std::borrow::Cow;
use std::fmt;
use std::fs;
use std::io;
use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};

use samsod::recognize::{Catalogue, CatalogueError, RecognizeParams};
use samsod::saliency::SaliencyParams;
use samsod::segment::SegmentParams;
use samsod::shadow::ShadowParams;
use samsod::{Cell, CellError, CellParams, RegionParams};
use samsod_camera::{Camera, CameraFile, CameraFileError, ProjectionError};
use samsod_frame::{FrameServiceConfig, MAX_SIDE_PX, ServiceError};
use samsod_robot::{
    ArmModel, GripperShape, JigSlot, Joints, Limits, MotionError, MotomanConfig, MotomanConfigError, PartTableError,
    PickTolerance, Pose, SimulatedConfig, SimulatedConfigError, TableState,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::place::Placer;
use crate::recording::{FoxgloveConfig, RecordError, RecorderConfig};

/// All that `samsodd` is told.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
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
    /// Recognition of the objects; of use with a catalogue.
    pub recognize: RecognizeParams,
    /// The parts that are recognised.
    pub catalogue: CatalogueConfig,
    /// From the image to the table, and to the robot.
    pub camera: CameraConfig,
    /// Instead of a camera file: a camera that looks straight down.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub view: Option<ViewConfig>,
    /// Commands to the robot.
    pub robot: RobotConfig,
    /// What is put where.
    pub jig: JigConfig,
    /// The recording.
    pub recording: RecorderConfig,
    /// When a part of the service is taken for stuck.
    pub supervision: SupervisionConfig,
    /// Where on the picture parts may be picked.
    pub interest: InterestConfig,
    /// The operator's page, health and metrics, served to whoever watches.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub http: Option<HttpConfig>,
    /// The topics of the recording live, for Foxglove's viewer.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub foxglove: Option<FoxgloveConfig>,
    /// Messages on standard error.
    pub log: LogConfig,
}

/// `[cell]`
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
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
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
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
    /// Time without a frame, after the first one, from which on frames are told to have stopped, ms.
    pub stalled_after_ms: u64,
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
            stalled_after_ms: 5000,
        }
    }
}

/// `[catalogue]`: the parts that objects are compared with.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct CatalogueConfig {
    /// Folder with a folder for each part, relative to the folder of the configuration; absolute once it was read.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub folder: Option<PathBuf>,
}

/// `[camera]`: from pixels to millimetres.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
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
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
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
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ControllerKind {
    /// An arm without a robot.
    #[default]
    Simulated,
    /// A Yaskawa controller over its Ethernet Server protocol.
    Motoman,
    /// None: nothing is commanded.
    None,
}

/// `[robot]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RobotConfig {
    /// `"simulated"`, `"motoman"` or `"none"`.
    pub controller: ControllerKind,
    /// Whether anything but a simulated robot may be moved.
    pub armed: bool,
    /// Where the tool waits, `base_from_tool`; the simulated arm starts there.
    pub home: Pose,
    /// Length of the tool: from the flange straight out to the tool centre point between the finger tips, mm.
    pub tool_length_mm: f64,
    /// Share of the greatest joint speed, above 0, at most 1.
    pub joint_speed_fraction: f64,
    /// Speed of the way down to a part and up from it, mm/s.
    pub linear_speed_mm_s: f64,
    /// Height of the tool on its way, mm above the table.
    pub safe_height_mm: f64,
    /// Height at which an object without a known height would be grasped, mm above the table; published with the scene.
    pub grasp_height_mm: f64,
    /// Greatest time for one joint motion, ms; a robot that is not there by then is put on hold. Linear motions have half as
    /// much again as their way takes, and 2 s.
    pub motion_timeout_ms: u64,
    /// Greatest time for the gripper, ms.
    pub gripper_timeout_ms: u64,
    /// Time between two looks at a robot that moves, ms.
    pub poll_interval_ms: u64,
    /// Distance that the gripper keeps from what it shall not touch, mm.
    pub clearance_mm: f64,
    /// Shape of the gripper.
    pub gripper: GripperShape,
    /// What is never asked of the robot.
    pub limits: Limits,
    /// The simulated arm and its table.
    pub simulated: SimulatedCellConfig,
    /// How the Yaskawa controller is reached, and what is wired to it.
    pub motoman: MotomanConfig,
}

impl Default for RobotConfig {
    fn default() -> Self {
        let SimulatedConfig { home, tool_length_mm, .. } = SimulatedConfig::default();
        Self {
            controller: ControllerKind::default(),
            armed: false,
            home,
            tool_length_mm,
            joint_speed_fraction: 0.5,
            linear_speed_mm_s: 250.0,
            safe_height_mm: 200.0,
            grasp_height_mm: 20.0,
            motion_timeout_ms: 30_000,
            gripper_timeout_ms: 3000,
            poll_interval_ms: 50,
            clearance_mm: 2.0,
            gripper: GripperShape::default(),
            limits: Limits::default(),
            simulated: SimulatedCellConfig::default(),
            motoman: MotomanConfig::default(),
        }
    }
}

impl RobotConfig {
    /// The arm, for what can be reached.
    pub fn arm(&self) -> ArmModel {
        ArmModel::mh5(self.tool_length_mm)
    }

    /// The simulated arm.
    pub fn simulated_arm(&self) -> SimulatedConfig {
        SimulatedConfig {
            home: self.home,
            tool_length_mm: self.tool_length_mm,
            linear_speed_max_mm_s: self.simulated.linear_speed_max_mm_s,
            gripper_time_ms: self.simulated.gripper_time_ms,
        }
    }
}

/// `[robot.simulated]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SimulatedCellConfig {
    /// Greatest speed of a linear motion, mm/s.
    pub linear_speed_max_mm_s: f64,
    /// Time that the gripper takes, ms.
    pub gripper_time_ms: u64,
    /// How many times faster than life the arm lives.
    pub clock_rate: f64,
    /// A table of parts that the gripper can pick, relative to the folder of the configuration; absolute once it was read. It
    /// is replaced at every pick.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub table: Option<PathBuf>,
    /// How far off a pick may be.
    pub pick_tolerance: PickTolerance,
}

impl Default for SimulatedCellConfig {
    fn default() -> Self {
        let SimulatedConfig { linear_speed_max_mm_s, gripper_time_ms, .. } = SimulatedConfig::default();
        let pick_tolerance = PickTolerance::default();
        Self { linear_speed_max_mm_s, gripper_time_ms, clock_rate: 1.0, table: None, pick_tolerance }
    }
}

/// `[jig]`: the assembly list.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct JigConfig {
    /// The parts in the order in which they are placed, and where. Without any the robot goes above what it sees.
    pub order: Vec<JigSlot>,
    /// Height that is assumed of what is seen and not known, mm: the gripper stays clear of it.
    pub unknown_height_mm: f64,
}

impl Default for JigConfig {
    fn default() -> Self {
        Self { order: Vec::new(), unknown_height_mm: 50.0 }
    }
}

/// `[supervision]`
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SupervisionConfig {
    /// Time without a sign of life from which on a part is taken for stuck, ms: longer than vision may take for a frame, and
    /// the robot controller to be connected anew.
    pub stuck_after_ms: u64,
}

impl Default for SupervisionConfig {
    fn default() -> Self {
        Self { stuck_after_ms: 60_000 }
    }
}

/// `[interest]`: the region of interest that the operator draws on the picture.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct InterestConfig {
    /// Where the region is kept, relative to the folder of the configuration; absolute once it was read. Without a value in the
    /// folder of the recordings.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub file: Option<PathBuf>,
}

/// `[http]`: the operator's page and its API, `GET /metrics` and `GET /healthz`. Without the section nothing is served.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct HttpConfig {
    /// Address and port; port 0 takes a free one, which the log tells. Whoever reaches it can look; what changes something needs
    /// the token.
    #[schemars(with = "String")]
    pub listen: SocketAddr,
    /// File with the operator's token, relative to the folder of the configuration; absolute once it was read. Without one a new
    /// token is made at every start, in a file beside the lock of the cell.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub token_file: Option<PathBuf>,
    /// Names by which this machine may be called, beside its addresses and `localhost`.
    pub hosts: Vec<String>,
}

impl Default for HttpConfig {
    fn default() -> Self {
        Self { listen: (Ipv4Addr::LOCALHOST, 9464).into(), token_file: None, hosts: Vec::new() }
    }
}

/// `[log]`
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LogConfig {
    /// `"error"`, `"warn"`, `"info"`, `"debug"` or `"trace"`; the environment variable `RUST_LOG` goes before it.
    pub level: Level,
}

/// From which gravity on messages are shown.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
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
    /// A folder lies where the file is expected.
    #[error("{} is a folder; a configuration is a file", path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
    },
    /// The file is no text.
    #[error("{} is no text in UTF-8", path.display())]
    NoText {
        /// The file.
        path: PathBuf,
    },
    /// The file has no section.
    #[error("{} is empty; a configuration has at least [cell] with the name of the cell", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
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
        key: Cow<'static, str>,
        /// The value given.
        value: String,
        /// What is allowed.
        allowed: String,
    },
    /// A value of `[cell]` or `[frames]` is out of range.
    #[error("{section} {0}", section = section_of(.0))]
    Frames(#[from] ServiceError),
    /// A value of `[segment]`, `[saliency]`, `[regions]`, `[shadow]` or `[recognize]` is out of range.
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
    /// The catalogue cannot be used.
    #[error("[catalogue] folder: {0}")]
    Catalogue(#[from] CatalogueError),
    /// The arm cannot be as it is described.
    #[error("[robot] {0}")]
    Arm(#[from] SimulatedConfigError),
    /// A value of `[robot.motoman]` is out of range.
    #[error("[robot.motoman] {0}")]
    Motoman(#[from] MotomanConfigError),
    /// The table of the simulated arm cannot be used.
    #[error("[robot.simulated] table: {0}")]
    Table(#[from] PartTableError),
    /// A line of the assembly list cannot be carried out.
    #[error("[jig] order: line {line} ({part}): {cause}")]
    Slot {
        /// Which, from 1.
        line: usize,
        /// The part it names.
        part: String,
        /// Why.
        cause: String,
    },
    /// Parts shall be placed, and nobody knows how they look.
    #[error("[jig] order names parts, but there is no [catalogue] folder to know them by")]
    JigWithoutCatalogue,
    /// A value of `[recording]` is out of range.
    #[error("[recording] {0}")]
    Recording(#[from] RecordError),
    /// The configuration cannot be written as TOML.
    #[error("cannot print the configuration: {0}")]
    Print(#[from] toml::ser::Error),
}

impl Config {
    /// Reads and checks a file, the camera file and the catalogue that it names.
    ///
    /// # Errors
    /// [`ConfigError`], with the file, the key, the value and what is allowed.
    pub fn read(path: &Path) -> Result<Self, ConfigError> {
        let config = Self::read_without_catalogue(path)?;
        let catalogue = config.read_catalogue()?;
        config.check_jig(catalogue.as_ref())?;
        Ok(config)
    }

    /// [`Self::read`] for those who do without the catalogue of the configuration, which may not be there yet.
    ///
    /// # Errors
    /// As [`Self::read`].
    pub fn read_without_catalogue(path: &Path) -> Result<Self, ConfigError> {
        let text = fs::read_to_string(path).map_err(|source| match source.kind() {
            io::ErrorKind::IsADirectory => ConfigError::Folder { path: path.to_owned() },
            io::ErrorKind::InvalidData => ConfigError::NoText { path: path.to_owned() },
            _ => ConfigError::Read { path: path.to_owned(), source },
        })?;
        let mut config = Self::from_toml(&text, path)?;
        // What a loss of power leaves of a file that was being written; the defaults are those of no cell.
        if text.lines().all(|line| line.trim().is_empty() || line.trim_start().starts_with('#')) {
            return Err(ConfigError::Empty { path: path.to_owned() });
        }
        let table = &mut config.robot.simulated.table;
        let (interest, token) = (&mut config.interest.file, config.http.as_mut().map(|http| &mut http.token_file));
        let files = [&mut config.camera.file, &mut config.catalogue.folder, table, interest].into_iter().chain(token);
        for file in files.flatten() {
            let beside = path.parent().unwrap_or(Path::new("")).join(&*file);
            // What is printed must mean the same from any folder.
            *file = std::path::absolute(&beside).unwrap_or(beside);
        }
        config.check()?;
        Ok(config)
    }

    /// The catalogue, if one is given. Reads its folder.
    ///
    /// # Errors
    /// The folder or a part in it cannot be used.
    pub fn read_catalogue(&self) -> Result<Option<Catalogue>, ConfigError> {
        Ok(self.catalogue.folder.as_deref().map(Catalogue::read).transpose()?)
    }

    /// Checks that every line of the assembly list names a part of the catalogue and a slot that can be reached.
    ///
    /// # Errors
    /// [`ConfigError::Slot`], [`ConfigError::JigWithoutCatalogue`].
    pub fn check_jig(&self, catalogue: Option<&Catalogue>) -> Result<(), ConfigError> {
        if self.jig.order.is_empty() {
            return Ok(());
        }
        let catalogue = catalogue.ok_or(ConfigError::JigWithoutCatalogue)?;
        let base_from_world = self.placer()?.and_then(|placer| placer.base_from_world());
        for (i, slot) in self.jig.order.iter().enumerate() {
            let fail = |cause: String| ConfigError::Slot { line: i + 1, part: slot.part.clone(), cause };
            let Some(part) = catalogue.part(&slot.part) else {
                let known: Vec<_> = catalogue.parts().iter().map(|part| part.name.as_str()).collect();
                return Err(fail(format!("the catalogue has no such part; it has {}", known.join(", "))));
            };
            let table_z_mm = base_from_world.map_or(f64::NEG_INFINITY, |base| base.translation.z);
            // Half a millimetre is what touching the table with the robot may be off.
            if slot.z_mm < table_z_mm - 0.5 {
                return Err(fail(format!("z_mm is {}, below the table, which lies at {table_z_mm:.1} mm", slot.z_mm)));
            }
            self.check_slot(slot, part.height_mm).map_err(|e| fail(e.to_string()))?;
        }
        Ok(())
    }

    /// Whether the tool can stand at a slot with a part in it, and above it.
    fn check_slot(&self, slot: &JigSlot, height_mm: f64) -> Result<(), MotionError> {
        let (arm, limits) = (self.robot.arm(), &self.robot.limits);
        let at = |height_mm| Pose::gripper_down(slot.x_mm, slot.y_mm, slot.z_mm + height_mm, slot.yaw_rad);
        let (above, release) = (at(self.robot.safe_height_mm), at(height_mm / 2.0));
        let joints = arm.joints_at(&above, &Joints([0.0; 6]))?;
        let speed = self.robot.linear_speed_mm_s;
        for (from, target) in [(&self.robot.home, above), (&above, release)] {
            let motion = samsod_robot::Motion::Linear { target, speed_mm_s: speed };
            limits.allow(from, &motion, None, std::time::Duration::ZERO)?;
        }
        arm.plan_line(&joints, &release, speed, speed)?;
        Ok(())
    }

    /// The vision chain, with the catalogue if one is given. Without a camera: that depends on the frames.
    ///
    /// # Errors
    /// A parameter out of range; a catalogue that cannot be used.
    pub fn make_cell(&self) -> Result<Cell, ConfigError> {
        Ok(match self.read_catalogue()? {
            Some(catalogue) => Cell::with_catalogue(self.vision(), catalogue)?,
            None => Cell::new(self.vision())?,
        })
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
        self.placer_of(file, CameraFile::read_camera(file)?).map(Some)
    }

    /// What places objects by the camera of a file.
    fn placer_of(&self, file: &Path, camera: Camera) -> Result<Placer, ConfigError> {
        let height_mm = self.camera.object_height_mm;
        let [width_px, height_px] = camera.intrinsics().size_px();
        let FramesConfig { max_width_px, max_height_px, .. } = self.frames;
        if width_px > max_width_px || height_px > max_height_px {
            let file = file.to_owned();
            return Err(ConfigError::CameraSize { file, width_px, height_px, max_width_px, max_height_px });
        }
        let placer = Placer::with_camera(camera, height_mm);
        placer.map_err(|cause| ConfigError::Plane { object_height_mm: height_mm, cause })
    }

    /// [`Self::placer`] with the text of the camera file, which need not be there any more.
    ///
    /// # Errors
    /// As [`Self::placer`].
    pub fn placer_with(&self, camera: &str) -> Result<Option<Placer>, ConfigError> {
        let Some(file) = &self.camera.file else { return self.placer() };
        let camera = CameraFile::from_toml(camera, file)?.camera().and_then(Result::ok);
        let camera = camera.ok_or_else(|| CameraFileError::NoWorld { path: file.clone() })?;
        self.placer_of(file, camera).map(Some)
    }

    /// The text of a configuration in force, as a recording holds it: neither values nor files are checked.
    ///
    /// # Errors
    /// [`ConfigError::Parse`]; `path` is the file that messages name.
    pub fn from_toml(text: &str, path: &Path) -> Result<Self, ConfigError> {
        let failed = |e: toml::de::Error| e.to_string().trim_end().to_owned();
        toml::from_str(text).map_err(|e| ConfigError::Parse { path: path.to_owned(), message: failed(e) })
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
        if self.http.is_none() {
            text += "# [http] listen: not set, neither the operator's page nor health nor metrics are served\n\n";
        }
        if self.foxglove.is_none() {
            text += "# [foxglove] listen: not set, there is no live view\n\n";
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
        let (segment, motoman) = (&self.segment, &self.robot.motoman);
        let optional = [
            (
                self.camera.file.is_none(),
                "[camera]",
                "file",
                if self.view.is_some() { "[view] takes its place" } else { "samsod calibrate writes one" },
            ),
            (
                self.catalogue.folder.is_none(),
                "[catalogue]",
                "folder",
                "objects are found, but not named; samsod teach makes one",
            ),
            (
                self.robot.simulated.table.is_none(),
                "[robot.simulated]",
                "table",
                "the gripper of the simulated arm closes on nothing that is told",
            ),
            (motoman.figure.is_none(), "[robot.motoman]", "figure", "that of the arm at the time"),
            (motoman.job.is_none(), "[robot.motoman]", "job", "needed with mode = \"job\""),
            (motoman.part_sensor.is_none(), "[robot.motoman]", "part_sensor", "nobody notices a pick that has missed"),
            (
                motoman.emergency_stop.is_none(),
                "[robot.motoman]",
                "emergency_stop",
                "an emergency stop shows as servo power off",
            ),
            (
                self.interest.file.is_none(),
                "[interest]",
                "file",
                "region-of-interest.toml in the folder of the recordings",
            ),
            (
                self.http.as_ref().is_some_and(|http| http.token_file.is_none()),
                "[http]",
                "token_file",
                "a new token at every start, in a file that the log names",
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

    /// Checks every value, and the camera file.
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
        within("[frames] stalled_after_ms", self.frames.stalled_after_ms as f64, 10.0, 86_400_000.0)?;
        within("[supervision] stuck_after_ms", self.supervision.stuck_after_ms as f64, 500.0, 3_600_000.0)?;
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
        within("[robot] linear_speed_mm_s", robot.linear_speed_mm_s, 0.1, robot.simulated.linear_speed_max_mm_s)?;
        within("[robot] grasp_height_mm", robot.grasp_height_mm, 0.0, 5000.0)?;
        // The robot moves freely at this height: it lies above what it grips and above the plane of the objects.
        let least_mm = robot.grasp_height_mm.max(self.camera.object_height_mm);
        within("[robot] safe_height_mm", robot.safe_height_mm, least_mm, 5000.0)?;
        within("[robot] motion_timeout_ms", robot.motion_timeout_ms as f64, 100.0, 600_000.0)?;
        within("[robot] gripper_timeout_ms", robot.gripper_timeout_ms as f64, 10.0, 60_000.0)?;
        within("[robot] poll_interval_ms", robot.poll_interval_ms as f64, 5.0, 100.0)?;
        within("[robot] clearance_mm", robot.clearance_mm, 0.0, 100.0)?;
        robot.gripper.check().map_err(|e| out_of_range("gripper", e))?;
        robot.limits.check().map_err(|e| out_of_range("limits", e))?;
        within("[robot.simulated] clock_rate", robot.simulated.clock_rate, 0.01, 1000.0)?;
        let tolerance = &robot.simulated.pick_tolerance;
        within("[robot.simulated] pick_tolerance.place_mm", tolerance.place_mm, 0.0, 100.0)?;
        within("[robot.simulated] pick_tolerance.yaw_deg", tolerance.yaw_rad.to_degrees(), 0.0, 90.0)?;
        robot.simulated_arm().check()?;
        robot.motoman.check()?;
        if let Some(table) = &robot.simulated.table {
            TableState::read(table)?;
        }
        within("[jig] unknown_height_mm", self.jig.unknown_height_mm, 0.0, 5000.0)?;
        Ok(self.recording.check()?)
    }

    /// Where the region of interest is kept.
    pub fn interest_file(&self) -> PathBuf {
        self.interest.file.clone().unwrap_or_else(|| self.recording.folder.join("region-of-interest.toml"))
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

fn out_of_range(section: &'static str, (key, value, allowed): (&'static str, f64, &'static str)) -> ConfigError {
    let key = match section {
        "gripper" => format!("[robot.gripper] {key}"),
        _ => format!("[robot.limits] {key}"),
    };
    ConfigError::Value { key: key.into(), value: value.to_string(), allowed: allowed.to_owned() }
}

fn within(key: &'static str, value: f64, min: f64, max: f64) -> Result<(), ConfigError> {
    // NaN is in no range.
    if (min..=max).contains(&value) {
        return Ok(());
    }
    Err(ConfigError::Value { key: key.into(), value: value.to_string(), allowed: format!("{min} to {max}") })
}

#[cfg(test)]
mod tests;
