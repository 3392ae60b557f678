//! The pixels of a part at a pose.

use samsod_camera::Camera;
use samsod_segment::BoundingBox;
use samsod_shadow::{Mask, MaskRun};

use crate::catalogue::Part;
use crate::edge_lanes::{LANES, Wide};
use crate::edge_model::fill_triangle;
use crate::flat_edges::{part_from_template, template_from_part};
use crate::mesh::{Faces, Side};
use crate::pose_fit::{Pose, Projector};

/// Pixels of a part in a rectangle of the frame, or of the frame reduced.
#[derive(Debug, Clone)]
pub(crate) struct Silhouette {
    /// In units of `step` pixels.
    pub(crate) bbox: BoundingBox,
    /// 1: every column and row of the frame has a bit; n: every n-th.
    pub(crate) step: u32,
    /// 1 on the part, row by row.
    pub(crate) bits: Vec<u8>,
}

impl Default for Silhouette {
    fn default() -> Self {
        Self { bbox: BoundingBox { x: 0, y: 0, width: 0, height: 0 }, step: 1, bits: Vec::new() }
    }
}

impl Silhouette {
    /// Every `step`-th column and row of a part; `None` when it lies outside of the frame, or does not fit the memory of one.
    pub(crate) fn of(part: &Part, camera: &Camera, pose: &Pose, step: u32) -> Option<Self> {
        let mut silhouette = Self { step: step.max(1), ..Self::default() };
        silhouette.paint(part, camera, pose)?;
        Some(silhouette)
    }

    fn paint(&mut self, part: &Part, camera: &Camera, pose: &Pose) -> Option<()> {
        let scale = 1.0 / self.step as f32;
        match &part.mesh {
            Some(mesh) => {
                // Where not every pixel counts, not every triangle does.
                let faces = if self.step > 1 { mesh.coarse() } else { mesh.fine() };
                let corners = seen(faces.vertices, &Projector::new(camera, pose), scale)?;
                self.clear_around(camera, corners.iter().copied())?;
                if mesh.is_closed() {
                    self.fill_rims(&faces, &corners);
                } else {
                    self.fill_triangles(faces.triangles, &corners);
                }
            }
            None => {
                let (columns, rows) = part.template.mask.dimensions();
                let ends = [(0, 0), (columns, 0), (0, rows), (columns, rows)];
                let mut corners = Vec::with_capacity(4);
                for (u, v) in ends {
                    let [x, y] = part_from_template(part, [f64::from(u), f64::from(v)])?;
                    let at = pose.world_from_part([x as f32, y as f32, part.height_mm as f32]);
                    let [u, v] = camera.image_from_world(at).ok()?;
                    corners.push([u as f32 * scale, v as f32 * scale]);
                }
                self.clear_around(camera, corners.into_iter())?;
                let (sin, cos) = pose.yaw_rad.sin_cos();
                for y in 0..self.bbox.height {
                    for x in 0..self.bbox.width {
                        let at = [self.bbox.x + x, self.bbox.y + y].map(|c| f64::from(c * self.step));
                        let Ok([wx, wy, _]) = camera.world_from_image(at, part.height_mm) else { continue };
                        let (dx, dy) = (wx - pose.x_mm, wy - pose.y_mm);
                        let in_part = [cos * dx + sin * dy, cos * dy - sin * dx];
                        let Some([u, v]) = template_from_part(part, in_part) else { continue };
                        let inside = (0.0..f64::from(columns) - 0.5).contains(&(u + 0.5))
                            && (0.0..f64::from(rows) - 0.5).contains(&(v + 0.5));
                        if inside && part.template.mask.get_pixel(u.round() as u32, v.round() as u32).0[0] > 127 {
                            self.bits[(y * self.bbox.width + x) as usize] = 1;
                        }
                    }
                }
            }
        }
        Some(())
    }

