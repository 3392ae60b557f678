//! The features of a part in its own frame, mm, and of a crop on planes over the table.
//!
//! A feature of a template is put where its ray meets the shape of the part, if that is known, else on the plane of the
//! part's height: lettering on the flange of a hub lies lower than the hub and shows another parallax. Features of a
//! crop are put on the plane of the feature that they are compared with. In these coordinates a part only turns and
//! shifts: lens, tilt and parallax are gone.

use nalgebra::{Point3, Rotation3, Vector3};
use samsod_camera::{Camera, Intrinsics};

use crate::sift_features::{Descriptor, Feature, SiftModel, dot};
use crate::{Mesh, Part, Template};

/// Distance at which two descriptors (of norm 512) are taken for those of different things.
pub(crate) const UNLIKE: f64 = 300.0;

/// A feature of a part.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PartFeature {
    /// Where it lies, mm.
    pub(crate) at: [f64; 2],
    /// Its height over the table, mm.
    pub(crate) height_mm: f64,
    /// Diameter, mm.
    pub(crate) size_mm: f64,
    /// Direction of its strongest gradient, counter-clockwise from the x axis of the part, rad.
    pub(crate) angle_rad: f64,
    /// Index of its place.
    pub(crate) place: usize,
    /// How little it is like features at other places of the part, in [0, 1]: the teeth of a gear tell no angle.
    pub(crate) distinctness: f64,
}

/// What one part is recognised by.
#[derive(Debug)]
pub(crate) struct SiftPart {
    pub(crate) features: Vec<PartFeature>,
    pub(crate) descriptors: Vec<Descriptor>,
    /// Squared lengths of the descriptors.
    pub(crate) norms: Vec<i32>,
    /// Mean place of the features, mm.
    pub(crate) center: [f64; 2],
    /// Distance of the outermost feature from there, mm.
    pub(crate) reach_mm: f64,
    /// Height of the part, mm.
    pub(crate) height_mm: f64,
    /// The camera of the template.
    pub(crate) camera: Camera,
    /// Corners of the template, px, and where they are seen at the height of the part, mm.
    pub(crate) corners_px: [[f64; 2]; 4],
    pub(crate) corners_mm: [[f64; 2]; 4],
}

/// A match: the feature of a crop and its nearest of a part.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Match {
    pub(crate) of_part: usize,
    pub(crate) of_crop: usize,
    /// Whether the second nearest is so much farther as the ratio asks.
    pub(crate) stands_out: bool,
}

impl SiftPart {
    pub(crate) fn new(model: &SiftModel, part: &Part) -> Self {
        let template = &part.template;
        let crop_px = template.crop_px.map(f64::from);
        let found = model.to_features();
        let pixels: Vec<[f64; 2]> = found.features.iter().map(|feature| feature.at.map(f64::from)).collect();
        let rays = Rays::new(&template.camera, &found.features, crop_px);
        let surface = part.mesh.as_ref().map(|mesh| surface_heights(mesh, template, &pixels));
        let (sin, cos) = template.yaw_rad.sin_cos();
        let to_part = |[x, y]: [f64; 2]| {
            let [x, y] = [x - template.origin_mm[0], y - template.origin_mm[1]];
            [cos * x + sin * y, cos * y - sin * x]
        };
        let mut features: Vec<PartFeature> = Vec::with_capacity(pixels.len());
        for (i, feature) in found.features.iter().enumerate() {
            let seen = surface.as_ref().and_then(|heights| heights.get(i).copied().flatten());
            let height_mm = seen.unwrap_or(part.height_mm);
            let on_plane = rays.on_plane(i, feature, height_mm);
            let last = features.last().map_or(0, |last| last.place);
            let is_other = i > 0 && found.features[i - 1].at != feature.at;
            features.push(PartFeature {
                at: to_part(on_plane.at),
                height_mm,
                size_mm: on_plane.size_mm,
                angle_rad: on_plane.angle_rad - template.yaw_rad,
                place: last + usize::from(is_other),
                distinctness: 1.0,
            });
        }
        let norms: Vec<i32> = found.descriptors.iter().map(|d| dot(d, d)).collect();
        for i in 0..features.len() {
            let others = (0..features.len()).filter(|&j| features[j].place != features[i].place);
            let distance = |j: usize| norms[i] + norms[j] - 2 * dot(&found.descriptors[i], &found.descriptors[j]);
            let nearest = others.map(distance).min().unwrap_or(i32::MAX);
            features[i].distinctness = (f64::from(nearest) / (UNLIKE * UNLIKE)).min(1.0);
        }
        let n = features.len().max(1) as f64;
        let center = [0, 1].map(|axis| features.iter().map(|feature| feature.at[axis]).sum::<f64>() / n);
        let distance = |feature: &PartFeature| (feature.at[0] - center[0]).hypot(feature.at[1] - center[1]);
        let (width, height) = template.image.dimensions();
        let [right, bottom] = [width, height].map(|side| f64::from(side) - 1.0);
        let corners_px = [[0.0, 0.0], [right, 0.0], [right, bottom], [0.0, bottom]];
        let corners_mm = corners_px.map(|[u, v]| {
            let seen = template.camera.world_from_image([u + crop_px[0], v + crop_px[1]], part.height_mm);
            // A corner that the camera cannot see makes no homography.
            seen.map_or([f64::NAN; 2], |[x, y, _]| to_part([x, y]))
        });
        Self {
            reach_mm: features.iter().map(distance).fold(0.0, f64::max),
            features,
            descriptors: found.descriptors,
            norms,
            center,
            height_mm: part.height_mm,
            camera: template.camera,
            corners_px,
            corners_mm,
        }
    }

