//! One frame as it was recorded and as it is seen now: which stages differ, and by how much.

use std::collections::HashMap;
use std::fmt;

use serde_json::Value;

use super::{RecordedFrame, Seen, Target};

/// A stage, or what is made of one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// Partitions.
    Labels,
    /// The saliency map.
    Saliency,
    /// Salient regions.
    Regions,
    /// Pixels of objects and shadows.
    Masks,
    /// Outlines of the objects.
    Outlines,
    /// Figures of the objects.
    Objects,
    /// What the objects are.
    Detections,
    /// Where they lie.
    Places,
    /// Where the robot is sent.
    Target,
}

impl Stage {
    const ALL: [Self; 9] = [
        Self::Labels,
        Self::Saliency,
        Self::Regions,
        Self::Masks,
        Self::Outlines,
        Self::Objects,
        Self::Detections,
        Self::Places,
        Self::Target,
    ];

    fn name(self) -> &'static str {
        match self {
            Self::Labels => "labels",
            Self::Saliency => "saliency",
            Self::Regions => "regions",
            Self::Masks => "masks",
            Self::Outlines => "outlines",
            Self::Objects => "objects",
            Self::Detections => "detections",
            Self::Places => "places",
            Self::Target => "target",
        }
    }

    /// The topics whose messages must be equal.
    fn topics(self) -> &'static [&'static str] {
        match self {
            Self::Labels => &["/segment/labels"],
            Self::Saliency => &["/saliency"],
            Self::Regions => &["/regions"],
            Self::Masks => &["/masks"],
            Self::Outlines => &["/outlines"],
            Self::Detections => &["/detections"],
            Self::Places => &["/places", "/tf"],
            Self::Objects | Self::Target => &[],
        }
    }

    /// The keys of `/scene` that must be equal.
    fn figures(self) -> &'static [&'static str] {
        match self {
            Self::Labels => &["width_px", "height_px", "partitions"],
            Self::Regions => &["regions"],
            Self::Objects => &["objects"],
            Self::Detections => &["detections"],
            _ => &[],
        }
    }
}

/// Names of parts that are told one by one; beyond that they are counted.
const MOST_NAMES: usize = 5;

/// A stage over all frames.
#[derive(Debug, Clone, PartialEq)]
pub struct StageComparison {
    /// Which.
    pub stage: Stage,
    /// Frames, or targets, that were compared.
    pub compared: u64,
    /// Those that differ.
    pub differ: u64,
    /// Greatest number of pixels of a frame that belong elsewhere, and the share of the frame.
    pub pixels: Option<(u64, f64)>,
    /// Greatest difference of the saliency of a pixel, and the greatest mean over a frame.
    pub saliency: Option<(f64, f64)>,
    /// The frame whose number of partitions, regions, objects or detections changed most: before, and now.
    pub count: Option<(u64, u64)>,
    /// Least intersection over union of an object with what it is now.
    pub least_iou: Option<f64>,
    /// Greatest way that a centroid or the origin of a part has moved, px.
    pub moved_px: Option<f64>,
    /// Greatest way of a place or a target, mm.
    pub moved_mm: Option<f64>,
    /// Greatest difference of a score.
    pub score: Option<f64>,
    /// Parts with another name: frame, from 0, and both names. The first ones only.
    pub names: Vec<(u64, String, String)>,
    /// All parts with another name.
    pub names_changed: u64,
}

impl StageComparison {
    pub(super) fn all() -> Vec<Self> {
        Stage::ALL.map(Self::new).to_vec()
    }

    fn new(stage: Stage) -> Self {
        Self {
            stage,
            compared: 0,
            differ: 0,
            pixels: None,
            saliency: None,
            count: None,
            least_iou: None,
            moved_px: None,
            moved_mm: None,
            score: None,
            names: Vec::new(),
            names_changed: 0,
        }
    }

    fn counts(&mut self, before: usize, now: usize) {
        let (before, now) = (before as u64, now as u64);
        if before != now && self.count.is_none_or(|(b, n)| b.abs_diff(n) < before.abs_diff(now)) {
            self.count = Some((before, now));
        }
    }
}

