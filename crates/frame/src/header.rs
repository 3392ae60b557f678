//! The header of a frame and its validation.
//!
//! Input: a [`FrameHeader`] as another process wrote it, and the number of bytes that came with it. Output: a
//! [`FrameLayout`], the only type from which pixels are read, or a [`FrameError`]. Cost: constant.

use std::fmt;
use std::mem::{align_of, offset_of, size_of};

use iceoryx2::prelude::*;
use serde::{Deserialize, Serialize};

/// Largest width and height that is accepted, px.
pub const MAX_SIDE_PX: u32 = 16_384;

/// Largest stride that is accepted, bytes: a row of the widest RGB frame, padded to the next power of two.
pub const MAX_STRIDE_BYTES: u32 = 65_536;

/// How the bytes of a row are to be read. One byte a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u32)]
pub enum PixelFormat {
    /// Red, green, blue: 3 bytes a pixel. Header value 1.
    Rgb8 = 1,
    /// Blue, green, red: 3 bytes a pixel. Header value 2.
    Bgr8 = 2,
    /// Grey: 1 byte a pixel. Header value 3.
    Mono8 = 3,
    /// Colour filter array, 1 byte a pixel: rows `R G R G ..` and `G B G B ..` in turn. Header value 4.
    BayerRg8 = 4,
    /// Colour filter array, 1 byte a pixel: rows `G R G R ..` and `B G B G ..` in turn. Header value 5.
    BayerGr8 = 5,
    /// Colour filter array, 1 byte a pixel: rows `G B G B ..` and `R G R G ..` in turn. Header value 6.
    BayerGb8 = 6,
    /// Colour filter array, 1 byte a pixel: rows `B G B G ..` and `G R G R ..` in turn. Header value 7.
    BayerBg8 = 7,
}

impl PixelFormat {
    /// All formats.
    pub const ALL: [Self; 7] =
        [Self::Rgb8, Self::Bgr8, Self::Mono8, Self::BayerRg8, Self::BayerGr8, Self::BayerGb8, Self::BayerBg8];

    /// Bytes that one pixel takes.
    pub const fn bytes_per_pixel(self) -> usize {
        match self {
            Self::Rgb8 | Self::Bgr8 => 3,
            Self::Mono8 | Self::BayerRg8 | Self::BayerGr8 | Self::BayerGb8 | Self::BayerBg8 => 1,
        }
    }

    /// The format with this value in a header, if there is one.
    pub fn from_value(value: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|f| *f as u32 == value)
    }

    /// The name in configuration files and recordings.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Rgb8 => "rgb8",
            Self::Bgr8 => "bgr8",
            Self::Mono8 => "mono8",
            Self::BayerRg8 => "bayer_rg8",
            Self::BayerGr8 => "bayer_gr8",
            Self::BayerGb8 => "bayer_gb8",
            Self::BayerBg8 => "bayer_bg8",
        }
    }
}

impl fmt::Display for PixelFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Which camera took a frame: up to 31 bytes of UTF-8, filled with zeros to 32.
#[derive(Clone, Copy, Default, PartialEq, Eq, Hash, ZeroCopySend)]
#[type_name("SamsodCameraIdV1")]
#[repr(C)]
pub struct CameraId {
    bytes: [u8; 32],
}

impl CameraId {
    /// Longest name, bytes.
    pub const MAX_LEN: usize = 31;

    /// A camera id from its name.
    ///
    /// # Errors
    /// [`FrameError::CameraIdLength`] for more than [`CameraId::MAX_LEN`] bytes, [`FrameError::CameraIdText`] for a
    /// name with a control character.
    pub fn new(name: &str) -> Result<Self, FrameError> {
        if name.len() > Self::MAX_LEN {
            return Err(FrameError::CameraIdLength { name: name.to_owned(), len: name.len(), max: Self::MAX_LEN });
        }
        let mut bytes = [0; 32];
        bytes[..name.len()].copy_from_slice(name.as_bytes());
        let id = Self { bytes };
        id.text()?;
        Ok(id)
    }

