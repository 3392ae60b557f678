//! Fine partitions of a region: the catchment basins of the colour gradient.
//!
//! The proto-object partitions are coarse where a grey part meets its grey shadow. Inside regions, which are few, the
//! frame is parted anew at full size: every basin of the gradient (watershed by flooding, without lines) lies on one side
//! of every edge that the camera saw.

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
    squares: Vec<u32>,
    gradient: Vec<u8>,
    flood: Flood,
    sums: Vec<Sum>,
    meetings: Vec<Meeting>,
}

/// The sheets of the flooding: those of the crop with a pixel more on each side, so that every pixel has four
/// neighbours.
#[derive(Debug, Default)]
struct Flood {
    /// Gradient above [`FLAT`].
    level: Vec<u8>,
    /// [`WET`] until water comes, then its basin; [`NONE`] where no water goes.
    labels: Vec<u32>,
    /// Pixels by gradient.
    order: Vec<u32>,
    /// The pixel that follows in the queue of its level; of pixels that were never queued whatever was there.
    next_in_queue: Vec<u32>,
}

/// No basin yet.
const WET: u32 = NONE - 1;

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
        for (y, gradients) in self.gradient.chunks_exact_mut(width).enumerate() {
            let line = |y: usize| &self.smooth[y * row..(y + 1) * row];
            let (above, here, below) = (line(y.saturating_sub(1)), line(y), line((y + 1).min(height - 1)));
            for ((square, &a), &b) in self.squares.iter_mut().zip(above).zip(below) {
                *square = u32::from(a.abs_diff(b)).pow(2);
            }
            // At the border the crop goes on as it ends: the difference is over one pixel.
            let mut add = |i: usize, left: usize, right: usize| {
                self.squares[i] += u32::from(here[left].abs_diff(here[right])).pow(2);
            };
            for c in 0..3 {
                add(c, c, (c + 3).min(row - 3 + c));
                if width > 1 {
                    add(row - 3 + c, row - 6 + c, row - 3 + c);
                }
            }
            if width > 2 {
                for ((square, &a), &b) in self.squares[3..row - 3].iter_mut().zip(here).zip(&here[6..]) {
                    *square += u32::from(a.abs_diff(b)).pow(2);
                }
            }
            for (gradient, &[r, g, b]) in gradients.iter_mut().zip(self.squares.as_chunks::<3>().0) {
                let largest = r.max(g).max(b) as f32;
                *gradient = (largest.sqrt().min(255.0) as u8).saturating_sub(FLAT);
            }
        }
    }

    /// Watershed by flooding from the lowest gradient up: water flows from pixel to pixel, breadth first within a level, and
    /// what none has reached at its level starts a new basin.
    fn flood(&mut self, crop: &Crop, bbox: BoundingBox) {
        let width = bbox.width as usize;
        let stride = width + 2;
        let Flood { level, labels, order, next_in_queue } = &mut self.flood;
        let padded = stride * (bbox.height as usize + 2);
        level.resize(padded, 0);
        next_in_queue.resize(padded, NONE);
        labels.clear();
        labels.resize(padded, NONE);
        let mut starts = [0u32; 257];
        let rows = self.gradient.chunks_exact(width).zip(crop.owners().chunks_exact(width));
        let padded_rows = level[stride..].chunks_exact_mut(stride).zip(labels[stride..].chunks_exact_mut(stride));
        for ((level, labels), (gradients, owners)) in padded_rows.zip(rows) {
            level[1..=width].copy_from_slice(gradients);
            for ((label, &gradient), &owner) in labels[1..=width].iter_mut().zip(gradients).zip(owners) {
                if has_right(owner) {
                    *label = WET;
                    starts[gradient as usize + 1] += 1;
                }
            }
        }
        for g in 0..256 {
            starts[g + 1] += starts[g];
        }
        order.clear();
        order.resize(starts[256] as usize, 0);
        let mut next = starts;
        for (i, (&g, _)) in (0u32..).zip(level.iter().zip(labels.iter())).filter(|(_, (_, label))| **label == WET) {
            order[next[g as usize] as usize] = i;
            next[g as usize] += 1;
        }
        // Pixels that water has reached, first in, first out, by the level at which it covers them.
        let mut queues = [(NONE, NONE); 256];
        for g in 0..=u8::MAX {
            let mut seeds = order[starts[g as usize] as usize..starts[g as usize + 1] as usize].iter();
            loop {
                while queues[g as usize].0 != NONE {
                    let i = queues[g as usize].0 as usize;
                    queues[g as usize].0 = next_in_queue[i];
                    let label = labels[i];
                    for n in around(i, stride) {
                        if labels[n] == WET {
                            labels[n] = label;
                            enqueue(&mut queues[level[n].max(g) as usize], next_in_queue, n as u32);
                        }
                    }
                }
                let Some(&seed) = seeds.by_ref().find(|&&i| labels[i as usize] == WET) else { break };
                labels[seed as usize] = self.basins.len() as u32;
                let (x, y) = (seed % stride as u32 - 1, seed / stride as u32 - 1);
                self.basins.push(Basin { seed: [bbox.x + x, bbox.y + y], ..Basin::default() });
                enqueue(&mut queues[g as usize], next_in_queue, seed);
            }
        }
        self.labels.clear();
        for row in labels[stride..].chunks_exact(stride).take(bbox.height as usize) {
            self.labels.extend_from_slice(&row[1..=width]);
        }
    }

    fn measure(&mut self, input: &Input<'_>, bbox: BoundingBox) {
        let width = bbox.width as usize;
        let (stride, pixels, lut) = (input.partition.width() as usize, input.frame.as_raw(), linear_table());
        self.sums.clear();
        self.sums.resize(self.basins.len(), Sum::default());
        let rows = self.labels.chunks_exact(width).zip(self.gradient.chunks_exact(width));
        for (y, (labels, gradients)) in (bbox.y..).zip(rows) {
            let start = 3 * (y as usize * stride + bbox.x as usize);
            let colors = pixels[start..].as_chunks::<3>().0;
            for (((x, &label), &gradient), color) in (bbox.x..).zip(labels).zip(gradients).zip(colors) {
                let Some(sum) = self.sums.get_mut(label as usize) else { continue };
                sum.pixels += 1;
                sum.center = [sum.center[0] + u64::from(x), sum.center[1] + u64::from(y)];
                let (of, count) = if gradient == 0 {
                    (&mut sum.flat_color, &mut sum.flat_pixels)
                } else if sum.flat_pixels == 0 {
                    (&mut sum.slope_color, &mut sum.slope_pixels)
                } else {
                    // The flat pixels alone will count.
                    continue;
                };
                *count += 1;
                *of = std::array::from_fn(|c| of[c] + f64::from(lut[color[c] as usize]));
            }
        }
        for (basin, sum) in self.basins.iter_mut().zip(&self.sums) {
            let (color, of) = if sum.flat_pixels > 0 {
                (sum.flat_color, sum.flat_pixels)
            } else {
                (sum.slope_color, sum.slope_pixels)
            };
            basin.pixels = sum.pixels as f32;
            basin.color = color.map(|c| (c / f64::from(of)) as f32);
            basin.center = sum.center.map(|c| (c as f64 / f64::from(sum.pixels)) as f32);
        }
    }

    fn find_borders(&mut self, width: usize) {
        let Self { labels, gradient, meetings, borders, .. } = self;
        meetings.clear();
        // Pixels that touch those beside them and below; a border that runs along a row meets pixel by pixel.
        let (mut beside, mut below) = (Meeting::default(), Meeting::default());
        for (y, (here, steep)) in labels.chunks_exact(width).zip(gradient.chunks_exact(width)).enumerate() {
            for (pair, steep) in here.windows(2).zip(steep.windows(2)) {
                if pair[0] != pair[1] && pair[0] != NONE && pair[1] != NONE {
                    beside.take(pair[0], pair[1], steep[0].max(steep[1]), meetings);
                }
            }
            let next = (y + 1) * width;
            let pairs = here.iter().zip(steep).zip(labels[next..].iter().zip(&gradient[next..]));
            for ((&label, &steep), (&other, &other_steep)) in pairs {
                if label != other && label != NONE && other != NONE {
                    below.take(label, other, steep.max(other_steep), meetings);
                }
            }
        }
        meetings.extend([beside, below].into_iter().filter(|meeting| meeting.length > 0));
        meetings.sort_unstable_by_key(|meeting| meeting.pair);
        borders.extend(meetings.chunk_by(|p, q| p.pair == q.pair).map(|meetings| {
            // Whole numbers: the order of equal pairs does not matter.
            let length = meetings.iter().map(|meeting| meeting.length).sum::<u32>() as f32;
            let steepness = meetings.iter().map(|meeting| u64::from(meeting.steepness)).sum::<u64>() as f32;
            let pair = meetings[0].pair;
            let (a, b) = ((pair >> 32) as u32, pair as u32);
            Border { a, b, length, gradient: steepness / length + f32::from(FLAT) }
        }));
    }
}

