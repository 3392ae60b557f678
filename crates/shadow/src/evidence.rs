//! What tells a part from a shadow, weighed over the whole scene (`object_side = "evidence"`).
//!
//! The paper asks the hue of two sides of a region. On a grey table hue says nothing, and a region may hold several
//! parts and shadows, so here every piece of a region (a basin of the gradient, `basins`) is judged, by
//!
//! - its tone: hue of the table or not, and how dark (`tone`). All shadows of a scene are darkened alike, so how dark they
//!   are is learnt from the scene itself;
//! - the rim of the region it lies at: parts end at an edge, shadows in a penumbra, and all shadows of a scene lie on the
//!   same side of their parts (`rim`), which is learnt as well;
//! - its neighbours, where no edge parts them; pieces of the same tone in its region; its proto-object partition;
//! - and what a region is: there is a part in it, or it would not be salient.
//!
//! Tones, the side of the shadows and the pieces depend on each other: a few rounds of expectation and maximisation
//! settle them, the pieces by mean-field sweeps. What comes out is one of the signs of a piece (`signs`) by which fitted
//! trees (`judgement`) judge. `docs/vision.md` has the measurements behind the constants; those in pixels are for
//! parts of some tens to hundreds of pixels and do not grow with the frame.

use rayon::prelude::*;

use crate::basins::{Basins, Border, NONE};
use crate::crop::{Crop, OBJECT, OWN, SHADOW, TABLE};
use crate::fringe::{Fringe, FringeSigns, FringeView};
use crate::holes::{Holes, cut_holes};
use crate::judgement;
use crate::necks::{Necks, cut_contacts, cut_necks};
use crate::rim::{DIRECTIONS, RimPoint, RimScratch, find_rim};
use crate::separator::Input;
use crate::signs::{Describer, RegionView, SceneSigns, Signs};
use crate::table_model::{TableModel, brightness, largest, level, levels_apart, linear_table};
use crate::tone::{Expectation, NO_TONES, Tone, Tones, spread};

/// Rounds of learning tones and sides, then judging pieces.
const ROUNDS: usize = 2;
/// Mean-field sweeps over the pieces of a region in each.
const SWEEPS: usize = 3;
/// Rounds in which the sides of the shadows and the rim settle.
const RIM_ROUNDS: usize = 6;

/// Evidence of a piece grows with its pixels to this power: they are not independent.
const WEIGHT_POWER: f32 = 0.6;
/// Width of the table's brightness, in standard deviations of its texture;
const TABLE_WIDTH: f32 = 2.03;
/// and of its colour, sRGB levels.
const TABLE_DIFFERENCE: f32 = 5.26;
/// Log-odds against a part where a piece looks like the table, a unit of weight.
const TABLE_ODDS: f32 = 0.587;
/// Log-odds of the tone, a unit of weight.
const TONE_ODDS: f32 = 1.17;
/// Log-odds of the rim, a point on it;
const RIM_ODDS: f32 = 2.98;
/// at most so many a unit of weight.
const LARGEST_RIM_ODDS: f32 = 8.68;
/// How much of the sharpness of the rim counts beside its direction.
const SHARPNESS_ODDS: f32 = 0.89;
/// How much of the tone counts where the rim is judged.
const RIM_TONE_ODDS: f32 = 0.68;
/// Pull of the pieces of the same tone in a region, a unit of weight;
const SAME_TONE: f32 = 1.17;
/// of the pieces of the same partition;
const SAME_PARTITION: f32 = 3.4;
/// and of a neighbour, a pixel of common border,
const NEIGHBOUR: f32 = 1.31;
/// falling off with the gradient there, sRGB levels over two pixels.
const NEIGHBOUR_GRADIENT: f32 = 10.4;
/// Pixels that make half a pull.
const FEW_PX: f32 = 9.5;
/// At least this share of what is not table in a region is part.
const LEAST_PART: f32 = 0.407;
/// Points of the rim that count as much as knowing nothing of a direction.
const DIRECTION_PRIOR: f32 = 9.8;
/// Pixels that a point of the rim stands for where tones are learnt.
const RIM_POINT_PX: f32 = 1.97;