    /// A camera id as another process wrote it; [`FrameLayout::check`] says whether it is text.
    pub const fn from_bytes(bytes: [u8; 32]) -> Self {
        Self { bytes }
    }

    /// The name, empty where the client gave none.
    ///
    /// # Errors
    /// [`FrameError::CameraIdText`] when the bytes are not zero-terminated UTF-8 without control characters: the name
    /// goes into logs and recordings.
    pub fn text(&self) -> Result<&str, FrameError> {
        let bad = || FrameError::CameraIdText { bytes: self.bytes };
        let len = self.bytes.iter().position(|&b| b == 0).ok_or_else(bad)?;
        if self.bytes[len..].iter().any(|&b| b != 0) {
            return Err(bad());
        }
        let name = std::str::from_utf8(&self.bytes[..len]).map_err(|_| bad())?;
        if name.chars().any(char::is_control) { Err(bad()) } else { Ok(name) }
    }
}

impl fmt::Debug for CameraId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "CameraId({:?})", String::from_utf8_lossy(&self.bytes).trim_end_matches('\0'))
    }
}

/// What travels in front of every frame.
///
/// 80 bytes, native byte order, alignment 8. The type name carries the version of the layout because the transport
/// compares names and sizes but not fields: a changed layout is a new name, and its peers refuse each other.
///
/// | offset | size | field | unit |
/// |---|---|---|---|
/// | 0 | 8 | `sequence` | 0 for the first frame of a publisher, then one more each |
/// | 8 | 8 | `timestamp_ns` | ns since the Unix epoch |
/// | 16 | 4 | `width` | px |
/// | 20 | 4 | `height` | px |
/// | 24 | 4 | `stride` | bytes from the start of a row to that of the next |
/// | 28 | 4 | `pixel_format` | 1 rgb8, 2 bgr8, 3 mono8, 4 bayer_rg8, 5 bayer_gr8, 6 bayer_gb8, 7 bayer_bg8 |
/// | 32 | 32 | `camera` | zero-terminated UTF-8 |
/// | 64 | 8 | `camera_frame` | the camera's own number of the frame, 0 where it has none |
/// | 72 | 8 | `camera_time_ns` | ns on the camera's own clock, 0 where it has none |
///
/// The payload holds `height` rows from top to bottom; the last one need not be padded to the stride.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, ZeroCopySend)]
#[type_name("SamsodFrameHeaderV2")]
#[repr(C)]
pub struct FrameHeader {
    /// Number of the frame, counted by its publisher from 0 without gaps.
    pub sequence: u64,
    /// When the client handed the frame over or, if it knows that, when the first byte came from the camera; ns since the Unix
    /// epoch.
    pub timestamp_ns: u64,
    /// Width, px; 1 to [`MAX_SIDE_PX`].
    pub width: u32,
    /// Height, px; 1 to [`MAX_SIDE_PX`].
    pub height: u32,
    /// Bytes from the start of a row to the start of the next; at least the row, at most [`MAX_STRIDE_BYTES`].
    pub stride: u32,
    /// Value of a [`PixelFormat`]. A number, not the enumeration: another process may write anything here.
    pub pixel_format: u32,
    /// Which camera took the frame.
    pub camera: CameraId,
    /// The camera's own number of the frame: gaps in it are frames that never came whole to the client. It may begin anew at any
    /// time. 0 where the camera gave none.
    pub camera_frame: u64,
    /// The camera's own clock at the frame, ns from a zero that only the camera knows: for distances between frames, without the
    /// jitter of network and system. 0 where the camera has none.
    pub camera_time_ns: u64,
}