/// Sums over a basin, in f64 or whole: it may have millions of pixels, of which sums in f32 lose percents.
#[derive(Debug, Clone, Copy, Default)]
struct Sum {
    pixels: u32,
    center: [u64; 2],
    flat_pixels: u32,
    flat_color: [f64; 3],
    /// Those on the slopes, until a flat one is found.
    slope_pixels: u32,
    slope_color: [f64; 3],
}

/// Pixels of two basins that touch, one after the other.
#[derive(Debug, Clone, Copy, Default)]
struct Meeting {
    /// The smaller label above the larger one.
    pair: u64,
    length: u32,
    /// Sum of the gradients above [`FLAT`].
    steepness: u32,
}

impl Meeting {
    /// Takes another pair of pixels; where other basins meet in it, what was taken before is put to `done`.
    fn take(&mut self, a: u32, b: u32, gradient: u8, done: &mut Vec<Self>) {
        let pair = u64::from(a.min(b)) << 32 | u64::from(a.max(b));
        if pair != self.pair && self.length > 0 {
            done.push(*self);
            *self = Self::default();
        }
        self.pair = pair;
        self.length += 1;
        self.steepness += u32::from(gradient);
    }
}

/// Appends a pixel to a queue of (first, last), linked by the table of followers.
fn enqueue(queue: &mut (u32, u32), next_in_queue: &mut [u32], pixel: u32) {
    if queue.0 == NONE {
        queue.0 = pixel;
    } else {
        next_in_queue[queue.1 as usize] = pixel;
    }
    next_in_queue[pixel as usize] = NONE;
    queue.1 = pixel;
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
