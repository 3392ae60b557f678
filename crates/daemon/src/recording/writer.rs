//! The back of the recorder: the thread that encodes and writes.
//!
//! In: [`Queues`](super::recorder::Queues). Out: MCAP files. A chunk is closed and handed to the operating system after each
//! frame, each command and at the latest each second, so that a killed process loses no more than that. A new file
//! is begun when one has grown to its greatest size or age; the index that MCAP keeps in memory until the end stays small so.
//!
//! Free space is looked at twice a second, also while nothing is written. When a write fails, the file is left as far as it came
//! (`samsod recover` closes it), what waits is lost and counted, and a new file is tried every two seconds.

use std::collections::{BTreeMap, VecDeque};
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::{Arc, MutexGuard};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};

use foxglove::Encode;
use image::ImageEncoder;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use mcap::records::MessageHeader;
use samsod_recording::cause_of;

use super::detections::{DetectionMessage, detections};
use super::disk::Disk;
use super::live::LiveView;
use super::messages::{
    RegionMessage, SceneMessage, Topic, compressed_image, descriptions, raw_image, regions, take_back,
};
use super::objects::{ObjectMessage, outlines, places, transforms};
use super::recorder::{FrameSlot, Line, Queues, Shared, json};
use super::retention::{self, Keep, safe_name};
use super::{ImageEncoding, OnLogFailure, RecordError, RecorderConfig, SaliencyEncoding};
use crate::made_with::{self, MadeWith};
use crate::masks;
use crate::picture::region_outlines;
use crate::pulse::{EndsWith, Pulse};

/// Longest time that a line waits to be handed to the operating system.
const FLUSH_INTERVAL: Duration = Duration::from_secs(1);

/// How often free space is looked at.
const LOOK_INTERVAL: Duration = Duration::from_millis(500);

/// How often a new file is tried after a failure.
const RETRY_INTERVAL: Duration = Duration::from_secs(2);

/// How often old recordings are looked for, beside at each new file.
const SWEEP_INTERVAL: Duration = Duration::from_secs(60);

/// Chunks after which a new file is begun even if it is small: the index of each stays in memory.
const MOST_CHUNKS: u64 = 100_000;

/// Whole numbers up to this are exact in 32 bits of floating point.
const MOST_FLOAT_LABELS: usize = 1 << 24;

/// One file being written.
struct Mcap {
    writer: mcap::Writer<BufWriter<Disk>>,
    /// Channel ids, by [`Topic`].
    channels: Vec<u16>,
    path: PathBuf,
    begun: Instant,
    chunks: u64,
    /// Since when something waits to be flushed.
    dirty: Option<Instant>,
    /// Lines among that.
    unflushed_lines: u64,
}

/// Names, opens and fills the files of one recording.
pub(super) struct Writer {
    config: RecorderConfig,
    cell_name: String,
    /// What the frames of this file were seen with.
    made_with: Option<Arc<MadeWith>>,
    /// Folder and beginning of the names of the files.
    stem: PathBuf,
    pulse: Arc<Pulse>,
    /// Viewers get every message as it is written.
    live: Option<LiveView>,
    /// Number of the last file.
    files: u32,
    /// None after a failure, until a new one could be begun.
    file: Option<Mcap>,
    failure: Option<Failure>,
    looked: Option<Instant>,
    swept: Option<Instant>,
    sweep: Option<JoinHandle<()>>,
    /// Size of the files that are closed, bytes.
    closed_bytes: u64,
    sequences: [u32; Topic::Log as usize + 1],
    encoded: Vec<u8>,
    masks: Vec<u8>,
    message: Vec<u8>,
    space_is_short: bool,
}

/// Why there is no file.
struct Failure {
    path: PathBuf,
    cause: String,
    tried: Instant,
}

impl Failure {
    fn new(error: &RecordError, file: &Path) -> Self {
        let (path, cause) = match error {
            RecordError::Write { path, cause } => (path.clone(), cause.clone()),
            RecordError::Folder { path, cause } => (path.clone(), format!("{}: {cause}", path.display())),
            other => (file.to_path_buf(), other.to_string()),
        };
        Self { path, cause, tried: Instant::now() }
    }

