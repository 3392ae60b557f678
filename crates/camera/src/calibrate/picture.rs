//! Pictures of a calibration: its residuals over the image plane, and the numbers of a board's corners.
//!
//! In: views with their poses. Out: packed RGB images. OpenCV draws: it brings lines and letters without a font file.

use image::RgbImage;
use opencv::core::{Mat, Point, Scalar, Vec3b};
use opencv::imgproc;

use super::CalibrateError;
use super::board::Board;
use super::find::View;
use super::solve::Calibration;

/// Width of the image plane in the picture, px.
const PLANE_WIDTH: f64 = 1400.0;
const MARGIN: i32 = 70;
/// Room for the names of the images.
const LEGEND_WIDTH: i32 = 400;
/// How long the arrow of a large residual should be, px of the picture.
const ARROW: f64 = 45.0;
const INK: Scalar = Scalar::from_array([20.0, 20.0, 20.0, 0.0]);
const GRID: Scalar = Scalar::from_array([222.0, 222.0, 222.0, 0.0]);
/// Bits of the fraction of coordinates that OpenCV is given.
const SHIFT: i32 = 4;

/// A picture that OpenCV draws on.
struct Canvas {
    picture: RgbImage,
}

impl Canvas {
    fn draw(
        &mut self,
        draw: impl FnOnce(&mut opencv::boxed_ref::BoxedRefMut<'_, Mat>) -> opencv::Result<()>,
    ) -> opencv::Result<()> {
        let (width, height) = self.picture.dimensions();
        let pixels: &mut [u8] = self.picture.as_flat_samples_mut().samples;
        draw(&mut Mat::new_rows_cols_with_bytes_mut::<Vec3b>(height as i32, width as i32, pixels)?)
    }

    fn line(&mut self, from: [f64; 2], to: [f64; 2], colour: Scalar, thickness: i32) -> opencv::Result<()> {
        let (from, to) = (fixed(from), fixed(to));
        self.draw(|mat| imgproc::line(mat, from, to, colour, thickness, imgproc::LINE_AA, SHIFT))
    }

    fn arrow(&mut self, from: [f64; 2], to: [f64; 2], colour: Scalar) -> opencv::Result<()> {
        self.line(from, to, colour, 1)?;
        let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
        let length = dx.hypot(dy);
        let head = (0.35 * length).min(9.0);
        if length > 0.0 {
            let (x, y) = (dx / length * head, dy / length * head);
            for side in [-0.45, 0.45] {
                self.line(to, [to[0] - x + side * y, to[1] - y - side * x], colour, 1)?;
            }
        }
        Ok(())
    }

    fn dot(&mut self, at: [f64; 2], radius: f64, colour: Scalar) -> opencv::Result<()> {
        let radius = (radius * f64::from(1 << SHIFT)) as i32;
        self.draw(|mat| imgproc::circle(mat, fixed(at), radius, colour, imgproc::FILLED, imgproc::LINE_AA, SHIFT))
    }

    fn text(&mut self, text: &str, [x, y]: [i32; 2], scale: f64, colour: Scalar, thickness: i32) -> opencv::Result<()> {
        // The letters of OpenCV are ASCII.
        let text: String = text.chars().map(|c| if c.is_ascii_graphic() || c == ' ' { c } else { '?' }).collect();
        let (font, at) = (imgproc::FONT_HERSHEY_SIMPLEX, Point::new(x, y));
        self.draw(|mat| imgproc::put_text(mat, &text, at, font, scale, colour, thickness, imgproc::LINE_AA, false))
    }
}

/// The residual of every corner as an arrow from its place in the image, enlarged by a factor that the caption states;
/// one colour an image, with its mean error beside it.
///
/// # Errors
/// [`CalibrateError::OpenCv`].
pub fn residual_picture(views: &[View], calibration: &Calibration) -> Result<RgbImage, CalibrateError> {
    let [width_px, height_px] = calibration.intrinsics.size_px().map(f64::from);
    let scale = PLANE_WIDTH / width_px;
    let plane = [PLANE_WIDTH, height_px * scale];
    let line_height = 26;
    let legend_height = (views.len() as i32 + 4) * line_height;
    let size = [PLANE_WIDTH as i32 + MARGIN + LEGEND_WIDTH, (plane[1] as i32).max(legend_height) + 2 * MARGIN + 40];
    let mut canvas = Canvas { picture: RgbImage::from_pixel(size[0] as u32, size[1] as u32, image::Rgb([252; 3])) };
    // Pixel (0, 0) is half a pixel inside the plane.
    let place = |px: [f64; 2]| px.map(|c| f64::from(MARGIN) + (c + 0.5) * scale);

    let (right, bottom) = (f64::from(MARGIN) + plane[0], f64::from(MARGIN) + plane[1]);
    for i in 1..=(width_px / 200.0) as i32 {
        let [x, _] = place([f64::from(i) * 200.0, 0.0]);
        canvas.line([x, f64::from(MARGIN)], [x, bottom], GRID, 1)?;
        canvas.text(&format!("{}", i * 200), [x as i32 - 18, bottom as i32 + 22], 0.5, INK, 1)?;
    }
    for i in 1..=(height_px / 200.0) as i32 {
        let [_, y] = place([0.0, f64::from(i) * 200.0]);
        canvas.line([f64::from(MARGIN), y], [right, y], GRID, 1)?;
        canvas.text(&format!("{:>4}", i * 200), [MARGIN - 48, y as i32 + 5], 0.5, INK, 1)?;
    }
    let frame = [[f64::from(MARGIN); 2], [right, f64::from(MARGIN)], [right, bottom], [f64::from(MARGIN), bottom]];
    for i in 0..4 {
        canvas.line(frame[i], frame[(i + 1) % 4], INK, 1)?;
    }

    let factor = factor(calibration, scale);
    for (index, (view, pose)) in views.iter().zip(&calibration.views).enumerate() {
        let ink = colour(index, views.len());
        for (corner, residual) in view.corners.iter().zip(&pose.residuals_px) {
            let from = place(corner.px);
            let to = [0, 1].map(|i| from[i] + residual[i] * factor * scale);
            canvas.dot(from, 1.6, ink)?;
            canvas.arrow(from, to, ink)?;
        }
    }

    let left = right as i32 + 30;
    canvas.text("image", [left + 34, MARGIN + 10], 0.55, INK, 1)?;
    canvas.text("mean px", [left + 245, MARGIN + 10], 0.55, INK, 1)?;
    for (index, (view, pose)) in views.iter().zip(&calibration.views).enumerate() {
        let y = MARGIN + 10 + (index as i32 + 1) * line_height;
        let ink = colour(index, views.len());
        canvas.line([f64::from(left), f64::from(y - 5)], [f64::from(left + 24), f64::from(y - 5)], ink, 4)?;
        canvas.text(&shortened(&view.path), [left + 34, y], 0.55, INK, 1)?;
        canvas.text(&format!("{:.3}", pose.mean_error_px), [left + 255, y], 0.55, INK, 1)?;
    }

    let corners: usize = views.iter().map(|view| view.corners.len()).sum();
    let caption = format!(
        "Corner found less corner computed, arrows enlarged {factor} times. {corners} corners in {} images, mean {:.3} px",
        views.len(),
        calibration.mean_error_px
    );
    canvas.text(&caption, [MARGIN, 40], 0.75, INK, 1)?;
    let bar_px = bar(factor, scale);
    let (y, start) = (bottom + 62.0, f64::from(MARGIN));
    let end = start + bar_px * factor * scale;
    canvas.line([start, y], [end, y], INK, 2)?;
    for x in [start, end] {
        canvas.line([x, y - 7.0], [x, y + 7.0], INK, 2)?;
    }
    let note = format!("= {bar_px} px of residual; axes in px of the image");
    canvas.text(&note, [end as i32 + 12, y as i32 + 6], 0.6, INK, 1)?;
    Ok(canvas.picture)
}

/// The image with every corner of the board and its number, and the axes of the world that a board on the table sets:
/// x red, y green, origin in corner 0.
///
/// # Errors
/// [`CalibrateError::Read`], [`CalibrateError::NoImage`], [`CalibrateError::OpenCv`].
pub fn corner_picture(view: &View, board: &Board) -> Result<RgbImage, CalibrateError> {
    let bytes = std::fs::read(&view.path).map_err(|source| CalibrateError::Read { path: view.path.clone(), source })?;
    let image = image::load_from_memory(&bytes);
    let picture = image.map_err(|source| CalibrateError::NoImage { path: view.path.clone(), source })?.into_rgb8();
    let mut canvas = Canvas { picture };
    let at = |index: u32| view.corners.iter().find(|corner| corner.index == index).map(|corner| corner.px);
    let size = f64::from(view.size_px[0]) / 1100.0;
    let thick = size.ceil() as i32;
    let axes = [(2, [230.0, 30.0, 30.0, 0.0], "x"), (2 * board.columns(), [20.0, 170.0, 40.0, 0.0], "y")];
    for (end, ink, name) in axes {
        if let (Some(origin), Some(end)) = (at(0), at(end)) {
            let ink = Scalar::from_array(ink);
            canvas.line(origin, end, ink, 3 * thick)?;
            canvas.text(name, [0, 1].map(|i| (end[i] + 8.0 * size) as i32), 1.2 * size, ink, 2 * thick)?;
        }
    }
    let (yellow, black) = (Scalar::from_array([255.0, 235.0, 60.0, 0.0]), Scalar::all(0.0));
    for corner in &view.corners {
        canvas.dot(corner.px, 2.5 * size, yellow)?;
        let [x, y] = [corner.px[0] + 4.0 * size, corner.px[1] - 4.0 * size].map(|c| c as i32);
        for (ink, thickness) in [(black, 3 * thick), (yellow, thick)] {
            canvas.text(&corner.index.to_string(), [x, y], 0.42 * size, ink, thickness)?;
        }
    }
    Ok(canvas.picture)
}

/// A round factor with which nineteen of twenty arrows are at most [`ARROW`] long.
fn factor(calibration: &Calibration, scale: f64) -> f64 {
    let mut lengths: Vec<f64> =
        calibration.views.iter().flat_map(|pose| &pose.residuals_px).map(|r| r[0].hypot(r[1])).collect();
    lengths.sort_by(f64::total_cmp);
    let large = lengths.get(lengths.len() * 19 / 20).copied().unwrap_or(1.0).max(1e-6);
    round_below(ARROW / (large * scale)).max(1.0)
}

/// A round length of a residual, px, whose bar is 100 px to 250 px long.
fn bar(factor: f64, scale: f64) -> f64 {
    round_below(250.0 / (factor * scale))
}

/// The largest of 1, 2 and 5 times a power of ten that is not above `value`.
fn round_below(value: f64) -> f64 {
    let decade = 10f64.powi(value.log10().floor() as i32);
    let step = [5.0, 2.0].into_iter().find(|step| step * decade <= value).unwrap_or(1.0);
    // Powers of ten below one have rounding errors that would show in the caption.
    if decade < 1.0 { step / (1.0 / decade).round() } else { step * decade }
}

/// Colours that differ as far as so many can: hues in turn, every other one dark.
fn colour(index: usize, count: usize) -> Scalar {
    let hue = 6.0 * index as f64 / count.max(1) as f64;
    let level = if index.is_multiple_of(2) { 215.0 } else { 140.0 };
    let channel = |offset: f64| {
        let distance = (hue + offset).rem_euclid(6.0);
        level * (2.0 - (distance - 3.0).abs()).clamp(0.0, 1.0).mul_add(-1.0, 1.0)
    };
    Scalar::from_array([channel(0.0), channel(4.0), channel(2.0), 0.0])
}

/// The name of a file, from its end if it is long.
fn shortened(path: &std::path::Path) -> String {
    const MOST: usize = 18;
    let name: Vec<char> = path.file_name().unwrap_or_default().to_string_lossy().chars().collect();
    if name.len() <= MOST {
        return name.into_iter().collect();
    }
    std::iter::repeat_n('.', 2).chain(name[name.len() + 2 - MOST..].iter().copied()).collect()
}

fn fixed(at: [f64; 2]) -> Point {
    let [x, y] = at.map(|c| (c * f64::from(1 << SHIFT)).round() as i32);
    Point::new(x, y)
}
