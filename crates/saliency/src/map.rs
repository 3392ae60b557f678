//! The saliency map.

/// Saliency S of every pixel, in [0, 1], row by row.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SaliencyMap {
    pub(crate) width: u32,
    pub(crate) height: u32,
    pub(crate) values: Vec<f32>,
}

/// Why numbers are not a saliency map.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum MapError {
    /// Number of values and size disagree.
    #[error("{values} values for a map of {width} x {height} = {pixels} pixels")]
    Size {
        /// Number of values given.
        values: usize,
        /// Width, px.
        width: u32,
        /// Height, px.
        height: u32,
        /// Width times height.
        pixels: usize,
    },
    /// A value is NaN or outside [0, 1].
    #[error("saliency {value} at pixel ({x}, {y}); allowed are 0 to 1")]
    Value {
        /// The value.
        value: f32,
        /// Its column.
        x: usize,
        /// Its row.
        y: usize,
    },
}

impl SaliencyMap {
    /// Takes `width * height` values in [0, 1], row by row.
    ///
    /// # Errors
    /// [`MapError`] for a wrong number of values or one out of range.
    pub fn from_values(width: u32, height: u32, values: Vec<f32>) -> Result<Self, MapError> {
        let pixels = width as usize * height as usize;
        if values.len() != pixels {
            return Err(MapError::Size { values: values.len(), width, height, pixels });
        }
        if let Some(i) = values.iter().position(|v| !(0.0..=1.0).contains(v)) {
            let (x, y) = (i % width as usize, i / width as usize);
            return Err(MapError::Value { value: values[i], x, y });
        }
        Ok(Self { width, height, values })
    }

    /// Width, px.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Height, px.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// S of every pixel, row by row.
    pub fn values(&self) -> &[f32] {
        &self.values
    }
}
