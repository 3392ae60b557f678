//! A table with parts on it, as the gripper of a simulated robot meets them.
//!
//! Input: where the tool passes, where the gripper closes and opens. Output: whether a part is held, and a record of every
//! pick, miss and collision. The state can live in a file, which is replaced as a whole at every change, so that the
//! program that stands for the camera sees what was taken away.
//!
//! A pick fails as it would in life: when the gripper closes too far from the grasp of a part, turned too much against it,
//! above it, or when the part is wider than the open fingers. What is let go above every surface has been dropped.

use std::f64::consts::{FRAC_PI_2, PI, TAU};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use glam::DVec2;
use serde::{Deserialize, Serialize};

use crate::gripper_shape::yaw_rad;
use crate::{Convex, GripperShape, Pose, Workpieces};

/// Version of the file.
const VERSION: u32 = 1;
/// Greatest distance of a part from the base of the robot along an axis, mm.
const MAX_PLACE_MM: f64 = 100_000.0;
/// What is let go higher than this above every surface has been dropped, mm.
const DROP_MM: f64 = 5.0;

/// Where a part is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Whereabouts {
    /// Where it lay from the start.
    Table,
    /// Held by the gripper.
    Gripper,
    /// Where the robot has put it down.
    Jig,
    /// Let go in the air.
    Dropped,
}

/// A part on the table, in the base frame of the robot.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TablePart {
    /// What it is.
    pub name: String,
    /// Where it is.
    #[serde(rename = "where")]
    pub whereabouts: Whereabouts,
    /// Its origin, mm. Of a part in the gripper: where it was gripped.
    pub x_mm: f64,
    /// See `x_mm`.
    pub y_mm: f64,
    /// Height of what it lies on, mm.
    pub z_mm: f64,
    /// Its turn, counter-clockwise seen from above, rad.
    #[serde(rename = "yaw_deg", with = "crate::degrees")]
    pub yaw_rad: f64,
    /// Its height, mm.
    pub height_mm: f64,
    /// Its width where it is gripped, mm.
    pub grasp_width_mm: f64,
    /// Where it is gripped, from its origin, in its own axes, mm.
    pub grasp_offset_mm: [f64; 2],
    /// Direction of the gripper's x axis in the axes of the part, rad.
    #[serde(rename = "grasp_angle_deg", with = "crate::degrees")]
    pub grasp_angle_rad: f64,
    /// After this share of a turn it looks the same; 0 for a round part.
    pub symmetry_order: u32,
    /// Its outline seen from above in its own axes.
    pub outline_mm: Convex,
}

impl TablePart {
    /// Its outline where it lies.
    pub fn outline(&self) -> Convex {
        self.outline_mm.moved([self.x_mm, self.y_mm], self.yaw_rad)
    }

    /// Where it is gripped, where it lies: (x, y), mm.
    pub fn grasp_mm(&self) -> [f64; 2] {
        self.grasp().into()
    }

    fn grasp(&self) -> DVec2 {
        DVec2::new(self.x_mm, self.y_mm) + DVec2::from_angle(self.yaw_rad).rotate(self.grasp_offset_mm.into())
    }

    /// The nearest way to grip it with the gripper turned so: how far it is turned off that, rad, and the width there, mm.
    ///
    /// A gripper grips as well from behind, and from every side that looks the same; across its grasp a part is as wide as its
    /// outline.
    fn grip(&self, tool_yaw_rad: f64) -> (f64, f64) {
        let off = tool_yaw_rad - self.yaw_rad - self.grasp_angle_rad;
        let step = match self.symmetry_order {
            0 => return (0.0, self.grasp_width_mm),
            even if even % 2 == 0 => TAU / f64::from(even),
            odd => PI / f64::from(odd),
        };
        let along = (remainder(off, step).abs(), self.grasp_width_mm);
        let extent = self.outline_mm.extent_mm(self.grasp_angle_rad).unwrap_or_default();
        let across = (remainder(off + FRAC_PI_2, step).abs(), extent[1] - extent[0]);
        if across.0 < along.0 { across } else { along }
    }
}

/// `angle` less the nearest multiple of `step`.
fn remainder(angle: f64, step: f64) -> f64 {
    angle - (angle / step).round() * step
}

