//! Fine partitions of a region: the catchment basins of the colour gradient.
//!
//! The proto-object partitions are coarse where a grey part meets its grey shadow. Inside regions, which are few, the
//! frame is parted anew at full size: every basin of the gradient (watershed by flooding, without lines) lies on one side
//! of every edge that the camera saw.

use std::ops::Range;
use std::sync::LazyLock;

use samsod_segment::BoundingBox;

use crate::crop::{Crop, has_right};
use crate::separator::Input;
use crate::table_model::linear_table;

/// No basin.
pub(crate) const NONE: u32 = u32::MAX;

/// Gradients up to this count as flat, sRGB levels over two pixels.
const FLAT: u8 = 4;

/// One basin.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Basin {
    /// Number of pixels.
    pub(crate) pixels: f32,
    /// Mean colour, linear light; of its flat pixels, if it has any. Those on its slopes are mixed with what is beyond.
    pub(crate) color: [f32; 3],
    /// Centre of area, px of the image.
    pub(crate) center: [f32; 2],
    /// A pixel where it is flattest (x, y), px of the image.
    pub(crate) seed: [u32; 2],
}

/// A border that two basins share.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Border {
    /// Index of the one basin.
    pub(crate) a: u32,
    /// Index of the other, larger than `a`.
    pub(crate) b: u32,
    /// Number of pairs of pixels that touch.
    pub(crate) length: f32,
    /// Mean gradient along it, sRGB levels over two pixels.
    pub(crate) gradient: f32,
}

/// The basins of one crop, with scratch memory.
#[derive(Debug, Default)]
pub(crate) struct Basins {
    /// Basin of every pixel of the crop that is the region's or may be claimed; [`NONE`] elsewhere.
    pub(crate) labels: Vec<u32>,
    /// The basins.
    pub(crate) basins: Vec<Basin>,
    /// Their common borders, by `a`, then `b`.
    pub(crate) borders: Vec<Border>,
    /// Smoothed colours of the crop, three sRGB levels a pixel.
    pub(crate) smooth: Vec<u8>,
    across: Vec<u16>,
    squares: Vec<u16>,
    gradient: Vec<u8>,
    flood: Flood,
    runs: Vec<BasinRun>,
    row_starts: Vec<usize>,
    sums: Vec<Sum>,
    meetings: Meetings,
}

/// The sheets of the flooding: those of the crop with a pixel more on each side, so that every pixel has four
/// neighbours.
#[derive(Debug, Default)]
struct Flood {
    /// Gradient above [`FLAT`]; [`DRY`] where no water goes.
    level: Vec<u8>,
    /// [`WET`] and the gradient until water comes, then the basin; [`NONE`] where no water goes.
    labels: Vec<u32>,
    /// Pixels where a basin may begin, by place and by gradient.
    lowest: Vec<u32>,
    order: Vec<u32>,
    /// Pixels that water has reached, first in, first out, by the level at which it covers them.
    queues: Vec<Vec<u32>>,
}

/// So many pixels of a row are compared at a time.
const LANES: usize = 16;
/// Higher than any gradient above [`FLAT`].
const DRY: u8 = u8::MAX;
/// No basin yet, in the upper bits; there are fewer basins than that.
const WET: u32 = 1 << 31;

/// The gradient of a pixel that no water has reached.
fn wet_level(label: u32) -> Option<u8> {
    (label & !0xff == WET).then_some(label as u8)
}

impl Basins {
    /// Parts the pixels of a crop that its region owns or may claim.
    pub(crate) fn part(&mut self, input: &Input<'_>, crop: &Crop) {
        self.labels.clear();
        self.basins.clear();
        self.borders.clear();
        let Some(bbox) = crop.bbox else { return };
        self.smooth(input, bbox);
        self.gradients(bbox.width as usize);
        self.flood(crop, bbox);
        self.measure(input, bbox);
        self.find_borders(bbox.width as usize);
    }

