//! The back of the recorder: the thread that encodes and writes.
//!
//! In: [`Queues`](super::recorder::Queues). Out: MCAP files. A chunk is closed and handed to the operating system after each
//! frame, each command and at the latest each second, so that a killed process loses no more than that. A new file
//! is begun when one has grown to its greatest size; the index that MCAP keeps in memory until the end stays small so.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::MutexGuard;
use std::time::{Duration, Instant, SystemTime};

use foxglove::Encode;
use image::ImageEncoder;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use mcap::records::MessageHeader;

use super::detections::{DetectionMessage, detections};
use super::messages::{
    RegionMessage, SceneMessage, Topic, compressed_image, descriptions, raw_image, regions, take_back,
};
use super::objects::{ObjectMessage, outlines, places, transforms};
use super::recorder::{FrameSlot, Line, Queues, Shared, json};
use super::{ImageEncoding, RecordError, RecorderConfig, SaliencyEncoding};
use crate::masks;
use crate::picture::region_outlines;
use crate::pulse::{EndsWith, LONGEST_SLEEP};

/// Longest time that a line waits to be handed to the operating system.
const FLUSH_INTERVAL: Duration = Duration::from_secs(1);

/// Chunks after which a new file is begun even if it is small: the index of each stays in memory.
const MOST_CHUNKS: u64 = 100_000;

/// Whole numbers up to this are exact in 32 bits of floating point.
const MOST_FLOAT_LABELS: usize = 1 << 24;

/// One file being written.
struct Mcap {
    writer: mcap::Writer<BufWriter<File>>,
    /// Channel ids, by [`Topic`].
    channels: Vec<u16>,
    path: PathBuf,
    chunks: u64,
    /// Since when something waits to be flushed.
    dirty: Option<Instant>,
}

/// Names, opens and fills the files of one recording.
pub(super) struct Writer {
    config: RecorderConfig,
    cell_name: String,
    /// Folder and beginning of the names of the files.
    stem: PathBuf,
    files: u32,
    file: Mcap,
    /// Size of the files that are closed, bytes.
    closed_bytes: u64,
    sequences: [u32; Topic::Log as usize + 1],
    encoded: Vec<u8>,
    masks: Vec<u8>,
    message: Vec<u8>,
    space_is_short: bool,
}

impl Writer {
    pub(super) fn create(config: &RecorderConfig, cell_name: &str) -> Result<Self, RecordError> {
        let folder = &config.folder;
        std::fs::create_dir_all(folder).map_err(|cause| RecordError::Folder { path: folder.clone(), cause })?;
        let time = humantime::format_rfc3339_millis(SystemTime::now()).to_string().replace(['-', ':'], "");
        let safe: String =
            cell_name.chars().map(|c| if c.is_ascii_alphanumeric() || "-_".contains(c) { c } else { '_' }).collect();
        let stem = folder.join(format!("{safe}-{time}"));
        let file = open(config, cell_name, &stem, 1)?;
        Ok(Self {
            config: config.clone(),
            cell_name: cell_name.to_string(),
            stem,
            files: 1,
            file,
            closed_bytes: 0,
            sequences: [0; Topic::Log as usize + 1],
            encoded: Vec::new(),
            masks: Vec::new(),
            message: Vec::new(),
            space_is_short: false,
        })
    }

    pub(super) fn path(&self) -> &Path {
        &self.file.path
    }

    fn failed(&self, error: mcap::McapError) -> RecordError {
        write_error(&self.file.path, &error)
    }

    fn put(&mut self, topic: Topic, timestamp_ns: u64, data: &[u8]) -> Result<(), RecordError> {
        let index = topic as usize;
        let sequence = &mut self.sequences[index];
        *sequence = sequence.wrapping_add(1);
        let header = MessageHeader {
            channel_id: self.file.channels[index],
            sequence: *sequence,
            log_time: timestamp_ns,
            publish_time: timestamp_ns,
        };
        self.file.writer.write_to_known_channel(&header, data).map_err(|e| self.failed(e))?;
        self.file.dirty.get_or_insert_with(Instant::now);
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
        if self.file.dirty.take().is_some() {
            self.file.writer.flush().map_err(|e| self.failed(e))?;
            self.file.chunks += 1;
        }
        Ok(())
    }

