//! What is fuzzed of frames: any bytes as a header and its pixels, and what must hold for all of them.
//!
//! Shared by the targets of cargo-fuzz and by `crates/frame/tests/any_bytes.rs`, which needs no nightly compiler.

use samsod_frame::{CameraId, FrameHeader, FrameLayout, MAX_SIDE_PX, MAX_STRIDE_BYTES};

/// Bytes of a header as another process may have written it; what follows is the payload.
pub(crate) fn frame(bytes: &[u8]) {
    let Some((header, payload)) = bytes.split_first_chunk::<80>() else { return };
    let u32_at = |at: usize| u32::from_le_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]]);
    let mut camera = [0; 32];
    camera.copy_from_slice(&header[32..64]);
    let header = FrameHeader {
        sequence: u64::from(u32_at(0)),
        timestamp_ns: u64::from(u32_at(8)),
        width: u32_at(16),
        height: u32_at(20),
        stride: u32_at(24),
        pixel_format: u32_at(28),
        camera: CameraId::from_bytes(camera),
        camera_frame: u64::from(u32_at(64)),
        camera_time_ns: u64::from(u32_at(72)),
    };
    let layout = match FrameLayout::check(&header, payload.len()) {
        Ok(layout) => layout,
        Err(refusal) => {
            assert!(!refusal.to_string().is_empty());
            return;
        }
    };
    assert!((1..=MAX_SIDE_PX).contains(&layout.width()) && (1..=MAX_SIDE_PX).contains(&layout.height()));
    assert!(layout.row_bytes() <= layout.stride() && layout.stride() <= MAX_STRIDE_BYTES as usize);
    assert!(layout.payload_bytes() <= payload.len());
    let Ok(name) = header.camera.text() else { unreachable!("the name was checked") };
    assert!(!name.chars().any(char::is_control), "{name:?}");
    let mut scratch = Vec::new();
    let Some(image) = layout.rgb(payload, &mut scratch) else { unreachable!("the payload was long enough") };
    assert_eq!(image.dimensions(), (layout.width(), layout.height()));
    assert_eq!(image.as_raw().len(), layout.width() as usize * layout.height() as usize * 3);
    // One byte less than it takes is refused.
    assert!(FrameLayout::check(&header, layout.payload_bytes() - 1).is_err());
}
