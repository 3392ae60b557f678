//! The signs by which a piece is judged, in numbers: its own, those of the groups it belongs to, of what lies ahead in the
//! direction of the shadows, of its region and of the scene.
//!
//! They are made after the rounds of `evidence`, whose odds are among them. Everything is relative to the bare table, to
//! the scene or to the direction of its shadows, so that neither a lamp's place nor its strength enters as such.

use crate::basins::{Basin, Border, NONE};
use crate::evidence::{Piece, RimPiece};
use crate::groups::Groups;
use crate::rim::DIRECTIONS;
use crate::table_model::{TableModel, level};
use crate::tone::Tones;

/// Number of signs of a piece.
pub(crate) const SIGNS: usize = OWN + REGION + AHEAD + 2 * GROUP;
const OWN: usize = 15;
const REGION: usize = 11;
const AHEAD: usize = 2 * AHEAD_PX.len();
const GROUP: usize = 9;

/// What the signs of a piece are called, in their order.
///
/// - `part`: log-odds of a part after the rounds; `odds`: the same by tone and rim alone, a unit of weight; `tone`: by tone
///   alone; `table`: how much it looks like the bare table, in [0, 1]
/// - `light`: logarithm of its brightness against the table; `difference`: what is left of the difference, sRGB levels, and
///   `difference_noise` in the noise of the table; `green` that of green with its sign; `saturation`, `level`: of its colour;
///   `pixels`: logarithm of their number; `light_25`, `light_50`: its light over two quantiles of what is not table in the
///   scene
/// - `rim_sharpness`, `rim_direction`: mean log-odds of its points of the rim
/// - `noise`, `spread`: of the table's colour and brightness; `table_saturation`; `shadow_light`, `shadow_spread`: the light of the
///   scene's shadows, its median and the width of its middle 80 %; `one_sided`: how much shadows lie on one side of parts
/// - `region_*`: share of part, spread of the light, light of the piece over the mean, logarithm of pixels
/// - `ahead_*`: light and probability of a part so many pixels in the direction in which shadows fall
/// - `node_*`, `fine_*`: means over its partition, and over the group of like pieces it belongs to; `rim` and
///   `sharp` of the rim, `border` the length of the group's border for its size, `contrast` the light of what is beyond,
///   `size` the logarithm of its pixels
pub const PIECE_SIGNS: [&str; SIGNS] = [
    "part",
    "odds",
    "tone",
    "table",
    "light",
    "difference",
    "difference_noise",
    "green",
    "saturation",
    "level",
    "pixels",
    "light_25",
    "light_50",
    "rim_sharpness",
    "rim_direction",
    "noise",
    "spread",
    "table_saturation",
    "shadow_light",
    "shadow_spread",
    "one_sided",
    "region_part",
    "region_spread",
    "region_light",
    "region_pixels",
    "region_table",
    "ahead_light_8",
    "ahead_part_8",
    "ahead_light_16",
    "ahead_part_16",
    "ahead_light_32",
    "ahead_part_32",
    "node_tone",
    "node_part",
    "node_table",
    "node_blue",
    "node_rim",
    "node_sharp",
    "node_border",
    "node_contrast",
    "node_size",
    "fine_tone",
    "fine_part",
    "fine_table",
    "fine_blue",
    "fine_rim",
    "fine_sharp",
    "fine_border",
    "fine_contrast",
    "fine_size",
];

/// The signs of a piece, in the order of [`PIECE_SIGNS`].
pub type Signs = [f32; SIGNS];

/// Log-odds are cut here.
const LARGEST_LOG_ODDS: f32 = 6.0;
/// How far ahead is looked, px.
const AHEAD_PX: [f32; 3] = [8.0, 16.0, 32.0];
/// What stands for a probability where there is no piece,
const NO_PART: f32 = -0.2;
/// and for a sharpness where there is no rim.
const NO_RIM: f32 = -0.1;
/// What a group is let off, sRGB levels times pixels.
const SLACK: f32 = 300.0;

/// What holds for the whole scene.
#[derive(Debug)]
pub(crate) struct SceneSigns<'a> {
    table: &'a TableModel,
    tone_odds: &'a Tones,
    direction_odds: [f32; DIRECTIONS],
    /// Unit vector in the image along which shadows fall, and how clearly they do.
    fall: [f32; 2],
    one_sided: f32,
    /// First quarter and median of the logarithm of the light of what is not table.
    light: [f32; 2],
    /// A tenth, the median and nine tenths of that of shadows.
    shadow_light: [f32; 3],
}