    /// Binomial 3 x 3 smoothing of the crop: demosaicing noise would part every flat area into hundreds of basins.
    fn smooth(&mut self, input: &Input<'_>, bbox: BoundingBox) {
        let row = 3 * bbox.width as usize;
        let height = bbox.height as usize;
        let stride = 3 * input.partition.width() as usize;
        let pixels = input.frame.as_raw();
        self.across.resize(row * height, 0);
        self.smooth.resize(row * height, 0);
        for (y, to) in self.across.chunks_exact_mut(row).enumerate() {
            let start = (bbox.y as usize + y) * stride + 3 * bbox.x as usize;
            let from = &pixels[start..start + row];
            // Beyond the crop its border goes on.
            let ends = [0..3, row - 3..row];
            for i in ends.into_iter().flatten() {
                let (left, right) = (from[i.saturating_sub(3).max(i % 3)], from[(i + 3).min(row - 3 + i % 3)]);
                to[i] = u16::from(left) + 2 * u16::from(from[i]) + u16::from(right);
            }
            if row > 6 {
                let sides = from[..row - 6].iter().zip(&from[6..]);
                for ((to, &here), (&left, &right)) in to[3..row - 3].iter_mut().zip(&from[3..row - 3]).zip(sides) {
                    *to = u16::from(left) + 2 * u16::from(here) + u16::from(right);
                }
            }
        }
        for (y, to) in self.smooth.chunks_exact_mut(row).enumerate() {
            let line = |y: usize| &self.across[y * row..(y + 1) * row];
            let sides = line(y.saturating_sub(1)).iter().zip(line((y + 1).min(height - 1)));
            for ((to, &here), (&above, &below)) in to.iter_mut().zip(line(y)).zip(sides) {
                *to = ((above + 2 * here + below + 8) / 16) as u8;
            }
        }
    }

    /// Largest gradient over the channels, above [`FLAT`].
    fn gradients(&mut self, width: usize) {
        let row = 3 * width;
        let height = self.smooth.len() / row;
        self.gradient.resize(self.smooth.len() / 3, 0);
        self.squares.resize(row, 0);
        let roots = roots_above_flat();
        for (y, gradients) in self.gradient.chunks_exact_mut(width).enumerate() {
            let line = |y: usize| &self.smooth[y * row..(y + 1) * row];
            let (above, here, below) = (line(y.saturating_sub(1)), line(y), line((y + 1).min(height - 1)));
            for ((square, &a), &b) in self.squares.iter_mut().zip(above).zip(below) {
                *square = u16::from(a.abs_diff(b)).pow(2);
            }
            // At the border the crop goes on as it ends: the difference is over one pixel.
            let mut add = |i: usize, left: usize, right: usize| {
                self.squares[i] = self.squares[i].saturating_add(u16::from(here[left].abs_diff(here[right])).pow(2));
            };
            for c in 0..3 {
                add(c, c, (c + 3).min(row - 3 + c));
                if width > 1 {
                    add(row - 3 + c, row - 6 + c, row - 3 + c);
                }
            }
            if width > 2 {
                for ((square, &a), &b) in self.squares[3..row - 3].iter_mut().zip(here).zip(&here[6..]) {
                    *square = square.saturating_add(u16::from(a.abs_diff(b)).pow(2));
                }
            }
            for (gradient, &[r, g, b]) in gradients.iter_mut().zip(self.squares.as_chunks::<3>().0) {
                *gradient = roots[usize::from(r.max(g).max(b))];
            }
        }
    }

