//! Random partitions, and the saliency written as plainly as possible: an oracle that sums over pixels.

#![allow(dead_code, reason = "each test program uses its part")]
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "helpers of tests fail by panicking, too")]

use proptest::prelude::*;
use samsod_saliency::{Method, Saliency, SaliencyMap, SaliencyParams, Scales};
use samsod_segment::{Partition, RgbView};

/// A label image and the colours under it.
#[derive(Clone)]
pub(crate) struct Picture {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) labels: Vec<u32>,
    pub(crate) rgb: Vec<[u8; 3]>,
}

impl std::fmt::Debug for Picture {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let count = self.labels.iter().max().map_or(0, |l| l + 1);
        write!(f, "Picture {} x {} of {count} partitions", self.width, self.height)
    }
}

impl Picture {
    /// Labels row by row and one colour a label.
    pub(crate) fn new(width: usize, labels: &[u32], colours: &[[u8; 3]]) -> Self {
        let rgb = labels.iter().map(|&l| colours[l as usize]).collect();
        Self { width, height: labels.len() / width, labels: labels.to_vec(), rgb }
    }

    pub(crate) fn partition(&self) -> Partition {
        let view = RgbView::from_raw(self.width as u32, self.height as u32, self.rgb.as_flattened()).unwrap();
        Partition::from_labels(&view, self.labels.clone()).expect("dense labels")
    }

    /// The picture whose pixel (x, y) is that at `from(x, y)` of this one.
    pub(crate) fn rearranged(
        &self,
        width: usize,
        height: usize,
        from: impl Fn(usize, usize) -> (usize, usize),
    ) -> Self {
        let index = |i: usize| {
            let (x, y) = from(i % width, i / width);
            y * self.width + x
        };
        Self {
            width,
            height,
            labels: (0..width * height).map(|i| self.labels[index(i)]).collect(),
            rgb: (0..width * height).map(|i| self.rgb[index(i)]).collect(),
        }
    }
}

/// SplitMix64: small, and the same everywhere.
pub(crate) struct Dice(pub(crate) u64);

impl Dice {
    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// A whole number in 0..n.
    pub(crate) fn below(&mut self, n: usize) -> usize {
        (self.next() % n as u64) as usize
    }
}

/// A picture of up to `most` partitions: every pixel belongs to the nearest of some seeds; colours are noisy, those of
/// the first two partitions far apart.
pub(crate) fn cells_picture(width: usize, height: usize, most: usize, seed: u64) -> Picture {
    let mut dice = Dice(seed);
    let seeds: Vec<(usize, usize)> = (0..most).map(|_| (dice.below(width), dice.below(height))).collect();
    let nearest = |x: usize, y: usize| {
        let squared = |&(sx, sy): &(usize, usize)| sx.abs_diff(x).pow(2) + 2 * sy.abs_diff(y).pow(2);
        (0..seeds.len()).min_by_key(|&i| (squared(&seeds[i]), i)).unwrap_or(0)
    };
    let by_seed: Vec<usize> = (0..width * height).map(|i| nearest(i % width, i / width)).collect();
    // Dense labels, in the order in which seeds appear.
    let mut numbers = vec![None; most];
    let mut count = 0;
    let labels: Vec<u32> = by_seed
        .iter()
        .map(|&s| {
            *numbers[s].get_or_insert_with(|| {
                count += 1;
                count - 1
            })
        })
        .collect();
    let mut colours: Vec<[u8; 3]> = (0..most).map(|_| [0; 3].map(|_| 5 + dice.below(246) as u8)).collect();
    colours[0] = [20, 30, 40];
    colours[1] = [220, 180, 200];
    let noisy = |c: u8, dice: &mut Dice| c - 5 + dice.below(11) as u8;
    let rgb = labels.iter().map(|&l| colours[l as usize].map(|c| noisy(c, &mut dice))).collect();
    Picture { width, height, labels, rgb }
}

/// Random pictures within these sides.
pub(crate) fn pictures(sides: std::ops::RangeInclusive<usize>, most: usize) -> impl Strategy<Value = Picture> {
    (sides.clone(), sides, 2..=most, any::<u64>())
        .prop_map(|(width, height, most, seed)| cells_picture(width, height, most, seed))
}

pub(crate) fn saliency(method: Method, scales: &Scales) -> Saliency {
    Saliency::new(SaliencyParams { method, scales: scales.clone(), ..SaliencyParams::default() })
        .expect("parameters in range")
}

