//! Pictures of what the vision chain saw: outlines, partitions, saliency, contact sheets.
//!
//! In: images, label images (one label a pixel, row by row) and saliency in [0, 1]. Out: packed RGB images of the same
//! size, or tiles of them. Pure functions without files; all linear in the number of pixels.

use image::{GrayImage, Luma, Rgb, RgbImage, imageops};
use imageproc::contours::find_contours;
use samsod::saliency::SalientRegion;
use samsod::segment::BoundingBox;
use samsod::shadow::{Mask, ObjectRegion};

use crate::masks::Shown;

/// A closed line through pixel centres, (x, y) in px; the last point joins the first.
pub type Outline = Vec<[u32; 2]>;

/// Colours of regions, told apart on wood, steel and green belts alike; used in turn.
const PALETTE: [Rgb<u8>; 8] = [
    Rgb([255, 64, 64]),
    Rgb([64, 220, 64]),
    Rgb([70, 130, 255]),
    Rgb([255, 200, 0]),
    Rgb([255, 64, 255]),
    Rgb([0, 230, 230]),
    Rgb([255, 140, 40]),
    Rgb([170, 110, 255]),
];

/// The colour in which region `index` is drawn.
pub fn region_colour(index: usize) -> Rgb<u8> {
    PALETTE[index % PALETTE.len()]
}

/// Outlines of the partitions `labels_inside` taken together: the outer border and the border of every hole, through
/// the outermost pixels that belong to them.
///
/// # Arguments
/// * `width` - of the label image, px
/// * `bbox` - box that holds the partitions; only it is looked at
/// * `labels_inside` - the labels of the partitions
/// * `label` - the label of pixel `y * width + x`
pub fn outlines(width: u32, bbox: &BoundingBox, labels_inside: &[u32], label: impl Fn(usize) -> u32) -> Vec<Outline> {
    let most = labels_inside.iter().copied().max().unwrap_or(0) as usize;
    let mut inside = vec![false; most + 1];
    for &label in labels_inside {
        inside[label as usize] = true;
    }
    // A margin of one pixel: the contour finder begins a border where it enters from the background.
    let mask = GrayImage::from_fn(bbox.width + 2, bbox.height + 2, |x, y| {
        let margin = x == 0 || y == 0 || x > bbox.width || y > bbox.height;
        if margin {
            return Luma([0]);
        }
        let pixel = (bbox.y + y - 1) as usize * width as usize + (bbox.x + x - 1) as usize;
        let is_inside = inside.get(label(pixel) as usize).copied().unwrap_or(false);
        Luma([if is_inside { 255 } else { 0 }])
    });
    contours(&mask, bbox)
}

/// Borders of a mask of a box with a margin of one pixel.
fn contours(with_margin: &GrayImage, bbox: &BoundingBox) -> Vec<Outline> {
    find_contours::<u32>(with_margin)
        .into_iter()
        .map(|contour| contour.points.into_iter().map(|p| [bbox.x + p.x - 1, bbox.y + p.y - 1]).collect())
        .collect()
}

/// Outlines of a set of pixels, as [`outlines`].
pub fn mask_outlines(mask: &Mask) -> Vec<Outline> {
    let bbox = mask.bbox();
    let mut with_margin = GrayImage::new(bbox.width + 2, bbox.height + 2);
    for run in mask.runs() {
        for x in run.start..run.end {
            with_margin.put_pixel(x - bbox.x + 1, run.y - bbox.y + 1, Luma([255]));
        }
    }
    contours(&with_margin, &bbox)
}

/// Outlines of one salient region.
pub fn region_outlines(width: u32, region: &SalientRegion, label: impl Fn(usize) -> u32) -> Vec<Outline> {
    outlines(width, &region.bbox, &region.partitions, label)
}

/// Draws an outline `thickness` pixels wide, to the right and down from its own pixels. What lies outside the picture is
/// left out.
pub fn draw_outline(picture: &mut RgbImage, outline: &Outline, colour: Rgb<u8>, thickness: u32) {
    for &[x, y] in outline {
        for (dx, dy) in (0..thickness).flat_map(|dx| (0..thickness).map(move |dy| (dx, dy))) {
            if let Some(pixel) = picture.get_pixel_mut_checked(x.saturating_add(dx), y.saturating_add(dy)) {
                *pixel = colour;
            }
        }
    }
}

