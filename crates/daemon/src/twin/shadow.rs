//! Shadows of parts on the table.
//!
//! Lamps and sky are many directions, each with a share of the light. Along each, every part is projected onto the table; a
//! pixel of the table loses the shares of the directions in which a part stands before it. So the shadow of a large lamp is
//! soft, and beside a part, where it hides much of the sky, lies a contact shadow.

use samsod_camera::Camera;

use super::raster::fill;
use super::render::Placed;
use super::surface::dot;

/// Half the side of the square over which a shadow is smoothed, px: the steps of the directions must not show.
const SMOOTH_PX: usize = 2;

/// Share of the light that each pixel of the table misses, row by row, in [0, 1].
///
/// # Arguments
/// * `directions` - towards the light, unit vectors of the world with z above 0, and their shares
pub(super) fn covered(camera: &Camera, parts: &[Placed<'_>], directions: &[([f64; 3], f64)]) -> Vec<f32> {
    let [width, height] = camera.intrinsics().size_px().map(|side| side as usize);
    let mut covered = vec![0.0f32; width * height];
    // Which direction has covered a pixel last: two parts before one lamp hide it once.
    let mut last = vec![0u32; width * height];
    for (number, (towards, share)) in (1u32..).zip(directions) {
        for part in parts {
            let on_table: Vec<Option<[f64; 2]>> = part
                .world
                .iter()
                .map(|&[x, y, z]| {
                    let along = z / towards[2];
                    camera.image_from_world([x - towards[0] * along, y - towards[1] * along, 0.0]).ok()
                })
                .collect();
            for (facet, normal) in part.surface.facets.iter().zip(&part.facet_normals) {
                // The back of a closed part covers the same as its front.
                if dot(*normal, *towards) <= 0.0 {
                    continue;
                }
                let [Some(a), Some(b), Some(c)] = facet.corners.map(|i| on_table[i]) else { continue };
                fill([a, b, c], width, height, |index, _| {
                    if last[index] != number {
                        last[index] = number;
                        covered[index] += *share as f32;
                    }
                });
            }
        }
    }
    smooth(&mut covered, width, height);
    covered
}

/// Means over squares, along rows and then along columns.
fn smooth(values: &mut [f32], width: usize, height: usize) {
    let mut line = Vec::new();
    let mut along = |start: usize, step: usize, length: usize| {
        line.clear();
        line.extend((0..length).map(|i| values[start + i * step]));
        if line.iter().all(|value| *value == 0.0) {
            return;
        }
        for i in 0..length {
            let near = &line[i.saturating_sub(SMOOTH_PX)..(i + SMOOTH_PX + 1).min(length)];
            values[start + i * step] = near.iter().sum::<f32>() / near.len() as f32;
        }
    };
    (0..height).for_each(|y| along(y * width, 1, width));
    (0..width).for_each(|x| along(x, width, height));
}
