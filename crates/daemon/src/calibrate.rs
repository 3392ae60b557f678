//! `samsod calibrate`: from pictures of a board to `camera.toml`.
//!
//! In: a folder of images of a board. Out: the camera file, a picture of the residuals, and a table for people. `table`
//! places the camera over the table from one image, `touch` the robot from points it has touched, `verify` measures how
//! well a camera does on a board that was laid elsewhere.

mod touch;

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::SystemTime;

use clap::{ArgMatches, Args, Command, FromArgMatches, Subcommand};
use image::{ImageFormat, RgbImage};
use samsod_camera::calibrate::{self as solver, Board, CalibrateError, Calibration, Markers, View};
use samsod_camera::nalgebra::{Isometry3, Vector3};
use samsod_camera::{CalibrationRecord, CameraFile, CameraFileError, Intrinsics};

pub use touch::{TouchArguments, TouchError};

/// What `samsod calibrate` is told: a folder to calibrate from, or one of its subcommands.
#[derive(Debug)]
pub struct CalibrateArguments(Action);

#[derive(Debug)]
enum Action {
    Solve(SolveArguments),
    Other(CalibrateCommand),
}

// By hand: what is derived cannot say "either these arguments or a subcommand" without making each of them optional.
impl Args for CalibrateArguments {
    fn augment_args(command: Command) -> Command {
        let command = CalibrateCommand::augment_subcommands(SolveArguments::augment_args(command));
        command
            .subcommand_required(false)
            .subcommand_negates_reqs(true)
            .args_conflicts_with_subcommands(true)
            .arg_required_else_help(true)
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

impl FromArgMatches for CalibrateArguments {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        Ok(Self(match matches.subcommand_name() {
            Some(_) => Action::Other(CalibrateCommand::from_arg_matches(matches)?),
            None => Action::Solve(SolveArguments::from_arg_matches(matches)?),
        }))
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

#[derive(Debug, Subcommand)]
enum CalibrateCommand {
    /// Measure, in mm, how well a camera does on a board laid flat anywhere on the table.
    Verify(VerifyArguments),
    /// Place a calibrated camera over the table from one image of a board that lies on it.
    Table(TableArguments),
    Touch(TouchArguments),
}

/// Find the lens and the place of a camera from pictures of a chessboard.
///
/// Photograph a flat board ten to twenty times with the camera as it hangs: in all parts of the image up to the corners,
/// most of the pictures tilted by 20 to 40 degrees. Then once lying flat on the table (--table): that sets the world, with
/// its origin in corner 0 of the board. The printed side is up, and the picture of --corners shows which corner is which.
#[derive(Debug, Args)]
struct SolveArguments {
    /// Folder of PNG and JPEG images of the board; one without it is left out with a note.
    dir: PathBuf,
    #[command(flatten)]
    board: BoardArguments,
    /// Image of the board lying flat on the table, printed side up; it sets the world.
    #[arg(long, value_name = "IMAGE")]
    table: Option<PathBuf>,
    /// How far the printed side lies over the table, mm.
    #[arg(long, value_name = "MM", default_value_t = 0.0, requires = "table")]
    board_thickness_mm: f64,
    /// Images that do not take part and on which the result is tested.
    #[arg(long, value_name = "IMAGE", num_args = 1..)]
    hold_out: Vec<PathBuf>,
    /// The camera file that is written.
    #[arg(long, value_name = "FILE", default_value = "camera.toml")]
    out: PathBuf,
    /// Picture of what is left at every corner.
    #[arg(long, value_name = "PNG", default_value = "residuals.png")]
    residuals: PathBuf,
    /// Picture of the image of --table with the numbers of the corners and the axes of the world.
    #[arg(long, value_name = "PNG", requires = "table")]
    corners: Option<PathBuf>,
    /// Overwrite files that exist.
    #[arg(long)]
    force: bool,
}

#[derive(Debug, Args)]
struct VerifyArguments {
    /// Image of the board lying flat on the table.
    image: PathBuf,
    /// The camera file.
    #[arg(long, value_name = "FILE", default_value = "camera.toml")]
    camera: PathBuf,
    #[command(flatten)]
    board: BoardArguments,
    /// How far the printed side lies over the table, mm.
    #[arg(long, value_name = "MM", default_value_t = 0.0)]
    board_thickness_mm: f64,
}

#[derive(Debug, Args)]
struct TableArguments {
    /// Image of the board lying flat on the table, printed side up.
    image: PathBuf,
    /// The camera file, which gets the pose.
    #[arg(long, value_name = "FILE", default_value = "camera.toml")]
    camera: PathBuf,
    #[command(flatten)]
    board: BoardArguments,
    /// How far the printed side lies over the table, mm.
    #[arg(long, value_name = "MM", default_value_t = 0.0)]
    board_thickness_mm: f64,
    /// Picture of the image with the numbers of the corners and the axes of the world.
    #[arg(long, value_name = "PNG")]
    corners: Option<PathBuf>,
    /// Replace a pose that the file has, and a picture that exists.
    #[arg(long)]
    force: bool,
}

/// Which board was photographed.
#[derive(Debug, Args)]
struct BoardArguments {
    /// Inner corners in a row and rows of them: one less than the squares. One odd and one even tell the ends apart.
    #[arg(long, value_name = "COLUMNSxROWS")]
    pattern: Pattern,
    /// Side of a square, mm, measured on the print.
    #[arg(long, value_name = "MM")]
    square_mm: f64,
    /// The white squares hold markers (ChArUco, drawn by OpenCV 4.6 or newer).
    #[arg(long, requires_all = ["marker_mm", "dictionary"])]
    charuco: bool,
    /// Side of a marker, mm.
    #[arg(long, value_name = "MM", requires = "charuco")]
    marker_mm: Option<f64>,
    /// Which markers: 4x4_50, 5x5_100, .., apriltag_36h11.
    #[arg(long, value_name = "NAME", requires = "charuco")]
    dictionary: Option<String>,
}

/// Inner corners of a board, as `9x6`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Pattern {
    columns: u32,
    rows: u32,
}

impl FromStr for Pattern {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let sides = text.split_once(['x', 'X']).map(|(columns, rows)| (columns.parse(), rows.parse()));
        match sides {
            Some((Ok(columns), Ok(rows))) => Ok(Self { columns, rows }),
            _ => Err("two numbers of inner corners are needed, as 9x6".to_owned()),
        }
    }
}

impl BoardArguments {
    fn board(&self) -> Result<Board, CalibrateError> {
        let markers = match (self.marker_mm, &self.dictionary) {
            (Some(marker_mm), Some(name)) => Some(Markers { marker_mm, dictionary: name.parse()? }),
            _ => None,
        };
        Board::new(self.pattern.columns, self.pattern.rows, self.square_mm, markers)
    }
}

/// Why a camera was not calibrated.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CalibrateCommandError {
    /// The board was not found, or the solution is none.
    #[error(transparent)]
    Calibrate(#[from] CalibrateError),
    /// The camera file.
    #[error(transparent)]
    File(#[from] CameraFileError),
    /// The points that were touched.
    #[error(transparent)]
    Touch(#[from] TouchError),
    /// Too few images show the board.
    #[error("{source}; not used:\n{}", skipped.join("\n"))]
    TooFewViews {
        /// How many there are and are needed.
        source: CalibrateError,
        /// Each image that was not used, and why.
        skipped: Vec<String>,
    },
    /// A number on the command line is impossible.
    #[error("{option} is {value}; allowed: {allowed}")]
    Option {
        /// The option.
        option: &'static str,
        /// Its value.
        value: f64,
        /// What is allowed.
        allowed: String,
    },
    /// A pose is there already.
    #[error("{} has a pose in {section} already; --force replaces it", path.display())]
    HasPose {
        /// The camera file.
        path: PathBuf,
        /// `"[world]"` or `"[base]"`.
        section: &'static str,
    },
    /// A picture cannot be written.
    #[error("cannot write {}: {cause}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system said.
        cause: String,
    },
}

/// Does what the arguments say. Returns what is to be printed.
///
/// # Errors
/// [`CalibrateCommandError`]; a camera file that existed has not been changed then.
pub fn run(arguments: &CalibrateArguments) -> Result<String, CalibrateCommandError> {
    match &arguments.0 {
        Action::Solve(arguments) => solve(arguments),
        Action::Other(CalibrateCommand::Verify(arguments)) => verify(arguments),
        Action::Other(CalibrateCommand::Table(arguments)) => table(arguments),
        Action::Other(CalibrateCommand::Touch(arguments)) => touch::run(arguments),
    }
}

fn solve(arguments: &SolveArguments) -> Result<String, CalibrateCommandError> {
    let board = arguments.board.board()?;
    let thickness_mm = thickness(arguments.board_thickness_mm)?;
    let outputs = [Some(&arguments.out), Some(&arguments.residuals), arguments.corners.as_ref()];
    for path in outputs.into_iter().flatten() {
        must_be_free(path, arguments.force)?;
    }
    let mut files = solver::image_files(&arguments.dir)?;
    let held_out: Vec<PathBuf> = arguments.hold_out.iter().map(|path| canonical(path)).collect();
    files.retain(|file| !held_out.contains(&canonical(file)));

    let (mut views, mut skipped) = (Vec::new(), Vec::new());
    for found in solver::find_views(&files, &board) {
        match found {
            Ok(view) => views.push(view),
            Err(error) => skipped.push(error.to_string()),
        }
    }
    let solution = match solver::calibrate(&views, &board) {
        Err(source @ CalibrateError::TooFewViews { .. }) if !skipped.is_empty() => {
            return Err(CalibrateCommandError::TooFewViews { source, skipped });
        }
        other => other?,
    };
    let mut text = String::new();
    for reason in &skipped {
        text += &format!("left out: {reason}\n");
    }
    text += &image_table(&views, &solution);
    text += &numbers(&solution);

    let intrinsics = &solution.intrinsics;
    for path in &arguments.hold_out {
        let view = solver::find_view(path, &board)?;
        let (pose, check) = solver::check_on_board(intrinsics, &view, &board)?;
        let _ = writeln!(
            text,
            "held out   {}: mean {:.3} px, max {:.3} px; corners on the board to {:.3} mm, max {:.3} mm",
            path.display(),
            pose.mean_error_px,
            pose.max_error_px,
            check.position_mm.mean,
            check.position_mm.max
        );
    }
    let record = CalibrationRecord {
        calibrated_at: SystemTime::now(),
        images: views.len() as u32,
        mean_reprojection_error_px: solution.mean_error_px,
    };
    let mut file =
        CameraFile { intrinsics: *intrinsics, calibration: Some(record), world_from_camera: None, base: None };
    if let Some(path) = &arguments.table {
        let (pose, line) = place(intrinsics, path, &board, thickness_mm, arguments.corners.as_deref())?;
        file.world_from_camera = Some(pose);
        text += &line;
    }
    let residuals = solver::residual_picture(&views, &solution)?;
    // The camera first: where it cannot be written, no picture stands in the way of the next attempt.
    file.write(&arguments.out, arguments.force)?;
    save(&arguments.residuals, &residuals)?;
    for path in outputs.into_iter().flatten() {
        let _ = writeln!(text, "written    {}", path.display());
    }
    text += &if arguments.table.is_none() {
        format!(
            "There is no pose over the table yet. Photograph the board lying on it, then run\n  samsod calibrate table \
             IMAGE --camera {} --pattern .. --square-mm ..\n",
            arguments.out.display()
        )
    } else {
        next_touch(&arguments.out)
    };
    Ok(text)
}

fn table(arguments: &TableArguments) -> Result<String, CalibrateCommandError> {
    let board = arguments.board.board()?;
    let thickness_mm = thickness(arguments.board_thickness_mm)?;
    let mut file = CameraFile::read(&arguments.camera)?;
    if file.world_from_camera.is_some() && !arguments.force {
        return Err(CalibrateCommandError::HasPose { path: arguments.camera.clone(), section: "[world]" });
    }
    if let Some(path) = &arguments.corners {
        must_be_free(path, arguments.force)?;
    }
    let (pose, mut text) =
        place(&file.intrinsics, &arguments.image, &board, thickness_mm, arguments.corners.as_deref())?;
    file.world_from_camera = Some(pose);
    if file.base.take().is_some() {
        text += "the robot's place was that of the world before; it is removed\n";
    }
    file.write(&arguments.camera, true)?;
    for path in [Some(&arguments.camera), arguments.corners.as_ref()].into_iter().flatten() {
        let _ = writeln!(text, "written    {}", path.display());
    }
    Ok(text + &next_touch(&arguments.camera))
}

fn verify(arguments: &VerifyArguments) -> Result<String, CalibrateCommandError> {
    let board = arguments.board.board()?;
    let thickness_mm = thickness(arguments.board_thickness_mm)?;
    let camera = CameraFile::read_camera(&arguments.camera)?;
    let view = solver::find_view(&arguments.image, &board)?;
    let check = solver::check_on_table(&camera, &view, &board, thickness_mm)?;
    let mut text = format!("{:<24} {:>9} {:>9} {:>9}\n", "", "mean", "rms", "max");
    for (name, unit, spread) in [
        ("positions on the plane", "mm", &check.position_mm),
        ("distances on the plane", "mm", &check.distance_mm),
        ("reprojection", "px", &check.reprojection_px),
    ] {
        let _ = writeln!(text, "{name:<24} {:>9.3} {:>9.3} {:>9.3} {unit}", spread.mean, spread.rms, spread.max);
    }
    let centre =
        [0, 1].map(|i| [board.columns() - 1, board.rows() - 1][i]).map(|n| f64::from(n) * board.square_mm() / 2.0);
    let middle = check.world_from_board * samsod_camera::nalgebra::Point3::new(centre[0], centre[1], 0.0);
    let _ = writeln!(
        text,
        "lengths come out {:+.3} % long; {} corners; by itself the image puts the board at ({:.1}, {:.1}, {:.1}) mm, tilted \
         by {:.2} deg",
        check.scale_error * 100.0,
        view.corners.len(),
        middle.x,
        middle.y,
        middle.z,
        check.tilt_rad().to_degrees()
    );
    Ok(text)
}

/// The pose of the camera over the table, and a line about it.
fn place(
    intrinsics: &Intrinsics,
    path: &Path,
    board: &Board,
    thickness_mm: f64,
    corners: Option<&Path>,
) -> Result<(Isometry3<f64>, String), CalibrateCommandError> {
    let view = solver::find_view(path, board)?;
    let seen = solver::board_pose(intrinsics, &view, board)?;
    let pose = solver::world_from_camera(&seen, thickness_mm);
    if let Some(out) = corners {
        save(out, &solver::corner_picture(&view, board)?)?;
    }
    let at = pose.translation.vector;
    let axis = pose.rotation * Vector3::z();
    let text = format!(
        "table      {}: mean {:.3} px, max {:.3} px; camera at ({:.1}, {:.1}, {:.1}) mm, {:.2} deg from straight down\n",
        path.display(),
        seen.mean_error_px,
        seen.max_error_px,
        at.x,
        at.y,
        at.z,
        (-axis.z).clamp(-1.0, 1.0).acos().to_degrees()
    );
    Ok((pose, text))
}

fn image_table(views: &[View], solution: &Calibration) -> String {
    let name = |view: &View| view.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let width = views.iter().map(|view| name(view).chars().count()).max().unwrap_or(0).max(5);
    let mut text = format!("{:<width$} {:>8} {:>9} {:>9}\n", "image", "corners", "mean px", "max px");
    for (view, pose) in views.iter().zip(&solution.views) {
        let (corners, mean, max) = (view.corners.len(), pose.mean_error_px, pose.max_error_px);
        let _ = writeln!(text, "{:<width$} {corners:>8} {mean:>9.3} {max:>9.3}", name(view));
    }
    let corners: usize = views.iter().map(|view| view.corners.len()).sum();
    let max = solution.views.iter().map(|pose| pose.max_error_px).fold(0.0, f64::max);
    let _ = writeln!(text, "{:<width$} {corners:>8} {:>9.3} {max:>9.3}\n", "all", solution.mean_error_px);
    text
}

fn numbers(solution: &Calibration) -> String {
    let p = solution.intrinsics.params();
    let [fx, fy, cx, cy] = solution.deviations_px;
    format!(
        "image      {} x {} px\nfocal      fx {:.2} +- {fx:.2} px, fy {:.2} +- {fy:.2} px\ncentre     cx {:.2} +- {cx:.2} \
         px, cy {:.2} +- {cy:.2} px\nlens       k1 {:.5}, k2 {:.5}, p1 {:.5}, p2 {:.5}, k3 {:.5}\n",
        p.width_px, p.height_px, p.fx_px, p.fy_px, p.cx_px, p.cy_px, p.k1, p.k2, p.p1, p.p2, p.k3
    )
}

fn next_touch(camera: &Path) -> String {
    let camera = camera.display();
    format!(
        "Next: touch points of the table with the robot, then run\n  samsod calibrate touch POINTS.toml --camera {camera}\n"
    )
}

fn thickness(board_thickness_mm: f64) -> Result<f64, CalibrateCommandError> {
    must_be_allowed("--board-thickness-mm", board_thickness_mm, 0.0, 200.0)?;
    Ok(board_thickness_mm)
}

fn must_be_allowed(option: &'static str, value: f64, least: f64, most: f64) -> Result<(), CalibrateCommandError> {
    // NaN is in no range.
    if (least..=most).contains(&value) {
        return Ok(());
    }
    Err(CalibrateCommandError::Option { option, value, allowed: format!("{least} to {most}") })
}

fn must_be_free(path: &Path, force: bool) -> Result<(), CalibrateCommandError> {
    if force || path.symlink_metadata().is_err() {
        return Ok(());
    }
    Err(CameraFileError::Exists { path: path.to_owned() }.into())
}

/// One name for a file however it was written; that of a file that does not exist stays.
fn canonical(path: &Path) -> PathBuf {
    path.canonicalize().unwrap_or_else(|_| path.to_owned())
}

fn save(path: &Path, picture: &RgbImage) -> Result<(), CalibrateCommandError> {
    picture
        .save_with_format(path, ImageFormat::Png)
        .map_err(|e| CalibrateCommandError::Write { path: path.to_owned(), cause: e.to_string() })
}
