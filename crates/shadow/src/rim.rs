//! The rim of a region: where it meets the table, how sharply, and in which direction.
//!
//! A part ends at an edge; the shadow of a lamp that is no point ends in a penumbra. And the shadows of one scene lie on
//! the same side of their parts, so the direction in which the rim faces says something too.

use samsod_segment::BoundingBox;

use crate::crop::{Crop, OWN};
use crate::separator::Input;

/// Directions that are told apart.
pub(crate) const DIRECTIONS: usize = 16;

/// Samples along the normal reach so far into the region, px.
const INSIDE_PX: i32 = 8;
/// And so far out of it.
const OUTSIDE_PX: i32 = 6;
const SAMPLES: usize = (INSIDE_PX + OUTSIDE_PX + 1) as usize;
/// Half the side of the window that gives the normal, px.
const WINDOW_PX: usize = 5;
/// A row of it is read with what follows: so many pixels at a time are compared.
const LANES: usize = 16;

/// A place on the rim.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RimPoint {
    /// Pixel of the crop just inside of the steepest step.
    pub(crate) inside: u32,
    /// Which way the rim faces: sector of the outward normal, counter-clockwise on the screen from image right.
    pub(crate) direction: u8,
    /// Share of the whole difference across the rim that lies within two pixels, in [0, 1].
    pub(crate) sharpness: f32,
    /// The whole difference across the rim, sRGB levels of the channel where it is largest.
    pub(crate) contrast: f32,
}

/// Scratch memory of [`find_rim`].
#[derive(Debug, Default)]
pub(crate) struct RimScratch {
    /// 1 outside of the region, row by row.
    outer: Vec<u8>,
    stack: Vec<u32>,
}

/// Finds the places where the region meets what lies outside of it (holes are not rim).
pub(crate) fn find_rim(input: &Input<'_>, crop: &Crop, scratch: &mut RimScratch, rim: &mut Vec<RimPoint>) {
    let RimScratch { outer, stack } = scratch;
    rim.clear();
    let Some(bbox) = crop.bbox else { return };
    let (width, height) = (bbox.width as usize, bbox.height as usize);
    flood_outside(crop, width, height, outer, stack);
    for y in 0..height {
        // Every other pixel, as on a chessboard: neighbours on the rim see nearly the same.
        for x in (y % 2..width).step_by(2) {
            let i = y * width + x;
            let meets_outside = crop.owners()[i] == OWN
                && ((x > 0 && outer[i - 1] == 1)
                    || (x + 1 < width && outer[i + 1] == 1)
                    || (y > 0 && outer[i - width] == 1)
                    || (y + 1 < height && outer[i + width] == 1));
            if meets_outside && let Some(normal) = normal(outer, width, height, x, y) {
                rim.extend(sample(input, bbox, x as f32, y as f32, normal));
            }
        }
    }
}

/// Marks with 1 the pixels that are not the region's and are joined to the border of the crop, and adds [`LANES`] pixels
/// that are not, so that a window at the end can be read whole.
fn flood_outside(crop: &Crop, width: usize, height: usize, outer: &mut Vec<u8>, stack: &mut Vec<u32>) {
    /// Neither the region nor known to be outside of it.
    const OPEN: u8 = 2;
    outer.clear();
    outer.extend(crop.owners().iter().map(|&owner| if owner == OWN { 0 } else { OPEN }));
    let pixels = outer.len();
    stack.clear();
    let mut start = |i: usize| {
        if outer[i] == OPEN {
            stack.push(i as u32);
        }
    };
    (0..width).for_each(|x| [x, (height - 1) * width + x].into_iter().for_each(&mut start));
    (0..height).for_each(|y| [y * width, y * width + width - 1].into_iter().for_each(&mut start));
    // A pixel may be on the stack twice; the second time it is marked already.
    while let Some(i) = stack.pop() {
        let i = i as usize;
        if outer[i] != OPEN {
            continue;
        }
        let row = i - i % width;
        let before = outer[row..i].iter().rev().take_while(|&&o| o == OPEN).count();
        let after = outer[i..row + width].iter().take_while(|&&o| o == OPEN).count();
        let (first, end) = (i - before, i + after);
        outer[first..end].fill(1);
        // Of every stretch above and below that is open the first pixel.
        for next in [first.checked_sub(width), Some(first + width).filter(|&n| n < pixels)].into_iter().flatten() {
            let mut was_open = false;
            for (n, &o) in (next..).zip(&outer[next..next + end - first]) {
                if o == OPEN && !was_open {
                    stack.push(n as u32);
                }
                was_open = o == OPEN;
            }
        }
    }
    outer.resize(pixels + LANES, 0);
}

