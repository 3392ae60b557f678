//! How bright shadows and parts are against the table, and how far from its hue: two histograms of one scene.

use crate::table_model::{TableModel, level};

/// Steps of brightness, logarithmic between [`DARKEST`] and [`BRIGHTEST`] times the table's.
const BRIGHTNESS_BINS: usize = 24;
const DARKEST: f32 = 0.04;
const BRIGHTEST: f32 = 1.6;
/// Where the steps of the colour difference end, sRGB levels.
const DIFFERENCE_ENDS: [f32; 10] = [1.0, 2.0, 3.0, 4.5, 6.5, 9.0, 13.0, 18.0, 26.0, 40.0];
const DIFFERENCE_BINS: usize = DIFFERENCE_ENDS.len() + 1;
/// The middle of the last step, sRGB levels, is half of this and the end of the one before.
const LARGEST_DIFFERENCE: f32 = 80.0;

/// Colour differences of shadows: their standard deviation is so many times the median on the bare table, since a shadow
/// has less light and the tint of what stands beside it.
const SHADOW_NOISE_GAIN: f32 = 7.77;
/// And within these bounds, sRGB levels.
const SHADOW_NOISE: [f32; 2] = [0.8, 5.5];
/// Colour differences of parts fall off over so many sRGB levels.
const PART_SPREAD: f32 = 14.3;
/// On a grey table so many of the parts are as grey as it, whatever their difference in brightness;
const GREY_SHARE: f32 = 0.8;
/// on others fewer, falling off with this saturation of the table.
const GREY_SATURATION: f32 = 0.2;
/// Share of the parts as bright as the table that are not to be expected: they would not have been cut from it.
const ABSENT_AT_TABLE: f32 = 0.83;
/// Pixels that the expectation weighs in the histogram of shadows,
const SHADOW_PRIOR_PX: f32 = 652.0;
/// and in that of parts, which are of many kinds.
const PART_PRIOR_PX: f32 = 1556.0;

/// Largest logarithm of odds that a tone gives.
const LARGEST_ODDS: f32 = 1.94;

/// Values by brightness and colour difference.
pub(crate) type Tones = [[f32; DIFFERENCE_BINS]; BRIGHTNESS_BINS];

/// No values.
pub(crate) const NO_TONES: Tones = [[0.0; DIFFERENCE_BINS]; BRIGHTNESS_BINS];

/// A cell of [`Tones`].
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Tone {
    brightness: u8,
    difference: u8,
}

impl Tone {
    /// The cell of a brightness and a difference as [`against_table`](crate::table_model::against_table) gives them.
    pub(crate) fn of(brightness: f32, difference: f32) -> Self {
        let step = (brightness.max(1e-3) / DARKEST).ln() / (BRIGHTEST / DARKEST).ln() * BRIGHTNESS_BINS as f32;
        Self {
            brightness: step.clamp(0.0, BRIGHTNESS_BINS as f32 - 1.0) as u8,
            difference: DIFFERENCE_ENDS.partition_point(|&end| end < difference) as u8,
        }
    }

    /// The value of this cell.
    pub(crate) fn get(self, tones: &Tones) -> f32 {
        tones[self.brightness as usize][self.difference as usize]
    }

    /// Adds to this cell.
    pub(crate) fn add(self, tones: &mut Tones, value: f32) {
        tones[self.brightness as usize][self.difference as usize] += value;
    }
}

/// Spreads counts over neighbouring cells: pieces are few, and a tone is not exact.
pub(crate) fn spread(tones: &Tones) -> Tones {
    let last = BRIGHTNESS_BINS - 1;
    let over_brightness: Tones = std::array::from_fn(|i| {
        let (below, above) = (&tones[i.saturating_sub(1)], &tones[(i + 1).min(last)]);
        std::array::from_fn(|j| 0.25 * below[j] + 0.5 * tones[i][j] + 0.25 * above[j])
    });
    over_brightness.map(|row| {
        std::array::from_fn(|j| {
            0.12 * row[j.saturating_sub(1)] + 0.76 * row[j] + 0.12 * row[(j + 1).min(DIFFERENCE_BINS - 1)]
        })
    })
}

/// What is expected of shadows and parts before any has been seen, on this table.
#[derive(Debug)]
pub(crate) struct Expectation {
    shadow: Tones,
    part: Tones,
}