impl<'a> SceneSigns<'a> {
    /// `part_by_direction` is how often a rim that faces there is a part's.
    pub(crate) fn of<'p>(
        table: &'a TableModel,
        tone_odds: &'a Tones,
        part_by_direction: &[f32; DIRECTIONS],
        pieces: impl Iterator<Item = &'p Piece>,
    ) -> Self {
        let (mut x, mut y) = (0.0, 0.0);
        for (k, part) in (0u8..).zip(part_by_direction) {
            let angle = f32::from(k) / DIRECTIONS as f32 * std::f32::consts::TAU;
            (x, y) = (x + (0.5 - part) * angle.cos(), y - (0.5 - part) * angle.sin());
        }
        let one_sided = x.hypot(y);
        let (lights, seen): (Vec<f32>, Vec<[f32; 2]>) = pieces
            .map(|piece| {
                let seen = piece.pixels * (1.0 - piece.table);
                (light(piece), [seen, seen * (1.0 - piece.part)])
            })
            .unzip();
        // Light in the upper bits, in the order of the numbers; the index below, so that no two are equal.
        let mut order: Vec<u64> =
            lights.iter().zip(0u64..).map(|(&light, i)| u64::from(ordered(light)) << 32 | i).collect();
        order.sort_unstable();
        let in_order = |which: usize| {
            let indices = order.iter().map(|key| (key & u64::from(u32::MAX)) as usize);
            indices.map(|i| (lights[i], seen[i][which])).collect::<Vec<_>>()
        };
        let (all, shadow) = (in_order(0), in_order(1));
        let of_all = |share| quantile(&all, share);
        let of_shadow = |share| quantile(&shadow, share);
        Self {
            table,
            tone_odds,
            direction_odds: part_by_direction.map(log_odds),
            fall: if one_sided > 0.0 { [x / one_sided, y / one_sided] } else { [1.0, 0.0] },
            one_sided,
            light: [0.25, 0.5].map(of_all),
            shadow_light: [0.1, 0.5, 0.9].map(of_shadow),
        }
    }
}

/// The value below which a share of the weight lies, of (value, weight) in the order of values; 0 of nothing.
fn quantile(values: &[(f32, f32)], share: f32) -> f32 {
    let total: f32 = values.iter().map(|(_, weight)| weight).sum();
    let mut sum = 0.0;
    let mut reached = values.iter().map(|(value, weight)| {
        sum += weight;
        (value, sum)
    });
    reached.find(|(_, sum)| *sum > 0.0 && *sum >= share * total).map_or(0.0, |(value, _)| *value)
}

/// Bits whose order is that of the numbers.
fn ordered(value: f32) -> u32 {
    let bits = value.to_bits();
    if bits >> 31 == 0 { bits | 1 << 31 } else { !bits }
}

/// Logarithm of the brightness against the table.
fn light(piece: &Piece) -> f32 {
    piece.brightness.clamp(0.01, 4.0).ln()
}

fn log_odds(probability: f32) -> f32 {
    let p = probability.clamp(1e-4, 1.0 - 1e-4);
    (p / (1.0 - p)).ln()
}

/// What is known of a region.
#[derive(Clone, Copy)]
pub(crate) struct RegionView<'a> {
    /// Top left of its crop in the image, px, and columns of the crop.
    pub(crate) corner: [u32; 2],
    pub(crate) width: usize,
    /// Piece of every pixel of the crop.
    pub(crate) labels: &'a [u32],
    pub(crate) basins: &'a [Basin],
    pub(crate) borders: &'a [Border],
    pub(crate) pieces: &'a [Piece],
    pub(crate) rim: &'a [RimPiece],
}

/// Sums over the points of a rim.
#[derive(Debug, Clone, Copy, Default)]
struct RimSum {
    points: f32,
    sharpness: f32,
    direction: f32,
}

/// What is needed of a piece more than once.
#[derive(Debug, Clone, Copy, Default)]
struct Known {
    pixels: f32,
    /// Pixels that do not look like the table.
    seen: f32,
    light: f32,
    tone: f32,
    blue: f32,
    rim: RimSum,
}

