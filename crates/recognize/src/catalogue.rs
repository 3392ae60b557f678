//! The catalogue: a folder of parts, each a folder of its own.
//!
//! ```text
//! DIR/flange/part.toml      module `part_file`
//! DIR/flange/template.png   the part alone, cut from a frame
//! DIR/flange/mask.png       of the same size, more than 127 on the part
//! DIR/flange/model.stl      optional: its shape, mm
//! DIR/flange/descriptors    made by samsod: what was computed from the others
//! ```

use std::fs;
use std::path::{Path, PathBuf};

use image::{GrayImage, RgbImage};
use samsod_camera::{Camera, Intrinsics, IntrinsicsError, PoseError, ProjectionError, pose_from_rows};

use crate::mesh::{Mesh, MeshError};
use crate::part_file::{PartFile, Symmetry};

/// Name of the file that says what a part is.
pub const PART_FILE: &str = "part.toml";
/// Name of the picture of a part.
pub const TEMPLATE_FILE: &str = "template.png";
/// Name of the mask of that picture.
pub const MASK_FILE: &str = "mask.png";
/// Name of the shape of a part.
pub const MODEL_FILE: &str = "model.stl";
/// Longest side of a template, px.
const MAX_TEMPLATE_PX: u32 = 4096;
/// Fewest pixels of a mask.
const MIN_MASK_PX: usize = 50;
/// Greatest height of a part, and width of a grasp, mm.
const MAX_LENGTH_MM: f64 = 5_000.0;
/// Highest order of a symmetry; what repeats more often counts as round.
const MAX_SYMMETRY: u32 = 360;

/// Why a catalogue cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CatalogueError {
    /// A file or folder cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The folder has no part in it.
    #[error("{}: no part in it (a folder with {PART_FILE}); `samsod teach` makes one", path.display())]
    Empty {
        /// The folder.
        path: PathBuf,
    },
    /// The file is no TOML, lacks a key, or has one that is not known.
    #[error("{}: {message}", path.display())]
    Parse {
        /// The file.
        path: PathBuf,
        /// Where and what.
        message: String,
    },
    /// A number or name is not allowed.
    #[error("{}: {key} is {value}; allowed: {allowed}", path.display())]
    Value {
        /// The file.
        path: PathBuf,
        /// Section and key.
        key: &'static str,
        /// The value.
        value: String,
        /// What is allowed.
        allowed: String,
    },
    /// Two parts have one name.
    #[error("{} and {}: both are named {name}; every part needs a name of its own", first.display(), second.display())]
    Twice {
        /// The name.
        name: String,
        /// The one file.
        first: PathBuf,
        /// The other.
        second: PathBuf,
    },
    /// A picture cannot be read.
    #[error("{}: {source}", path.display())]
    Image {
        /// The file.
        path: PathBuf,
        /// Why.
        source: image::ImageError,
    },
    /// The mask does not fit its picture.
    #[error("{}: {} x {} px, but {TEMPLATE_FILE} beside it has {} x {} px", path.display(), mask[0], mask[1], template[0], template[1])]
    MaskSize {
        /// The mask.
        path: PathBuf,
        /// Its width and height, px.
        mask: [u32; 2],
        /// Those of the picture.
        template: [u32; 2],
    },
    /// The mask has hardly any pixel.
    #[error("{}: {pixels} px are set (more than 127); a part needs at least {MIN_MASK_PX}", path.display())]
    MaskEmpty {
        /// The mask.
        path: PathBuf,
        /// Pixels set.
        pixels: usize,
    },
    /// The camera of the template is impossible.
    #[error("{}: [camera.intrinsics] {source}", path.display())]
    Intrinsics {
        /// The file.
        path: PathBuf,
        /// Why.
        source: IntrinsicsError,
    },
    /// The pose of that camera is none.
    #[error("{}: [camera] world_from_camera_mm: {source}", path.display())]
    Pose {
        /// The file.
        path: PathBuf,
        /// Why.
        source: PoseError,
    },
    /// The origin of the part cannot be seen in its template.
    #[error("{}: [template] origin_px: {source}", path.display())]
    Origin {
        /// The file.
        path: PathBuf,
        /// Why.
        source: ProjectionError,
    },
    /// The shape cannot be used.
    #[error(transparent)]
    Mesh(#[from] MeshError),
    /// The height of the part and that of its shape differ.
    #[error("{}: height_mm is {height_mm}, but {MODEL_FILE} beside it is {model_mm} mm high; allowed is a difference of 10 %", path.display())]
    Height {
        /// The file.
        path: PathBuf,
        /// Height of the part, mm.
        height_mm: f64,
        /// Height of its shape, mm.
        model_mm: f64,
    },
}