    fn error(&self) -> RecordError {
        RecordError::Write { path: self.path.clone(), cause: self.cause.clone() }
    }
}

impl Writer {
    /// With `on_log_failure = "continue"` a file that cannot be begun is tried again later, as one that fails later.
    pub(super) fn create(
        config: &RecorderConfig,
        cell_name: &str,
        made_with: Option<Arc<MadeWith>>,
        pulse: &Arc<Pulse>,
    ) -> Result<Self, RecordError> {
        let folder = &config.folder;
        let made = std::fs::create_dir_all(folder).map_err(|cause| RecordError::Folder { path: folder.clone(), cause });
        let time = humantime::format_rfc3339_millis(SystemTime::now()).to_string().replace(['-', ':'], "");
        let mut writer = Self {
            config: config.clone(),
            cell_name: cell_name.to_string(),
            made_with,
            stem: folder.join(format!("{}-{time}", safe_name(cell_name))),
            pulse: Arc::clone(pulse),
            live: None,
            files: 0,
            file: None,
            failure: None,
            looked: None,
            swept: None,
            sweep: None,
            closed_bytes: 0,
            sequences: [0; Topic::Log as usize + 1],
            encoded: Vec::new(),
            masks: Vec::new(),
            message: Vec::new(),
            space_is_short: false,
        };
        match made.and_then(|()| writer.begin_file()) {
            Ok(()) => {}
            Err(error) if config.on_log_failure == OnLogFailure::Continue => {
                tracing::error!(%error, "nothing is recorded; tried again and again");
                writer.failure = Some(Failure::new(&error, folder));
            }
            Err(error) => return Err(error),
        }
        Ok(writer)
    }

    /// Shows what is written from now on to the viewers, too.
    pub(super) fn shows(&mut self, live: Option<LiveView>) {
        self.live = live;
    }

    /// The file that is written to, or would be.
    pub(super) fn path(&self) -> PathBuf {
        self.file.as_ref().map_or_else(|| file_path(&self.stem, self.files + 1), |file| file.path.clone())
    }

    /// Why there is no file, if there is none.
    pub(super) fn failure(&self) -> Option<String> {
        self.failure.as_ref().map(|failure| failure.cause.clone())
    }

    fn begin_file(&mut self) -> Result<(), RecordError> {
        let made_with = self.made_with.as_deref();
        let file = open(&self.config, &self.cell_name, made_with, &self.stem, self.files + 1, &self.pulse)?;
        self.files += 1;
        self.file = Some(file);
        Ok(())
    }

    fn file(&mut self) -> Result<&mut Mcap, RecordError> {
        let (stem, files, failure) = (&self.stem, self.files, &self.failure);
        self.file.as_mut().ok_or_else(|| match failure {
            Some(failure) => failure.error(),
            None => RecordError::Writer { path: file_path(stem, files), cause: "there is no file".to_owned() },
        })
    }

    fn put(&mut self, topic: Topic, timestamp_ns: u64, data: &[u8]) -> Result<(), RecordError> {
        let index = topic as usize;
        let sequence = self.sequences[index].wrapping_add(1);
        self.sequences[index] = sequence;
        let file = self.file()?;
        let header = MessageHeader {
            channel_id: file.channels[index],
            sequence,
            log_time: timestamp_ns,
            publish_time: timestamp_ns,
        };
        file.writer.write_to_known_channel(&header, data).map_err(|e| write_error(&file.path, &e))?;
        file.dirty.get_or_insert_with(Instant::now);
        if let Some(live) = &self.live {
            live.send(topic, timestamp_ns, data);
        }
        Ok(())
    }

    fn put_protobuf<M: Encode>(&mut self, topic: Topic, timestamp_ns: u64, message: &M) -> Result<(), RecordError> {
        let mut data = std::mem::take(&mut self.message);
        data.clear();
        let result = message
            .encode(&mut data)
            .map_err(|e| RecordError::Encode { topic: "a frame's topic", cause: e.to_string() })
            .and_then(|()| self.put(topic, timestamp_ns, &data));
        self.message = data;
        result
    }