const _: () = {
    assert!(size_of::<FrameHeader>() == 80 && align_of::<FrameHeader>() == 8);
    assert!(offset_of!(FrameHeader, sequence) == 0 && offset_of!(FrameHeader, timestamp_ns) == 8);
    assert!(offset_of!(FrameHeader, width) == 16 && offset_of!(FrameHeader, height) == 20);
    assert!(offset_of!(FrameHeader, stride) == 24 && offset_of!(FrameHeader, pixel_format) == 28);
    assert!(offset_of!(FrameHeader, camera) == 32 && size_of::<CameraId>() == 32);
    assert!(offset_of!(FrameHeader, camera_frame) == 64 && offset_of!(FrameHeader, camera_time_ns) == 72);
};

/// Why a frame is not accepted. Every variant names the field, its value and what is allowed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum FrameError {
    /// Width or height is zero or too large.
    #[error("frame {side} is {value} px; 1 to {max} px are allowed")]
    Side {
        /// `"width"` or `"height"`.
        side: &'static str,
        /// What the header says, px.
        value: u32,
        /// Largest value, px.
        max: u32,
    },
    /// The number of the pixel format is not known.
    #[error("pixel format {value} is unknown; allowed are {}", known_formats())]
    PixelFormat {
        /// What the header says.
        value: u32,
    },
    /// A row is longer than the stride, or the stride is too large.
    #[error("stride is {stride} bytes; {min} to {max} are allowed for {width} px of {format}")]
    Stride {
        /// What the header says, bytes.
        stride: u32,
        /// Bytes of one row.
        min: usize,
        /// Largest stride, bytes.
        max: u32,
        /// Width of the frame, px.
        width: u32,
        /// Format of the frame.
        format: PixelFormat,
    },
    /// The payload ends before the last row does.
    #[error("payload has {len} bytes; {width} x {height} px of {format} with a stride of {stride} need {needed}")]
    Payload {
        /// Bytes that came.
        len: usize,
        /// Bytes that the header announces.
        needed: usize,
        /// Width of the frame, px.
        width: u32,
        /// Height of the frame, px.
        height: u32,
        /// Stride of the frame, bytes.
        stride: usize,
        /// Format of the frame.
        format: PixelFormat,
    },
    /// The name of a camera is too long for the header.
    #[error("camera id {name:?} has {len} bytes; at most {max} are allowed")]
    CameraIdLength {
        /// The name.
        name: String,
        /// Its length, bytes.
        len: usize,
        /// Longest name, bytes.
        max: usize,
    },
    /// The camera id in the header is no text.
    #[error("camera id {:?} must be UTF-8 without control characters, ended and filled up by zeros", lossy(bytes))]
    CameraIdText {
        /// What the header says.
        bytes: [u8; 32],
    },
}

fn known_formats() -> String {
    PixelFormat::ALL.map(|format| format!("{} ({format})", format as u32)).join(", ")
}

fn lossy(bytes: &[u8; 32]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// The checked geometry of a frame: reading the rows it describes stays inside the payload it was checked against.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameLayout {
    width: u32,
    height: u32,
    stride: usize,
    format: PixelFormat,
}

impl FrameLayout {
    /// Checks every field of a header against the length of its payload, bytes.
    ///
    /// ```
    /// use samsod_frame::{FrameError, FrameHeader, FrameLayout, PixelFormat};
    /// let header = FrameHeader {
    ///     width: 4,
    ///     height: 3,
    ///     stride: 12,
    ///     pixel_format: PixelFormat::Rgb8 as u32,
    ///     ..FrameHeader::default()
    /// };
    /// assert!(FrameLayout::check(&header, 36).is_ok());
    /// assert!(matches!(FrameLayout::check(&header, 35), Err(FrameError::Payload { len: 35, needed: 36, .. })));
    /// ```
    ///
    /// # Errors
    /// The first field that is wrong; see [`FrameError`]. A payload longer than needed is accepted.
    pub fn check(header: &FrameHeader, payload_len: usize) -> Result<Self, FrameError> {
        let FrameHeader { width, height, stride, pixel_format, camera, .. } = *header;
        let format = PixelFormat::from_value(pixel_format).ok_or(FrameError::PixelFormat { value: pixel_format })?;
        for (side, value) in [("width", width), ("height", height)] {
            if value == 0 || value > MAX_SIDE_PX {
                return Err(FrameError::Side { side, value, max: MAX_SIDE_PX });
            }
        }
        // 16384 px * 3 bytes and 16384 rows * 65536 bytes: nothing below can overflow once the sides are checked.
        let row = width as usize * format.bytes_per_pixel();
        if (stride as usize) < row || stride > MAX_STRIDE_BYTES {
            return Err(FrameError::Stride { stride, min: row, max: MAX_STRIDE_BYTES, width, format });
        }
        let stride = stride as usize;
        let needed = stride * (height as usize - 1) + row;
        if payload_len < needed {
            return Err(FrameError::Payload { len: payload_len, needed, width, height, stride, format });
        }
        camera.text()?;
        Ok(Self { width, height, stride, format })
    }

