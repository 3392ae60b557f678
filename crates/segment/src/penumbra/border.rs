//! The border of table and shadows at full resolution: after the refinement, pixels near it whose tone is the table's are judged
//! once more by their own light, averaged over the square of a working pixel and its margin, but not across an edge.

use rayon::prelude::*;

use super::{MOST_LIGHT, MOST_REST_OF_SHADOW, PenumbraFinder, Sum, TableRow, against, brightness, dot, linear};
use crate::partition::RgbView;
use crate::penumbrae::NOTHING;
use crate::refine::Coarse;
use crate::table::{BLOCK, neighbours};
use crate::working_image::UNITS_PER_LEVEL;

/// What has another light by more than this share of the table's is not averaged with a pixel.
const MOST_STEP: f32 = 0.2;
/// How far from it the border of the table is settled at full resolution, working pixels.
const SETTLED: usize = 3;

impl PenumbraFinder {
    /// Settles the border of table and shadows at full resolution: pixels up to [`SETTLED`] working pixels from it that have the
    /// tone of the table are table from `light` on, and else what lies beyond. `labels` are the refined ones of the
    /// labels that were absorbed.
    pub(crate) fn settle(&mut self, image: &RgbView<'_>, coarse: &Coarse<'_>, labels: &mut [u32], light: f32) {
        let (width, height) = (coarse.width, coarse.height);
        if !self.absorbed {
            return;
        }
        let (mut beyond, mut queue) = (std::mem::take(&mut self.beyond), std::mem::take(&mut self.queue));
        let is_table = |label: u32| self.table.get(label as usize).copied().unwrap_or(false);
        beyond.clear();
        beyond.resize(coarse.labels.len(), NOTHING);
        queue.clear();
        let labels_of = coarse.labels;
        beyond.par_chunks_exact_mut(width).enumerate().with_min_len(8).for_each(|(y, beyond)| {
            let row_of = |y: usize| &labels_of[y * width..(y + 1) * width];
            let (above, row, below) = (row_of(y.saturating_sub(1)), row_of(y), row_of((y + 1).min(height - 1)));
            let differs = |own: u32, other: u32| own != other && is_table(own) != is_table(other);
            for start in (0..width).step_by(BLOCK) {
                let end = (start + BLOCK).min(width);
                let around = &row[start.saturating_sub(1)..(end + 1).min(width)];
                let is_plain = around.iter().fold(0, |any, label| any | (label ^ around[0])) == 0;
                if is_plain && above[start..end] == row[start..end] && below[start..end] == row[start..end] {
                    continue;
                }
                for x in start..end {
                    let sides = [row[(x + 1).min(width - 1)], row[x.saturating_sub(1)], above[x], below[x]];
                    if let Some(other) = sides.into_iter().rfind(|&other| differs(row[x], other)) {
                        beyond[x] = other;
                    }
                }
            }
        });
        for (k, block) in beyond.chunks(BLOCK).enumerate() {
            // No label is all ones.
            if block.iter().fold(NOTHING, |all, label| all & label) != NOTHING {
                let first = (k * BLOCK) as u32;
                queue.extend((first..).zip(block).filter(|(_, label)| **label != NOTHING).map(|(i, _)| i));
            }
        }
        let mut from = 0;
        for _ in 1..SETTLED {
            let to = queue.len();
            for at in from..to {
                let i = queue[at] as usize;
                for j in neighbours(i, width, height) {
                    if beyond[j] == NOTHING {
                        beyond[j] = beyond[i];
                        queue.push(j as u32);
                    }
                }
            }
            from = to;
        }
        (self.beyond, self.queue) = (beyond, queue);
        let (w, r) = (image.width() as usize, coarse.reduction);
        let this = &*self;
        labels.par_chunks_mut(w * r).enumerate().with_min_len(4).for_each_init(
            <(TableRow, Around)>::default,
            |(table, around), (row, out)| {
                table.fill(&this.cells, this.levels[0].columns, row);
                for column in 0..width {
                    let cell = row * width + column;
                    let beyond = this.beyond[cell];
                    if beyond == NOTHING {
                        continue;
                    }
                    let table = table.at(column);
                    let sides = [coarse.labels[cell], beyond];
                    let [table_label, shadow_label] = if is_table(sides[0]) { sides } else { [sides[1], sides[0]] };
                    around.bbox = None;
                    for (y, line) in (row * r..).zip(out.chunks_exact_mut(w)) {
                        for (x, label) in (column * r..).zip(line.iter_mut().skip(column * r).take(r)) {
                            let on_table = is_table(*label);
                            // Far from it the pixel itself tells what the mean of its like will be.
                            let own = brightness(pixel_at(image, x, y), table);
                            if on_table && own > light + MOST_STEP || !on_table && own < light - MOST_STEP {
                                continue;
                            }
                            if around.bbox.is_none() {
                                around.fill(image, [column * r, row * r], r, table);
                            }
                            let (brightness, rest) = against(around.mean(x, y, r, own), table);
                            if rest > MOST_REST_OF_SHADOW {
                                continue;
                            }
                            if on_table {
                                if brightness < light {
                                    *label = shadow_label;
                                }
                            } else if this.spared[cell] == 0 && (light..=MOST_LIGHT).contains(&brightness) {
                                *label = table_label;
                            }
                        }
                    }
                }
            },
        );
    }
}