/// How a gripper takes a part.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grasp {
    /// Opening of the gripper at the part, mm.
    pub width_mm: f64,
    /// Where it closes, from the origin of the part and in its axes, mm.
    pub offset_mm: [f64; 2],
    /// Direction of the gripper's x axis, along its fingers, in the axes of the part, rad.
    pub angle_rad: f64,
}

/// The picture of a part, and where the part lay in it.
#[derive(Debug, Clone, PartialEq)]
pub struct Template {
    /// The picture.
    pub image: RgbImage,
    /// More than 127 on the part; of the same size.
    pub mask: GrayImage,
    /// The camera that took the frame that the picture was cut from.
    pub camera: Camera,
    /// Where in that frame, px.
    pub crop_px: [u32; 2],
    /// Origin of the part on the table (x, y), mm, in the world of that camera.
    pub origin_mm: [f64; 2],
    /// Yaw of the part there, rad.
    pub yaw_rad: f64,
}

/// A part of the catalogue.
#[derive(Debug, Clone, PartialEq)]
pub struct Part {
    /// Its name.
    pub name: String,
    /// The folder that it was read from.
    pub folder: PathBuf,
    /// Height over the table, as it lies, mm.
    pub height_mm: f64,
    /// How it is gripped.
    pub grasp: Grasp,
    /// Which turns give the same.
    pub symmetry: Symmetry,
    /// Its picture.
    pub template: Template,
    /// Its shape, if a model was given.
    pub mesh: Option<Mesh>,
}

/// Parts that can be recognised.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Catalogue {
    parts: Vec<Part>,
}

impl Catalogue {
    /// Reads all parts of a folder, in the order of their names. Folders without `part.toml` are passed over.
    ///
    /// # Errors
    /// [`CatalogueError`]: no part, a file that is missing or wrong, two parts with one name.
    pub fn read(folder: &Path) -> Result<Self, CatalogueError> {
        let unreadable = |source| CatalogueError::Read { path: folder.to_owned(), source };
        let mut folders = Vec::new();
        for entry in fs::read_dir(folder).map_err(unreadable)? {
            let path = entry.map_err(unreadable)?.path();
            if path.join(PART_FILE).is_file() {
                folders.push(path);
            }
        }
        folders.sort();
        if folders.is_empty() {
            return Err(CatalogueError::Empty { path: folder.to_owned() });
        }
        let mut catalogue = Self::default();
        for folder in folders {
            catalogue.add(Part::read(&folder)?)?;
        }
        Ok(catalogue)
    }

    /// Adds a part behind the others.
    ///
    /// # Errors
    /// [`CatalogueError::Twice`]: there is a part of that name.
    pub fn add(&mut self, part: Part) -> Result<(), CatalogueError> {
        if let Some(other) = self.part(&part.name) {
            let (first, second) = (other.folder.join(PART_FILE), part.folder.join(PART_FILE));
            return Err(CatalogueError::Twice { name: part.name, first, second });
        }
        self.parts.push(part);
        Ok(())
    }

    /// The parts.
    pub fn parts(&self) -> &[Part] {
        &self.parts
    }

    /// The part of a name.
    pub fn part(&self, name: &str) -> Option<&Part> {
        self.parts.iter().find(|part| part.name == name)
    }

    /// The same catalogue without some parts; names that are not there change nothing.
    pub fn without(&self, names: &[&str]) -> Self {
        Self { parts: self.parts.iter().filter(|part| !names.contains(&part.name.as_str())).cloned().collect() }
    }
}