/// Sums over a group.
#[derive(Debug, Clone, Copy, Default)]
struct GroupSum {
    pixels: f32,
    seen: f32,
    root: f32,
    tone: f32,
    part: f32,
    table: f32,
    blue: f32,
    rim: RimSum,
    border: f32,
    contrast: f32,
}

/// Scratch memory of [`Describer::describe`].
#[derive(Debug, Default)]
pub(crate) struct Describer {
    groups: Groups,
    labels: [Vec<u32>; 2],
    sums: Vec<GroupSum>,
    of_groups: [Vec<[f32; GROUP]>; 2],
    known: Vec<Known>,
}

impl Describer {
    /// Writes the signs of every piece of a region.
    pub(crate) fn describe(&mut self, scene: &SceneSigns<'_>, region: &RegionView<'_>, signs: &mut Vec<Signs>) {
        let pieces = region.pieces;
        self.know(scene, region);
        self.labels[0].clear();
        self.labels[0].extend(pieces.iter().map(|piece| piece.node));
        self.groups.join(region.basins, region.borders, SLACK, &mut self.labels[1]);
        for (labels, signs) in self.labels.iter().zip(&mut self.of_groups) {
            sum_groups(region, &self.known, labels, &mut self.sums);
            signs.clear();
            signs.extend(self.sums.iter().map(GroupSum::signs));
        }
        // The region.
        let (mut pixels, mut seen, mut table, mut part, mut mean, mut square) = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        for (piece, known) in pieces.iter().zip(&self.known) {
            pixels += piece.pixels;
            table += piece.pixels * piece.table;
            seen += known.seen;
            part += known.seen * piece.part;
            mean += known.seen * known.light;
            square += known.seen * known.light * known.light;
        }
        let mean = mean / seen;
        let region_spread = (square / seen - mean * mean).max(0.0).sqrt();
        signs.clear();
        signs.extend(pieces.iter().zip(region.basins).enumerate().map(|(i, (piece, basin))| {
            let known = &self.known[i];
            let own: [f32; OWN] = [
                log_odds(piece.part).clamp(-LARGEST_LOG_ODDS, LARGEST_LOG_ODDS),
                piece.odds / piece.weight,
                known.tone,
                piece.table,
                known.light,
                piece.difference,
                piece.difference / scene.table.color_noise.max(0.3),
                piece.apart[1],
                saturation(piece.levels),
                piece.levels.iter().sum::<f32>() / 3.0,
                piece.pixels.ln(),
                known.light - scene.light[0],
                known.light - scene.light[1],
                if known.rim.points > 0.0 { known.rim.sharpness / known.rim.points } else { NO_RIM },
                known.rim.direction / known.rim.points.max(1.0),
            ];
            let of_region: [f32; REGION] = [
                scene.table.color_noise,
                scene.table.brightness_spread,
                saturation(piece.bare.map(level)),
                scene.shadow_light[1],
                scene.shadow_light[2] - scene.shadow_light[0],
                scene.one_sided,
                part / seen,
                region_spread,
                known.light - mean,
                pixels.ln(),
                table / pixels,
            ];
            let mut row = [0.0; SIGNS];
            let mut rest = &mut row[..];
            let mut put = |signs: &[f32]| {
                let (to, after) = std::mem::take(&mut rest).split_at_mut(signs.len());
                to.copy_from_slice(signs);
                rest = after;
            };
            put(&own);
            put(&of_region);
            AHEAD_PX.iter().for_each(|&px| put(&self.ahead(scene, region, basin, px)));
            let groups = self.labels.iter().zip(&self.of_groups);
            groups.for_each(|(labels, signs)| put(&signs[labels[i] as usize]));
            row
        }));
    }

    /// Rim and tone of every piece.
    fn know(&mut self, scene: &SceneSigns<'_>, region: &RegionView<'_>) {
        self.known.clear();
        self.known.extend(region.pieces.iter().map(|piece| Known {
            pixels: piece.pixels,
            // A little of every piece counts, or a group of pieces of table had no mean.
            seen: piece.pixels * (1.0 - piece.table) + 1e-3,
            light: light(piece),
            tone: piece.tone.get(scene.tone_odds),
            blue: piece.apart[2],
            rim: RimSum::default(),
        }));
        for point in region.rim {
            let rim = &mut self.known[point.piece as usize].rim;
            rim.points += 1.0;
            rim.sharpness += point.sharpness;
            rim.direction += scene.direction_odds[point.direction as usize];
        }
    }

