//! Settles the outline of the objects pixel by pixel.
//!
//! Pieces end where the gradient of the colour is steepest. That is a pixel beside the outline as often as on it: a lit edge of a
//! part is steeper than the step to its shadow, the shaded side of a part is not steeper than that to the shadow it stands
//! in. So every pixel at the outline of the pieces that are judged part is asked once more, by the light along a line
//! across the outline, its tint, and what the pieces on both sides are. Fitted trees answer, as for pieces (`judgement`).
//!
//! In: codes, pieces and the smoothed colours of a crop. Out: codes of pixels up to some 2 px from an outline.

use rayon::prelude::*;
use samsod_segment::BoundingBox;

use crate::basins::{Basins, NONE};
use crate::crop::{Crop, OBJECT, SHADOW, TABLE};
use crate::evidence::{PENUMBRA_BRIGHTNESS, Piece};
use crate::forest::{Forest, LANES, Tree};
use crate::table_model::{brightness, linear_table};

/// Number of signs of a pixel at an outline.
pub(crate) const FRINGE_SIGN_COUNT: usize = 2 + ACROSS_PX.len() + 2 * TINT_AT.len() + 3 * SIDES_AT.len() + 2;

/// Where the light is read, px along the normal of the outline, towards the object.
const ACROSS_PX: [f32; 9] = [-4.0, -2.5, -1.5, -0.75, 0.0, 0.75, 1.5, 2.5, 4.0];
/// Of these, where the tint is,
const TINT_AT: [usize; 3] = [1, 4, 7];
/// and where the pieces are that lie on both sides.
const SIDES_AT: [usize; 2] = [1, 7];

/// What the signs of a pixel at an outline are called, in their order.
///
/// - `object`: whether its piece is judged part (and is no hole), 0 or 1; `share`: of the object in a smooth window of 7 x 7 px round
///   it
/// - `light_*`: brightness against the table, so many px along the normal of the outline, towards the object
/// - `red_*`, `blue_*`: what is left of the difference to the table in that light, over the mean of the table's channels
/// - `part_*`, `table_*`, `difference_*`: of the pieces outside and inside, as signs of pieces have them; `part`, `light`: of its own piece
pub const FRINGE_SIGNS: [&str; FRINGE_SIGN_COUNT] = [
    "object",
    "share",
    "light_-4",
    "light_-2.5",
    "light_-1.5",
    "light_-0.75",
    "light_0",
    "light_0.75",
    "light_1.5",
    "light_2.5",
    "light_4",
    "red_-2.5",
    "blue_-2.5",
    "red_0",
    "blue_0",
    "red_2.5",
    "blue_2.5",
    "part_outside",
    "table_outside",
    "difference_outside",
    "part_inside",
    "table_inside",
    "difference_inside",
    "part",
    "light",
];

/// The signs of a pixel at an outline, in the order of [`FRINGE_SIGNS`].
pub type FringeSigns = [f32; FRINGE_SIGN_COUNT];

/// As `samsod.evaluation.judgement` wrote it.
static FOREST: Forest<FRINGE_SIGN_COUNT, { FRINGE_SIGN_COUNT.next_power_of_two() }, 7, 8> = include!("fringe.in");

/// Binomial window whose sum is 64.
const WINDOW: [u16; 7] = [1, 6, 15, 20, 15, 6, 1];
/// So far it reaches from its middle, px.
const REACH_PX: usize = WINDOW.len() / 2;
/// Sum of the window in both directions.
const WHOLE: u16 = 64 * 64;
/// A pixel is at an outline where the share of the object is neither below this nor above the rest of it.
const LEAST_SHARE: u16 = WHOLE / 14;
/// Light against the table is no less than this where the tint is asked.
const LEAST_LIGHT: f32 = 0.01;
/// Log-odds against an object of less than this leave a pixel to the object that its piece is: where little speaks against it,
/// pieces have looked farther.
const LEAST_ODDS_AGAINST: f32 = 0.5;
/// Pixels that one thread takes at a time.
const PIXELS_AT_A_TIME: usize = 512;

/// Scratch memory of a region, and what was asked of it last.
#[derive(Debug, Default)]
pub(crate) struct Fringe {
    line: Vec<u8>,
    across: Vec<u8>,
    share: Vec<u16>,
    /// The pixels at outlines, by index in the crop, in their order,
    pub(crate) pixels: Vec<u32>,
    /// and their signs, where they are asked for.
    pub(crate) signs: Vec<FringeSigns>,
    objects: Vec<bool>,
}

