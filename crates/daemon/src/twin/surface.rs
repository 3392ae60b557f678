//! The coloured surface of a part: its model, and on it the picture of its template.
//!
//! A point of the model has the colour of the pixel at which the camera of the template saw it. What that camera did not see,
//! side walls above all, takes the nearest colour that it saw.

use std::collections::BTreeMap;

use samsod::recognize::{Part, Template};
use samsod_camera::nalgebra::Point3;

use super::light::linear_from_srgb;
use super::raster::fill;

/// Corners round off where facets meet at less than this angle, as on cylinders; sharp edges stay sharp. Cosine.
const SMOOTH_COSINE: f64 = 0.8;
/// A facet that turns away from the camera of the template so far that its pixels are those of its neighbours. Cosine.
const GRAZING_COSINE: f64 = 0.15;
/// What lies deeper than its pixel is hidden, mm; sloping facets vary within a pixel.
const HIDDEN_MM: f64 = 1.5;

/// A facet of the model.
#[derive(Debug, Clone)]
pub(super) struct Facet {
    /// Indices of its vertices.
    pub(super) corners: [usize; 3],
    /// Its unit normal, in the axes of the part.
    pub(super) normal: [f64; 3],
    /// Unit normals at its corners, of the rounded surface.
    pub(super) corner_normals: [[f64; 3]; 3],
}

/// A line at which facets meet.
#[derive(Debug, Clone)]
pub(super) struct Edge {
    /// Indices of its vertices.
    pub(super) ends: [usize; 2],
    /// Indices of its facets; 1 for those that run along it from its first end to its second, -1 for the others.
    pub(super) facets: Vec<(usize, i32)>,
}

/// A part that can be drawn.
#[derive(Debug, Clone)]
pub(super) struct Surface {
    /// In the axes of the part, mm.
    pub(super) vertices: Vec<[f64; 3]>,
    pub(super) facets: Vec<Facet>,
    pub(super) edges: Vec<Edge>,
    template: Template,
    /// Linear light of the template, everywhere as if the part went on.
    colours: Vec<[f32; 3]>,
    /// Depth of what the template shows, mm from its camera; infinite beside the part.
    depths: Vec<f32>,
}

/// Colour of a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Colour {
    /// Linear light.
    pub(super) light: [f64; 3],
    /// Whether the template shows it, with the light that fell on it; else its shade is not known.
    pub(super) is_seen: bool,
}

impl Surface {
    /// `None` for a part without a model.
    pub(super) fn of(part: &Part) -> Option<Self> {
        let mesh = part.mesh.as_ref()?;
        let vertices: Vec<[f64; 3]> = mesh.vertices().iter().map(|v| v.map(f64::from)).collect();
        let facets = facets(&vertices, mesh.triangles());
        let edges = edges(&facets);
        let template = part.template.clone();
        let colours = extended_colours(&template);
        let depths = vec![f32::INFINITY; colours.len()];
        let mut surface = Self { vertices, facets, edges, template, colours, depths };
        surface.measure_depths();
        Some(surface)
    }

    fn size(&self) -> [usize; 2] {
        let (width, height) = self.template.image.dimensions();
        [width as usize, height as usize]
    }

    /// A point of the part in the world of the template.
    fn in_template_world(&self, point: [f64; 3]) -> [f64; 3] {
        let (sin, cos) = self.template.yaw_rad.sin_cos();
        let [x_mm, y_mm] = self.template.origin_mm;
        [x_mm + cos * point[0] - sin * point[1], y_mm + sin * point[0] + cos * point[1], point[2]]
    }

    /// Pixel of the template and depth, mm, of a point of the part.
    fn seen_at(&self, point: [f64; 3]) -> Option<([f64; 2], f64)> {
        let camera = &self.template.camera;
        let world = self.in_template_world(point);
        let [u, v] = camera.image_from_world(world).ok()?;
        let depth = camera.world_from_camera().inverse_transform_point(&Point3::from(world)).z;
        let [left, top] = self.template.crop_px.map(f64::from);
        Some(([u - left, v - top], depth))
    }