    fn flush(&mut self) -> Result<(), RecordError> {
        let file = self.file()?;
        if file.dirty.take().is_some() {
            file.writer.flush().map_err(|e| write_error(&file.path, &e))?;
            file.chunks += 1;
            file.unflushed_lines = 0;
        }
        Ok(())
    }

    /// Begins a new file if this one has reached its greatest size or age.
    fn rotate(&mut self, shared: &Shared) -> Result<(), RecordError> {
        let bytes = self.bytes_of_file();
        let file = self.file()?;
        let (chunks, age_s) = (file.chunks, file.begun.elapsed().as_secs());
        if !is_full(&self.config, bytes, chunks, age_s) {
            return Ok(());
        }
        self.next_file(shared)
    }

    /// Closes the file and begins a new one.
    fn next_file(&mut self, shared: &Shared) -> Result<(), RecordError> {
        let full = self.file.take();
        let begun = self.begin_file();
        if let Some(mut full) = full {
            let finished = finish(&mut full);
            self.closed_bytes += file_size(&full.path);
            if let Err(error) = &finished {
                tracing::error!(%error, "a full recording is not closed; samsod recover closes it");
                shared.lock().summary.failures += 1;
            }
        }
        begun?;
        shared.lock().summary.files.push(self.path());
        self.swept = None;
        Ok(())
    }

    /// Takes in that writing has failed: what waits is lost, and everybody is told.
    fn fail(&mut self, error: &RecordError, shared: &Shared) {
        let failure = Failure::new(error, &self.path());
        let mut unflushed_lines = 0;
        if let Some(file) = self.file.take() {
            self.closed_bytes += file_size(&file.path);
            unflushed_lines = file.unflushed_lines;
        }
        tracing::error!(%error, "recording has failed; a new file is tried again and again");
        let mut queues = shared.lock();
        queues.failed = Some(failure.cause.clone());
        queues.summary.failures += 1;
        queues.summary.lines_not_written += unflushed_lines;
        queues.lose_frames();
        let lines = std::mem::take(&mut queues.lines);
        drop(queues);
        lose_lines(lines, error, shared);
        self.failure = Some(failure);
    }

    /// Tries a new file, if there is none and the last attempt is some time ago.
    fn try_again(&mut self, shared: &Shared) {
        let Some(failure) = &self.failure else { return };
        if failure.tried.elapsed() < RETRY_INTERVAL {
            return;
        }
        let was = failure.cause.clone();
        match self.begin_file() {
            Ok(()) => {
                self.failure = None;
                let path = self.path();
                tracing::warn!(path = %path.display(), "recording again");
                let mut queues = shared.lock();
                queues.failed = None;
                queues.summary.files.push(path);
                self.swept = None;
            }
            Err(error) => {
                let failure = Failure::new(&error, &self.stem);
                if failure.cause != was {
                    tracing::error!(%error, "still nothing is recorded");
                    shared.lock().failed = Some(failure.cause.clone());
                }
                self.failure = Some(failure);
            }
        }
    }

    /// Begins a new file if a frame was seen with something else than those before it.
    fn follow(&mut self, made_with: Option<&Arc<MadeWith>>, shared: &Shared) -> Result<(), RecordError> {
        let Some(made_with) = made_with else { return Ok(()) };
        if self.made_with.as_ref().is_some_and(|with| Arc::ptr_eq(with, made_with)) {
            return Ok(());
        }
        self.made_with = Some(Arc::clone(made_with));
        self.next_file(shared)
    }

    fn bytes_of_file(&self) -> u64 {
        self.file.as_ref().map_or(0, |file| file_size(&file.path))
    }

    /// What has to be done from time to time though nothing is written.
    fn look_about(&mut self, shared: &Arc<Shared>) {
        if self.looked.is_none_or(|looked| looked.elapsed() >= LOOK_INTERVAL) {
            self.look_at_space(shared);
        }
        self.try_again(shared);
        self.sweep(shared);
    }

