//! What a frame says of white balance and exposure.
//!
//! Input: a frame as RGB in which the table takes more than half of the pixels. Output: the gains that would make the table grey, and
//! whether the exposure fits. Cost: linear in pixels; some milliseconds for 1 Mpx.
//!
//! The table is what the middle of the levels shows: the median of each channel is a level of the table as long as parts and shadows
//! cover less than half of the picture, however bright or dark they are. Levels are taken for proportional to light, as industrial
//! cameras deliver them.

use std::fmt;

use samsod_frame::RgbView;

/// Levels from this one on may stand for any amount of light.
const SATURATED: usize = 254;
/// Levels up to this one tell next to nothing of the light.
const BLACK: usize = 4;
/// Where the brightest pixels should be, but for the few that shine.
const TARGET: f64 = 230.0;
/// Share of the pixels that may shine: screws and edges do, whatever the exposure.
const SHINING: f64 = 0.01;
/// Below this share of the target an exposure is called too short: noise would be several times what it could be.
const DIM: f64 = 0.5;
/// Distance of the gains from 1 from which on it is worth a word.
const GAIN_TOLERANCE: f64 = 0.05;

/// How the exposure is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Exposure {
    /// Nothing to do.
    Fits,
    /// Too much light by this factor, above 1. At least: what is saturated does not tell by how much.
    TooLong {
        /// Factor by which the exposure should be divided.
        at_least: f64,
    },
    /// Too little light by this factor, above 1.
    TooShort {
        /// Factor by which the exposure may be multiplied.
        by: f64,
    },
}

/// What could be better about the settings of a camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Advice {
    /// Median level of red, green and blue, 0 to 255: the table.
    pub table: [u8; 3],
    /// Factors on red and blue, green left as it is, that make the table grey. 1 where the table is too dark or too bright to tell.
    pub gains: [f64; 2],
    /// Share of the pixels with a saturated channel, 0 to 1.
    pub saturated: f64,
    /// Share of the pixels that are black in all channels, 0 to 1.
    pub black: f64,
    /// How the exposure is.
    pub exposure: Exposure,
}

/// Why there is no advice.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum AdviceError {
    /// There is no pixel.
    #[error("a frame of {width} x {height} px has no pixels to look at")]
    Empty {
        /// Width, px.
        width: u32,
        /// Height, px.
        height: u32,
    },
}

impl Advice {
    /// Looks at a frame.
    ///
    /// ```
    /// use samsod_camera_client::{Advice, Exposure};
    /// let reddish = [200, 160, 80].repeat(64);
    /// let advice = Advice::of(&samsod_frame::RgbView::from_raw(8, 8, &reddish).ok_or("size")?)?;
    /// assert_eq!(advice.gains, [0.8, 2.0]);
    /// assert_eq!(advice.exposure, Exposure::Fits);
    /// # Ok::<(), Box<dyn std::error::Error>>(())
    /// ```
    ///
    /// # Errors
    /// [`AdviceError::Empty`].
    pub fn of(frame: &RgbView<'_>) -> Result<Self, AdviceError> {
        let (width, height) = frame.dimensions();
        if width == 0 || height == 0 {
            return Err(AdviceError::Empty { width, height });
        }
        let mut levels = [[0_u64; 256]; 3];
        let mut brightest = [0_u64; 256];
        for px in frame.as_raw().chunks_exact(3) {
            for (channel, level) in px.iter().enumerate() {
                levels[channel][usize::from(*level)] += 1;
            }
            brightest[usize::from(px[0].max(px[1]).max(px[2]))] += 1;
        }
        let pixels = f64::from(width) * f64::from(height);
        let table = levels.map(|levels| level_at(&levels, 0.5));
        let saturated = brightest[SATURATED..].iter().sum::<u64>() as f64 / pixels;
        let black = brightest[..=BLACK].iter().sum::<u64>() as f64 / pixels;
        let tells = table.iter().all(|level| (BLACK + 1..SATURATED).contains(&usize::from(*level)));
        let [red, green, blue] = table.map(f64::from);
        let gains = if tells { [green / red, green / blue] } else { [1.0, 1.0] };
        Ok(Self { table, gains, saturated, black, exposure: exposure(&brightest) })
    }
}

/// Smallest level that at least this share of the pixels does not exceed.
fn level_at(levels: &[u64; 256], share: f64) -> u8 {
    let all = levels.iter().sum::<u64>();
    let mut below = 0;
    for (level, count) in (0..=u8::MAX).zip(levels) {
        below += count;
        if below as f64 >= share * all as f64 {
            return level;
        }
    }
    u8::MAX
}