/// The colour in which shadows are tinted: none of the palette, and neither a table's nor a shadow's own.
const SHADOW: Rgb<u8> = Rgb([255, 255, 255]);
/// Share of the tint, of 256, in pixels of objects and of shadows.
const OBJECT_TINT: u32 = 110;
const SHADOW_TINT: u32 = 120;

/// Tints objects in their colours and shadows in one of their own.
///
/// # Arguments
/// * `codes` - a code of [`masks`](crate::masks) for each pixel, row by row; pixels without one stay as they are
pub fn tint_masks(picture: &mut RgbImage, codes: &[u8]) {
    for (Rgb(pixel), &code) in picture.pixels_mut().zip(codes) {
        let (Rgb(tint), share) = match Shown::from_code(code) {
            Shown::Table => continue,
            Shown::Object(index) => (region_colour(index), OBJECT_TINT),
            Shown::Shadow(_) => (SHADOW, SHADOW_TINT),
        };
        for (channel, tint) in pixel.iter_mut().zip(tint) {
            *channel = ((u32::from(*channel) * (256 - share) + u32::from(tint) * share) / 256) as u8;
        }
    }
}

/// Outlines of one object, the outer one first.
pub fn object_outlines(object: &ObjectRegion) -> impl Iterator<Item = Outline> {
    let unsigned = |outline: &Vec<[i32; 2]>| outline.iter().map(|point| point.map(|c| c.max(0) as u32)).collect();
    std::iter::once(&object.outline).chain(&object.holes).map(unsigned)
}

/// The digits in 3 x 5 pixels, one octal figure a row: enough for ids, and no font file to ship.
const DIGITS: [[u8; 5]; 10] = [
    [7, 5, 5, 5, 7],
    [2, 6, 2, 2, 7],
    [7, 1, 7, 4, 7],
    [7, 1, 7, 1, 7],
    [5, 5, 7, 1, 1],
    [7, 4, 7, 1, 7],
    [7, 4, 7, 5, 7],
    [7, 1, 2, 2, 2],
    [7, 5, 7, 5, 7],
    [7, 5, 7, 1, 7],
];

/// Writes a number centred at (x, y) in white on a black field, `scale` pixels a dot.
pub fn draw_number(picture: &mut RgbImage, number: usize, x: u32, y: u32, scale: u32) {
    let digits: Vec<usize> = number.to_string().bytes().map(|b| usize::from(b - b'0')).collect();
    let (width, height) = ((digits.len() as u32 * 4 + 1) * scale, 7 * scale);
    let (left, top) = (x.saturating_sub(width / 2), y.saturating_sub(height / 2));
    for row in 0..height {
        for column in 0..width {
            let (dot_x, dot_y) = (column / scale, row / scale);
            // One dot of margin on every side, one between digits.
            let lit = (1..6).contains(&dot_y)
                && dot_x % 4 != 0
                && digits
                    .get((dot_x / 4) as usize)
                    .is_some_and(|&digit| DIGITS[digit][dot_y as usize - 1] >> (3 - dot_x % 4) & 1 == 1);
            if let Some(pixel) = picture.get_pixel_mut_checked(left + column, top + row) {
                *pixel = if lit { Rgb([255; 3]) } else { Rgb([0; 3]) };
            }
        }
    }
}

/// Every partition in its mean colour, its right and lower border in white.
///
/// # Arguments
/// * `means` - mean colour of each label, 0 to 255; a label without one is black
/// * `label` - the label of pixel `y * width + x`
pub fn partition_picture(width: u32, height: u32, means: &[[f32; 3]], label: impl Fn(usize) -> u32) -> RgbImage {
    RgbImage::from_fn(width, height, |x, y| {
        let pixel = y as usize * width as usize + x as usize;
        let own = label(pixel);
        let border =
            (x + 1 < width && label(pixel + 1) != own) || (y + 1 < height && label(pixel + width as usize) != own);
        if border {
            return Rgb([255; 3]);
        }
        Rgb(means.get(own as usize).map_or([0; 3], |mean| mean.map(|c| c.round() as u8)))
    })
}

