//! `samsod calibrate touch`: where the robot stands, from points of the table that its tool has touched.

use std::fmt::Write as _;
use std::fs;
use std::path::PathBuf;

use clap::Args;
use samsod_camera::calibrate::Board;
use samsod_camera::{BaseRecord, CameraFile, RigidFitError, fit_rigid};
use serde::Deserialize;

use super::{CalibrateCommandError, Pattern, must_be_allowed, thickness};

/// What `help` says after the options.
const POINTS_HELP: &str = "\
POINTS.toml has a section for each point: where it lies in the world, mm, or which corner of the board it is while the
board still lies as in the image that set the world; and where the robot says that its tool is.

  [[point]]
  corner = 0                      # or: world_mm = [0.0, 0.0, 0.0]
  base_mm = [412.3, -85.0, 12.1]";

/// Tell where the robot stands from three or more points of the table that it has touched.
#[derive(Debug, Args)]
#[command(after_help = POINTS_HELP)]
pub struct TouchArguments {
    /// The points.
    points: PathBuf,
    /// The camera file, which gets the pose of the world at the robot.
    #[arg(long, value_name = "FILE", default_value = "camera.toml")]
    camera: PathBuf,
    /// Inner corners of the board, as 9x6; needed if a point is a corner.
    #[arg(long, value_name = "COLUMNSxROWS", requires = "square_mm")]
    pattern: Option<Pattern>,
    /// Side of a square of the board, mm.
    #[arg(long, value_name = "MM", requires = "pattern")]
    square_mm: Option<f64>,
    /// How far the printed side of the board lies over the table, mm.
    #[arg(long, value_name = "MM", default_value_t = 0.0)]
    board_thickness_mm: f64,
    /// Largest root mean square distance at the points that is accepted, mm.
    #[arg(long, value_name = "MM", default_value_t = 2.0)]
    max_rms_mm: f64,
    /// Replace a pose that the file has.
    #[arg(long)]
    force: bool,
}

/// Why points do not tell where the robot stands.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TouchError {
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
        /// Where and what.
        message: String,
    },
    /// A point is incomplete or impossible.
    #[error("{}: point {index}: {reason}", path.display())]
    Point {
        /// The file.
        path: PathBuf,
        /// Which point, from 0.
        index: usize,
        /// What is wrong.
        reason: String,
    },
    /// The points have no solution.
    #[error("{}: {source}", path.display())]
    Fit {
        /// The file.
        path: PathBuf,
        /// Why not.
        source: RigidFitError,
    },
    /// The points do not fit.
    #[error(
        "the points fit to {rms_mm:.2} mm rms only; allowed: {allowed_mm} mm (--max-rms-mm). Left at each point, mm: \
         {residuals_mm}"
    )]
    Poor {
        /// Root of the mean square distance, mm.
        rms_mm: f64,
        /// What is allowed, mm.
        allowed_mm: f64,
        /// Distance at each point.
        residuals_mm: String,
    },
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Points {
    point: Vec<Touched>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Touched {
    world_mm: Option<[f64; 3]>,
    corner: Option<u32>,
    base_mm: [f64; 3],
}

pub(super) fn run(arguments: &TouchArguments) -> Result<String, CalibrateCommandError> {
    let path = &arguments.points;
    let thickness_mm = thickness(arguments.board_thickness_mm)?;
    must_be_allowed("--max-rms-mm", arguments.max_rms_mm, 0.0, 100.0)?;
    let mut file = CameraFile::read(&arguments.camera)?;
    if file.base.is_some() && !arguments.force {
        return Err(CalibrateCommandError::HasPose { path: arguments.camera.clone(), section: "[base]" });
    }
    if file.world_from_camera.is_none() {
        return Err(samsod_camera::CameraFileError::NoWorld { path: arguments.camera.clone() }.into());
    }
    let board = match (arguments.pattern, arguments.square_mm) {
        (Some(pattern), Some(square_mm)) => Some(Board::new(pattern.columns, pattern.rows, square_mm, None)?),
        _ => None,
    };
    let text = fs::read_to_string(path).map_err(|source| TouchError::Read { path: path.clone(), source })?;
    let points: Points = toml::from_str(&text)
        .map_err(|e| TouchError::Parse { path: path.clone(), message: e.to_string().trim_end().to_owned() })?;
    let (mut world_mm, mut base_mm) = (Vec::new(), Vec::new());
    for (index, point) in points.point.iter().enumerate() {
        let place = place(point, board.as_ref(), thickness_mm);
        world_mm.push(place.map_err(|reason| TouchError::Point { path: path.clone(), index, reason })?);
        base_mm.push(point.base_mm);
    }
    let fit = fit_rigid(&world_mm, &base_mm).map_err(|source| TouchError::Fit { path: path.clone(), source })?;
    if fit.rms_mm > arguments.max_rms_mm {
        let residuals: Vec<String> = fit.residuals_mm.iter().map(|r| format!("{r:.2}")).collect();
        let (rms_mm, allowed_mm, residuals_mm) = (fit.rms_mm, arguments.max_rms_mm, residuals.join(", "));
        return Err(TouchError::Poor { rms_mm, allowed_mm, residuals_mm }.into());
    }
    let mut out = format!("{:>5} {:>28} {:>28} {:>8}\n", "point", "world mm", "base mm", "left mm");
    let triple = |[x, y, z]: [f64; 3]| format!("({x:.1}, {y:.1}, {z:.1})");
    for (index, ((world, base), residual)) in world_mm.iter().zip(&base_mm).zip(&fit.residuals_mm).enumerate() {
        let _ = writeln!(out, "{index:>5} {:>28} {:>28} {residual:>8.3}", triple(*world), triple(*base));
    }
    let at = fit.second_from_first.translation.vector;
    let (roll, pitch, yaw) = fit.second_from_first.rotation.euler_angles();
    let [roll, pitch, yaw] = [roll, pitch, yaw].map(f64::to_degrees);
    let _ = writeln!(
        out,
        "rms        {:.3} mm\nworld      at ({:.2}, {:.2}, {:.2}) mm of the base, turned by {yaw:.3} deg, tilted by {roll:.3} \
         and {pitch:.3} deg",
        fit.rms_mm, at.x, at.y, at.z
    );
    if world_mm.len() == samsod_camera::LEAST_POINTS {
        out += "three points leave little to check; a fourth, far from them, shows a slip\n";
    }
    file.base =
        Some(BaseRecord { base_from_world: fit.second_from_first, points: world_mm.len() as u32, rms_mm: fit.rms_mm });
    file.write(&arguments.camera, true)?;
    let _ = writeln!(out, "written    {}", arguments.camera.display());
    Ok(out)
}

/// Where a point lies in the world, mm.
fn place(point: &Touched, board: Option<&Board>, thickness_mm: f64) -> Result<[f64; 3], String> {
    match (point.world_mm, point.corner) {
        (Some(world_mm), None) => Ok(world_mm),
        (None, Some(corner)) => {
            let board = board.ok_or("a corner needs --pattern and --square-mm")?;
            let [x, y] = board.corner_mm(corner).ok_or_else(|| {
                format!("corner is {corner}; allowed: 0 to {}, as the board has", board.corners() - 1)
            })?;
            Ok([x, y, thickness_mm])
        }
        _ => Err("either world_mm or corner must be given".to_owned()),
    }
}