fn exposure(brightest: &[u64; 256]) -> Exposure {
    let nearly_brightest = level_at(brightest, 1.0 - SHINING);
    // Black as it is, at least one level: a lens cap says "much too short", not infinity.
    let level = f64::from(nearly_brightest.max(1));
    if usize::from(nearly_brightest) >= SATURATED {
        Exposure::TooLong { at_least: level / TARGET }
    } else if level < DIM * TARGET {
        Exposure::TooShort { by: TARGET / level }
    } else {
        Exposure::Fits
    }
}

impl fmt::Display for Advice {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [red, green, blue] = self.table;
        write!(f, "table at red {red}, green {green}, blue {blue}")?;
        match self.gains {
            [red, blue] if (red - 1.0).abs() < GAIN_TOLERANCE && (blue - 1.0).abs() < GAIN_TOLERANCE => {}
            [red, blue] => write!(f, "; grey with red x {red:.2}, blue x {blue:.2}")?,
        }
        let (saturated, black) = (100.0 * self.saturated, 100.0 * self.black);
        write!(f, "; {saturated:.1} % saturated, {black:.1} % black")?;
        match self.exposure {
            Exposure::Fits => Ok(()),
            Exposure::TooLong { at_least } => write!(f, "; exposure too long by a factor of at least {at_least:.1}"),
            Exposure::TooShort { by } => write!(f, "; exposure too short by a factor of {by:.1}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn advice(pixels: &[[u8; 3]]) -> Advice {
        let raw = pixels.as_flattened();
        Advice::of(&RgbView::from_raw(pixels.len() as u32, 1, raw).unwrap()).unwrap()
    }

    #[test]
    fn parts_do_not_change_what_the_table_is() {
        // 60 % table, the rest a red part and its shadow.
        let pixels = [vec![[120, 100, 80]; 60], vec![[220, 10, 10]; 25], vec![[30, 25, 20]; 15]].concat();
        let advice = advice(&pixels);
        assert_eq!(advice.table, [120, 100, 80]);
        assert!(
            (advice.gains[0] - 100.0 / 120.0).abs() < 1e-12 && (advice.gains[1] - 1.25).abs() < 1e-12,
            "{advice:?}"
        );
        let gained = [120.0 * advice.gains[0], 80.0 * advice.gains[1]];
        assert!(gained.iter().all(|level| (level - 100.0).abs() < 1e-9), "the table is grey: {gained:?}");
        assert_eq!(advice.exposure, Exposure::Fits);
        let text = advice.to_string();
        assert_eq!(
            text,
            "table at red 120, green 100, blue 80; grey with red x 0.83, blue x 1.25; 0.0 % saturated, 0.0 % black"
        );
    }

    #[test]
    fn a_few_shining_pixels_are_no_fault() {
        let pixels = [vec![[140; 3]; 991], vec![[255; 3]; 9]].concat();
        let advice = advice(&pixels);
        assert_eq!(advice.exposure, Exposure::Fits);
        assert!((advice.saturated - 0.009).abs() < 1e-12);
    }

    #[test]
    fn too_long_and_too_short() {
        let bright = advice(&[vec![[120; 3]; 80], vec![[255, 200, 90]; 20]].concat());
        assert_eq!(bright.exposure, Exposure::TooLong { at_least: 255.0 / 230.0 });
        assert!((bright.saturated - 0.2).abs() < 1e-12, "one channel suffices");
        assert!(
            bright
                .to_string()
                .ends_with("20.0 % saturated, 0.0 % black; exposure too long by a factor of at least 1.1")
        );

        let dim = advice(&[[46; 3]; 50]);
        assert_eq!(dim.exposure, Exposure::TooShort { by: 5.0 });
        let dark = advice(&[[0; 3]; 50]);
        assert_eq!((dark.exposure, dark.black, dark.gains), (Exposure::TooShort { by: 230.0 }, 1.0, [1.0, 1.0]));
        // Saturated in one channel: how much blue there is cannot be told, so no gain is advised.
        assert_eq!(advice(&[[100, 120, 255]; 50]).gains, [1.0, 1.0]);
    }

    #[test]
    fn no_pixels_no_advice() {
        let empty = RgbView::from_raw(0, 0, &[][..]).unwrap();
        assert_eq!(Advice::of(&empty), Err(AdviceError::Empty { width: 0, height: 0 }));
    }
}