    /// Fills every triangle, wherever it is seen from.
    fn fill_triangles(&mut self, triangles: &[[u32; 3]], corners: &[[f32; 2]]) {
        let (width, height) = (self.bbox.width as usize, self.bbox.height as usize);
        let (left, top) = (self.bbox.x as f32, self.bbox.y as f32);
        for triangle in triangles {
            let corners = triangle.map(|i| {
                let [u, v] = corners[i as usize];
                [u - left, v - top, 0.0]
            });
            fill_triangle(corners, width, height, |index, _| self.bits[index] = 1);
        }
    }

    /// Fills what lies within the rims of a closed mesh: the edges between triangles that are seen from their front and such that
    /// are not. Along a row every rim that is crossed adds a layer of the part or takes one away.
    fn fill_rims(&mut self, faces: &Faces<'_>, corners: &[[f32; 2]]) {
        let (width, height) = (self.bbox.width as usize, self.bbox.height as usize);
        let (left, top) = (self.bbox.x as f32, self.bbox.y as f32);
        let is_front = |triangle: &[u32; 3]| {
            let [a, b, c] = triangle.map(|i| corners[i as usize]);
            (b[0] - a[0]) * (c[1] - a[1]) <= (c[0] - a[0]) * (b[1] - a[1])
        };
        let is_front: Vec<bool> = faces.triangles.iter().map(is_front).collect();
        for sides in faces.sides.chunk_by(|a, b| a.edge == b.edge) {
            let layer = |side: &Side| match (is_front[side.triangle as usize], side.is_along) {
                (false, _) => 0u8,
                (true, true) => 1,
                (true, false) => u8::MAX,
            };
            // Layers are counted modulo 256, of which a rim is one forth or back.
            let layers = sides.iter().map(layer).fold(0, u8::wrapping_add);
            if layers == 0 {
                continue;
            }
            let [a, b] = sides[0].edge.map(|i| {
                let [u, v] = corners[i as usize];
                [u - left, v - top]
            });
            let (from, to, layers) = if a[1] <= b[1] { (a, b, layers) } else { (b, a, layers.wrapping_neg()) };
            // The rows whose centres the edge crosses; of two edges that meet at one, one crosses it.
            let row = |v: f32| v.ceil().clamp(0.0, height as f32) as usize;
            let slope = (to[0] - from[0]) / (to[1] - from[1]);
            for y in row(from[1])..row(to[1]) {
                let x = (from[0] + (y as f32 - from[1]) * slope).ceil().max(0.0) as usize;
                if x < width {
                    let bit = &mut self.bits[y * width + x];
                    *bit = bit.wrapping_add(layers);
                }
            }
        }
        for row in self.bits.chunks_exact_mut(width) {
            let mut layers = 0u8;
            for bit in row {
                layers = layers.wrapping_add(*bit);
                *bit = u8::from(layers != 0);
            }
        }
    }

    fn clear_around(&mut self, camera: &Camera, corners: impl Iterator<Item = [f32; 2]>) -> Option<()> {
        let (mut low, mut high) = ([f32::MAX; 2], [f32::MIN; 2]);
        for corner in corners {
            for axis in 0..2 {
                low[axis] = low[axis].min(corner[axis]);
                high[axis] = high[axis].max(corner[axis]);
            }
        }
        let size = camera.intrinsics().size_px();
        let least = [0, 1].map(|i| low[i].floor().max(0.0));
        let most = [0, 1].map(|i| high[i].ceil().min(((size[i] - 1) / self.step) as f32));
        if !(least[0] <= most[0] && least[1] <= most[1]) {
            return None;
        }
        self.bbox = BoundingBox {
            x: least[0] as u32,
            y: least[1] as u32,
            width: (most[0] - least[0]) as u32 + 1,
            height: (most[1] - least[1]) as u32 + 1,
        };
        self.bits.clear();
        self.bits.resize(self.bbox.width as usize * self.bbox.height as usize, 0);
        Some(())
    }

