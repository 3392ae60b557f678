//! Names on pictures: text, and arrows along the x axis of a part.
//!
//! Text is drawn with the 8 x 8 dots of the IBM PC, which are public domain and legible at any whole scale. A name may hold
//! any letters: those that the font lacks become a question mark.

use font8x8::{BASIC_FONTS, GREEK_FONTS, LATIN_FONTS, UnicodeFonts};
use image::{Rgb, RgbImage};
use samsod::recognize::Detection;

/// Side of a letter, dots.
const LETTER: u32 = 8;
/// Length of an arrow, as a share of the diagonal of the part's box, and of its head, as a share of the arrow.
const ARROW_SHARE: f64 = 0.4;
const HEAD_SHARE: f64 = 0.3;
/// How many half lines a text is moved at most.
const MOVES: u32 = 12;
/// Angle between the sides of the head and the shaft, rad.
const HEAD_ANGLE_RAD: f64 = 0.45;

/// What is written beside a detection: name and angle, of something unknown that it is unknown.
pub fn short(name: Option<&str>, angle_deg: f64) -> String {
    match name {
        // Rounded before it is printed: there is no -0.
        Some(name) => format!("{name} {}\u{b0}", angle_deg.round() as i64),
        None => "unknown".to_owned(),
    }
}

/// [`short`] with the score.
pub fn with_score(detection: &Detection) -> String {
    let (score, angle_deg) = (detection.score, detection.image.angle_rad.to_degrees());
    match &detection.name {
        Some(name) => format!("{name} {score:.2}, {}\u{b0}", angle_deg.round() as i64),
        None => format!("unknown {score:.2}"),
    }
}

/// An arrow from the origin of a part along its x axis; of something unknown a line along its longest axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Arrow {
    /// Where it begins, of a line its middle, px.
    pub from_px: [f64; 2],
    /// Counter-clockwise on the screen from image right, rad.
    pub angle_rad: f64,
    /// px.
    pub length_px: f64,
    /// Whether it has a head.
    pub is_directed: bool,
}

impl Arrow {
    /// That of a detection.
    pub fn of(detection: &Detection) -> Self {
        let bbox = detection.mask.bbox();
        Self {
            from_px: detection.image.origin_px,
            angle_rad: detection.image.angle_rad,
            length_px: ARROW_SHARE * f64::from(bbox.width).hypot(f64::from(bbox.height)),
            is_directed: detection.name.is_some(),
        }
    }

    /// Its lines, from end to end, px.
    pub fn lines(&self) -> Vec<[[f64; 2]; 2]> {
        let [x, y] = self.from_px;
        // Rows run downwards.
        let away = |from: [f64; 2], angle_rad: f64, length: f64| {
            [from[0] + length * angle_rad.cos(), from[1] - length * angle_rad.sin()]
        };
        if !self.is_directed {
            let half = self.length_px / 2.0;
            return vec![[away([x, y], self.angle_rad, -half), away([x, y], self.angle_rad, half)]];
        }
        let tip = away([x, y], self.angle_rad, self.length_px);
        let side = |sign: f64| away(tip, self.angle_rad + sign * HEAD_ANGLE_RAD, -HEAD_SHARE * self.length_px);
        vec![[[x, y], tip], [tip, side(1.0)], [tip, side(-1.0)]]
    }
}

/// Draws a line `thickness` pixels wide. What lies outside the picture is left out.
pub fn draw_line(picture: &mut RgbImage, [from, to]: [[f64; 2]; 2], colour: Rgb<u8>, thickness: u32) {
    let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
    // A line that is longer than a picture can be comes from a broken file.
    let steps = dx.abs().max(dy.abs()).ceil().clamp(1.0, 65_536.0);
    if !(steps.is_finite() && from.iter().all(|c| c.is_finite())) {
        return;
    }
    let half = f64::from(thickness) / 2.0;
    for step in 0..=steps as u32 {
        let share = f64::from(step) / steps;
        let (left, top) = ((from[0] + dx * share - half).round(), (from[1] + dy * share - half).round());
        for (x, y) in (0..thickness).flat_map(|y| (0..thickness).map(move |x| (x, y))) {
            let (x, y) = (left + f64::from(x), top + f64::from(y));
            if x >= 0.0
                && y >= 0.0
                && let Some(pixel) = picture.get_pixel_mut_checked(x as u32, y as u32)
            {
                *pixel = colour;
            }
        }
    }
}

/// Lines of text on one picture. Each is written beside those before it, not over them.
#[derive(Debug, Default)]
pub struct Captions {
    /// Left, top, right and bottom end of each field, px.
    taken: Vec<[u32; 4]>,
}

impl Captions {
    /// Writes a line of text centred at (x, y) in a colour on a black field, `scale` pixels a dot. It is moved so that it
    /// lies in the picture if it fits, and up or down to the nearest free place; where there is none it stays.
    pub fn draw(&mut self, picture: &mut RgbImage, text: &str, [x, y]: [f64; 2], colour: Rgb<u8>, scale: u32) {
        let letters: Vec<[u8; 8]> = text.chars().map(letter).collect();
        // One dot of margin on every side.
        let (width, height) = ((letters.len() as u32 * LETTER + 2) * scale, (LETTER + 2) * scale);
        let start = |middle: f64, length: u32, side: u32| {
            // NaN and negative numbers become 0.
            ((middle - f64::from(length) / 2.0).round() as u32).min(side.saturating_sub(length))
        };
        let left = start(x, width, picture.width());
        let field = |y: f64| {
            let top = start(y, height, picture.height());
            [left, top, left + width, top + height]
        };
        let is_free = |[left, top, right, bottom]: &[u32; 4]| {
            let meets =
                |other: &[u32; 4]| *left < other[2] && other[0] < *right && *top < other[3] && other[1] < *bottom;
            !self.taken.iter().any(meets)
        };
        // By half a line, first the nearest.
        let step = f64::from(height) / 2.0;
        let moved = (0..=MOVES).flat_map(|k| [y - step * f64::from(k), y + step * f64::from(k)]);
        let place = moved.map(field).find(is_free).unwrap_or_else(|| field(y));
        draw_letters(picture, &letters, place, colour, scale);
        self.taken.push(place);
    }
}