    /// Watershed by flooding from the lowest gradient up: water flows from pixel to pixel, breadth first within a level, and
    /// what none has reached at its level starts a new basin.
    fn flood(&mut self, crop: &Crop, bbox: BoundingBox) {
        let width = bbox.width as usize;
        let stride = width + 2;
        let Flood { level, labels, lowest, order, queues } = &mut self.flood;
        let padded = stride * (bbox.height as usize + 2);
        // A row may be read beyond its end.
        level.resize(padded + LANES, DRY);
        labels.resize(padded, NONE);
        // What lies round the crop; the crop itself is written anew.
        for edge in [0..stride, padded - stride..padded] {
            level[edge.clone()].fill(DRY);
            labels[edge].fill(NONE);
        }
        level[padded..].fill(DRY);
        let rows = self.gradient.chunks_exact(width).zip(crop.owners().chunks_exact(width));
        let padded_rows = level[stride..].chunks_exact_mut(stride).zip(labels[stride..].chunks_exact_mut(stride));
        for ((level, labels), (gradients, owners)) in padded_rows.zip(rows) {
            for side in [0, width + 1] {
                (level[side], labels[side]) = (DRY, NONE);
            }
            let pixels = level[1..=width].iter_mut().zip(&mut labels[1..=width]).zip(gradients.iter().zip(owners));
            for ((level, label), (&gradient, &owner)) in pixels {
                let is_wet = has_right(owner);
                *level = if is_wet { gradient } else { DRY };
                *label = if is_wet { WET | u32::from(gradient) } else { NONE };
            }
        }
        lowest.clear();
        for y in 1..=bbox.height as usize {
            find_lowest(level, stride, y * stride + 1..y * stride + 1 + width, lowest);
        }
        let mut starts = [0u32; 257];
        lowest.iter().for_each(|&i| starts[level[i as usize] as usize + 1] += 1);
        for g in 0..256 {
            starts[g + 1] += starts[g];
        }
        order.clear();
        order.resize(lowest.len(), 0);
        let mut next = starts;
        for &i in &*lowest {
            let next = &mut next[level[i as usize] as usize];
            order[*next as usize] = i;
            *next += 1;
        }
        queues.resize_with(usize::from(DRY), Vec::new);
        for g in 0..DRY {
            let mut seeds = order[starts[g as usize] as usize..starts[g as usize + 1] as usize].iter();
            let mut queue = std::mem::take(&mut queues[g as usize]);
            let mut next = 0;
            loop {
                while let Some(&i) = queue.get(next) {
                    next += 1;
                    let label = labels[i as usize];
                    for n in around(i as usize, stride) {
                        if let Some(level) = wet_level(labels[n]) {
                            labels[n] = label;
                            if level <= g { queue.push(n as u32) } else { queues[level as usize].push(n as u32) }
                        }
                    }
                }
                let Some(&seed) = seeds.by_ref().find(|&&i| wet_level(labels[i as usize]).is_some()) else { break };
                labels[seed as usize] = self.basins.len() as u32;
                let (x, y) = (seed % stride as u32 - 1, seed / stride as u32 - 1);
                self.basins.push(Basin { seed: [bbox.x + x, bbox.y + y], ..Basin::default() });
                queue.push(seed);
            }
            queue.clear();
            queues[g as usize] = queue;
        }
        self.labels.clear();
        self.runs.clear();
        self.row_starts.clear();
        for row in labels[stride..].chunks_exact(stride).take(bbox.height as usize) {
            let row = &row[1..=width];
            self.labels.extend_from_slice(row);
            self.row_starts.push(self.runs.len());
            let mut start = 0;
            self.runs.extend(row.chunk_by(|a, b| a == b).map(|run| {
                let first = start;
                start += run.len();
                BasinRun { label: run[0], start: first as u32, end: start as u32 }
            }));
        }
        self.row_starts.push(self.runs.len());
    }

    /// The runs of every row of the crop, those without a basin as well.
    pub(crate) fn rows(&self) -> impl Iterator<Item = &[BasinRun]> {
        self.row_starts.windows(2).map(|ends| &self.runs[ends[0]..ends[1]])
    }

