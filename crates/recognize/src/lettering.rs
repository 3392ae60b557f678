//! Which of the turns that its outline allows a part has, by what is written on it.
//!
//! In: the template of a part whose outline has n-fold symmetry and whose picture has less. Out: its level pixels, each with its
//! brightness against its surroundings and with how much brighter it is than what a turn brings there: labels that are the
//! same at two turns cancel out, and what is written on them remains. In a frame these differences are a matched filter:
//! correlated with what is seen they are positive at the turn that is right and negative at the other, whatever the light on
//! the labels.

use std::f64::consts::TAU;

use samsod_camera::Camera;
use samsod_segment::RgbView;
use serde::{Deserialize, Serialize};

use crate::catalogue::Part;
use crate::edge_model::EdgeModel;
use crate::gradient::Gradient;
use crate::mesh::Mesh;
use crate::pose_fit::{Fitter, Pose};
use crate::template_edges::TemplateSurface;

/// Half the side of the surroundings of a pixel, px of the template: hardly more than a letter.
const HALF_WINDOW: i32 = 2;
/// Contrast in them that counts half, sRGB levels: less is grain.
const GRAIN: f32 = 4.0;
/// Differences in units of that contrast that tell turns apart,
const LEAST_DIFFERENCE: f32 = 0.5;
/// at so many pixels at least.
const LEAST_PIXELS: usize = 40;
/// Largest template that is looked at, px: what is written on larger ones is told by their features.
const MOST_PIXELS: usize = 250_000;
/// The correlations of two turns must differ by so much.
const LEAD: f32 = 0.2;

/// What is written on the level surfaces of a part.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Lettering {
    width: usize,
    height: usize,
    /// Index in the template, place in the frame of the part (mm), and brightness against the surroundings.
    pixels: Vec<(u32, [f32; 3], f32)>,
    /// For every turn but the first, and every pixel, how much brighter it is than what the turn brings there; 0 where that is
    /// alike or not level.
    differences: Vec<Vec<f32>>,
}

impl Lettering {
    /// That of a part; `None` where the outline tells as much as the picture, or any turn looks alike.
    pub(crate) fn of(part: &Part, mesh: &Mesh) -> Option<Self> {
        let order = part.symmetry.shape_order;
        if order < 2 || order == part.symmetry.appearance_order {
            return None;
        }
        let (width, height) = part.template.image.dimensions();
        let (width, height) = (width as usize, height as usize);
        if width * height > MOST_PIXELS {
            return None;
        }
        let surface = TemplateSurface::of(part, mesh)?;
        let grey: Vec<f32> =
            part.template.image.pixels().map(|p| p.0.iter().map(|&c| f32::from(c)).sum::<f32>() / 3.0).collect();
        let level: Vec<bool> = (0..width * height).map(|i| surface.is_level(i)).collect();
        let own = normalised(&grey, &level, width);
        let indices: Vec<usize> = (0..width * height).filter(|&i| level[i]).collect();
        let pixels: Vec<(u32, [f32; 3], f32)> =
            indices.iter().filter_map(|&i| Some((i as u32, surface.position(i)?, own[i]))).collect();
        let differences: Vec<Vec<f32>> = (1..order)
            .map(|k| {
                let (sin, cos) = (TAU * f64::from(k) / f64::from(order)).sin_cos();
                // What the template shows where the turn brings every pixel from: at the same height, as the outline is the same.
                let mut turned = vec![0.0; width * height];
                let mut both = vec![false; width * height];
                for (i, [x, y, z], _) in &pixels {
                    let (x, y) = (f64::from(*x), f64::from(*y));
                    let from = surface.pixel([cos * x + sin * y, cos * y - sin * x, f64::from(*z)]);
                    let seen = from.and_then(|from| between(&grey, &level, width, from));
                    if let Some(value) = seen {
                        (turned[*i as usize], both[*i as usize]) = (value, true);
                    }
                }
                let (a, b) = (normalised(&grey, &both, width), normalised(&turned, &both, width));
                let difference = |i: &u32| {
                    let d = a[*i as usize] - b[*i as usize];
                    if both[*i as usize] && d.abs() >= LEAST_DIFFERENCE { d } else { 0.0 }
                };
                pixels.iter().map(|(i, _, _)| difference(i)).collect()
            })
            .collect();
        let tells = |difference: &Vec<f32>| difference.iter().filter(|d| **d != 0.0).count() >= LEAST_PIXELS;
        differences.iter().all(tells).then_some(Self { width, height, pixels, differences })
    }

