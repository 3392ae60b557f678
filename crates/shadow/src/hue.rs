//! Hue histograms and their likeness (section 4.1, eq 15).
//!
//! In: colours of pixels. Out: histograms of 360 bins of one degree, and the Bhattacharyya coefficient of two of them,
//!
//! ```text
//! B = sum over hues of sqrt(p q) = exp(-D_B)         in [0, 1]
//! ```
//!
//! Pixels with R = G = B have no hue and are left out. So a histogram can be empty: two empty ones are alike, B = 1,
//! and an empty one is unlike any other, B = 0.

use nalgebra::DMatrix;
use rayon::prelude::*;

/// Number of bins; bin h holds hues from h to below h + 1 degrees.
pub(crate) const HUE_BINS: usize = 360;

/// The bin of a colour, in 0..360; `None` for grey.
pub(crate) fn hue_bin(rgb: [u8; 3]) -> Option<u16> {
    let [r, g, b] = rgb.map(i32::from);
    let (high, low) = (r.max(g).max(b), r.min(g).min(b));
    if high == low {
        return None;
    }
    // Degrees from the hue of the strongest channel, -60 to 60.
    let (base, rise) = if high == r {
        (360, g - b)
    } else if high == g {
        (120, b - r)
    } else {
        (240, r - g)
    };
    // Positive, so that truncation rounds down. A quotient of such small whole numbers that is not whole is at least 1 / 255
    // from a whole one, far beyond what rounding can do.
    let degrees = (base as f32 + (60 * rise) as f32 / (high - low) as f32) as u16;
    Some(degrees % HUE_BINS as u16)
}

/// How many pixels have which hue.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct HueHistogram {
    counts: [u32; HUE_BINS],
}

impl Default for HueHistogram {
    fn default() -> Self {
        Self { counts: [0; HUE_BINS] }
    }
}

impl HueHistogram {
    /// Adds packed RGB pixels.
    pub(crate) fn add_pixels(&mut self, rgb: &[u8]) {
        for px in rgb.chunks_exact(3) {
            if let Some(bin) = hue_bin([px[0], px[1], px[2]]) {
                self.counts[bin as usize] += 1;
            }
        }
    }

    /// Adds the pixels of another histogram.
    pub(crate) fn merge(&mut self, other: &Self) {
        for (a, b) in self.counts.iter_mut().zip(&other.counts) {
            *a += b;
        }
    }

    /// Square roots of the shares of the hues that occur; empty without a hue.
    pub(crate) fn roots(&self) -> HueRoots {
        let total: u64 = self.counts.iter().map(|&n| u64::from(n)).sum();
        let used = self.counts.iter().enumerate().filter(|(_, n)| **n > 0);
        let bins = used.map(|(bin, &n)| (bin as u16, (f64::from(n) / total as f64).sqrt() as f32)).collect();
        HueRoots { bins }
    }
}

/// The square roots of a hue distribution, bins without a pixel left out: a partition has few hues.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct HueRoots {
    bins: Vec<(u16, f32)>,
}

impl HueRoots {
    fn dense(&self, sheet: &mut [f32; HUE_BINS]) {
        sheet.fill(0.0);
        for &(bin, root) in &self.bins {
            sheet[bin as usize] = root;
        }
    }

    /// The Bhattacharyya coefficient with a distribution that is spread over a sheet, which `is_empty` or not.
    fn coefficient(&self, sheet: &[f32; HUE_BINS], is_empty: bool) -> f32 {
        match (self.bins.is_empty(), is_empty) {
            (true, true) => 1.0,
            (false, false) => {
                // Shares add up to one but for rounding.
                self.bins.iter().map(|&(bin, root)| root * sheet[bin as usize]).sum::<f32>().min(1.0)
            }
            _ => 0.0,
        }
    }
}

/// Partitions that are treated as one: their histogram, and their indices.
#[derive(Debug, Clone, Default)]
pub(crate) struct HueGroup {
    histogram: HueHistogram,
    /// Ascending.
    pub(crate) members: Vec<usize>,
}

/// Most partitions that are compared each with each; a region has more only where the segmentation has gone to pieces.
const MAX_COMPARED: usize = 256;