impl Part {
    /// Reads the folder of a part.
    ///
    /// # Errors
    /// [`CatalogueError`], with the file, the value and what is allowed.
    pub fn read(folder: &Path) -> Result<Self, CatalogueError> {
        let path = folder.join(PART_FILE);
        let text = fs::read_to_string(&path).map_err(|source| CatalogueError::Read { path: path.clone(), source })?;
        let file: PartFile = toml::from_str(&text).map_err(|error| CatalogueError::Parse {
            path: path.clone(),
            message: error.to_string().trim_end().to_owned(),
        })?;
        check_name(&path, &file.name)?;
        let within = |key, value: f64, [least, most]: [f64; 2]| {
            let allowed = || format!("{least} to {most}");
            let error =
                || CatalogueError::Value { path: path.clone(), key, value: value.to_string(), allowed: allowed() };
            if (least..=most).contains(&value) { Ok(value) } else { Err(error()) }
        };
        let height_mm = within("height_mm", file.height_mm, [0.01, MAX_LENGTH_MM])?;
        let grasp = Grasp {
            width_mm: within("grasp_width_mm", file.grasp_width_mm, [0.0, MAX_LENGTH_MM])?,
            offset_mm: [
                within("grasp_offset_mm[0]", file.grasp_offset_mm[0], [-MAX_LENGTH_MM, MAX_LENGTH_MM])?,
                within("grasp_offset_mm[1]", file.grasp_offset_mm[1], [-MAX_LENGTH_MM, MAX_LENGTH_MM])?,
            ],
            angle_rad: within("grasp_angle_deg", file.grasp_angle_deg, [-360.0, 360.0])?.to_radians(),
        };
        let orders = [0.0, f64::from(MAX_SYMMETRY)];
        within("symmetry.shape_order", f64::from(file.symmetry.shape_order), orders)?;
        within("symmetry.appearance_order", f64::from(file.symmetry.appearance_order), orders)?;
        let yaw_rad = within("template.angle_deg", file.template.angle_deg, [-360.0, 360.0])?.to_radians();

        let image = read_image(&folder.join(TEMPLATE_FILE))?.into_rgb8();
        let mask_path = folder.join(MASK_FILE);
        let mask = read_image(&mask_path)?.into_luma8();
        if mask.dimensions() != image.dimensions() {
            let (mask, template) = (mask.dimensions().into(), image.dimensions().into());
            return Err(CatalogueError::MaskSize { path: mask_path, mask, template });
        }
        let pixels = mask.iter().filter(|&&value| value > 127).count();
        if pixels < MIN_MASK_PX {
            return Err(CatalogueError::MaskEmpty { path: mask_path, pixels });
        }
        let intrinsics = Intrinsics::new(file.camera.intrinsics)
            .map_err(|source| CatalogueError::Intrinsics { path: path.clone(), source })?;
        let world_from_camera = pose_from_rows(&file.camera.world_from_camera_mm)
            .map_err(|source| CatalogueError::Pose { path: path.clone(), source })?;
        let no_origin = |source| CatalogueError::Origin { path: path.clone(), source };
        let camera = Camera::new(intrinsics, world_from_camera, None).map_err(no_origin)?;
        let crop_px = file.template.crop_px;
        let [u, v] = [0, 1].map(|axis| file.template.origin_px[axis] + f64::from(crop_px[axis]));
        let [x_mm, y_mm, _] = camera.world_from_image([u, v], height_mm).map_err(no_origin)?;

        let model = folder.join(MODEL_FILE);
        let mesh = if model.exists() { Some(Mesh::read(&model)?) } else { None };
        if let Some(mesh) = &mesh {
            let model_mm = f64::from(mesh.height_mm());
            if (model_mm - height_mm).abs() > 0.1 * height_mm {
                return Err(CatalogueError::Height { path, height_mm, model_mm });
            }
        }
        let template = Template { image, mask, camera, crop_px, origin_mm: [x_mm, y_mm], yaw_rad };
        let (name, symmetry) = (file.name, file.symmetry);
        Ok(Self { name, folder: folder.to_owned(), height_mm, grasp, symmetry, template, mesh })
    }
}

/// A name is that of a folder, a topic and a key: letters, digits, `_` and `-`.
pub(crate) fn check_name(path: &Path, name: &str) -> Result<(), CatalogueError> {
    let allowed = |c: char| c.is_alphanumeric() || c == '_' || c == '-';
    if (1..=64).contains(&name.chars().count()) && name.chars().all(allowed) {
        return Ok(());
    }
    Err(CatalogueError::Value {
        path: path.to_owned(),
        key: "name",
        value: format!("{name:?}"),
        allowed: "1 to 64 letters, digits, _ and -".to_owned(),
    })
}

