//! Salient regions: the partitions whose saliency stands above the background, joined where they touch.

use std::f32::consts::FRAC_PI_2;

use image::GrayImage;
use rayon::prelude::*;
use samsod_segment::{BoundingBox, Partition};
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};

use crate::SaliencyMap;

/// From which mean saliency on a partition is salient.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub enum Threshold {
    /// The paper's S > 0, made robust: just above the noise of the background.
    #[default]
    Positive,
    /// Twice the mean of S over the image (the rule of Achanta et al. that the paper uses for its F-measure).
    Adaptive,
    /// A fixed value in [0, 1]; a partition is salient when its mean saliency exceeds it.
    Value(f32),
}

/// One connected salient region: partitions that touch and are all salient.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SalientRegion {
    /// Labels of its partitions, ascending; its boundary is theirs.
    pub partitions: Vec<u32>,
    /// Number of pixels.
    pub area: u32,
    /// Extent in the image.
    pub bbox: BoundingBox,
    /// Centre of area (x, y), px, pixel centres at integers.
    pub centroid: [f32; 2],
    /// Direction of the longest axis (second moments), radians in (-pi/2, pi/2], counter-clockwise on the screen
    /// from image right; 0 where no axis is longest.
    pub axis_rad: f32,
    /// Mean of S over the region, in [0, 1].
    pub mean_saliency: f32,
}

/// Why there are no salient regions.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RegionError {
    /// The map and the partition differ in size.
    #[error("saliency map of {map_width} x {map_height} px for a partition of {width} x {height} px")]
    Size {
        /// Width of the map, px.
        map_width: u32,
        /// Height of the map, px.
        map_height: u32,
        /// Width of the partition, px.
        width: u32,
        /// Height of the partition, px.
        height: u32,
    },
    /// A threshold that is NaN or out of range.
    #[error("threshold = {value}; allowed are \"positive\", \"adaptive\" or a number from 0 to 1")]
    Threshold {
        /// The value given.
        value: f32,
    },
}

impl Threshold {
    /// Checks the range of a number.
    ///
    /// # Errors
    /// [`RegionError::Threshold`] for NaN or a number outside of [0, 1].
    pub fn check(&self) -> Result<(), RegionError> {
        match *self {
            Self::Value(value) if !(0.0..=1.0).contains(&value) => Err(RegionError::Threshold { value }),
            _ => Ok(()),
        }
    }
}

impl Serialize for Threshold {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Positive => serializer.serialize_str("positive"),
            Self::Adaptive => serializer.serialize_str("adaptive"),
            Self::Value(value) => serializer.serialize_f32(*value),
        }
    }
}

impl<'de> Deserialize<'de> for Threshold {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged, expecting = "threshold: allowed are \"positive\", \"adaptive\" or a number from 0 to 1")]
        enum Written {
            Number(f32),
            Word(String),
        }
        match Written::deserialize(deserializer)? {
            Written::Number(value) => Ok(Self::Value(value)),
            Written::Word(word) => match word.as_str() {
                "positive" => Ok(Self::Positive),
                "adaptive" => Ok(Self::Adaptive),
                _ => Err(de::Error::custom(format!(
                    "threshold = {word:?}; allowed are \"positive\", \"adaptive\" or a number from 0 to 1"
                ))),
            },
        }
    }
}

#[cfg(feature = "schema")]
impl schemars::JsonSchema for Threshold {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "Threshold".into()
    }

    fn json_schema(_: &mut schemars::SchemaGenerator) -> schemars::Schema {
        schemars::json_schema!({
            "anyOf": [{ "enum": ["positive", "adaptive"] }, { "type": "number", "minimum": 0, "maximum": 1 }]
        })
    }
}