    /// Light and probability of a part so many pixels from a piece in the direction in which shadows fall.
    fn ahead(&self, scene: &SceneSigns<'_>, region: &RegionView<'_>, basin: &Basin, px: f32) -> [f32; 2] {
        // Half a pixel more: what is cut off is then rounded.
        let x = basin.center[0] - region.corner[0] as f32 + px * scene.fall[0] + 0.5;
        let y = basin.center[1] - region.corner[1] as f32 + px * scene.fall[1] + 0.5;
        let height = region.labels.len() / region.width.max(1);
        if x < 0.0 || y < 0.0 || x >= region.width as f32 || y >= height as f32 {
            return [0.0, NO_PART];
        }
        match region.labels[y as usize * region.width + x as usize] {
            NONE => [0.0, NO_PART],
            piece => [self.known[piece as usize].light, region.pieces[piece as usize].part],
        }
    }
}

/// Sums of the pieces of every group, and of the borders between groups.
fn sum_groups(region: &RegionView<'_>, known: &[Known], labels: &[u32], sums: &mut Vec<GroupSum>) {
    sums.clear();
    sums.resize(labels.iter().max().map_or(0, |&last| last as usize + 1), GroupSum::default());
    for ((piece, known), &label) in region.pieces.iter().zip(known).zip(labels) {
        let sum = &mut sums[label as usize];
        sum.pixels += known.pixels;
        sum.seen += known.seen;
        sum.root += known.pixels.sqrt();
        sum.tone += known.seen * known.tone;
        sum.part += known.seen * piece.part;
        sum.table += known.pixels * piece.table;
        sum.blue += known.pixels * known.blue;
        sum.rim.points += known.rim.points;
        sum.rim.sharpness += known.rim.sharpness;
        sum.rim.direction += known.rim.direction;
    }
    for border in region.borders {
        let (a, b) = (border.a as usize, border.b as usize);
        if labels[a] != labels[b] {
            let contrast = border.length * (known[b].light - known[a].light);
            for (label, contrast) in [(labels[a], contrast), (labels[b], -contrast)] {
                let sum = &mut sums[label as usize];
                sum.border += border.length;
                sum.contrast += contrast;
            }
        }
    }
}

impl GroupSum {
    fn signs(&self) -> [f32; GROUP] {
        [
            self.tone / self.seen,
            self.part / self.seen,
            self.table / self.pixels,
            self.blue / self.pixels,
            self.rim.direction / self.root,
            if self.rim.points > 0.0 { self.rim.sharpness / self.rim.points } else { NO_RIM },
            self.border / self.pixels.sqrt(),
            self.contrast / self.border.max(1.0),
            self.pixels.ln(),
        ]
    }
}

