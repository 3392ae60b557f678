//! `samsod twin`: the cell twin, which stands in for table and camera.
//!
//! In: the configuration of `samsodd` for camera and catalogue, a picture of a bare table, and `table.json`, which says what
//! lies where. Out: frames of that table, as the camera would take them. The simulated robot replaces the table file when it
//! takes a part; the next frame is without it. So the service finds, picks and places parts that can be taken away.
//!
//! * `twin/random_table`: makes a table file, with `twin/random`; its type is the [`TableState`] of the robot.
//! * `twin/canvas`: the picture of a table, from a layer for each part; `twin/tile`: parts of pictures.
//! * `twin/render`: makes a layer, by `twin/surface` (parts), `twin/shadow`, `twin/light` and `twin/raster`.
//! * `twin/run`: publishes frames of it; `twin/noise`: what tells one frame from the next.

mod canvas;
mod light;
mod noise;
mod random;
mod random_table;
mod raster;
mod render;
mod run;
mod score;
mod shadow;
mod surface;
mod tile;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use image::{ImageFormat, RgbImage};
use samsod::recognize::Catalogue;
use samsod_camera::Camera;
use samsod_camera::nalgebra::Isometry3;
use samsod_robot::{PartTableError, TableState, Whereabouts};

pub use light::{Arrangement, LampError, LampOptions, Lighting};
pub use random_table::{MARGIN_PX, REACH_MM, TableError, TableOptions, random_table};
pub use run::{RunEvent, RunOptions, RunSummary, run};
pub use score::Score;

use crate::config::{Config, ConfigError};
use crate::inspect::{self, InspectError};
use crate::place::PlanePose;
use crate::publish::PublishError;
use canvas::{Canvas, LayerKey};
use noise::SensorNoise;
use render::{Placed, Renderer};
use surface::Surface;

/// Brightness of parts that can be asked for, and noise.
const EXPOSURE: [f64; 2] = [0.05, 20.0];
const NOISE: [f64; 2] = [0.0, 10.0];

/// Stand in for table and camera: frames of a simulated table, from which the simulated robot takes parts.
#[derive(Debug, Args)]
pub struct TwinArguments {
    /// What to do.
    #[command(subcommand)]
    pub command: TwinCommand,
}

/// What the twin can do.
#[derive(Debug, Subcommand)]
pub enum TwinCommand {
    /// Send frames of the table to a running samsodd, until SIGINT or SIGTERM.
    Run(TwinRunArguments),
    /// Lay parts at random places and angles; write the table file.
    Table(TwinTableArguments),
    /// Draw one frame of the table, to be looked at.
    Picture(TwinPictureArguments),
    /// Tell every pick with its error, and whether all was placed; exit code 1 when not.
    Score(TwinScoreArguments),
}

/// How the table is drawn.
#[derive(Debug, Args)]
pub struct DrawArguments {
    /// The table file, as the simulated robot writes it.
    #[arg(long, value_name = "FILE")]
    pub table: PathBuf,
    /// Configuration of samsodd: its `[camera]` and its `[catalogue]`.
    #[arg(long, value_name = "FILE")]
    pub config: PathBuf,
    /// Picture of the bare table, of the size of the camera's images.
    #[arg(long, value_name = "IMAGE")]
    pub background: PathBuf,
    /// Where the light comes from.
    #[arg(long, value_enum, default_value_t)]
    pub lighting: Arrangement,
    /// Direction towards the first lamp, counter-clockwise from world x; 125 by default.
    #[arg(long, value_name = "DEG", allow_negative_numbers = true)]
    pub lamp_azimuth_deg: Option<f64>,
    /// Elevation of the first lamp, 10 to 90.
    #[arg(long, value_name = "DEG", allow_negative_numbers = true)]
    pub lamp_elevation_deg: Option<f64>,
    /// Softness of its shadows, 0 to 30: half the angle under which the lamp is seen.
    #[arg(long, value_name = "DEG", allow_negative_numbers = true)]
    pub lamp_softness_deg: Option<f64>,
    /// Brightness of the parts, of that in their templates, 0.05 to 20: a camera is exposed for its table.
    #[arg(long, value_name = "GAIN", default_value_t = 1.0, allow_negative_numbers = true)]
    pub exposure: f64,
    /// Noise, of that of a common sensor, 0 to 10; 0 makes all frames of a table the same.
    #[arg(long, value_name = "AMOUNT", default_value_t = 1.0, allow_negative_numbers = true)]
    pub noise: f64,
    /// Of the noise: the same seed makes the same frames.
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
}

