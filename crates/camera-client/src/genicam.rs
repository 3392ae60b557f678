//! GigE Vision and USB3 Vision cameras, through Aravis.
//!
//! Input: the camera of a [`ClientConfig`]. Output: its frames, received where they are sent from: each buffer that Aravis fills is
//! a slot of shared memory. Cost: no copy; one small allocation a frame.
//!
//! A buffer owns its slot through the callback that Aravis runs when the buffer is destroyed. So the memory stays valid for as long
//! as Aravis may write to it, whoever still holds the buffer, also on ways out that were not thought of.

use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use aravis::glib;
use aravis::glib::object::Cast;
use aravis::prelude::*;
use aravis::{AcquisitionMode, Aravis, Auto, Buffer, BufferPayloadType, BufferStatus, Camera, GvStream, Stream};
use aravis::{GvPacketSizeAdjustment, GvStreamOption, GvStreamPacketResend, GvStreamSocketBuffer};
use samsod_frame::{FrameHeader, FramePublisher, FrameSlot, PixelFormat, SendError};
use tracing::{debug, warn};

use crate::config::{AutoOr, CameraSection, ClientConfig, ConfigError, refused};
use crate::source::{CameraError, Grabbed, Sink, Source};

/// The formats of GenICam that a frame can have.
const FORMATS: [(PixelFormat, aravis::PixelFormat); 7] = [
    (PixelFormat::BayerRg8, aravis::PixelFormat::BAYER_RG_8),
    (PixelFormat::BayerGr8, aravis::PixelFormat::BAYER_GR_8),
    (PixelFormat::BayerGb8, aravis::PixelFormat::BAYER_GB_8),
    (PixelFormat::BayerBg8, aravis::PixelFormat::BAYER_BG_8),
    (PixelFormat::Rgb8, aravis::PixelFormat::RGB_8_PACKED),
    (PixelFormat::Bgr8, aravis::PixelFormat::BGR_8_PACKED),
    (PixelFormat::Mono8, aravis::PixelFormat::MONO_8),
];

/// Frames that the kernel may keep for a thread that is not running at the moment.
const SOCKET_FRAMES: usize = 4;
/// Bytes that it may keep at least.
const SMALLEST_SOCKET_BUFFER: usize = 1 << 20;

/// A camera on the network or the USB.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FoundCamera {
    /// What `[camera] device` may say.
    pub id: String,
    /// Vendor and model.
    pub model: String,
    /// Address in the network or on the bus.
    pub address: String,
    /// `"GigEVision"` or `"USB3Vision"`.
    pub protocol: String,
}

/// The cameras that answer now; takes about a second. None when this process has asked before.
pub fn list_cameras() -> Vec<FoundCamera> {
    let Ok(aravis) = Aravis::initialize() else { return Vec::new() };
    let text = |text: &std::ffi::CString| text.to_string_lossy().into_owned();
    let found = aravis.get_device_list().into_iter();
    let found = found.map(|camera| FoundCamera {
        id: text(&camera.id),
        model: format!("{} {}", text(&camera.vendor), text(&camera.model)),
        address: text(&camera.address),
        protocol: text(&camera.protocol),
    });
    found.collect()
}

/// A camera that is set up and delivers.
pub(crate) struct Genicam {
    // The stream before its camera: they are dropped in this order. Its thread ends, then its buffers return their slots.
    stream: Stream,
    camera: Camera,
    id: String,
    model: String,
    payload: usize,
    buffers: usize,
    /// What buffers in Aravis' hands write to, by address.
    filling: Vec<(usize, SharedSlot)>,
    /// Set by Aravis when the camera does not answer any more.
    lost: Arc<AtomicBool>,
    silent_after: Duration,
    triggered: bool,
    trigger_period: Option<Duration>,
    next_trigger: Instant,
    /// When a buffer came, or when the camera last answered.
    alive: Instant,
    running: bool,
}

/// A slot that a buffer and [`Genicam::filling`] both know: taken out when its frame is sent.
type SharedSlot = Arc<Mutex<Option<FrameSlot>>>;