    /// The pixels as a mask, of a silhouette of all columns and rows; `None` without any.
    pub(crate) fn to_mask(&self) -> Option<Mask> {
        let runs: Vec<MaskRun> = self
            .rows()
            .flat_map(|(y, row)| {
                let mut start = self.bbox.x;
                row.chunk_by(|a, b| a == b).filter_map(move |chunk| {
                    let run = MaskRun { y, start, end: start + chunk.len() as u32 };
                    start = run.end;
                    (chunk[0] != 0).then_some(run)
                })
            })
            .collect();
        Mask::from_runs(&runs)
    }

    /// Number of pixels.
    pub(crate) fn pixels(&self) -> u32 {
        self.bits.iter().map(|&bit| u32::from(bit)).sum()
    }

    /// Number of pixels that are in another, too.
    pub(crate) fn shared_pixels(&self, other: &Self) -> u32 {
        let first = self.bbox.x.max(other.bbox.x);
        let last = (self.bbox.x + self.bbox.width).min(other.bbox.x + other.bbox.width);
        if first >= last {
            return 0;
        }
        let mut both = 0;
        for (y, row) in self.rows() {
            let Some(line) = other.row(y) else { continue };
            let mine = &row[(first - self.bbox.x) as usize..(last - self.bbox.x) as usize];
            let theirs = &line[(first - other.bbox.x) as usize..(last - other.bbox.x) as usize];
            both += mine.iter().zip(theirs).map(|(m, t)| u32::from(m & t)).sum::<u32>();
        }
        both
    }

    /// The bits of a row of the frame; `None` outside of the box.
    pub(crate) fn row(&self, y: u32) -> Option<&[u8]> {
        let row = y.checked_sub(self.bbox.y).filter(|row| *row < self.bbox.height)? as usize;
        let width = self.bbox.width as usize;
        Some(&self.bits[row * width..(row + 1) * width])
    }

    /// Rows from top to bottom: y in the frame, and the bits.
    pub(crate) fn rows(&self) -> impl Iterator<Item = (u32, &[u8])> {
        (self.bbox.y..).zip(self.bits.chunks_exact(self.bbox.width.max(1) as usize))
    }
}