    /// Looks whether there is room for frames; a file system that cannot tell has room.
    pub(super) fn look_at_space(&mut self, shared: &Shared) {
        self.looked = Some(Instant::now());
        let free = free_bytes(&self.config.folder);
        let least = self.config.min_free_mib.saturating_mul(1 << 20);
        // Once it is short, some more is asked for: not to go to and fro.
        let needed = if self.space_is_short { least.saturating_add(least / 8) } else { least };
        let short = free.is_some_and(|free| free < needed);
        if short != self.space_is_short {
            self.space_is_short = short;
            let (folder, free_mib) = (self.config.folder.display(), free.unwrap_or(0) >> 20);
            let min_free_mib = self.config.min_free_mib;
            if short {
                tracing::error!(%folder, free_mib, min_free_mib, "short of space: frames are not recorded any more");
            } else {
                tracing::warn!(%folder, free_mib, min_free_mib, "space again: frames are recorded");
            }
        }
        let mut queues = shared.lock();
        (queues.free_bytes, queues.space_is_short) = (free, short);
    }

    /// Has old recordings deleted, by a thread of its own: large files take their time, and commands do not wait for that.
    fn sweep(&mut self, shared: &Arc<Shared>) {
        let keep = Keep { days: self.config.keep_days, mib: self.config.keep_mib };
        let is_due = self.swept.is_none_or(|swept| swept.elapsed() >= SWEEP_INTERVAL);
        if keep.is_all() || !is_due || self.sweep.as_ref().is_some_and(|thread| !thread.is_finished()) {
            return;
        }
        self.swept = Some(Instant::now());
        let (folder, name, in_use) = (self.config.folder.clone(), safe_name(&self.cell_name), self.path());
        let shared = Arc::clone(shared);
        let sweep = move || match retention::sweep(&folder, &name, keep, &in_use, SystemTime::now()) {
            Ok(deleted) => shared.lock().summary.files_deleted += deleted.len() as u64,
            Err(error) => tracing::warn!(folder = %folder.display(), %error, "old recordings cannot be looked for"),
        };
        match std::thread::Builder::new().name("retention".to_owned()).spawn(sweep) {
            Ok(thread) => self.sweep = Some(thread),
            Err(error) => tracing::warn!(%error, "old recordings cannot be looked for"),
        }
    }

    /// When the writer has to look about again, at the latest.
    fn due(&self) -> Instant {
        let now = Instant::now();
        let look = self.looked.map_or(now, |looked| looked + LOOK_INTERVAL);
        let flush = self.file.as_ref().and_then(|file| file.dirty).map(|since| since + FLUSH_INTERVAL);
        let retry = self.failure.as_ref().map(|failure| failure.tried + RETRY_INTERVAL);
        [flush, retry].into_iter().flatten().fold(look, Instant::min)
    }

    /// Whether what waits to be flushed has waited long enough.
    fn must_flush(&self) -> bool {
        self.file.as_ref().and_then(|file| file.dirty).is_some_and(|since| since.elapsed() >= FLUSH_INTERVAL)
    }

    /// Closes the file.
    fn close(&mut self) -> Result<(), RecordError> {
        if let Some(sweep) = self.sweep.take() {
            // A panic there is in the log already.
            let _ = sweep.join();
        }
        self.flush()?;
        finish(self.file()?)
    }