    /// Squared distance of descriptors.
    pub(crate) fn distance(&self, of_part: usize, descriptor: &Descriptor, norm: i32) -> i32 {
        self.norms[of_part] + norm - 2 * dot(&self.descriptors[of_part], descriptor)
    }

    /// For every descriptor of a crop the nearest of the part, when the second nearest, at another place, is `least_ratio`
    /// times as far; those at `ratio` stand out. `norms` are the squared lengths.
    pub(crate) fn matches(
        &self,
        descriptors: &[Descriptor],
        norms: &[i32],
        ratio: f32,
        least_ratio: f32,
        matches: &mut Vec<Match>,
    ) {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the processor was just found to have AVX2, the only feature the function asks for.
            unsafe { matches_avx2(self, descriptors, norms, ratio, least_ratio, matches) };
            return;
        }
        self.matches_portable(descriptors, norms, ratio, least_ratio, matches);
    }

    #[inline(always)]
    fn matches_portable(
        &self,
        descriptors: &[Descriptor],
        norms: &[i32],
        ratio: f32,
        least_ratio: f32,
        matches: &mut Vec<Match>,
    ) {
        matches.clear();
        let [square, least_square] = [ratio, ratio.min(least_ratio)].map(|ratio| f64::from(ratio).powi(2));
        for (of_crop, (descriptor, norm)) in descriptors.iter().zip(norms).enumerate() {
            let (mut nearest, mut of_part, mut place, mut second) = (i32::MAX, 0, usize::MAX, i32::MAX);
            for (i, (other, other_norm)) in self.descriptors.iter().zip(&self.norms).enumerate() {
                let distance = norm + other_norm - 2 * dot(descriptor, other);
                if distance >= second {
                    continue;
                }
                let is_other_place = self.features[i].place != place;
                if distance < nearest {
                    if is_other_place {
                        second = nearest;
                    }
                    (nearest, of_part, place) = (distance, i, self.features[i].place);
                } else if is_other_place {
                    second = distance;
                }
            }
            // Without a second there is nothing to stand out from.
            if second < i32::MAX && f64::from(second) >= least_square * f64::from(nearest) {
                let stands_out = f64::from(second) >= square * f64::from(nearest);
                matches.push(Match { of_part, of_crop, stands_out });
            }
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn matches_avx2(
    part: &SiftPart,
    descriptors: &[Descriptor],
    norms: &[i32],
    ratio: f32,
    least_ratio: f32,
    matches: &mut Vec<Match>,
) {
    part.matches_portable(descriptors, norms, ratio, least_ratio, matches);
}

/// The rays of a camera through the features of a crop.
#[derive(Debug)]
pub(crate) struct Rays {
    pub(crate) camera: Camera,
    origin: Vector3<f64>,
    /// Directions through the centre of each feature, and one pixel further along its gradient.
    directions: Vec<[Vector3<f64>; 2]>,
}

/// A feature of a crop on a plane over the table.
#[derive(Debug, Clone, Copy)]
pub(crate) struct OnPlane {
    pub(crate) at: [f64; 2],
    pub(crate) size_mm: f64,
    pub(crate) angle_rad: f64,
}

impl Rays {
    /// # Arguments
    /// * `crop_px` - first pixel of the crop in the image of the camera
    pub(crate) fn new(camera: &Camera, features: &[Feature], crop_px: [f64; 2]) -> Self {
        let rotation = camera.world_from_camera().rotation.to_rotation_matrix();
        let directions = features.iter().map(|feature| {
            let [u, v] = [0, 1].map(|axis| f64::from(feature.at[axis]) + crop_px[axis]);
            let (sin, cos) = f64::from(feature.angle_rad).sin_cos();
            [[u, v], [u + cos, v + sin]].map(|pixel| direction(camera.intrinsics(), &rotation, pixel))
        });
        let directions = directions.collect();
        Self { camera: *camera, origin: camera.world_from_camera().translation.vector, directions }
    }

    /// A feature on the plane z = `height_mm`; NaN when its ray does not meet it.
    pub(crate) fn on_plane(&self, index: usize, feature: &Feature, height_mm: f64) -> OnPlane {
        let [from, to] = self.directions[index].map(|direction| {
            let distance = (height_mm - self.origin.z) / direction.z;
            let distance = if distance > 0.0 { distance } else { f64::NAN };
            [self.origin.x + direction.x * distance, self.origin.y + direction.y * distance]
        });
        let step = [to[0] - from[0], to[1] - from[1]];
        let size_mm = f64::from(feature.size_px) * step[0].hypot(step[1]);
        OnPlane { at: from, size_mm, angle_rad: step[1].atan2(step[0]) }
    }
}

fn direction(intrinsics: &Intrinsics, rotation: &Rotation3<f64>, pixel: [f64; 2]) -> Vector3<f64> {
    match intrinsics.ray_from_image(pixel) {
        Ok([x, y]) => rotation * Vector3::new(x, y, 1.0),
        // Meets no plane: the feature agrees with nothing.
        Err(_) => Vector3::repeat(f64::NAN),
    }
}

/// Height of the surface that the camera of a template sees at some pixels of it, in the order of their rows, mm; `None`
/// where it sees past the part. Linear in triangles times pixels within their rows.
fn surface_heights(mesh: &Mesh, template: &Template, pixels: &[[f64; 2]]) -> Vec<Option<f64>> {
    let (sin, cos) = template.yaw_rad.sin_cos();
    let camera_from_world = template.camera.world_from_camera().inverse();
    let [left, top] = template.crop_px.map(f64::from);
    // Pixel, height, and one over depth, which is linear in the image.
    let project = |vertex: &[f32; 3]| {
        let [x, y, z] = vertex.map(f64::from);
        let [x, y] = [cos * x - sin * y + template.origin_mm[0], sin * x + cos * y + template.origin_mm[1]];
        let [u, v] = template.camera.image_from_world([x, y, z]).ok()?;
        let depth = (camera_from_world * Point3::new(x, y, z)).z;
        Some([u - left, v - top, z, depth.recip()])
    };
    let vertices: Vec<Option<[f64; 4]>> = mesh.vertices().iter().map(project).collect();
    let mut nearest: Vec<Option<[f64; 2]>> = vec![None; pixels.len()];
    for triangle in mesh.triangles() {
        let [Some(a), Some(b), Some(c)] = triangle.map(|vertex| vertices.get(vertex as usize).copied().flatten())
        else {
            continue;
        };
        let [first, last] = [a[1].min(b[1]).min(c[1]), a[1].max(b[1]).max(c[1])];
        let start = pixels.partition_point(|pixel| pixel[1] < first);
        let twice_area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1]);
        for (&[x, y], nearest) in pixels.iter().zip(&mut nearest).skip(start).take_while(|(pixel, _)| pixel[1] <= last)
        {
            let of_b = ((x - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (y - a[1])) / twice_area;
            let of_c = ((b[0] - a[0]) * (y - a[1]) - (x - a[0]) * (b[1] - a[1])) / twice_area;
            let of_a = 1.0 - of_b - of_c;
            // NaN of a triangle that is seen from its edge is not inside.
            if !(of_a >= 0.0 && of_b >= 0.0 && of_c >= 0.0) {
                continue;
            }
            let nearness = of_a * a[3] + of_b * b[3] + of_c * c[3];
            if nearest.is_none_or(|[_, least]| nearness > least) {
                let height = (of_a * a[3] * a[2] + of_b * b[3] * b[2] + of_c * c[3] * c[2]) / nearness;
                *nearest = Some([height, nearness]);
            }
        }
    }
    nearest.into_iter().map(|nearest| nearest.map(|[height, _]| height)).collect()
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use image::{GrayImage, RgbImage};
    use proptest::prelude::*;

    use super::*;

    fn part_of(descriptors: Vec<Descriptor>, places: &[usize]) -> SiftPart {
        let feature = |&place: &usize| PartFeature {
            at: [0.0; 2],
            height_mm: 0.0,
            size_mm: 1.0,
            angle_rad: 0.0,
            place,
            distinctness: 1.0,
        };
        SiftPart {
            features: places.iter().map(feature).collect(),
            norms: descriptors.iter().map(|d| dot(d, d)).collect(),
            descriptors,
            center: [0.0; 2],
            reach_mm: 1.0,
            height_mm: 0.0,
            camera: Camera::overhead([100, 100], 0.5, [50.0, 50.0], 900.0).unwrap(),
            corners_px: [[0.0; 2]; 4],
            corners_mm: [[0.0; 2]; 4],
        }
    }

    fn matches(part: &SiftPart, descriptors: &[Descriptor], ratio: f32) -> Vec<Match> {
        let norms: Vec<i32> = descriptors.iter().map(|d| dot(d, d)).collect();
        let mut matches = Vec::new();
        part.matches(descriptors, &norms, ratio, 1.0, &mut matches);
        matches
    }

    /// A descriptor with these first numbers.
    fn descriptor(first: &[i16]) -> Descriptor {
        let mut all = [0; 128];
        all[..first.len()].copy_from_slice(first);
        all
    }

    #[test]
    fn a_match_stands_out_from_other_places_only() {
        let near = descriptor(&[10, 0]);
        // At distances 10, 12 (same place as the first) and 30.
        let all = vec![descriptor(&[20, 0]), descriptor(&[22, 0]), descriptor(&[40, 0])];
        let found = |places: &[usize], ratio| matches(&part_of(all.clone(), places), &[near], ratio)[0];
        assert_eq!(found(&[0, 0, 1], 1.5), Match { of_part: 0, of_crop: 0, stands_out: true });
        assert!(found(&[0, 0, 1], 3.0).stands_out && !found(&[0, 0, 1], 3.1).stands_out);
        assert!(!found(&[0, 1, 2], 1.5).stands_out);
        // In the opposite order, too.
        let reversed = part_of(all.iter().rev().copied().collect(), &[0, 1, 1]);
        assert_eq!(matches(&reversed, &[near], 1.5), [Match { of_part: 2, of_crop: 0, stands_out: true }]);
    }

    #[test]
    fn nothing_matches_nothing_and_one_place_stands_out_from_none() {
        assert!(matches(&part_of(Vec::new(), &[]), &[descriptor(&[1])], 1.5).is_empty());
        assert!(matches(&part_of(vec![descriptor(&[1])], &[0]), &[], 1.5).is_empty());
        assert!(matches(&part_of(vec![descriptor(&[1])], &[0]), &[descriptor(&[1])], 1.5).is_empty());
    }

    proptest! {
        #[test]
        fn matches_with_and_without_avx2_are_the_same(
            values in prop::collection::vec(0i16..=255, 128 * 12),
            ratio in 1.0f32..2.0,
        ) {
            let all: Vec<Descriptor> = values.chunks_exact(128).map(|row| std::array::from_fn(|i| row[i])).collect();
            let part = part_of(all[..8].to_vec(), &[0, 1, 1, 2, 3, 4, 4, 5]);
            let norms: Vec<i32> = all[8..].iter().map(|d| dot(d, d)).collect();
            let mut portable = Vec::new();
            part.matches_portable(&all[8..], &norms, ratio, 1.0, &mut portable);
            prop_assert_eq!(matches(&part, &all[8..], ratio), portable);
        }
    }

    #[test]
    fn a_step_is_seen_at_its_heights() {
        // 20 x 10 mm, 4 mm high for x < 0 and 12 mm for x > 0; only its upper faces matter.
        let mut file = tempfile::NamedTempFile::new().unwrap();
        let mut write = |text: String| file.write_all(text.as_bytes()).unwrap();
        write("solid step\n".to_owned());
        for (left, right, z) in [(-10.0, 0.0, 4.0), (0.0, 10.0, 12.0), (-10.0, 10.0, 0.0)] {
            for [a, b, c] in [[(left, -5.0), (right, -5.0), (right, 5.0)], [(left, -5.0), (right, 5.0), (left, 5.0)]] {
                write("facet normal 0 0 1\nouter loop\n".to_owned());
                [a, b, c].iter().for_each(|(x, y)| write(format!("vertex {x} {y} {z}\n")));
                write("endloop\nendfacet\n".to_owned());
            }
        }
        write("endsolid step\n".to_owned());
        let mesh = Mesh::read(file.path()).unwrap();
        let template = Template {
            image: RgbImage::new(60, 60),
            mask: GrayImage::new(60, 60),
            camera: Camera::overhead([400, 300], 0.5, [200.0, 150.0], 900.0).unwrap(),
            crop_px: [270, 120],
            origin_mm: [50.0, 10.0],
            yaw_rad: std::f64::consts::FRAC_PI_2,
        };
        // Turned by 90 degrees, part x runs up the image; parallax moves what is high away from the centre.
        let pixel = |[x, y]: [f64; 2], z: f64| {
            let [u, v] = template.camera.image_from_world([50.0 - y, 10.0 + x, z]).unwrap();
            [u - 270.0, v - 120.0]
        };
        let pixels =
            [pixel([8.0, 2.0], 12.0), pixel([5.0, 2.0], 12.0), pixel([-6.0, -3.0], 4.0), pixel([-20.0, 0.0], 0.0)];
        let heights = surface_heights(&mesh, &template, &pixels);
        for (found, expected) in heights.iter().zip([Some(12.0), Some(12.0), Some(4.0), None]) {
            let is_equal = match (found, expected) {
                (Some(found), Some(expected)) => (found - expected).abs() < 1e-4,
                (found, expected) => *found == expected,
            };
            assert!(is_equal, "{heights:?}");
        }
    }

    #[test]
    fn features_on_a_plane_have_its_scale_and_angle() {
        let camera = Camera::overhead([400, 300], 0.5, [200.0, 150.0], 900.0).unwrap();
        let feature = Feature { at: [10.0, 20.0], size_px: 6.0, angle_rad: 0.5 };
        let rays = Rays::new(&camera, &[feature], [240.0, 100.0]);
        let on_table = rays.on_plane(0, &feature, 0.0);
        assert!((on_table.at[0] - 25.0).abs() < 1e-9 && (on_table.at[1] - 15.0).abs() < 1e-9, "{on_table:?}");
        // Clockwise on the screen is clockwise in the world.
        assert!((on_table.size_mm - 3.0).abs() < 1e-9 && (on_table.angle_rad + 0.5).abs() < 1e-9);
        assert!((rays.on_plane(0, &feature, 450.0).size_mm - 1.5).abs() < 1e-9);
        assert!(rays.on_plane(0, &feature, 1000.0).at[0].is_nan());
    }
}