/// What is seen of a region.
#[derive(Clone, Copy)]
pub(crate) struct FringeView<'a> {
    pub(crate) basins: &'a Basins,
    pub(crate) pieces: &'a [Piece],
}

impl Fringe {
    /// Asks the trees of every pixel at an outline, and writes what they say.
    pub(crate) fn settle(&mut self, region: FringeView<'_>, crop: &mut Crop) {
        let Some(bbox) = self.find(region.basins, crop) else { return };
        let Self { share, pixels, objects, .. } = self;
        let seen = Seen { region, codes: &crop.codes, share, bbox };
        objects.clear();
        objects.extend(pixels.iter().map(|&pixel| crop.codes[pixel as usize] == OBJECT));
        let chunks = objects.par_chunks_mut(PIXELS_AT_A_TIME).zip(pixels.par_chunks(PIXELS_AT_A_TIME));
        chunks.for_each(|(objects, pixels)| {
            let mut columns = [[0.0; LANES]; FRINGE_SIGN_COUNT];
            for (objects, pixels) in objects.chunks_mut(LANES).zip(pixels.chunks(LANES)) {
                seen.signs_of(pixels, &mut columns);
                let odds = FOREST.log_odds_of(&columns);
                objects.iter_mut().zip(odds).for_each(|(object, odds)| *object = is_object(*object, odds));
            }
        });
        self.write(region, crop);
    }

    /// Finds the pixels at outlines, with their signs.
    pub(crate) fn describe(&mut self, region: FringeView<'_>, crop: &Crop) {
        self.signs.clear();
        let Some(bbox) = self.find(region.basins, crop) else { return };
        let seen = Seen { region, codes: &crop.codes, share: &self.share, bbox };
        let mut columns = [[0.0; LANES]; FRINGE_SIGN_COUNT];
        for pixels in self.pixels.chunks(LANES) {
            seen.signs_of(pixels, &mut columns);
            self.signs.extend((0..pixels.len()).map(|lane| columns.map(|column| column[lane])));
        }
    }

    /// Writes another's answers for the pixels found last: probabilities that they show an object.
    pub(crate) fn write_judged(&mut self, region: FringeView<'_>, crop: &mut Crop, probabilities: &[f32]) {
        self.objects.clear();
        let of_pixels = self.pixels.iter().zip(probabilities);
        self.objects.extend(of_pixels.map(|(&pixel, &probability)| {
            is_object(crop.codes[pixel as usize] == OBJECT, (probability / (1.0 - probability)).ln())
        }));
        self.write(region, crop);
    }

    /// The pixels of the region at the outline of its objects, and the share of objects round every pixel. `None` without any.
    fn find(&mut self, basins: &Basins, crop: &Crop) -> Option<BoundingBox> {
        self.pixels.clear();
        let (bbox, width) = (crop.bbox?, crop.width());
        let Self { line, across, share, pixels, .. } = self;
        across.resize(crop.codes.len(), 0);
        share.resize(crop.codes.len(), 0);
        for (to, codes) in across.chunks_exact_mut(width).zip(crop.codes.chunks_exact(width)) {
            // A binomial window is so many sums of neighbours. Beyond the crop there is no object.
            line.clear();
            line.resize(width + 2 * REACH_PX, 0);
            line[REACH_PX..].iter_mut().zip(codes).for_each(|(to, &code)| *to = u8::from(code == OBJECT));
            for left in (width..width + 2 * REACH_PX).rev() {
                for i in 0..left {
                    line[i] += line[i + 1];
                }
            }
            to.copy_from_slice(&line[..width]);
        }
        line.fill(0);
        let row = |y: usize, k: usize| {
            let row = (y + k).checked_sub(REACH_PX).and_then(|row| across.chunks_exact(width).nth(row));
            row.unwrap_or(line)
        };
        let outline = LEAST_SHARE..=WHOLE - LEAST_SHARE;
        let rows = share.chunks_exact_mut(width).zip(basins.labels.chunks_exact(width)).enumerate();
        for (y, (share, labels)) in rows {
            let rows: [&[u8]; WINDOW.len()] = std::array::from_fn(|k| &row(y, k)[..width]);
            for (x, to) in share.iter_mut().enumerate() {
                *to = rows.iter().zip(WINDOW).map(|(row, weight)| weight * u16::from(row[x])).sum();
            }
            let first = y * width;
            for ((share, labels), at) in share.chunks(LANES).zip(labels.chunks(LANES)).zip((first..).step_by(LANES)) {
                if share.iter().fold(false, |any, share| any | outline.contains(share)) {
                    let found = share.iter().zip(labels).zip(at as u32..);
                    pixels.extend(
                        found.filter(|((share, label), _)| outline.contains(share) && **label != NONE).map(|(_, i)| i),
                    );
                }
            }
        }
        (!self.pixels.is_empty()).then_some(bbox)
    }

