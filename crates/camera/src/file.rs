//! `camera.toml`: what `samsod calibrate` writes and everything else reads.
//!
//! ```toml
//! [intrinsics]                      # IntrinsicParams
//! [calibration]                     # optional: calibrated_at, images, mean_reprojection_error_px
//! [world]                           # optional: world_from_camera_mm, 4 rows of 4
//! [base]                            # optional: base_from_world_mm, points, rms_mm
//! ```

use std::fmt::Write as _;
use std::fs;
use std::io::Write as _;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use nalgebra::Isometry3;
use serde::Deserialize;

use crate::camera::Camera;
use crate::intrinsics::{IntrinsicParams, Intrinsics, IntrinsicsError};
use crate::pose::{PoseError, pose_from_rows, rows_from_pose};
use crate::projection::ProjectionError;

/// All that is known about a camera.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraFile {
    /// Focal lengths, principal point and lens.
    pub intrinsics: Intrinsics,
    /// How they were found.
    pub calibration: Option<CalibrationRecord>,
    /// Pose of the camera over the table, mm, once a board was seen lying on it.
    pub world_from_camera: Option<Isometry3<f64>>,
    /// Where the robot stands, once it has touched points of the table.
    pub base: Option<BaseRecord>,
}

/// How the intrinsics were found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CalibrationRecord {
    /// When, to the second.
    pub calibrated_at: SystemTime,
    /// Images in which the board was found.
    pub images: u32,
    /// Mean distance of the corners found from those computed, px.
    pub mean_reprojection_error_px: f64,
}

/// Where the robot stands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BaseRecord {
    /// Pose of the world in the base frame, mm.
    pub base_from_world: Isometry3<f64>,
    /// Points touched.
    pub points: u32,
    /// Root of the mean square distance that is left at them, mm.
    pub rms_mm: f64,
}