fn read_image(path: &Path) -> Result<image::DynamicImage, CatalogueError> {
    let mut reader = image::ImageReader::open(path)
        .map_err(|source| CatalogueError::Read { path: path.to_owned(), source })?
        .with_guessed_format()
        .map_err(|source| CatalogueError::Read { path: path.to_owned(), source })?;
    let mut limits = image::Limits::default();
    limits.max_image_width = Some(MAX_TEMPLATE_PX);
    limits.max_image_height = Some(MAX_TEMPLATE_PX);
    reader.limits(limits);
    reader.decode().map_err(|source| CatalogueError::Image { path: path.to_owned(), source })
}

#[cfg(test)]
mod tests {
    use image::{Luma, Rgb};
    use tempfile::TempDir;

    use super::*;
    use crate::test_parts::{Block, binary_stl, write_stl};

    const BOX: [Block; 1] = [[[-10.0, -10.0, 0.0], [10.0, 10.0, 8.0]]];
    const TEXT: &str = r#"name = "box"
height_mm = 8.0
grasp_width_mm = 20.0

[symmetry]
shape_order = 4
appearance_order = 1

[template]
crop_px = [30, 20]
origin_px = [20.0, 15.0]
angle_deg = 90.0

[camera]
world_from_camera_mm = [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 408.0], [0.0, 0.0, 0.0, 1.0]]