/// How far off a pick may be.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct PickTolerance {
    /// Distance of the tool from the grasp, mm.
    pub place_mm: f64,
    /// Turn of the tool against the grasp, rad.
    #[serde(rename = "yaw_deg", with = "crate::degrees")]
    #[cfg_attr(feature = "schema", schemars(with = "f64"))]
    pub yaw_rad: f64,
}

impl Default for PickTolerance {
    /// 3 mm and 6 degrees.
    fn default() -> Self {
        Self { place_mm: 3.0, yaw_rad: 6f64.to_radians() }
    }
}

/// The gripper has closed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PickRecord {
    /// The part whose grasp was nearest, if any lay on the table.
    pub part: Option<String>,
    /// Whether it is held.
    pub held: bool,
    /// Distance of the tool from the grasp, mm.
    pub error_mm: f64,
    /// Turn of the tool against the grasp, degrees.
    pub error_deg: f64,
}

/// Something met a part that it should not have met.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CollisionRecord {
    /// The part that was met.
    pub part: String,
    /// What met it.
    pub by: Collider,
    /// Where the tool was, `base_from_tool`.
    pub tool: Pose,
}

/// What can meet a part.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Collider {
    /// A finger of the gripper.
    Finger,
    /// The body of the gripper.
    Body,
    /// The part that the gripper holds.
    HeldPart,
}

/// The state of a table, as it stands in its file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TableState {
    /// Version of this format.
    pub version: u32,
    /// Every part, wherever it is.
    pub parts: Vec<TablePart>,
    /// Heights on which things can be put down, mm.
    #[serde(default = "ground")]
    pub surfaces_mm: Vec<f64>,
    /// Every time that the gripper has closed.
    #[serde(default)]
    pub picks: Vec<PickRecord>,
    /// Every collision.
    #[serde(default)]
    pub collisions: Vec<CollisionRecord>,
}

fn ground() -> Vec<f64> {
    vec![0.0]
}

impl TableState {
    /// A table with these parts, its surface at height 0.
    pub fn new(parts: Vec<TablePart>) -> Self {
        Self { version: VERSION, parts, surfaces_mm: ground(), picks: Vec::new(), collisions: Vec::new() }
    }

    /// Reads and checks a file.
    ///
    /// # Errors
    /// [`PartTableError`] names the file, the part and the value.
    pub fn read(path: &Path) -> Result<Self, PartTableError> {
        let bytes = std::fs::read(path)
            .map_err(|source| PartTableError::Read { path: path.to_owned(), cause: source.to_string() })?;
        Self::parse(path, &bytes)
    }

    /// Checks what was read from a file; `path` is for messages.
    ///
    /// # Errors
    /// As [`Self::read`].
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self, PartTableError> {
        let state: Self = serde_json::from_slice(bytes)
            .map_err(|e| PartTableError::Parse { path: path.to_owned(), cause: e.to_string() })?;
        state.check().map_err(|(part, what)| PartTableError::Value { path: path.to_owned(), part, what })?;
        Ok(state)
    }

    fn check(&self) -> Result<(), (String, String)> {
        if self.version != VERSION {
            return Err(("the file".to_owned(), format!("version is {}; this program knows {VERSION}", self.version)));
        }
        for part in &self.parts {
            let fail = |what: String| Err((format!("part {:?}", part.name), what));
            for (key, value) in [("x_mm", part.x_mm), ("y_mm", part.y_mm), ("z_mm", part.z_mm)] {
                // NaN is in no range.
                if !(-MAX_PLACE_MM..=MAX_PLACE_MM).contains(&value) {
                    return fail(format!("{key} is {value}; allowed: -{MAX_PLACE_MM} to {MAX_PLACE_MM}"));
                }
            }
            if !part.yaw_rad.is_finite() {
                return fail(format!("yaw_deg is {}; it must be a finite number", part.yaw_rad));
            }
            for (key, value) in [("height_mm", part.height_mm), ("grasp_width_mm", part.grasp_width_mm)] {
                if !(value.is_finite() && value > 0.0) {
                    return fail(format!("{key} is {value}; it must be above 0"));
                }
            }
            if part.outline_mm.corners_mm().len() < 3 {
                let n = part.outline_mm.corners_mm().len();
                return fail(format!("outline_mm has {n} corners; it must have at least 3"));
            }
        }
        Ok(())
    }

