//! Frames for the benchmarks: the bundled scenes of a robot cell at several widths, and the parts that lie in them.

use std::path::{Path, PathBuf};

use image::imageops::{self, FilterType};
use image::{ImageError, RgbImage};
use samsod::recognize::{Catalogue, CatalogueError};
use samsod::segment::RgbView;

/// Widths at which the stages are measured, px; the last is that of the bundled frames.
pub const WIDTHS_PX: [u32; 3] = [256, 512, 1078];

/// Names of the bundled frames.
pub const ALL: [&str; 6] = ["0001", "0008", "0010", "0022", "0032", "0039"];

/// Two of [`ALL`] between which the others lie: a plain grey table, and a ruled mat in low light.
pub const PLAIN_AND_TEXTURED: [&str; 2] = ["0022", "0010"];

/// Those of [`ALL`] that were taken by the camera of the bundled parts' templates.
pub const OF_TEMPLATE_CAMERA: [&str; 4] = ["0008", "0022", "0032", "0039"];

/// The frame of [`OF_TEMPLATE_CAMERA`] with the most parts: 7.
pub const FULLEST: &str = "0008";

/// The bundled parts that recognition is measured with: all that lie in [`FULLEST`], 0032 and 0039, and a washer. Most of
/// those in 0022 are not among them.
pub const TWELVE_PARTS: [&str; 12] = [
    "asym_plate",
    "dovetail_plate",
    "flange",
    "housing_block",
    "l_bracket",
    "sensor_box",
    "spur_gear",
    "star_knob",
    "stepped_shaft",
    "t_piece",
    "u_channel",
    "washer",
];

/// Some of the bundled parts.
///
/// # Errors
/// A file of the catalogue that cannot be used.
pub fn bundled_parts(names: &[&str]) -> Result<Catalogue, CatalogueError> {
    let all = Catalogue::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/data/parts"))?;
    let others: Vec<&str> = all.parts().iter().map(|part| part.name.as_str()).filter(|n| !names.contains(n)).collect();
    Ok(all.without(&others))
}

/// Why a frame could not be loaded.
#[derive(Debug, thiserror::Error)]
#[error("{}: {source}", path.display())]
pub struct FrameError {
    path: PathBuf,
    source: ImageError,
}

/// One decoded frame.
#[derive(Debug, Clone)]
pub struct Frame {
    /// Name of the file without extension.
    pub name: &'static str,
    /// The pixels.
    pub image: RgbImage,
}

impl Frame {
    /// Decodes a bundled frame at its own size.
    ///
    /// # Errors
    /// The file that cannot be read or decoded.
    pub fn load(name: &'static str) -> Result<Self, FrameError> {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/data/cell").join(name).with_extension("jpg");
        match image::open(&path) {
            Ok(image) => Ok(Self { name, image: image.into_rgb8() }),
            Err(source) => Err(FrameError { path, source }),
        }
    }

    /// Decodes several bundled frames.
    ///
    /// # Errors
    /// The first file that cannot be read or decoded.
    pub fn load_all(names: &[&'static str]) -> Result<Vec<Self>, FrameError> {
        names.iter().copied().map(Self::load).collect()
    }

    /// The frame at another width, with its proportions; bilinear, over all pixels that a smaller one covers.
    pub fn at_width(&self, width: u32) -> Self {
        if width == self.image.width() {
            return self.clone();
        }
        let scale = f64::from(width) / f64::from(self.image.width());
        let height = (f64::from(self.image.height()) * scale).round().max(1.0) as u32;
        Self { name: self.name, image: imageops::resize(&self.image, width, height, FilterType::Triangle) }
    }

    /// The frame beside and below itself, `times` in each direction.
    pub fn tiled(&self, times: u32) -> Self {
        let (width, height) = self.image.dimensions();
        let mut image = RgbImage::new(width * times, height * times);
        imageops::tile(&mut image, &self.image);
        Self { name: self.name, image }
    }

    /// The pixels, borrowed as the stages take them.
    #[expect(clippy::expect_used, reason = "the buffer of an image is as long as its size asks for")]
    pub fn view(&self) -> RgbView<'_> {
        let (width, height) = self.image.dimensions();
        RgbView::from_raw(width, height, self.image.as_raw().as_slice()).expect("a buffer of width * height * 3 bytes")
    }
}