[camera.intrinsics]
width_px = 101
height_px = 71
fx_px = 200.0
fy_px = 200.0
cx_px = 50.0
cy_px = 35.0
k1 = 0.0
k2 = 0.0
p1 = 0.0
p2 = 0.0
k3 = 0.0
"#;

    /// A catalogue of one part, in the folder `a`.
    struct Bench {
        folder: TempDir,
    }

    impl Bench {
        fn new() -> Self {
            let bench = Self { folder: tempfile::tempdir().unwrap() };
            bench.add("a", TEXT);
            bench
        }

        fn path(&self, name: &str) -> PathBuf {
            self.folder.path().join(name)
        }

        fn add(&self, folder: &str, text: &str) {
            fs::create_dir(self.path(folder)).unwrap();
            fs::write(self.path(folder).join(PART_FILE), text).unwrap();
            RgbImage::from_pixel(40, 30, Rgb([9; 3])).save(self.path(folder).join(TEMPLATE_FILE)).unwrap();
            GrayImage::from_pixel(40, 30, Luma([255])).save(self.path(folder).join(MASK_FILE)).unwrap();
        }

        fn read(&self) -> Result<Catalogue, CatalogueError> {
            Catalogue::read(self.folder.path())
        }

        /// The message, which names a file of the part.
        fn refused(&self, file: &str) -> String {
            let message = self.read().unwrap_err().to_string();
            let path = self.path("a").join(file);
            assert!(message.contains(path.to_str().unwrap()), "{message}");
            message
        }

        /// The message for a part.toml with another line.
        fn refused_line(&self, line: &str, other: &str) -> String {
            assert!(TEXT.contains(line));
            fs::write(self.path("a").join(PART_FILE), TEXT.replace(line, other)).unwrap();
            self.refused(PART_FILE)
        }
    }

    fn assert_contains(message: &str, parts: &[&str]) {
        assert!(parts.iter().all(|part| message.contains(part)), "{message}");
    }

    #[test]
    fn a_part_is_read_with_its_place_in_millimetres() {
        let bench = Bench::new();
        write_stl(&BOX, &bench.path("a").join(MODEL_FILE));
        let catalogue = bench.read().unwrap();
        let part = catalogue.part("box").unwrap();
        // The camera is 400 mm over the top of the part: 2 mm a pixel, from the middle (50, 35) of its image.
        assert!((part.template.origin_mm[0] - 0.0).abs() < 1e-9 && (part.template.origin_mm[1] - 0.0).abs() < 1e-9);
        assert!((part.template.yaw_rad - std::f64::consts::FRAC_PI_2).abs() < 1e-12);
        assert_eq!(part.grasp, Grasp { width_mm: 20.0, offset_mm: [0.0; 2], angle_rad: 0.0 });
        assert_eq!(part.mesh.as_ref().map(Mesh::height_mm), Some(8.0));
        assert_eq!(part.symmetry, Symmetry { shape_order: 4, appearance_order: 1 });
        assert_eq!(part.folder, bench.path("a"));
        fs::remove_file(bench.path("a").join(MODEL_FILE)).unwrap();
        assert_eq!(bench.read().unwrap().part("box").unwrap().mesh, None);
        assert_eq!(bench.read().unwrap().part("a"), None);
    }

    #[test]
    fn parts_come_in_the_order_of_their_folders_and_can_be_left_out() {
        let bench = Bench::new();
        bench.add("c", &TEXT.replace("\"box\"", "\"third\""));
        bench.add("b", &TEXT.replace("\"box\"", "\"second\""));
        // Neither a part: a folder without part.toml, and a file.
        fs::create_dir(bench.path("notes")).unwrap();
        fs::write(bench.path("readme.txt"), "").unwrap();
        let catalogue = bench.read().unwrap();
        let names = |catalogue: &Catalogue| catalogue.parts().iter().map(|p| p.name.clone()).collect::<Vec<_>>();
        assert_eq!(names(&catalogue), ["box", "second", "third"]);
        assert_eq!(names(&catalogue.without(&["second", "nothing"])), ["box", "third"]);
    }

    #[test]
    fn folders_without_parts_are_refused() {
        let empty = tempfile::tempdir().unwrap();
        let message = Catalogue::read(empty.path()).unwrap_err().to_string();
        assert_contains(&message, &[empty.path().to_str().unwrap(), "no part in it", "samsod teach"]);
        let missing = empty.path().join("missing");
        let message = Catalogue::read(&missing).unwrap_err().to_string();
        assert_contains(&message, &["cannot read", missing.to_str().unwrap()]);
    }

    #[test]
    fn a_name_that_is_there_twice_is_refused_with_both_files() {
        let bench = Bench::new();
        bench.add("b", TEXT);
        let (first, second) = (bench.path("a").join(PART_FILE), bench.path("b").join(PART_FILE));
        let message = bench.read().unwrap_err().to_string();
        assert_contains(&message, &[first.to_str().unwrap(), second.to_str().unwrap(), "both are named box"]);
    }

    #[test]
    fn pictures_and_masks_that_do_not_fit_are_refused() {
        let bench = Bench::new();
        let (image, mask) = (bench.path("a").join(TEMPLATE_FILE), bench.path("a").join(MASK_FILE));
        GrayImage::from_pixel(41, 30, Luma([255])).save(&mask).unwrap();
        assert_contains(&bench.refused(MASK_FILE), &["41 x 30 px", "template.png beside it has 40 x 30 px"]);
        GrayImage::from_pixel(40, 30, Luma([127])).save(&mask).unwrap();
        assert_contains(&bench.refused(MASK_FILE), &["0 px are set", "at least 50"]);
        GrayImage::from_fn(40, 30, |x, y| Luma([if x < 7 && y < 7 { 128 } else { 0 }])).save(&mask).unwrap();
        assert_contains(&bench.refused(MASK_FILE), &["49 px are set", "at least 50"]);
        fs::write(&mask, "no picture").unwrap();
        bench.refused(MASK_FILE);
        fs::remove_file(&mask).unwrap();
        assert_contains(&bench.refused(MASK_FILE), &["cannot read"]);
        GrayImage::new(MAX_TEMPLATE_PX + 1, 1).save(&image).unwrap();
        bench.refused(TEMPLATE_FILE);
        fs::remove_file(&image).unwrap();
        assert_contains(&bench.refused(TEMPLATE_FILE), &["cannot read"]);
    }

    #[test]
    fn keys_that_are_unknown_missing_or_no_toml_are_refused() {
        let bench = Bench::new();
        assert_contains(
            &bench.refused_line("height_mm = 8.0", "height_mm = 8.0\nheigth_mm = 8.0"),
            &["unknown field", "heigth_mm"],
        );
        assert_contains(
            &bench.refused_line("shape_order = 4", "shape_order = 4\norder = 1"),
            &["unknown field", "order"],
        );
        assert_contains(&bench.refused_line("height_mm = 8.0\n", ""), &["missing field", "height_mm"]);
        assert_contains(&bench.refused_line("height_mm = 8.0", "height_mm = \"8\""), &["height_mm", "line 2"]);
        assert_contains(&bench.refused_line("height_mm = 8.0", "height_mm"), &["line 2"]);
        assert_contains(&bench.refused_line("crop_px = [30, 20]", "crop_px = [-1, 20]"), &["crop_px"]);
        fs::write(bench.path("a").join(PART_FILE), [0xff, 0xfe]).unwrap();
        assert_contains(&bench.refused(PART_FILE), &["cannot read"]);
    }

    #[test]
    fn numbers_out_of_range_are_refused_with_what_is_allowed() {
        let bench = Bench::new();
        for (line, other, message) in [
            ("height_mm = 8.0", "height_mm = 0.0", "height_mm is 0; allowed: 0.01 to 5000"),
            ("height_mm = 8.0", "height_mm = nan", "height_mm is NaN; allowed: 0.01 to 5000"),
            ("grasp_width_mm = 20.0", "grasp_width_mm = -1.0", "grasp_width_mm is -1; allowed: 0 to 5000"),
            (
                "grasp_width_mm = 20.0",
                "grasp_width_mm = 20.0\ngrasp_offset_mm = [0.0, inf]",
                "grasp_offset_mm[1] is inf; allowed: -5000 to 5000",
            ),
            (
                "grasp_width_mm = 20.0",
                "grasp_width_mm = 20.0\ngrasp_angle_deg = 400.0",
                "grasp_angle_deg is 400; allowed: -360 to 360",
            ),
            ("shape_order = 4", "shape_order = 361", "symmetry.shape_order is 361; allowed: 0 to 360"),
            ("appearance_order = 1", "appearance_order = 1000", "symmetry.appearance_order is 1000; allowed: 0 to 360"),
            ("angle_deg = 90.0", "angle_deg = 361.0", "template.angle_deg is 361; allowed: -360 to 360"),
            ("name = \"box\"", "name = \"a/b\"", "name is \"a/b\"; allowed: 1 to 64 letters, digits, _ and -"),
            ("name = \"box\"", "name = \"\"", "name is \"\"; allowed: 1 to 64 letters, digits, _ and -"),
        ] {
            assert_contains(&bench.refused_line(line, other), &[message]);
        }
        assert_contains(&bench.refused_line("fx_px = 200.0", "fx_px = 0.0"), &["[camera.intrinsics]", "fx_px"]);
        let turned = "world_from_camera_mm = [[2.0, 0.0, 0.0, 0.0]";
        let message = bench.refused_line("world_from_camera_mm = [[1.0, 0.0, 0.0, 0.0]", turned);
        assert_contains(&message, &["[camera] world_from_camera_mm"]);
        let origin = bench.refused_line("origin_px = [20.0, 15.0]", "origin_px = [nan, 15.0]");
        assert_contains(&origin, &["[template] origin_px"]);
        // The camera would be below the top of the part.
        let below = bench.refused_line("height_mm = 8.0", "height_mm = 500.0");
        assert_contains(&below, &["[template] origin_px"]);
    }

    #[test]
    fn a_model_must_be_as_high_as_its_part() {
        let bench = Bench::new();
        let model = bench.path("a").join(MODEL_FILE);
        let of_height = |height: f32| write_stl(&[[[-10.0, -10.0, 0.0], [10.0, 10.0, height]]], &model);
        of_height(8.7);
        bench.read().unwrap();
        of_height(9.0);
        assert_contains(&bench.refused(PART_FILE), &["height_mm is 8", "9 mm high", "10 %"]);
        fs::write(&model, binary_stl(&[], 12)).unwrap();
        assert_contains(&bench.refused(MODEL_FILE), &["cannot read"]);
        fs::write(&model, binary_stl(&[], u32::MAX)).unwrap();
        bench.refused(MODEL_FILE);
        let nan = [[[f32::NAN, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 8.0]]; 4];
        fs::write(&model, binary_stl(&nan, 4)).unwrap();
        assert_contains(&bench.refused(MODEL_FILE), &["NaN", "finite numbers"]);
    }
}