    fn measure(&mut self, input: &Input<'_>, bbox: BoundingBox) {
        let width = bbox.width as usize;
        let (stride, pixels, light) = (input.partition.width() as usize, input.frame.as_raw(), whole_light());
        let mut sums = std::mem::take(&mut self.sums);
        sums.clear();
        sums.resize(self.basins.len(), Sum::default());
        for (y, (runs, gradients)) in (bbox.y..).zip(self.rows().zip(self.gradient.chunks_exact(width))) {
            let start = 3 * (y as usize * stride + bbox.x as usize);
            let colors = pixels[start..start + 3 * width].as_chunks::<3>().0;
            for run in runs {
                let Some(sum) = sums.get_mut(run.label as usize) else { continue };
                let columns = run.start as usize..run.end as usize;
                let (mut all, mut flat, mut flat_pixels) = ([0; 3], [0; 3], 0);
                for (color, &gradient) in colors[columns.clone()].iter().zip(&gradients[columns]) {
                    let light = color.map(|level| light[level as usize]);
                    let is_flat = u64::from(gradient == 0);
                    all = std::array::from_fn(|c| all[c] + light[c]);
                    flat = std::array::from_fn(|c| flat[c] + is_flat * light[c]);
                    flat_pixels += is_flat as u32;
                }
                let n = u64::from(run.end - run.start);
                sum.pixels += n as u32;
                sum.flat_pixels += flat_pixels;
                // Twice the sum of the columns is a whole number.
                sum.doubled_x += n * u64::from(2 * bbox.x + run.start + run.end - 1);
                sum.y += n * u64::from(y);
                sum.color = std::array::from_fn(|c| sum.color[c] + all[c]);
                sum.flat_color = std::array::from_fn(|c| sum.flat_color[c] + flat[c]);
            }
        }
        for (basin, sum) in self.basins.iter_mut().zip(&sums) {
            let (color, of) =
                if sum.flat_pixels > 0 { (sum.flat_color, sum.flat_pixels) } else { (sum.color, sum.pixels) };
            let pixels = f64::from(sum.pixels);
            basin.pixels = sum.pixels as f32;
            basin.color = color.map(|c| (c as f64 * LIGHT_UNIT / f64::from(of)) as f32);
            basin.center = [(sum.doubled_x / 2) as f64, sum.y as f64].map(|c| (c / pixels) as f32);
        }
        self.sums = sums;
    }

    fn find_borders(&mut self, width: usize) {
        let mut meetings = std::mem::take(&mut self.meetings);
        meetings.clear(self.basins.len());
        let (mut above, mut gradients_above): (&[BasinRun], &[u8]) = (&[], &[]);
        for (runs, gradients) in self.rows().zip(self.gradient.chunks_exact(width)) {
            for pair in runs.windows(2) {
                let (left, right) = (pair[0].end as usize - 1, pair[1].start as usize);
                let steepness = || u32::from(gradients[left].max(gradients[right]));
                meetings.take(pair[0].label, pair[1].label, 1, steepness);
            }
            let mut first = 0;
            for run in runs {
                while above.get(first).is_some_and(|other| other.end <= run.start) {
                    first += 1;
                }
                for other in above[first..].iter().take_while(|other| other.start < run.end) {
                    let columns = run.start.max(other.start) as usize..run.end.min(other.end) as usize;
                    let length = columns.len() as u32;
                    meetings.take(run.label, other.label, length, || {
                        let pairs = gradients[columns.clone()].iter().zip(&gradients_above[columns]);
                        pairs.map(|(&a, &b)| u32::from(a.max(b))).sum()
                    });
                }
            }
            (above, gradients_above) = (runs, gradients);
        }
        meetings.borders(&mut self.borders);
        self.meetings = meetings;
    }
}

/// Pixels of a row of the crop that are of one basin.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BasinRun {
    /// The basin; [`NONE`] where there is none.
    pub(crate) label: u32,
    /// First column of the crop.
    pub(crate) start: u32,
    /// One past the last column.
    pub(crate) end: u32,
}

/// Roots above [`FLAT`] of all squares; what the squares are cut to has a root of 255 and a little. Most that are asked for
/// lie close together.
fn roots_above_flat() -> &'static [u8; 1 << 16] {
    static ROOTS: LazyLock<Box<[u8; 1 << 16]>> = LazyLock::new(|| {
        let mut roots = Box::new([0; 1 << 16]);
        (0..=u16::MAX)
            .zip(roots.iter_mut())
            .for_each(|(square, root)| *root = (square.isqrt() as u8).saturating_sub(FLAT));
        roots
    });
    &ROOTS
}

/// Linear light is a multiple of this: at level 1, the darkest that is not black, a unit in the last place of an f32.
const LIGHT_UNIT: f64 = 1.0 / (1u64 << 35) as f64;