impl Genicam {
    pub(crate) fn open(config: &ClientConfig) -> Result<Self, CameraError> {
        let wanted = if config.camera.device.is_empty() { None } else { Some(config.camera.device.as_str()) };
        let called = wanted.unwrap_or("the first GenICam camera");
        let gone = |e: glib::Error| CameraError::Gone { camera: called.to_owned(), reason: e.to_string() };
        // It looks through the network by itself.
        let camera = Camera::new(wanted).map_err(gone)?;
        let id = camera.device_id().map_err(gone)?.to_string();
        let model = match (camera.vendor_name(), camera.model_name()) {
            (Ok(vendor), Ok(model)) => format!("{vendor} {model}"),
            _ => "unknown model".to_owned(),
        };
        let lost = Arc::new(AtomicBool::new(false));
        if let Some(device) = camera.device() {
            let lost = Arc::clone(&lost);
            device.connect_control_lost(move |_| lost.store(true, Ordering::Relaxed));
        }
        set_up(&camera, &id, config)?;
        let gone = |e: glib::Error| CameraError::Gone { camera: id.clone(), reason: e.to_string() };
        let payload = camera.payload().map_err(gone)? as usize;
        let stream = camera.create_stream().map_err(gone)?;
        if let Some(stream) = stream.downcast_ref::<GvStream>() {
            let resend = if config.gige.resend { GvStreamPacketResend::Always } else { GvStreamPacketResend::Never };
            stream.set_packet_resend(resend);
            stream.set_frame_retention(config.gige.frame_retention_ms * 1000);
            // By itself Aravis asks for room for one frame, of which the kernel's bookkeeping takes a part: packets are lost as
            // soon as this thread has to wait for a processor. The kernel gives no more than net.core.rmem_max.
            stream.set_socket_buffer(GvStreamSocketBuffer::Fixed);
            let bytes = payload.saturating_mul(SOCKET_FRAMES).max(SMALLEST_SOCKET_BUFFER);
            stream.set_socket_buffer_size(i32::try_from(bytes).unwrap_or(i32::MAX));
        }
        let now = Instant::now();
        Ok(Self {
            stream,
            camera,
            id,
            model,
            payload,
            buffers: config.camera.buffers,
            filling: Vec::new(),
            lost,
            silent_after: Duration::from_millis(config.reconnect.silent_after_ms),
            triggered: config.camera.is_triggered(),
            trigger_period: config.camera.trigger_rate_hz.map(|rate| Duration::from_secs_f64(1.0 / rate)),
            next_trigger: now,
            alive: now,
            running: false,
        })
    }

    fn gone(&self, reason: impl Into<String>) -> CameraError {
        CameraError::Gone { camera: self.id.clone(), reason: reason.into() }
    }

    /// Hands Aravis a slot to fill.
    fn push_slot(&mut self, publisher: &mut FramePublisher) -> Result<(), SendError> {
        let mut slot = publisher.take_slot(self.payload)?;
        let (address, len) = (slot.as_mut_ptr(), slot.len());
        let slot: SharedSlot = Arc::new(Mutex::new(Some(slot)));
        let owner = Arc::clone(&slot);
        // The memory is that of a slot which nobody else writes to. It stays valid until the callback runs, for the callback owns
        // the slot with us, and we take it out only when Aravis has given the buffer back.
        let buffer = Buffer::new_preallocated_owned(address, len, move || drop(owner));
        self.filling.push((address as usize, slot));
        self.stream.push_buffer(buffer);
        Ok(())
    }

    fn start(&mut self, publisher: &mut FramePublisher) -> Result<(), CameraError> {
        for _ in 0..self.buffers {
            self.push_slot(publisher)?;
        }
        self.camera.start_acquisition().map_err(|e| self.gone(e.to_string()))?;
        self.running = true;
        self.alive = Instant::now();
        self.next_trigger = self.alive;
        Ok(())
    }

    /// Nothing came: whether the camera is still there.
    fn after_silence(&mut self) -> Result<Grabbed, CameraError> {
        if self.lost.load(Ordering::Relaxed) {
            return Err(self.gone("it does not answer any more"));
        }
        if self.alive.elapsed() < self.silent_after {
            return Ok(Grabbed::Nothing);
        }
        if !self.triggered {
            return Err(self.gone(format!("no frame for {} ms", self.alive.elapsed().as_millis())));
        }
        // Nobody may have triggered it.
        self.camera.payload().map_err(|e| self.gone(e.to_string()))?;
        self.alive = Instant::now();
        Ok(Grabbed::Nothing)
    }