impl fmt::Display for StageComparison {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut words = Vec::new();
        if let Some((pixels, share)) = self.pixels {
            words.push(format!("in up to {pixels} px ({:.2} %) of a frame", share * 100.0));
        }
        if let Some((greatest, mean)) = self.saliency {
            words.push(format!("by up to {greatest:.4}, {mean:.6} in the mean over a frame"));
        }
        if let Some((before, now)) = self.count {
            words.push(format!("{before} became {now}"));
        }
        if let Some(iou) = self.least_iou {
            words.push(format!("intersection over union at least {iou:.3}"));
        }
        if let Some(px) = self.moved_px {
            words.push(format!("moved up to {px:.2} px"));
        }
        if let Some(mm) = self.moved_mm {
            words.push(format!("moved up to {mm:.2} mm"));
        }
        if let Some(score) = self.score {
            words.push(format!("score by up to {score:.3}"));
        }
        if self.names_changed > 0 {
            let names = self.names.iter().map(|(frame, before, now)| format!("frame {frame} {before} -> {now}"));
            words.push(format!("{} names: {}", self.names_changed, names.collect::<Vec<_>>().join(", ")));
        }
        let (name, compared, differ) = (self.stage.name(), self.compared, self.differ);
        write!(f, "{}", format!("{name:<12} {compared:>8} {differ:>8}  {}", words.join("; ")).trim_end())
    }
}

fn greatest(kept: &mut Option<f64>, value: f64) {
    *kept = Some(kept.map_or(value, |kept| kept.max(value)));
}

fn least(kept: &mut Option<f64>, value: f64) {
    *kept = Some(kept.map_or(value, |kept| kept.min(value)));
}

/// Compares a frame; whether any stage differs.
pub(super) fn compare(
    frame: &RecordedFrame,
    seen: &Seen<'_>,
    targets: &[Target],
    stages: &mut [StageComparison],
) -> bool {
    let now = |topic: &str| seen.messages.iter().find(|(name, _)| *name == topic).map(|(_, data)| data);
    let figures_before = frame.scene();
    let figures_now: Option<Value> = now("/scene").and_then(|data| serde_json::from_slice(data).ok());
    let mut any = false;
    for comparison in stages {
        let stage = comparison.stage;
        if stage == Stage::Target {
            any |= compare_targets(seen, targets, comparison);
            continue;
        }
        // A message that only one of both has is a difference, unless the recording ends before it.
        let topics = stage.topics().iter().map(|topic| (frame.messages.get(*topic), now(topic)));
        let topics = topics.filter(|(before, now)| before.is_some() || (frame.is_whole && now.is_some()));
        let equal: Vec<bool> = topics.map(|(before, now)| before == now).collect();
        let figures = figures_before.iter().flat_map(|before| {
            stage.figures().iter().map(|key| Some(&before[*key]) == figures_now.as_ref().map(|now| &now[*key]))
        });
        let equal: Vec<bool> = equal.into_iter().chain(figures).collect();
        if equal.is_empty() {
            continue;
        }
        let number = comparison.compared;
        comparison.compared += 1;
        if equal.iter().all(|equal| *equal) {
            continue;
        }
        any = true;
        comparison.differ += 1;
        let empty = Value::Null;
        let (before, now) = (figures_before.as_ref().unwrap_or(&empty), figures_now.as_ref().unwrap_or(&empty));
        measure(frame, seen, (before, now), number, comparison);
    }
    any
}

fn compare_targets(seen: &Seen<'_>, targets: &[Target], comparison: &mut StageComparison) -> bool {
    let mut any = false;
    let now = seen.target.as_ref().and_then(|pose| serde_json::to_value(pose).ok());
    for target in targets.iter().filter(|target| target.phase.is_none()) {
        comparison.compared += 1;
        if now.as_ref() == Some(&target.pose) {
            continue;
        }
        any = true;
        comparison.differ += 1;
        if let Some(now) = &now {
            let at = |pose: &Value| ["x_mm", "y_mm", "z_mm"].map(|key| pose[key].as_f64().unwrap_or(f64::NAN));
            greatest(&mut comparison.moved_mm, distance(&at(&target.pose), &at(now)));
        }
    }
    any
}

