//! The saliency of a partition: scales, their combination (eq 14), and the map.

use rayon::prelude::*;
use samsod_segment::Partition;

use crate::background::partition_saliency;
use crate::cells::CellGrid;
use crate::exact::{Gaussian, Scratch, mean_colour};
use crate::fast::{Cursor, Mass, NodeGrid};
use crate::map::SaliencyMap;
use crate::params::{Method, SaliencyParamError, SaliencyParams, Variant};
use crate::regions::partition_means;

/// Nodes of the fast method to a deviation.
const NODES_PER_SIGMA: f32 = 1.75;
/// The cells under the nodes have the largest side below this share of a deviation.
const CELLS_PER_SIGMA: f32 = 1.5;
/// Deviations below this are evaluated exactly at the sites: nodes would be as dense as pixels.
const FINE_SIGMA_PX: f32 = 2.0;

/// How the fast method evaluates a scale.
enum Evaluator<'a> {
    Nodes(&'a NodeGrid),
    Exact(Gaussian),
}

impl<'a> Evaluator<'a> {
    fn cursor(&self) -> Option<Cursor<'a>> {
        match self {
            Self::Nodes(grid) => Some(grid.cursor()),
            Self::Exact(_) => None,
        }
    }
}

/// Why no saliency was computed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SaliencyError {
    /// The partition has no pixels.
    #[error("partition of {width} x {height} px; both sides must be at least 1")]
    Empty {
        /// Width, px.
        width: u32,
        /// Height, px.
        height: u32,
    },
}

/// Structure-aware saliency with memory that is reused from partition to partition.
#[derive(Debug)]
pub struct Saliency {
    params: SaliencyParams,
    masses: Vec<Mass>,
    /// Mean colour of the image, to which those of `masses` are relative.
    image_mean: [f32; 3],
    cells: Vec<CellGrid>,
    nodes: Vec<NodeGrid>,
    /// M of every site (or pixel) and scale, three values each.
    colours: Vec<f32>,
    /// S_kt of every site (or pixel) and pair of scales.
    distances: Vec<f32>,
    /// First site of every row of base cells.
    site_rows: Vec<usize>,
    /// S of every site.
    site_values: Vec<f32>,
}

impl Saliency {
    /// Checks the parameters.
    ///
    /// # Errors
    /// The parameter that is out of range, with the value and what is allowed.
    pub fn new(params: SaliencyParams) -> Result<Self, SaliencyParamError> {
        params.check()?;
        Ok(Self {
            params,
            masses: Vec::new(),
            image_mean: [0.0; 3],
            cells: Vec::new(),
            nodes: Vec::new(),
            colours: Vec::new(),
            distances: Vec::new(),
            site_rows: Vec::new(),
            site_values: Vec::new(),
        })
    }

    /// Computes S for every pixel.
    ///
    /// # Errors
    /// [`SaliencyError::Empty`] for a partition without pixels.
    pub fn compute(&mut self, partition: &Partition) -> Result<SaliencyMap, SaliencyError> {
        let mut map = SaliencyMap::default();
        self.compute_into(partition, &mut map)?;
        Ok(map)
    }

    /// Computes S into a map whose memory is reused.
    ///
    /// # Errors
    /// As [`Saliency::compute`]; the map is then unchanged.
    pub fn compute_into(&mut self, partition: &Partition, map: &mut SaliencyMap) -> Result<(), SaliencyError> {
        let (width, height) = (partition.width(), partition.height());
        if width == 0 || height == 0 {
            return Err(SaliencyError::Empty { width, height });
        }
        (map.width, map.height) = (width, height);
        map.values.resize(width as usize * height as usize, 0.0);
        if partition.len() == 1 {
            map.values.fill(0.0);
            return Ok(());
        }
        let variant = self.params.variant;
        if !variant.has_scales() {
            paint(&partition_saliency(partition, variant == Variant::Centred), partition, &mut map.values);
            return Ok(());
        }
        let (center, surround) = self.params.deviations(width, height);
        match self.params.method {
            Method::Exact => self.exact(partition, &center, &surround, map),
            Method::Fast => self.fast(partition, &center, &surround, map),
        }
        if variant == Variant::Averaged {
            let means = partition_means(&map.values, partition);
            paint(&means, partition, &mut map.values);
        }
        Ok(())
    }

    fn exact(&mut self, partition: &Partition, center: &[f32], surround: &[f32], map: &mut SaliencyMap) {
        let width = partition.width() as usize;
        let gaussians: Vec<Gaussian> = center.iter().chain(surround).map(|&s| Gaussian::new(s)).collect();
        let scales = gaussians.len();
        self.colours.resize(map.values.len() * scales * 3, 0.0);
        self.colours.par_chunks_mut(width * scales * 3).enumerate().for_each_init(
            || Scratch::for_labels(partition.len()),
            |scratch, (y, out)| {
                let labels = &partition.labels()[y * width..(y + 1) * width];
                for (x, out) in out.chunks_exact_mut(scales * 3).enumerate() {
                    for (gaussian, out) in gaussians.iter().zip(out.chunks_exact_mut(3)) {
                        let at = (x as i64, y as i64);
                        let colour = mean_colour(partition, gaussian, at, labels[x], scratch);
                        out.copy_from_slice(&colour.map(|c| c as f32));
                    }
                }
            },
        );
        combine(&self.colours, center.len(), surround.len(), &mut self.distances, &mut map.values);
    }