    fn write(&self, region: FringeView<'_>, crop: &mut Crop) {
        let FringeView { basins, pieces } = region;
        for (&pixel, &object) in self.pixels.iter().zip(&self.objects) {
            let i = pixel as usize;
            if object {
                crop.codes[i] = OBJECT;
            } else if crop.codes[i] == OBJECT {
                let piece = basins.labels.get(i).and_then(|&label| pieces.get(label as usize));
                let is_dark =
                    piece.is_some_and(|piece| brightness(color_at(basins, i), piece.bare) < PENUMBRA_BRIGHTNESS);
                crop.codes[i] = if is_dark { SHADOW } else { TABLE };
            }
        }
    }
}

/// Whether a pixel shows an object: one whose piece is, or is none, by what its signs say.
fn is_object(is_piece: bool, odds: f32) -> bool {
    odds > if is_piece { -LEAST_ODDS_AGAINST } else { 0.0 }
}

/// Smoothed colour of a pixel of the crop, linear light.
fn color_at(basins: &Basins, i: usize) -> [f32; 3] {
    let lut = linear_table();
    basins.smooth.as_chunks::<3>().0.get(i).map_or([0.0; 3], |color| color.map(|level| lut[usize::from(level)]))
}

struct Seen<'a> {
    region: FringeView<'a>,
    codes: &'a [u8],
    share: &'a [u16],
    bbox: BoundingBox,
}

impl Seen<'_> {
    /// Writes the signs of up to [`LANES`] pixels, sign by sign. Steps of arithmetic are done for all of them side by side;
    /// columns beyond the last pixel hold anything.
    fn signs_of(&self, pixels: &[u32], columns: &mut [[f32; LANES]; FRINGE_SIGN_COUNT]) {
        let FringeView { basins, pieces } = self.region;
        let BoundingBox { width, height, .. } = self.bbox;
        let (smooth, lut) = (basins.smooth.as_chunks::<3>().0, linear_table());
        let piece = |place: u32| pieces.get(*basins.labels.get(place as usize)? as usize);
        let share = |x: u32, y: u32| f32::from(self.share[(y * width + x) as usize]);
        let (own, rest) = columns.split_at_mut(2);
        let (lights, rest) = rest.split_at_mut(ACROSS_PX.len());
        let (tints, rest) = rest.split_at_mut(2 * TINT_AT.len());
        let (sides, of_piece) = rest.split_at_mut(3 * SIDES_AT.len());

        let (mut place, mut slope, mut bare) = ([[0.0; LANES]; 2], [[0.0f32; LANES]; 2], [[0.2; LANES]; 3]);
        for (lane, &pixel) in pixels.iter().enumerate() {
            let (x, y) = (pixel % width, pixel / width);
            (place[0][lane], place[1][lane]) = (x as f32, y as f32);
            slope[0][lane] = share((x + 1).min(width - 1), y) - share(x.saturating_sub(1), y);
            slope[1][lane] = share(x, (y + 1).min(height - 1)) - share(x, y.saturating_sub(1));
            own[0][lane] = f32::from(u8::from(self.codes[pixel as usize] == OBJECT));
            own[1][lane] = share(x, y) / f32::from(WHOLE);
            // The table hardly changes over a piece; every pixel at an outline is of one.
            if let Some(piece) = piece(pixel) {
                (0..3).for_each(|c| bare[c][lane] = piece.bare[c]);
                (of_piece[0][lane], of_piece[1][lane]) = (piece.part, piece.brightness);
            } else {
                (of_piece[0][lane], of_piece[1][lane]) = (0.0, 1.0);
            }
        }
        let (mut mean, mut per_light) = ([0.0; LANES], [[0.0; LANES]; 3]);
        for lane in 0..LANES {
            let [red, green, blue] = [bare[0][lane], bare[1][lane], bare[2][lane]];
            mean[lane] = (red + green + blue) / 3.0;
            // Brightness against the table is the product with this.
            let square = (red * red + green * green + blue * blue).max(1e-9);
            [per_light[0][lane], per_light[1][lane], per_light[2][lane]] =
                [red / square, green / square, blue / square];
            let steepness = (slope[0][lane] * slope[0][lane] + slope[1][lane] * slope[1][lane]).sqrt().max(1.0);
            (slope[0][lane], slope[1][lane]) = (slope[0][lane] / steepness, slope[1][lane] / steepness);
        }
        let (right, bottom) = ((width - 1) as f32, (height - 1) as f32);
        for (k, px) in ACROSS_PX.into_iter().enumerate() {
            let (mut column, mut row) = ([0; LANES], [0; LANES]);
            for lane in 0..LANES {
                column[lane] = rounded(place[0][lane] + px * slope[0][lane], right);
                row[lane] = rounded(place[1][lane] + px * slope[1][lane], bottom);
            }
            let mut places = [0; LANES];
            let mut color = [[0.0; LANES]; 3];
            for lane in 0..LANES {
                places[lane] = row[lane] * width + column[lane];
                let [red, green, blue] = smooth.get(places[lane] as usize).copied().unwrap_or_default();
                color[0][lane] = lut[usize::from(red)];
                color[1][lane] = lut[usize::from(green)];
                color[2][lane] = lut[usize::from(blue)];
            }
            let mut light = [0.0; LANES];
            for lane in 0..LANES {
                light[lane] = color[0][lane] * per_light[0][lane]
                    + color[1][lane] * per_light[1][lane]
                    + color[2][lane] * per_light[2][lane];
            }
            lights[k] = light;
            if let Some(at) = TINT_AT.iter().position(|&at| at == k) {
                let mut tint = [[0.0; LANES]; 2];
                for lane in 0..LANES {
                    let light = light[lane].max(LEAST_LIGHT);
                    tint[0][lane] = (color[0][lane] / light - bare[0][lane]) / mean[lane];
                    tint[1][lane] = (color[2][lane] / light - bare[2][lane]) / mean[lane];
                }
                tints[2 * at..2 * at + 2].copy_from_slice(&tint);
            }
            if let Some(side) = SIDES_AT.iter().position(|&at| at == k) {
                for (lane, &place) in places.iter().enumerate() {
                    // Beyond the region there is nothing but table.
                    let of_piece = piece(place).map_or([0.0, 1.0, 0.0], |p| [p.part, p.table, p.difference]);
                    (0..3).for_each(|sign| sides[3 * side + sign][lane] = of_piece[sign]);
                }
            }
        }
    }
}