/// Unit vector out of the region: from the centre of a window to the centre of what is outside in it.
fn normal(outer: &[u8], width: usize, height: usize, x: usize, y: usize) -> Option<[f32; 2]> {
    let inside = |at: usize, end: usize| at >= WINDOW_PX && at + WINDOW_PX < end;
    let [nx, ny] = if inside(x, width) && inside(y, height) {
        whole_window(outer, width, x - WINDOW_PX, y - WINDOW_PX)
    } else {
        window_at_border(outer, width, height, x as i32, y as i32)
    };
    let length = f64::from(nx * nx + ny * ny).sqrt() as f32;
    (length > 0.0).then(|| [nx as f32 / length, ny as f32 / length])
}

/// Sums of the offsets of what is outside less those of what is not, in the window that begins at (left, top).
fn whole_window(outer: &[u8], width: usize, left: usize, top: usize) -> [i32; 2] {
    // Offsets of a whole window add up to nothing: those outside stand for both. Columns are summed side by side; the
    // last ones lie beyond the window.
    let (mut counts, mut moments) = ([0i8; LANES], [0i8; LANES]);
    for (dy, row) in (-(WINDOW_PX as i8)..=WINDOW_PX as i8).zip(top..) {
        let at = row * width + left;
        if let Some(lanes) = outer.get(at..).and_then(|row| row.first_chunk::<LANES>()) {
            for ((count, moment), &o) in counts.iter_mut().zip(&mut moments).zip(lanes) {
                let outside = i8::from(o == 1);
                *count += outside;
                *moment += outside * dy;
            }
        }
    }
    let columns = counts[..=2 * WINDOW_PX].iter().zip(&moments);
    columns
        .zip(-(WINDOW_PX as i32)..)
        .fold([0, 0], |[nx, ny], ((&count, &moment), dx)| [nx + 2 * dx * i32::from(count), ny + 2 * i32::from(moment)])
}

/// As [`whole_window`], round (x, y), where the crop ends in the window.
fn window_at_border(outer: &[u8], width: usize, height: usize, x: i32, y: i32) -> [i32; 2] {
    let (mut nx, mut ny) = (0i32, 0i32);
    let window = WINDOW_PX as i32;
    for dy in -window..=window {
        for dx in -window..=window {
            let (px, py) = (x + dx, y + dy);
            // Beyond the image nothing is known.
            if px >= 0 && py >= 0 && px < width as i32 && py < height as i32 {
                let outside = i32::from(outer[py as usize * width + px as usize] == 1);
                nx += (2 * outside - 1) * dx;
                ny += (2 * outside - 1) * dy;
            }
        }
    }
    [nx, ny]
}

fn sample(input: &Input<'_>, bbox: BoundingBox, x: f32, y: f32, normal: [f32; 2]) -> Option<RimPoint> {
    let (x_image, y_image) = (x + bbox.x as f32, y + bbox.y as f32);
    let (mut low, mut high) = ([f32::MAX; 4], [0.0f32; 4]);
    let profile: [[f32; 4]; SAMPLES] = std::array::from_fn(|k| {
        let t = k as f32 - INSIDE_PX as f32;
        let color = pixel_between(input, x_image + t * normal[0], y_image + t * normal[1]);
        low = std::array::from_fn(|c| low[c].min(color[c]));
        high = std::array::from_fn(|c| high[c].max(color[c]));
        color
    });
    let largest = |a: [f32; 4], b: [f32; 4]| {
        let apart: [f32; 4] = std::array::from_fn(|c| (a[c] - b[c]).abs());
        apart[0].max(apart[1]).max(apart[2])
    };
    let contrast = largest(high, low);
    let (mut steepest, mut step) = (0, 0.0);
    for k in 0..SAMPLES - 2 {
        let here = largest(profile[k + 2], profile[k]);
        if here > step {
            (steepest, step) = (k, here);
        }
    }
    // The step lies round sample k + 1; two and a half pixels further in the blur of the lens has ended.
    let t = steepest as f32 - INSIDE_PX as f32 - 2.0;
    let (px, py) = ((x + t * normal[0]).round(), (y + t * normal[1]).round());
    let within = px >= 0.0 && py >= 0.0 && px < bbox.width as f32 && py < bbox.height as f32;
    let angle = (-normal[1]).atan2(normal[0]) / std::f32::consts::TAU;
    within.then(|| RimPoint {
        inside: py as u32 * bbox.width + px as u32,
        direction: ((angle * DIRECTIONS as f32).round() as i32).rem_euclid(DIRECTIONS as i32) as u8,
        sharpness: step / contrast.max(1e-3),
        contrast,
    })
}