/// The surroundings of a working pixel.
#[derive(Debug, Default)]
struct Around {
    /// Left, top, right and bottom, the latter two beyond the last; none before it is filled.
    bbox: Option<[usize; 4]>,
    /// Linear light, and that as a share of the table's.
    pixels: Vec<([f32; 3], f32)>,
}

impl Around {
    /// Reads a working pixel of side `r` at `corner`, and as much all around it.
    fn fill(&mut self, image: &RgbView<'_>, corner: [usize; 2], r: usize, table: [f32; 3]) {
        let (w, h) = (image.width() as usize, image.height() as usize);
        let [left, top] = corner.map(|first| first.saturating_sub(r));
        let (right, bottom) = ((corner[0] + 2 * r).min(w), (corner[1] + 2 * r).min(h));
        let bytes: &[u8] = image.as_raw();
        let per_light = table.map(|c| c / dot(table, table).max(1e-9));
        self.pixels.clear();
        for y in top..bottom {
            self.pixels.extend(bytes[(y * w + left) * 3..(y * w + right) * 3].as_chunks::<3>().0.iter().map(|p| {
                let colour = linear(p.map(|c| u16::from(c) * UNITS_PER_LEVEL));
                (colour, dot(colour, per_light))
            }));
        }
        self.bbox = Some([left, top, right, bottom]);
    }

    /// Mean linear light of the pixels of the square of `r` pixels around one that have about its light `own`, as far as they lie
    /// in the image: against the grain, and not across an edge.
    fn mean(&self, x: usize, y: usize, r: usize, own: f32) -> [f32; 3] {
        let [left, top, right, bottom] = self.bbox.unwrap_or_default();
        let columns = x.saturating_sub(r) - left..(x + r + 1).min(right) - left;
        let mut sum = Sum::default();
        for y in y.saturating_sub(r) - top..(y + r + 1).min(bottom) - top {
            let row = y * (right - left);
            for &(colour, light) in &self.pixels[row + columns.start..row + columns.end] {
                // No branch: neighbours differ in this all the time. The pixel itself is always among them.
                sum.add(colour, f32::from(u8::from((light - own).abs() <= MOST_STEP)));
            }
        }
        sum.mean()
    }
}

/// Linear light of a pixel.
fn pixel_at(image: &RgbView<'_>, x: usize, y: usize) -> [f32; 3] {
    linear(image.get_pixel(x as u32, y as u32).0.map(|c| u16::from(c) * UNITS_PER_LEVEL))
}
