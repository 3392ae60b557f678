//! The frame client of the command line: a folder of images, sent as a camera would send them.
//!
//! Input: JPEG and PNG files, sorted by name. Output: frames in shared memory at a steady rate. An 8-bit RGB or grey
//! image is decoded straight into the loaned slot, before the moment it is due; when the folder is sent again, its
//! pixels come from a cache (up to [`CACHE_BYTES`]) so that the client leaves the processors to the service.

use std::fmt;
use std::fs::{self, File};
use std::io::{self, BufReader};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use image::{ColorType, DynamicImage, ImageDecoder, ImageError, ImageReader};
use samsod_frame::{
    CameraId, FrameError, FrameLoan, FramePublisher, FrameServiceConfig, MAX_SIDE_PX, PixelFormat, SendError,
    ServiceError,
};

/// Frames a second that can be asked for, least and most.
pub(crate) const RATE_HZ: (f64, f64) = (0.001, 1000.0);

/// Pixels of decoded images that are kept for the next round, bytes.
pub const CACHE_BYTES: usize = 256 << 20;

/// How often a wait looks whether it should end.
const TICK: Duration = Duration::from_millis(20);
/// How long the slots stay mapped after the last frame: a subscriber may be reading it.
pub(crate) const LINGER: Duration = Duration::from_millis(500);

/// What is published, and how fast.
#[derive(Debug, Clone, PartialEq)]
pub struct PublishOptions {
    /// The folder of images.
    pub folder: PathBuf,
    /// Which cell gets them.
    pub service: FrameServiceConfig,
    /// Frames a second, 0.001 to 1000.
    pub rate_hz: f64,
    /// How many frames; without it, every image once, or for ever with `repeat`. More than there are images only with
    /// `repeat`.
    pub count: Option<u64>,
    /// Whether to begin again after the last image.
    pub repeat: bool,
    /// How long to wait for the first subscriber.
    pub wait: Duration,
    /// Name of the camera, at most 31 bytes.
    pub camera: String,
}

impl Default for PublishOptions {
    fn default() -> Self {
        Self {
            folder: PathBuf::from("."),
            service: FrameServiceConfig::default(),
            rate_hz: 10.0,
            count: None,
            repeat: false,
            wait: Duration::from_secs(10),
            camera: "publish".to_owned(),
        }
    }
}

/// How far it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Progress {
    /// Frames sent.
    pub sent: u64,
    /// Frames that will be sent, if that is known.
    pub planned: Option<u64>,
    /// Time since the first frame was due.
    pub elapsed: Duration,
}

/// What happens on the way.
#[derive(Debug)]
pub enum Event<'a> {
    /// The images are known and a subscriber is waited for.
    Waiting {
        /// Number of images.
        images: usize,
    },
    /// A frame was sent.
    Sent(Progress),
    /// An image cannot be decoded, or is too large for a frame, and is left out.
    Skipped {
        /// The file.
        path: &'a Path,
        /// Why.
        reason: &'a str,
    },
}

/// What was sent.
#[derive(Debug, Clone, PartialEq)]
pub struct PublishSummary {
    /// Frames sent.
    pub sent: u64,
    /// Images that can be sent.
    pub images: usize,
    /// Images that cannot.
    pub skipped_files: usize,
    /// Bytes of pixels sent.
    pub bytes: u64,
    /// Time from the first frame to the last.
    pub elapsed: Duration,
    /// Frames that were late by more than a period.
    pub late: u64,
}

impl fmt::Display for PublishSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = self.elapsed.as_secs_f64();
        let rate = if self.sent > 1 && seconds > 0.0 { (self.sent - 1) as f64 / seconds } else { 0.0 };
        write!(
            f,
            "{} frames of {} images sent in {seconds:.1} s ({rate:.1} Hz, {:.1} MB); {} late, {} files skipped",
            self.sent,
            self.images,
            self.bytes as f64 / 1e6,
            self.late,
            self.skipped_files
        )
    }
}