    /// Writes all stages of a frame. `between` runs between them, so that commands need not wait for a whole frame.
    fn put_frame(
        &mut self,
        slot: &mut FrameSlot,
        mut between: impl FnMut(&mut Self) -> Result<(), RecordError>,
    ) -> Result<(), RecordError> {
        let at = slot.timestamp_ns;
        self.put_image(slot)?;
        between(self)?;
        if slot.partitions <= MOST_FLOAT_LABELS {
            let (encoding, bytes) = if slot.wide_labels { ("32FC1", 4) } else { ("mono16", 2) };
            let data = std::mem::take(&mut slot.labels);
            let message = raw_image(at, &slot.camera, slot.size, encoding, bytes, data);
            let result = self.put_protobuf(Topic::Labels, at, &message);
            slot.labels = take_back(message.data);
            result?;
        } else {
            tracing::error!(partitions = slot.partitions, "more labels than a recording can hold: they are left out");
        }
        between(self)?;
        let (encoding, bytes) = match self.config.saliency_encoding {
            SaliencyEncoding::Mono8 => ("mono8", 1),
            SaliencyEncoding::Float32 => ("32FC1", 4),
        };
        let message = raw_image(at, &slot.camera, slot.size, encoding, bytes, std::mem::take(&mut slot.saliency));
        let result = self.put_protobuf(Topic::Saliency, at, &message);
        slot.saliency = take_back(message.data);
        result?;
        between(self)?;

        let label = |pixel: usize| slot_label(slot, pixel);
        let outlined: Vec<_> = slot.regions.iter().map(|r| (r, region_outlines(slot.size.0, r, label))).collect();
        self.put_protobuf(Topic::Regions, at, &regions(at, &outlined))?;
        self.put_objects(slot)?;
        self.put_protobuf(Topic::Detections, at, &detections(at, &slot.detections))?;
        let scene = SceneMessage {
            sequence: slot.sequence,
            camera: &slot.camera,
            width_px: slot.size.0,
            height_px: slot.size.1,
            partitions: slot.partitions,
            regions: slot.regions.iter().enumerate().map(|(id, r)| RegionMessage::new(id, r)).collect(),
            objects: ObjectMessage::all(&slot.objects, slot.places.as_deref().unwrap_or_default()),
            detections: DetectionMessage::all(&slot.detections, slot.base_from_world.as_ref()),
        };
        self.put(Topic::Scene, at, &json("/scene", &scene)?)?;
        self.put(Topic::Timings, at, &timings(slot)?)?;
        self.flush()
    }

    /// Masks, outlines and places of the objects of a frame.
    fn put_objects(&mut self, slot: &FrameSlot) -> Result<(), RecordError> {
        let at = slot.timestamp_ns;
        masks::paint(slot.size, &slot.objects, &mut self.masks);
        let message = raw_image(at, &slot.camera, slot.size, "mono8", 1, std::mem::take(&mut self.masks));
        let result = self.put_protobuf(Topic::Masks, at, &message);
        self.masks = take_back(message.data);
        result?;
        let placed = slot.places.as_deref();
        self.put_protobuf(Topic::Outlines, at, &outlines(at, &slot.objects, placed.unwrap_or_default()))?;
        if let Some(base_from_world) = &slot.base_from_world {
            self.put_protobuf(Topic::Transforms, at, &transforms(at, base_from_world))?;
        }
        match placed {
            Some(placed) => self.put_protobuf(Topic::Places, at, &places(at, placed)),
            None => Ok(()),
        }
    }

    fn put_image(&mut self, slot: &mut FrameSlot) -> Result<(), RecordError> {
        let at = slot.timestamp_ns;
        let (width, height) = slot.size;
        let encode_error = |cause: String| RecordError::Encode { topic: "/camera/image", cause };
        self.encoded.clear();
        let format = match self.config.image_encoding {
            ImageEncoding::Raw => {
                let message = raw_image(at, &slot.camera, slot.size, "rgb8", 3, std::mem::take(&mut slot.rgb));
                let result = self.put_protobuf(Topic::Image, at, &message);
                slot.rgb = take_back(message.data);
                return result;
            }
            ImageEncoding::Png => {
                // Of the filters that the fast deflate likes, Paeth was smallest and no slower.
                PngEncoder::new_with_quality(&mut self.encoded, CompressionType::Fast, FilterType::Paeth)
                    .write_image(&slot.rgb, width, height, image::ExtendedColorType::Rgb8)
                    .map_err(|e| encode_error(e.to_string()))?;
                "png"
            }
            ImageEncoding::Jpeg => {
                let (Ok(w), Ok(h)) = (u16::try_from(width), u16::try_from(height)) else {
                    return Err(encode_error(format!("{width} x {height}; a JPEG has at most 65535 x 65535 pixels")));
                };
                let mut encoder = jpeg_encoder::Encoder::new(&mut self.encoded, self.config.jpeg_quality);
                encoder.set_sampling_factor(jpeg_encoder::SamplingFactor::F_2_2);
                encoder
                    .encode(&slot.rgb, w, h, jpeg_encoder::ColorType::Rgb)
                    .map_err(|e| encode_error(e.to_string()))?;
                "jpeg"
            }
        };
        let message = compressed_image(at, &slot.camera, format, std::mem::take(&mut self.encoded));
        let result = self.put_protobuf(Topic::Image, at, &message);
        self.encoded = take_back(message.data);
        result
    }
}