/// Where some vertices are seen, px times `scale`; `None` when one is not.
fn seen(vertices: &[[f32; 3]], projector: &Projector, scale: f32) -> Option<Vec<[f32; 2]>> {
    let mut corners = Vec::with_capacity(vertices.len());
    for chunk in vertices.chunks(LANES) {
        let of = |axis: usize| Wide(std::array::from_fn(|lane| chunk.get(lane).map_or(0.0, |vertex| vertex[axis])));
        let ([Wide(u), Wide(v)], Wide(is_seen)) = projector.image_from_part([of(0), of(1), of(2)]);
        for lane in 0..chunk.len() {
            let corner = [u[lane] * scale, v[lane] * scale];
            if is_seen[lane] <= 0.0 || !corner.iter().all(|c| c.is_finite()) {
                return None;
            }
            corners.push(corner);
        }
    }
    Some(corners)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use proptest::prelude::*;

    use super::*;
    use crate::Catalogue;
    use crate::test_parts::{Block, FLAT_L, overhead, part, tilted};

    const BOX: [Block; 1] = [[[-25.0, -15.0, 0.0], [25.0, 15.0, 20.0]]];

    fn painted(part: &Part, camera: &Camera, pose: &Pose) -> Option<Silhouette> {
        let mut silhouette = Silhouette::default();
        silhouette.paint(part, camera, pose)?;
        Some(silhouette)
    }

    /// Area of the convex hull of some points.
    fn hull_area(mut points: Vec<[f64; 2]>) -> f64 {
        points.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
        let chain = |points: &mut dyn Iterator<Item = [f64; 2]>| {
            let mut hull: Vec<[f64; 2]> = Vec::new();
            for p in points {
                while let [.., a, b] = hull[..] {
                    if (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]) > 0.0 {
                        break;
                    }
                    hull.pop();
                }
                hull.push(p);
            }
            hull
        };
        let mut hull = chain(&mut points.iter().copied());
        hull.pop();
        hull.extend(chain(&mut points.iter().rev().copied()));
        hull.windows(2).map(|w| w[0][0] * w[1][1] - w[0][1] * w[1][0]).sum::<f64>().abs() / 2.0
    }

    proptest! {
        #[test]
        fn a_box_covers_what_its_corners_span(x_mm in -80.0f64..80.0, y_mm in -60.0f64..60.0, yaw_rad in -3.1f64..3.1) {
            let (part, pose) = (part("box", &BOX, true), Pose { x_mm, y_mm, yaw_rad });
            for camera in [overhead(), tilted()] {
                let corners = part.mesh.as_ref().unwrap().vertices().iter();
                let corners = corners.map(|v| camera.image_from_world(pose.world_from_part(*v)).unwrap()).collect();
                let (expected, found) = (hull_area(corners), painted(&part, &camera, &pose).unwrap());
                let pixels = f64::from(found.pixels());
                prop_assert!((pixels - expected).abs() < 0.02 * expected, "{} for {}", pixels, expected);
                prop_assert_eq!(found.to_mask().unwrap().area(), found.pixels());
            }
        }

        #[test]
        fn shared_pixels_are_those_of_both(
            a in (-20.0f64..20.0, -20.0f64..20.0, -3.1f64..3.1),
            b in (-40.0f64..40.0, -40.0f64..40.0, -3.1f64..3.1),
        ) {
            let (part, camera) = (part("l", &FLAT_L, true), overhead());
            let [a, b] = [a, b].map(|(x_mm, y_mm, yaw_rad)| {
                painted(&part, &camera, &Pose { x_mm, y_mm, yaw_rad }).unwrap()
            });
            let (mask_a, mask_b) = (a.to_mask().unwrap(), b.to_mask().unwrap());
            let both = mask_a.runs().flat_map(|r| (r.start..r.end).map(move |x| (x, r.y)));
            let both = both.filter(|(x, y)| mask_b.contains(*x, *y)).count() as u32;
            prop_assert_eq!(a.shared_pixels(&b), both);
            prop_assert_eq!(b.shared_pixels(&a), both);
            prop_assert_eq!(a.shared_pixels(&a), a.pixels());
        }
    }

    #[test]
    fn a_part_without_a_mesh_covers_its_mask() {
        let part = part("l", &FLAT_L, false);
        let template = &part.template;
        let pose = Pose { x_mm: 0.0, y_mm: 0.0, yaw_rad: 0.0 };
        let found = painted(&part, &template.camera, &pose).unwrap().to_mask().unwrap();
        let [left, top] = template.crop_px;
        let set = template.mask.enumerate_pixels().filter(|(_, _, v)| v.0[0] > 127);
        let expected: Vec<(u32, u32)> = set.map(|(x, y, _)| (x + left, y + top)).collect();
        assert!(expected.iter().all(|(x, y)| found.contains(*x, *y)));
        assert_eq!(found.area() as usize, expected.len());
        // Elsewhere, turned, and from aside it covers as much as its mesh would.
        let meshed = Part { mesh: Some(crate::test_parts::mesh(&FLAT_L)), ..part.clone() };
        for camera in [overhead(), tilted()] {
            let pose = Pose { x_mm: 30.0, y_mm: -20.0, yaw_rad: 2.0 };
            let flat = painted(&part, &camera, &pose).unwrap();
            let solid = painted(&meshed, &camera, &pose).unwrap();
            let shared = f64::from(flat.shared_pixels(&solid)) / f64::from(flat.pixels());
            assert!(shared > 0.97, "{shared}");
        }
    }

    #[test]
    fn a_coarse_mesh_covers_what_the_fine_one_does() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/parts");
        let catalogue = Catalogue::read(&folder).unwrap();
        let mut saved = 0;
        for part in catalogue.parts() {
            let mesh = part.mesh.as_ref().unwrap();
            saved += mesh.triangles().len() - mesh.coarse().triangles.len();
            let (camera, pose) = (&part.template.camera, Pose { x_mm: 70.0, y_mm: -40.0, yaw_rad: 0.6 });
            let fine = painted(part, camera, &pose).unwrap().to_mask().unwrap();
            let coarse = Silhouette::of(part, camera, &pose, 2).unwrap();
            let bits = coarse.rows().flat_map(|(y, row)| {
                (coarse.bbox.x..).zip(row).filter(|(_, bit)| **bit != 0).map(move |(x, _)| (2 * x, 2 * y))
            });
            let (count, both) =
                bits.fold((0u32, 0u32), |(n, both), (x, y)| (n + 1, both + u32::from(fine.contains(x, y))));
            let of_fine: u32 =
                fine.runs().map(|r| if r.y % 2 == 0 { r.end.div_ceil(2) - r.start.div_ceil(2) } else { 0 }).sum();
            let iou = f64::from(both) / f64::from(count + of_fine - both);
            assert!(iou > 0.95, "{}: {iou}, {count} pixels for {of_fine}", part.name);
        }
        assert!(saved > 10_000, "{saved} triangles fewer");
    }

    #[test]
    fn within_the_rims_of_a_mesh_lies_what_its_triangles_cover() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/parts");
        let mut closed = 0;
        for part in Catalogue::read(&folder).unwrap().parts() {
            let (mesh, camera) = (part.mesh.as_ref().unwrap(), &part.template.camera);
            if !mesh.is_closed() {
                continue;
            }
            closed += 1;
            for (step, x_mm) in [(1, 70.0), (2, -60.0), (1, 300.0)] {
                let pose = Pose { x_mm, y_mm: -40.0, yaw_rad: 0.6 + x_mm };
                let Some(by_rims) = Silhouette::of(part, camera, &pose, step) else {
                    assert!(x_mm > 200.0, "{} is seen", part.name);
                    continue;
                };
                let faces = if step > 1 { mesh.coarse() } else { mesh.fine() };
                let corners = seen(faces.vertices, &Projector::new(camera, &pose), 1.0 / step as f32).unwrap();
                let mut by_triangles = Silhouette { bits: vec![0; by_rims.bits.len()], ..by_rims.clone() };
                by_triangles.fill_triangles(faces.triangles, &corners);
                // Pixels through whose centre a rim runs, up to rounding.
                let differ = by_rims.bits.iter().zip(&by_triangles.bits).filter(|(a, b)| a != b).count();
                assert!(differ <= 3, "{differ} of {} pixels of {}", by_rims.pixels(), part.name);
            }
        }
        assert!(closed >= 10, "{closed} closed meshes");
    }

    #[test]
    fn parts_are_cut_at_the_border_and_absent_beyond() {
        let (part, camera) = (part("box", &BOX, true), overhead());
        let at = |x_mm| painted(&part, &camera, &Pose { x_mm, y_mm: 0.0, yaw_rad: 0.0 });
        let [width, _] = camera.intrinsics().size_px();
        let edge_mm = camera.world_from_image([f64::from(width) - 0.5, 180.0], 20.0).unwrap()[0];
        let (whole, cut) = (at(0.0).unwrap(), at(edge_mm).unwrap());
        assert_eq!(cut.bbox.right(), width - 1);
        assert!((0.4..0.6).contains(&(f64::from(cut.pixels()) / f64::from(whole.pixels()))));
        assert!(at(edge_mm + 60.0).is_none() && at(-1e6).is_none() && at(f64::NAN).is_none());
        assert_eq!(Silhouette::default().to_mask(), None);
        assert_eq!(whole.shared_pixels(&Silhouette::default()), 0);
    }
}