/// Draws letters into a field.
fn draw_letters(picture: &mut RgbImage, letters: &[[u8; 8]], field: [u32; 4], colour: Rgb<u8>, scale: u32) {
    let [left, top, right, bottom] = field;
    let (width, height) = (right - left, bottom - top);
    for row in 0..height {
        for column in 0..width {
            let (dot_x, dot_y) = ((column / scale).checked_sub(1), (row / scale).checked_sub(1));
            let lit = dot_x.zip(dot_y).is_some_and(|(dot_x, dot_y)| {
                let line = letters.get((dot_x / LETTER) as usize).and_then(|letter| letter.get(dot_y as usize));
                // The lowest bit is the leftmost dot.
                line.is_some_and(|line| line >> (dot_x % LETTER) & 1 == 1)
            });
            if let Some(pixel) = picture.get_pixel_mut_checked(left + column, top + row) {
                *pixel = if lit { colour } else { Rgb([0; 3]) };
            }
        }
    }
}

fn letter(c: char) -> [u8; 8] {
    let known = BASIC_FONTS.get(c).or_else(|| LATIN_FONTS.get(c)).or_else(|| GREEK_FONTS.get(c));
    known.or_else(|| BASIC_FONTS.get('?')).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows(picture: &RgbImage) -> Vec<String> {
        let dot = |p: &Rgb<u8>| match p[0] {
            255 => '#',
            0 => '.',
            _ => ' ',
        };
        picture.rows().map(|row| row.map(dot).collect()).collect()
    }

    #[test]
    fn a_name_and_an_angle_can_be_read() {
        let mut picture = RgbImage::from_pixel(28, 12, Rgb([9; 3]));
        Captions::default().draw(&mut picture, "L7\u{b0}", [14.0, 6.0], Rgb([255; 3]), 1);
        let rows = rows(&picture);
        assert_eq!(rows[2], " .####....######....###.... ");
        assert_eq!(rows[5], " ..##........##.....###.... ");
    }

    #[test]
    fn text_stays_in_the_picture_and_no_letter_is_lost() {
        let mut picture = RgbImage::from_pixel(40, 12, Rgb([9; 3]));
        let mut captions = Captions::default();
        captions.draw(&mut picture, "nut", [0.0, 300.0], Rgb([255; 3]), 1);
        let rows = rows(&picture);
        assert!(rows[11].starts_with("........") && rows[11].ends_with("   "), "{rows:#?}");
        for text in ["\u{4e00}", "\u{e4}\u{3c9}", ""] {
            captions.draw(&mut picture, text, [f64::NAN, -5.0], Rgb([255; 3]), 3);
        }
        assert_eq!(letter('\u{4e00}'), letter('?'), "a letter that the font lacks");
        assert!(letter('\u{e4}') != letter('?') && letter('\u{3c9}') != letter('?'));
    }

    #[test]
    fn no_text_covers_another_while_there_is_room() {
        let (mut picture, mut captions) = (RgbImage::from_pixel(60, 60, Rgb([9; 3])), Captions::default());
        let black = |picture: &RgbImage| picture.pixels().filter(|p| p[0] != 9).count();
        for count in 1..=4 {
            captions.draw(&mut picture, "nut", [30.0, 30.0], Rgb([255; 3]), 1);
            assert_eq!(black(&picture), count * 26 * 10);
        }
        // Beside the others nothing is moved.
        captions.draw(&mut picture, "a", [5.0, 30.0], Rgb([255; 3]), 1);
        assert_eq!(captions.taken.last(), Some(&[0, 25, 10, 35]));
        for _ in 0..9 {
            captions.draw(&mut picture, "nut", [30.0, 30.0], Rgb([255; 3]), 1);
        }
        assert!(captions.taken.iter().all(|[_, _, right, bottom]| *right <= 60 && *bottom <= 60));
    }

    #[test]
    fn names_are_short_and_zero_has_no_sign() {
        assert_eq!(short(Some("hex_nut"), -0.4), "hex_nut 0\u{b0}");
        assert_eq!(short(Some("hex_nut"), 179.6), "hex_nut 180\u{b0}");
        assert_eq!(short(None, 12.0), "unknown");
    }

    #[test]
    fn an_arrow_points_along_its_angle_and_lines_are_clipped() {
        let mut picture = RgbImage::from_pixel(21, 21, Rgb([9; 3]));
        let arrow = Arrow { from_px: [10.0, 10.0], angle_rad: 0.0, length_px: 8.0, is_directed: true };
        for line in arrow.lines() {
            draw_line(&mut picture, line, Rgb([255; 3]), 1);
        }
        let rows = rows(&picture);
        assert!(rows[10].contains("#########") && rows[9].contains('#') && rows[11].contains('#'), "{rows:#?}");
        assert!(rows.iter().all(|row| row.starts_with("         ")), "nothing behind it: {rows:#?}");
        for end in [1e9, -1e9, f64::NAN, f64::INFINITY] {
            draw_line(&mut picture, [[3.0, 3.0], [end, end]], Rgb([255; 3]), 2);
        }
    }
}