    fn measure_depths(&mut self) {
        let [width, height] = self.size();
        let seen: Vec<_> = self.vertices.iter().map(|v| self.seen_at(*v)).collect();
        for facet in &self.facets {
            let [Some(a), Some(b), Some(c)] = facet.corners.map(|i| seen[i]) else { continue };
            fill([a.0, b.0, c.0], width, height, |index, weights| {
                // Its inverse is linear in the picture.
                let inverse = weights[0] / a.1 + weights[1] / b.1 + weights[2] / c.1;
                let nearest: &mut f32 = &mut self.depths[index];
                *nearest = nearest.min((1.0 / inverse) as f32);
            });
        }
    }

    /// The colour of a point of a facet.
    pub(super) fn colour(&self, point: [f64; 3], facet: &Facet) -> Colour {
        let Some((pixel, depth)) = self.seen_at(point) else {
            return Colour { light: [0.0; 3], is_seen: false };
        };
        Colour { light: self.sample(pixel), is_seen: self.faces_template(point, facet) && self.is_open(pixel, depth) }
    }

    fn faces_template(&self, point: [f64; 3], facet: &Facet) -> bool {
        let (sin, cos) = self.template.yaw_rad.sin_cos();
        let [x, y, z] = facet.normal;
        let normal = [cos * x - sin * y, sin * x + cos * y, z];
        let eye = self.template.camera.world_from_camera().translation.vector;
        let world = self.in_template_world(point);
        let towards = [eye.x - world[0], eye.y - world[1], eye.z - world[2]];
        dot(normal, towards) > GRAZING_COSINE * dot(towards, towards).sqrt()
    }

    /// Whether nothing lies before a point.
    fn is_open(&self, [u, v]: [f64; 2], depth: f64) -> bool {
        let [width, height] = self.size();
        let (column, row) = (u.round(), v.round());
        let mut deepest = f32::NEG_INFINITY;
        for (dx, dy) in [(0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)] {
            let (x, y) = (column + dx, row + dy);
            if x >= 0.0 && y >= 0.0 && x < width as f64 && y < height as f64 {
                let found = self.depths[y as usize * width + x as usize];
                deepest = deepest.max(if found.is_finite() { found } else { f32::NEG_INFINITY });
            }
        }
        depth <= f64::from(deepest) + HIDDEN_MM
    }

    /// Between the four pixels around.
    fn sample(&self, [u, v]: [f64; 2]) -> [f64; 3] {
        let [width, height] = self.size();
        let (u, v) = (u.clamp(0.0, width as f64 - 1.0), v.clamp(0.0, height as f64 - 1.0));
        let (left, top) = (u as usize, v as usize);
        let (right, bottom) = ((left + 1).min(width - 1), (top + 1).min(height - 1));
        let (fu, fv) = (u - left as f64, v - top as f64);
        let at = |x: usize, y: usize, i: usize| f64::from(self.colours[y * width + x][i]);
        [0, 1, 2].map(|i| {
            let upper = at(left, top, i) * (1.0 - fu) + at(right, top, i) * fu;
            let lower = at(left, bottom, i) * (1.0 - fu) + at(right, bottom, i) * fu;
            upper * (1.0 - fv) + lower * fv
        })
    }
}

/// Triangles with an area, and their normals.
fn facets(vertices: &[[f64; 3]], triangles: &[[u32; 3]]) -> Vec<Facet> {
    let mut facets = Vec::new();
    let mut areas = Vec::new();
    for triangle in triangles {
        let corners = triangle.map(|i| i as usize);
        let [a, b, c] = corners.map(|i| vertices[i]);
        let normal = cross(minus(b, a), minus(c, a));
        let length = dot(normal, normal).sqrt();
        if length > 1e-9 {
            let normal = normal.map(|n| n / length);
            facets.push(Facet { corners, normal, corner_normals: [normal; 3] });
            areas.push(length);
        }
    }
    let mut around: Vec<Vec<usize>> = vec![Vec::new(); vertices.len()];
    for (index, facet) in facets.iter().enumerate() {
        facet.corners.iter().for_each(|&corner| around[corner].push(index));
    }
    for index in 0..facets.len() {
        let Facet { corners, normal, .. } = facets[index];
        facets[index].corner_normals = corners.map(|corner| {
            let mut sum = [0.0; 3];
            for &other in around[corner].iter().filter(|&&other| dot(facets[other].normal, normal) > SMOOTH_COSINE) {
                (0..3).for_each(|i| sum[i] += areas[other] * facets[other].normal[i]);
            }
            unit(sum)
        });
    }
    facets
}