/// [`linear_table`] in units of [`LIGHT_UNIT`]. Sums of whole numbers do not depend on an order, and those of millions of
/// pixels lose nothing.
fn whole_light() -> &'static [u64; 256] {
    static WHOLE: LazyLock<[u64; 256]> =
        LazyLock::new(|| linear_table().map(|light| (f64::from(light) / LIGHT_UNIT) as u64));
    &WHOLE
}

/// Sums over a basin.
#[derive(Debug, Clone, Copy, Default)]
struct Sum {
    pixels: u32,
    flat_pixels: u32,
    doubled_x: u64,
    y: u64,
    /// Linear light of all pixels, and of the flat ones, in units of [`LIGHT_UNIT`].
    color: [u64; 3],
    flat_color: [u64; 3],
}

/// Pixels of two basins that touch.
#[derive(Debug, Clone, Copy)]
struct Meeting {
    /// The larger label.
    b: u32,
    /// The next meeting of the smaller label; [`NONE`] after the last.
    next: u32,
    length: u32,
    /// Sum of the gradients above [`FLAT`].
    steepness: u32,
}

/// What was met so far, by the smaller label.
#[derive(Debug, Default)]
struct Meetings {
    /// The last meeting of every label.
    heads: Vec<u32>,
    all: Vec<Meeting>,
    of_label: Vec<Meeting>,
}

impl Meetings {
    /// So many meetings of a label are searched for an earlier one with the same other label: most have few neighbours,
    /// and one with thousands must not cost their square.
    const SEARCHED: usize = 8;

    fn clear(&mut self, labels: usize) {
        self.heads.clear();
        self.heads.resize(labels, NONE);
        self.all.clear();
    }

    fn take(&mut self, a: u32, b: u32, length: u32, steepness: impl FnOnce() -> u32) {
        if a == b || a == NONE || b == NONE {
            return;
        }
        let (a, b) = (a.min(b), a.max(b));
        let Some(head) = self.heads.get_mut(a as usize) else { return };
        let mut at = *head;
        for _ in 0..Self::SEARCHED {
            let Some(meeting) = self.all.get_mut(at as usize) else { break };
            if meeting.b == b {
                meeting.length += length;
                meeting.steepness += steepness();
                return;
            }
            at = meeting.next;
        }
        let meeting = Meeting { b, next: *head, length, steepness: steepness() };
        *head = self.all.len() as u32;
        self.all.push(meeting);
    }

    /// Appends the borders, by `a`, then `b`.
    fn borders(&mut self, borders: &mut Vec<Border>) {
        for (a, &head) in (0..).zip(&self.heads) {
            self.of_label.clear();
            let mut at = head;
            while let Some(meeting) = self.all.get(at as usize) {
                self.of_label.push(*meeting);
                at = meeting.next;
            }
            self.of_label.sort_unstable_by_key(|meeting| meeting.b);
            borders.extend(self.of_label.chunk_by(|p, q| p.b == q.b).map(|meetings| {
                // Whole numbers: the order does not matter.
                let length = meetings.iter().map(|meeting| meeting.length).sum::<u32>() as f32;
                let steepness = meetings.iter().map(|meeting| u64::from(meeting.steepness)).sum::<u64>() as f32;
                Border { a, b: meetings[0].b, length, gradient: steepness / length + f32::from(FLAT) }
            }));
        }
    }
}

/// Appends the pixels of a row where a basin may begin. One with a lower neighbour is reached by its water, and of
/// neighbours as high as each other the first one is asked first.
fn find_lowest(level: &[u8], stride: usize, row: Range<usize>, lowest: &mut Vec<u32>) {
    for start in row.clone().step_by(LANES) {
        // The last stretch reaches into the row below, whose pixels are cut off again.
        let part = |shift: usize| level.get(start + shift - stride..).and_then(|rest| rest.first_chunk::<LANES>());
        // Shifts from the row above.
        let parts = (part(0), part(stride - 1), part(stride), part(stride + 1), part(2 * stride));
        let (Some(above), Some(left), Some(here), Some(right), Some(below)) = parts else { continue };
        let mut is_lowest = [0u8; LANES];
        for k in 0..LANES {
            let (before, after) = (above[k].min(left[k]), right[k].min(below[k]));
            is_lowest[k] = u8::from((here[k] < before) & (here[k] <= after) & (here[k] != DRY));
        }
        if is_lowest != [0; LANES] {
            lowest.extend((start..row.end).zip(is_lowest).filter(|(_, is)| *is != 0).map(|(i, _)| i as u32));
        }
    }
}