/// Sharpness of a rim at a part, and its standard deviation.
const SHARP: (f32, f32) = (0.646, 0.177);
/// And at a shadow.
const SOFT: (f32, f32) = (0.42, 0.11);
/// Rims of a lower contrast say nothing, sRGB levels; those of [`CLEAR_CONTRAST`] all that they can.
const LEAST_CONTRAST: f32 = 12.0;
const CLEAR_CONTRAST: f32 = 40.0;
const LARGEST_SHARPNESS_ODDS: f32 = 1.5;

/// What is not part and brighter than this is table that shows in the region.
const TABLE_BRIGHTNESS: f32 = 0.97;
/// unless its colour is another by so many sRGB levels.
const TABLE_MISMATCH: f32 = 9.0;
/// A pixel of the table that is darker than this lies in a penumbra.
pub(crate) const PENUMBRA_BRIGHTNESS: f32 = 0.94;
/// Darker than this, and enclosed in a part, is a hole.
const HOLE_BRIGHTNESS: f32 = 0.16;
/// Objects that touch in a neck of up to twice this width are two, px,
const NECK_RADIUS_PX: usize = 2;
/// or along a contact of up to twice this, if they differ there (`necks`),
const CONTACT_RADIUS_PX: usize = 8;
/// when so many pixels of either are left without their border.
const LEAST_CORE_PX: usize = 266;

/// Scratch memory, kept from frame to frame.
#[derive(Debug, Default)]
pub(crate) struct Evidence {
    table: TableModel,
    regions: Vec<Region>,
}

/// A piece of a region.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Piece {
    pub(crate) pixels: f32,
    /// Its pixels as they count for evidence.
    pub(crate) weight: f32,
    /// How much it looks like the bare table, in [0, 1].
    pub(crate) table: f32,
    /// Colour of the table under it, linear light.
    pub(crate) bare: [f32; 3],
    /// Its colour, sRGB levels, and how far they are from the table's in its light.
    pub(crate) levels: [f32; 3],
    pub(crate) apart: [f32; 3],
    /// Brightness, difference and tone against the table.
    pub(crate) brightness: f32,
    pub(crate) difference: f32,
    pub(crate) tone: Tone,
    /// Its partition: 1 + index in the region, 0 outside of it.
    pub(crate) node: u32,
    /// Log-odds by tone and rim.
    pub(crate) odds: f32,
    /// Probability that it is part.
    pub(crate) part: f32,
}

/// A point of the rim, and the piece inside of it.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RimPiece {
    pub(crate) piece: u32,
    pub(crate) direction: u8,
    /// Log-odds by sharpness.
    pub(crate) sharpness: f32,
    /// How little the piece looks like the table.
    pub(crate) seen: f32,
    /// Odds against a part by sharpness and tone.
    pub(crate) against: f32,
    /// Probability that the rim is that of a part.
    pub(crate) part: f32,
}

#[derive(Debug, Default)]
struct Region {
    basins: Basins,
    rim_scratch: RimScratch,
    points: Vec<RimPoint>,
    pieces: Vec<Piece>,
    rim: Vec<RimPiece>,
    pulls: Vec<f32>,
    /// Pull of neighbours across every border.
    strengths: Vec<f32>,
    nodes: Vec<[f32; 2]>,
    describer: Describer,
    signs: Vec<Signs>,
    odds: Vec<f32>,
    paint: Vec<Paint>,
    dark: Vec<bool>,
    necks: Necks,
    holes: Holes,
    fringe: Fringe,
}

impl Evidence {
    /// Writes the codes of every region.
    pub(crate) fn label_regions(&mut self, input: &Input<'_>, crops: &mut [Crop]) {
        self.describe_and(input, crops, |region, crop| {
            judgement::log_odds(&region.signs, &mut region.odds);
            for (piece, &odds) in region.pieces.iter_mut().zip(&region.odds) {
                piece.part = probability(odds);
            }
            region.write(crop);
            region.settle(crop);
        });
    }

    /// Parts the regions into pieces and describes every piece.
    pub(crate) fn describe(&mut self, input: &Input<'_>, crops: &mut [Crop]) {
        self.describe_and(input, crops, |_, _| {});
    }

