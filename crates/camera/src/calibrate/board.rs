//! The board that is photographed: a chessboard, with or without markers in its white squares.

use std::fmt;
use std::str::FromStr;

use opencv::aruco;

use super::CalibrateError;

/// Corners a side, least and most; OpenCV looks for no smaller chessboard.
const CORNERS: (u32, u32) = (3, 64);
/// Side of a square, mm.
const SQUARE_MM: (f64, f64) = (0.1, 1000.0);

/// A chessboard by its inner corners.
///
/// Its frame: origin in corner 0, x along the row of corner 0, y across the rows, z up out of the printed side. Corner
/// i lies at (i % columns, i / columns) squares.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Board {
    columns: u32,
    rows: u32,
    square_mm: f64,
    markers: Option<Markers>,
}

/// The markers of a ChArUco board, which tell its corners apart even if some are hidden.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Markers {
    /// Side of a marker, mm; less than that of a square.
    pub marker_mm: f64,
    /// Which markers.
    pub dictionary: Dictionary,
}

/// A set of markers that OpenCV knows: its name without `DICT_`, in small letters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Dictionary {
    name: &'static str,
    id: i32,
    markers: u32,
}

const DICTIONARIES: [Dictionary; 21] = [
    Dictionary { name: "4x4_50", id: aruco::DICT_4X4_50, markers: 50 },
    Dictionary { name: "4x4_100", id: aruco::DICT_4X4_100, markers: 100 },
    Dictionary { name: "4x4_250", id: aruco::DICT_4X4_250, markers: 250 },
    Dictionary { name: "4x4_1000", id: aruco::DICT_4X4_1000, markers: 1000 },
    Dictionary { name: "5x5_50", id: aruco::DICT_5X5_50, markers: 50 },
    Dictionary { name: "5x5_100", id: aruco::DICT_5X5_100, markers: 100 },
    Dictionary { name: "5x5_250", id: aruco::DICT_5X5_250, markers: 250 },
    Dictionary { name: "5x5_1000", id: aruco::DICT_5X5_1000, markers: 1000 },
    Dictionary { name: "6x6_50", id: aruco::DICT_6X6_50, markers: 50 },
    Dictionary { name: "6x6_100", id: aruco::DICT_6X6_100, markers: 100 },
    Dictionary { name: "6x6_250", id: aruco::DICT_6X6_250, markers: 250 },
    Dictionary { name: "6x6_1000", id: aruco::DICT_6X6_1000, markers: 1000 },
    Dictionary { name: "7x7_50", id: aruco::DICT_7X7_50, markers: 50 },
    Dictionary { name: "7x7_100", id: aruco::DICT_7X7_100, markers: 100 },
    Dictionary { name: "7x7_250", id: aruco::DICT_7X7_250, markers: 250 },
    Dictionary { name: "7x7_1000", id: aruco::DICT_7X7_1000, markers: 1000 },
    Dictionary { name: "aruco_original", id: aruco::DICT_ARUCO_ORIGINAL, markers: 1024 },
    Dictionary { name: "apriltag_16h5", id: aruco::DICT_APRILTAG_16h5, markers: 30 },
    Dictionary { name: "apriltag_25h9", id: aruco::DICT_APRILTAG_25h9, markers: 35 },
    Dictionary { name: "apriltag_36h10", id: aruco::DICT_APRILTAG_36h10, markers: 2320 },
    Dictionary { name: "apriltag_36h11", id: aruco::DICT_APRILTAG_36h11, markers: 587 },
];

impl Dictionary {
    /// OpenCV's number of the dictionary.
    pub(super) fn id(self) -> i32 {
        self.id
    }
}

impl FromStr for Dictionary {
    type Err = CalibrateError;

    fn from_str(text: &str) -> Result<Self, CalibrateError> {
        let small = text.to_ascii_lowercase();
        let name = small.strip_prefix("dict_").unwrap_or(&small);
        DICTIONARIES.into_iter().find(|d| d.name == name).ok_or_else(|| CalibrateError::Board {
            what: "dictionary",
            value: format!("{text:?}"),
            allowed: DICTIONARIES.map(|d| d.name).join(", "),
        })
    }
}

impl fmt::Display for Dictionary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name)
    }
}