/// Label of a pixel as it lies in a slot.
fn slot_label(slot: &FrameSlot, pixel: usize) -> u32 {
    if slot.wide_labels {
        slot.labels.as_chunks::<4>().0.get(pixel).map_or(0, |b| f32::from_le_bytes(*b) as u32)
    } else {
        slot.labels.as_chunks::<2>().0.get(pixel).map_or(0, |b| u16::from_le_bytes(*b).into())
    }
}

fn timings(slot: &FrameSlot) -> Result<Vec<u8>, RecordError> {
    let milliseconds = |time: &Duration| serde_json::Value::from(time.as_secs_f64() * 1e3);
    let mut fields = serde_json::Map::new();
    fields.insert("sequence".to_string(), slot.sequence.into());
    fields.insert("frames_dropped".to_string(), slot.frames_dropped.into());
    fields.insert("total_ms".to_string(), milliseconds(&slot.total));
    // After the total, so that a caller who measures the whole chain has the last word on it.
    for (stage, time) in &slot.times {
        fields.insert(format!("{stage}_ms"), milliseconds(time));
    }
    json("/stage/timings", &fields)
}

/// Free space of the file system of a folder, bytes; none if it cannot tell.
fn free_bytes(folder: &Path) -> Option<u64> {
    rustix::fs::statvfs(folder).ok().map(|s| s.f_bavail.saturating_mul(s.f_frsize))
}

fn file_size(path: &Path) -> u64 {
    std::fs::metadata(path).map_or(0, |m| m.len())
}

/// Whether a new file is to be begun. One in which nothing has happened may get as old as it likes.
fn is_full(config: &RecorderConfig, bytes: u64, chunks: u64, age_s: u64) -> bool {
    let is_old = config.max_file_minutes > 0 && chunks > 0 && age_s >= 60 * config.max_file_minutes;
    bytes >= config.max_file_mib << 20 || chunks >= MOST_CHUNKS || is_old
}

/// The file of this number, from 1.
fn file_path(stem: &Path, number: u32) -> PathBuf {
    let mut name = stem.as_os_str().to_os_string();
    if number > 1 {
        name.push(format!("-{number:03}"));
    }
    name.push(".mcap");
    PathBuf::from(name)
}

/// Begins a file; one that cannot be begun is taken away again.
fn open(
    config: &RecorderConfig,
    cell_name: &str,
    made_with: Option<&MadeWith>,
    stem: &Path,
    number: u32,
    pulse: &Arc<Pulse>,
) -> Result<Mcap, RecordError> {
    let path = file_path(stem, number);
    let disk = Disk::create(&path, pulse).map_err(|cause| RecordError::Folder {
        path: if number > 1 { path.clone() } else { config.folder.clone() },
        cause,
    })?;
    begin(config, cell_name, made_with, number, &path, disk).inspect_err(|_| {
        // Nothing is in it; what cannot be taken away does no harm.
        let _ = std::fs::remove_file(&path);
    })
}

