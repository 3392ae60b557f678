//! What the table looks like where nothing lies on it: its colour at every place, and how much it varies.
//!
//! Light falls off towards the corners and lamps make pools, so the table has no one colour. The mean colour of
//! the background is taken in cells of 16 x 16 pixels, in linear light, and carried over the cells that regions cover
//! from coarser and coarser means.

use std::iter;
use std::ops::Range;
use std::sync::LazyLock;

use rayon::prelude::*;

use crate::separator::Input;

/// Side of a cell, px.
const CELL_PX: usize = 16;
/// Every so many pixels of every so many rows one is read: neighbours say the same.
const STRIDE_PX: [usize; 2] = [2, 4];
/// Side of the squares on which the variation is measured, px: about the size of the pieces that are judged.
const SQUARE_PX: usize = 5;

/// Linear light in [0, 1] of every 8-bit sRGB level (IEC 61966-2-1).
static LINEAR: LazyLock<[f32; 256]> = LazyLock::new(|| {
    std::array::from_fn(|level| {
        let v = level as f32 / 255.0;
        if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
    })
});

/// Linear light in [0, 1] of every 8-bit sRGB level.
pub(crate) fn linear_table() -> &'static [f32; 256] {
    &LINEAR
}

/// Steps of [`LEVELS`].
const LEVEL_STEPS: usize = 2048;
/// Light above this counts as this.
const MOST_LIGHT: f32 = 1.2;

/// sRGB levels at equal steps of the root of linear light, from 0 to that of [`MOST_LIGHT`].
static LEVELS: LazyLock<[f32; LEVEL_STEPS + 1]> = LazyLock::new(|| {
    std::array::from_fn(|step| {
        let v = (step as f32 / LEVEL_STEPS as f32).powi(2) * MOST_LIGHT;
        255.0 * if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 }
    })
});

/// The sRGB level, in 0..=255 without rounding, of linear light. From a table: tens of thousands a frame are asked for.
/// Over the root of the light levels are so nearly straight that interpolation is off by less than a thousandth.
pub(crate) fn level(linear: f32) -> f32 {
    let place = (linear.clamp(0.0, MOST_LIGHT) / MOST_LIGHT).sqrt() * LEVEL_STEPS as f32;
    let below = (place as usize).min(LEVEL_STEPS - 1);
    let (low, high) = (LEVELS[below], LEVELS[below + 1]);
    low + (high - low) * (place - below as f32)
}

/// Brightness of a colour against the table's, and what is left of the difference: `(b, d)`. `b` is the factor by which
/// the light on the table would have to change (least squares in linear light), `d` the largest difference in any channel
/// to the table under that light, in sRGB levels, which noise of the camera spreads alike at all brightnesses.
pub(crate) fn against_table(color: [f32; 3], table: [f32; 3]) -> (f32, f32) {
    let brightness = brightness(color, table);
    (brightness, largest(levels_apart(color.map(level), table, brightness)))
}