impl Board {
    /// A board by its inner corners: one less than its squares in each direction, also for ChArUco.
    ///
    /// # Errors
    /// [`CalibrateError::Board`] names what is out of range.
    pub fn new(columns: u32, rows: u32, square_mm: f64, markers: Option<Markers>) -> Result<Self, CalibrateError> {
        let wrong = |what, value: String, allowed: String| Err(CalibrateError::Board { what, value, allowed });
        let (least, most) = CORNERS;
        if ![columns, rows].iter().all(|side| (least..=most).contains(side)) {
            return wrong("pattern", format!("{columns}x{rows}"), format!("{least} to {most} inner corners a side"));
        }
        let (least, most) = SQUARE_MM;
        if !(least..=most).contains(&square_mm) {
            return wrong("square", format!("{square_mm} mm"), format!("{least} to {most} mm"));
        }
        if let Some(Markers { marker_mm, dictionary }) = markers {
            if !(marker_mm > 0.0 && marker_mm < square_mm) {
                return wrong(
                    "marker",
                    format!("{marker_mm} mm"),
                    format!("above 0 and below the {square_mm} mm of a square"),
                );
            }
            let needed = (columns + 1) * (rows + 1) / 2;
            if needed > dictionary.markers {
                return wrong("dictionary", dictionary.to_string(), format!("one of at least {needed} markers"));
            }
        }
        Ok(Self { columns, rows, square_mm, markers })
    }

    /// Inner corners in a row.
    pub fn columns(&self) -> u32 {
        self.columns
    }

    /// Rows of inner corners.
    pub fn rows(&self) -> u32 {
        self.rows
    }

    /// Side of a square, mm.
    pub fn square_mm(&self) -> f64 {
        self.square_mm
    }

    /// Its markers, if it is a ChArUco board.
    pub fn markers(&self) -> Option<&Markers> {
        self.markers.as_ref()
    }

    /// Number of inner corners.
    pub fn corners(&self) -> u32 {
        self.columns * self.rows
    }

    /// Where a corner lies on the board, mm; `None` if the board has no such corner.
    pub fn corner_mm(&self, index: u32) -> Option<[f64; 2]> {
        (index < self.corners())
            .then(|| [index % self.columns, index / self.columns].map(|squares| f64::from(squares) * self.square_mm))
    }
}

impl fmt::Display for Board {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { columns, rows, square_mm, .. } = self;
        match &self.markers {
            None => write!(f, "a chessboard of {columns} x {rows} inner corners, {square_mm} mm apart"),
            Some(Markers { marker_mm, dictionary }) => write!(
                f,
                "a ChArUco board of {columns} x {rows} inner corners, {square_mm} mm apart, markers {dictionary} of \
                 {marker_mm} mm"
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn impossible_boards_are_refused_with_what_is_allowed() {
        let markers = |marker_mm, name: &str| Some(Markers { marker_mm, dictionary: name.parse().unwrap() });
        for (board, message) in [
            (Board::new(2, 6, 20.0, None), "pattern is 2x6; allowed: 3 to 64 inner corners a side"),
            (Board::new(9, 6, 0.0, None), "square is 0 mm; allowed: 0.1 to 1000 mm"),
            (Board::new(9, 6, f64::NAN, None), "square is NaN mm"),
            (Board::new(9, 6, 20.0, markers(20.0, "4x4_50")), "marker is 20 mm; allowed: above 0 and below the 20 mm"),
            (
                Board::new(20, 9, 20.0, markers(15.0, "DICT_4X4_100")),
                "dictionary is 4x4_100; allowed: one of at least 105",
            ),
        ] {
            assert!(board.as_ref().unwrap_err().to_string().starts_with(message), "{board:?}");
        }
        let refusal = "8x8".parse::<Dictionary>().unwrap_err().to_string();
        assert!(refusal.starts_with("dictionary is \"8x8\"; allowed: 4x4_50, 4x4_100"), "{refusal}");
    }

    #[test]
    fn corners_are_counted_along_x_first() {
        let board = Board::new(9, 6, 20.0, None).unwrap();
        assert_eq!(board.corner_mm(0), Some([0.0, 0.0]));
        assert_eq!(board.corner_mm(10), Some([20.0, 20.0]));
        assert_eq!(board.corner_mm(53), Some([160.0, 100.0]));
        assert_eq!(board.corner_mm(54), None);
    }
}
