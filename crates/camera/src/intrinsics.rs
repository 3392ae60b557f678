//! The inner geometry of a camera: from rays to pixels and back.

use serde::{Deserialize, Serialize};

use crate::lens::{LEAST_DETERMINANT, Lens};
use crate::projection::ProjectionError;

/// Longest side of an image, px; that of a frame in shared memory.
pub const MAX_SIDE_PX: u32 = 16_384;
/// How exactly a ray must lead back to its pixel, px.
const TOLERANCE_PX: f64 = 1e-8;
/// Steps from the optical axis to a pixel when its ray is followed.
const FOLLOW_STEPS: u32 = 24;
/// Points of each side of the image to which the lens is followed when it is checked.
const BORDER_POINTS: u32 = 16;
/// How far beyond the rays of the image the lens model is trusted: a polynomial says nothing outside of its data.
const REACH: f64 = 2.0;

/// The numbers of [`Intrinsics`], not yet checked. The key names are those of `camera.toml`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IntrinsicParams {
    /// Width of the image, px.
    pub width_px: u32,
    /// Height of the image, px.
    pub height_px: u32,
    /// Focal length along image x, px.
    pub fx_px: f64,
    /// Focal length along image y, px.
    pub fy_px: f64,
    /// Principal point, x; pixel centres are at integers.
    pub cx_px: f64,
    /// Principal point, y.
    pub cy_px: f64,
    /// Radial distortion, coefficient of r^2.
    pub k1: f64,
    /// Radial distortion, coefficient of r^4.
    pub k2: f64,
    /// Tangential distortion.
    pub p1: f64,
    /// Tangential distortion.
    pub p2: f64,
    /// Radial distortion, coefficient of r^6.
    pub k3: f64,
}

/// Focal lengths, principal point and lens of a camera, checked: every pixel of the image has exactly one ray.
///
/// A ray is (x, y) = (X/Z, Y/Z) in the axes of the camera (x right, y down, z forward). The lens model is OpenCV's
/// with five coefficients, and
///
/// ```text
/// u = fx x'' + cx        v = fy y'' + cy
/// ```
///
/// Pixel centres are at integers, so the image reaches from -0.5 to `width_px` - 0.5.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "IntrinsicParams", into = "IntrinsicParams")]
pub struct Intrinsics {
    params: IntrinsicParams,
    /// Rays longer than this are outside of the lens model.
    reach: f64,
}

/// Why numbers are no camera.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum IntrinsicsError {
    /// A value is out of range.
    #[error("{key} is {value}; allowed: {allowed}")]
    Value {
        /// The key.
        key: &'static str,
        /// Its value.
        value: f64,
        /// What is allowed.
        allowed: String,
    },
    /// The distortion gives some pixel of the image no ray, or two.
    #[error(
        "k1 = {k1}, k2 = {k2}, p1 = {p1}, p2 = {p2}, k3 = {k3} are not allowed: with them the lens turns back on itself \
         before pixel ({u:.1}, {v:.1}), whose ray cannot be told"
    )]
    Folds {
        /// Radial distortion.
        k1: f64,
        /// Radial distortion.
        k2: f64,
        /// Tangential distortion.
        p1: f64,
        /// Tangential distortion.
        p2: f64,
        /// Radial distortion.
        k3: f64,
        /// Column of the pixel.
        u: f64,
        /// Row of the pixel.
        v: f64,
    },
}

impl Intrinsics {
    /// Checks the numbers.
    ///
    /// # Errors
    /// A side that is not 2 to [`MAX_SIDE_PX`], a focal length that is not above 0, a principal point more than half an
    /// image away from the image, a number that is not finite, and a lens that is not invertible all over the image:
    /// the iteration with which OpenCV undistorts says nothing then and returns some pixel.
    pub fn new(params: IntrinsicParams) -> Result<Self, IntrinsicsError> {
        let (width, height) = (f64::from(params.width_px), f64::from(params.height_px));
        let within = |key, value: f64, least: f64, most: f64| {
            // NaN is in no range.
            if (least..=most).contains(&value) {
                return Ok(());
            }
            Err(IntrinsicsError::Value { key, value, allowed: format!("{least} to {most}") })
        };
        within("width_px", width, 2.0, f64::from(MAX_SIDE_PX))?;
        within("height_px", height, 2.0, f64::from(MAX_SIDE_PX))?;
        within("fx_px", params.fx_px, 1.0, 1e9)?;
        within("fy_px", params.fy_px, 1.0, 1e9)?;
        within("cx_px", params.cx_px, -0.5 * width, 1.5 * width)?;
        within("cy_px", params.cy_px, -0.5 * height, 1.5 * height)?;
        for (key, value) in
            [("k1", params.k1), ("k2", params.k2), ("p1", params.p1), ("p2", params.p2), ("k3", params.k3)]
        {
            if !value.is_finite() {
                return Err(IntrinsicsError::Value { key, value, allowed: "a finite number".to_owned() });
            }
        }
        let unchecked = Self { params, reach: f64::INFINITY };
        let reach = if unchecked.lens().is_ideal() { f64::INFINITY } else { unchecked.reach()? };
        Ok(Self { params, reach })
    }