/// Mean colour of each label, 0 to 255; the index is the label. Labels without pixels are black.
pub fn mean_colours(image: &RgbImage, label: impl Fn(usize) -> u32) -> Vec<[f32; 3]> {
    let mut sums: Vec<[f64; 4]> = Vec::new();
    for (i, Rgb(colour)) in image.pixels().enumerate() {
        let label = label(i) as usize;
        // More labels than pixels are not a partition; do not let a broken file ask for gigabytes.
        if label >= image.len() {
            continue;
        }
        if label >= sums.len() {
            sums.resize(label + 1, [0.0; 4]);
        }
        let sum = &mut sums[label];
        for (s, &c) in sum.iter_mut().zip(colour) {
            *s += f64::from(c);
        }
        sum[3] += 1.0;
    }
    sums.iter().map(|&[r, g, b, n]| [r, g, b].map(|c| (c / n.max(1.0)) as f32)).collect()
}

/// Saliency as grey levels: the greatest value of the picture is white, and the square root of the rest lets a faint
/// region be seen beside a strong one.
pub fn saliency_picture(width: u32, height: u32, value: impl Fn(usize) -> f32) -> RgbImage {
    let pixels = width as usize * height as usize;
    let most = (0..pixels).map(&value).fold(0.0f32, f32::max);
    let scale = if most > 0.0 { 1.0 / most } else { 0.0 };
    RgbImage::from_fn(width, height, |x, y| {
        let share = value(y as usize * width as usize + x as usize) * scale;
        Rgb([(share.max(0.0).sqrt() * 255.0).round() as u8; 3])
    })
}

/// A picture scaled to `tile_width` px.
pub fn tile(picture: &RgbImage, tile_width: u32) -> RgbImage {
    imageops::thumbnail(picture, tile_width, tile_height(picture, tile_width))
}

fn tile_height(picture: &RgbImage, tile_width: u32) -> u32 {
    let (width, height) = (picture.width().max(1), picture.height().max(1));
    (u64::from(height) * u64::from(tile_width) / u64::from(width)).clamp(1, 16_384) as u32
}

