//! Undistorting whole images.
//!
//! The map is computed once for a camera; applying it to a frame is four reads and a weighted sum a pixel.

use image::{ImageBuffer, Rgb, RgbImage};
use rayon::prelude::*;

use crate::intrinsics::Intrinsics;

/// A borrowed RGB frame.
pub type RgbView<'a> = ImageBuffer<Rgb<u8>, &'a [u8]>;

/// Steps between two pixels; weights are products of two such fractions.
const FRACTION: u32 = 256;
/// Stands for a pixel that the camera did not see.
const UNSEEN: u32 = u32::MAX;

/// Where a pixel of the undistorted image comes from.
#[derive(Debug, Clone, Copy)]
struct Source {
    /// Upper left of the four pixels, as y * width + x, or [`UNSEEN`].
    pixel: u32,
    /// Fraction of the way to the next pixel to the right, in 0..=[`FRACTION`].
    right: u16,
    /// And down.
    down: u16,
}

/// From the image of a camera to the one that an ideal lens of the same focal lengths and principal point would give.
///
/// Bilinear with weights of 8 bits a direction; what the camera did not see is black. 8 bytes a pixel.
#[derive(Debug, Clone)]
pub struct UndistortionMap {
    width_px: u32,
    height_px: u32,
    sources: Vec<Source>,
}

/// The image is not one of this camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the image has {given:?} px, the camera {expected:?}: it was calibrated for another resolution")]
#[non_exhaustive]
pub struct ImageSizeError {
    /// Width and height of the image, px.
    pub given: [u32; 2],
    /// Width and height of the camera's images, px.
    pub expected: [u32; 2],
}

impl UndistortionMap {
    /// Computes the map.
    pub fn new(intrinsics: &Intrinsics) -> Self {
        let [width_px, height_px] = intrinsics.size_px();
        let source = |u: u32, v: u32| {
            let at = intrinsics.distort_point([f64::from(u), f64::from(v)]);
            let Some([x, y]) = at.ok().filter(|&at| intrinsics.contains(at)) else {
                return Source { pixel: UNSEEN, right: 0, down: 0 };
            };
            // Between the centre and the edge of an outermost pixel its colour goes on.
            let cell = |at: f64, side: u32| {
                let at = at.clamp(0.0, f64::from(side - 1));
                let first = (at.floor() as u32).min(side - 2);
                (first, ((at - f64::from(first)) * f64::from(FRACTION)).round() as u16)
            };
            let ((left, right), (top, down)) = (cell(x, width_px), cell(y, height_px));
            Source { pixel: top * width_px + left, right, down }
        };
        let rows = (0..height_px).into_par_iter();
        let sources = rows.flat_map_iter(|v| (0..width_px).map(move |u| source(u, v))).collect();
        Self { width_px, height_px, sources }
    }

    /// Width and height of the images, px.
    pub fn size_px(&self) -> [u32; 2] {
        [self.width_px, self.height_px]
    }

    /// Writes the undistorted image into `out`, which is made anew only if it has another size.
    ///
    /// # Errors
    /// [`ImageSizeError`] if the image is not of the camera's size.
    pub fn apply(&self, image: &RgbView<'_>, out: &mut RgbImage) -> Result<(), ImageSizeError> {
        if image.dimensions() != (self.width_px, self.height_px) {
            return Err(ImageSizeError { given: image.dimensions().into(), expected: self.size_px() });
        }
        if out.dimensions() != image.dimensions() {
            *out = RgbImage::new(self.width_px, self.height_px);
        }
        let width = self.width_px as usize;
        let (pixels, _) = image.as_raw().as_chunks::<3>();
        let (targets, _) = out.as_flat_samples_mut().samples.as_chunks_mut::<3>();
        targets.par_chunks_mut(width).zip(self.sources.par_chunks(width)).for_each(|(row, sources)| {
            for (target, source) in row.iter_mut().zip(sources) {
                *target = source.colour(pixels, width);
            }
        });
        Ok(())
    }
}

impl Source {
    fn colour(self, pixels: &[[u8; 3]], width: usize) -> [u8; 3] {
        let Self { pixel, right, down } = self;
        let first = pixel as usize;
        // The sources lie within the image, so only an unseen pixel has none.
        let (Some([a, b]), Some([c, d])) = (pair(pixels, first), pair(pixels, first.wrapping_add(width))) else {
            return [0; 3];
        };
        let (right, down) = (u32::from(right), u32::from(down));
        let (left, up) = (FRACTION - right, FRACTION - down);
        std::array::from_fn(|i| {
            let upper = u32::from(a[i]) * left + u32::from(b[i]) * right;
            let lower = u32::from(c[i]) * left + u32::from(d[i]) * right;
            ((upper * up + lower * down + FRACTION * FRACTION / 2) / (FRACTION * FRACTION)) as u8
        })
    }
}