    /// Begins a new file if this one has reached its greatest size. Returns its path if so.
    fn rotate(&mut self) -> Result<Option<PathBuf>, RecordError> {
        let bytes = self.bytes_of_file();
        if bytes < self.config.max_file_mib << 20 && self.file.chunks < MOST_CHUNKS {
            return Ok(None);
        }
        self.files += 1;
        let next = open(&self.config, &self.cell_name, &self.stem, self.files)?;
        let mut full = std::mem::replace(&mut self.file, next);
        finish(&mut full)?;
        self.closed_bytes += file_size(&full.path);
        Ok(Some(self.file.path.clone()))
    }

    fn bytes_of_file(&self) -> u64 {
        file_size(&self.file.path)
    }

    /// Whether there is room for frames; a file system that cannot tell has room.
    fn has_space(&mut self) -> bool {
        let free = free_bytes(&self.config.folder);
        let short = free.is_some_and(|free| free < self.config.min_free_mib << 20);
        if short != self.space_is_short {
            self.space_is_short = short;
            let folder = self.config.folder.display();
            if short {
                let (free_mib, least) = (free.unwrap_or(0) >> 20, self.config.min_free_mib);
                tracing::error!(%folder, "{free_mib} MiB free, less than {least} MiB: frames are not recorded any more");
            } else {
                tracing::warn!(%folder, "space again: frames are recorded");
            }
        }
        !short
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
pub(crate) fn free_bytes(folder: &Path) -> Option<u64> {
    rustix::fs::statvfs(folder).ok().map(|s| s.f_bavail.saturating_mul(s.f_frsize))
}

fn file_size(path: &Path) -> u64 {
    std::fs::metadata(path).map_or(0, |m| m.len())
}

fn open(config: &RecorderConfig, cell_name: &str, stem: &Path, number: u32) -> Result<Mcap, RecordError> {
    let mut name = stem.as_os_str().to_os_string();
    if number > 1 {
        name.push(format!("-{number:03}"));
    }
    name.push(".mcap");
    let path = PathBuf::from(name);
    // Never over an older recording.
    let file = File::create_new(&path).map_err(|cause| RecordError::Folder {
        path: if number > 1 { path.clone() } else { config.folder.clone() },
        cause,
    })?;
    let failed = |e: mcap::McapError| write_error(&path, &e);
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
        .create(BufWriter::with_capacity(1 << 16, file))
        .map_err(failed)?;
    let about = [("cell", cell_name), ("version", env!("CARGO_PKG_VERSION"))]
        .map(|(k, v)| (k.to_string(), v.to_string()))
        .into_iter()
        .chain([("part".to_string(), number.to_string())])
        .collect();
    writer.write_metadata(&mcap::records::Metadata { name: "samsod".to_string(), metadata: about }).map_err(failed)?;
    let described = descriptions(config.image_encoding != ImageEncoding::Raw);
    let mut channels = vec![0; described.len()];
    for topic in &described {
        channels[topic.topic as usize] = writer
            .add_schema(&topic.schema.name, &topic.schema.encoding, &topic.schema.data)
            .and_then(|schema| writer.add_channel(schema, topic.name, topic.message_encoding, &BTreeMap::new()))
            .map_err(failed)?;
    }
    writer.flush().map_err(failed)?;
    Ok(Mcap { writer, channels, path: path.clone(), chunks: 0, dirty: None })
}

fn finish(file: &mut Mcap) -> Result<(), RecordError> {
    file.writer.finish().map_err(|e| write_error(&file.path, &e))?;
    Ok(())
}

/// The error of the library with its causes: that the disk is full stands in the last of them.
fn write_error(path: &Path, error: &mcap::McapError) -> RecordError {
    let mut cause = error.to_string();
    let mut source = std::error::Error::source(error);
    while let Some(deeper) = source {
        cause += &format!(": {deeper}");
        source = deeper.source();
    }
    RecordError::Write { path: path.to_path_buf(), cause }
}

/// The writer thread: empties the queues until they are closed, then closes the file.
pub(super) fn run(mut writer: Writer, shared: &Shared) -> Result<(), RecordError> {
    let _ends = EndsWith(&shared.pulse);
    let mut end = End { shared, cause: Some("the writer thread panicked".to_string()) };
    let result = work(&mut writer, shared).and_then(|()| finish(&mut writer.file));
    shared.lock().summary.bytes = writer.closed_bytes + writer.bytes_of_file();
    end.cause = match &result {
        Ok(()) => None,
        Err(RecordError::Write { cause, .. }) => Some(cause.clone()),
        Err(other) => Some(other.to_string()),
    };
    if let Err(error) = &result {
        tracing::error!(%error, "recording stopped");
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
        queues.summary.frames_not_written += queues.frames.len() as u64;
        queues.frames.clear();
        // Dropping a line tells those who wait for it.
        queues.lines.clear();
        drop(queues);
        self.shared.gone.notify_all();
    }
}

fn work(writer: &mut Writer, shared: &Shared) -> Result<(), RecordError> {
    loop {
        shared.pulse.beat();
        let mut queues = wait(shared, writer.file.dirty);
        if queues.closing && queues.frames_until.is_some_and(|until| Instant::now() >= until) {
            let Queues { frames, summary, .. } = &mut *queues;
            summary.frames_not_written += frames.len() as u64;
            frames.clear();
        }
        let lines = std::mem::take(&mut queues.lines);
        let frame = if lines.is_empty() { queues.frames.pop_front() } else { None };
        let closing = queues.closing;
        drop(queues);

        if let Some(mut slot) = frame {
            let written = write_frame(writer, shared, &mut slot);
            let mut queues = shared.lock();
            match &written {
                Ok(true) => queues.summary.frames_written += 1,
                _ => queues.summary.frames_not_written += 1,
            }
            queues.free.push(slot);
            queues.summary.bytes = writer.closed_bytes + writer.bytes_of_file();
            drop(queues);
            written?;
        } else if !lines.is_empty() {
            put_lines(writer, shared, lines)?;
        } else {
            writer.flush()?;
            if closing {
                return Ok(());
            }
        }
        if let Some(path) = writer.rotate()? {
            shared.lock().summary.files.push(path);
        }
    }
}

/// Waits until there is something to do: a line, a frame, the end, or a flush that is due.
fn wait(shared: &Shared, dirty: Option<Instant>) -> MutexGuard<'_, Queues> {
    let mut queues = shared.lock();
    loop {
        shared.pulse.beat();
        if !queues.lines.is_empty() || !queues.frames.is_empty() || queues.closing {
            return queues;
        }
        queues = match dirty {
            None => sleep(shared, queues, LONGEST_SLEEP),
            Some(since) => {
                let Some(left) = FLUSH_INTERVAL.checked_sub(since.elapsed()) else { return queues };
                sleep(shared, queues, left.min(LONGEST_SLEEP))
            }
        };
    }
}

fn sleep<'a>(shared: &'a Shared, queues: MutexGuard<'a, Queues>, longest: Duration) -> MutexGuard<'a, Queues> {
    shared.pulse.rest();
    shared.wake.wait_timeout(queues, longest).unwrap_or_else(std::sync::PoisonError::into_inner).0
}

/// Returns whether the frame was written; it is left out when space is short.
fn write_frame(writer: &mut Writer, shared: &Shared, slot: &mut FrameSlot) -> Result<bool, RecordError> {
    let has_space = writer.has_space();
    shared.lock().space_is_short = !has_space;
    if !has_space {
        return Ok(false);
    }
    let result = writer.put_frame(slot, |writer| {
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
fn put_lines(writer: &mut Writer, shared: &Shared, lines: std::collections::VecDeque<Line>) -> Result<(), RecordError> {
    let mut waiting = Vec::new();
    for line in lines {
        writer.put(line.topic, line.timestamp_ns, &line.data)?;
        waiting.extend(line.flushed);
    }
    if !waiting.is_empty() {
        writer.flush()?;
        shared.lock().summary.commands += waiting.len() as u64;
        for sender in waiting {
            // Nobody listens any more: then nobody needs to know.
            let _ = sender.send(Ok(()));
        }
    }
    Ok(())
}
