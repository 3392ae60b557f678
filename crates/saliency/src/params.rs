//! Parameters of the saliency: which scales, which method.

use serde::{Deserialize, Serialize};

/// How the saliency is evaluated.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// Coarse nodes and interpolation; within some thousandths of `Exact`, hundreds of times faster.
    #[default]
    Fast,
    /// Every pixel by itself; the reference.
    Exact,
}

/// What makes a pixel salient.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "lowercase")]
pub enum Variant {
    /// The paper's multi-scale centre-surround contrast (eqs 2 to 14): the default of a robot cell, where parts of known
    /// size lie on a table.
    #[default]
    Paper,
    /// The same, averaged over every partition.
    Averaged,
    /// Distance from the border of the image on the way of least colour change, and unlikeness to the border's colours: the
    /// default for still photos. One value a partition; 0.5 parts background from objects.
    Background,
    /// `Background` with a preference for the centre of the image.
    Centred,
}

impl Variant {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Paper, Self::Averaged, Self::Background, Self::Centred];

    /// The name in configurations.
    pub fn name(self) -> &'static str {
        match self {
            Self::Paper => "paper",
            Self::Averaged => "averaged",
            Self::Background => "background",
            Self::Centred => "centred",
        }
    }

    /// Whether it has centre and surround scales.
    pub fn has_scales(self) -> bool {
        matches!(self, Self::Paper | Self::Averaged)
    }
}

/// Standard deviations of the centre and surround Gaussians.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Scales {
    /// {3, 5, 7} and {19, 23, 29} px for a longer side of 256 px, scaled with the image (section 6.1).
    #[default]
    Generic,
    /// Given in pixels of the image.
    Pixels {
        /// Centre deviations sigma_k, px.
        center_px: Vec<f32>,
        /// Surround deviations sigma_t, px; every one larger than every centre.
        surround_px: Vec<f32>,
    },
    /// Expected diameters of the objects, px: a third of each is a centre deviation, beside one below a pixel; the
    /// surround is one above a third of the longer side (section 3.1).
    #[serde(rename = "object_sizes_px")]
    ObjectSizes(Vec<f32>),
}

/// Parameters of the saliency.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct SaliencyParams {
    /// `"paper"`, `"averaged"`, `"background"` or `"centred"`.
    pub variant: Variant,
    /// `"fast"` or `"exact"`; of `paper` and `averaged` only, the others have one way.
    pub method: Method,
    /// The scales of `paper` and `averaged`; the others have none.
    pub scales: Scales,
}

/// A saliency parameter out of range.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SaliencyParamError {
    /// A length is NaN, not positive or absurdly large.
    #[error("{name} = {value} px; allowed are {min} to {max} px")]
    Length {
        /// Which length.
        name: &'static str,
        /// The value given.
        value: f32,
        /// Smallest value allowed.
        min: f32,
        /// Largest value allowed.
        max: f32,
    },
    /// A list of scales has no or too many entries.
    #[error("{name} has {count} entries; allowed are 1 to {max}")]
    Count {
        /// Which list.
        name: &'static str,
        /// Number of entries given.
        count: usize,
        /// Largest number allowed.
        max: usize,
    },
    /// Scales are given to a variant that has none.
    #[error("variant \"{}\" has no scales; allowed with scales are \"paper\" and \"averaged\"", variant.name())]
    NoScales {
        /// The variant.
        variant: Variant,
    },
    /// A surround is not larger than a centre (eq 12 asks for sigma_t > sigma_k).
    #[error("surround scale {surround} px is not larger than center scale {center} px")]
    Order {
        /// The largest centre deviation, px.
        center: f32,
        /// The smallest surround deviation, px.
        surround: f32,
    },
}

/// Most entries of a list of scales.
const MAX_SCALES: usize = 16;

impl SaliencyParams {
    /// Checks every parameter.
    ///
    /// # Errors
    /// The first parameter out of range.
    pub fn check(&self) -> Result<(), SaliencyParamError> {
        if !self.variant.has_scales() && self.scales != Scales::Generic {
            return Err(SaliencyParamError::NoScales { variant: self.variant });
        }
        match &self.scales {
            Scales::Generic => Ok(()),
            Scales::Pixels { center_px, surround_px } => {
                check_list("center_px", center_px, 0.1, 10_000.0)?;
                check_list("surround_px", surround_px, 0.1, 10_000.0)?;
                let largest = center_px.iter().copied().fold(0.0, f32::max);
                let smallest = surround_px.iter().copied().fold(f32::INFINITY, f32::min);
                if smallest > largest {
                    Ok(())
                } else {
                    Err(SaliencyParamError::Order { center: largest, surround: smallest })
                }
            }
            Scales::ObjectSizes(sizes) => check_list("object_sizes_px", sizes, 1.0, 16_384.0),
        }
    }

    /// Centre and surround deviations for an image of this size, px, ascending.
    pub(crate) fn deviations(&self, width: u32, height: u32) -> (Vec<f32>, Vec<f32>) {
        let longer = width.max(height) as f32;
        match &self.scales {
            Scales::Generic => {
                let scale = longer / 256.0;
                ([3.0, 5.0, 7.0].map(|s| s * scale).to_vec(), [19.0, 23.0, 29.0].map(|s| s * scale).to_vec())
            }
            Scales::Pixels { center_px, surround_px } => (sorted(center_px.clone()), sorted(surround_px.clone())),
            Scales::ObjectSizes(sizes) => {
                // An object as large as the image has no surround: its scale stays below that of the gist.
                let gist = longer * 0.35;
                let mut center: Vec<f32> = sizes.iter().map(|s| (s / 3.0).min(gist * 0.9)).collect();
                center.push(0.7);
                (sorted(center), vec![gist])
            }
        }
    }
}

fn sorted(mut deviations: Vec<f32>) -> Vec<f32> {
    deviations.sort_unstable_by(f32::total_cmp);
    deviations
}

fn check_list(name: &'static str, list: &[f32], min: f32, max: f32) -> Result<(), SaliencyParamError> {
    if list.is_empty() || list.len() > MAX_SCALES {
        return Err(SaliencyParamError::Count { name, count: list.len(), max: MAX_SCALES });
    }
    match list.iter().find(|v| !(min..=max).contains(*v)) {
        Some(&value) => Err(SaliencyParamError::Length { name, value, min, max }),
        None => Ok(()),
    }
}
