//! `table.json`: what lies on the simulated table.
//!
//! The simulated robot reads it at its start and replaces it, whole, at every pick and place. The twin reads it before each
//! frame; keys that are not its own it passes over, and does not write.
//!
//! ```text
//! {"version": 1,
//!  "parts": [{"name": "hex_nut", "where": "table", "x_mm": 512.3, "y_mm": -40.1, "z_mm": 0.0, "yaw_deg": 31.0,
//!             "height_mm": 11.0, "grasp_width_mm": 21.0, "grasp_offset_mm": [0.0, 0.0], "grasp_angle_deg": 0.0,
//!             "symmetry_order": 6, "outline_mm": [[12.1, 0.0], [6.1, 10.5], ..]}, ..]}
//! ```

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

/// The only version there is.
const VERSION: u32 = 1;
/// Greatest distance of a part from the base of the robot along an axis, mm.
const MAX_COORDINATE_MM: f64 = 100_000.0;

/// Why a table file cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TableFileError {
    /// It cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// It is no JSON, breaks off, lacks a key or has one of another type.
    #[error("{}: {source}", path.display())]
    Parse {
        /// The file.
        path: PathBuf,
        /// Where and what.
        source: serde_json::Error,
    },
    /// It is of another version.
    #[error("{}: version is {version}; allowed: {VERSION}", path.display())]
    Version {
        /// The file.
        path: PathBuf,
        /// The version given.
        version: u32,
    },
    /// A part lies nowhere near the robot.
    #[error(
        "{}: {key} of part {index} ({name}) is {value}; allowed: -{MAX_COORDINATE_MM} to {MAX_COORDINATE_MM}",
        path.display()
    )]
    Value {
        /// The file.
        path: PathBuf,
        /// Index of the part.
        index: usize,
        /// Name of the part.
        name: String,
        /// The key.
        key: &'static str,
        /// The value given.
        value: f64,
    },
    /// It cannot be written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
}

/// Where a part is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Whereabouts {
    /// On the table, not yet taken.
    Table,
    /// Held by the robot.
    Gripper,
    /// Laid down where parts belong.
    Jig,
    /// Lost on the way, out of view.
    Dropped,
}

impl Whereabouts {
    /// Whether a camera over the table may see the part.
    pub fn is_drawn(self) -> bool {
        matches!(self, Self::Table | Self::Jig)
    }
}

/// A part of the table.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TablePart {
    /// Its name in the catalogue.
    pub name: String,
    /// Where it is.
    #[serde(rename = "where")]
    pub whereabouts: Whereabouts,
    /// Its origin in the base frame of the robot, mm.
    pub x_mm: f64,
    /// As `x_mm`.
    pub y_mm: f64,
    /// As `x_mm`.
    pub z_mm: f64,
    /// About the z axis of the base, counter-clockwise seen from above, degrees.
    pub yaw_deg: f64,
    /// Height over what it lies on, mm.
    pub height_mm: f64,
    /// Opening of the gripper at the part, mm.
    pub grasp_width_mm: f64,
    /// Where the gripper closes, from the origin, in the axes of the part, mm.
    pub grasp_offset_mm: [f64; 2],
    /// Direction of the gripper's x axis in the axes of the part, degrees.
    pub grasp_angle_deg: f64,
    /// A turn by 360 / n degrees gives the same outline; 0: any turn does.
    pub symmetry_order: u32,
    /// Convex hull of the part from above, in its axes, counter-clockwise, mm.
    pub outline_mm: Vec<[f64; 2]>,
}

/// What lies on the table.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct TableFile {
    version: u32,
    /// The parts, those that were taken too.
    pub parts: Vec<TablePart>,
}

impl TableFile {
    /// A table of parts.
    pub fn new(parts: Vec<TablePart>) -> Self {
        Self { version: VERSION, parts }
    }

    /// Reads and checks a file.
    ///
    /// # Errors
    /// [`TableFileError`], with the file, the value and what is allowed.
    pub fn read(path: &Path) -> Result<Self, TableFileError> {
        Self::parse(path, &read_bytes(path)?)
    }

    /// Checks what was read from a file.
    ///
    /// # Errors
    /// As [`Self::read`].
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self, TableFileError> {
        let path = || path.to_owned();
        let table: Self =
            serde_json::from_slice(bytes).map_err(|source| TableFileError::Parse { path: path(), source })?;
        if table.version != VERSION {
            return Err(TableFileError::Version { path: path(), version: table.version });
        }
        for (index, part) in table.parts.iter().enumerate() {
            let values = [("x_mm", part.x_mm), ("y_mm", part.y_mm), ("z_mm", part.z_mm), ("yaw_deg", part.yaw_deg)];
            for (key, value) in values {
                // NaN is in no range.
                if !(-MAX_COORDINATE_MM..=MAX_COORDINATE_MM).contains(&value) {
                    let name = part.name.clone();
                    return Err(TableFileError::Value { path: path(), index, name, key, value });
                }
            }
        }
        Ok(table)
    }

    /// Writes a file, whole or not at all: beside its place, then renamed. A file of that name is replaced.
    ///
    /// # Errors
    /// [`TableFileError::Write`].
    pub fn write(&self, path: &Path) -> Result<(), TableFileError> {
        let error = |source| TableFileError::Write { path: path.to_owned(), source };
        let text = self.to_json().map_err(|e| error(e.into()))?;
        let mut name = path.file_name().unwrap_or_default().to_owned();
        name.push(format!(".{}.tmp", std::process::id()));
        let beside = path.with_file_name(name);
        let written = fs::File::create(&beside)
            .and_then(|mut file| file.write_all(text.as_bytes()).and_then(|()| file.sync_all()))
            .and_then(|()| fs::rename(&beside, path));
        if written.is_err() {
            // The first failure is the one to tell.
            let _ = fs::remove_file(&beside);
        }
        written.map_err(error)
    }

    /// One line a part.
    fn to_json(&self) -> Result<String, serde_json::Error> {
        let parts: Vec<String> = self.parts.iter().map(serde_json::to_string).collect::<Result<_, _>>()?;
        Ok(format!("{{\"version\": {VERSION},\n \"parts\": [\n  {}\n ]}}\n", parts.join(",\n  ")))
    }
}

/// The bytes of a file. One that is replaced meanwhile is read to its end as it was.
pub(super) fn read_bytes(path: &Path) -> Result<Vec<u8>, TableFileError> {
    fs::read(path).map_err(|source| TableFileError::Read { path: path.to_owned(), source })
}