    /// A buffer that Aravis has given back.
    fn take(&mut self, buffer: Buffer, sink: &mut Sink<'_>) -> Result<Grabbed, CameraError> {
        self.alive = Instant::now();
        let camera_frame = buffer.frame_id();
        match header_of(&buffer) {
            Err(reason) => {
                // It is filled anew from its beginning.
                self.stream.push_buffer(buffer);
                Ok(Grabbed::Incomplete { camera_frame, reason })
            }
            Ok(header) => {
                let address = buffer.data().0 as usize;
                drop(buffer);
                let found = self.filling.iter().position(|(filling, _)| *filling == address);
                let slot = found.map(|index| self.filling.swap_remove(index).1);
                let slot = slot.and_then(|slot| slot.lock().unwrap_or_else(PoisonError::into_inner).take());
                let Some(slot) = slot else { return Err(self.gone("a buffer came back that was not handed out")) };
                sink.send(slot, header)?;
                self.push_slot(sink.publisher)?;
                Ok(Grabbed::Frame { camera_frame })
            }
        }
    }
}

impl Source for Genicam {
    fn frame_bytes(&self) -> usize {
        self.payload
    }

    fn slots(&self) -> usize {
        self.buffers
    }

    fn describe(&self) -> String {
        format!("{} ({})", self.id, self.model)
    }

    fn next(&mut self, sink: &mut Sink<'_>, timeout: Duration) -> Result<Grabbed, CameraError> {
        if !self.running {
            self.start(sink.publisher)?;
        }
        let mut wait = timeout;
        if let Some(period) = self.trigger_period {
            let now = Instant::now();
            if now >= self.next_trigger {
                self.camera.software_trigger().map_err(|e| self.gone(e.to_string()))?;
                // Late by more than a period: go on from here rather than send a burst.
                self.next_trigger =
                    if now > self.next_trigger + period { now + period } else { self.next_trigger + period };
            }
            wait = wait.min(self.next_trigger.saturating_duration_since(now));
        }
        match self.stream.timeout_pop_buffer(u64::try_from(wait.as_micros()).unwrap_or(u64::MAX)) {
            Some(buffer) => self.take(buffer, sink),
            None => self.after_silence(),
        }
    }
}

impl Drop for Genicam {
    fn drop(&mut self) {
        // A camera that is gone would be asked again and again, for seconds.
        let answers = self.running && !self.lost.load(Ordering::Relaxed) && self.alive.elapsed() < self.silent_after;
        if answers && let Err(e) = self.camera.stop_acquisition() {
            debug!(camera = %self.id, error = %e, "acquisition not stopped");
        }
    }
}

/// The header of a whole frame, or what is wrong with it.
fn header_of(buffer: &Buffer) -> Result<FrameHeader, String> {
    match buffer.status() {
        BufferStatus::Success => {}
        BufferStatus::MissingPackets => return Err("packets are missing".to_owned()),
        BufferStatus::Timeout => return Err("packets did not come in time".to_owned()),
        BufferStatus::SizeMismatch => return Err("it is larger than the camera had announced".to_owned()),
        status => return Err(format!("{status:?}")),
    }
    match buffer.payload_type() {
        BufferPayloadType::Image | BufferPayloadType::ExtendedChunkData => {}
        payload => return Err(format!("it is no image but {payload:?}")),
    }
    let raw = buffer.image_pixel_format();
    let Some((format, _)) = FORMATS.iter().find(|(_, genicam)| *genicam == raw) else {
        return Err(format!("its pixel format {:#010x} cannot be used", raw.raw()));
    };
    let side = |value: i32| u32::try_from(value).unwrap_or(0);
    let (width, height) = (side(buffer.image_width()), side(buffer.image_height()));
    let stride = u64::from(width) * format.bytes_per_pixel() as u64 + u64::from(side(buffer.image_padding().0));
    Ok(FrameHeader {
        // When its first packet came. 0, where that is not known, becomes the time of sending.
        timestamp_ns: buffer.system_timestamp(),
        width,
        height,
        stride: u32::try_from(stride).unwrap_or(u32::MAX),
        pixel_format: *format as u32,
        camera_frame: buffer.frame_id(),
        camera_time_ns: buffer.timestamp(),
        ..FrameHeader::default()
    })
}