    /// As [`Evidence::describe`], and goes on with every region as soon as it is described.
    fn describe_and(&mut self, input: &Input<'_>, crops: &mut [Crop], go_on: impl Fn(&mut Region, &mut Crop) + Sync) {
        if self.regions.len() < crops.len() {
            self.regions.resize_with(crops.len(), Region::default);
        }
        let regions = &mut self.regions[..crops.len()];
        let read = || {
            let pairs = crops.par_iter_mut().zip(regions.par_iter_mut());
            pairs.for_each(|(crop, region)| region.read(input, crop));
        };
        rayon::join(read, || self.table.measure(input));
        let table = &self.table;
        let table_width = TABLE_WIDTH * table.brightness_spread;
        crops.par_iter().zip(regions.par_iter_mut()).for_each(|(crop, region)| {
            region.compare(input, crop, table, table_width);
        });
        let expectation = Expectation::on(table, mean_table_color(regions), table_width);
        let mut tone_odds = expectation.odds_with(&NO_TONES, &NO_TONES);
        let mut part_by_direction = [0.5; DIRECTIONS];
        for round in 0..ROUNDS {
            if round > 0 {
                let (shadow, part) = seen_tones(regions);
                tone_odds = expectation.odds_with(&shadow, &part);
            }
            settle_rim(regions, &tone_odds, &mut part_by_direction);
            let direction_odds = part_by_direction.map(odds);
            regions.par_iter_mut().for_each(|region| region.judge(&tone_odds, &direction_odds, round == 0));
        }
        let pieces = regions.iter().flat_map(|region| &region.pieces);
        let scene = SceneSigns::of(table, &tone_odds, &part_by_direction, pieces);
        crops.par_iter_mut().zip(regions.par_iter_mut()).for_each(|(crop, region)| {
            region.describe(&scene, crop);
            go_on(region, crop);
        });
    }

    /// The pieces of the regions that were described last: those of every pixel of a crop, by index in its region, and the
    /// signs of every piece of the region.
    pub(crate) fn described(&self, count: usize) -> impl Iterator<Item = (&[u32], &[Signs])> {
        self.regions[..count].iter().map(|region| (&region.basins.labels[..], &region.signs[..]))
    }

    /// Takes probabilities of a part for the pieces that were described last, region by region, and writes the codes up to
    /// the outlines, which are left as the pieces have them. They are settled next, by [`Evidence::settle_fringes`] or
    /// [`Evidence::write_fringes`].
    pub(crate) fn write_judged(&mut self, crops: &mut [Crop], parts: &[f32]) {
        let regions = &mut self.regions[..crops.len()];
        let pieces = regions.iter_mut().flat_map(|region| &mut region.pieces);
        pieces.zip(parts).for_each(|(piece, &part)| piece.part = part);
        crops.par_iter_mut().zip(regions.par_iter_mut()).for_each(|(crop, region)| region.write(crop));
    }

    /// Settles the outlines of what was written last.
    pub(crate) fn settle_fringes(&mut self, crops: &mut [Crop]) {
        let regions = &mut self.regions[..crops.len()];
        crops.par_iter_mut().zip(regions.par_iter_mut()).for_each(|(crop, region)| region.settle(crop));
    }

    /// Describes the pixels at the outlines of what was written last.
    pub(crate) fn describe_fringes(&mut self, crops: &[Crop]) {
        let regions = &mut self.regions[..crops.len()];
        crops.par_iter().zip(regions.par_iter_mut()).for_each(|(crop, region)| {
            let Region { basins, pieces, fringe, .. } = region;
            fringe.describe(FringeView { basins, pieces }, crop);
        });
    }

    /// The pixels at outlines that were described last, by index in the crop of their region, with their signs.
    pub(crate) fn described_fringes(&self, count: usize) -> impl Iterator<Item = (&[u32], &[FringeSigns])> {
        self.regions[..count].iter().map(|region| (&region.fringe.pixels[..], &region.fringe.signs[..]))
    }

    /// Takes probabilities that the pixels at outlines that were described last show a part, and settles these by them.
    pub(crate) fn write_fringes(&mut self, crops: &mut [Crop], mut probabilities: &[f32]) {
        for (crop, region) in crops.iter_mut().zip(&mut self.regions) {
            let Region { basins, pieces, fringe, .. } = region;
            let own = probabilities.split_off(..fringe.pixels.len()).unwrap_or_default();
            fringe.write_judged(FringeView { basins, pieces }, crop, own);
            region.cut(crop);
        }
    }
}

/// The mean over pieces: the table where regions are. Mid-grey where there are none.
fn mean_table_color(regions: &[Region]) -> [f32; 3] {
    let (mut sum, mut count) = ([0.0; 3], 0.0);
    for piece in regions.iter().flat_map(|region| &region.pieces) {
        sum = std::array::from_fn(|c| sum[c] + piece.bare[c]);
        count += 1.0;
    }
    if count > 0.0 { sum.map(|s| s / count) } else { [0.2; 3] }
}