    fn fast(&mut self, partition: &Partition, center: &[f32], surround: &[f32], map: &mut SaliencyMap) {
        self.weigh(partition);
        let scales: Vec<f32> = center.iter().chain(surround).copied().collect();
        // Scales finer than nodes can be are evaluated exactly, once a site.
        let coarse = || scales.iter().copied().filter(|&sigma| sigma >= FINE_SIGMA_PX);
        // Sites stay small beside the image even where all scales are large, or fine.
        let largest_side = partition.width().max(partition.height()) as f32 / 128.0;
        let base_side = power_of_two_below(coarse().map(|sigma| sigma / 3.0).fold(largest_side, f32::min));
        self.fill_cells(partition, base_side, coarse().fold(0.0, f32::max));

        self.nodes.resize_with(scales.len(), NodeGrid::default);
        let (masses, cells) = (&self.masses, &self.cells);
        let mut evaluators = Vec::with_capacity(scales.len());
        for (grid, &sigma) in self.nodes.iter_mut().zip(&scales) {
            evaluators.push(if sigma < FINE_SIGMA_PX {
                Evaluator::Exact(Gaussian::new(sigma))
            } else {
                let level = cells.partition_point(|c| c.side as f32 <= sigma / CELLS_PER_SIGMA).saturating_sub(1);
                grid.fill(partition, masses, &cells[level], sigma, (sigma / NODES_PER_SIGMA).max(1.0));
                Evaluator::Nodes(&*grid)
            });
        }

        // M of every site.
        let base = &self.cells[0];
        self.site_rows.clear();
        let mut total = 0;
        for row in base.rows() {
            self.site_rows.push(total);
            total += row.entries.len();
        }
        let per_site = scales.len() * 3;
        self.colours.resize(total * per_site, 0.0);
        let mut rest = self.colours.as_mut_slice();
        let mut pieces = Vec::with_capacity(base.rows().len());
        for row in base.rows() {
            let (piece, tail) = rest.split_at_mut(row.entries.len() * per_site);
            pieces.push((row, piece));
            rest = tail;
        }
        let image_mean = self.image_mean;
        let scratch = || Scratch::for_labels(partition.len());
        pieces.into_par_iter().with_min_len(4).for_each_init(scratch, |scratch, (row, out)| {
            let mut cursors: Vec<_> = evaluators.iter().map(Evaluator::cursor).collect();
            for (entry, out) in row.entries.iter().zip(out.chunks_exact_mut(per_site)) {
                let mass = masses[entry.label as usize];
                for ((evaluator, cursor), out) in evaluators.iter().zip(&mut cursors).zip(out.chunks_exact_mut(3)) {
                    let colour = match (evaluator, cursor) {
                        (_, Some(cursor)) => cursor.mean_colour(entry.x, entry.y, entry.label, mass),
                        (Evaluator::Exact(gaussian), _) if !base.holds_only(entry, gaussian.radius_px()) => {
                            let at = (entry.x.round() as i64, entry.y.round() as i64);
                            let colour = mean_colour(partition, gaussian, at, entry.label, scratch);
                            [0, 1, 2].map(|c| colour[c] as f32 - image_mean[c])
                        }
                        _ => mass.colour,
                    };
                    out.copy_from_slice(&colour);
                }
            }
        });
        self.site_values.resize(total, 0.0);
        combine(&self.colours, center.len(), surround.len(), &mut self.distances, &mut self.site_values);
        self.spread(partition, &mut map.values);
    }

    /// Area and colour of every partition, the colour relative to the mean of the image.
    fn weigh(&mut self, partition: &Partition) {
        let objects = partition.objects();
        let pixels = partition.labels().len() as f64;
        let mean = [0, 1, 2]
            .map(|c| (objects.iter().map(|o| f64::from(o.area) * f64::from(o.mean[c])).sum::<f64>() / pixels) as f32);
        self.image_mean = mean;
        self.masses.clear();
        self.masses.extend(objects.iter().map(|o| Mass::new(o, mean)));
    }

    fn fill_cells(&mut self, partition: &Partition, base_side: usize, largest_sigma: f32) {
        let levels =
            1 + (0..).take_while(|l| ((base_side << (l + 1)) as f32) <= largest_sigma / CELLS_PER_SIGMA).count();
        self.cells.resize_with(levels, CellGrid::default);
        self.cells[0].fill(partition.runs(), partition.width() as usize, base_side);
        for level in 1..levels {
            let (finer, coarser) = self.cells.split_at_mut(level);
            coarser[0].fill_doubled(&finer[level - 1]);
        }
    }

