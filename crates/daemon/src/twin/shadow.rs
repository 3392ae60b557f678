//! The shadow of a part on the table.
//!
//! Lamps and sky are many directions, each with a share of the light. Along each, the part is projected onto the table; a
//! pixel of the table loses the shares of the directions in which the part stands before it. So the shadow of a large lamp is
//! soft, and beside a part, where it hides much of the sky, lies a contact shadow.

use samsod_camera::Camera;

use super::raster::fill;
use super::render::Placed;
use super::surface::dot;
use super::tile::{Area, Tile};

/// Half the side of the square over which a shadow is smoothed, px: the steps of the directions must not show.
const SMOOTH_PX: usize = 2;

/// Share of the light that each pixel of the table misses, in [0, 1]; none is missed beside the tile.
///
/// # Arguments
/// * `directions` - towards the light, unit vectors of the world with z above 0, and their shares
pub(super) fn shadow(camera: &Camera, part: &Placed<'_>, directions: &[([f64; 3], f64)]) -> Tile<f32> {
    let on_table = |&([dx, dy, dz], _): &([f64; 3], f64)| -> Vec<Option<[f64; 2]>> {
        let project = |&[x, y, z]: &[f64; 3]| camera.image_from_world([x - dx * z / dz, y - dy * z / dz, 0.0]).ok();
        part.world.iter().map(project).collect()
    };
    let projected: Vec<_> = directions.iter().map(on_table).collect();
    let size_px = camera.intrinsics().size_px().map(|side| side as usize);
    // Smoothing widens it, and at the rim, where it has fewer neighbours, there is nothing to smooth.
    let area = Area::about(projected.iter().flatten().flatten().copied(), 2 * SMOOTH_PX, size_px);
    let mut tile = Tile::new(area, 0.0f32);
    let (width, height) = (tile.area.columns.len(), tile.area.rows.len());
    // Which direction has covered a pixel last: two facets before one lamp hide it once.
    let mut last = vec![0u32; tile.values.len()];
    for ((number, (towards, share)), on_table) in (1u32..).zip(directions).zip(&projected) {
        for (facet, normal) in part.surface.facets.iter().zip(&part.facet_normals) {
            // The back of a closed part covers the same as its front.
            if dot(*normal, *towards) <= 0.0 {
                continue;
            }
            let [Some(a), Some(b), Some(c)] = facet.corners.map(|i| on_table[i]) else { continue };
            fill([a, b, c].map(|at| tile.area.local(at)), width, height, |index, _| {
                if last[index] != number {
                    last[index] = number;
                    tile.values[index] += *share as f32;
                }
            });
        }
    }
    smooth(&mut tile.values, width, height);
    tile.values.iter_mut().for_each(|missed| *missed = missed.min(1.0));
    tile
}

/// Means over squares, along rows and then along columns.
fn smooth(values: &mut [f32], width: usize, height: usize) {
    let near = |i: usize, length: usize| i.saturating_sub(SMOOTH_PX)..(i + SMOOTH_PX + 1).min(length);
    let mut along_rows = vec![0.0; values.len()];
    for (from, to) in values.chunks_exact(width.max(1)).zip(along_rows.chunks_exact_mut(width.max(1))) {
        for (i, mean) in to.iter_mut().enumerate() {
            let near = &from[near(i, width)];
            *mean = near.iter().sum::<f32>() / near.len() as f32;
        }
    }
    for (y, to) in values.chunks_exact_mut(width.max(1)).enumerate() {
        let rows = near(y, height);
        let share = 1.0 / rows.len() as f32;
        to.fill(0.0);
        for row in rows {
            let from = &along_rows[row * width..][..width];
            to.iter_mut().zip(from).for_each(|(sum, value)| *sum += value);
        }
        to.iter_mut().for_each(|sum| *sum *= share);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn smoothing_spreads_a_pixel_over_its_square_and_keeps_the_sum() {
        let (width, height) = (12, 9);
        let mut values = vec![0.0; width * height];
        values[4 * width + 6] = 1.0;
        smooth(&mut values, width, height);
        for (index, value) in values.iter().enumerate() {
            let is_near = (index % width).abs_diff(6) <= SMOOTH_PX && (index / width).abs_diff(4) <= SMOOTH_PX;
            assert!((value - if is_near { 1.0 / 25.0 } else { 0.0 }).abs() < 1e-6, "{index}: {value}");
        }
        // At a border, the mean is that of fewer: what is even stays so.
        let mut even = vec![0.5; width * height];
        smooth(&mut even, width, height);
        assert!(even.iter().all(|value| (value - 0.5).abs() < 1e-6));
    }
}