fn begin(
    config: &RecorderConfig,
    cell_name: &str,
    made_with: Option<&MadeWith>,
    number: u32,
    path: &Path,
    disk: Disk,
) -> Result<Mcap, RecordError> {
    let failed = |e: mcap::McapError| write_error(path, &e);
    // PNG and JPEG do not compress any further, and zstd passes over them; on labels and saliency its level 1 is as
    // fast as lz4 and half the size. On raw pixels lz4 is faster by a quarter.
    let compression = match config.image_encoding {
        ImageEncoding::Raw => mcap::Compression::Lz4,
        ImageEncoding::Png | ImageEncoding::Jpeg => mcap::Compression::Zstd,
    };
    let mut writer = mcap::WriteOptions::new()
        .library(concat!("samsod ", env!("CARGO_PKG_VERSION")))
        .compression(Some(compression))
        .compression_level(1)
        // On the recorder's thread: the other cores belong to the vision chain.
        .compression_threads(0)
        .chunk_size(None)
        .create(BufWriter::with_capacity(1 << 16, disk))
        .map_err(failed)?;
    let about = [("cell", cell_name), ("version", env!("CARGO_PKG_VERSION"))]
        .map(|(k, v)| (k.to_string(), v.to_string()))
        .into_iter()
        .chain([("part".to_string(), number.to_string())])
        .collect();
    writer.write_metadata(&mcap::records::Metadata { name: "samsod".to_string(), metadata: about }).map_err(failed)?;
    if let Some(made_with) = made_with {
        let (name, metadata) = (made_with::METADATA.to_string(), made_with.to_metadata());
        writer.write_metadata(&mcap::records::Metadata { name, metadata }).map_err(failed)?;
    }
    let described = descriptions(config.image_encoding != ImageEncoding::Raw);
    let mut channels = vec![0; described.len()];
    for topic in &described {
        channels[topic.topic as usize] = writer
            .add_schema(&topic.schema.name, &topic.schema.encoding, &topic.schema.data)
            .and_then(|schema| writer.add_channel(schema, topic.name, topic.message_encoding, &BTreeMap::new()))
            .map_err(failed)?;
    }
    writer.flush().map_err(failed)?;
    Ok(Mcap {
        writer,
        channels,
        path: path.to_path_buf(),
        begun: Instant::now(),
        chunks: 0,
        dirty: None,
        unflushed_lines: 0,
    })
}

fn finish(file: &mut Mcap) -> Result<(), RecordError> {
    file.writer.finish().map_err(|e| write_error(&file.path, &e))?;
    Ok(())
}

fn write_error(path: &Path, error: &mcap::McapError) -> RecordError {
    RecordError::Write { path: path.to_path_buf(), cause: cause_of(error) }
}

/// The writer thread: empties the queues until they are closed, then closes the file.
pub(super) fn run(mut writer: Writer, shared: &Arc<Shared>) -> Result<(), RecordError> {
    let _ends = EndsWith(&shared.pulse);
    let mut end = End { shared, cause: Some("the writer thread panicked".to_string()) };
    work(&mut writer, shared);
    let result = writer.close();
    shared.lock().summary.bytes = writer.closed_bytes + writer.bytes_of_file();
    end.cause = match &result {
        Ok(()) => None,
        Err(RecordError::Write { cause, .. }) => Some(cause.clone()),
        Err(other) => Some(other.to_string()),
    };
    if let Err(error) = &result {
        tracing::error!(%error, "the recording is not closed; samsod recover closes it");
    }
    result
}

/// Tells everybody, when the writer thread ends for whatever reason, that nothing is written any more; otherwise a
/// command would wait for ever.
struct End<'a> {
    shared: &'a Shared,
    cause: Option<String>,
}

impl Drop for End<'_> {
    fn drop(&mut self) {
        let mut queues = self.shared.lock();
        queues.failed = Some(self.cause.take().unwrap_or_else(|| "it is finished".to_string()));
        queues.lose_frames();
        // Dropping a line tells those who wait for it.
        queues.lines.clear();
        queues.ended = true;
        drop(queues);
        self.shared.gone.notify_all();
    }
}

fn work(writer: &mut Writer, shared: &Arc<Shared>) {
    loop {
        shared.pulse.beat();
        writer.look_about(shared);
        let mut queues = wait(shared, writer.due());
        if queues.closing && queues.frames_until.is_some_and(|until| Instant::now() >= until) {
            queues.lose_frames();
        }
        let lines = std::mem::take(&mut queues.lines);
        let frame = if lines.is_empty() { queues.frames.pop_front() } else { None };
        let closing = queues.closing;
        drop(queues);

        let done = if let Some(mut slot) = frame {
            let written = write_frame(writer, shared, &mut slot);
            let mut queues = shared.lock();
            match &written {
                Ok(true) => queues.summary.frames_written += 1,
                _ => queues.lose_frame(),
            }
            queues.free.push(slot);
            queues.summary.bytes = writer.closed_bytes + writer.bytes_of_file();
            written.map(drop)
        } else if !lines.is_empty() {
            put_lines(writer, shared, lines)
        } else if closing {
            return;
        } else if writer.must_flush() {
            writer.flush()
        } else {
            Ok(())
        };
        let has_file = writer.file.is_some();
        if let Err(error) = done.and_then(|()| if has_file { writer.rotate(shared) } else { Ok(()) }) {
            writer.fail(&error, shared);
        }
    }
}