/// Says by how much a stage that differs does.
fn measure(
    frame: &RecordedFrame,
    seen: &Seen<'_>,
    (before, now): (&Value, &Value),
    number: u64,
    comparison: &mut StageComparison,
) {
    let list = |figures: &'_ Value, key: &str| figures[key].as_array().cloned().unwrap_or_default();
    match comparison.stage {
        Stage::Labels => {
            if let Some(labels) = frame.labels() {
                elsewhere(&labels, seen.scene.partition.labels(), &mut comparison.pixels);
            }
            let count = |figures: &Value| figures["partitions"].as_u64().unwrap_or_default() as usize;
            comparison.counts(count(before), count(now));
        }
        Stage::Saliency => {
            let Some(map) = frame.saliency() else { return };
            let differences = map.iter().zip(seen.scene.saliency.values());
            // Eight bits are recorded, and the map of now is as it was computed.
            let eight_bits = |s: f32| if frame.has_float_saliency() { s } else { (s * 255.0 + 0.5).floor() / 255.0 };
            let (mut sum, mut most) = (0.0, 0.0f64);
            for (before, now) in differences {
                let difference = f64::from((before - eight_bits(*now)).abs());
                sum += difference;
                most = most.max(difference);
            }
            let mean = sum / map.len().max(1) as f64;
            let (m, n) = comparison.saliency.unwrap_or_default();
            comparison.saliency = Some((m.max(most), n.max(mean)));
        }
        Stage::Masks => {
            let codes = seen.messages.iter().find(|(topic, _)| *topic == "/masks");
            let codes = codes.and_then(|(_, data)| super::recording::mask_codes(data, frame.image.dimensions()));
            if let (Some(before), Some(now)) = (frame.masks(), codes) {
                elsewhere(&before, &now, &mut comparison.pixels);
            }
        }
        Stage::Regions => comparison.counts(list(before, "regions").len(), list(now, "regions").len()),
        Stage::Objects => {
            let (before, now) = (list(before, "objects"), list(now, "objects"));
            comparison.counts(before.len(), now.len());
            let Some(codes) = frame.masks() else { return };
            for (i, object) in before.iter().enumerate() {
                let Some((j, iou)) = overlap(i, &codes, seen) else { continue };
                least(&mut comparison.least_iou, iou);
                let Some(other) = now.get(j) else { continue };
                greatest(&mut comparison.moved_px, between(object, other, "/centroid_px"));
                let place = |o: &Value| Some([o["world"]["x_mm"].as_f64()?, o["world"]["y_mm"].as_f64()?]);
                if let (Some(a), Some(b)) = (place(object), place(other)) {
                    greatest(&mut comparison.moved_mm, distance(&a, &b));
                }
            }
        }
        Stage::Detections => {
            let (before, now) = (list(before, "detections"), list(now, "detections"));
            comparison.counts(before.len(), now.len());
            for detection in &before {
                let away = |other: &&Value| between(detection, other, "/image/origin_px");
                let Some(other) = now.iter().min_by(|a, b| away(a).total_cmp(&away(b))) else { continue };
                let name = |d: &Value| d["name"].as_str().unwrap_or("unknown").to_owned();
                if name(detection) != name(other) {
                    comparison.names_changed += 1;
                    if comparison.names.len() < MOST_NAMES {
                        comparison.names.push((number, name(detection), name(other)));
                    }
                }
                greatest(&mut comparison.moved_px, away(&other));
                let score = |d: &Value| d["score"].as_f64().unwrap_or_default();
                greatest(&mut comparison.score, (score(detection) - score(other)).abs());
            }
        }
        Stage::Outlines | Stage::Places | Stage::Target => {}
    }
}