    /// Replaces a file as a whole: a reader sees the old state or the new one.
    ///
    /// # Errors
    /// [`PartTableError::Write`].
    pub fn write(&self, path: &Path) -> Result<(), PartTableError> {
        let fail = |cause: String| PartTableError::Write { path: path.to_owned(), cause };
        let text = serde_json::to_vec_pretty(self).map_err(|e| fail(e.to_string()))?;
        let mut name = path.file_name().ok_or_else(|| fail("it has no file name".to_owned()))?.to_owned();
        name.push(".new");
        let beside = path.with_file_name(name);
        std::fs::write(&beside, text).map_err(|e| fail(e.to_string()))?;
        std::fs::rename(&beside, path).map_err(|e| fail(e.to_string()))
    }
}

/// Why a table cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum PartTableError {
    /// The file cannot be read.
    #[error("cannot read the table {}: {cause}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        cause: String,
    },
    /// The file is no table.
    #[error("{} is no table of parts: {cause}", path.display())]
    Parse {
        /// The file.
        path: PathBuf,
        /// Where and what.
        cause: String,
    },
    /// A value is out of range.
    #[error("{}: {part}: {what}", path.display())]
    Value {
        /// The file.
        path: PathBuf,
        /// Which part.
        part: String,
        /// Key, value and what is allowed.
        what: String,
    },
    /// The file cannot be written.
    #[error("cannot write the table {}: {cause}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system said.
        cause: String,
    },
}

/// A table for a simulated gripper. Clones share it.
#[derive(Debug, Clone)]
pub struct PartTable {
    shared: Arc<Mutex<Inner>>,
}

#[derive(Debug)]
struct Inner {
    state: TableState,
    file: Option<PathBuf>,
    gripper: GripperShape,
    tolerance: PickTolerance,
    held: Option<Held>,
    /// Distance of the fingers, mm.
    opening_mm: f64,
    /// What the gripper touches at the moment: each collision is told once.
    touching: Vec<(usize, Collider)>,
    failure: Option<PartTableError>,
}

/// The part in the gripper, in the frame of the tool.
#[derive(Debug, Clone, Copy)]
struct Held {
    part: usize,
    offset: DVec2,
    yaw_rad: f64,
    /// Its lower side above the tool, mm.
    bottom_mm: f64,
}

impl PartTable {
    /// A table that lives in memory only.
    pub fn new(state: TableState, gripper: GripperShape, tolerance: PickTolerance) -> Self {
        Self::with_file(state, None, gripper, tolerance)
    }

    /// A table that lives in a file: read now, replaced at every change.
    ///
    /// # Errors
    /// [`PartTableError`]
    pub fn open(path: &Path, gripper: GripperShape, tolerance: PickTolerance) -> Result<Self, PartTableError> {
        let state = TableState::read(path)?;
        Ok(Self::with_file(state, Some(path.to_owned()), gripper, tolerance))
    }

    fn with_file(state: TableState, file: Option<PathBuf>, gripper: GripperShape, tolerance: PickTolerance) -> Self {
        let inner =
            Inner { state, file, gripper, tolerance, held: None, opening_mm: 0.0, touching: Vec::new(), failure: None };
        Self { shared: Arc::new(Mutex::new(inner)) }
    }

    /// The table as it is now.
    pub fn state(&self) -> TableState {
        self.lock().state.clone()
    }

    /// Why the file does not hold the present state, if so.
    pub fn failure(&self) -> Option<PartTableError> {
        self.lock().failure.clone()
    }

