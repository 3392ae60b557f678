//! The shadow of a part on the table.
//!
//! Lamps and sky are many directions, each with a share of the light. Along each, the part is projected onto the table; a
//! pixel of the table loses the shares of the directions in which the part stands before it. So the shadow of a large lamp is
//! soft, and beside a part, where it hides much of the sky, lies a contact shadow.
//!
//! What is covered is told by the outline of the lit facets alone: along a row, from left to right, each edge of it that is
//! passed leads onto a lit facet or off one. Edges at which two lit facets meet lead from one to the next and are left out.

use samsod_camera::Camera;

use super::render::Placed;
use super::surface::{Facet, dot};
use super::tile::{Area, Tile};

/// Half the side of the square over which a shadow is smoothed, px: the steps of the directions must not show.
const SMOOTH_PX: usize = 2;
/// How much farther than its projections a shadow reaches, px. Smoothing widens it; at the rim of its tile, where pixels
/// have fewer neighbours, there is nothing to smooth.
pub(super) const SHADOW_MARGIN_PX: usize = 2 * SMOOTH_PX;

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
    let area = Area::about(projected.iter().flatten().flatten().copied(), SHADOW_MARGIN_PX, size_px);
    let mut tile = Tile::new(area, 0.0f32);
    let (width, height) = (tile.area.columns.len(), tile.area.rows.len());
    for ((towards, share), on_table) in directions.iter().zip(&projected) {
        let points = on_table.iter().flatten().map(|at| tile.area.local(*at));
        let area = Area::about(points, 1, [width, height]);
        let covered = covered(part, *towards, |i| Some(area.local(tile.area.local(on_table[i]?))), &area);
        for (row, covered) in area.rows.clone().zip(covered.chunks_exact(area.columns.len().max(1))) {
            let values = &mut tile.values[row * width..][area.columns.clone()];
            values
                .iter_mut()
                .zip(covered)
                .filter(|(_, covered)| **covered)
                .for_each(|(value, _)| *value += *share as f32);
        }
    }
    smooth(&mut tile.values, width, height);
    tile.values.iter_mut().for_each(|missed| *missed = missed.min(1.0));
    tile
}

/// Which pixels of an area lie in the shadow of one direction, row by row.
///
/// # Arguments
/// * `on_table` - where the shadow of a vertex falls, from the corner of the area; not every one is before the camera
fn covered(
    part: &Placed<'_>,
    towards: [f64; 3],
    on_table: impl Fn(usize) -> Option<[f64; 2]>,
    area: &Area,
) -> Vec<bool> {
    let (width, height) = (area.columns.len(), area.rows.len());
    // The back of a closed part covers the same as its front.
    let is_lit = |(facet, normal): (&Facet, &[f64; 3])| {
        dot(*normal, towards) > 0.0 && facet.corners.iter().all(|&corner| on_table(corner).is_some())
    };
    let lit: Vec<bool> = part.surface.facets.iter().zip(&part.facet_normals).map(is_lit).collect();
    // How many more facets cover a pixel than the one on its left.
    let mut steps = vec![0i32; width * height];
    for edge in &part.surface.edges {
        let turns: i32 = edge.facets.iter().filter(|(facet, _)| lit[*facet]).map(|(_, sign)| sign).sum();
        if turns == 0 {
            continue;
        }
        let [Some(a), Some(b)] = edge.ends.map(&on_table) else { continue };
        let (upper, lower, turns) = if a[1] < b[1] { (a, b, turns) } else { (b, a, -turns) };
        let slope = (lower[0] - upper[0]) / (lower[1] - upper[1]);
        // The end of one edge is the start of the next: the lower end is not of it.
        let rows = upper[1].ceil().max(0.0) as usize..lower[1].ceil().clamp(0.0, height as f64) as usize;
        for row in rows {
            let column = (upper[0] + (row as f64 - upper[1]) * slope).ceil().max(0.0) as usize;
            if column < width {
                steps[row * width + column] += turns;
            }
        }
    }
    let mut covered = Vec::with_capacity(steps.len());
    for row in steps.chunks_exact(width.max(1)) {
        let mut count = 0;
        covered.extend(row.iter().map(|step| {
            count += step;
            count != 0
        }));
    }
    covered
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
    use std::path::Path;

    use samsod::recognize::Part;

    use super::super::raster::fill;
    use super::super::surface::Surface;
    use super::*;
    use crate::place::PlanePose;

    /// Against every lit facet filled: slow and plain.
    #[test]
    fn outlines_cover_what_the_lit_facets_cover() {
        for name in ["u_channel", "flange", "star_knob"] {
            let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/parts").join(name);
            let surface = Surface::of(&Part::read(&folder).unwrap()).unwrap();
            let pose = PlanePose { x_mm: 3.0, y_mm: -5.0, z_mm: 0.0, yaw_deg: 31.0 };
            let part = Placed::new(&surface, &pose);
            for towards in [[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [-0.48, 0.64, 0.6]] {
                // A table at 2 px/mm; the shadow is cut at the left of the area.
                let on_table = |i: usize| {
                    let [x, y, z] = part.world[i];
                    let along = z / towards[2];
                    Some([60.0 + 2.0 * (x - towards[0] * along), 150.0 - 2.0 * (y - towards[1] * along)])
                };
                let (width, height) = (260, 300);
                let mut filled = vec![false; width * height];
                for (facet, normal) in surface.facets.iter().zip(&part.facet_normals) {
                    if dot(*normal, towards) > 0.0 {
                        fill(facet.corners.map(|i| on_table(i).unwrap()), width, height, |at, _| filled[at] = true);
                    }
                }
                let covered = covered(&part, towards, on_table, &Area { columns: 0..width, rows: 0..height });
                let count = filled.iter().filter(|filled| **filled).count();
                assert!(count > 2_000 && count < width * height, "{name}: {count} px");
                // A pixel on an edge is of either.
                let differ = filled.iter().zip(&covered).filter(|(a, b)| a != b).count();
                assert!(differ <= 8, "{name}, {towards:?}: {differ} of {count} px differ");
            }
        }
    }

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
