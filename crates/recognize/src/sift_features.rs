//! SIFT features of an image, and those of a template that are kept.
//!
//! In: a box of an RGB image, and which of its pixels matter. Out: features (px, rad) and their descriptors of 128
//! numbers. The scale space dominates: some 0.3 us a pixel of the box.

use opencv::core::{KeyPoint, Mat, Vector, no_array};
use opencv::features2d::SIFT;
use opencv::prelude::*;
use samsod_segment::{BoundingBox, RgbView};
use serde::{Deserialize, Serialize};

use crate::homography::failed;
use crate::{RecognizeError, SiftParams, Template};

/// Numbers of a descriptor.
const LENGTH: usize = 128;
/// Layers an octave, edge threshold and first blur of Lowe (2004).
const OCTAVE_LAYERS: i32 = 3;
const EDGE_THRESHOLD: f64 = 10.0;
const SIGMA_PX: f64 = 1.6;
/// OpenCV doubles an image about its corner and halves the places found there about the centre of its first pixel, so
/// that all are so much too far right and down. As it turns with the template, it would be an error of 0.35 px.
const TOO_FAR_PX: f32 = 0.25;
/// Features so close to a part are of its outline.
const OUTLINE_PX: u32 = 3;

/// A descriptor: OpenCV's are whole numbers from 0 to 255.
pub(crate) type Descriptor = [i16; LENGTH];

/// Sum of the products, of which distances are made.
#[inline(always)]
pub(crate) fn dot(a: &Descriptor, b: &Descriptor) -> i32 {
    a.iter().zip(b).map(|(&a, &b)| i32::from(a) * i32::from(b)).sum()
}

/// A feature of an image.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(crate) struct Feature {
    /// Its centre, px.
    pub(crate) at: [f32; 2],
    /// Diameter, px.
    pub(crate) size_px: f32,
    /// Direction of its strongest gradient, atan2(dv, du), rad.
    pub(crate) angle_rad: f32,
}

/// Features from top to bottom and left to right, with their descriptors. One place has several features where its
/// gradients have several directions.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Features {
    pub(crate) features: Vec<Feature>,
    pub(crate) descriptors: Vec<Descriptor>,
}

impl Features {
    /// The strongest `max_features` features of a box of an image, and of those the ones at pixels of the box that are
    /// wanted.
    ///
    /// # Errors
    /// OpenCV failed. Nothing to be found is no error.
    pub(crate) fn find(
        image: &RgbView<'_>,
        bbox: &BoundingBox,
        params: &SiftParams,
        is_wanted: Option<&dyn Fn(u32, u32) -> bool>,
    ) -> Result<Self, RecognizeError> {
        let grey = grey(image, bbox);
        let (rows, columns) = (bbox.height as i32, bbox.width as i32);
        if rows == 0 || columns == 0 || grey.len() != bbox.width as usize * bbox.height as usize {
            return Ok(Self::default());
        }
        let image = Mat::new_rows_cols_with_bytes::<u8>(rows, columns, &grey).map_err(failed)?;
        let most = i32::try_from(params.max_features).unwrap_or(i32::MAX);
        let mut sift =
            SIFT::create(most, OCTAVE_LAYERS, params.contrast_threshold, EDGE_THRESHOLD, SIGMA_PX).map_err(failed)?;
        let (mut points, mut values) = (Vector::<KeyPoint>::new(), Mat::default());
        // The scale space is that of the whole box, but what lies beyond the mask gets no descriptor.
        match is_wanted {
            Some(is_wanted) => {
                let pixels = (0..bbox.height).flat_map(|y| (0..bbox.width).map(move |x| (x, y)));
                let mask: Vec<u8> = pixels.map(|(x, y)| if is_wanted(x, y) { 255 } else { 0 }).collect();
                let mask = Mat::new_rows_cols_with_bytes::<u8>(rows, columns, &mask).map_err(failed)?;
                sift.detect_and_compute(&image, &mask, &mut points, &mut values, false)
            }
            None => sift.detect_and_compute(&image, &no_array(), &mut points, &mut values, false),
        }
        .map_err(failed)?;
        let values = if values.empty() { &[][..] } else { values.data_typed::<f32>().map_err(failed)? };
        let mut found: Vec<(KeyPoint, &[f32])> = points.iter().zip(values.chunks_exact(LENGTH)).collect();
        found.retain(|(point, _)| point.size() > 0.0 && point.pt().x.is_finite() && point.pt().y.is_finite());
        // OpenCV keeps all that are as strong as the last.
        found.sort_by(|(a, _), (b, _)| b.response().total_cmp(&a.response()));
        found.truncate(params.max_features);
        let order = |point: &KeyPoint| [point.pt().y, point.pt().x, point.size(), point.angle()];
        found.sort_by(|(a, _), (b, _)| order(a).partial_cmp(&order(b)).unwrap_or(std::cmp::Ordering::Equal));
        Ok(Self {
            features: found.iter().map(|(point, _)| Feature::new(point)).collect(),
            descriptors: found.iter().map(|(_, row)| std::array::from_fn(|i| i16::from(row[i] as u8))).collect(),
        })
    }
}