impl Expectation {
    /// `table_color` is the table's mean colour in linear light, `table_width` the spread of its brightness.
    pub(crate) fn on(table: &TableModel, table_color: [f32; 3], table_width: f32) -> Self {
        let levels = table_color.map(level);
        let (high, low) = (levels.iter().copied().fold(0.0, f32::max), levels.iter().copied().fold(f32::MAX, f32::min));
        let saturation = (high - low) / high.max(1.0);
        let grey = GREY_SHARE * (-(saturation / GREY_SATURATION).powi(2)).exp();

        let start = |j: usize| if j == 0 { 0.0 } else { DIFFERENCE_ENDS[j - 1] };
        let end = |j: usize| DIFFERENCE_ENDS.get(j).copied().unwrap_or(LARGEST_DIFFERENCE);
        let over_difference = |density: &dyn Fn(f32) -> f32| -> [f32; DIFFERENCE_BINS] {
            normalized(std::array::from_fn(|j| (end(j) - start(j)) * density((start(j) + end(j)) / 2.0)))
        };
        let noise = (SHADOW_NOISE_GAIN * table.color_noise).clamp(SHADOW_NOISE[0], SHADOW_NOISE[1]);
        // The tail: light that parts throw on the shadow beside them.
        let shadow_difference = over_difference(&|d| (-0.5 * (d / noise).powi(2)).exp() + 1e-3);
        let part_difference = over_difference(&|d| 1.0 / (1.0 + d / PART_SPREAD));
        let part_difference: [f32; DIFFERENCE_BINS] =
            std::array::from_fn(|j| (1.0 - grey) * part_difference[j] + grey * shadow_difference[j]);

        let brightness: [f32; BRIGHTNESS_BINS] =
            std::array::from_fn(|i| DARKEST * (BRIGHTEST / DARKEST).powf((i as f32 + 0.5) / BRIGHTNESS_BINS as f32));
        let at_table = brightness.map(|b| (-0.5 * ((b - 1.0) / table_width.max(0.08)).powi(2)).exp());
        // Shadows are of any darkness; what is not object is table too, and nothing of that is brighter.
        let shadow_brightness: [f32; BRIGHTNESS_BINS] = normalized(std::array::from_fn(|i| {
            if brightness[i] < 0.9 { 1.0 + 1.5 * at_table[i] } else { 0.02 + 1.5 * at_table[i] }
        }));
        let any_part: [f32; BRIGHTNESS_BINS] = normalized(std::array::from_fn(|i| {
            (1.0 - ABSENT_AT_TABLE * at_table[i]) * if brightness[i] > 1.1 { 2.0 } else { 1.0 }
        }));
        // Darkness alone tells nothing until shadows have been seen.
        let part_brightness: [f32; BRIGHTNESS_BINS] =
            normalized(std::array::from_fn(|i| if brightness[i] < 0.8 { shadow_brightness[i] } else { any_part[i] }));
        Self {
            shadow: shadow_brightness.map(|b| shadow_difference.map(|d| b * d)),
            part: part_brightness.map(|b| part_difference.map(|d| b * d)),
        }
    }

    /// The logarithm of the odds that a tone is a part's, by what was expected and the pixels that were seen.
    pub(crate) fn odds_with(&self, seen_shadow: &Tones, seen_part: &Tones) -> Tones {
        let shadow = mixed(&spread(seen_shadow), &self.shadow, SHADOW_PRIOR_PX);
        let part = mixed(&spread(seen_part), &self.part, PART_PRIOR_PX);
        std::array::from_fn(|i| {
            std::array::from_fn(|j| {
                (part[i][j].max(1e-12) / shadow[i][j].max(1e-12)).ln().clamp(-LARGEST_ODDS, LARGEST_ODDS)
            })
        })
    }
}

fn normalized<const N: usize>(values: [f32; N]) -> [f32; N] {
    let sum: f32 = values.iter().sum();
    values.map(|v| v / sum)
}

/// Shares of counts and a prior that weighs so many of them.
fn mixed(counts: &Tones, prior: &Tones, weight: f32) -> Tones {
    let total = counts.iter().flatten().sum::<f32>() + weight;
    std::array::from_fn(|i| std::array::from_fn(|j| (counts[i][j] + weight * prior[i][j]) / total))
}

#[cfg(test)]
mod tests {
    use super::*;

    const GREY: [f32; 3] = [0.2; 3];
    const BLUE: [f32; 3] = [0.02, 0.05, 0.2];

    fn table() -> TableModel {
        let mut table = TableModel::default();
        table.color_noise = 0.6;
        table
    }

    fn odds(table_color: [f32; 3], seen_shadow: &Tones, seen_part: &Tones, brightness: f32, difference: f32) -> f32 {
        let expectation = Expectation::on(&table(), table_color, 0.04);
        Tone::of(brightness, difference).get(&expectation.odds_with(seen_shadow, seen_part))
    }

    #[test]
    fn another_hue_than_the_tables_is_a_part() {
        for table_color in [GREY, BLUE] {
            assert!(odds(table_color, &NO_TONES, &NO_TONES, 0.4, 30.0) > 1.0);
            assert!(odds(table_color, &NO_TONES, &NO_TONES, 1.3, 30.0) > 1.0);
        }
    }

    #[test]
    fn the_hue_of_the_table_is_shadow_on_a_coloured_table_and_says_little_on_a_grey_one() {
        let (coloured, grey) = (odds(BLUE, &NO_TONES, &NO_TONES, 0.4, 1.0), odds(GREY, &NO_TONES, &NO_TONES, 0.4, 1.0));
        assert!(coloured < -1.5, "{coloured}");
        assert!(grey > -0.5 && grey < 0.5, "{grey}");
        assert!(odds(GREY, &NO_TONES, &NO_TONES, 1.0, 0.5) < -1.0, "table");
        assert!(odds(GREY, &NO_TONES, &NO_TONES, 1.4, 0.5) > 1.0, "brighter than the table");
    }

    #[test]
    fn a_darkness_that_shadows_of_the_scene_had_is_shadow_and_another_is_not() {
        let mut seen = NO_TONES;
        Tone::of(0.2, 1.0).add(&mut seen, 5000.0);
        assert!(odds(GREY, &seen, &NO_TONES, 0.2, 1.0) < -1.0);
        assert!(odds(GREY, &seen, &NO_TONES, 0.5, 1.0) > 1.0);
    }

    #[test]
    fn spreading_keeps_the_sum() {
        let mut tones = NO_TONES;
        Tone::of(0.0, 100.0).add(&mut tones, 3.0);
        Tone::of(f32::INFINITY, 0.0).add(&mut tones, 2.0);
        Tone::of(0.3, 5.0).add(&mut tones, 1.0);
        let sum: f32 = spread(&tones).iter().flatten().sum();
        assert!((sum - 6.0).abs() < 1e-4);
        assert_eq!(Tone::of(0.3, 5.0).get(&tones), 1.0);
    }
}