impl SalientRegion {
    /// The pixels of the region: an image of the partition's size, 255 inside and 0 outside.
    pub fn mask(&self, partition: &Partition) -> GrayImage {
        let mut inside = vec![0u8; partition.len()];
        for &label in &self.partitions {
            if let Some(slot) = inside.get_mut(label as usize) {
                *slot = 255;
            }
        }
        let pixels = partition.labels().iter().map(|&l| inside[l as usize]).collect();
        GrayImage::from_raw(partition.width(), partition.height(), pixels).unwrap_or_default()
    }
}

/// The connected regions of partitions whose mean saliency exceeds the threshold, largest first.
///
/// # Errors
/// [`RegionError`] when sizes differ or the threshold is out of range.
pub fn salient_regions(
    map: &SaliencyMap,
    partition: &Partition,
    threshold: Threshold,
) -> Result<Vec<SalientRegion>, RegionError> {
    let mut regions = Vec::new();
    salient_regions_into(map, partition, threshold, &mut regions)?;
    Ok(regions)
}

/// As [`salient_regions`], into a vector whose memory is reused.
///
/// # Errors
/// As [`salient_regions`]; the vector is then unchanged.
pub fn salient_regions_into(
    map: &SaliencyMap,
    partition: &Partition,
    threshold: Threshold,
    regions: &mut Vec<SalientRegion>,
) -> Result<(), RegionError> {
    if (map.width(), map.height()) != (partition.width(), partition.height()) {
        return Err(RegionError::Size {
            map_width: map.width(),
            map_height: map.height(),
            width: partition.width(),
            height: partition.height(),
        });
    }
    threshold.check()?;
    regions.clear();
    let means = partition_means(map.values(), partition);
    let salient: Vec<bool> = match threshold {
        Threshold::Value(value) => means.iter().map(|&m| m > value).collect(),
        Threshold::Adaptive => {
            let limit = 2.0 * image_mean(&means, partition);
            means.iter().map(|&m| m > limit).collect()
        }
        Threshold::Positive => {
            let background = partition.border_background();
            let limit = noise_limit(&means, &background, partition);
            means.iter().zip(&background).map(|(&m, &b)| !b && m > limit).collect()
        }
    };
    collect_regions(&salient, &means, partition, regions);
    Ok(())
}

/// Mean of S over every partition.
pub(crate) fn partition_means(values: &[f32], partition: &Partition) -> Vec<f32> {
    let width = partition.width().max(1) as usize;
    // One sum a run, side by side; added up in the order of rows, whatever the number of threads.
    let sums_of_rows: Vec<Vec<f32>> = values
        .par_chunks_exact(width)
        .zip(partition.runs().rows())
        .with_min_len(32)
        .map(|(line, row)| row.iter().map(|run| line[run.start as usize..run.end as usize].iter().sum()).collect())
        .collect();
    let mut sums = vec![0f64; partition.len()];
    for (row, sums_of_row) in partition.runs().rows().iter().zip(&sums_of_rows) {
        for (run, &sum) in row.iter().zip(sums_of_row) {
            sums[run.label as usize] += f64::from(sum);
        }
    }
    sums.iter().zip(partition.objects()).map(|(s, o)| (s / f64::from(o.area)) as f32).collect()
}

fn image_mean(means: &[f32], partition: &Partition) -> f32 {
    let sum: f64 = means.iter().zip(partition.objects()).map(|(&m, o)| f64::from(m) * f64::from(o.area)).sum();
    (sum / partition.labels().len().max(1) as f64) as f32
}

/// The saliency that the background itself reaches: half of its mean, and more than rounding.
fn noise_limit(means: &[f32], background: &[bool], partition: &Partition) -> f32 {
    const ROUNDING: f32 = 0.001;
    let (mut sum, mut area) = (0f64, 0f64);
    for ((&mean, object), _) in means.iter().zip(partition.objects()).zip(background).filter(|(_, b)| **b) {
        sum += f64::from(mean) * f64::from(object.area);
        area += f64::from(object.area);
    }
    (0.5 * sum / area.max(1.0)).max(f64::from(ROUNDING)) as f32
}

