//! Parameters of the recognition and their ranges.

use serde::{Deserialize, Serialize};

/// Which matcher says what a part is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// Local features (section 5.1 of the paper). For parts with lettering or other texture.
    Sift,
    /// Shape context (section 5.2).
    Shape,
    /// Shape for every part, and SIFT where the texture tells more than the shape.
    #[default]
    Best,
}

/// Parameters of the recognition.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct RecognizeParams {
    /// `"sift"`, `"shape"` or `"best"`.
    pub method: Method,
    /// A part whose score is below this is `unknown`, in [0, 1].
    pub min_score: f32,
    /// A part that is not better than the next by so much is `unknown`, in [0, 1].
    pub min_margin: f32,
    /// Parameters of SIFT.
    pub sift: SiftParams,
}

impl Default for RecognizeParams {
    fn default() -> Self {
        Self { method: Method::default(), min_score: 0.5, min_margin: 0.0, sift: SiftParams::default() }
    }
}

/// Parameters of the feature matcher (section 5.1).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct SiftParams {
    /// Features of lower contrast are left out, above 0, at most 1.
    pub contrast_threshold: f64,
    /// A match counts when the second nearest descriptor is so many times as far as the nearest, at least 1.
    pub ratio: f32,
    /// Features of one object that are used, the strongest first; at least 4.
    pub max_features: usize,
    /// Matches that must agree on one pose, at least 4.
    pub min_inliers: usize,
    /// Whether fewer features may propose a part, which the edges of the frame then confirm or not. By them alone, as in
    /// section 5.1 of the paper, `"sift"` finds what has `min_inliers`; `"best"` asks the edges in any case.
    pub confirm: bool,
}

impl Default for SiftParams {
    fn default() -> Self {
        Self { contrast_threshold: 0.02, ratio: 1.5, max_features: 1000, min_inliers: 6, confirm: true }
    }
}

/// A parameter of the recognition out of range.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{name} = {value}; allowed are {min} to {max}")]
pub struct RecognizeParamError {
    /// Name of the parameter.
    pub name: &'static str,
    /// The value given.
    pub value: f64,
    /// The smallest value allowed.
    pub min: f64,
    /// The largest value allowed.
    pub max: f64,
}

impl RecognizeParams {
    /// Checks every parameter.
    ///
    /// # Errors
    /// The first parameter out of range.
    pub fn check(&self) -> Result<(), RecognizeParamError> {
        let within = |name, value: f64, min: f64, max: f64| {
            if (min..=max).contains(&value) { Ok(()) } else { Err(RecognizeParamError { name, value, min, max }) }
        };
        within("min_score", f64::from(self.min_score), 0.0, 1.0)?;
        within("min_margin", f64::from(self.min_margin), 0.0, 1.0)?;
        within("sift.contrast_threshold", self.sift.contrast_threshold, 1e-4, 1.0)?;
        within("sift.ratio", f64::from(self.sift.ratio), 1.0, 100.0)?;
        within("sift.max_features", self.sift.max_features as f64, 4.0, 100_000.0)?;
        within("sift.min_inliers", self.sift.min_inliers as f64, 4.0, 100_000.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_out_of_range_are_named() {
        assert_eq!(RecognizeParams::default().check(), Ok(()));
        let refused = |change: fn(&mut RecognizeParams)| {
            let mut params = RecognizeParams::default();
            change(&mut params);
            params.check().unwrap_err().to_string()
        };
        assert_eq!(refused(|p| p.min_score = 1.5), "min_score = 1.5; allowed are 0 to 1");
        assert_eq!(refused(|p| p.min_margin = f32::NAN), "min_margin = NaN; allowed are 0 to 1");
        assert_eq!(refused(|p| p.sift.min_inliers = 3), "sift.min_inliers = 3; allowed are 4 to 100000");
        assert_eq!(refused(|p| p.sift.ratio = 0.5), "sift.ratio = 0.5; allowed are 1 to 100");
    }
}