/// `samsod twin score`
#[derive(Debug, Args)]
pub struct TwinScoreArguments {
    /// The table file, as the simulated robot left it.
    #[arg(long, value_name = "FILE")]
    pub table: PathBuf,
}

/// `samsod twin run`
#[derive(Debug, Args)]
pub struct TwinRunArguments {
    /// How the table is drawn.
    #[command(flatten)]
    pub draw: DrawArguments,
    /// Frames a second, 0.001 to 1000.
    #[arg(long, value_name = "HZ", default_value_t = 5.0, allow_negative_numbers = true)]
    pub rate: f64,
    /// End after so many frames.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub count: Option<u64>,
    /// Name of the camera.
    #[arg(long, value_name = "NAME", default_value = "twin")]
    pub camera: String,
    /// How long to wait for samsodd, seconds.
    #[arg(long, value_name = "S", default_value_t = 10)]
    pub wait: u64,
}

/// `samsod twin table`
#[derive(Debug, Args)]
pub struct TwinTableArguments {
    /// Names of parts in the catalogue, with commas; one may come twice.
    #[arg(long, value_name = "NAMES", value_delimiter = ',', required = true)]
    pub parts: Vec<String>,
    /// The same seed makes the same table.
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
    /// Least distance of two parts, mm: so that the fingers of the gripper fit beside each.
    #[arg(long, value_name = "MM", default_value_t = 25.0, allow_negative_numbers = true)]
    pub gap_mm: f64,
    /// A circle to keep free, as for the jig: x, y in the base frame of the robot, and radius, mm.
    #[arg(long, value_name = "X,Y,R", value_parser = circle, allow_negative_numbers = true)]
    pub keep_free_mm: Vec<[f64; 3]>,
    /// Configuration of samsodd: its `[camera]` and its `[catalogue]`.
    #[arg(long, value_name = "FILE")]
    pub config: PathBuf,
    /// The table file; one that exists is replaced.
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
}

/// `samsod twin picture`
#[derive(Debug, Args)]
pub struct TwinPictureArguments {
    /// How the table is drawn.
    #[command(flatten)]
    pub draw: DrawArguments,
    /// The picture, PNG.
    #[arg(long, value_name = "PNG")]
    pub out: PathBuf,
}

fn circle(text: &str) -> Result<[f64; 3], String> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|number| number.trim().parse()).collect();
    match numbers.as_deref() {
        Ok(&[x, y, radius]) => Ok([x, y, radius]),
        _ => Err("three numbers with commas are needed: X,Y,R".to_owned()),
    }
}