impl Feature {
    fn new(point: &KeyPoint) -> Self {
        Self {
            at: [point.pt().x - TOO_FAR_PX, point.pt().y - TOO_FAR_PX],
            size_px: point.size(),
            angle_rad: point.angle().to_radians(),
        }
    }
}

/// Brightness of the pixels of a box.
fn grey(image: &RgbView<'_>, bbox: &BoundingBox) -> Vec<u8> {
    let columns = 3 * bbox.x as usize..3 * (bbox.x as usize + bbox.width as usize);
    let rows = image.as_raw().chunks_exact((3 * image.width() as usize).max(1));
    let rows = rows.skip(bbox.y as usize).take(bbox.height as usize);
    let pixels = rows.filter_map(|row| row.get(columns.clone())).flat_map(|row| row.chunks_exact(3));
    // Weights of BT.601, in 256ths.
    let brightness = |rgb: &[u8]| (77 * u32::from(rgb[0]) + 150 * u32::from(rgb[1]) + 29 * u32::from(rgb[2])) >> 8;
    pixels.map(|rgb| brightness(rgb) as u8).collect()
}

/// The features of the template of one part.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct SiftModel {
    features: Vec<Feature>,
    /// [`LENGTH`] numbers a feature.
    descriptors: Vec<u8>,
}

impl SiftModel {
    /// The features of a template on its part, those of its outline included.
    ///
    /// # Errors
    /// OpenCV failed. A template without features is no error: its part is never found.
    pub(crate) fn compute(template: &Template, params: &SiftParams) -> Result<Self, RecognizeError> {
        let (width, height) = template.image.dimensions();
        let Some(image) = RgbView::from_raw(width, height, template.image.as_raw().as_slice()) else {
            return Ok(Self::default());
        };
        let is_on_part = |x: u32, y: u32| {
            let rows = y.saturating_sub(OUTLINE_PX)..=y + OUTLINE_PX;
            let columns = x.saturating_sub(OUTLINE_PX)..=x + OUTLINE_PX;
            let is_set = |x, y| template.mask.get_pixel_checked(x, y).is_some_and(|pixel| pixel.0[0] > 127);
            rows.into_iter().any(|y| columns.clone().any(|x| is_set(x, y)))
        };
        let bbox = BoundingBox { x: 0, y: 0, width, height };
        let found = Features::find(&image, &bbox, params, Some(&is_on_part))?;
        let descriptors = found.descriptors.iter().flatten().map(|&value| value as u8).collect();
        Ok(Self { features: found.features, descriptors })
    }

    /// Number of features.
    pub(crate) fn features(&self) -> usize {
        self.features.len().min(self.descriptors.len() / LENGTH)
    }

    /// The features with descriptors as they are compared. What a damaged file holds too much of is left out.
    pub(crate) fn to_features(&self) -> Features {
        let of_row = |row: &[u8]| std::array::from_fn(|i| i16::from(row[i]));
        Features {
            features: self.features[..self.features()].to_vec(),
            descriptors: self.descriptors.chunks_exact(LENGTH).take(self.features()).map(of_row).collect(),
        }
    }
}