/// The factor by which the light on the table would have to change, as [`against_table`] has it.
pub(crate) fn brightness(color: [f32; 3], table: [f32; 3]) -> f32 {
    let dot = |a: [f32; 3], b: [f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    dot(color, table) / dot(table, table).max(1e-9)
}

/// How far sRGB levels are from those of the table under that light.
pub(crate) fn levels_apart(levels: [f32; 3], table: [f32; 3], brightness: f32) -> [f32; 3] {
    std::array::from_fn(|c| levels[c] - level(brightness * table[c]))
}

/// The largest of three differences, whatever their signs.
pub(crate) fn largest(apart: [f32; 3]) -> f32 {
    apart.into_iter().map(f32::abs).fold(0.0, f32::max)
}

/// Sums of linear light and the number of pixels.
#[derive(Debug, Clone, Copy, Default)]
struct Sum {
    color: [f32; 3],
    count: f32,
}

/// The table under everything that lies on it.
#[derive(Debug, Default)]
pub(crate) struct TableModel {
    columns: usize,
    rows: usize,
    colors: Vec<[f32; 3]>,
    /// Standard deviation of `b` over the bare table (texture and noise), robustly.
    pub(crate) brightness_spread: f32,
    /// Median of `d` over the bare table, sRGB levels.
    pub(crate) color_noise: f32,
}

impl TableModel {
    /// Measures the table on the pixels that no region has, and where no shadow fades out. Without any the table is mid-grey.
    pub(crate) fn measure(&mut self, input: &Input<'_>) {
        let (width, height) = (input.partition.width() as usize, input.partition.height() as usize);
        self.columns = width.div_ceil(CELL_PX).max(1);
        self.rows = height.div_ceil(CELL_PX).max(1);
        let columns = self.columns;
        let pixels = input.frame.as_raw();
        let free: Vec<bool> = (0..input.partition.len() as u32).map(|label| input.owners.of(label).is_none()).collect();
        let lut = linear_table();
        let mut sums = vec![Sum::default(); columns * self.rows];
        sums.par_chunks_exact_mut(columns).enumerate().for_each(|(row, cells)| {
            for y in (row * CELL_PX..((row + 1) * CELL_PX).min(height)).step_by(STRIDE_PX[1]) {
                let line = pixels[3 * y * width..3 * (y + 1) * width].as_chunks::<3>().0;
                let faded = || input.partition.penumbrae(y as u32);
                for run in input.partition.runs().row(y).iter().filter(|run| free[run.label as usize]) {
                    // The stretches of the run between those where a shadow fades out.
                    let starts = iter::once(run.start).chain(faded().map(|faded| faded.end.clamp(run.start, run.end)));
                    let ends = faded().map(|faded| faded.start.clamp(run.start, run.end)).chain(iter::once(run.end));
                    for (start, end) in starts.zip(ends).map(|(start, end)| (start as usize, end as usize)) {
                        add_stretch(cells, line, start..end, lut);
                    }
                }
            }
        });
        self.colors = filled(&sums, columns, self.rows);
        self.measure_variation(input, &free);
    }

    fn measure_variation(&mut self, input: &Input<'_>, free: &[bool]) {
        let (width, height) = (input.partition.width() as usize, input.partition.height() as usize);
        let (labels, pixels, lut) = (input.partition.labels(), input.frame.as_raw(), linear_table());
        let rows: Vec<usize> = (0..height.saturating_sub(SQUARE_PX)).step_by(CELL_PX).collect();
        let squares: Vec<Vec<(f32, f32)>> = rows
            .par_iter()
            .map(|&y0| {
                let fades = |x: usize, y: usize| input.partition.fades_from(x as u32, y as u32);
                let is_free = |x: usize, y: usize| free[labels[y * width + x] as usize] && fades(x, y).is_none();
                let end = SQUARE_PX - 1;
                (0..width.saturating_sub(SQUARE_PX))
                    .step_by(CELL_PX)
                    .filter(|&x0| {
                        let corners = [(x0, y0), (x0 + end, y0), (x0, y0 + end), (x0 + end, y0 + end)];
                        corners.into_iter().all(|(x, y)| is_free(x, y))
                    })
                    .map(|x0| {
                        let mut sum = [0.0; 3];
                        for y in y0..y0 + SQUARE_PX {
                            for p in pixels[3 * (y * width + x0)..3 * (y * width + x0 + SQUARE_PX)].as_chunks::<3>().0 {
                                sum = std::array::from_fn(|c| sum[c] + lut[p[c] as usize]);
                            }
                        }
                        let mean = sum.map(|s| s / (SQUARE_PX * SQUARE_PX) as f32);
                        let half = SQUARE_PX as f32 / 2.0;
                        let (b, d) = against_table(mean, self.color_at(x0 as f32 + half, y0 as f32 + half));
                        ((b - 1.0).abs(), d)
                    })
                    .collect()
            })
            .collect();
        let (mut brightness, mut rest): (Vec<f32>, Vec<f32>) = squares.into_iter().flatten().unzip();
        self.brightness_spread = (1.4826 * median(&mut brightness) + 0.005).max(0.015);
        self.color_noise = median(&mut rest);
    }

    /// Colour of the table at a place in the image, linear light.
    pub(crate) fn color_at(&self, x: f32, y: f32) -> [f32; 3] {
        bilinear(
            &self.colors,
            self.columns,
            self.rows,
            (x + 0.5) / CELL_PX as f32 - 0.5,
            (y + 0.5) / CELL_PX as f32 - 0.5,
        )
    }
}

/// Adds pixels of a row to the cells that they lie in.
fn add_stretch(cells: &mut [Sum], line: &[[u8; 3]], stretch: Range<usize>, lut: &[f32; 256]) {
    let touched = stretch.start / CELL_PX..stretch.end.div_ceil(CELL_PX);
    for (cell, sum) in cells.iter_mut().enumerate().take(touched.end).skip(touched.start) {
        let first = stretch.start.max(cell * CELL_PX).next_multiple_of(STRIDE_PX[0]);
        let end = stretch.end.min((cell + 1) * CELL_PX);
        for color in line.get(first..end).into_iter().flat_map(|part| part.iter().step_by(STRIDE_PX[0])) {
            sum.color = std::array::from_fn(|c| sum.color[c] + lut[color[c] as usize]);
            sum.count += 1.0;
        }
    }
}

/// Means of the cells; a cell with few pixels leans on the mean of its surroundings.
fn filled(sums: &[Sum], columns: usize, rows: usize) -> Vec<[f32; 3]> {
    let coarse = (columns > 1 || rows > 1).then(|| {
        let (half_columns, half_rows) = (columns.div_ceil(2), rows.div_ceil(2));
        let mut halves = vec![Sum::default(); half_columns * half_rows];
        for (i, sum) in sums.iter().enumerate() {
            let half = &mut halves[i / columns / 2 * half_columns + i % columns / 2];
            half.count += sum.count;
            for c in 0..3 {
                half.color[c] += sum.color[c];
            }
        }
        (filled(&halves, half_columns, half_rows), half_columns, half_rows)
    });
    // A quarter of a full cell: below it the cell's own mean is mostly that of a strip along a region.
    let trust = (CELL_PX * CELL_PX / STRIDE_PX[0] / STRIDE_PX[1]) as f32 / 4.0;
    let mid_grey = [0.2; 3];
    sums.iter()
        .enumerate()
        .map(|(i, sum)| {
            let around = coarse.as_ref().map_or(mid_grey, |(colors, half_columns, half_rows)| {
                let (x, y) = ((i % columns) as f32, (i / columns) as f32);
                bilinear(colors, *half_columns, *half_rows, (x + 0.5) / 2.0 - 0.5, (y + 0.5) / 2.0 - 0.5)
            });
            // Nothing is below a black level: ratios to the table stay finite.
            std::array::from_fn(|c| ((sum.color[c] + trust * around[c]) / (sum.count + trust)).max(1e-4))
        })
        .collect()
}

/// Value between cell centres, which lie at integers.
fn bilinear(cells: &[[f32; 3]], columns: usize, rows: usize, x: f32, y: f32) -> [f32; 3] {
    let (x, y) = (x.clamp(0.0, (columns - 1) as f32), y.clamp(0.0, (rows - 1) as f32));
    let (x0, y0) = (x as usize, y as usize);
    let (x1, y1) = ((x0 + 1).min(columns - 1), (y0 + 1).min(rows - 1));
    let (fx, fy) = (x - x0 as f32, y - y0 as f32);
    std::array::from_fn(|c| {
        let across = |y: usize| cells[y * columns + x0][c] * (1.0 - fx) + cells[y * columns + x1][c] * fx;
        across(y0) * (1.0 - fy) + across(y1) * fy
    })
}

/// The median; 0 of nothing.
fn median(values: &mut [f32]) -> f32 {
    let middle = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(middle, f32::total_cmp).1 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_are_those_of_the_curve() {
        for (number, &light) in linear_table().iter().enumerate() {
            assert!((level(light) - number as f32).abs() < 2e-3, "{number}: {}", level(light));
        }
        for light in (0..10_000).map(|i| i as f32 * 1.2e-4) {
            let v = f64::from(light);
            let exact = 255.0 * if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 };
            assert!((f64::from(level(light)) - exact).abs() < 1e-3, "{light}: {} instead of {exact}", level(light));
        }
        assert_eq!((level(-1.0), level(9.0)), (level(0.0), level(1.2)));
    }
    use crate::separator::tests::Scene;

    fn measured(scene: &Scene) -> TableModel {
        let mut table = TableModel::default();
        scene.show(|input, _| table.measure(input));
        table
    }

    /// Numbers without order in [-1, 1].
    fn noise(x: u32, y: u32) -> f32 {
        let mixed = (x.wrapping_mul(0x9E37_79B1) ^ y.wrapping_mul(0x85EB_CA77)).wrapping_mul(0xC2B2_AE3D);
        ((mixed ^ mixed >> 15).wrapping_mul(0x27D4_EB2F) >> 16) as f32 / 32767.5 - 1.0
    }

    const BASE: [f32; 3] = [0.5, 0.35, 0.2];

    /// Light falls off from left to right, and from top to bottom.
    fn light(x: f32, y: f32) -> f32 {
        1.0 - 0.0012 * x - 0.0008 * y
    }

    fn lit(x: u32, y: u32) -> [u8; 3] {
        BASE.map(|c| level(c * light(x as f32, y as f32)).round() as u8)
    }

    #[test]
    fn light_that_falls_off_is_followed_under_regions() {
        let size = [320, 240];
        let in_region = |x: u32, y: u32| (90..160).contains(&x) && (100..150).contains(&y);
        let color = |x, y| if in_region(x, y) { [250, 10, 250] } else { lit(x, y) };
        let table = measured(&Scene::new(size, color, |x, y| u32::from(in_region(x, y)), &[&[1]]));
        let off = |x: f32, y: f32| {
            let (brightness, difference) = against_table(table.color_at(x, y), BASE.map(|c| c * light(x, y)));
            assert!(difference < 1.0, "{difference} levels at ({x}, {y})");
            (brightness - 1.0).abs()
        };
        assert!(off(125.0, 125.0) < 0.012, "{} in the middle of the region", off(125.0, 125.0));
        for (x, y) in [(92.0, 102.0), (158.0, 148.0), (92.0, 148.0), (158.0, 102.0)] {
            assert!(off(x, y) < 0.03, "{} at its corner ({x}, {y})", off(x, y));
        }
        for (x, y) in [(40.0, 40.0), (250.0, 60.0), (200.0, 200.0)] {
            assert!(off(x, y) < 0.005, "{} on the bare table at ({x}, {y})", off(x, y));
        }
        assert!(table.brightness_spread < 0.025 && table.color_noise < 1.0);
    }

    #[test]
    fn without_any_table_it_is_mid_grey() {
        for size in [[1, 1], [2, 1], [5, 40], [64, 48]] {
            for color in [[0; 3], [255; 3], [200, 10, 10]] {
                let table = measured(&Scene::new(size, |_, _| color, |_, _| 0, &[&[0]]));
                for (x, y) in [(0.0, 0.0), (size[0] as f32 / 2.0, size[1] as f32 / 2.0), (1e6, -1e6)] {
                    assert!(table.color_at(x, y).iter().all(|c| (c - 0.2).abs() < 1e-6));
                }
                assert!(table.brightness_spread > 0.0 && table.brightness_spread.is_finite());
                assert_eq!(table.color_noise, 0.0);
            }
        }
    }

    #[test]
    fn a_black_table_leaves_ratios_finite() {
        let table = measured(&Scene::new([64, 64], |_, _| [0; 3], |_, _| 0, &[]));
        let color = table.color_at(30.0, 30.0);
        assert!(color.iter().all(|&c| c > 0.0 && c < 0.05), "{color:?}");
        let (brightness, difference) = against_table([1.0; 3], color);
        assert!(brightness.is_finite() && difference.is_finite());
        let (brightness, difference) = against_table([0.5; 3], [0.0; 3]);
        assert!(brightness.is_finite() && difference.is_finite());
    }

    #[test]
    fn less_light_is_told_from_another_hue() {
        for table in [[0.2; 3], BASE, [0.02, 0.05, 0.3]] {
            for factor in [0.05, 0.3, 0.8, 1.0, 1.2] {
                let (brightness, difference) = against_table(table.map(|c| factor * c), table);
                assert!((brightness - factor).abs() < 1e-4 && difference < 1e-2, "{brightness} {difference}");
            }
        }
        let (_, difference) = against_table([0.05, 0.2, 0.05], [0.2; 3]);
        assert!(difference > 25.0, "{difference}");
        // The same luminance, another hue.
        let (brightness, difference) = against_table([0.3, 0.2, 0.1], [0.2; 3]);
        assert!((brightness - 1.0).abs() < 0.01 && difference > 20.0, "{brightness} {difference}");
    }

    #[test]
    fn a_spotted_table_varies_more() {
        let spread = |amplitude: f32, tint: f32| {
            let color = |x: u32, y: u32| {
                let (spot, hue) = (amplitude * noise(x / 5, y / 5), tint * noise(1000 + x / 5, y / 5));
                [140.0 + spot + hue, 140.0 + spot, 140.0 + spot - hue].map(|v: f32| v.round() as u8)
            };
            let table = measured(&Scene::new([320, 240], color, |_, _| 0, &[]));
            (table.brightness_spread, table.color_noise)
        };
        let (flat, spotted, tinted) = (spread(0.0, 0.0), spread(20.0, 0.0), spread(0.0, 12.0));
        assert_eq!(flat.1, 0.0);
        assert!(flat.0 <= 0.02 && spotted.0 > 0.08 && spotted.0 < 0.5, "{flat:?} {spotted:?}");
        assert!(spotted.1 < 1.0 && tinted.1 > 1.5 && tinted.1 < 12.0, "{spotted:?} {tinted:?}");
    }

    #[test]
    fn what_lies_in_regions_is_not_table() {
        let color = |x, _| if x < 100 { [255, 0, 0] } else { [90; 3] };
        let table = measured(&Scene::new([200, 100], color, |x, _| u32::from(x < 100), &[&[1]]));
        let (brightness, difference) = against_table(table.color_at(50.0, 50.0), [linear_table()[90]; 3]);
        assert!((brightness - 1.0).abs() < 0.1 && difference < 3.0, "{brightness} {difference}");
    }
}