fn edges(facets: &[Facet]) -> Vec<Edge> {
    let mut edges: BTreeMap<[usize; 2], Vec<(usize, i32)>> = BTreeMap::new();
    for (index, Facet { corners: [a, b, c], .. }) in facets.iter().enumerate() {
        for [from, to] in [[*a, *b], [*b, *c], [*c, *a]] {
            let (ends, sign) = if from < to { ([from, to], 1) } else { ([to, from], -1) };
            edges.entry(ends).or_default().push((index, sign));
        }
    }
    edges.into_iter().map(|(ends, facets)| Edge { ends, facets }).collect()
}

/// Linear light of the template, its part grown over all that is none. The outermost pixels of the part count as none: the
/// table has mixed into them.
fn extended_colours(template: &Template) -> Vec<[f32; 3]> {
    let (width, height) = template.image.dimensions();
    let on_part = |x: i64, y: i64| {
        x >= 0
            && y >= 0
            && x < i64::from(width)
            && y < i64::from(height)
            && template.mask.get_pixel(x as u32, y as u32).0[0] > 127
    };
    let around = |x: i64, y: i64| (-1..=1).flat_map(move |dy| (-1..=1).map(move |dx| (x + dx, y + dy)));
    let pixels = || (0..i64::from(height)).flat_map(|y| (0..i64::from(width)).map(move |x| (x, y)));
    let mut known: Vec<bool> = pixels().map(|(x, y)| around(x, y).all(|(x, y)| on_part(x, y))).collect();
    // Of a part no wider than two pixels nothing would be left.
    if !known.contains(&true) {
        known = pixels().map(|(x, y)| on_part(x, y)).collect();
    }
    let light = |value: u8| linear_from_srgb(f64::from(value) / 255.0) as f32;
    let mut colours: Vec<[f32; 3]> = template.image.pixels().map(|pixel| pixel.0.map(light)).collect();

    let index = |x: i64, y: i64| {
        let inside = x >= 0 && y >= 0 && x < i64::from(width) && y < i64::from(height);
        inside.then(|| y as usize * width as usize + x as usize)
    };
    // Ring by ring, each the mean of what it touches.
    let mut unknown: Vec<(i64, i64)> = pixels().zip(&known).filter(|(_, known)| !**known).map(|(at, _)| at).collect();
    while !unknown.is_empty() {
        let (mut ring, mut left) = (Vec::new(), Vec::new());
        for &(x, y) in &unknown {
            let (mut sum, mut count) = ([0.0f32; 3], 0.0);
            for near in around(x, y).filter_map(|(x, y)| index(x, y)).filter(|&near| known[near]) {
                (0..3).for_each(|i| sum[i] += colours[near][i]);
                count += 1.0;
            }
            match index(x, y) {
                Some(at) if count > 0.0 => ring.push((at, sum.map(|s| s / count))),
                _ => left.push((x, y)),
            }
        }
        if ring.is_empty() {
            break;
        }
        for (at, colour) in ring {
            (colours[at], known[at]) = (colour, true);
        }
        unknown = left;
    }
    colours
}

pub(super) fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Of length 1; (0, 0, 1) when it has none.
pub(super) fn unit(a: [f64; 3]) -> [f64; 3] {
    let length = dot(a, a).sqrt();
    if length > 0.0 { a.map(|c| c / length) } else { [0.0, 0.0, 1.0] }
}

fn minus(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}
