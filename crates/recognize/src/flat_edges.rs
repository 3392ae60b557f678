//! The edges of a part without a mesh: those of its template, on the plane of its height.

use crate::catalogue::Part;
use crate::edge_model::{EdgePoint, SURFACE_POINTS, ViewEdges};
use crate::gradient::Gradient;

/// Points of the outline, and inside of it, that are kept.
const OUTLINE_POINTS: usize = 140;
const INNER_POINTS: usize = 100;
/// An edge inside has this share of the strongest gradient there, or more.
const INNER_SHARE: f32 = 0.25;

/// The outline of the mask, and the strong edges of the picture inside of it.
pub(crate) fn flat_edges(part: &Part) -> ViewEdges {
    let template = &part.template;
    let (width, height) = template.mask.dimensions();
    let inside = |x: i64, y: i64| {
        let within = (0..i64::from(width)).contains(&x) && (0..i64::from(height)).contains(&y);
        within && template.mask.get_pixel(x as u32, y as u32).0[0] > 127
    };
    let gradient = Gradient::of_image(&template.image);
    let (mut outline, mut inner) = (Vec::new(), Vec::new());
    let mut pixels = 0usize;
    for y in 0..i64::from(height) {
        for x in 0..i64::from(width) {
            if !inside(x, y) {
                continue;
            }
            pixels += 1;
            let beside = [(1, 0), (-1, 0), (0, 1), (0, -1)].map(|(dx, dy)| inside(x + dx, y + dy));
            if beside.contains(&false) {
                // Across the border of a mask smoothed over 5 x 5 pixels.
                let (mut nx, mut ny) = (0.0f32, 0.0f32);
                for dy in -2..=2 {
                    for dx in -2..=2 {
                        if inside(x + dx, y + dy) {
                            nx -= dx as f32;
                            ny -= dy as f32;
                        }
                    }
                }
                let norm = nx.hypot(ny);
                if norm > 0.0 {
                    // The border lies half a pixel outside of the centres of its pixels.
                    let at = [x as f32 + 0.5 * nx / norm, y as f32 + 0.5 * ny / norm];
                    outline.push((at, [nx / norm, ny / norm]));
                }
            } else if let Some(normal) = gradient.ridge(x as usize, y as usize) {
                let deep = [(3, 0), (-3, 0), (0, 3), (0, -3)].iter().all(|&(dx, dy)| inside(x + dx, y + dy));
                if deep {
                    inner.push((normal.2, [x as f32, y as f32], [normal.0, normal.1]));
                }
            }
        }
    }
    let strongest = inner.iter().map(|point| point.0).fold(0.0, f32::max);
    inner.retain(|point| point.0 >= INNER_SHARE * strongest);
    let inner: Vec<_> = inner.into_iter().map(|(_, at, normal)| (at, normal)).collect();
    let mut points = Vec::new();
    for (all, count, is_outline) in [(outline, OUTLINE_POINTS, true), (inner, INNER_POINTS, false)] {
        let step = (all.len() as f32 / count as f32).max(1.0);
        // Every so many in the order of rows is even enough on a plane.
        let kept = (0..).map(|k| (k as f32 * step) as usize).take_while(|&i| i < all.len()).map(|i| all[i]);
        points.extend(kept.filter_map(|(at, normal)| lift(part, at, normal, is_outline)));
    }
    let px_per_mm = match (part_from_template(part, [0.0, 0.0]), part_from_template(part, [0.0, 1.0])) {
        (Some(a), Some(b)) => 1.0 / (a[0] - b[0]).hypot(a[1] - b[1]).max(1e-9),
        _ => 1.0,
    };
    let area_mm2 = pixels as f32 / (px_per_mm * px_per_mm) as f32;
    let step = ((pixels as f32 / SURFACE_POINTS).sqrt() as usize).max(1);
    let surface = (0..i64::from(height)).step_by(step).flat_map(|y| {
        (0..i64::from(width)).step_by(step).filter(move |&x| inside(x, y)).filter_map(move |x| {
            let [px, py] = part_from_template(part, [x as f64, y as f64])?;
            Some([px as f32, py as f32, part.height_mm as f32])
        })
    });
    // All of it lies on one plane, so where the camera is does not matter.
    ViewEdges::new(points, surface.collect(), area_mm2, [0.0, 0.0, 1.0], part.height_mm as f32)
}

fn lift(part: &Part, at: [f32; 2], normal: [f32; 2], outline: bool) -> Option<EdgePoint> {
    let [x, y] = part_from_template(part, at.map(f64::from))?;
    let beside = [f64::from(at[0] - normal[1]), f64::from(at[1] + normal[0])];
    let [bx, by] = part_from_template(part, beside)?;
    let length = (bx - x).hypot(by - y);
    (length > 0.0).then(|| EdgePoint {
        position: [x as f32, y as f32, part.height_mm as f32],
        tangent: [((bx - x) / length) as f32, ((by - y) / length) as f32, 0.0],
        outline,
        // Holes of a flat template are few, and its outline is the longest of all.
        outer: outline,
    })
}