/// Distance of two points of figures, px.
fn between(a: &Value, b: &Value, pointer: &str) -> f64 {
    let at = |figures: &Value| {
        let point = figures.pointer(pointer);
        [0, 1].map(|axis| point.and_then(|p| p[axis].as_f64()).unwrap_or(f64::NAN))
    };
    distance(&at(a), &at(b))
}

fn distance(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
}

/// Keeps the greatest number of pixels that belong elsewhere: numbers may be given anew, so each area is compared with the one
/// that covers most of it, both ways.
fn elsewhere<T: Copy + Eq + std::hash::Hash>(before: &[T], now: &[T], kept: &mut Option<(u64, f64)>) {
    let mut pairs: HashMap<(T, T), u64> = HashMap::new();
    for pair in before.iter().zip(now) {
        *pairs.entry((*pair.0, *pair.1)).or_default() += 1;
    }
    let covered = |of: fn(&(T, T)) -> T| {
        let mut most: HashMap<T, u64> = HashMap::new();
        for (pair, pixels) in &pairs {
            let most = most.entry(of(pair)).or_default();
            *most = (*most).max(*pixels);
        }
        most.values().sum::<u64>()
    };
    let all = before.len().max(now.len()) as u64;
    let pixels = all - covered(|pair| pair.0).min(covered(|pair| pair.1));
    let share = pixels as f64 / all.max(1) as f64;
    *kept = Some(kept.filter(|(most, _)| *most >= pixels).unwrap_or((pixels, share)));
}

/// The object of now that shares most pixels with object `i` of the recording, and their intersection over union.
fn overlap(i: usize, codes: &[u8], seen: &Seen<'_>) -> Option<(usize, f64)> {
    // Later objects share one code.
    let code = u8::try_from(i).ok().filter(|i| *i < 126).map(|i| 255 - i)?;
    let area = codes.iter().filter(|c| **c == code).count() as f64;
    let width = seen.scene.partition.width() as usize;
    let shares = seen.scene.objects.iter().map(|object| {
        let runs = object.mask.runs();
        let inside = runs.map(|run| {
            let row = run.y as usize * width;
            let pixels = codes.get(row + run.start as usize..row + run.end as usize).unwrap_or_default();
            pixels.iter().filter(|c| **c == code).count() as f64
        });
        let inside: f64 = inside.sum();
        inside / (area + f64::from(object.area) - inside).max(1.0)
    });
    shares.enumerate().max_by(|(_, a), (_, b)| a.total_cmp(b))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn areas_that_are_only_numbered_anew_are_the_same() {
        let mut kept = None;
        elsewhere(&[0, 0, 1, 1, 2], &[7, 7, 3, 3, 0], &mut kept);
        assert_eq!(kept, Some((0, 0.0)));
        // One pixel has changed hands, and later less is kept less.
        elsewhere(&[0, 0, 0, 1], &[0, 0, 1, 1], &mut kept);
        assert_eq!(kept, Some((1, 0.25)));
        elsewhere(&[0, 0, 0, 1], &[0, 0, 0, 1], &mut kept);
        assert_eq!(kept, Some((1, 0.25)));
        // An area that has swallowed another is a difference, though each of the old ones is covered whole.
        let mut swallowed = None;
        elsewhere(&[0, 0, 1, 1], &[0, 0, 0, 0], &mut swallowed);
        assert_eq!(swallowed, Some((2, 0.5)));
    }

    #[test]
    fn a_line_says_by_how_much() {
        let mut labels = StageComparison { compared: 7, differ: 2, ..StageComparison::new(Stage::Labels) };
        labels.counts(10, 12);
        labels.counts(10, 9);
        labels.counts(5, 5);
        labels.pixels = Some((25, 0.0025));
        assert_eq!(
            labels.to_string(),
            "labels              7        2  in up to 25 px (0.25 %) of a frame; 10 became 12"
        );
        assert_eq!(StageComparison::new(Stage::Target).to_string(), "target              0        0");
    }
}