fn collect_regions(salient: &[bool], means: &[f32], partition: &Partition, regions: &mut Vec<SalientRegion>) {
    let mut region_of = vec![u32::MAX; salient.len()];
    let mut stack = Vec::new();
    for first in 0..salient.len() as u32 {
        if !salient[first as usize] || region_of[first as usize] != u32::MAX {
            continue;
        }
        let number = regions.len() as u32;
        let mut partitions = Vec::new();
        region_of[first as usize] = number;
        stack.push(first);
        while let Some(label) = stack.pop() {
            partitions.push(label);
            for &next in partition.neighbours(label) {
                if salient[next as usize] && region_of[next as usize] == u32::MAX {
                    region_of[next as usize] = number;
                    stack.push(next);
                }
            }
        }
        partitions.sort_unstable();
        regions.push(summarize(partitions, means, partition));
    }
    let axes = axes(&region_of, regions, partition);
    for (region, axis) in regions.iter_mut().zip(axes) {
        region.axis_rad = axis;
    }
    regions.sort_by(|a, b| b.area.cmp(&a.area).then(a.partitions.cmp(&b.partitions)));
}

fn summarize(partitions: Vec<u32>, means: &[f32], partition: &Partition) -> SalientRegion {
    let objects = || partitions.iter().map(|&l| (&partition.objects()[l as usize], means[l as usize]));
    let (mut area, mut x, mut y, mut saliency) = (0u32, 0f64, 0f64, 0f64);
    let mut bbox = objects().next().map_or(BoundingBox { x: 0, y: 0, width: 1, height: 1 }, |(o, _)| o.bbox);
    for (object, mean) in objects() {
        let n = f64::from(object.area);
        area += object.area;
        x += n * f64::from(object.centroid[0]);
        y += n * f64::from(object.centroid[1]);
        saliency += n * f64::from(mean);
        bbox = bbox.union(&object.bbox);
    }
    let n = f64::from(area.max(1));
    SalientRegion {
        partitions,
        area,
        bbox,
        centroid: [(x / n) as f32, (y / n) as f32],
        axis_rad: 0.0,
        mean_saliency: (saliency / n) as f32,
    }
}

/// Direction of the longest axis of every region, from second moments summed run by run.
fn axes(region_of: &[u32], regions: &[SalientRegion], partition: &Partition) -> Vec<f32> {
    let mut moments = vec![[0f64; 3]; regions.len()];
    for (y, row) in partition.runs().rows().iter().enumerate() {
        for run in row {
            let (from, n) = (f64::from(run.start), f64::from(run.end - run.start));
            let number = region_of[run.label as usize] as usize;
            let Some(region) = regions.get(number) else { continue };
            let dx = from + (n - 1.0) / 2.0 - f64::from(region.centroid[0]);
            let dy = y as f64 - f64::from(region.centroid[1]);
            let m = &mut moments[number];
            // A run of n pixels has a second moment of its own, n (n^2 - 1) / 12.
            m[0] += n * dx * dx + n * (n * n - 1.0) / 12.0;
            m[1] += n * dx * dy;
            m[2] += n * dy * dy;
        }
    }
    moments.into_iter().map(longest_axis_rad).collect()
}

/// Direction of the longest axis of a shape from its second moments about its centre, `[xx, xy, yy]` in image coordinates
/// (y down): radians in (-pi/2, pi/2], counter-clockwise on the screen from image right; 0 where no axis is longest.
pub fn longest_axis_rad([xx, xy, yy]: [f64; 3]) -> f32 {
    // y grows downwards, so the sign turns to be counter-clockwise on the screen.
    let (cross, difference) = (-2.0 * xy, xx - yy);
    if cross.abs() + difference.abs() <= 1e-6 * (xx + yy) {
        return 0.0;
    }
    let axis = (cross.atan2(difference) / 2.0) as f32;
    // A vertical axis is up, not down: -0.0 and rounding would make it -pi / 2.
    if axis <= -FRAC_PI_2 { FRAC_PI_2 } else { axis }
}