    /// The numbers.
    pub fn params(&self) -> &IntrinsicParams {
        &self.params
    }

    /// Width and height of the image, px.
    pub fn size_px(&self) -> [u32; 2] {
        [self.params.width_px, self.params.height_px]
    }

    /// The length of the longest ray (X/Z, Y/Z) that the lens model speaks of; infinite for an ideal lens.
    pub fn longest_ray(&self) -> f64 {
        self.reach
    }

    /// The same camera with an ideal lens: that of an undistorted image.
    pub fn without_distortion(&self) -> Self {
        let params = IntrinsicParams { k1: 0.0, k2: 0.0, p1: 0.0, p2: 0.0, k3: 0.0, ..self.params };
        Self { params, reach: f64::INFINITY }
    }

    /// Whether a pixel position lies in the image, to the outer edges of its outermost pixels.
    pub fn contains(&self, [u, v]: [f64; 2]) -> bool {
        let inside = |at: f64, side: u32| (-0.5..=f64::from(side) - 0.5).contains(&at);
        inside(u, self.params.width_px) && inside(v, self.params.height_px)
    }

    /// The ray (X/Z, Y/Z) of a pixel, which may lie outside the image.
    ///
    /// # Errors
    /// [`ProjectionError::NotFinite`], and [`ProjectionError::OutsideLens`] for a pixel that no ray of the lens model
    /// reaches; inside the image there is none.
    pub fn ray_from_image(&self, [u, v]: [f64; 2]) -> Result<[f64; 2], ProjectionError> {
        let p = &self.params;
        if !(u.is_finite() && v.is_finite()) {
            return Err(ProjectionError::NotFinite { what: "pixel", values: vec![u, v] });
        }
        let target = [(u - p.cx_px) / p.fx_px, (v - p.cy_px) / p.fy_px];
        let lens = self.lens();
        if lens.is_ideal() {
            return Ok(target);
        }
        let within_reach = |ray: &[f64; 2]| ray[0].hypot(ray[1]) <= self.reach;
        let direct = lens.undistort_from(target, target, self.tolerance()).filter(within_reach);
        direct
            .or_else(|| lens.follow(target, FOLLOW_STEPS, self.tolerance(), |_| {}).filter(within_reach))
            .ok_or(ProjectionError::OutsideLens { what: "pixel", values: [u, v] })
    }

    /// The pixel of a ray (X/Z, Y/Z); it may lie outside the image.
    ///
    /// # Errors
    /// [`ProjectionError::NotFinite`], and [`ProjectionError::OutsideLens`] for a ray so far out that the polynomial
    /// of the lens says nothing about it: it would come back into the image.
    pub fn image_from_ray(&self, ray: [f64; 2]) -> Result<[f64; 2], ProjectionError> {
        if !(ray[0].is_finite() && ray[1].is_finite()) {
            return Err(ProjectionError::NotFinite { what: "ray", values: ray.to_vec() });
        }
        if ray[0].hypot(ray[1]) > self.reach {
            return Err(ProjectionError::OutsideLens { what: "ray", values: ray });
        }
        let [x, y] = self.lens().distort(ray);
        Ok([self.params.fx_px * x + self.params.cx_px, self.params.fy_px * y + self.params.cy_px])
    }

    /// Where a pixel of the camera image lies in the undistorted image, which has the same focal lengths and
    /// principal point.
    ///
    /// # Errors
    /// Those of [`Self::ray_from_image`].
    pub fn undistort_point(&self, pixel: [f64; 2]) -> Result<[f64; 2], ProjectionError> {
        let [x, y] = self.ray_from_image(pixel)?;
        Ok([self.params.fx_px * x + self.params.cx_px, self.params.fy_px * y + self.params.cy_px])
    }

    /// Where a pixel of the undistorted image lies in the camera image; the inverse of [`Self::undistort_point`].
    ///
    /// # Errors
    /// Those of [`Self::image_from_ray`].
    pub fn distort_point(&self, [u, v]: [f64; 2]) -> Result<[f64; 2], ProjectionError> {
        let p = &self.params;
        self.image_from_ray([(u - p.cx_px) / p.fx_px, (v - p.cy_px) / p.fy_px])
    }