/// Rows of equal tiles on a dark ground, each picture scaled to `tile_width` px; rows may differ in height.
pub fn contact_sheet(rows: &[Vec<RgbImage>], tile_width: u32) -> RgbImage {
    const GAP: u32 = 6;
    let tile_height = |picture: &RgbImage| tile_height(picture, tile_width);
    let columns = rows.iter().map(Vec::len).max().unwrap_or(0) as u32;
    let heights: Vec<u32> = rows.iter().map(|row| row.iter().map(tile_height).max().unwrap_or(0)).collect();
    let height = heights.iter().map(|h| h + GAP).sum::<u32>() + GAP;
    let mut sheet = RgbImage::from_pixel(columns * (tile_width + GAP) + GAP, height, Rgb([24, 24, 28]));
    let mut top = GAP;
    for (row, height) in rows.iter().zip(heights) {
        let mut left = GAP;
        for picture in row {
            imageops::replace(&mut sheet, &tile(picture, tile_width), i64::from(left), i64::from(top));
            left += tile_width + GAP;
        }
        top += height + GAP;
    }
    sheet
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two partitions inside (1 and 2), a hole of 0 in them, and 3 apart.
    const LABELS: [u32; 48] = [
        0, 0, 0, 0, 0, 0, 0, 0, //
        0, 1, 1, 1, 2, 2, 0, 3, //
        0, 1, 1, 1, 2, 2, 0, 3, //
        0, 1, 1, 0, 2, 2, 0, 0, //
        0, 1, 1, 1, 2, 2, 0, 0, //
        0, 0, 0, 0, 0, 0, 0, 0,
    ];

    #[test]
    fn the_outline_runs_on_the_border_of_both_partitions_and_round_the_hole() {
        let bbox = BoundingBox { x: 1, y: 1, width: 5, height: 4 };
        let found = outlines(8, &bbox, &[1, 2], |i| LABELS[i]);
        assert_eq!(found.len(), 2, "outer border and hole: {found:?}");
        let mut outer = found[0].clone();
        outer.sort_unstable();
        let mut expected: Vec<[u32; 2]> = (1..=5)
            .flat_map(|x| (1..=4).map(move |y| [x, y]))
            .filter(|&[x, y]| x == 1 || x == 5 || y == 1 || y == 4)
            .collect();
        expected.sort_unstable();
        assert_eq!(outer, expected);
        assert!(found[1].iter().all(|&[x, y]| x.abs_diff(3) + y.abs_diff(3) <= 2), "{:?}", found[1]);
    }

    #[test]
    fn a_partition_is_drawn_in_its_mean_colour_with_a_border() {
        let image = RgbImage::from_fn(8, 6, |x, y| Rgb([LABELS[(y * 8 + x) as usize] as u8 * 50, 10, 20]));
        let means = mean_colours(&image, |i| LABELS[i]);
        assert_eq!(means, [[0.0, 10.0, 20.0], [50.0, 10.0, 20.0], [100.0, 10.0, 20.0], [150.0, 10.0, 20.0]]);
        let picture = partition_picture(8, 6, &means, |i| LABELS[i]);
        assert_eq!(picture.get_pixel(1, 1), &Rgb([50, 10, 20]));
        assert_eq!(picture.get_pixel(3, 1), &Rgb([255; 3]), "between 1 and 2");
    }

    #[test]
    fn faint_saliency_is_stretched_and_none_is_black() {
        let faint = saliency_picture(2, 1, |i| [0.001, 0.004][i]);
        assert_eq!((faint.get_pixel(0, 0)[0], faint.get_pixel(1, 0)[0]), (128, 255));
        assert_eq!(saliency_picture(2, 1, |_| 0.0).as_raw(), &[0; 6]);
    }

    #[test]
    fn objects_and_shadows_are_tinted_and_the_table_is_not() {
        let mut picture = RgbImage::from_pixel(3, 1, Rgb([100, 100, 100]));
        tint_masks(&mut picture, &[0, 254, 127]);
        assert_eq!(picture.get_pixel(0, 0), &Rgb([100, 100, 100]));
        let Rgb([red, green, blue]) = *picture.get_pixel(1, 0);
        assert!(green > 140 && red < 100 && blue < 100, "towards the colour of object 1");
        let Rgb([red, green, blue]) = *picture.get_pixel(2, 0);
        assert!(red > 120 && red == green && green == blue, "lighter");
        tint_masks(&mut picture, &[]);
    }

    #[test]
    fn a_number_can_be_read() {
        let mut picture = RgbImage::from_pixel(11, 9, Rgb([9; 3]));
        draw_number(&mut picture, 17, 5, 4, 1);
        let rows: Vec<String> = picture
            .rows()
            .map(|row| {
                row.map(|p| {
                    if p[0] == 255 {
                        '#'
                    } else if p[0] == 0 {
                        '.'
                    } else {
                        ' '
                    }
                })
                .collect()
            })
            .collect();
        assert_eq!(rows[2], " ..#..###. ");
        assert_eq!(rows[3], " .##....#. ");
        assert_eq!(rows[6], " .###..#.. ");
    }

    #[test]
    fn a_sheet_places_tiles_side_by_side_and_survives_no_rows() {
        let tile = RgbImage::from_pixel(20, 10, Rgb([200; 3]));
        let sheet = contact_sheet(&[vec![tile.clone(), tile.clone()], vec![tile]], 40);
        assert_eq!(sheet.dimensions(), (2 * 46 + 6, 2 * 26 + 6));
        assert_eq!(sheet.get_pixel(52 + 20, 16)[0], 200);
        assert_eq!(sheet.get_pixel(52 + 20, 42)[0], 24, "the second row has one tile");
        assert_eq!(contact_sheet(&[], 40).dimensions(), (6, 6));
    }
}