/// Sets everything that the configuration gives. A value that the camera does not take is a [`CameraError::Setting`]; a camera
/// that stops to answer meanwhile is [`CameraError::Gone`].
fn set_up(camera: &Camera, id: &str, config: &ClientConfig) -> Result<(), CameraError> {
    let gone = |e: glib::Error| CameraError::Gone { camera: id.to_owned(), reason: e.to_string() };
    let section = &config.camera;
    camera.set_acquisition_mode(AcquisitionMode::Continuous).map_err(gone)?;
    set_format(camera, section.pixel_format).map_err(|e| e.or_gone(gone))?;
    set_region(camera, section).map_err(|e| e.or_gone(gone))?;
    if section.is_triggered() {
        let sources = camera.dup_available_trigger_sources().map_err(gone)?;
        if !sources.iter().any(|source| source.as_str() == section.trigger) {
            let sources: Vec<_> = sources.iter().map(|source| format!("{:?}", source.as_str())).collect();
            let allowed = format!("\"off\", {} with this camera", sources.join(", "));
            return Err(refused("[camera] trigger", format!("{:?}", section.trigger), allowed).into());
        }
        let set = camera.set_trigger(&section.trigger);
        taken(camera, "[camera] trigger", format!("{:?}", section.trigger), set).map_err(|e| e.or_gone(gone))?;
    } else {
        camera.clear_triggers().map_err(gone)?;
    }
    if let Some(rate) = section.frame_rate_hz {
        set_frame_rate(camera, rate).map_err(|e| e.or_gone(gone))?;
    }
    let exposure = Control {
        key: "[camera] exposure_us",
        auto_feature: "ExposureAuto",
        set_auto: &|auto| camera.set_exposure_time_auto(auto),
        bounds: &|| camera.exposure_time_bounds(),
        set: &|value| camera.set_exposure_time(value),
    };
    exposure.apply(camera, section.exposure_us).map_err(|e| e.or_gone(gone))?;
    let gain = Control {
        key: "[camera] gain",
        auto_feature: "GainAuto",
        set_auto: &|auto| camera.set_gain_auto(auto),
        bounds: &|| camera.gain_bounds(),
        set: &|value| camera.set_gain(value),
    };
    gain.apply(camera, section.gain).map_err(|e| e.or_gone(gone))?;
    if camera.is_gv_device() {
        set_packets(camera, config).map_err(|e| e.or_gone(gone))?;
    }
    Ok(())
}

/// Why a value could not be set.
enum SetError {
    Refused(ConfigError),
    Device(glib::Error),
}

impl SetError {
    fn or_gone(self, gone: impl Fn(glib::Error) -> CameraError) -> CameraError {
        match self {
            Self::Refused(e) => e.into(),
            Self::Device(e) => gone(e),
        }
    }
}

impl From<glib::Error> for SetError {
    fn from(error: glib::Error) -> Self {
        Self::Device(error)
    }
}

impl From<ConfigError> for SetError {
    fn from(error: ConfigError) -> Self {
        Self::Refused(error)
    }
}

/// What an answer of the camera to a value of the configuration means: it may not take the value, or not be there any more.
fn taken<T>(
    camera: &Camera,
    key: &'static str,
    value: impl fmt::Display,
    answer: Result<T, glib::Error>,
) -> Result<T, SetError> {
    answer.map_err(|e| match camera.payload() {
        Ok(_) => refused(key, value, format!("what this camera takes as it is set; it says: {e}")).into(),
        Err(e) => e.into(),
    })
}

fn set_frame_rate(camera: &Camera, rate_hz: f64) -> Result<(), SetError> {
    let key = "[camera] frame_rate_hz";
    check_bounds(key, rate_hz, taken(camera, key, rate_hz, camera.frame_rate_bounds())?)?;
    taken(camera, key, rate_hz, camera.set_frame_rate(rate_hz))
}

fn set_format(camera: &Camera, wanted: Option<PixelFormat>) -> Result<(), SetError> {
    let offered = camera.dup_available_pixel_formats()?;
    let usable: Vec<_> = FORMATS.iter().filter(|(_, genicam)| offered.contains(&i64::from(genicam.raw()))).collect();
    let names = usable.iter().map(|(format, _)| format!("{:?}", format.name())).collect::<Vec<_>>().join(", ");
    let genicam = match wanted {
        Some(wanted) => usable.iter().find(|(format, _)| *format == wanted).ok_or_else(|| {
            refused("[camera] pixel_format", format!("{:?}", wanted.name()), format!("{names} with this camera"))
        })?,
        None => {
            let current = camera.pixel_format()?;
            let kept = usable.iter().find(|(_, genicam)| *genicam == current);
            kept.or(usable.first()).ok_or_else(|| {
                let allowed = "a camera with 8-bit Bayer, RGB, BGR or grey".to_owned();
                refused("[camera] device", "a camera without a format that can be used", allowed)
            })?
        }
    };
    Ok(camera.set_pixel_format(genicam.1)?)
}

