//! The colour of a part, without its brightness: what survives another light.
//!
//! In: pixels. Out: a [`Tint`], the shares of red, green and blue in all of their light, and how far two of them are apart.

use std::sync::LazyLock;

use samsod_segment::RgbView;

use crate::Template;
use crate::silhouette::Silhouette;

/// Square roots of the shares that red, green and blue have of the light of some pixels; grey without any light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Tint([f32; 3]);

impl Tint {
    fn of_light(light: [f64; 3]) -> Self {
        let all: f64 = light.iter().sum();
        Self(light.map(|l| if all > 0.0 { (l / all).sqrt() as f32 } else { (1.0f32 / 3.0).sqrt() }))
    }

    /// Of the part on a template.
    pub(crate) fn of_template(template: &Template) -> Self {
        let linear = linear_table();
        let on_part = template.image.pixels().zip(template.mask.pixels()).filter(|(_, mask)| mask.0[0] > 127);
        let light = on_part.fold([0.0; 3], |sum: [f64; 3], (pixel, _)| add(sum, pixel.0, linear));
        Self::of_light(light)
    }

    /// Of the pixels of a frame that a silhouette covers.
    pub(crate) fn of_frame(frame: &RgbView<'_>, silhouette: &Silhouette) -> Self {
        let linear = linear_table();
        let (pixels, stride) = (frame.as_raw().as_chunks::<3>().0, frame.width() as usize);
        let mut light = [0.0; 3];
        for (y, row) in silhouette.rows() {
            let start = (y * silhouette.step) as usize * stride;
            for (x, _) in (silhouette.bbox.x..).zip(row).filter(|(_, bit)| **bit != 0) {
                if let Some(pixel) = pixels.get(start + (x * silhouette.step) as usize) {
                    light = add(light, *pixel, linear);
                }
            }
        }
        Self::of_light(light)
    }

    /// Hellinger distance, in [0, 1]: 0 of the same tint, 1 of two that share no colour.
    pub(crate) fn distance(&self, other: &Self) -> f32 {
        let common: f32 = self.0.iter().zip(&other.0).map(|(a, b)| a * b).sum();
        (1.0 - common).max(0.0).sqrt()
    }
}

fn add(sum: [f64; 3], pixel: [u8; 3], linear: &[f64; 256]) -> [f64; 3] {
    std::array::from_fn(|c| sum[c] + linear[usize::from(pixel[c])])
}

/// Light in [0, 1] of every sRGB level.
fn linear_table() -> &'static [f64; 256] {
    static TABLE: LazyLock<[f64; 256]> = LazyLock::new(|| {
        std::array::from_fn(|level| {
            let value = level as f64 / 255.0;
            if value <= 0.040_45 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
        })
    });
    &TABLE
}

#[cfg(test)]
mod tests {
    use image::RgbImage;
    use samsod_camera::Camera;

    use super::*;
    use crate::pose_fit::Pose;
    use crate::test_parts::{Block, PAINT, overhead, paint, part, table};

    const BOX: [Block; 1] = [[[-25.0, -15.0, 0.0], [25.0, 15.0, 20.0]]];

    /// The tint of the box where it lies in a picture of which every level is changed.
    fn seen(camera: &Camera, change: impl Fn([u8; 3]) -> [u8; 3]) -> Tint {
        let pose = Pose { x_mm: 12.0, y_mm: -9.0, yaw_rad: 0.7 };
        let mut image: RgbImage = table();
        paint(&mut image, &BOX, camera, &pose);
        image.pixels_mut().for_each(|pixel| pixel.0 = change(pixel.0));
        let silhouette = Silhouette::of(&part("box", &BOX, true), camera, &pose, 2).unwrap();
        let (width, height) = image.dimensions();
        Tint::of_frame(&RgbView::from_raw(width, height, image.as_raw().as_slice()).unwrap(), &silhouette)
    }

    #[test]
    fn another_light_leaves_the_tint_and_another_paint_does_not() {
        let template = Tint::of_template(&part("box", &BOX, true).template);
        let camera = overhead();
        let linear = linear_table();
        let half = |level: u8| linear.iter().position(|l| *l >= 0.5 * linear[usize::from(level)]).unwrap() as u8;
        let (same, dim) = (seen(&camera, |rgb| rgb), seen(&camera, |rgb| rgb.map(half)));
        assert!(same.distance(&template) < 0.02, "{}", same.distance(&template));
        assert!(dim.distance(&template) < 0.03, "{}", dim.distance(&template));
        let [r, g, b] = PAINT;
        let other = seen(&camera, |rgb| if rgb == [r, g, b] { [b, g, r] } else { rgb });
        assert!(other.distance(&template) > 0.2, "{}", other.distance(&template));
    }

    #[test]
    fn distances_are_those_of_shares() {
        let of = |rgb: [f64; 3]| Tint::of_light(rgb);
        // The root of what rounding leaves.
        assert!(of([2.0, 2.0, 2.0]).distance(&of([0.0; 3])) < 1e-3);
        assert!((of([1.0, 0.0, 0.0]).distance(&of([0.0, 1.0, 1.0])) - 1.0).abs() < 1e-6);
        let (grey, red) = (of([1.0; 3]), of([2.0, 1.0, 1.0]));
        assert_eq!(grey.distance(&red), red.distance(&grey));
        assert!((0.1..0.2).contains(&grey.distance(&red)), "{}", grey.distance(&red));
        assert!((of([0.0; 3]).distance(&red) - grey.distance(&red)).abs() < 1e-3);
    }
}