/// Pixels of shadow and of part by tone, as judged so far.
fn seen_tones(regions: &[Region]) -> (Tones, Tones) {
    let (mut shadow, mut part) = (NO_TONES, NO_TONES);
    for region in regions {
        for piece in &region.pieces {
            piece.tone.add(&mut shadow, piece.pixels * (1.0 - piece.part));
            piece.tone.add(&mut part, piece.pixels * piece.part);
        }
        for point in &region.rim {
            let tone = region.pieces[point.piece as usize].tone;
            let weight = RIM_POINT_PX * point.seen * (2.0 * point.part - 1.0).abs();
            tone.add(&mut shadow, weight * (1.0 - point.part));
            tone.add(&mut part, weight * point.part);
        }
    }
    (shadow, part)
}

/// Judges every point of the rim by sharpness, tone and direction, and the directions by their points, until both agree.
fn settle_rim(regions: &mut [Region], tone_odds: &Tones, part_by_direction: &mut [f32; DIRECTIONS]) {
    // Odds against a part by what stays the same; the other factor, that of a direction, does not need a logarithm.
    regions.par_iter_mut().for_each(|region| {
        for point in &mut region.rim {
            let tone = region.pieces[point.piece as usize].tone.get(tone_odds);
            point.against = (-(SHARPNESS_ODDS * point.sharpness + RIM_TONE_ODDS * tone)).exp();
        }
    });
    for _ in 0..RIM_ROUNDS {
        let against = part_by_direction.map(|part| (1.0 - part) / part);
        let (mut part, mut all) = ([0.0; DIRECTIONS], [0.0; DIRECTIONS]);
        for point in regions.iter_mut().flat_map(|region| &mut region.rim) {
            let direction = point.direction as usize;
            point.part = 1.0 / (1.0 + point.against * against[direction]);
            part[direction] += point.part * point.seen;
            all[direction] += point.seen;
        }
        *part_by_direction = std::array::from_fn(|k| {
            let around = |v: &[f32; DIRECTIONS]| {
                0.25 * v[(k + DIRECTIONS - 1) % DIRECTIONS] + 0.5 * v[k] + 0.25 * v[(k + 1) % DIRECTIONS]
            };
            ((around(&part) + 0.5 * DIRECTION_PRIOR) / (around(&all) + DIRECTION_PRIOR)).clamp(0.03, 0.97)
        });
    }
}

impl Region {
    /// Basins and rim of a crop.
    fn read(&mut self, input: &Input<'_>, crop: &mut Crop) {
        crop.grow();
        let Self { basins, rim_scratch, points, .. } = self;
        // Side by side: one large region must not keep the other cores waiting.
        rayon::join(|| basins.part(input, crop), || find_rim(input, crop, rim_scratch, points));
    }

    /// Pieces and rim against the table.
    fn compare(&mut self, input: &Input<'_>, crop: &Crop, table: &TableModel, table_width: f32) {
        let labels = input.partition.labels();
        let stride = input.partition.width() as usize;
        self.pieces.clear();
        self.pieces.extend(self.basins.basins.iter().map(|basin| {
            let bare = table.color_at(basin.center[0], basin.center[1]);
            let (brightness, levels) = (brightness(basin.color, bare), basin.color.map(level));
            let apart = levels_apart(levels, bare, brightness);
            let difference = largest(apart);
            let off = ((brightness - 1.0) / table_width).powi(2) + (difference / TABLE_DIFFERENCE).powi(2);
            let [x, y] = basin.seed;
            let seed = y as usize * stride + x as usize;
            let fades_from = || input.owners.of(input.partition.fades_from(x, y)?);
            let owner = input.owners.of(labels[seed]).or_else(fades_from);
            Piece {
                pixels: basin.pixels,
                weight: basin.pixels.powf(WEIGHT_POWER),
                table: (-0.5 * off).exp(),
                bare,
                levels,
                apart,
                brightness,
                difference,
                tone: Tone::of(brightness, difference),
                node: owner.map_or(0, |owner| owner.node + 1),
                odds: 0.0,
                part: 0.5,
            }
        }));
        self.strengths.clear();
        let strength = |border: &Border| NEIGHBOUR * border.length * (-border.gradient / NEIGHBOUR_GRADIENT).exp();
        self.strengths.extend(self.basins.borders.iter().map(strength));
        self.rim.clear();
        for point in &self.points {
            let inside = point.inside as usize;
            let piece = self.basins.labels[inside];
            if piece != NONE && crop.owners()[inside] == OWN {
                self.rim.push(RimPiece {
                    piece,
                    direction: point.direction,
                    sharpness: sharpness_odds(point),
                    seen: 1.0 - self.pieces[piece as usize].table,
                    against: 1.0,
                    part: 0.5,
                });
            }
        }
    }