fn set_region(camera: &Camera, section: &CameraSection) -> Result<(), SetError> {
    let given = [
        ("[camera] offset_x_px", section.offset_x_px),
        ("[camera] offset_y_px", section.offset_y_px),
        ("[camera] width_px", section.width_px),
        ("[camera] height_px", section.height_px),
    ];
    let Some((first_key, first)) = given.iter().find_map(|(key, value)| value.map(|value| (*key, value))) else {
        return Ok(());
    };
    let (x, y, width, height) = camera.region()?;
    let side = |value: Option<u32>, current| value.map_or(Ok(current), i32::try_from).unwrap_or(i32::MAX);
    let (width, height) = (side(section.width_px, width), side(section.height_px, height));
    let bounds =
        [("[camera] width_px", width, camera.width_bounds()?), ("[camera] height_px", height, camera.height_bounds()?)];
    for (key, value, (min, max)) in bounds {
        check_bounds(key, f64::from(value), (f64::from(min), f64::from(max)))?;
    }
    let (x, y) = (side(section.offset_x_px, x), side(section.offset_y_px, y));
    // Aravis sets the offset to 0 before the size, for what fits depends on it.
    taken(camera, first_key, first, camera.set_region(x, y, width, height))?;
    let set = camera.region()?;
    for (key, wanted, set) in [
        ("[camera] offset_x_px", x, set.0),
        ("[camera] offset_y_px", y, set.1),
        ("[camera] width_px", width, set.2),
        ("[camera] height_px", height, set.3),
    ] {
        if wanted != set {
            return Err(refused(
                key,
                wanted,
                format!("what fits on the sensor in the steps of this camera, e.g. {set}"),
            )
            .into());
        }
    }
    Ok(())
}

/// Exposure or gain of a camera.
struct Control<'a> {
    key: &'static str,
    auto_feature: &'static str,
    set_auto: &'a dyn Fn(Auto) -> Result<(), glib::Error>,
    bounds: &'a dyn Fn() -> Result<(f64, f64), glib::Error>,
    set: &'a dyn Fn(f64) -> Result<(), glib::Error>,
}

impl Control<'_> {
    fn apply(&self, camera: &Camera, wanted: Option<AutoOr<f64>>) -> Result<(), SetError> {
        let Some(wanted) = wanted else { return Ok(()) };
        let has_auto = camera.is_feature_available(self.auto_feature).unwrap_or(false);
        match wanted {
            AutoOr::Auto if has_auto => taken(camera, self.key, "\"auto\"", (self.set_auto)(Auto::Continuous)),
            AutoOr::Auto => {
                let (min, max) = taken(camera, self.key, "\"auto\"", (self.bounds)())?;
                Err(refused(self.key, "\"auto\"", format!("{min} to {max}; this camera has no automatic")).into())
            }
            AutoOr::Value(value) => {
                if has_auto {
                    taken(camera, self.key, value, (self.set_auto)(Auto::Off))?;
                }
                check_bounds(self.key, value, taken(camera, self.key, value, (self.bounds)())?)?;
                taken(camera, self.key, value, (self.set)(value))
            }
        }
    }
}

fn check_bounds(key: &'static str, value: f64, (min, max): (f64, f64)) -> Result<(), ConfigError> {
    if (min..=max).contains(&value) {
        Ok(())
    } else {
        Err(refused(key, value, format!("{min} to {max} with this camera as it is set")))
    }
}

fn set_packets(camera: &Camera, config: &ClientConfig) -> Result<(), SetError> {
    match config.gige.packet_size {
        AutoOr::Auto => {
            if let Err(e) = camera.gv_auto_packet_size() {
                // Cameras without test packets keep what they have.
                warn!(error = %e, "largest packet not found; [gige] packet_size sets it by hand");
            }
        }
        AutoOr::Value(bytes) => {
            camera.gv_set_packet_size_adjustment(GvPacketSizeAdjustment::Never);
            let set = camera.gv_set_packet_size(i32::try_from(bytes).unwrap_or(i32::MAX));
            taken(camera, "[gige] packet_size", bytes, set)?;
            let set = camera.gv_get_packet_size()?;
            if set != bytes {
                return Err(refused("[gige] packet_size", bytes, format!("what this camera takes, e.g. {set}")).into());
            }
        }
    }
    // Raw sockets are for root alone, so never there for a service; and where camera and client share a machine, packets do not
    // pass the interface that they are waited for at.
    camera.gv_set_stream_options(GvStreamOption::PACKET_SOCKET_DISABLED);
    if let Some(delay_ns) = config.gige.packet_delay_ns {
        let set = camera.gv_set_packet_delay(i64::from(delay_ns));
        taken(camera, "[gige] packet_delay_ns", delay_ns, set)?;
    }
    Ok(())
}