    /// The pose, turned to where the frame shows what is written; `None` where that does not tell.
    pub(crate) fn turned(
        &self,
        fitter: &mut Fitter,
        model: &EdgeModel,
        part: &Part,
        camera: &Camera,
        (frame, gradient): (&RgbView<'_>, &Gradient),
        pose: Pose,
    ) -> Option<Pose> {
        let order = self.differences.len() + 1;
        // Every turn where its own edges put it.
        let fitted = |fitter: &mut Fitter, pose: Pose| {
            let fit = fitter.fit(model, part.height_mm, camera, gradient, pose);
            fit.map_or(pose, |fit| fit.pose)
        };
        let mut best = (pose, self.seen(frame, camera, &fitted(fitter, pose)));
        let (mut at, mut tells) = (0, false);
        for k in 1..order {
            let turn = TAU * k as f64 / order as f64;
            let other = fitted(fitter, Pose { yaw_rad: pose.yaw_rad + turn, ..pose });
            let seen = self.seen(frame, camera, &other);
            // As the one sees the other, and the other the one.
            let (there, back) = (k - at, order + at - k);
            let [Some(own), Some(others)] =
                [(&best.1, there), (&seen, back)].map(|(seen, turn)| self.correlation(seen.as_deref()?, turn % order))
            else {
                continue;
            };
            tells |= (others - own).abs() > LEAD;
            if others > own + LEAD {
                (best, at) = ((other, seen), k);
            }
        }
        tells.then_some(best.0)
    }

    /// What the frame shows at every pixel, against its surroundings; `None` where it ends. Of places up to a pixel away those
    /// at which it looks most like the template.
    fn seen(&self, frame: &RgbView<'_>, camera: &Camera, pose: &Pose) -> Option<Vec<f32>> {
        let projected: Option<Vec<[f32; 2]>> = (self.pixels.iter())
            .map(|(_, position, _)| {
                camera.image_from_world(pose.world_from_part(*position)).ok().map(|at| at.map(|c| c as f32))
            })
            .collect();
        let projected = projected?;
        let mut mask = vec![false; self.width * self.height];
        for (i, _, _) in &self.pixels {
            *mask.get_mut(*i as usize)? = true;
        }
        let mut best: Option<(f32, Vec<f32>)> = None;
        for (dx, dy) in [(0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)] {
            let mut grey = vec![0.0; self.width * self.height];
            for ((i, _, _), [u, v]) in self.pixels.iter().zip(&projected) {
                grey[*i as usize] = brightness(frame, u + dx, v + dy)?;
            }
            let all = normalised(&grey, &mask, self.width);
            let seen: Vec<f32> = self.pixels.iter().map(|(i, _, _)| all[*i as usize]).collect();
            let alike: f32 = seen.iter().zip(&self.pixels).map(|(seen, (_, _, own))| seen * own).sum();
            if best.as_ref().is_none_or(|(most, _)| alike > *most) {
                best = Some((alike, seen));
            }
        }
        best.map(|(_, seen)| seen)
    }

    /// Correlation of what is seen with the difference to a turn, in [-1, 1].
    fn correlation(&self, seen: &[f32], turn: usize) -> Option<f32> {
        let difference = self.differences.get(turn.checked_sub(1)?)?;
        let (mut both, mut own, mut other) = (0.0, 0.0, 0.0);
        for (d, s) in difference.iter().zip(seen).filter(|(d, _)| **d != 0.0) {
            both += d * s;
            own += d * d;
            other += s * s;
        }
        (own > 0.0 && other > 0.0).then(|| both / (own * other).sqrt())
    }
}

/// Values less the mean of their surroundings in the mask, in units of the deviation there.
fn normalised(values: &[f32], mask: &[bool], width: usize) -> Vec<f32> {
    let height = values.len() / width.max(1);
    let mut result = vec![0.0; values.len()];
    for y in 0..height as i32 {
        for x in 0..width as i32 {
            let i = y as usize * width + x as usize;
            if !mask[i] {
                continue;
            }
            let (mut n, mut sum, mut squares) = (0.0, 0.0, 0.0);
            for v in (y - HALF_WINDOW).max(0)..=(y + HALF_WINDOW).min(height as i32 - 1) {
                for u in (x - HALF_WINDOW).max(0)..=(x + HALF_WINDOW).min(width as i32 - 1) {
                    let j = v as usize * width + u as usize;
                    if mask[j] {
                        n += 1.0;
                        sum += values[j];
                        squares += values[j] * values[j];
                    }
                }
            }
            let mean: f32 = sum / n;
            let deviation = (squares / n - mean * mean).max(0.0).sqrt();
            result[i] = (values[i] - mean) / (deviation + GRAIN);
        }
    }
    result
}

/// A value between pixels, all of which must be in the mask.
fn between(values: &[f32], mask: &[bool], width: usize, [u, v]: [f64; 2]) -> Option<f32> {
    let height = values.len() / width.max(1);
    let inside = u >= 0.0 && v >= 0.0 && u < width as f64 - 1.0 && v < height as f64 - 1.0;
    if !inside {
        return None;
    }
    let (x, y) = (u as usize, v as usize);
    let (fx, fy) = ((u - x as f64) as f32, (v - y as f64) as f32);
    let i = y * width + x;
    let corners = [i, i + 1, i + width, i + width + 1];
    if !corners.iter().all(|&j| mask[j]) {
        return None;
    }
    let upper = values[i] + fx * (values[i + 1] - values[i]);
    let lower = values[i + width] + fx * (values[i + width + 1] - values[i + width]);
    Some(upper + fy * (lower - upper))
}

/// Brightness of a frame between pixels; `None` outside.
fn brightness(frame: &RgbView<'_>, u: f32, v: f32) -> Option<f32> {
    let (width, height) = (frame.width() as usize, frame.height() as usize);
    if !(u >= 0.0 && v >= 0.0 && u < width as f32 - 1.0 && v < height as f32 - 1.0) {
        return None;
    }
    let (x, y) = (u as usize, v as usize);
    let (fx, fy) = (u - x as f32, v - y as f32);
    let raw = frame.as_raw();
    let grey = |x: usize, y: usize| {
        let start = 3 * (y * width + x);
        raw.get(start..start + 3).map_or(0.0, |rgb| rgb.iter().map(|&c| f32::from(c)).sum::<f32>() / 3.0)
    };
    let upper = grey(x, y) + fx * (grey(x + 1, y) - grey(x, y));
    let lower = grey(x, y + 1) + fx * (grey(x + 1, y + 1) - grey(x, y + 1));
    Some(upper + fy * (lower - upper))
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use image::RgbImage;

    use super::*;
    use crate::Symmetry;
    use crate::test_parts::{Block, overhead, paint, table, tilted, view, write_on, written_part};

    const BOX: [Block; 1] = [[[-40.0, -16.0, 0.0], [40.0, 16.0, 12.0]]];
    const REPEATS: Symmetry = Symmetry { shape_order: 2, appearance_order: 1 };

    /// White labels at both long sides, the same when turned; on those of the one side lies a bar, on those of the other it stands.
    fn labels(x: f64, y: f64) -> Option<u8> {
        let across = x.rem_euclid(12.0) - 6.0;
        let along = y.abs() - 9.0;
        if across.abs() > 4.0 || along.abs() > 4.0 || x.abs() > 36.0 {
            return None;
        }
        let (bar, across_bar) = if y > 0.0 { (across, along) } else { (along, across) };
        Some(if bar.abs() < 0.8 && across_bar.abs() < 2.4 { 40 } else { 230 })
    }

    /// The labels at a pose, those of one side in the shade.
    fn frame(camera: &Camera, pose: &Pose) -> RgbImage {
        let mut image = table();
        paint(&mut image, &BOX, camera, pose);
        write_on(&mut image, camera, (pose, 12.0), |x, y| {
            let shade = if y > 0.0 { 0.3 } else { 1.0 };
            labels(x, y).map(|value| (f64::from(value) * shade) as u8)
        });
        image
    }

    #[test]
    fn what_is_written_on_the_same_labels_tells_the_turn() {
        let part = written_part(&BOX, REPEATS, labels);
        let model = EdgeModel::of(&part);
        let lettering = model.lettering.as_ref().unwrap();
        for camera in [overhead(), tilted()] {
            for yaw_rad in [0.2, 1.9, -2.6] {
                let pose = Pose { x_mm: 12.0, y_mm: -7.0, yaw_rad };
                let image = frame(&camera, &pose);
                let gradient = Gradient::of_image(&image);
                let seen = view(&image);
                let turned = |yaw_rad: f64| {
                    let given = Pose { yaw_rad, ..pose };
                    let mut fitter = Fitter::default();
                    lettering.turned(&mut fitter, &model, &part, &camera, (&seen, &gradient), given).unwrap().yaw_rad
                };
                for given in [yaw_rad, yaw_rad + PI] {
                    let off = (turned(given) - yaw_rad + PI).rem_euclid(2.0 * PI) - PI;
                    assert!(off.abs() < 0.02, "{off} rad from {yaw_rad} when given {given}");
                }
            }
        }
    }

    #[test]
    fn a_part_with_nothing_written_on_it_stays_as_it_is() {
        let lettering = |symmetry, shade: fn(f64, f64) -> Option<u8>| {
            let part = written_part(&BOX, symmetry, shade);
            Lettering::of(&part, part.mesh.as_ref().unwrap())
        };
        assert!(lettering(REPEATS, labels).is_some());
        // Nothing at all, labels alone, and parts whose outline tells, or whose picture repeats as often.
        assert_eq!(lettering(REPEATS, |_, _| None), None);
        assert_eq!(lettering(REPEATS, |x, y| labels(x, y).map(|_| 230)), None);
        for (shape_order, appearance_order) in [(1, 1), (2, 2), (0, 1)] {
            assert_eq!(lettering(Symmetry { shape_order, appearance_order }, labels), None);
        }
    }

    #[test]
    fn what_is_not_seen_tells_nothing() {
        let part = written_part(&BOX, REPEATS, labels);
        let (model, camera, image) = (EdgeModel::of(&part), overhead(), table());
        let gradient = Gradient::of_image(&image);
        for x_mm in [0.0, 130.0, 4000.0] {
            let pose = Pose { x_mm, y_mm: 0.0, yaw_rad: 0.4 };
            let lettering = model.lettering.as_ref().unwrap();
            let seen = (&view(&image), &gradient);
            assert_eq!(lettering.turned(&mut Fitter::default(), &model, &part, &camera, seen, pose), None);
        }
    }
}