    /// Judges the pieces, from scratch in the first round.
    fn judge(&mut self, tone_odds: &Tones, direction_odds: &[f32; DIRECTIONS], first: bool) {
        self.pulls.clear();
        self.pulls.resize(self.pieces.len(), 0.0);
        for point in &self.rim {
            let rim = SHARPNESS_ODDS * point.sharpness + direction_odds[point.direction as usize];
            self.pulls[point.piece as usize] += RIM_ODDS * rim * point.seen;
        }
        for (piece, &rim) in self.pieces.iter_mut().zip(&self.pulls) {
            let largest = LARGEST_RIM_ODDS * piece.weight;
            let own = TONE_ODDS * piece.tone.get(tone_odds) - TABLE_ODDS * piece.table;
            piece.odds = own * piece.weight + rim.clamp(-largest, largest);
        }
        self.expect_a_part();
        if first {
            self.pieces.iter_mut().for_each(|piece| piece.part = probability(piece.odds));
        }
        for _ in 0..SWEEPS {
            self.sweep();
        }
    }

    /// Raises the odds of all that is not table until enough of it is part.
    fn expect_a_part(&mut self) {
        const STEP: f32 = 0.15;
        const STEPS: usize = 12;
        let seen: f32 = self.pieces.iter().filter(|piece| piece.table < 0.5).map(|piece| piece.pixels).sum();
        for _ in 0..STEPS {
            let not_table = self.pieces.iter().filter(|piece| piece.table < 0.5);
            if not_table.map(|piece| piece.pixels * probability(piece.odds)).sum::<f32>() >= LEAST_PART * seen {
                break;
            }
            for piece in self.pieces.iter_mut().filter(|piece| piece.table < 0.5) {
                piece.odds += STEP * piece.weight;
            }
        }
    }

    /// One mean-field sweep: every piece hears what the others say, and goes half the way.
    fn sweep(&mut self) {
        let (mut shadow, mut part) = (NO_TONES, NO_TONES);
        self.nodes.clear();
        for piece in &self.pieces {
            piece.tone.add(&mut shadow, piece.pixels * (1.0 - piece.part));
            piece.tone.add(&mut part, piece.pixels * piece.part);
            let node = piece.node as usize;
            if self.nodes.len() <= node {
                self.nodes.resize(node + 1, [0.0; 2]);
            }
            let pixels = piece.pixels * (1.0 - piece.table);
            self.nodes[node][0] += pixels * (2.0 * piece.part - 1.0);
            self.nodes[node][1] += pixels;
        }
        let (shadow, part) = (spread(&shadow), spread(&part));
        for (piece, pull) in self.pieces.iter().zip(&mut self.pulls) {
            let (p, s) = (piece.tone.get(&part), piece.tone.get(&shadow));
            let mut all = SAME_TONE * (p - s) / (p + s + FEW_PX);
            if piece.node > 0 {
                let [sum, pixels] = self.nodes[piece.node as usize];
                all += SAME_PARTITION * (1.0 - piece.table) * sum / (pixels + FEW_PX);
            }
            *pull = all * piece.weight;
        }
        for (border, &strength) in self.basins.borders.iter().zip(&self.strengths) {
            let (a, b) = (border.a as usize, border.b as usize);
            self.pulls[a] += strength * (2.0 * self.pieces[b].part - 1.0);
            self.pulls[b] += strength * (2.0 * self.pieces[a].part - 1.0);
        }
        for (piece, &pull) in self.pieces.iter_mut().zip(&self.pulls) {
            piece.part = 0.5 * (piece.part + probability(piece.odds + pull));
        }
    }