/// A pixel and the one to its right.
fn pair(pixels: &[[u8; 3]], at: usize) -> Option<[[u8; 3]; 2]> {
    pixels.get(at..)?.first_chunk().copied()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::intrinsics::IntrinsicParams;
    use crate::intrinsics::tests::PARAMS;

    fn view(image: &RgbImage) -> RgbView<'_> {
        RgbView::from_raw(image.width(), image.height(), image.as_raw().as_slice()).unwrap()
    }

    /// Blobs and edges of many directions.
    pub(super) fn pattern(width: u32, height: u32) -> RgbImage {
        RgbImage::from_fn(width, height, |x, y| {
            let (x, y) = (f64::from(x), f64::from(y));
            let wave = |a: f64, b: f64| (127.5 + 127.0 * (a * x + b * y).sin()) as u8;
            let check = if (x / 40.0) as u32 % 2 == (y / 40.0) as u32 % 2 { 230 } else { 20 };
            Rgb([wave(0.11, 0.03), check, wave(-0.02, 0.17)])
        })
    }

    #[test]
    fn an_ideal_lens_changes_nothing_and_the_buffer_is_kept() {
        let image = pattern(64, 48);
        let params = IntrinsicParams { width_px: 64, height_px: 48, cx_px: 31.0, cy_px: 23.0, ..PARAMS };
        let map = UndistortionMap::new(&Intrinsics::new(params).unwrap().without_distortion());
        let mut out = RgbImage::new(1, 1);
        map.apply(&view(&image), &mut out).unwrap();
        assert_eq!(out, image);
        let buffer = out.as_ptr();
        map.apply(&view(&image), &mut out).unwrap();
        assert_eq!(out.as_ptr(), buffer);
        assert_eq!(
            map.apply(&view(&pattern(48, 64)), &mut out).unwrap_err().to_string(),
            "the image has [48, 64] px, the camera [64, 48]: it was calibrated for another resolution"
        );
    }

    #[test]
    fn every_pixel_is_the_bilinear_mean_at_its_source_and_black_where_nothing_was_seen() {
        // A pincushion: the corners of the undistorted image lie outside of what the camera saw.
        let params = IntrinsicParams {
            width_px: 300,
            height_px: 200,
            cx_px: 149.0,
            cy_px: 99.0,
            fx_px: 300.0,
            fy_px: 310.0,
            k1: 0.2,
            ..PARAMS
        };
        let intrinsics = Intrinsics::new(params).unwrap();
        let image = pattern(300, 200);
        let mut out = RgbImage::new(300, 200);
        UndistortionMap::new(&intrinsics).apply(&view(&image), &mut out).unwrap();
        let mut unseen = 0;
        for (u, v, Rgb(colour)) in out.enumerate_pixels() {
            let at = intrinsics.distort_point([f64::from(u), f64::from(v)]).unwrap();
            if !intrinsics.contains(at) {
                assert_eq!(*colour, [0; 3], "({u}, {v})");
                unseen += 1;
                continue;
            }
            let (x, y) = (at[0].clamp(0.0, 299.0), at[1].clamp(0.0, 199.0));
            let (left, top) = ((x as u32).min(298), (y as u32).min(198));
            let (right, down) = (x - f64::from(left), y - f64::from(top));
            for (i, &found) in colour.iter().enumerate() {
                let at = |dx: u32, dy: u32| f64::from(image.get_pixel(left + dx, top + dy)[i]);
                let mean = (at(0, 0) * (1.0 - right) + at(1, 0) * right) * (1.0 - down)
                    + (at(0, 1) * (1.0 - right) + at(1, 1) * right) * down;
                // Half a 256th of a step of 255 levels in either direction, and the rounding.
                assert!((f64::from(found) - mean).abs() <= 1.5, "({u}, {v})[{i}]: {found} {mean}");
            }
        }
        assert!(unseen > 100, "{unseen}");
    }

    #[cfg(feature = "calibrate")]
    #[test]
    fn it_agrees_with_opencv() {
        use opencv::core::{BORDER_CONSTANT, CV_32FC1, Mat, Scalar, Size, Vec3b};
        use opencv::prelude::*;
        use opencv::{calib3d, imgproc};

        let intrinsics = Intrinsics::new(PARAMS).unwrap();
        let image = pattern(1078, 958);
        let mut ours = RgbImage::new(1078, 958);
        UndistortionMap::new(&intrinsics).apply(&view(&image), &mut ours).unwrap();

        let p = PARAMS;
        let matrix = Mat::from_slice_2d(&[[p.fx_px, 0.0, p.cx_px], [0.0, p.fy_px, p.cy_px], [0.0, 0.0, 1.0]]).unwrap();
        let lens = Mat::from_slice(&[p.k1, p.k2, p.p1, p.p2, p.k3]).unwrap().clone_pointee();
        let (mut map_x, mut map_y) = (Mat::default(), Mat::default());
        let size = Size::new(1078, 958);
        let turned = Mat::default();
        calib3d::init_undistort_rectify_map(&matrix, &lens, &turned, &matrix, size, CV_32FC1, &mut map_x, &mut map_y)
            .unwrap();
        let source = Mat::new_rows_cols_with_bytes::<Vec3b>(958, 1078, image.as_raw()).unwrap();
        let mut theirs = Mat::default();
        let black = Scalar::all(0.0);
        imgproc::remap(&source, &mut theirs, &map_x, &map_y, imgproc::INTER_LINEAR, BORDER_CONSTANT, black).unwrap();

        let (mut most, mut sum, mut count) = (0u32, 0u64, 0u64);
        for (u, v, Rgb(colour)) in ours.enumerate_pixels() {
            let x = *map_x.at_2d::<f32>(v as i32, u as i32).unwrap();
            let y = *map_y.at_2d::<f32>(v as i32, u as i32).unwrap();
            // At the border OpenCV mixes with black.
            if !(0.0..1077.0).contains(&x) || !(0.0..957.0).contains(&y) {
                continue;
            }
            let other = theirs.at_2d::<Vec3b>(v as i32, u as i32).unwrap();
            for (&a, &b) in colour.iter().zip(other.iter()) {
                most = most.max(u32::from(a.abs_diff(b)));
                sum += u64::from(a.abs_diff(b));
                count += 1;
            }
        }
        assert!(count > 2_900_000, "{count}");
        // OpenCV's fractions have 5 bits: half a 32nd of a step of 210 levels is 3.3, in each direction.
        assert!(most <= 7 && (sum as f64 / count as f64) < 0.2, "{most} {}", sum as f64 / count as f64);
    }
}