/// Why frames were not published.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PublishError {
    /// The folder cannot be read.
    #[error("cannot read the folder {}: {source}", path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// There is nothing to send.
    #[error("no image in {}: {files} files end in .jpg, .jpeg or .png and none of them can be sent", path.display())]
    NoImage {
        /// The folder.
        path: PathBuf,
        /// Files that look like images.
        files: usize,
    },
    /// The rate is not one.
    #[error("rate is {rate_hz} Hz; {} to {} Hz are allowed", RATE_HZ.0, RATE_HZ.1)]
    Rate {
        /// The rate given, Hz.
        rate_hz: f64,
    },
    /// More frames are asked for than there are images, and none may be sent twice.
    #[error(
        "{count} frames are asked for, but {} has {images} images; --loop begins again after the last",
        path.display()
    )]
    Count {
        /// The folder.
        path: PathBuf,
        /// Frames asked for.
        count: u64,
        /// Images that can be sent.
        images: usize,
    },
    /// Nobody subscribed.
    #[error("no subscriber on cell {cell:?} within {waited_s:.1} s; is samsodd running with this name and root_path?")]
    NoSubscriber {
        /// Name of the cell.
        cell: String,
        /// How long was waited, s.
        waited_s: f64,
    },
    /// The name of the camera does not fit into a header.
    #[error("camera: {0}")]
    Camera(#[source] FrameError),
    /// The shared memory cannot be used.
    #[error(transparent)]
    Service(#[from] ServiceError),
    /// A frame cannot be sent.
    #[error(transparent)]
    Send(#[from] SendError),
}

/// Publishes a folder until it is done, or until `stop` is set.
///
/// # Errors
/// [`PublishError`]; a single file that is no image is no error but an [`Event::Skipped`].
pub fn run(
    options: &PublishOptions,
    stop: &AtomicBool,
    events: &mut dyn FnMut(&Event<'_>),
) -> Result<PublishSummary, PublishError> {
    // NaN is in no range. A period beyond the least rate would not fit into a duration.
    if !(RATE_HZ.0..=RATE_HZ.1).contains(&options.rate_hz) {
        return Err(PublishError::Rate { rate_hz: options.rate_hz });
    }
    let camera = CameraId::new(&options.camera).map_err(PublishError::Camera)?;
    let mut source = Source::open(&options.folder, if options.repeat { CACHE_BYTES } else { 0 }, events)?;
    if let Some(count) = options.count
        && !options.repeat
        && count > source.files.len() as u64
    {
        return Err(PublishError::Count { path: options.folder.clone(), count, images: source.files.len() });
    }
    let service = FrameServiceConfig { max_frame_bytes: source.largest, ..options.service.clone() };
    let mut publisher = FramePublisher::open(&service, camera)?;
    events(&Event::Waiting { images: source.files.len() });
    let mut summary = PublishSummary {
        sent: 0,
        images: source.files.len(),
        skipped_files: source.skipped,
        bytes: 0,
        elapsed: Duration::ZERO,
        late: 0,
    };
    if !wait_for_subscriber(&publisher, &options.service.cell, options.wait, stop)? {
        return Ok(summary);
    }

    let period = Duration::from_secs_f64(1.0 / options.rate_hz);
    let planned = match (options.count, options.repeat) {
        (None, true) => None,
        (None, false) => Some(source.files.len() as u64),
        (Some(count), _) => Some(count),
    };
    let mut first = None;
    let mut due = Instant::now();
    let mut index = 0;
    while planned.is_none_or(|planned| summary.sent < planned) && !stop.load(Ordering::Relaxed) {
        if index == source.files.len() {
            if !options.repeat {
                break;
            }
            index = 0;
        }
        // Decoded into the slot before it is due.
        let bytes = match source.load_into(index, &mut publisher)? {
            Ok((loan, bytes)) => {
                if !sleep_until(due, stop) {
                    break;
                }
                loan.send()?;
                bytes
            }
            Err(e) => {
                events(&Event::Skipped { path: &source.files[index].path, reason: &e.to_string() });
                source.files.remove(index);
                summary.skipped_files += 1;
                summary.images -= 1;
                if source.files.is_empty() {
                    let files = summary.skipped_files;
                    return Err(PublishError::NoImage { path: options.folder.clone(), files });
                }
                continue;
            }
        };
        index += 1;
        let now = Instant::now();
        let start = *first.get_or_insert(now);
        summary.sent += 1;
        summary.bytes += bytes as u64;
        summary.elapsed = now - start;
        events(&Event::Sent(Progress { sent: summary.sent, planned, elapsed: summary.elapsed }));
        due += period;
        if now > due {
            // Late by more than a period: go on from here rather than send a burst.
            summary.late += 1;
            due = now;
        }
    }
    sleep_until(Instant::now() + LINGER, stop);
    Ok(summary)
}

/// False when it was told to stop.
pub(crate) fn wait_for_subscriber(
    publisher: &FramePublisher,
    cell: &str,
    wait: Duration,
    stop: &AtomicBool,
) -> Result<bool, PublishError> {
    let start = Instant::now();
    while publisher.subscribers() == 0 {
        if stop.load(Ordering::Relaxed) {
            return Ok(false);
        }
        if start.elapsed() >= wait {
            return Err(PublishError::NoSubscriber { cell: cell.to_owned(), waited_s: wait.as_secs_f64() });
        }
        thread::sleep(TICK);
    }
    Ok(true)
}

/// False when it was told to stop.
pub(crate) fn sleep_until(due: Instant, stop: &AtomicBool) -> bool {
    loop {
        if stop.load(Ordering::Relaxed) {
            return false;
        }
        let left = due.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return true;
        }
        // A signal does not end a sleep, so sleep in pieces.
        thread::sleep(left.min(TICK));
    }
}

/// The images of a folder.
struct Source {
    files: Vec<ImageFile>,
    /// Bytes of the largest frame.
    largest: usize,
    skipped: usize,
    /// Bytes that may still be kept for the next round.
    cache_left: usize,
}

struct ImageFile {
    path: PathBuf,
    cached: Option<Decoded>,
}

struct Decoded {
    width: u32,
    height: u32,
    format: PixelFormat,
    pixels: Vec<u8>,
}

/// A slot with the pixels of an image and their number of bytes, or why the file is no image.
type Loaded<'a> = Result<(FrameLoan<'a>, usize), ImageError>;

impl Source {
    /// Lists the images of a folder and reads their sizes, which decide how much shared memory is reserved.
    fn open(folder: &Path, cache_bytes: usize, events: &mut dyn FnMut(&Event<'_>)) -> Result<Self, PublishError> {
        let error = |source| PublishError::Folder { path: folder.to_owned(), source };
        let mut paths = Vec::new();
        for entry in fs::read_dir(folder).map_err(error)? {
            let path = entry.map_err(error)?.path();
            let extension = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
            if matches!(extension.as_deref(), Some("jpg" | "jpeg" | "png")) {
                paths.push(path);
            }
        }
        paths.sort_unstable();
        let count = paths.len();
        let mut source = Self { files: Vec::new(), largest: 1, skipped: 0, cache_left: cache_bytes };
        for path in paths {
            match open_image(&path).map(|decoder| decoder.dimensions()) {
                Ok((width, height)) if width > MAX_SIDE_PX || height > MAX_SIDE_PX => {
                    source.skipped += 1;
                    let reason = format!(
                        "it is {width} x {height} px; at most {MAX_SIDE_PX} x {MAX_SIDE_PX} px fit into a frame"
                    );
                    events(&Event::Skipped { path: &path, reason: &reason });
                }
                Ok((width, height)) => {
                    source.largest = source.largest.max(width as usize * height as usize * 3);
                    source.files.push(ImageFile { path, cached: None });
                }
                Err(e) => {
                    source.skipped += 1;
                    events(&Event::Skipped { path: &path, reason: &e.to_string() });
                }
            }
        }
        if source.files.is_empty() {
            return Err(PublishError::NoImage { path: folder.to_owned(), files: count });
        }
        Ok(source)
    }

    /// Puts image `index` into a slot.
    fn load_into<'p>(&mut self, index: usize, publisher: &'p mut FramePublisher) -> Result<Loaded<'p>, SendError> {
        let file = &mut self.files[index];
        if let Some(image) = &file.cached {
            let mut loan = publisher.loan(image.width, image.height, image.format)?;
            // The one copy of a frame that was decoded in an earlier round.
            loan.pixels().copy_from_slice(&image.pixels);
            return Ok(Ok((loan, image.pixels.len())));
        }
        let decoder = match open_image(&file.path) {
            Ok(decoder) => decoder,
            Err(e) => return Ok(Err(e)),
        };
        let (width, height) = decoder.dimensions();
        let direct = match decoder.color_type() {
            ColorType::Rgb8 => Some(PixelFormat::Rgb8),
            ColorType::L8 => Some(PixelFormat::Mono8),
            _ => None,
        };
        let format = direct.unwrap_or(PixelFormat::Rgb8);
        let mut loan = publisher.loan(width, height, format)?;
        let decoded = match direct {
            Some(_) => decoder.read_image(loan.pixels()),
            // 16 bits, an alpha channel, a palette: converted, then copied into the slot.
            None => DynamicImage::from_decoder(decoder).map(|image| loan.pixels().copy_from_slice(&image.into_rgb8())),
        };
        if let Err(e) = decoded {
            return Ok(Err(e));
        }
        let bytes = loan.pixels().len();
        if bytes <= self.cache_left {
            self.cache_left -= bytes;
            // A copy for the next round; without one there is no budget, and no copy.
            file.cached = Some(Decoded { width, height, format, pixels: loan.pixels().to_vec() });
        }
        Ok(Ok((loan, bytes)))
    }
}