/// The whole number that is nearest, from 0 to a last one below 2^22. The sum with the constant has it in its lowest bits,
/// which is done for a whole register; `as` is done number by number.
#[inline(always)]
fn rounded(value: f32, last: f32) -> u32 {
    const ROUNDING: f32 = (3 << 22) as f32;
    (value.max(0.0).min(last) + ROUNDING).to_bits().wrapping_sub(ROUNDING.to_bits())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evidence::Evidence;
    use crate::separator::Input;
    use crate::separator::tests::Scene;
    use crate::signs::tests::shaded;

    /// Describes the pieces, and writes those as part that are mostly red.
    fn judge(input: &Input<'_>, crops: &mut [Crop], evidence: &mut Evidence) {
        evidence.describe(input, crops);
        let (labels, signs) = evidence.described(1).next().unwrap();
        let bbox = crops[0].bbox.unwrap();
        let mut red_over_other = vec![0; signs.len()];
        for (i, &label) in (0u32..).zip(labels).filter(|(_, label)| **label != NONE) {
            let (x, y) = (bbox.x + i % bbox.width, bbox.y + i / bbox.width);
            let is_red = (30..70).contains(&x) && (20..60).contains(&y);
            red_over_other[label as usize] += if is_red { 1 } else { -1 };
        }
        let parts: Vec<f32> = red_over_other.into_iter().map(|over| f32::from(u8::from(over > 0))).collect();
        evidence.write_judged(crops, &parts);
    }

    /// The signs of the pixel at a place, if it is at an outline.
    fn signs_at(evidence: &Evidence, bbox: BoundingBox, x: u32, y: u32) -> Option<FringeSigns> {
        let (pixels, signs) = evidence.described_fringes(1).next().unwrap();
        let i = (y - bbox.y) * bbox.width + x - bbox.x;
        pixels.iter().position(|&pixel| pixel == i).map(|at| signs[at])
    }

    fn sign(signs: &FringeSigns, name: &str) -> f32 {
        signs[FRINGE_SIGNS.iter().position(|sign| *sign == name).unwrap()]
    }

    #[test]
    fn names_are_told_apart() {
        let mut names = FRINGE_SIGNS.to_vec();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), FRINGE_SIGN_COUNT);
    }

    #[test]
    fn every_question_is_about_a_sign() {
        let asked = FOREST.trees.iter().flat_map(|tree| tree.questions).map(|(sign, _)| usize::from(sign));
        assert!(asked.into_iter().all(|sign| sign < FRINGE_SIGN_COUNT));
        assert!(!FOREST.trees.is_empty());
        assert!(FOREST.middles.iter().chain(&FOREST.steps).all(|scale| scale.is_finite()));
    }

    #[test]
    fn what_lies_across_an_outline() {
        shaded().show(|input, crops| {
            let mut evidence = Evidence::default();
            judge(input, crops, &mut evidence);
            evidence.describe_fringes(crops);
            let bbox = crops[0].bbox.unwrap();
            let signs = signs_at(&evidence, bbox, 69, 40).expect("the last column of the part");
            assert!(sign(&signs, "share") > 0.4 && sign(&signs, "share") < 0.8, "{}", sign(&signs, "share"));
            assert_eq!((sign(&signs, "part_inside"), sign(&signs, "part_outside")), (1.0, 0.0));
            // To the right the table in a quarter of its light, to the left red.
            assert!((sign(&signs, "light_-2.5") - 0.25).abs() < 0.03, "{}", sign(&signs, "light_-2.5"));
            assert!(sign(&signs, "red_-2.5").abs() < 0.1 && sign(&signs, "red_2.5") > 1.0);
            assert!(sign(&signs, "difference_inside") > 40.0 && sign(&signs, "difference_outside") < 10.0);
            // Neither the middle of the part is at an outline nor that of the shadow.
            assert_eq!(signs_at(&evidence, bbox, 50, 40), None);
            assert_eq!(signs_at(&evidence, bbox, 85, 40), None);
        });
    }

    #[test]
    fn answers_are_written() {
        shaded().show(|input, crops| {
            let mut evidence = Evidence::default();
            judge(input, crops, &mut evidence);
            evidence.describe_fringes(crops);
            let bbox = crops[0].bbox.unwrap();
            let pixels: Vec<u32> = evidence.described_fringes(1).next().unwrap().0.to_vec();
            let at = |x: u32, y: u32| ((y - bbox.y) * bbox.width + x - bbox.x) as usize;
            let before = crops[0].codes.clone();
            evidence.write_fringes(crops, &vec![1.0; pixels.len()]);
            assert!(pixels.iter().all(|&pixel| crops[0].codes[pixel as usize] == OBJECT));
            crops[0].codes.clone_from(&before);
            evidence.write_fringes(crops, &vec![0.0; pixels.len()]);
            assert!(pixels.iter().all(|&pixel| crops[0].codes[pixel as usize] != OBJECT));
            assert_eq!(crops[0].codes[at(50, 40)], OBJECT, "the middle is not asked");
            assert_eq!(crops[0].codes[at(71, 40)], SHADOW);
        });
    }

    #[test]
    fn a_clear_outline_stays_where_it_is() {
        shaded().show(|input, crops| {
            let mut evidence = Evidence::default();
            judge(input, crops, &mut evidence);
            evidence.settle_fringes(crops);
            let bbox = crops[0].bbox.unwrap();
            let wrong = (0u32..).zip(&crops[0].codes).filter(|&(i, &code)| {
                let (x, y) = (bbox.x + i % bbox.width, bbox.y + i / bbox.width);
                // A pixel either way is let pass: the picture has no blur, which no lens gives.
                let inside = (31..69).contains(&x) && (21..59).contains(&y);
                let outside = !((29..71).contains(&x) && (19..61).contains(&y));
                inside && code != OBJECT || outside && code == OBJECT
            });
            assert_eq!(wrong.count(), 0);
        });
    }

    #[test]
    fn signs_are_numbers_whatever_is_seen() {
        let inside = |x: u32, y: u32| u32::from((8..40).contains(&x) && (5..30).contains(&y));
        for color in [[0; 3], [255; 3], [255, 0, 0]] {
            for table in [[0; 3], [255; 3]] {
                let paint = move |x, y| if inside(x, y) == 1 { color } else { table };
                for (label, region) in [(&inside as &dyn Fn(u32, u32) -> u32, 1), (&|_, _| 0, 0)] {
                    Scene::new([50, 40], paint, label, &[&[region]]).show(|input, crops| {
                        let mut evidence = Evidence::default();
                        evidence.describe(input, crops);
                        let count = evidence.described(1).map(|(_, signs)| signs.len()).sum();
                        let every_other: Vec<f32> = (0u8..).map(|i| f32::from(i % 2)).take(count).collect();
                        evidence.write_judged(crops, &every_other);
                        evidence.describe_fringes(crops);
                        let (_, signs) = evidence.described_fringes(1).next().unwrap();
                        assert!(signs.iter().flatten().all(|sign| sign.is_finite()), "{color:?} on {table:?}");
                    });
                }
            }
        }
    }
}