    /// Interpolates the values of sites to pixels, within labels.
    fn spread(&self, partition: &Partition, values: &mut [f32]) {
        let base = &self.cells[0];
        let side = base.side;
        let (site_rows, site_values) = (&self.site_rows, &self.site_values);
        let width = partition.width() as usize;
        values.par_chunks_exact_mut(width).enumerate().with_min_len(8).for_each(|(y, line)| {
            // The rows of cells whose centres lie above and below.
            let grid_y = (y as f32 + 0.5) / side as f32 - 0.5;
            let upper = grid_y.floor();
            let fraction_y = grid_y - upper;
            let rows = [(upper, 1.0 - fraction_y), (upper + 1.0, fraction_y)];
            let value = |label: u32, cx: isize| -> (f32, f32) {
                let (mut sum, mut weight) = (0.0, 0.0);
                for (cy, wy) in rows {
                    if cy < 0.0 || cx < 0 || cx as usize >= base.columns {
                        continue;
                    }
                    let Some(row) = base.rows().get(cy as usize) else { continue };
                    if let Some(i) = row.find(cx as usize, label) {
                        sum += wy * site_values[site_rows[cy as usize] + i];
                        weight += wy;
                    }
                }
                (sum, weight)
            };
            for run in partition.runs().row(y) {
                let (start, end) = (run.start as usize, run.end as usize);
                // Between the centres of columns cx and cx + 1 the value is linear.
                let mut x = start;
                let mut cx = ((x as f32 + 0.5) / side as f32 - 0.5).floor() as isize;
                let mut left = value(run.label, cx);
                while x < end {
                    let right = value(run.label, cx + 1);
                    let middle = ((cx + 1) * side as isize + side as isize / 2) as usize;
                    let to = middle.max(x + 1).min(end);
                    for (px, out) in line[x..to].iter_mut().enumerate() {
                        let t = ((x + px) as f32 + 0.5) / side as f32 - 0.5 - cx as f32;
                        let weight = left.1 * (1.0 - t) + right.1 * t;
                        *out = (left.0 * (1.0 - t) + right.0 * t) / weight.max(1e-6);
                    }
                    x = to;
                    cx += 1;
                    left = right;
                }
            }
        });
    }
}

/// Gives every pixel the value of its label.
fn paint(by_label: &[f32], partition: &Partition, values: &mut [f32]) {
    let width = partition.width() as usize;
    values.par_chunks_exact_mut(width).zip(partition.runs().rows()).with_min_len(32).for_each(|(line, row)| {
        for run in row {
            line[run.start as usize..run.end as usize].fill(by_label[run.label as usize]);
        }
    });
}

/// The largest power of two that is at most `length`, and at least 1.
fn power_of_two_below(length: f32) -> usize {
    let mut side = 1;
    while (side * 2) as f32 <= length {
        side *= 2;
    }
    side
}

/// Eq 14: S from M of all scales. `colours` holds `center + surround` colours for every value; `distances` is scratch.
fn combine(colours: &[f32], center: usize, surround: usize, distances: &mut Vec<f32>, values: &mut [f32]) {
    const CHUNK: usize = 4096;
    let scales = center + surround;
    let pairs = center * surround;
    distances.resize(values.len() * pairs, 0.0);
    let maxima = distances
        .par_chunks_mut(CHUNK * pairs)
        .zip(colours.par_chunks(CHUNK * scales * 3))
        .map(|(distances, colours)| {
            let mut maxima = vec![0.0f32; pairs];
            for (distances, site) in distances.chunks_exact_mut(pairs).zip(colours.chunks_exact(scales * 3)) {
                let (centers, surrounds) = site.split_at(center * 3);
                let rows = distances.chunks_exact_mut(surround).zip(maxima.chunks_exact_mut(surround));
                for (k, (distances, maxima)) in centers.chunks_exact(3).zip(rows) {
                    for ((t, distance), max) in surrounds.chunks_exact(3).zip(distances).zip(maxima) {
                        let (x, y, z) = (k[0] - t[0], k[1] - t[1], k[2] - t[2]);
                        *distance = (x * x + y * y + z * z).sqrt();
                        *max = max.max(*distance);
                    }
                }
            }
            maxima
        })
        .reduce(|| vec![0.0; pairs], |a, b| a.iter().zip(&b).map(|(x, y)| x.max(*y)).collect());
    // Where all is alike a maximum is only rounding, and dividing by it would make rounding salient.
    const ROUNDING: f32 = 1e-3;
    let scale: Vec<f32> = maxima.iter().map(|&m| if m > ROUNDING { 1.0 / (m * pairs as f32) } else { 0.0 }).collect();
    values.par_chunks_mut(CHUNK).zip(distances.par_chunks(CHUNK * pairs)).for_each(|(values, distances)| {
        for (value, distances) in values.iter_mut().zip(distances.chunks_exact(pairs)) {
            let sum: f32 = distances.iter().zip(&scale).map(|(d, s)| d * s).sum();
            *value = sum.min(1.0);
        }
    });
}