fn open_image(path: &Path) -> Result<impl ImageDecoder + use<>, ImageError> {
    let file = BufReader::new(File::open(path)?);
    ImageReader::new(file).with_guessed_format()?.into_decoder()
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{GrayImage, Luma, Rgb, RgbImage, Rgba, RgbaImage};
    use samsod_frame::{Frame, FrameSubscriber};

    /// A folder of images, and shared memory of its own below it.
    fn cell() -> (tempfile::TempDir, PublishOptions) {
        let folder = tempfile::Builder::new().prefix("samsod-").tempdir_in("/tmp").unwrap();
        let images = folder.path().join("images");
        fs::create_dir(&images).unwrap();
        let service = FrameServiceConfig {
            root_path: Some(folder.path().join("shm")),
            buffer_frames: 16,
            borrowed_frames: 16,
            ..FrameServiceConfig::for_cell("publish-test")
        };
        let options = PublishOptions { folder: images, service, rate_hz: 1000.0, ..PublishOptions::default() };
        (folder, options)
    }

    fn publish(options: &PublishOptions) -> (Result<PublishSummary, PublishError>, Vec<String>) {
        let mut told = Vec::new();
        let result = run(options, &AtomicBool::new(false), &mut |event| told.push(format!("{event:?}")));
        (result, told)
    }

    /// Every frame that is sent, in order. The client is throttled so that none is overwritten.
    fn receive(options: &PublishOptions) -> (PublishSummary, Vec<Frame>) {
        let mut subscriber = FrameSubscriber::open(&options.service).unwrap();
        let mut frames = Vec::new();
        let summary = run(options, &AtomicBool::new(false), &mut |event| {
            if matches!(event, Event::Sent(_)) {
                frames.push(subscriber.wait(Duration::from_secs(30)).unwrap().unwrap());
            }
        });
        (summary.unwrap(), frames)
    }

    #[test]
    fn images_go_out_sorted_each_in_its_format() {
        let (_folder, mut options) = cell();
        let at = |name: &str| options.folder.join(name);
        RgbImage::from_pixel(3, 2, Rgb([1, 2, 3])).save(at("b.png")).unwrap();
        GrayImage::from_pixel(2, 2, Luma([7])).save(at("a.PNG")).unwrap();
        RgbaImage::from_pixel(1, 1, Rgba([9, 8, 7, 255])).save(at("c.png")).unwrap();
        fs::write(at("d.jpg"), "no image at all").unwrap();
        fs::write(at("notes.txt"), "not looked at").unwrap();
        options.count = Some(7);
        options.repeat = true;
        let (summary, frames) = receive(&options);
        assert_eq!((summary.sent, summary.images, summary.skipped_files), (7, 3, 1));
        let expected: [(PixelFormat, &[u8]); 3] =
            [(PixelFormat::Mono8, &[7; 4]), (PixelFormat::Rgb8, &[1, 2, 3].repeat(6)), (PixelFormat::Rgb8, &[9, 8, 7])];
        for (i, frame) in frames.iter().enumerate() {
            let (format, bytes) = expected[i % 3];
            assert_eq!((frame.sequence(), frame.layout().format(), frame.bytes()), (i as u64, format, bytes));
            assert_eq!(frame.camera(), "publish");
        }
        let text = summary.to_string();
        assert!(text.starts_with("7 frames of 3 images sent in "), "{text}");
    }

    #[test]
    fn without_repeat_every_image_goes_out_once() {
        let (_folder, options) = cell();
        for name in ["1.png", "2.png"] {
            RgbImage::new(2, 2).save(options.folder.join(name)).unwrap();
        }
        assert_eq!(receive(&options).0.sent, 2);
        assert_eq!(receive(&PublishOptions { count: Some(1), ..options }).0.sent, 1);
    }

    #[test]
    fn an_image_that_breaks_off_is_left_out() {
        let (_folder, options) = cell();
        let whole = options.folder.join("2.png");
        RgbImage::from_fn(64, 64, |x, y| Rgb([x as u8, y as u8, (x * y) as u8])).save(&whole).unwrap();
        let bytes = fs::read(&whole).unwrap();
        fs::write(options.folder.join("1.png"), &bytes[..bytes.len() / 2]).unwrap();
        let (summary, frames) = receive(&options);
        assert_eq!((summary.sent, summary.images, summary.skipped_files), (1, 1, 1));
        assert_eq!(frames.len(), 1);
    }

    #[test]
    fn the_slowest_rate_still_has_a_period() {
        let (_folder, mut options) = cell();
        options.rate_hz = RATE_HZ.0;
        RgbImage::new(2, 2).save(options.folder.join("1.png")).unwrap();
        assert_eq!(receive(&options).0.sent, 1);
    }

    #[test]
    fn an_image_too_large_for_a_frame_is_left_out_by_name() {
        let (_folder, options) = cell();
        let at = |name: &str| options.folder.join(name);
        RgbImage::new(2, 2).save(at("1.png")).unwrap();
        GrayImage::new(MAX_SIDE_PX + 1, 1).save(at("2.png")).unwrap();
        // A small file whose header promises 12.9 GB.
        let mut bytes = fs::read(at("1.png")).unwrap();
        bytes[16..24].copy_from_slice(&[0, 0, 0xff, 0xff, 0, 0, 0xff, 0xff]);
        let crc = crc32(&bytes[12..29]).to_be_bytes();
        bytes[29..33].copy_from_slice(&crc);
        fs::write(at("3.png"), bytes).unwrap();
        let _subscriber = FrameSubscriber::open(&options.service).unwrap();
        let (summary, told) = publish(&options);
        let summary = summary.unwrap();
        assert_eq!((summary.sent, summary.images, summary.skipped_files), (1, 1, 2));
        for (name, size) in [("2.png", "16385 x 1 px"), ("3.png", "65535 x 65535 px")] {
            let expected = format!("it is {size}; at most 16384 x 16384 px fit into a frame");
            assert!(told.iter().any(|event| event.contains(name) && event.contains(&expected)), "{told:?}");
        }
    }

    /// Checksum of a PNG chunk.
    fn crc32(bytes: &[u8]) -> u32 {
        !bytes.iter().fold(u32::MAX, |crc, &byte| {
            (0..8).fold(crc ^ u32::from(byte), |crc, _| (crc >> 1) ^ (0xedb8_8320 & (crc & 1).wrapping_neg()))
        })
    }

    #[test]
    fn more_frames_than_images_need_a_loop() {
        let (_folder, options) = cell();
        for name in ["1.png", "2.png"] {
            RgbImage::new(2, 2).save(options.folder.join(name)).unwrap();
        }
        let options = PublishOptions { count: Some(30), ..options };
        let (result, told) = publish(&options);
        let expected = format!(
            "30 frames are asked for, but {} has 2 images; --loop begins again after the last",
            options.folder.display()
        );
        assert_eq!(result.unwrap_err().to_string(), expected);
        assert!(told.is_empty(), "{told:?}");
        assert_eq!(receive(&PublishOptions { count: Some(2), ..options.clone() }).0.sent, 2);
        assert_eq!(receive(&PublishOptions { count: Some(3), repeat: true, ..options }).0.sent, 3);
    }

    #[test]
    fn refusals() {
        let (_folder, options) = cell();
        let (result, _) = publish(&options);
        assert!(matches!(result, Err(PublishError::NoImage { files: 0, .. })), "{result:?}");
        fs::write(options.folder.join("a.jpg"), "no image at all").unwrap();
        let (result, told) = publish(&options);
        assert!(matches!(result, Err(PublishError::NoImage { files: 1, .. })), "{result:?}");
        assert!(told[0].contains("a.jpg"), "{told:?}");
        for rate_hz in [0.0, -1.0, f64::NAN, f64::INFINITY, 1001.0, 1e-20, 0.000_999] {
            let (result, _) = publish(&PublishOptions { rate_hz, ..options.clone() });
            let refusal = result.unwrap_err().to_string();
            assert_eq!(refusal, format!("rate is {rate_hz} Hz; 0.001 to 1000 Hz are allowed"));
        }
        let (result, _) = publish(&PublishOptions { folder: "/no/such/folder".into(), ..options.clone() });
        assert!(matches!(result, Err(PublishError::Folder { .. })), "{result:?}");
        RgbImage::new(1, 1).save(options.folder.join("b.png")).unwrap();
        let (result, told) = publish(&PublishOptions { wait: Duration::ZERO, ..options });
        assert!(matches!(result, Err(PublishError::NoSubscriber { .. })), "{result:?}");
        assert!(told.iter().any(|event| event == "Waiting { images: 1 }"), "{told:?}");
    }
}
