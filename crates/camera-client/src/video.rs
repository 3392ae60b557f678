//! Cameras of the kernel: `/dev/video*`.
//!
//! Input: the camera of a [`ClientConfig`]. Output: its frames. Cost: one copy, or one conversion of YUYV, for the kernel's buffers
//! cannot lie in the shared memory of a cell; the kernel fills the next ones meanwhile.

use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use samsod_frame::{FrameHeader, FrameLayout, PixelFormat, unix_time_ns};
use tracing::warn;
use v4l::buffer::{Flags, Type};
use v4l::control::{Control, Description, Value};
use v4l::io::mmap::Stream;
use v4l::io::traits::CaptureStream;
use v4l::video::Capture;
use v4l::{Device, Format, FourCC};

use crate::config::{AutoOr, ClientConfig, refused};
use crate::source::{CameraError, Grabbed, Sink, Source};
use crate::yuyv;

const DEFAULT_DEVICE: &str = "/dev/video0";

/// `POLLIN` of poll(2).
const READABLE: i16 = 1;

// Numbers of the kernel's controls, <linux/v4l2-controls.h>.
const EXPOSURE_AUTO: u32 = 0x009a_0901;
const EXPOSURE_ABSOLUTE: u32 = 0x009a_0902;
const AUTOGAIN: u32 = 0x0098_0912;
const GAIN: u32 = 0x0098_0913;
/// `V4L2_EXPOSURE_MANUAL` and `V4L2_EXPOSURE_APERTURE_PRIORITY`, the automatic of most cameras.
const EXPOSURE_MANUAL: i64 = 1;
const EXPOSURE_APERTURE_PRIORITY: i64 = 3;
/// The kernel counts exposures in steps of 100 microseconds.
const EXPOSURE_STEP_US: f64 = 100.0;

/// How the rows of a camera become those of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Rows {
    /// As they are.
    Copied(PixelFormat),
    /// To RGB.
    FromYuyv,
}

/// The kernel's formats that a frame can be made of, the best for vision first.
const FORMATS: [(&[u8; 4], Rows); 8] = [
    (b"RGGB", Rows::Copied(PixelFormat::BayerRg8)),
    (b"GRBG", Rows::Copied(PixelFormat::BayerGr8)),
    (b"GBRG", Rows::Copied(PixelFormat::BayerGb8)),
    (b"BA81", Rows::Copied(PixelFormat::BayerBg8)),
    (b"RGB3", Rows::Copied(PixelFormat::Rgb8)),
    (b"BGR3", Rows::Copied(PixelFormat::Bgr8)),
    (b"YUYV", Rows::FromYuyv),
    (b"GREY", Rows::Copied(PixelFormat::Mono8)),
];

impl Rows {
    fn format(self) -> PixelFormat {
        match self {
            Self::Copied(format) => format,
            Self::FromYuyv => PixelFormat::Rgb8,
        }
    }
}

/// A camera that is set up and delivers.
pub(crate) struct Video {
    /// None only while it is dropped.
    stream: Option<Stream<'static>>,
    device: Device,
    path: String,
    card: String,
    rows: Rows,
    format: Format,
    silent_after: Duration,
    alive: Instant,
    running: bool,
}

impl Video {
    pub(crate) fn open(config: &ClientConfig) -> Result<Self, CameraError> {
        let path = match config.camera.device.as_str() {
            "" => DEFAULT_DEVICE,
            path => path,
        };
        let gone = |e: io::Error| CameraError::Gone { camera: path.to_owned(), reason: e.to_string() };
        let device = Device::with_path(path).map_err(gone)?;
        let card = device.query_caps().map_err(gone)?.card;
        let (rows, format) = set_format(&device, path, config)?;
        if let Some(rate) = config.camera.frame_rate_hz {
            set_rate(&device, rate, path)?;
        }
        let controls = device.query_controls().map_err(gone)?;
        let exposure = Automatic {
            key: "[camera] exposure_us",
            mode: EXPOSURE_AUTO,
            value: EXPOSURE_ABSOLUTE,
            step: EXPOSURE_STEP_US,
        };
        exposure.apply(&device, &controls, config.camera.exposure_us, path)?;
        let gain = Automatic { key: "[camera] gain", mode: AUTOGAIN, value: GAIN, step: 1.0 };
        gain.apply(&device, &controls, config.camera.gain, path)?;
        let buffers = u32::try_from(config.camera.buffers).unwrap_or(u32::MAX);
        let mut stream = Stream::with_buffers(&device, Type::VideoCapture, buffers).map_err(gone)?;
        let silent_after = Duration::from_millis(config.reconnect.silent_after_ms);
        stream.set_timeout(silent_after);
        let (path, alive) = (path.to_owned(), Instant::now());
        Ok(Self { stream: Some(stream), device, path, card, rows, format, silent_after, alive, running: false })
    }

