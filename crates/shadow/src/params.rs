//! Parameters of the separation and their ranges.

use serde::{Deserialize, Serialize};

/// Which pixels of a region are the object.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum ObjectSide {
    /// The rule of the paper (section 4.1): of the two sides of one normalised cut of hue histograms, the one with the
    /// higher mean saliency.
    Paper,
    /// What tells a shadow from a dark part is asked of every piece.
    #[default]
    Evidence,
}

/// Parameters of the separation. Areas are in pixels of the image that is given.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct ShadowParams {
    /// `"evidence"` or `"paper"`.
    pub object_side: ObjectSide,
    /// Connected object pixels fewer than these are no object, px, at least 1. Without it, half of the squared
    /// default spatial bandwidth of the segmentation: two thirds of the smallest partition, so that a part whose
    /// border was nibbled at still counts.
    pub min_object_area_px: Option<u32>,
}

/// A parameter of the separation out of range.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{name} = {value}; allowed are {min} to {max}")]
pub struct ShadowParamError {
    /// Name of the parameter.
    pub name: &'static str,
    /// The value given.
    pub value: u32,
    /// The smallest value allowed.
    pub min: u32,
    /// The largest value allowed.
    pub max: u32,
}

impl ShadowParams {
    /// Checks every parameter.
    ///
    /// # Errors
    /// The first parameter out of range.
    pub fn check(&self) -> Result<(), ShadowParamError> {
        const MIN: u32 = 1;
        const MAX: u32 = u32::MAX;
        match self.min_object_area_px {
            Some(value) if !(MIN..=MAX).contains(&value) => {
                Err(ShadowParamError { name: "min_object_area_px", value, min: MIN, max: MAX })
            }
            _ => Ok(()),
        }
    }

    /// The minimum area of an object in an image of this size, px.
    pub fn min_object_area_for(&self, width: u32, height: u32) -> u32 {
        self.min_object_area_px.unwrap_or_else(|| {
            let bandwidth = (width.max(height) as f32 / 90.0).max(3.0);
            (bandwidth * bandwidth * 0.5) as u32
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_area_grows_with_the_frame() {
        let params = ShadowParams::default();
        assert_eq!(params.min_object_area_for(1078, 958), 71);
        assert_eq!(params.min_object_area_for(958, 1078), 71);
        assert_eq!(params.min_object_area_for(2 * 1078, 2 * 958), 286);
        assert_eq!(params.min_object_area_for(1, 1), 4);
        let fixed = ShadowParams { min_object_area_px: Some(7), ..params };
        assert_eq!(fixed.min_object_area_for(1078, 958), 7);
    }

    #[test]
    fn areas_out_of_range_are_named() {
        let error = ShadowParams { min_object_area_px: Some(0), ..ShadowParams::default() }.check().unwrap_err();
        assert_eq!(error.to_string(), "min_object_area_px = 0; allowed are 1 to 4294967295");
        assert_eq!(ShadowParams { min_object_area_px: Some(1), ..ShadowParams::default() }.check(), Ok(()));
        assert_eq!(ShadowParams::default().check(), Ok(()));
    }
}