pub(crate) fn map_of(partition: &Partition, method: Method, scales: &Scales) -> SaliencyMap {
    saliency(method, scales).compute(partition).expect("has pixels")
}

pub(crate) fn largest_difference(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

pub(crate) fn mean_difference(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum::<f32>() / a.len() as f32
}

/// Standard deviations of the generic scales for an image of this size, px: {3, 5, 7} and {19, 23, 29} at 256 px.
pub(crate) fn generic(width: usize, height: usize) -> (Vec<f64>, Vec<f64>) {
    let scale = width.max(height) as f64 / 256.0;
    ([3.0, 5.0, 7.0].map(|s| s * scale).to_vec(), [19.0, 23.0, 29.0].map(|s| s * scale).to_vec())
}

/// The saliency by eqs 2 to 14, pixel by pixel; divided by the number of pairs of scales.
pub(crate) fn oracle(picture: &Picture, center: &[f64], surround: &[f64]) -> Vec<f64> {
    let pixels = picture.labels.len();
    let mut saliency = vec![0.0; pixels];
    for &sigma_k in center {
        for &sigma_t in surround {
            let of_pair: Vec<f64> = (0..pixels).map(|c| saliency_of_pair(picture, c, sigma_k, sigma_t)).collect();
            // Eq 14. Differences below a thousandth of a grey level are rounding of the partitions' mean colours.
            let largest = of_pair.iter().copied().fold(0.0, f64::max);
            if largest > 1e-3 {
                for (s, pair) in saliency.iter_mut().zip(of_pair) {
                    *s += pair / largest / (center.len() * surround.len()) as f64;
                }
            }
        }
    }
    saliency
}

/// S of one pair of scales at pixel number `c`: eqs 12 and 13, with sigma_t in the second numerator of eq 12.
fn saliency_of_pair(picture: &Picture, c: usize, sigma_k: f64, sigma_t: f64) -> f64 {
    let (mask_k, mask_t) = (mask(picture, c, sigma_k), mask(picture, c, sigma_t));
    let (sum_k, sum_t) = (mask_k.iter().sum::<f64>(), mask_t.iter().sum::<f64>());
    let mut total = [0.0; 3];
    for ((k, t), image) in mask_k.iter().zip(&mask_t).zip(&picture.rgb) {
        let operator = k / sum_k - t / sum_t;
        for (sum, value) in total.iter_mut().zip(image) {
            *sum += operator * f64::from(*value);
        }
    }
    total.iter().map(|v| v * v).sum::<f64>().sqrt()
}

/// Values of the mask around pixel number `c`, one a pixel of the image: eqs 2 to 11.
fn mask(picture: &Picture, c: usize, sigma: f64) -> Vec<f64> {
    let count = picture.labels.iter().max().map_or(0, |l| *l as usize + 1);
    let place = |i: usize| ((i % picture.width) as f64, (i / picture.width) as f64);
    let (xc, yc) = place(c);
    let mut gaussians = vec![0.0; count];
    let mut in_disc = vec![0.0; count];
    let (mut left, mut right) = (vec![f64::INFINITY; count], vec![0.0f64; count]);
    let (mut top, mut bottom) = (vec![f64::INFINITY; count], vec![0.0f64; count]);
    let gaussian = |d2: f64| (-d2 / (2.0 * sigma * sigma)).exp() / (2.0 * std::f64::consts::PI * sigma * sigma);
    for (p, &label) in picture.labels.iter().enumerate() {
        let (i, (x, y)) = (label as usize, place(p));
        let d2 = (x - xc) * (x - xc) + (y - yc) * (y - yc);
        if d2 <= 9.0 * sigma * sigma {
            gaussians[i] += gaussian(d2);
            in_disc[i] += 1.0;
        }
        (left[i], right[i]) = (left[i].min(x), right[i].max(x));
        (top[i], bottom[i]) = (top[i].min(y), bottom[i].max(y));
    }
    let value = |i: usize| {
        if i == picture.labels[c] as usize {
            gaussian(0.0)
        } else if in_disc[i] == 0.0 {
            0.0
        } else {
            let t = (xc - left[i]).abs().max((xc - right[i]).abs()) + (yc - top[i]).abs().max((yc - bottom[i]).abs());
            gaussians[i] / in_disc[i] * (1.0 - t / (picture.width + picture.height) as f64)
        }
    };
    let values: Vec<f64> = (0..count).map(value).collect();
    picture.labels.iter().map(|&label| values[label as usize]).collect()
}