/// Colour between pixel centres, sRGB levels, beyond the image that of its border; and a fourth value without a meaning,
/// since four are worked out as fast as three.
#[inline(always)]
fn pixel_between(input: &Input<'_>, x: f32, y: f32) -> [f32; 4] {
    let (width, height) = (input.partition.width() as usize, input.partition.height() as usize);
    let (x, y) = (x.clamp(0.0, (width - 1) as f32), y.clamp(0.0, (height - 1) as f32));
    let (x0, y0) = (x as u32 as usize, y as u32 as usize);
    let (x1, y1) = ((x0 + 1).min(width - 1), (y0 + 1).min(height - 1));
    let (fx, fy) = (x - x0 as f32, y - y0 as f32);
    let bytes = input.frame.as_raw();
    let at = |x: usize, y: usize| {
        let start = 3 * (y * width + x);
        match bytes.get(start..start + 4) {
            Some(&[r, g, b, next]) => [r, g, b, next].map(f32::from),
            // The last pixel of the image.
            _ => [bytes[start], bytes[start + 1], bytes[start + 2], 0].map(f32::from),
        }
    };
    let (a, b, c, d) = (at(x0, y0), at(x1, y0), at(x0, y1), at(x1, y1));
    std::array::from_fn(|k| {
        let above = a[k] + (b[k] - a[k]) * fx;
        let below = c[k] + (d[k] - c[k]) * fx;
        above + (below - above) * fy
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::separator::tests::Scene;

    /// The rim of the first region, and where its points lie in the image.
    fn rim(scene: &Scene) -> Vec<(RimPoint, [f32; 2])> {
        scene.show(|input, crops| {
            let mut scratch = RimScratch { outer: vec![7; 3], stack: vec![9] };
            let mut rim = Vec::new();
            find_rim(input, &crops[0], &mut scratch, &mut rim);
            let bbox = crops[0].bbox.unwrap();
            let place = |i: u32| [(bbox.x + i % bbox.width) as f32, (bbox.y + i / bbox.width) as f32];
            rim.into_iter().map(|point| (point, place(point.inside))).collect()
        })
    }

    fn distance(x: u32, y: u32, center: [f32; 2]) -> f32 {
        (x as f32 - center[0]).hypot(y as f32 - center[1])
    }

    /// A dark disc on a bright table, whose edge is `blur` px wide.
    fn disc(size: [u32; 2], center: [f32; 2], radius: f32, blur: f32) -> Scene {
        let share = move |x, y| ((radius - distance(x, y, center)) / blur + 0.5).clamp(0.0, 1.0);
        let color = |x, y| [220.0, 180.0, 160.0].map(|table: f32| (table - 120.0 * share(x, y)) as u8);
        Scene::new(size, color, |x, y| u32::from(share(x, y) > 0.5), &[&[1]])
    }

    #[test]
    fn a_penumbra_is_told_from_an_edge() {
        let (sharp, soft) = (rim(&disc([90, 90], [44.0; 2], 25.0, 1.5)), rim(&disc([90, 90], [44.0; 2], 25.0, 9.0)));
        assert!(sharp.len() > 40 && soft.len() > 40, "{} and {} points", sharp.len(), soft.len());
        for (point, _) in &sharp {
            assert!(point.sharpness > 0.8 && point.sharpness <= 1.0, "{point:?}");
            assert!((point.contrast - 120.0).abs() < 2.0, "{point:?}");
        }
        for (point, _) in &soft {
            assert!(point.sharpness > 0.1 && point.sharpness < 0.35, "{point:?}");
        }
    }

    #[test]
    fn points_know_which_way_they_face_and_lie_within() {
        let center = [44.0, 50.0];
        let points = rim(&disc([95, 100], center, 30.0, 1.5));
        let mut seen = [0; DIRECTIONS];
        for (point, [x, y]) in points {
            // Counter-clockwise on the screen, where y grows downwards.
            let angle = (center[1] - y).atan2(x - center[0]).to_degrees();
            let turn = (angle - 22.5 * f32::from(point.direction) + 540.0).rem_euclid(360.0) - 180.0;
            assert!(turn.abs() < 11.25 + 6.0, "{turn} degrees off at ({x}, {y})");
            let inside = 30.0 - (x - center[0]).hypot(y - center[1]);
            assert!(inside > 0.5 && inside < 4.5, "{inside} px from the edge");
            seen[point.direction as usize] += 1;
        }
        assert!(seen.iter().all(|&n| n > 1), "{seen:?}");
    }

    #[test]
    fn up_is_a_quarter_turn_from_right() {
        let color = |x: u32, y: u32| if (30..70).contains(&x) && (20..50).contains(&y) { [40; 3] } else { [200; 3] };
        let label = |x, y| u32::from(color(x, y) == [40; 3]);
        let points = rim(&Scene::new([100, 70], color, label, &[&[1]]));
        let facing = |x: std::ops::Range<f32>, y: std::ops::Range<f32>| {
            let near = points.iter().filter(|(_, at)| x.contains(&at[0]) && y.contains(&at[1]));
            near.map(|(point, _)| point.direction).collect::<std::collections::BTreeSet<u8>>()
        };
        assert_eq!(facing(40.0..60.0, 20.0..25.0), [4].into());
        assert_eq!(facing(40.0..60.0, 45.0..50.0), [12].into());
        assert_eq!(facing(65.0..70.0, 30.0..40.0), [0].into());
        assert_eq!(facing(30.0..35.0, 30.0..40.0), [8].into());
    }

    #[test]
    fn holes_have_no_rim() {
        let center = [50.0; 2];
        let color = |x, y| if (14.0..34.0).contains(&distance(x, y, center)) { [40; 3] } else { [200; 3] };
        let label = |x, y| u32::from(color(x, y) == [40; 3]);
        let points = rim(&Scene::new([100, 100], color, label, &[&[1]]));
        assert!(points.len() > 40);
        for (_, [x, y]) in points {
            assert!((x - 50.0).hypot(y - 50.0) > 28.0, "a rim at ({x}, {y})");
        }
    }

    #[test]
    fn the_border_of_the_image_is_no_rim() {
        // Half a disc at the left border.
        let points = rim(&disc([70, 90], [0.0, 44.0], 30.0, 1.5));
        assert!(points.len() > 15, "{}", points.len());
        for (point, [x, y]) in points {
            assert!((x - 0.0).hypot(y - 44.0) > 25.0, "a rim at ({x}, {y})");
            assert!(!(6..=10).contains(&point.direction), "facing left at ({x}, {y}): {point:?}");
        }
        for size in [[1, 1], [1, 9], [9, 1], [2, 2], [40, 30]] {
            let whole = Scene::new(size, |x, _| [x as u8; 3], |_, _| 0, &[&[0]]);
            assert!(rim(&whole).is_empty(), "a region as large as the frame, {size:?}");
        }
    }

    #[test]
    fn thin_regions_and_flat_frames_have_rims_of_numbers() {
        for size in [[2, 1], [3, 3], [1, 20], [20, 1], [30, 30]] {
            for color in [[0; 3], [255; 3]] {
                let scene = Scene::new(size, |_, _| color, |x, y| u32::from((x, y) == (0, 0)), &[&[1], &[0]]);
                for (point, _) in rim(&scene) {
                    assert_eq!((point.sharpness, point.contrast), (0.0, 0.0));
                    assert!(usize::from(point.direction) < DIRECTIONS);
                }
            }
        }
    }
}