    fn lens(&self) -> Lens {
        let IntrinsicParams { k1, k2, p1, p2, k3, .. } = self.params;
        Lens { k1, k2, p1, p2, k3 }
    }

    /// [`TOLERANCE_PX`] on the normalised plane.
    fn tolerance(&self) -> f64 {
        TOLERANCE_PX / self.params.fx_px.max(self.params.fy_px)
    }

    /// Follows the lens from the axis to the border of the image, which passes every pixel, and then outwards to the
    /// first fold.
    fn reach(&self) -> Result<f64, IntrinsicsError> {
        let p = &self.params;
        let lens = self.lens();
        let (right, bottom) = (f64::from(p.width_px) - 0.5, f64::from(p.height_px) - 0.5);
        let mut longest = 0.0f64;
        for i in 0..=BORDER_POINTS {
            let share = f64::from(i) / f64::from(BORDER_POINTS);
            let (u, v) = (-0.5 + share * (right + 0.5), -0.5 + share * (bottom + 0.5));
            for [u, v] in [[u, -0.5], [u, bottom], [-0.5, v], [right, v]] {
                let target = [(u - p.cx_px) / p.fx_px, (v - p.cy_px) / p.fy_px];
                let visit = |ray: [f64; 2]| longest = longest.max(ray[0].hypot(ray[1]));
                if lens.follow(target, FOLLOW_STEPS, self.tolerance(), visit).is_none() {
                    let IntrinsicParams { k1, k2, p1, p2, k3, .. } = *p;
                    return Err(IntrinsicsError::Folds { k1, k2, p1, p2, k3, u, v });
                }
            }
        }
        const DIRECTIONS: u32 = 64;
        const STEPS: u32 = 256;
        let folds = |radius: f64| {
            (0..DIRECTIONS).any(|i| {
                let angle = std::f64::consts::TAU * f64::from(i) / f64::from(DIRECTIONS);
                let determinant = lens.determinant([radius * angle.cos(), radius * angle.sin()]);
                // Far out it may not be a number, which counts as a fold.
                determinant.is_nan() || determinant <= LEAST_DETERMINANT
            })
        };
        let first_fold = (0..=STEPS)
            .map(|i| longest * (1.0 + (REACH - 1.0) * f64::from(i) / f64::from(STEPS)))
            .take_while(|&radius| !folds(radius))
            .last();
        Ok(first_fold.unwrap_or(longest))
    }
}

impl TryFrom<IntrinsicParams> for Intrinsics {
    type Error = IntrinsicsError;

    fn try_from(params: IntrinsicParams) -> Result<Self, IntrinsicsError> {
        Self::new(params)
    }
}

