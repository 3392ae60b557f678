//! Parameters of the segmentation and their ranges.

use serde::{Deserialize, Serialize};

/// Parameters of the mean shift and of the partitions. Lengths are in pixels of the image that is given.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct SegmentParams {
    /// Radius of the flat kernel in the image plane, px, 1 to 1000. Without it, a ninetieth of the longer side, but at least 3.
    pub spatial_bandwidth_px: Option<f32>,
    /// Radius of the flat kernel in colour, levels of 255, 1 to 255, on a table without noise or texture.
    pub range_bandwidth: f32,
    /// How much the noise and texture of the table widen the range bandwidth, in standard deviations of the colour
    /// within small blocks, 0 to 10. The bandwidth along a direction of colour is
    /// `sqrt(range_bandwidth^2 + (texture_gain * deviation)^2)`; 0 keeps it the same everywhere.
    pub texture_gain: f32,
    /// Partitions with fewer pixels are joined to the neighbour closest in colour. Without it, three quarters of the
    /// squared spatial bandwidth.
    pub min_area_px: Option<u32>,
    /// Where a shadow fades out: the share of its light, 0.5 to 1, from which on the table is table. 1 leaves every penumbra where
    /// the mean shift puts it.
    pub penumbra_light: f32,
}

impl Default for SegmentParams {
    fn default() -> Self {
        Self {
            spatial_bandwidth_px: None,
            range_bandwidth: 4.0,
            texture_gain: 3.0,
            min_area_px: None,
            penumbra_light: 0.8,
        }
    }
}

/// A segmentation parameter out of range.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{name} = {value}; allowed are {min} to {max}")]
pub struct SegmentParamError {
    /// Name of the parameter.
    pub name: &'static str,
    /// The value given.
    pub value: f32,
    /// The smallest value allowed.
    pub min: f32,
    /// The largest value allowed.
    pub max: f32,
}

impl SegmentParams {
    /// For still photos of this size instead of a robot cell.
    ///
    /// What repeats all over a photo is no table: its texture does not widen the bandwidth, so that objects and background
    /// stay apart, and the range bandwidth is wider instead; and no light on it is known.
    /// Fragments below 40 px of an image of 256 px are joined.
    pub fn photo(width: u32, height: u32) -> Self {
        let scale = width.max(height) as f32 / 256.0;
        let min_area_px = Some((40.0 * scale * scale) as u32);
        Self { range_bandwidth: 16.0, texture_gain: 0.0, min_area_px, penumbra_light: 1.0, ..Self::default() }
    }

    /// Checks every parameter.
    ///
    /// # Errors
    /// The first parameter that is NaN or out of range.
    pub fn check(&self) -> Result<(), SegmentParamError> {
        let within = |name, value: f32, min: f32, max: f32| {
            // NaN is in no range.
            if (min..=max).contains(&value) { Ok(()) } else { Err(SegmentParamError { name, value, min, max }) }
        };
        if let Some(px) = self.spatial_bandwidth_px {
            within("spatial_bandwidth_px", px, 1.0, 1000.0)?;
        }
        within("range_bandwidth", self.range_bandwidth, 1.0, 255.0)?;
        within("texture_gain", self.texture_gain, 0.0, 10.0)?;
        within("penumbra_light", self.penumbra_light, 0.5, 1.0)
    }

    /// The spatial bandwidth for an image of this size, px.
    pub(crate) fn spatial_bandwidth_for(&self, width: u32, height: u32) -> f32 {
        self.spatial_bandwidth_px.unwrap_or_else(|| (width.max(height) as f32 / 90.0).max(3.0))
    }

    /// The minimum area for an image of this size, px.
    pub(crate) fn min_area_for(&self, width: u32, height: u32) -> u32 {
        self.min_area_px.unwrap_or_else(|| {
            let bandwidth = self.spatial_bandwidth_for(width, height);
            (bandwidth * bandwidth * 0.75) as u32
        })
    }
}