/// Why `camera.toml` was not read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CameraFileError {
    /// The file cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The file is no TOML, lacks a key, or has one that is not known.
    #[error("{}: {message}", path.display())]
    Parse {
        /// The file.
        path: PathBuf,
        /// Where and what.
        message: String,
    },
    /// A number of `[intrinsics]` is impossible.
    #[error("{}: [intrinsics] {source}", path.display())]
    Intrinsics {
        /// The file.
        path: PathBuf,
        /// Key, value and what is allowed.
        source: IntrinsicsError,
    },
    /// A matrix is no pose.
    #[error("{}: {key}: {source}", path.display())]
    Pose {
        /// The file.
        path: PathBuf,
        /// Section and key.
        key: &'static str,
        /// What is wrong with it.
        source: PoseError,
    },
    /// Another number is impossible.
    #[error("{}: {key} is {value}; allowed: {allowed}", path.display())]
    Value {
        /// The file.
        path: PathBuf,
        /// Section and key.
        key: &'static str,
        /// The value.
        value: String,
        /// What is allowed.
        allowed: &'static str,
    },
    /// The file has no pose of the camera.
    #[error(
        "{}: there is no [world]: photograph the board lying on the table, then run `samsod calibrate table IMAGE`",
        path.display()
    )]
    NoWorld {
        /// The file.
        path: PathBuf,
    },
    /// The file exists already.
    #[error("{} exists already and was not overwritten; --force does that", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// The file cannot be written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Sections {
    intrinsics: IntrinsicParams,
    calibration: Option<CalibrationSection>,
    world: Option<WorldSection>,
    base: Option<BaseSection>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CalibrationSection {
    calibrated_at: String,
    images: u32,
    mean_reprojection_error_px: f64,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct WorldSection {
    world_from_camera_mm: [[f64; 4]; 4],
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct BaseSection {
    base_from_world_mm: [[f64; 4]; 4],
    points: u32,
    rms_mm: f64,
}

impl CameraFile {
    /// Reads and checks a file.
    ///
    /// # Errors
    /// [`CameraFileError`]; every message begins with the file and names the key.
    pub fn read(path: &Path) -> Result<Self, CameraFileError> {
        let text = fs::read_to_string(path).map_err(|source| CameraFileError::Read { path: path.into(), source })?;
        Self::from_toml(&text, path)
    }

    /// Checks the text of a file, as it was kept elsewhere; `path` is the file that messages name.
    ///
    /// # Errors
    /// Those of [`Self::read`].
    pub fn from_toml(text: &str, path: &Path) -> Result<Self, CameraFileError> {
        let sections: Sections = toml::from_str(text)
            .map_err(|e| CameraFileError::Parse { path: path.into(), message: e.to_string().trim_end().to_owned() })?;
        let pose = |key, rows: &[[f64; 4]; 4]| {
            pose_from_rows(rows).map_err(|source| CameraFileError::Pose { path: path.into(), key, source })
        };
        let value = |key, value: String, allowed| CameraFileError::Value { path: path.into(), key, value, allowed };
        let length = |key, number: f64| {
            let possible = number.is_finite() && number >= 0.0;
            if possible { Ok(number) } else { Err(value(key, number.to_string(), "a finite number, 0 or more")) }
        };
        let calibration = sections.calibration.map(|section| {
            let error_px = section.mean_reprojection_error_px;
            Ok(CalibrationRecord {
                calibrated_at: humantime::parse_rfc3339_weak(&section.calibrated_at).map_err(|_| {
                    value("[calibration] calibrated_at", section.calibrated_at, "a time as \"2026-01-31T12:00:00Z\"")
                })?,
                images: section.images,
                mean_reprojection_error_px: length("[calibration] mean_reprojection_error_px", error_px)?,
            })
        });
        let base = sections.base.map(|section| {
            Ok(BaseRecord {
                base_from_world: pose("[base] base_from_world_mm", &section.base_from_world_mm)?,
                points: section.points,
                rms_mm: length("[base] rms_mm", section.rms_mm)?,
            })
        });
        Ok(Self {
            intrinsics: Intrinsics::new(sections.intrinsics)
                .map_err(|source| CameraFileError::Intrinsics { path: path.into(), source })?,
            calibration: calibration.transpose()?,
            world_from_camera: sections
                .world
                .map(|section| pose("[world] world_from_camera_mm", &section.world_from_camera_mm))
                .transpose()?,
            base: base.transpose()?,
        })
    }

    /// Reads a file of which the camera's pose over the table is needed.
    ///
    /// # Errors
    /// Those of [`Self::read`], and [`CameraFileError::NoWorld`].
    pub fn read_camera(path: &Path) -> Result<Camera, CameraFileError> {
        let file = Self::read(path)?;
        // Poses of a file are finite, so a camera is refused only for want of one.
        file.camera().and_then(Result::ok).ok_or_else(|| CameraFileError::NoWorld { path: path.into() })
    }

    /// The camera, if its pose over the table is known.
    pub fn camera(&self) -> Option<Result<Camera, ProjectionError>> {
        let base_from_world = self.base.as_ref().map(|base| base.base_from_world);
        self.world_from_camera.map(|world_from_camera| Camera::new(self.intrinsics, world_from_camera, base_from_world))
    }

    /// Writes the file as a whole or not at all: into a new file beside it, which then takes its name.
    ///
    /// # Errors
    /// [`CameraFileError::Exists`] unless it may be overwritten, [`CameraFileError::Write`].
    pub fn write(&self, path: &Path, overwrite: bool) -> Result<(), CameraFileError> {
        let failed = |source| CameraFileError::Write { path: path.into(), source };
        let folder = match path.parent() {
            Some(folder) if !folder.as_os_str().is_empty() => folder,
            _ => Path::new("."),
        };
        // Readable by all as far as the umask allows: by itself a temporary file is for its owner only.
        let permissions = fs::Permissions::from_mode(0o666);
        let mut file =
            tempfile::Builder::new().prefix(".camera-").permissions(permissions).tempfile_in(folder).map_err(failed)?;
        file.write_all(self.to_toml().as_bytes()).and_then(|()| file.as_file().sync_all()).map_err(failed)?;
        let done = if overwrite { file.persist(path) } else { file.persist_noclobber(path) };
        match done {
            Ok(_) => Ok(()),
            Err(e) if !overwrite && e.error.kind() == std::io::ErrorKind::AlreadyExists => {
                Err(CameraFileError::Exists { path: path.into() })
            }
            Err(e) => Err(failed(e.error)),
        }
    }

    /// The text of the file, with comments for people.
    pub fn to_toml(&self) -> String {
        let p = self.intrinsics.params();
        let mut text = format!(
            "# A camera of samsod, written by `samsod calibrate`. Lengths in mm, pixel centres at integers.\n\
             # Image: u right, v down. Camera: x right, y down, z forward. World: z = 0 is the table, z up.\n\
             # a_from_b maps coordinates of b to those of a. docs/camera.md says more.\n\n\
             [intrinsics]\n\
             width_px = {}\nheight_px = {}\nfx_px = {:?}\nfy_px = {:?}\ncx_px = {:?}\ncy_px = {:?}\n\
             # Lens: OpenCV's model, radial k1 k2 k3 and tangential p1 p2.\n\
             k1 = {:?}\nk2 = {:?}\np1 = {:?}\np2 = {:?}\nk3 = {:?}\n",
            p.width_px, p.height_px, p.fx_px, p.fy_px, p.cx_px, p.cy_px, p.k1, p.k2, p.p1, p.p2, p.k3
        );
        // Writing to a String does not fail.
        if let Some(record) = &self.calibration {
            let _ = write!(
                text,
                "\n[calibration]\ncalibrated_at = \"{}\"\nimages = {}\nmean_reprojection_error_px = {:.6}\n",
                humantime::format_rfc3339_seconds(record.calibrated_at),
                record.images,
                record.mean_reprojection_error_px
            );
        }
        if let Some(pose) = &self.world_from_camera {
            let _ = write!(text, "\n[world]\n# The last column is the place of the camera over the table.\n");
            matrix(&mut text, "world_from_camera_mm", pose);
        }
        if let Some(base) = &self.base {
            let _ =
                write!(text, "\n[base]\n# Where the origin of the table lies at the robot, and how it is turned.\n");
            matrix(&mut text, "base_from_world_mm", &base.base_from_world);
            let _ = writeln!(text, "points = {}\nrms_mm = {:.6}", base.points, base.rms_mm);
        }
        text
    }
}

fn matrix(text: &mut String, key: &str, pose: &Isometry3<f64>) {
    let _ = writeln!(text, "{key} = [");
    for row in rows_from_pose(pose) {
        let _ = writeln!(text, "    {row:?},");
    }
    let _ = writeln!(text, "]");
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::intrinsics::tests::PARAMS;
    use nalgebra::Vector3;
    use std::time::Duration;

    fn complete() -> CameraFile {
        let pose = Isometry3::new(Vector3::new(1.0, -2.5, 900.0), Vector3::new(3.1, 0.02, 0.1));
        CameraFile {
            intrinsics: Intrinsics::new(PARAMS).unwrap(),
            calibration: Some(CalibrationRecord {
                calibrated_at: SystemTime::UNIX_EPOCH + Duration::from_secs(1_800_000_000),
                images: 18,
                mean_reprojection_error_px: 0.0625,
            }),
            world_from_camera: Some(pose),
            base: Some(BaseRecord { base_from_world: pose.inverse(), points: 4, rms_mm: 0.25 }),
        }
    }

    fn read(text: &str) -> Result<CameraFile, CameraFileError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("camera.toml");
        fs::write(&path, text).unwrap();
        CameraFile::read(&path)
    }

    #[test]
    fn what_is_written_is_read_back() {
        let file = complete();
        let again = read(&file.to_toml()).unwrap();
        assert_eq!((again.intrinsics, again.calibration), (file.intrinsics, file.calibration));
        for (a, b) in [
            (again.world_from_camera, file.world_from_camera),
            (again.base.map(|b| b.base_from_world), file.base.map(|b| b.base_from_world)),
        ] {
            assert!((a.unwrap().to_homogeneous() - b.unwrap().to_homogeneous()).amax() < 1e-12);
        }
        // Only the intrinsics must be there.
        let bare = CameraFile { calibration: None, world_from_camera: None, base: None, ..file };
        assert_eq!(read(&bare.to_toml()).unwrap(), bare);
        assert!(bare.camera().is_none());
    }

    #[test]
    fn refusals_name_the_key_the_value_and_what_is_allowed() {
        let text = complete().to_toml();
        for (from, to, parts) in [
            ("fx_px = 1600.0", "fx_px = -3.0", vec!["[intrinsics] fx_px is -3; allowed: 1 to"]),
            ("fx_px = 1600.0\n", "", vec!["missing field `fx_px`"]),
            ("fx_px", "fx_mm", vec!["unknown field `fx_mm`", "`fx_px`"]),
            ("k1 = -0.118", "k1 = -90.0", vec!["[intrinsics] k1 = -90", "turns back on itself"]),
            ("k1 = -0.118", "k1 = nan", vec!["[intrinsics] k1 is NaN; allowed: a finite number"]),
            ("width_px = 1078", "width_px = 0", vec!["[intrinsics] width_px is 0; allowed: 2 to 16384"]),
            ("[world]", "[wrld]", vec!["unknown field `wrld`"]),
            (
                "[0.0, 0.0, 0.0, 1.0]",
                "[0.0, 0.0, 0.0, 2.0]",
                vec!["world_from_camera_mm: the last row is", "[0, 0, 0, 1]"],
            ),
            ("[0.0, 0.0, 0.0, 1.0]", "[0.0, 0.0, 1.0]", vec!["[0.0, 0.0, 1.0]", "expected an array of length 4"]),
            ("rms_mm = 0.25", "rms_mm = -0.25", vec!["[base] rms_mm is -0.25; allowed: a finite number, 0 or more"]),
            ("2027-01-15T08:00:00Z", "yesterday", vec!["[calibration] calibrated_at is yesterday; allowed: a time as"]),
        ] {
            let changed = text.replacen(from, to, 1);
            assert_ne!(changed, text, "{from}");
            let refusal = read(&changed).unwrap_err().to_string();
            for part in parts {
                assert!(refusal.contains("camera.toml") && refusal.contains(part), "{to}: {refusal}");
            }
        }
        let missing = CameraFile::read(Path::new("/no/such/camera.toml")).unwrap_err().to_string();
        assert!(missing.starts_with("cannot read /no/such/camera.toml: "), "{missing}");
    }

    #[test]
    fn a_file_is_written_whole_and_not_over_another() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("camera.toml");
        fs::write(&path, "mine").unwrap();
        let refusal = complete().write(&path, false).unwrap_err().to_string();
        assert!(
            refusal.ends_with("camera.toml exists already and was not overwritten; --force does that"),
            "{refusal}"
        );
        assert_eq!(fs::read_to_string(&path).unwrap(), "mine");
        complete().write(&path, true).unwrap();
        let camera = CameraFile::read_camera(&path).unwrap();
        assert!(camera.base_from_world().is_some());
        let bare = CameraFile { world_from_camera: None, base: None, ..complete() };
        bare.write(&path, true).unwrap();
        assert!(CameraFile::read_camera(&path).unwrap_err().to_string().contains("samsod calibrate table"));
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "no temporary file is left");
        assert!(complete().write(&folder.path().join("no/camera.toml"), false).is_err());
    }
}