/// A pixel of the template on the plane of the part's height, in the axes of the part, mm.
pub(crate) fn part_from_template(part: &Part, [u, v]: [f64; 2]) -> Option<[f64; 2]> {
    let template = &part.template;
    let frame = [u + f64::from(template.crop_px[0]), v + f64::from(template.crop_px[1])];
    let [x, y, _] = template.camera.world_from_image(frame, part.height_mm).ok()?;
    let (dx, dy) = (x - template.origin_mm[0], y - template.origin_mm[1]);
    let (sin, cos) = template.yaw_rad.sin_cos();
    Some([cos * dx + sin * dy, cos * dy - sin * dx])
}

/// The pixel of the template that shows a point of the plane of the part's height, given in the axes of the part, mm.
pub(crate) fn template_from_part(part: &Part, [x, y]: [f64; 2]) -> Option<[f64; 2]> {
    let template = &part.template;
    let (sin, cos) = template.yaw_rad.sin_cos();
    let world = [template.origin_mm[0] + cos * x - sin * y, template.origin_mm[1] + sin * x + cos * y, part.height_mm];
    let [u, v] = template.camera.image_from_world(world).ok()?;
    Some([u - f64::from(template.crop_px[0]), v - f64::from(template.crop_px[1])])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::edge_model::EdgeModel;
    use crate::test_parts::{Block, part};

    const BAR: [Block; 1] = [[[-30.0, -15.0, 0.0], [30.0, 15.0, 10.0]]];

    #[test]
    fn a_part_without_a_mesh_has_the_outline_of_its_mask_on_the_plane_of_its_height() {
        let part = part("bar", &BAR, false);
        let view = flat_edges(&part);
        let outline: Vec<&EdgePoint> = view.points.iter().filter(|p| p.outline).collect();
        assert!(outline.len() > 100, "{}", outline.len());
        let mut sides = [0; 4];
        for p in outline {
            let [x, y, z] = p.position;
            assert_eq!(z, 10.0);
            // The border of a mask is known to half a pixel, 0.3 mm.
            let off = [x + 30.0, x - 30.0, y + 15.0, y - 15.0].map(f32::abs);
            let side = (0..4).min_by(|&a, &b| off[a].total_cmp(&off[b])).unwrap();
            assert!(off[side] < 0.4 && x.abs() < 30.4 && y.abs() < 15.4, "{p:?}");
            sides[side] += 1;
            if x.abs() < 28.0 && y.abs() < 13.0 {
                assert!(p.tangent[usize::from(side < 2)].abs() > 0.99, "{p:?}");
            }
        }
        assert!(sides[..2].iter().all(|n| *n > 15) && sides[2..].iter().all(|n| *n > 30), "{sides:?}");
        assert!((view.area_mm2 - 1800.0).abs() < 36.0, "{}", view.area_mm2);
        // One view serves for all directions.
        let model = EdgeModel::of(&part);
        assert_eq!(model.view([0.3, 0.2, 1.0]), &view);
        assert_eq!(model.view([0.0, 0.0, 1.0]), &view);
    }

    #[test]
    fn a_mark_on_a_flat_part_is_inside() {
        let mut part = part("bar", &BAR, false);
        // A black square of 16 px about the origin: 10 mm, at a height of 10 mm 9.8.
        let [u, v] = template_from_part(&part, [0.0, 0.0]).unwrap().map(|c| c.round() as u32);
        for (dx, dy) in (0..16).flat_map(|y| (0..16).map(move |x| (x, y))) {
            part.template.image.put_pixel(u - 8 + dx, v - 8 + dy, image::Rgb([0; 3]));
        }
        let view = flat_edges(&part);
        let inner: Vec<&EdgePoint> = view.points.iter().filter(|p| !p.outline).collect();
        assert!(inner.len() > 30, "{}", inner.len());
        for p in inner {
            let [x, y, _] = p.position;
            assert!((x.abs().max(y.abs()) - 4.9).abs() < 1.2 && !p.outer, "{p:?}");
        }
    }

    #[test]
    fn pixels_of_the_template_come_back() {
        let mut part = part("bar", &BAR, false);
        (part.template.origin_mm, part.template.yaw_rad) = ([12.0, -7.0], 2.3);
        for pixel in [[0.0, 0.0], [90.0, 80.0], [33.3, 120.7]] {
            let at = part_from_template(&part, pixel).unwrap();
            let back = template_from_part(&part, at).unwrap();
            assert!((back[0] - pixel[0]).hypot(back[1] - pixel[1]) < 1e-6, "{back:?} for {pixel:?}");
        }
    }
}