    fn gone(&self, reason: impl ToString) -> CameraError {
        CameraError::Gone { camera: self.path.clone(), reason: reason.to_string() }
    }

    fn header(&self) -> FrameHeader {
        let format = self.rows.format();
        let stride = match self.rows {
            Rows::Copied(_) => self.format.stride.max(self.format.width * format.bytes_per_pixel() as u32),
            Rows::FromYuyv => self.format.width * 3,
        };
        FrameHeader {
            width: self.format.width,
            height: self.format.height,
            stride,
            pixel_format: format as u32,
            ..FrameHeader::default()
        }
    }
}

impl Source for Video {
    fn frame_bytes(&self) -> usize {
        let header = self.header();
        header.stride as usize * header.height as usize
    }

    fn slots(&self) -> usize {
        1
    }

    fn describe(&self) -> String {
        format!("{} ({})", self.path, self.card)
    }

    fn next(&mut self, sink: &mut Sink<'_>, timeout: Duration) -> Result<Grabbed, CameraError> {
        // The first call of `next` below starts the stream; until then there is nothing to poll for.
        if self.running {
            let timeout_ms = i32::try_from(timeout.as_millis()).unwrap_or(i32::MAX);
            match self.device.handle().poll(READABLE, timeout_ms) {
                Ok(0) if self.alive.elapsed() < self.silent_after => return Ok(Grabbed::Nothing),
                Ok(0) => return Err(self.gone(format!("no frame for {} ms", self.alive.elapsed().as_millis()))),
                Err(e) if e.kind() == io::ErrorKind::Interrupted => return Ok(Grabbed::Nothing),
                Ok(_) => {}
                Err(e) => return Err(self.gone(e)),
            }
        }
        self.running = true;
        let (header, rows, path) = (self.header(), self.rows, &self.path);
        let (width, height, stride) = (header.width as usize, header.height as usize, self.format.stride as usize);
        let gone = |e: io::Error| CameraError::Gone { camera: path.clone(), reason: e.to_string() };
        let Some(stream) = self.stream.as_mut() else { return Ok(Grabbed::Nothing) };
        let (bytes, meta) = CaptureStream::next(stream).map_err(gone)?;
        let bytes = &bytes[..bytes.len().min(meta.bytesused as usize)];
        self.alive = Instant::now();
        // The kernel counts from 0, where 0 is "none" in a header.
        let camera_frame = u64::from(meta.sequence) + 1;
        let incomplete = |reason: String| Ok(Grabbed::Incomplete { camera_frame, reason });
        if meta.flags.contains(Flags::ERROR) {
            return incomplete("the driver says so".to_owned());
        }
        let len = header.stride as usize * height;
        let mut slot = sink.publisher.take_slot(len)?;
        match rows {
            Rows::Copied(_) => {
                if let Err(e) = FrameLayout::check(&header, bytes.len()) {
                    return incomplete(e.to_string());
                }
                // The last row may come without its padding.
                let copied = bytes.len().min(len);
                slot.bytes()[..copied].copy_from_slice(&bytes[..copied]);
            }
            Rows::FromYuyv => {
                if !yuyv::to_rgb(bytes, width, height, stride, slot.bytes()) {
                    return incomplete(format!("{} bytes of YUYV for {width} x {height} px", bytes.len()));
                }
            }
        }
        let time = Duration::from(meta.timestamp);
        let camera_time_ns = u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
        sink.send(slot, FrameHeader { camera_frame, camera_time_ns, timestamp_ns: unix_time_ns(), ..header })?;
        Ok(Grabbed::Frame { camera_frame })
    }
}

impl Drop for Video {
    fn drop(&mut self) {
        // The crate panics when a camera that was pulled out cannot be told to stop.
        let stream = self.stream.take();
        if catch_unwind(AssertUnwindSafe(|| drop(stream))).is_err() {
            warn!(camera = %self.path, "could not be told to stop");
        }
    }
}