/// Neighbours that share an edge, in a sheet with a pixel to spare on each side.
fn around(i: usize, stride: usize) -> [usize; 4] {
    [i - 1, i + 1, i - stride, i + stride]
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::separator::tests::Scene;

    /// The basins of the first region.
    fn part(scene: &Scene) -> (Basins, Crop) {
        let mut basins = Basins::default();
        let crop = part_into(scene, &mut basins);
        (basins, crop)
    }

    fn part_into(scene: &Scene, basins: &mut Basins) -> Crop {
        scene.show(|input, crops| {
            basins.part(input, &crops[0]);
            std::mem::take(&mut crops[0])
        })
    }

    fn in_box(x: u32, y: u32, columns: std::ops::Range<u32>, rows: std::ops::Range<u32>) -> u32 {
        u32::from(columns.contains(&x) && rows.contains(&y))
    }

    #[test]
    fn an_edge_parts_two_flat_areas() {
        let color = |x, _| if x < 18 { [100; 3] } else { [160, 100, 130] };
        let (found, crop) = part(&Scene::new([40, 30], color, |x, y| in_box(x, y, 8..28, 8..22), &[&[1]]));
        let [left, right] = &found.basins[..] else { panic!("{} basins", found.basins.len()) };
        // The region and the four pixels round it that it may claim: columns 4 to 31, rows 4 to 25.
        assert_eq!((left.pixels, right.pixels), (14.0 * 22.0, 14.0 * 22.0));
        let lut = linear_table();
        for (basin, levels) in [(left, [100, 100, 100]), (right, [160, 100, 130])] {
            for c in 0..3 {
                assert!((basin.color[c] - lut[levels[c]]).abs() < 1e-4, "{:?}", basin.color);
            }
        }
        assert_eq!((left.center, right.center), ([10.5, 14.5], [24.5, 14.5]));
        assert!((4..18).contains(&left.seed[0]) && (18..32).contains(&right.seed[0]));
        // Smoothing leaves three quarters of a step over two pixels.
        let [border] = &found.borders[..] else { panic!("{} borders", found.borders.len()) };
        assert_eq!((border.a, border.b, border.length), (0, 1, 22.0));
        assert!((border.gradient - 45.0).abs() <= 1.0, "{}", border.gradient);
        let bbox = crop.bbox.unwrap();
        for (x, y) in [(3, 15), (32, 15), (15, 3), (15, 26)] {
            assert_eq!(found.labels[((y - bbox.y) * bbox.width + x - bbox.x) as usize], NONE, "({x}, {y})");
        }
    }

    #[test]
    fn noise_of_a_few_levels_does_not_part_a_flat_area() {
        let color = |x: u32, y: u32| [120 + ((x * 7 + y * 13) % 5) as u8; 3];
        let (found, _) = part(&Scene::new([60, 50], color, |x, y| in_box(x, y, 10..50, 10..40), &[&[1]]));
        assert_eq!((found.basins.len(), found.borders.len()), (1, 0));
    }

    #[test]
    fn pixels_of_another_region_are_in_no_basin() {
        let label = |x, y| in_box(x, y, 5..20, 5..20) + 2 * in_box(x, y, 22..35, 5..20);
        let (found, crop) = part(&Scene::new([40, 25], |_, _| [90; 3], label, &[&[1], &[2]]));
        let row = &found.labels[10 * crop.width()..11 * crop.width()];
        let own: Vec<usize> = (0..row.len()).filter(|&x| row[x] != NONE).collect();
        assert_eq!(own, (1..21).collect::<Vec<_>>());
    }

    #[test]
    fn a_region_without_partitions_has_none() {
        let scene = Scene::new([5, 5], |_, _| [90; 3], |_, _| 0, &[&[]]);
        let (mut basins, _) = part(&Scene::new([5, 5], |_, _| [90; 3], |_, _| 0, &[&[0]]));
        assert_eq!(basins.basins.len(), 1);
        part_into(&scene, &mut basins);
        assert!(basins.labels.is_empty() && basins.basins.is_empty() && basins.borders.is_empty());
    }

    proptest! {
        /// Crops of any size, from one pixel on.
        #[test]
        fn basins_part_what_the_region_may_have(
            width in 1u32..30,
            height in 1u32..14,
            step in 1u8..120,
            bytes in prop::collection::vec(0u8..4, 30 * 14),
            region_size in [1u32..30, 1u32..14],
        ) {
            let at = |x: u32, y: u32| bytes[(y * 30 + x) as usize];
            let color = |x: u32, y: u32| [at(x, y) * (step / 2), at(y, x % 14), 80 + at(x, y) / 2 * step];
            let [w, h] = region_size;
            let is_whole = w >= width && h >= height;
            let label = |x, y| u32::from(!is_whole && x < w && y < h);
            let regions: &[&[u32]] = if is_whole { &[&[0]] } else { &[&[1]] };
            let scene = Scene::new([width, height], color, label, regions);
            let (found, crop) = part(&scene);
            let (w, n) = (crop.width(), found.labels.len());
            prop_assert_eq!(n, crop.owners().len());
            for (&label, &owner) in found.labels.iter().zip(crop.owners()) {
                prop_assert_eq!(label != NONE, has_right(owner));
                prop_assert!(label == NONE || (label as usize) < found.basins.len());
            }
            // Every basin is what a flood from its seed reaches.
            let bbox = crop.bbox.unwrap();
            for (label, basin) in (0..).zip(&found.basins) {
                let mut seen = vec![false; n];
                let mut stack = vec![(basin.seed[1] - bbox.y) as usize * w + (basin.seed[0] - bbox.x) as usize];
                while let Some(i) = stack.pop() {
                    if found.labels[i] == label && !std::mem::replace(&mut seen[i], true) {
                        stack.extend([(i % w > 0).then(|| i - 1), i.checked_sub(w)].into_iter().flatten());
                        stack.extend([(i % w + 1 < w).then_some(i + 1), Some(i + w)].into_iter().flatten().filter(|&i| i < n));
                    }
                }
                let pixels = found.labels.iter().filter(|&&l| l == label).count();
                prop_assert_eq!(seen.iter().filter(|&&s| s).count(), pixels);
                prop_assert_eq!(basin.pixels, pixels as f32);
                prop_assert!(basin.color.iter().chain(&basin.center).all(|v| v.is_finite()));
            }
            let mut pairs = std::collections::BTreeMap::<(u32, u32), f32>::new();
            for i in 0..n {
                let right = (i % w + 1 < w).then_some(i + 1);
                for other in [right, Some(i + w).filter(|&i| i < n)].into_iter().flatten() {
                    let (a, b) = (found.labels[i], found.labels[other]);
                    if a != b && a != NONE && b != NONE {
                        *pairs.entry((a.min(b), a.max(b))).or_default() += 1.0;
                    }
                }
            }
            let borders: Vec<_> = found.borders.iter().map(|border| ((border.a, border.b), border.length)).collect();
            prop_assert_eq!(borders, pairs.into_iter().collect::<Vec<_>>());
            prop_assert!(found.borders.iter().all(|border| border.gradient >= f32::from(FLAT) && border.gradient <= 255.0));
            // The memory of a larger crop says nothing.
            let mut used = part(&Scene::new([40, 40], color_of_stripes, |_, _| 0, &[&[0]])).0;
            part_into(&scene, &mut used);
            prop_assert_eq!(&used.labels, &found.labels);
            prop_assert_eq!(format!("{:?}{:?}", used.basins, used.borders), format!("{:?}{:?}", found.basins, found.borders));
        }
    }

    fn color_of_stripes(x: u32, y: u32) -> [u8; 3] {
        [(x / 5 * 29 % 256) as u8, (y / 3 * 31 % 256) as u8, 7]
    }
}