/// Why the twin cannot do what it is told.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TwinError {
    /// The configuration, its camera or its catalogue cannot be used.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The configuration lacks what the twin needs.
    #[error("{}: the twin needs {what}", path.display())]
    Lacks {
        /// The configuration.
        path: PathBuf,
        /// What is missing, and where it comes from.
        what: &'static str,
    },
    /// The camera has a lens that bends lines, which the twin does not draw.
    #[error(
        "{}: the camera has distortion ({key} = {value}); the twin draws by cameras without: undistort, and set k1 to k3, p1 \
         and p2 to 0",
        path.display()
    )]
    Distorted {
        /// The configuration.
        path: PathBuf,
        /// Which coefficient.
        key: &'static str,
        /// Its value.
        value: f64,
    },
    /// The background is no picture, or not of the camera.
    #[error(transparent)]
    Background(#[from] InspectError),
    /// The table file cannot be used.
    #[error(transparent)]
    TableFile(#[from] PartTableError),
    /// A table cannot be laid, or has a part that is not in the catalogue.
    #[error(transparent)]
    Table(#[from] TableError),
    /// A lamp cannot be where it is said to be.
    #[error("lamp: {0}")]
    Lamp(#[from] LampError),
    /// A number is out of range.
    #[error("{key} is {value}; allowed: {least} to {most}")]
    Value {
        /// Which.
        key: &'static str,
        /// The value given.
        value: f64,
        /// The least that is allowed.
        least: f64,
        /// The most that is allowed.
        most: f64,
    },
    /// Frames cannot be published.
    #[error(transparent)]
    Publish(#[from] PublishError),
    /// The picture cannot be written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// The picture.
        path: PathBuf,
        /// Why.
        source: image::ImageError,
    },
}

/// What the configuration says about the cell.
struct CellSetup {
    camera: Camera,
    base_from_world: Isometry3<f64>,
    catalogue: Catalogue,
}

impl CellSetup {
    /// # Arguments
    /// * `size_px` - of the image; of use with a `[view]`, which has none itself
    fn read(path: &Path, config: &Config, size_px: Option<[u32; 2]>) -> Result<Self, TwinError> {
        let lacks = |what| TwinError::Lacks { path: path.to_owned(), what };
        let placer = config.placer()?;
        let no_camera = "a [camera] file, which samsod calibrate writes: it draws what that camera sees";
        let placer = placer.ok_or_else(|| lacks(no_camera))?;
        let size_px = placer.image_size_px().or(size_px).ok_or_else(|| lacks(no_camera))?;
        let camera = placer.camera(size_px).ok_or_else(|| lacks(no_camera))?;
        let params = camera.intrinsics().params();
        let lens = [("k1", params.k1), ("k2", params.k2), ("p1", params.p1), ("p2", params.p2), ("k3", params.k3)];
        if let Some(&(key, value)) = lens.iter().find(|(_, value)| *value != 0.0) {
            return Err(TwinError::Distorted { path: path.to_owned(), key, value });
        }
        let base_from_world = placer.base_from_world();
        let no_base =
            "a [base] in the camera file, by samsod calibrate touch: parts lie in the base frame of the robot";
        let base_from_world = base_from_world.ok_or_else(|| lacks(no_base))?;
        let catalogue = config.read_catalogue()?;
        let catalogue = catalogue.ok_or_else(|| lacks("a [catalogue] folder: it draws the parts of the catalogue"))?;
        Ok(Self { camera, base_from_world, catalogue })
    }
}

/// Draws tables.
#[derive(Debug)]
pub struct Twin {
    renderer: Renderer,
    canvas: Canvas,
    /// By name.
    surfaces: BTreeMap<String, Surface>,
    catalogue: Catalogue,
    world_from_base: Isometry3<f64>,
    noise: SensorNoise,
    size_px: [u32; 2],
}

/// What [`Twin::compose`] had to do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Composed {
    /// Parts in view.
    pub in_view: usize,
    /// Parts that had to be drawn: those that were not where they are now in this picture or the one before.
    pub drawn: usize,
}

impl Twin {
    /// Reads the configuration, its camera and catalogue, and the picture of the bare table; not the table file.
    ///
    /// # Errors
    /// [`TwinError`], with the file or the value.
    pub fn open(arguments: &DrawArguments) -> Result<Self, TwinError> {
        let config = Config::read_without_catalogue(&arguments.config)?;
        Self::with_config(arguments, &config)
    }

    fn with_config(arguments: &DrawArguments, config: &Config) -> Result<Self, TwinError> {
        for (key, value, [least, most]) in
            [("exposure", arguments.exposure, EXPOSURE), ("noise", arguments.noise, NOISE)]
        {
            // NaN is in no range.
            if !(least..=most).contains(&value) {
                return Err(TwinError::Value { key, value, least, most });
            }
        }
        let lighting = Lighting::new(
            arguments.lighting,
            &LampOptions {
                azimuth_deg: arguments.lamp_azimuth_deg,
                elevation_deg: arguments.lamp_elevation_deg,
                softness_deg: arguments.lamp_softness_deg,
            },
        )?;
        let background = inspect::load(&arguments.background)?;
        let (width, height) = background.dimensions();
        let setup = CellSetup::read(&arguments.config, config, Some([width, height]))?;
        let size_px = setup.camera.intrinsics().size_px();
        if size_px != [width, height] {
            let (path, [camera_width, camera_height]) = (arguments.background.clone(), size_px);
            return Err(InspectError::OtherCamera { path, width, height, camera_width, camera_height }.into());
        }
        let parts = setup.catalogue.parts().iter();
        let surfaces = parts.filter_map(|part| Some((part.name.clone(), Surface::of(part)?))).collect();
        let table = render::linear(&background);
        let renderer = Renderer::new(setup.camera, &table, lighting, arguments.exposure);
        Ok(Self {
            canvas: Canvas::new(table, renderer.size()),
            renderer,
            surfaces,
            catalogue: setup.catalogue,
            world_from_base: setup.base_from_world.inverse(),
            noise: SensorNoise::new(arguments.noise, arguments.seed),
            size_px,
        })
    }

    /// Width and height of its frames, px.
    pub fn size_px(&self) -> [u32; 2] {
        self.size_px
    }

    /// Composes the picture of a table; before, it is that of the bare table.
    ///
    /// Parts that lie where they lay are not drawn anew, so that a part taken away costs little. The picture is the same
    /// whatever was composed before. Parts that the robot holds are not drawn; one that was dropped lies on the table, under
    /// the place at which the gripper let go.
    ///
    /// # Errors
    /// [`TwinError::Table`]: a part that the catalogue does not have, or has no model of. The picture has not changed then.
    pub fn compose(&mut self, table: &TableState) -> Result<Composed, TwinError> {
        // Those that are not drawn must be known as well: the file is of this cell or it is not.
        table.parts.iter().try_for_each(|part| random_table::find(&self.catalogue, &part.name).map(|_| ()))?;
        let visible = table.parts.iter().filter(|part| part.whereabouts != Whereabouts::Gripper);
        let keys = visible.map(|part| {
            let place = [part.x_mm, part.y_mm, part.z_mm, part.yaw_rad.to_degrees()];
            LayerKey::new(&part.name, place, part.whereabouts == Whereabouts::Dropped)
        });
        // Every part with a model has a surface.
        let keys = keys.filter(|key| self.surfaces.contains_key(&key.name)).collect();
        let Self { canvas, renderer, surfaces, world_from_base, .. } = self;
        let shown = canvas.show(keys, |key, table| {
            let [x_mm, y_mm, z_mm, yaw_deg] = key.place();
            let mut world = PlanePose { x_mm, y_mm, z_mm, yaw_deg }.moved(world_from_base);
            if key.is_dropped {
                world.z_mm = 0.0;
            }
            let part = Placed::new(&surfaces[&key.name], &world);
            renderer.layer(key, &part, table)
        });
        Ok(Composed { in_view: shown.in_view, drawn: shown.drawn })
    }

    /// The picture without noise: red, green, blue of each pixel, row by row, sRGB from 0 to 65280.
    pub fn levels(&self) -> &[u16] {
        self.canvas.levels()
    }

    /// Takes frame `number` of the picture, with the noise of that frame.
    ///
    /// # Arguments
    /// * `out` - red, green, blue of each pixel, row by row
    pub fn expose(&self, number: u64, out: &mut [u8]) {
        self.noise.expose(self.levels(), number, out);
    }
}

/// Makes a [`Twin`] and tells how it publishes: of `samsod twin run`.
///
/// # Errors
/// As [`Twin::open`].
pub fn prepare_run(arguments: &TwinRunArguments) -> Result<(Twin, RunOptions), TwinError> {
    let config = Config::read_without_catalogue(&arguments.draw.config)?;
    let twin = Twin::with_config(&arguments.draw, &config)?;
    let options = RunOptions {
        table: arguments.draw.table.clone(),
        service: config.service(),
        rate_hz: arguments.rate,
        count: arguments.count,
        wait: std::time::Duration::from_secs(arguments.wait),
        camera: arguments.camera.clone(),
    };
    Ok((twin, options))
}

/// Lays a random table and writes its file. Returns what is to be printed.
///
/// # Errors
/// [`TwinError`]; the file has not been changed then.
pub fn table(arguments: &TwinTableArguments) -> Result<String, TwinError> {
    let config = Config::read_without_catalogue(&arguments.config)?;
    // A view has no size of its own, and no picture gives it one here.
    let setup = CellSetup::read(&arguments.config, &config, None)?;
    let options = TableOptions {
        parts: arguments.parts.clone(),
        seed: arguments.seed,
        gap_mm: arguments.gap_mm,
        keep_free_mm: arguments.keep_free_mm.clone(),
    };
    let table = random_table(&options, &setup.catalogue, &setup.camera, &setup.base_from_world)?;
    table.write(&arguments.out)?;
    let width = table.parts.iter().map(|part| part.name.chars().count()).max().unwrap_or(0);
    let mut text = format!("{:<width$} {:>17} {:>7}\n", "part", "base mm", "yaw deg");
    for part in &table.parts {
        let yaw_deg = part.yaw_rad.to_degrees();
        text += &format!("{:<width$} {:>8.1} {:>8.1} {:>7.1}\n", part.name, part.x_mm, part.y_mm, yaw_deg);
    }
    Ok(text + &format!("{}\n", arguments.out.display()))
}

/// Draws one frame of a table into a file.
///
/// # Errors
/// [`TwinError`].
pub fn picture(arguments: &TwinPictureArguments) -> Result<(), TwinError> {
    let mut twin = Twin::open(&arguments.draw)?;
    twin.compose(&TableState::read(&arguments.draw.table)?)?;
    let [width, height] = twin.size_px();
    let mut image = RgbImage::new(width, height);
    twin.expose(0, &mut image);
    let path = &arguments.out;
    image.save_with_format(path, ImageFormat::Png).map_err(|source| TwinError::Write { path: path.clone(), source })
}