/// Joins histograms until at most `most` groups remain, always the two groups that are most alike, and of pairs as alike
/// the one with the smallest indices. More than 256 histograms are first reduced to that number: those with the fewest
/// pixels of a hue each join the one of the others that they are most like.
pub(crate) fn group_alike(histograms: Vec<HueHistogram>, most: usize) -> Vec<HueGroup> {
    let most = most.max(1);
    let mut groups: Vec<HueGroup> =
        histograms.into_iter().enumerate().map(|(i, histogram)| HueGroup { histogram, members: vec![i] }).collect();
    if groups.len() <= most {
        return groups;
    }
    if groups.len() > MAX_COMPARED {
        groups = join_smallest(groups, MAX_COMPARED);
    }
    let mut likeness = likeness_matrix(&groups);
    let mut roots: Vec<HueRoots> = groups.iter().map(|g| g.histogram.roots()).collect();
    let mut alive: Vec<usize> = (0..groups.len()).collect();
    while alive.len() > most {
        let mut best = (f64::NEG_INFINITY, 0, 0);
        for (i, &a) in alive.iter().enumerate() {
            for &b in &alive[i + 1..] {
                if likeness[(a, b)] > best.0 {
                    best = (likeness[(a, b)], a, b);
                }
            }
        }
        let (_, a, b) = best;
        let joined = std::mem::take(&mut groups[b]);
        groups[a].histogram.merge(&joined.histogram);
        groups[a].members.extend(joined.members);
        alive.retain(|&i| i != b);
        roots[a] = groups[a].histogram.roots();
        let mut sheet = [0.0; HUE_BINS];
        roots[a].dense(&mut sheet);
        for &i in alive.iter().filter(|&&i| i != a) {
            let coefficient = f64::from(roots[i].coefficient(&sheet, roots[a].bins.is_empty()));
            likeness[(a, i)] = coefficient;
            likeness[(i, a)] = coefficient;
        }
    }
    let mut kept: Vec<HueGroup> = alive.into_iter().map(|i| std::mem::take(&mut groups[i])).collect();
    for group in &mut kept {
        group.members.sort_unstable();
    }
    kept
}

fn join_smallest(groups: Vec<HueGroup>, kept: usize) -> Vec<HueGroup> {
    let pixels: Vec<u64> = groups.iter().map(|g| g.histogram.counts.iter().map(|&n| u64::from(n)).sum()).collect();
    let mut order: Vec<usize> = (0..groups.len()).collect();
    order.sort_by_key(|&i| std::cmp::Reverse(pixels[i]));
    let mut is_kept = vec![false; groups.len()];
    for &i in &order[..kept.min(order.len())] {
        is_kept[i] = true;
    }
    let mut large = Vec::new();
    let mut small = Vec::new();
    for (group, is_kept) in groups.into_iter().zip(is_kept) {
        if is_kept { large.push(group) } else { small.push(group) }
    }
    let roots: Vec<HueRoots> = large.iter().map(|g| g.histogram.roots()).collect();
    let nearest: Vec<usize> = small
        .par_iter()
        .map(|group| {
            let own = group.histogram.roots();
            let mut sheet = [0.0; HUE_BINS];
            own.dense(&mut sheet);
            let mut best = (f32::NEG_INFINITY, 0);
            for (i, other) in roots.iter().enumerate() {
                let coefficient = other.coefficient(&sheet, own.bins.is_empty());
                if coefficient > best.0 {
                    best = (coefficient, i);
                }
            }
            best.1
        })
        .collect();
    for (group, i) in small.into_iter().zip(nearest) {
        large[i].histogram.merge(&group.histogram);
        large[i].members.extend(group.members);
    }
    large
}

/// The Bhattacharyya coefficient of every pair of groups, 1 on the diagonal.
fn likeness_matrix(groups: &[HueGroup]) -> DMatrix<f64> {
    let roots: Vec<HueRoots> = groups.iter().map(|g| g.histogram.roots()).collect();
    let mut matrix = DMatrix::from_element(groups.len(), groups.len(), 1.0);
    let mut sheet = [0.0; HUE_BINS];
    for (a, own) in roots.iter().enumerate() {
        own.dense(&mut sheet);
        for (b, other) in roots.iter().enumerate().skip(a + 1) {
            let coefficient = f64::from(other.coefficient(&sheet, own.bins.is_empty()));
            matrix[(a, b)] = coefficient;
            matrix[(b, a)] = coefficient;
        }
    }
    matrix
}