/// Share of the largest channel that the smallest one lacks.
fn saturation(levels: [f32; 3]) -> f32 {
    let (high, low) = (levels.iter().copied().fold(0.0, f32::max), levels.iter().copied().fold(f32::MAX, f32::min));
    (high - low) / high.max(1.0)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::evidence::Evidence;
    use crate::judgement;
    use crate::separator::tests::Scene;

    const TABLE: [u8; 3] = [150, 170, 200];
    const RED: [u8; 3] = [210, 40, 30];
    /// The table at a quarter of its linear light.
    const SHADE: [u8; 3] = [78, 89, 106];

    /// The signs of the pieces at some pixels of a scene with one region.
    fn signs_at(scene: &Scene, places: &[(u32, u32)]) -> Vec<Signs> {
        scene.show(|input, crops| {
            let mut evidence = Evidence::default();
            evidence.describe(input, crops);
            let (labels, signs) = evidence.described(1).next().unwrap();
            let bbox = crops[0].bbox.unwrap();
            let at = |&(x, y): &(u32, u32)| labels[((y - bbox.y) * bbox.width + x - bbox.x) as usize];
            places.iter().map(|place| signs[at(place) as usize]).collect()
        })
    }

    fn sign(signs: &Signs, name: &str) -> f32 {
        signs[PIECE_SIGNS.iter().position(|sign| *sign == name).unwrap()]
    }

    /// A red part of 40 x 40 px, and its shadow of 30 x 40 px to the right, which ends softly.
    pub(crate) fn shaded() -> Scene {
        let color = |x: u32, y: u32| match x {
            30..70 if (20..60).contains(&y) => RED,
            70..100 if (20..60).contains(&y) => {
                let lit = (x as f32 - 88.0).clamp(0.0, 12.0) / 12.0;
                std::array::from_fn(|c| (f32::from(SHADE[c]) * (1.0 - lit) + f32::from(TABLE[c]) * lit) as u8)
            }
            _ => TABLE,
        };
        let label = |x: u32, y: u32| match x {
            30..70 if (20..60).contains(&y) => 1,
            70..96 if (20..60).contains(&y) => 2,
            _ => 0,
        };
        Scene::new([140, 90], color, label, &[&[1, 2]])
    }

    #[test]
    fn names_are_told_apart() {
        let mut names = PIECE_SIGNS.to_vec();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), SIGNS);
    }

    #[test]
    fn a_part_and_its_shadow() {
        let found = signs_at(&shaded(), &[(50, 40), (79, 40)]);
        let [part, shadow] = &found[..] else { panic!("{} pieces", found.len()) };
        assert!(sign(part, "difference") > 40.0 && sign(shadow, "difference") < 3.0);
        assert!((sign(shadow, "light") - 0.25f32.ln()).abs() < 0.1, "{}", sign(shadow, "light"));
        assert!(sign(part, "green") < -20.0, "less green than the table in that light");
        assert!(sign(part, "saturation") > 0.8 && (sign(shadow, "saturation") - 0.26).abs() < 0.05);
        assert!(sign(part, "part") > 2.0 && sign(shadow, "part") < -2.0);
        assert!(sign(part, "node_part") > 0.9 && sign(shadow, "fine_part") < 0.1);
        assert!((sign(part, "node_size") - 1600f32.ln()).abs() < 0.1);
        let mut odds = Vec::new();
        judgement::log_odds(&[*part, *shadow], &mut odds);
        assert!(odds[0] > 1.0 && odds[1] < -1.0, "{odds:?}");
        for scene in ["noise", "spread", "one_sided", "shadow_light", "region_pixels"] {
            assert_eq!(sign(part, scene), sign(shadow, scene), "{scene}");
        }
    }

    #[test]
    fn ahead_is_where_shadows_fall() {
        let found = signs_at(&shaded(), &[(50, 40)]);
        assert!(sign(&found[0], "one_sided") > 0.3, "{}", sign(&found[0], "one_sided"));
        // 32 px to the right of the middle of the part lies its shadow.
        assert!((sign(&found[0], "ahead_light_32") - 0.25f32.ln()).abs() < 0.15);
        assert!(sign(&found[0], "ahead_part_32") < 0.2 && sign(&found[0], "ahead_part_8") > 0.8);
    }

    #[test]
    fn quantiles_of_weights() {
        let values = [(1.0, 1.0), (2.0, 0.0), (3.0, 2.0), (4.0, 1.0)];
        let of = |share| quantile(&values, share);
        assert_eq!([0.0, 0.25, 0.26, 0.75, 0.76, 1.0].map(of), [1.0, 1.0, 3.0, 3.0, 4.0, 4.0]);
        assert_eq!(quantile(&[], 0.5), 0.0);
        assert_eq!(quantile(&[(5.0, 0.0)], 0.5), 0.0);
    }

    #[test]
    fn signs_are_numbers_whatever_is_seen() {
        let inside = |x: u32, y: u32| u32::from((8..40).contains(&x) && (5..30).contains(&y));
        for color in [[0; 3], [255; 3], [255, 0, 0]] {
            for table in [[0; 3], [255; 3]] {
                let paint = move |x, y| if inside(x, y) == 1 { color } else { table };
                let all = Scene::new([50, 40], paint, |_, _| 0, &[&[0]]);
                let some = Scene::new([50, 40], paint, inside, &[&[1]]);
                for scene in [&all, &some] {
                    let found = signs_at(scene, &[(20, 20), (39, 29)]);
                    assert!(found.iter().flatten().all(|sign| sign.is_finite()), "{color:?} on {table:?}: {found:?}");
                }
            }
        }
        let one = Scene::new([9, 9], |_, _| [90; 3], |x, y| u32::from((x, y) == (4, 4)), &[&[1]]);
        assert!(signs_at(&one, &[(4, 4)])[0].iter().all(|sign| sign.is_finite()));
    }
}