/// Waits until there is something to do: a line, a frame, the end, or something that is due.
fn wait(shared: &Shared, due: Instant) -> MutexGuard<'_, Queues> {
    let mut queues = shared.lock();
    loop {
        shared.pulse.beat();
        let left = due.saturating_duration_since(Instant::now());
        if !queues.lines.is_empty() || !queues.frames.is_empty() || queues.closing || left.is_zero() {
            return queues;
        }
        shared.pulse.rest();
        queues = shared.wake.wait_timeout(queues, left).unwrap_or_else(std::sync::PoisonError::into_inner).0;
    }
}

/// Returns whether the frame was written; it is left out when space is short.
fn write_frame(writer: &mut Writer, shared: &Shared, slot: &mut FrameSlot) -> Result<bool, RecordError> {
    writer.look_at_space(shared);
    if writer.space_is_short {
        return Ok(false);
    }
    writer.follow(slot.made_with.as_ref(), shared)?;
    let result = writer.put_frame(slot, |writer| {
        shared.pulse.beat();
        let lines = std::mem::take(&mut shared.lock().lines);
        if lines.is_empty() { Ok(()) } else { put_lines(writer, shared, lines) }
    });
    match result {
        Ok(()) => Ok(true),
        // One image that cannot be encoded is no reason to stop recording.
        Err(error @ RecordError::Encode { .. }) => {
            tracing::error!(%error, sequence = slot.sequence, "a frame is not recorded");
            writer.flush()?;
            Ok(false)
        }
        Err(error) => Err(error),
    }
}

/// Writes lines in their order; if anybody waits for one, flushes and tells.
fn put_lines(writer: &mut Writer, shared: &Shared, mut lines: VecDeque<Line>) -> Result<(), RecordError> {
    let mut put = 0;
    let mut put_all = || {
        for line in &lines {
            // Nobody gives a command any more that had to wait too long: then it must not stand in the recording.
            if line.waiter.as_ref().is_none_or(|waiter| !waiter.has_given_up()) {
                writer.put(line.topic, line.timestamp_ns, &line.data)?;
                writer.file()?.unflushed_lines += 1;
                put += 1;
            }
        }
        if lines.iter().any(|line| line.waiter.is_some()) { writer.flush() } else { Ok(()) }
    };
    if let Err(error) = put_all() {
        // Back to where they came from: `Writer::fail` loses them, and tells who waits when everybody can see why.
        if let Some(file) = &mut writer.file {
            file.unflushed_lines = file.unflushed_lines.saturating_sub(put);
        }
        let mut queues = shared.lock();
        lines.append(&mut queues.lines);
        queues.lines = lines;
        return Err(error);
    }
    let waiting: Vec<_> = lines.into_iter().filter_map(|line| Some((line.topic, line.waiter?))).collect();
    let commands = waiting.iter().filter(|(topic, waiter)| *topic == Topic::Command && !waiter.has_given_up()).count();
    shared.lock().summary.commands += commands as u64;
    for (_, waiter) in waiting {
        waiter.tell(Ok(()));
    }
    Ok(())
}

/// Lines that could not be written: who waits for one is told why, the others are counted.
fn lose_lines(mut lines: VecDeque<Line>, error: &RecordError, shared: &Shared) {
    shared.lock().summary.lines_not_written += lines.len() as u64;
    lines.iter_mut().for_each(|line| line.refuse(error));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_ends_by_its_size_or_its_age_unless_nothing_has_happened() {
        let config = RecorderConfig { max_file_mib: 16, max_file_minutes: 60, ..RecorderConfig::default() };
        let by_size = RecorderConfig { max_file_minutes: 0, ..config.clone() };
        assert!(!is_full(&config, (16 << 20) - 1, 1, 3599) && is_full(&config, 16 << 20, 1, 0));
        assert!(is_full(&config, 0, 1, 3600) && !is_full(&config, 0, 0, 3600));
        assert!(!is_full(&by_size, 0, 1, u64::MAX) && is_full(&by_size, 0, MOST_CHUNKS, 0));
    }
}