    /// Width, px; at least 1.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Height, px; at least 1.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// Bytes from the start of a row to the start of the next.
    pub fn stride(&self) -> usize {
        self.stride
    }

    /// How a row is to be read.
    pub fn format(&self) -> PixelFormat {
        self.format
    }

    /// Bytes of a row without its padding.
    pub fn row_bytes(&self) -> usize {
        self.width as usize * self.format.bytes_per_pixel()
    }

    /// Bytes from the first to the last pixel.
    pub fn payload_bytes(&self) -> usize {
        self.stride * (self.height as usize - 1) + self.row_bytes()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const GOOD: FrameHeader = FrameHeader {
        sequence: 7,
        timestamp_ns: 0,
        width: 4,
        height: 3,
        stride: 12,
        pixel_format: PixelFormat::Rgb8 as u32,
        camera: CameraId::from_bytes([0; 32]),
        camera_frame: 0,
        camera_time_ns: 0,
    };

    fn refusal(header: FrameHeader, len: usize) -> String {
        FrameLayout::check(&header, len).expect_err("refused").to_string()
    }

    #[test]
    fn every_refusal_names_the_value_and_what_is_allowed() {
        let cases = [
            (FrameHeader { width: 0, ..GOOD }, "frame width is 0 px; 1 to 16384 px are allowed"),
            (FrameHeader { height: 0, ..GOOD }, "frame height is 0 px; 1 to 16384 px are allowed"),
            (FrameHeader { width: 16_385, ..GOOD }, "frame width is 16385 px; 1 to 16384 px are allowed"),
            (FrameHeader { height: u32::MAX, ..GOOD }, "frame height is 4294967295 px; 1 to 16384 px are allowed"),
            (FrameHeader { stride: 11, ..GOOD }, "stride is 11 bytes; 12 to 65536 are allowed for 4 px of rgb8"),
            (FrameHeader { stride: 0, ..GOOD }, "stride is 0 bytes; 12 to 65536 are allowed for 4 px of rgb8"),
            (
                FrameHeader { stride: u32::MAX, ..GOOD },
                "stride is 4294967295 bytes; 12 to 65536 are allowed for 4 px of rgb8",
            ),
            (FrameHeader { stride: 13, ..GOOD }, "payload has 36 bytes; 4 x 3 px of rgb8 with a stride of 13 need 38"),
            (FrameHeader { height: 4, ..GOOD }, "payload has 36 bytes; 4 x 4 px of rgb8 with a stride of 12 need 48"),
            (
                FrameHeader { pixel_format: 8, ..GOOD },
                "pixel format 8 is unknown; allowed are 1 (rgb8), 2 (bgr8), 3 (mono8), 4 (bayer_rg8), 5 (bayer_gr8), \
                 6 (bayer_gb8), 7 (bayer_bg8)",
            ),
        ];
        for (header, message) in cases {
            assert_eq!(refusal(header, 36), message);
        }
        assert!(refusal(FrameHeader { pixel_format: 0, ..GOOD }, 36).starts_with("pixel format 0 is unknown; allowed"));
        assert!(refusal(GOOD, 0).starts_with("payload has 0 bytes"));
        let unended = FrameHeader { camera: CameraId::from_bytes([b'x'; 32]), ..GOOD };
        assert!(refusal(unended, 36).contains("must be UTF-8 without control characters"));
    }

    #[test]
    fn accepted_as_they_are() {
        assert!(FrameLayout::check(&GOOD, 36).is_ok());
        assert!(FrameLayout::check(&GOOD, 37).is_ok(), "longer payload");
        let padded = FrameHeader { stride: 16, ..GOOD };
        assert!(FrameLayout::check(&padded, 44).is_ok(), "last row not padded");
        assert!(FrameLayout::check(&padded, 43).is_err());
        let pixel = FrameHeader { width: 1, height: 1, stride: 1, pixel_format: 4, ..GOOD };
        assert!(FrameLayout::check(&pixel, 1).is_ok());
        let largest = FrameHeader { width: MAX_SIDE_PX, height: MAX_SIDE_PX, stride: MAX_STRIDE_BYTES, ..GOOD };
        assert!(FrameLayout::check(&largest, usize::MAX).is_ok());
    }

    #[test]
    fn camera_ids() {
        assert_eq!(CameraId::new("left").unwrap().text(), Ok("left"));
        assert_eq!(CameraId::new("").unwrap(), CameraId::default());
        assert!(CameraId::new(&"x".repeat(31)).is_ok());
        assert!(matches!(CameraId::new(&"x".repeat(32)), Err(FrameError::CameraIdLength { len: 32, max: 31, .. })));
        assert!(matches!(CameraId::new("a\nb"), Err(FrameError::CameraIdText { .. })));
        assert!(matches!(CameraId::new("a\0b"), Err(FrameError::CameraIdText { .. })));
        let mut bytes = [0; 32];
        bytes[0] = 0xff;
        assert!(CameraId::from_bytes(bytes).text().is_err());
    }

    /// Values near the limits far more often than uniform ones would come near them.
    fn edgy(max: u32) -> impl Strategy<Value = u32> {
        prop_oneof![4 => 0..20u32, 1 => max - 2..max + 3, 1 => any::<u32>()]
    }

    proptest! {
        #[test]
        fn no_header_leads_out_of_its_payload(
            width in edgy(MAX_SIDE_PX),
            height in edgy(MAX_SIDE_PX),
            stride in edgy(MAX_STRIDE_BYTES),
            pixel_format in 0..9u32,
            sequence in any::<u64>(),
            camera in any::<[u8; 32]>(),
            camera_is_text in proptest::bool::weighted(0.9),
            payload in proptest::collection::vec(any::<u8>(), 0..1500),
        ) {
            let camera = CameraId::from_bytes(if camera_is_text { [0; 32] } else { camera });
            let header = FrameHeader { sequence, timestamp_ns: 0, width, height, stride, pixel_format, camera, ..GOOD };
            if let Ok(layout) = FrameLayout::check(&header, payload.len()) {
                prop_assert!(layout.payload_bytes() <= payload.len());
                let mut scratch = Vec::new();
                let view = layout.rgb(&payload, &mut scratch).expect("checked");
                prop_assert_eq!(view.dimensions(), (width, height));
                prop_assert_eq!(view.as_raw().len(), width as usize * height as usize * 3);
            }
        }

        #[test]
        fn any_header_is_answered(
            fields in any::<[u32; 4]>(), camera in any::<[u8; 32]>(), len in any::<usize>(),
        ) {
            let [width, height, stride, pixel_format] = fields;
            let camera = CameraId::from_bytes(camera);
            let header = FrameHeader { width, height, stride, pixel_format, camera, ..GOOD };
            if let Err(e) = FrameLayout::check(&header, len) {
                prop_assert!(!e.to_string().is_empty());
            }
        }
    }
}