/// Sets size and format, and says how rows are to be read.
fn set_format(device: &Device, path: &str, config: &ClientConfig) -> Result<(Rows, Format), CameraError> {
    let gone = |e: io::Error| CameraError::Gone { camera: path.to_owned(), reason: e.to_string() };
    let offered = device.enum_formats().map_err(gone)?;
    let usable: Vec<_> = FORMATS.iter().filter(|(code, _)| offered.iter().any(|o| o.fourcc.repr == **code)).collect();
    let wanted = config.camera.pixel_format;
    let current = device.format().map_err(gone)?;
    let chosen = match wanted {
        Some(wanted) => usable.iter().find(|(_, rows)| rows.format() == wanted),
        None => usable.iter().find(|(code, _)| current.fourcc.repr == **code).or(usable.first()),
    };
    let Some((code, rows)) = chosen else {
        let names: Vec<_> = usable.iter().map(|(_, rows)| format!("{:?}", rows.format().name())).collect();
        let allowed = match names.is_empty() {
            true => "none: it offers no 8-bit Bayer, RGB, BGR, YUYV or grey".to_owned(),
            false => format!("{} with this camera", names.join(", ")),
        };
        let given = wanted.map_or("not given".to_owned(), |wanted| format!("{:?}", wanted.name()));
        return Err(refused("[camera] pixel_format", given, allowed).into());
    };
    let width = config.camera.width_px.unwrap_or(current.width);
    let height = config.camera.height_px.unwrap_or(current.height);
    let set = device.set_format(&Format::new(width, height, FourCC::new(code))).map_err(gone)?;
    // A driver takes what comes next to what was asked for.
    if set.fourcc.repr != **code {
        let format = format!("{:?}", rows.format().name());
        return Err(refused("[camera] pixel_format", format, format!("{} now, says the driver", set.fourcc)).into());
    }
    for (key, wanted, set) in [
        ("[camera] width_px", config.camera.width_px, set.width),
        ("[camera] height_px", config.camera.height_px, set.height),
    ] {
        if let Some(wanted) = wanted.filter(|wanted| *wanted != set) {
            return Err(refused(key, wanted, format!("what this camera has, e.g. {set}")).into());
        }
    }
    Ok((*rows, set))
}

fn set_rate(device: &Device, rate_hz: f64, path: &str) -> Result<(), CameraError> {
    let gone = |e: io::Error| CameraError::Gone { camera: path.to_owned(), reason: e.to_string() };
    // A period in milliseconds; drivers take the nearest that they have.
    let period = v4l::Fraction::new((1000.0 / rate_hz).round().clamp(1.0, 1e9) as u32, 1000);
    let set = device.set_params(&v4l::video::capture::Parameters::new(period)).map_err(gone)?.interval;
    let set_hz = f64::from(set.denominator) / f64::from(set.numerator.max(1));
    if (set_hz - rate_hz).abs() > 0.05 * rate_hz {
        return Err(
            refused("[camera] frame_rate_hz", rate_hz, format!("what this camera has, e.g. {set_hz:.3}")).into()
        );
    }
    Ok(())
}

/// A control with an automatic.
struct Automatic {
    key: &'static str,
    /// Number of the control that switches the automatic.
    mode: u32,
    /// Number of the control of the value.
    value: u32,
    /// The unit of the key in that of the control.
    step: f64,
}

impl Automatic {
    fn apply(
        &self,
        device: &Device,
        controls: &[Description],
        wanted: Option<AutoOr<f64>>,
        path: &str,
    ) -> Result<(), CameraError> {
        let Some(wanted) = wanted else { return Ok(()) };
        let gone = |e: io::Error| CameraError::Gone { camera: path.to_owned(), reason: e.to_string() };
        let set = |id: u32, value: i64| device.set_control(Control { id, value: Value::Integer(value) }).map_err(gone);
        let has = |id: u32| controls.iter().find(|control| control.id == id);
        let (manual, automatic) =
            if self.mode == EXPOSURE_AUTO { (EXPOSURE_MANUAL, EXPOSURE_APERTURE_PRIORITY) } else { (0, 1) };
        match wanted {
            AutoOr::Auto if has(self.mode).is_some() => set(self.mode, automatic),
            AutoOr::Auto => {
                Err(refused(self.key, "\"auto\"", "a number; this camera has no automatic".to_owned()).into())
            }
            AutoOr::Value(value) => {
                let Some(control) = has(self.value) else {
                    return Err(
                        refused(self.key, value, "not with this camera, which has no such control".to_owned()).into()
                    );
                };
                let (min, max) = (control.minimum as f64 * self.step, control.maximum as f64 * self.step);
                if !(min..=max).contains(&value) {
                    return Err(refused(self.key, value, format!("{min} to {max} with this camera")).into());
                }
                if has(self.mode).is_some() {
                    set(self.mode, manual)?;
                }
                set(self.value, (value / self.step).round() as i64)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{CameraSection, Driver};

    fn config(device: &str) -> ClientConfig {
        let camera = CameraSection { driver: Driver::V4l, device: device.to_owned(), ..CameraSection::default() };
        ClientConfig { camera, ..ClientConfig::default() }
    }

    #[test]
    fn a_missing_device_is_looked_for_and_named() {
        let Err(error) = Video::open(&config("/dev/video-that-is-not")) else { panic!("there is none") };
        assert!(matches!(error, CameraError::Gone { .. }), "it may be plugged in: {error:?}");
        assert!(error.to_string().starts_with("/dev/video-that-is-not: No such file"), "{error}");
    }

    #[test]
    fn a_file_that_is_no_camera_is_named() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let path = file.path().to_str().unwrap();
        let Err(error) = Video::open(&config(path)) else { panic!("it is none") };
        assert!(error.to_string().starts_with(path), "{error}");
    }
}