    fn describe(&mut self, scene: &SceneSigns<'_>, crop: &Crop) {
        let Self { basins, pieces, rim, describer, signs, .. } = self;
        signs.clear();
        let Some(bbox) = crop.bbox else { return };
        let region = RegionView {
            corner: [bbox.x, bbox.y],
            width: crop.width(),
            labels: &basins.labels,
            basins: &basins.basins,
            borders: &basins.borders,
            pieces,
            rim,
        };
        describer.describe(scene, &region, signs);
    }

    fn write(&mut self, crop: &mut Crop) {
        self.paint.clear();
        self.paint.extend(self.pieces.iter().map(|piece| {
            if piece.part > 0.5 {
                Paint::All(OBJECT)
            } else if piece.brightness < TABLE_BRIGHTNESS || piece.difference > TABLE_MISMATCH {
                Paint::All(SHADOW)
            } else {
                let square: f32 = piece.bare.iter().map(|c| c * c).sum();
                Paint::ByLight(piece.bare.map(|c| c / square))
            }
        }));
        let lut = linear_table();
        let smooth = self.basins.smooth.as_chunks::<3>().0;
        let width = crop.width().max(1);
        let sheets = crop.codes.chunks_exact_mut(width).zip(smooth.chunks_exact(width));
        for ((codes, smooth), runs) in sheets.zip(self.basins.rows()) {
            for run in runs {
                let Some(paint) = self.paint.get(run.label as usize) else { continue };
                let columns = run.start as usize..run.end as usize;
                match paint {
                    Paint::All(of_piece) => codes[columns].fill(*of_piece),
                    Paint::ByLight(light) => {
                        for (code, color) in codes[columns.clone()].iter_mut().zip(&smooth[columns]) {
                            let brightness: f32 = (0..3).map(|c| lut[color[c] as usize] * light[c]).sum();
                            *code = if brightness < PENUMBRA_BRIGHTNESS { SHADOW } else { TABLE };
                        }
                    }
                }
            }
        }
        self.dark.clear();
        self.dark.extend(self.pieces.iter().map(|piece| piece.part > 0.5 && piece.brightness < HOLE_BRIGHTNESS));
        if self.dark.contains(&true) {
            let (labels, dark) = (&self.basins.labels, &self.dark);
            let is_dark = |label: u32| dark.get(label as usize) == Some(&true);
            let rows = self.basins.rows().enumerate();
            let runs = rows.flat_map(|(y, runs)| runs.iter().map(move |run| (y, run)));
            let starts = runs.filter(|(_, run)| is_dark(run.label)).map(|(y, run)| y * width + run.start as usize);
            cut_holes(crop, starts, |i| is_dark(labels[i]), &mut self.holes);
        }
    }

    /// Settles the outlines, and cuts what touches.
    fn settle(&mut self, crop: &mut Crop) {
        let Self { basins, pieces, fringe, .. } = self;
        fringe.settle(FringeView { basins, pieces }, crop);
        self.cut(crop);
    }

    fn cut(&mut self, crop: &mut Crop) {
        cut_necks(crop, NECK_RADIUS_PX, LEAST_CORE_PX, &mut self.necks);
        let smooth = self.basins.smooth.as_chunks::<3>().0;
        let color = |i: usize| smooth.get(i).copied().unwrap_or_default();
        cut_contacts(crop, CONTACT_RADIUS_PX, LEAST_CORE_PX, color, &mut self.necks);
    }
}

/// What becomes of the pixels of a piece.
#[derive(Debug, Clone, Copy)]
enum Paint {
    /// All get this code.
    All(u8),
    /// Table, up to where a penumbra begins, which no gradient tells: a pixel's brightness against the table is its product
    /// with this.
    ByLight([f32; 3]),
}

/// Log-odds of a part by the sharpness of the rim: two normal distributions.
fn sharpness_odds(point: &RimPoint) -> f32 {
    if point.contrast <= LEAST_CONTRAST {
        return 0.0;
    }
    let log_density =
        |(mean, deviation): (f32, f32)| -deviation.ln() - 0.5 * ((point.sharpness - mean) / deviation).powi(2);
    let odds = log_density(SHARP) - log_density(SOFT);
    odds.clamp(-LARGEST_SHARPNESS_ODDS, LARGEST_SHARPNESS_ODDS) * (point.contrast / CLEAR_CONTRAST).min(1.0)
}

fn odds(probability: f32) -> f32 {
    (probability / (1.0 - probability)).ln()
}

fn probability(odds: f32) -> f32 {
    1.0 / (1.0 + (-odds.clamp(-40.0, 40.0)).exp())
}
