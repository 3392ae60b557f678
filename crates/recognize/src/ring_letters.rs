//! Which way a round part is turned: by the lettering on it.
//!
//! In: edges on the level surfaces of the template of a part whose outline is round and whose picture is not. Out: the edges
//! that most turns move to where the template shows none like them, and with them, for a place in a frame, the turn at which
//! the frame shows most of them. Edges have a sign: dark letters on a light ring are no light letters on a dark one.

use std::collections::HashMap;
use std::f64::consts::TAU;

use samsod_camera::Camera;

use crate::catalogue::Part;
use crate::edge_model::EdgePoint;
use crate::gradient::Gradient;
use crate::pose_fit::{Fitter, Pose};

/// Edges that are kept, at most,
const MOST: usize = 240;
/// and at least: fewer tell nothing.
const LEAST: usize = 24;
/// An edge no farther than this is the same, mm: a pixel of most cameras,
const SAME_MM: f32 = 0.6;
/// and of a direction whose cosine with it is no less.
const SAME_COSINE: f32 = 0.6;
/// Turns that are compared.
const TURNS: u32 = 120;
/// The best of them is refined by halves of their distance, so often.
const REFINED: u32 = 3;

/// The edges that tell the turns of a part apart, of those on its level surfaces, given the strongest first; none of a part that
/// is not round or shows the same at every turn.
pub(crate) fn ring_letters(part: &Part, level: &[EdgePoint]) -> Vec<EdgePoint> {
    if part.symmetry.shape_order != 0 || part.symmetry.appearance_order == 0 {
        return Vec::new();
    }
    let cell = |x: f32, y: f32| [(x / SAME_MM).floor() as i32, (y / SAME_MM).floor() as i32];
    let mut near: HashMap<[i32; 2], Vec<&EdgePoint>> = HashMap::new();
    for point in level {
        near.entry(cell(point.position[0], point.position[1])).or_default().push(point);
    }
    let shows = |[x, y]: [f32; 2], [tx, ty]: [f32; 2]| {
        let [column, row] = cell(x, y);
        let around = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| [column + dx, row + dy]));
        around.filter_map(|cell| near.get(&cell)).flatten().any(|p| {
            (p.position[0] - x).hypot(p.position[1] - y) <= SAME_MM
                && p.tangent[0] * tx + p.tangent[1] * ty >= SAME_COSINE
        })
    };
    let tells = |point: &&EdgePoint| {
        let is_elsewhere = |k: &u32| {
            let (sin, cos) = (*k as f32 / TURNS as f32 * TAU as f32).sin_cos();
            let turned = |[x, y, _]: [f32; 3]| [cos * x - sin * y, sin * x + cos * y];
            !shows(turned(point.position), turned(point.tangent))
        };
        2 * (1..TURNS).filter(is_elsewhere).count() > TURNS as usize
    };
    let found: Vec<EdgePoint> = level.iter().filter(tells).copied().collect();
    if found.len() < LEAST {
        return Vec::new();
    }
    // Of too many every so many: the strongest alone would be those of one word.
    let step = (found.len() as f32 / MOST as f32).max(1.0);
    (0..).map(|k| (k as f32 * step) as usize).map_while(|i| found.get(i).copied()).collect()
}

/// The pose, turned to where the frame shows most of some letters, and their share there, in [-1, 1].
pub(crate) fn turned_by_letters(
    fitter: &mut Fitter,
    letters: &[EdgePoint],
    height_mm: f64,
    camera: &Camera,
    gradient: &Gradient,
    pose: Pose,
) -> (Pose, f32) {
    let mut best = (pose, f32::NEG_INFINITY);
    let mut compare = |best: &mut (Pose, f32), yaw_rad: f64| {
        let pose = Pose { yaw_rad, ..pose };
        let share = fitter.signed_share(letters, height_mm, camera, gradient, &pose).unwrap_or_default();
        if share > best.1 {
            *best = (pose, share);
        }
    };
    let step = TAU / f64::from(TURNS);
    for k in 0..TURNS {
        compare(&mut best, pose.yaw_rad + f64::from(k) * step);
    }
    for half in 1..=REFINED {
        let (middle, by) = (best.0.yaw_rad, step / f64::from(1 << half));
        compare(&mut best, middle - by);
        compare(&mut best, middle + by);
    }
    best
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;
    use crate::Symmetry;
    use crate::edge_model::EdgeModel;
    use crate::test_parts::{Block, overhead, paint, table, tilted, write_on, written_part};

    // Its corners do not matter: the letters alone are asked.
    const PLATE: [Block; 1] = [[[-34.0, -34.0, 0.0], [34.0, 34.0, 6.0]]];
    const ROUND: Symmetry = Symmetry { shape_order: 0, appearance_order: 1 };

    /// A dark ring with bright bars on a third of it, as if they were a word.
    fn word(x: f64, y: f64) -> Option<u8> {
        let (radius, angle) = (x.hypot(y), y.atan2(x).to_degrees());
        if !(14.0..26.0).contains(&radius) {
            return None;
        }
        let on_letter = (17.0..23.0).contains(&radius)
            && [10.0, 30.0, 42.0, 61.0, 90.0, 104.0].iter().any(|at| (angle - at).abs() < 4.0);
        Some(if on_letter { 220 } else { 50 })
    }

    #[test]
    fn a_word_on_a_ring_tells_its_turn() {
        let part = written_part(&PLATE, ROUND, word);
        let model = EdgeModel::of(&part);
        for camera in [overhead(), tilted()] {
            for yaw_rad in [0.0, 0.7, 2.5, -1.3] {
                let pose = Pose { x_mm: -8.0, y_mm: 5.0, yaw_rad };
                let mut image = table();
                paint(&mut image, &PLATE, &camera, &pose);
                write_on(&mut image, &camera, (&pose, part.height_mm), word);
                let gradient = Gradient::of_image(&image);
                let given = Pose { yaw_rad: 0.3, ..pose };
                let mut fitter = Fitter::default();
                let (found, share) =
                    turned_by_letters(&mut fitter, &model.letters, part.height_mm, &camera, &gradient, given);
                let off = (found.yaw_rad - yaw_rad + PI).rem_euclid(2.0 * PI) - PI;
                assert!(off.abs() < 0.02 && share > 0.6, "{off} rad from {yaw_rad}, share {share}");
            }
        }
    }

    #[test]
    fn what_every_turn_shows_is_no_letter() {
        let part = written_part(&PLATE, ROUND, word);
        let letters = EdgeModel::of(&part).letters;
        assert!((LEAST..=MOST).contains(&letters.len()), "{}", letters.len());
        // Not the two borders of the ring.
        let is_on_letter = |p: &EdgePoint| (15.5..24.5).contains(&p.position[0].hypot(p.position[1]));
        assert!(letters.iter().all(is_on_letter), "{letters:?}");
        let of = |symmetry, shade: fn(f64, f64) -> Option<u8>| {
            EdgeModel::of(&written_part(&PLATE, symmetry, shade)).letters.len()
        };
        assert_eq!(of(ROUND, |x, y| word(x, y).map(|_| 50)), 0, "a ring without letters");
        assert_eq!(of(Symmetry { shape_order: 1, appearance_order: 1 }, word), 0, "its outline tells");
        assert_eq!(of(Symmetry { shape_order: 0, appearance_order: 0 }, word), 0, "its turn is not asked for");
    }
}