/// The affinities of some groups of partitions, for a normalised cut:
///
/// ```text
/// W_ab = m_a m_b B_ab        m = number of partitions in the group
/// ```
///
/// With that, cutting the groups is cutting the graph of all partitions as if those of a group had one histogram.
pub(crate) fn affinities(groups: &[HueGroup]) -> DMatrix<f64> {
    let mut matrix = likeness_matrix(groups);
    for (a, group) in groups.iter().enumerate() {
        for (b, other) in groups.iter().enumerate() {
            matrix[(a, b)] *= (group.members.len() * other.members.len()) as f64;
        }
    }
    matrix
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn histogram(pixels: &[([u8; 3], usize)]) -> HueHistogram {
        let mut histogram = HueHistogram::default();
        for &(rgb, n) in pixels {
            histogram.add_pixels(&rgb.repeat(n));
        }
        histogram
    }

    fn coefficient(a: &HueHistogram, b: &HueHistogram) -> f64 {
        let groups = [a, b].map(|h| HueGroup { histogram: h.clone(), members: vec![0] });
        likeness_matrix(&groups)[(0, 1)]
    }

    const RED: [u8; 3] = [200, 10, 10];
    const GREEN: [u8; 3] = [10, 200, 10];
    const BLUE: [u8; 3] = [10, 10, 200];
    const GREY: [u8; 3] = [90, 90, 90];

    #[test]
    fn hues_of_known_colours() {
        for (rgb, bin) in [
            ([255, 0, 0], Some(0)),
            ([255, 255, 0], Some(60)),
            ([0, 255, 0], Some(120)),
            ([0, 255, 255], Some(180)),
            ([0, 0, 255], Some(240)),
            ([255, 0, 255], Some(300)),
            // Just below 360 degrees.
            ([255, 0, 1], Some(359)),
            // 60 * 1 / 120 degrees.
            ([120, 1, 0], Some(0)),
            // 60 * 3 / 90 degrees exactly.
            ([90, 3, 0], Some(2)),
            ([0, 0, 0], None),
            ([255, 255, 255], None),
            ([7, 7, 7], None),
        ] {
            assert_eq!(hue_bin(rgb), bin, "{rgb:?}");
        }
    }

    #[test]
    fn darker_pixels_keep_their_hue() {
        assert_eq!(hue_bin([200, 100, 50]), hue_bin([100, 50, 25]));
    }

    #[test]
    fn bhattacharyya_by_hand() {
        let half = histogram(&[(RED, 5), (GREEN, 5)]);
        assert!((coefficient(&half, &histogram(&[(RED, 3)])) - 0.5f64.sqrt()).abs() < 1e-6);
        assert!((coefficient(&half, &half) - 1.0).abs() < 1e-6);
        assert_eq!(coefficient(&histogram(&[(RED, 3)]), &histogram(&[(BLUE, 9)])), 0.0);
        let thirds = histogram(&[(RED, 1), (GREEN, 3)]);
        let expected = (0.5f64 * 0.25).sqrt() + (0.5f64 * 0.75).sqrt();
        assert!((coefficient(&half, &thirds) - expected).abs() < 1e-6);
    }

    #[test]
    fn grey_is_like_grey_and_like_nothing_else() {
        let grey = histogram(&[(GREY, 40)]);
        assert_eq!(coefficient(&grey, &HueHistogram::default()), 1.0);
        assert_eq!(coefficient(&grey, &histogram(&[(RED, 1)])), 0.0);
        // Grey pixels do not count beside coloured ones.
        assert_eq!(histogram(&[(GREY, 40), (RED, 2)]), histogram(&[(RED, 2)]));
    }

    #[test]
    fn the_most_alike_are_joined_first() {
        let histograms = vec![
            histogram(&[(RED, 10)]),
            histogram(&[(GREEN, 10)]),
            histogram(&[(RED, 9), (BLUE, 1)]),
            histogram(&[(BLUE, 10)]),
            histogram(&[(GREY, 10)]),
            histogram(&[(GREY, 3)]),
        ];
        let members = |most| -> Vec<Vec<usize>> {
            group_alike(histograms.clone(), most).into_iter().map(|g| g.members).collect()
        };
        assert_eq!(members(6).len(), 6);
        assert_eq!(members(5), [vec![0], vec![1], vec![2], vec![3], vec![4, 5]]);
        assert_eq!(members(4), [vec![0, 2], vec![1], vec![3], vec![4, 5]]);
        assert_eq!(members(3), [vec![0, 2, 3], vec![1], vec![4, 5]]);
        assert_eq!(members(0), [vec![0, 1, 2, 3, 4, 5]]);
    }

    #[test]
    fn hundreds_of_partitions_become_few_groups() {
        let histograms: Vec<_> = (0..700)
            .map(|i| {
                let rgb = if i % 7 < 3 { [200, (i % 40) as u8, 0] } else { [0, (i % 40) as u8, 200] };
                histogram(&[(rgb, 1 + i % 50)])
            })
            .collect();
        let groups = group_alike(histograms, 48);
        assert!(groups.len() <= 48);
        let mut all: Vec<usize> = groups.iter().flat_map(|g| g.members.clone()).collect();
        all.sort_unstable();
        assert_eq!(all, (0..700).collect::<Vec<_>>());
        for group in &groups {
            assert!(group.members.is_sorted());
        }
    }

    #[test]
    fn affinities_count_the_partitions_of_a_group() {
        let groups =
            group_alike(vec![histogram(&[(RED, 4)]), histogram(&[(RED, 9)]), histogram(&[(RED, 5), (BLUE, 5)])], 2);
        let matrix = affinities(&groups);
        let b = 0.5f64.sqrt();
        for ((i, j), expected) in [((0, 0), 4.0), ((0, 1), 2.0 * b), ((1, 0), 2.0 * b), ((1, 1), 1.0)] {
            assert!((matrix[(i, j)] - expected).abs() < 1e-6, "({i}, {j}): {}", matrix[(i, j)]);
        }
    }

    proptest! {
        #[test]
        fn bins_are_those_of_exact_arithmetic(r: u8, g: u8, b: u8) {
            let (high, low) = (r.max(g).max(b), r.min(g).min(b));
            let expected = (high > low).then(|| {
                let [r, g, b, high, low] = [r, g, b, high, low].map(i32::from);
                let (base, rise) = if high == r { (0, g - b) } else if high == g { (120, b - r) } else { (240, r - g) };
                ((base + (60 * rise).div_euclid(high - low)).rem_euclid(360)) as u16
            });
            prop_assert_eq!(hue_bin([r, g, b]), expected);
        }
    }
}