impl From<Intrinsics> for IntrinsicParams {
    fn from(intrinsics: Intrinsics) -> Self {
        intrinsics.params
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A lens with every coefficient.
    pub(crate) const PARAMS: IntrinsicParams = IntrinsicParams {
        width_px: 1078,
        height_px: 958,
        fx_px: 1600.0,
        fy_px: 1590.0,
        cx_px: 541.2,
        cy_px: 476.6,
        k1: -0.118,
        k2: 0.094,
        p1: 0.0007,
        p2: -0.0004,
        k3: -0.01,
    };

    #[test]
    fn one_point_worked_out_by_hand() {
        // x = 0.2, y = -0.1, r^2 = 0.05, R = 1 - 0.0059 + 0.000235 - 0.00000125 = 0.99433375.
        let [u, v] = Intrinsics::new(PARAMS).unwrap().image_from_ray([0.2, -0.1]).unwrap();
        let x = 0.2 * 0.994_333_75 + 2.0 * 0.0007 * -0.02 + -0.0004 * (0.05 + 0.08);
        let y = -0.1 * 0.994_333_75 + 0.0007 * (0.05 + 0.02) + 2.0 * -0.0004 * -0.02;
        assert!((u - (1600.0 * x + 541.2)).abs() < 1e-9 && (v - (1590.0 * y + 476.6)).abs() < 1e-9, "{u} {v}");
    }

    #[test]
    fn refusals_name_the_key_the_value_and_what_is_allowed() {
        for (params, message) in [
            (IntrinsicParams { width_px: 1, ..PARAMS }, "width_px is 1; allowed: 2 to 16384"),
            (IntrinsicParams { height_px: 20_000, ..PARAMS }, "height_px is 20000; allowed: 2 to 16384"),
            (IntrinsicParams { fx_px: 0.0, ..PARAMS }, "fx_px is 0; allowed: 1 to 1000000000"),
            (IntrinsicParams { fy_px: -1600.0, ..PARAMS }, "fy_px is -1600; allowed: 1"),
            (IntrinsicParams { fy_px: f64::NAN, ..PARAMS }, "fy_px is NaN"),
            (IntrinsicParams { cx_px: 5000.0, ..PARAMS }, "cx_px is 5000; allowed: -539 to 1617"),
            (IntrinsicParams { cy_px: f64::INFINITY, ..PARAMS }, "cy_px is inf"),
            (IntrinsicParams { k2: f64::NAN, ..PARAMS }, "k2 is NaN; allowed: a finite number"),
            // r (1 - 8 r^2) turns back at r = 0.2; the corners of the image lie at 0.43.
            (IntrinsicParams { k1: -8.0, ..PARAMS }, "k1 = -8"),
            (IntrinsicParams { k3: -900.0, ..PARAMS }, "turns back on itself before pixel"),
            (IntrinsicParams { p1: 9.0, ..PARAMS }, "p1 = 9"),
        ] {
            let refusal = Intrinsics::new(params).unwrap_err().to_string();
            assert!(refusal.contains(message), "{refusal}");
        }
        let toml = toml::to_string(&PARAMS).unwrap().replace("1600.0", "-2.0");
        let refusal = toml::from_str::<Intrinsics>(&toml).unwrap_err().to_string();
        assert!(refusal.contains("fx_px is -2; allowed: 1 to"), "{refusal}");
    }

    #[test]
    fn a_ray_far_outside_does_not_come_back_into_the_image() {
        let intrinsics = Intrinsics::new(IntrinsicParams { k1: -0.4, k2: 0.0, k3: 0.0, ..PARAMS }).unwrap();
        // The fold is at r = 0.91; x (1 - 0.4 x^2) at 1.5 is 0.15: a pixel near the centre.
        let refusal = intrinsics.image_from_ray([1.5, 0.0]).unwrap_err();
        assert!(matches!(refusal, ProjectionError::OutsideLens { what: "ray", .. }), "{refusal}");
        let refusal = intrinsics.ray_from_image([1e5, 0.0]).unwrap_err();
        assert!(matches!(refusal, ProjectionError::OutsideLens { what: "pixel", .. }), "{refusal}");
        // An ideal lens has no such limit.
        let [u, _] = intrinsics.without_distortion().image_from_ray([1.5, 0.0]).unwrap();
        assert!((u - 2941.2).abs() < 1e-9);
        for pixel in [[f64::NAN, 0.0], [0.0, f64::INFINITY]] {
            assert!(matches!(intrinsics.ray_from_image(pixel), Err(ProjectionError::NotFinite { .. })));
        }
    }

    proptest! {
        /// From strong barrel to strong pincushion: either refused, or exact all over the image and a little beyond.
        #[test]
        fn a_pixel_comes_back_from_its_ray(
            k1 in -0.9f64..0.9, k2 in -0.5f64..0.5, k3 in -0.5f64..0.5, p1 in -0.01f64..0.01, p2 in -0.01f64..0.01,
            focal in 500.0f64..4000.0, u in 0.0f64..=1.0, v in 0.0f64..=1.0,
        ) {
            let params = IntrinsicParams { fx_px: focal, fy_px: focal * 1.02, k1, k2, p1, p2, k3, ..PARAMS };
            if let Ok(intrinsics) = Intrinsics::new(params) {
                let pixel = [-0.5 + u * 1078.0, -0.5 + v * 958.0];
                let ideal = intrinsics.undistort_point(pixel).unwrap();
                let back = intrinsics.distort_point(ideal).unwrap();
                prop_assert!((back[0] - pixel[0]).hypot(back[1] - pixel[1]) < 1e-7, "{pixel:?} {back:?}");
                let again = intrinsics.undistort_point(back).unwrap();
                prop_assert!((again[0] - ideal[0]).hypot(again[1] - ideal[1]) < 1e-6, "{ideal:?} {again:?}");
            } else {
                // A mild lens is never refused.
                prop_assert!(k1.abs() + k2.abs() + k3.abs() > 0.3 || focal < 1500.0);
            }
        }

        #[test]
        fn every_pixel_of_an_ordinary_lens_comes_back(u in -0.5f64..1077.5, v in -0.5f64..957.5) {
            let intrinsics = Intrinsics::new(PARAMS).unwrap();
            let back = intrinsics.distort_point(intrinsics.undistort_point([u, v]).unwrap()).unwrap();
            prop_assert!((back[0] - u).hypot(back[1] - v) < 1e-9);
        }
    }
}
