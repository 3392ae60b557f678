//! From YUYV, the format of most cameras for offices, to RGB.
//!
//! Input: rows of `Y U Y V`, two pixels in four bytes, of limited range (BT.601), as the kernel's drivers deliver them. Output:
//! packed RGB. Cost: linear in pixels.

/// Converts `height` rows of `width` pixels, `stride` bytes apart. False, and nothing written, when either side is too short or the
/// width is odd.
pub(crate) fn to_rgb(bytes: &[u8], width: usize, height: usize, stride: usize, rgb: &mut [u8]) -> bool {
    let row_bytes = width * 2;
    let needed = match height {
        0 => 0,
        _ => stride * (height - 1) + row_bytes,
    };
    if !width.is_multiple_of(2)
        || stride < row_bytes
        || stride == 0
        || bytes.len() < needed
        || rgb.len() < width * height * 3
    {
        return false;
    }
    if width == 0 {
        return true;
    }
    for (row, line) in bytes.chunks(stride).zip(rgb.chunks_exact_mut(width * 3)).take(height) {
        for (pair, out) in row[..row_bytes].chunks_exact(4).zip(line.chunks_exact_mut(6)) {
            let [left, u, right, v] = [pair[0], pair[1], pair[2], pair[3]].map(i32::from);
            out[..3].copy_from_slice(&pixel(left, u, v));
            out[3..].copy_from_slice(&pixel(right, u, v));
        }
    }
    true
}

/// Fixed point with 8 bits; the factors are those of BT.601 for levels of 16 to 235.
fn pixel(y: i32, u: i32, v: i32) -> [u8; 3] {
    let (y, u, v) = (298 * (y - 16) + 128, u - 128, v - 128);
    [y + 409 * v, y - 100 * u - 208 * v, y + 516 * u].map(|level| (level >> 8).clamp(0, 255) as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colours_by_hand() {
        // White and black; then red (81, 90, 240) and blue (41, 240, 110) of the colour bars.
        let bytes = [235, 128, 16, 128, 0, 0, 81, 90, 81, 240];
        let mut rgb = [0; 12];
        assert!(to_rgb(&bytes, 2, 2, 6, &mut rgb));
        assert_eq!(rgb[..6], [255, 255, 255, 0, 0, 0]);
        let near = |a: &[u8], b: [u8; 3]| a.iter().zip(b).all(|(a, b)| a.abs_diff(b) <= 2);
        assert!(near(&rgb[6..9], [255, 0, 0]) && near(&rgb[9..], [255, 0, 0]), "{rgb:?}");
        assert!(to_rgb(&[41, 240, 41, 110], 2, 1, 4, &mut rgb));
        assert!(near(&rgb[..3], [0, 0, 255]), "{rgb:?}");
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        let mut rgb = [7; 12];
        assert!(!to_rgb(&[0; 8], 3, 1, 6, &mut rgb), "odd width");
        assert!(!to_rgb(&[0; 7], 2, 2, 4, &mut rgb), "short of bytes");
        assert!(!to_rgb(&[0; 32], 4, 2, 8, &mut rgb), "short of room");
        assert!(!to_rgb(&[0; 8], 2, 1, 3, &mut rgb), "stride below a row");
        assert_eq!(rgb, [7; 12]);
    }
}