    /// A poisoned lock only says that another thread panicked; the state is valid after every statement.
    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.shared.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Inner {
    fn save(&mut self) {
        if let Some(file) = &self.file {
            self.failure = self.state.write(file).err();
        }
    }

    /// The part whose grasp is nearest: its index and distance.
    fn nearest(&self, tool: &Pose) -> Option<(usize, f64)> {
        let at = DVec2::new(tool.x_mm, tool.y_mm);
        let parts = self.state.parts.iter().enumerate();
        let lying = parts.filter(|(_, part)| matches!(part.whereabouts, Whereabouts::Table | Whereabouts::Jig));
        let distances = lying.map(|(i, part)| (i, part.grasp().distance(at)));
        distances.min_by(|a, b| a.1.total_cmp(&b.1))
    }

    fn collisions(&self, tool: &Pose) -> Vec<(usize, Collider)> {
        let held = self.held.as_ref();
        let mut found = Vec::new();
        for (i, part) in self.state.parts.iter().enumerate() {
            let lies = matches!(part.whereabouts, Whereabouts::Table | Whereabouts::Jig);
            let top = part.z_mm + part.height_mm;
            if !lies || held.is_some_and(|held| held.part == i) || tool.z_mm - 200.0 > top {
                continue;
            }
            let outline = part.outline();
            let meets = |other: &Convex| other.gap_mm(&outline) < 0.0;
            if tool.z_mm < top && self.gripper.fingers(tool, self.opening_mm).iter().any(meets) {
                found.push((i, Collider::Finger));
            }
            if tool.z_mm + self.gripper.finger_length_mm < top && meets(&self.gripper.body(tool)) {
                found.push((i, Collider::Body));
            }
            if let Some(held) = held
                && tool.z_mm + held.bottom_mm < top
                && let Some(own) = self.state.parts.get(held.part)
                && meets(&held.outline(&own.outline_mm, tool))
            {
                found.push((i, Collider::HeldPart));
            }
        }
        found
    }
}

impl Held {
    fn place(&self, tool: &Pose) -> (DVec2, f64) {
        let yaw = yaw_rad(tool);
        (DVec2::new(tool.x_mm, tool.y_mm) + DVec2::from_angle(yaw).rotate(self.offset), yaw + self.yaw_rad)
    }

    fn outline(&self, outline: &Convex, tool: &Pose) -> Convex {
        let (at, yaw) = self.place(tool);
        outline.moved(at.into(), yaw)
    }
}

impl Workpieces for PartTable {
    fn passes(&mut self, tool: &Pose) {
        let mut inner = self.lock();
        let touching = inner.collisions(tool);
        let before = std::mem::replace(&mut inner.touching, touching.clone());
        let new: Vec<_> = touching.into_iter().filter(|met| !before.contains(met)).collect();
        if new.is_empty() {
            return;
        }
        for (part, by) in new {
            let part = inner.state.parts[part].name.clone();
            inner.state.collisions.push(CollisionRecord { part, by, tool: *tool });
        }
        inner.save();
    }

    fn close(&mut self, tool: &Pose) -> bool {
        let mut inner = self.lock();
        let nearest = inner.nearest(tool);
        let mut record = PickRecord { part: None, held: false, error_mm: 0.0, error_deg: 0.0 };
        inner.opening_mm = 0.0;
        inner.held = None;
        if let Some((index, distance)) = nearest {
            let part = &inner.state.parts[index];
            let (yaw, height) = (yaw_rad(tool), tool.z_mm - part.z_mm);
            let (angle, width) = part.grip(yaw);
            record.part = Some(part.name.clone());
            (record.error_mm, record.error_deg) = (distance, angle.to_degrees());
            record.held = distance <= inner.tolerance.place_mm
                && angle <= inner.tolerance.yaw_rad
                && (0.0..=part.height_mm).contains(&height)
                && width <= inner.gripper.opening_mm;
            if record.held {
                let to_part = DVec2::new(part.x_mm - tool.x_mm, part.y_mm - tool.y_mm);
                let held = Held {
                    part: index,
                    offset: DVec2::from_angle(-yaw).rotate(to_part),
                    yaw_rad: part.yaw_rad - yaw,
                    bottom_mm: part.z_mm - tool.z_mm,
                };
                inner.held = Some(held);
                inner.opening_mm = width;
                inner.state.parts[index].whereabouts = Whereabouts::Gripper;
            }
        }
        let held = record.held;
        inner.state.picks.push(record);
        inner.save();
        held
    }

    fn open(&mut self, tool: &Pose) {
        let mut inner = self.lock();
        inner.opening_mm = inner.gripper.opening_mm;
        let Some(held) = inner.held.take() else { return };
        let (at, yaw_rad) = held.place(tool);
        let bottom = tool.z_mm + held.bottom_mm;
        let surface = inner.state.surfaces_mm.iter().copied().find(|z| (bottom - z).abs() <= DROP_MM);
        let Some(part) = inner.state.parts.get_mut(held.part) else { return };
        (part.x_mm, part.y_mm, part.yaw_rad) = (at.x, at.y, remainder(yaw_rad, TAU));
        part.z_mm = surface.unwrap_or(bottom);
        part.whereabouts = if surface.is_some() { Whereabouts::Jig } else { Whereabouts::Dropped };
        inner.save();
    }
}
