//! Reading recordings back, whole or cut off.
//!
//! In: an MCAP file, by samsod or anybody. Out: what is on its topics ([`survey`]), and the stages of some frames
//! ([`frames`]). The file is streamed: memory scales with its largest chunk, not its length. What lies before damage
//! is always returned, together with what the damage is.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};

use foxglove::messages::{CompressedImage, ImageAnnotations, RawImage, points_annotation};
use image::RgbImage;
use mcap::Message;
use mcap::sans_io::{LinearReaderOptions, MessageReadEvent, MessageReader};
use prost::Message as _;

use super::messages::{
    COMMAND, DETECTIONS, IMAGE, LABELS, MASKS, OUTCOME, OUTLINES, REGIONS, SALIENCY, SCENE, TIMINGS,
};
use crate::picture::Outline;

/// Why a file cannot be read as a recording.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ReadError {
    /// The file cannot be opened or read.
    #[error("cannot read {}: {cause}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        #[source]
        cause: std::io::Error,
    },
    /// The file is no MCAP file.
    #[error("{} is no MCAP recording: {cause}", path.display())]
    NoRecording {
        /// The file.
        path: PathBuf,
        /// What was found.
        cause: String,
    },
    /// A message is not what its schema says.
    #[error("{}: message {number} on {topic} cannot be decoded: {cause}", path.display())]
    Message {
        /// The file.
        path: PathBuf,
        /// The topic.
        topic: String,
        /// Number of the message on its topic, from 0.
        number: u64,
        /// Why.
        cause: String,
    },
}

/// What is in a recording.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Survey {
    /// All topics, by name, also those without messages.
    pub topics: Vec<TopicSurvey>,
    /// Times of the stages, in the order of the chain, the total last.
    pub stages: Vec<StageStatistics>,
    /// Time of the first message, ns since the Unix epoch.
    pub first_ns: Option<u64>,
    /// Time of the last message, ns since the Unix epoch.
    pub last_ns: Option<u64>,
    /// Frames, counted by their camera images.
    pub frames: u64,
    /// Commands to the robot.
    pub commands: u64,
    /// Salient regions of all frames.
    pub regions: u64,
    /// Objects of all frames.
    pub objects: u64,
    /// Those with a place on the table.
    pub placed: u64,
    /// Detections of all frames that have a name.
    pub recognized: u64,
    /// Detections of something unknown.
    pub unknown: u64,
    /// How often each final outcome of a command was recorded, by name.
    pub outcomes: BTreeMap<String, u64>,
    /// Frames that the recorder says it dropped.
    pub frames_dropped: u64,
    /// Size of the file, bytes.
    pub bytes: u64,
    /// Why the file is not whole, if it is not; everything else here is what lies before that.
    pub damage: Option<String>,
}

/// One topic of a recording.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct TopicSurvey {
    /// Its name.
    pub name: String,
    /// Name of its schema; empty if it has none.
    pub schema: String,
    /// How its messages are encoded.
    pub encoding: String,
    /// Number of messages.
    pub messages: u64,
    /// Size of the messages before compression, bytes.
    pub bytes: u64,
}

/// Times of one stage, ms.
#[derive(Debug, Clone, PartialEq)]
pub struct StageStatistics {
    /// Name of the stage.
    pub stage: String,
    /// Number of frames.
    pub frames: usize,
    /// Median.
    pub p50_ms: f64,
    /// 99th percentile (nearest rank).
    pub p99_ms: f64,
    /// Longest.
    pub max_ms: f64,
}

/// The stages of one frame, read back.
#[derive(Debug, Clone, Default)]
pub struct FrameStages {
    /// When it was taken, ns since the Unix epoch.
    pub timestamp_ns: u64,
    /// The camera image.
    pub image: RgbImage,
    /// Label of each pixel, row by row; empty if none was recorded in the size of the image.
    pub labels: Vec<u32>,
    /// Saliency of each pixel, row by row; empty if none was recorded in the size of the image.
    pub saliency: Vec<f32>,
    /// Outlines of the regions.
    pub outlines: Vec<Outline>,
    /// Codes of [`masks`](crate::masks), row by row; empty if none were recorded in the size of the image.
    pub masks: Vec<u8>,
    /// Outlines of the objects and of their holes.
    pub object_outlines: Vec<Outline>,
    /// What the objects are; empty without a catalogue.
    pub detections: Vec<SeenDetection>,
}

/// A detection, read back.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SeenDetection {
    /// Name of the part, if it is known.
    pub name: Option<String>,
    /// Direction of its x axis, degrees counter-clockwise on the screen.
    pub angle_deg: f64,
    /// Its outlines.
    pub outlines: Vec<Outline>,
    /// Lines of its arrow, from end to end, px.
    pub arrow: Vec<[[f64; 2]; 2]>,
}

/// How many times larger than the whole file a record may be that lies in it compressed.
const MOST_COMPRESSED: u64 = 4096;
/// Longest such record, bytes: raw pixels of the largest frame.
const MOST_RECORD_BYTES: u64 = 1 << 30;

type Fields = serde_json::Map<String, serde_json::Value>;

/// Streams messages; `Err` in the result is damage, after which nothing comes.
pub(super) struct Messages {
    pub(super) path: PathBuf,
    file: BufReader<File>,
    reader: MessageReader,
    pub(super) length: u64,
}

impl Messages {
    pub(super) fn open(path: &Path) -> Result<Self, ReadError> {
        let io = |cause| ReadError::Io { path: path.to_path_buf(), cause };
        let mut file = File::open(path).map_err(io)?;
        let length = file.metadata().map_err(io)?.len();
        let mut magic = Vec::new();
        file.by_ref().take(mcap::MAGIC.len() as u64).read_to_end(&mut magic).map_err(io)?;
        if magic != mcap::MAGIC {
            let cause = format!("it begins with {:?}, not with the magic of MCAP", magic.escape_ascii().to_string());
            return Err(ReadError::NoRecording { path: path.to_path_buf(), cause });
        }
        // A damaged length must not ask for gigabytes; labels of a plain table are a thousandth of their size in the file.
        let limit = length.saturating_mul(MOST_COMPRESSED).min(MOST_RECORD_BYTES).max(length);
        let limit = usize::try_from(limit).unwrap_or(usize::MAX);
        let options = LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_validate_chunk_crcs(true)
            .with_record_length_limit(limit);
        let reader = MessageReader::new_with_options(options);
        Ok(Self { path: path.to_path_buf(), file: BufReader::new(file), reader, length })
    }

    /// The next message, `None` at the end, or in the inner result what is broken.
    pub(super) fn next(&mut self) -> Result<Option<Result<Message<'static>, String>>, ReadError> {
        while let Some(event) = self.reader.next_event() {
            match event {
                Ok(MessageReadEvent::Message(message)) => return Ok(Some(Ok(message))),
                Ok(MessageReadEvent::ReadRequest(bytes)) => {
                    let read = self.file.read(self.reader.insert(bytes));
                    let read = read.map_err(|cause| ReadError::Io { path: self.path.clone(), cause })?;
                    self.reader.notify_read(read);
                }
                Err(error) => return Ok(Some(Err(error.to_string()))),
            }
        }
        Ok(None)
    }

    /// Every channel that was seen.
    fn topics(&self) -> impl Iterator<Item = TopicSurvey> {
        (0..=u16::MAX).filter_map(|id| self.reader.get_channel(id)).map(|channel| TopicSurvey {
            name: channel.topic.clone(),
            schema: channel.schema.as_ref().map_or(String::new(), |schema| schema.name.clone()),
            encoding: channel.message_encoding.clone(),
            ..TopicSurvey::default()
        })
    }
}

/// Counts what is on every topic and the times of the stages.
///
/// # Errors
/// [`ReadError`] when there is nothing to read; damage further on is told in [`Survey::damage`] instead.
pub fn survey(path: &Path) -> Result<Survey, ReadError> {
    let mut messages = Messages::open(path)?;
    let mut survey = Survey { bytes: messages.length, ..Survey::default() };
    let mut counts: BTreeMap<String, (u64, u64)> = BTreeMap::new();
    let mut times: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    while let Some(message) = messages.next()? {
        let message = match message {
            Ok(message) => message,
            Err(damage) => {
                survey.damage = Some(damage);
                break;
            }
        };
        let (number, bytes) = counts.entry(message.channel.topic.clone()).or_default();
        *number += 1;
        *bytes += message.data.len() as u64;
        survey.first_ns = Some(survey.first_ns.map_or(message.log_time, |t| t.min(message.log_time)));
        survey.last_ns = Some(survey.last_ns.map_or(message.log_time, |t| t.max(message.log_time)));
        if ![TIMINGS, SCENE, OUTCOME].contains(&message.channel.topic.as_str()) {
            continue;
        }
        let fields: Fields = serde_json::from_slice(&message.data).map_err(|e| ReadError::Message {
            path: path.to_path_buf(),
            topic: message.channel.topic.clone(),
            number: *number - 1,
            cause: e.to_string(),
        })?;
        match message.channel.topic.as_str() {
            TIMINGS => {
                add_times(&fields, &mut times);
                let dropped = fields.get("frames_dropped").and_then(serde_json::Value::as_u64).unwrap_or(0);
                survey.frames_dropped = survey.frames_dropped.max(dropped);
            }
            SCENE => {
                let items = |key| fields.get(key).and_then(serde_json::Value::as_array).map_or(&[][..], Vec::as_slice);
                survey.regions += items("regions").len() as u64;
                let objects = items("objects");
                survey.objects += objects.len() as u64;
                let has = |item: &serde_json::Value, key| item.get(key).is_some_and(|value| !value.is_null());
                survey.placed += objects.iter().filter(|o| has(o, "world")).count() as u64;
                let detections = items("detections");
                let recognized = detections.iter().filter(|d| has(d, "name")).count();
                survey.recognized += recognized as u64;
                survey.unknown += (detections.len() - recognized) as u64;
            }
            _ => match fields.get("outcome").and_then(serde_json::Value::as_str) {
                None | Some("accepted") => {}
                Some(outcome) => *survey.outcomes.entry(outcome.to_string()).or_default() += 1,
            },
        }
    }
    survey.topics = messages.topics().collect();
    survey.topics.sort_by(|a, b| a.name.cmp(&b.name));
    for topic in &mut survey.topics {
        (topic.messages, topic.bytes) = counts.get(&topic.name).copied().unwrap_or_default();
    }
    survey.frames = counts.get(IMAGE).map_or(0, |(messages, _)| *messages);
    survey.commands = counts.get(COMMAND).map_or(0, |(messages, _)| *messages);
    survey.stages = times.into_iter().filter_map(|(stage, times)| statistics(stage, times)).collect();
    survey.stages.sort_by_key(|s| rank(&s.stage));
    Ok(survey)
}

fn add_times(fields: &Fields, times: &mut BTreeMap<String, Vec<f64>>) {
    for (key, value) in fields {
        if let (Some(stage), Some(value)) = (key.strip_suffix("_ms"), value.as_f64()) {
            times.entry(stage.to_string()).or_default().push(value);
        }
    }
}

/// Where a stage stands in a table: JSON objects have no order. Unknown stages come before the total.
fn rank(stage: &str) -> usize {
    const CHAIN: [&str; 7] = ["transport", "convert", "segment", "saliency", "regions", "shadow", "recognize"];
    match CHAIN.iter().position(|known| *known == stage) {
        Some(rank) => rank,
        None if stage == "total" => CHAIN.len() + 1,
        None => CHAIN.len(),
    }
}

fn statistics(stage: String, mut times: Vec<f64>) -> Option<StageStatistics> {
    times.sort_by(f64::total_cmp);
    let value = |share: f64| times.get(((times.len() as f64 * share).ceil() as usize).max(1) - 1).copied();
    Some(StageStatistics { stage, frames: times.len(), p50_ms: value(0.5)?, p99_ms: value(0.99)?, max_ms: value(1.0)? })
}

/// Reads the stages of up to `wanted` frames, spread evenly over the recording, and what is damaged, if anything.
///
/// # Errors
/// [`ReadError`] when the file is no recording or a message of a frame cannot be decoded.
pub fn frames(path: &Path, wanted: usize) -> Result<(Vec<FrameStages>, Option<String>), ReadError> {
    let found = survey(path)?;
    let images = found.frames;
    let wanted = (wanted as u64).min(images);
    let picked: Vec<u64> = (0..wanted).map(|i| (2 * i + 1) * images / (2 * wanted)).collect();

    let mut messages = Messages::open(path)?;
    let mut stages: Vec<FrameStages> = Vec::new();
    let mut image_number = 0;
    // The recorder writes the topics of a frame one after the other, the image first.
    let mut in_picked_frame = false;
    while let Some(Ok(message)) = messages.next()? {
        let error = |cause: String| ReadError::Message {
            path: path.to_path_buf(),
            topic: message.channel.topic.clone(),
            number: image_number,
            cause,
        };
        if message.channel.topic == IMAGE {
            in_picked_frame = picked.contains(&image_number);
            if in_picked_frame {
                let image = decode_image(&message).map_err(error)?;
                stages.push(FrameStages { timestamp_ns: message.log_time, image, ..FrameStages::default() });
            }
            image_number += 1;
            continue;
        }
        let Some(frame) = stages.last_mut().filter(|f| in_picked_frame && f.timestamp_ns == message.log_time) else {
            continue;
        };
        let size = frame.image.dimensions();
        match message.channel.topic.as_str() {
            LABELS => frame.labels = decode_labels(&message.data, size).map_err(error)?,
            SALIENCY => frame.saliency = decode_saliency(&message.data, size).map_err(error)?,
            REGIONS => frame.outlines = decode_outlines(&message).map_err(error)?,
            DETECTIONS => frame.detections = decode_detections(&message).map_err(error)?,
            SCENE => name_detections(&message, &mut frame.detections).map_err(error)?,
            MASKS => frame.masks = decode_masks(&message.data, size).map_err(error)?,
            OUTLINES => frame.object_outlines = decode_outlines(&message).map_err(error)?,
            _ => {}
        }
    }
    Ok((stages, found.damage))
}

pub(super) fn decode_image(message: &Message<'_>) -> Result<RgbImage, String> {
    let schema = message.channel.schema.as_ref().map_or("", |schema| schema.name.as_str());
    match schema {
        "foxglove.CompressedImage" => {
            let message = CompressedImage::decode(&*message.data).map_err(|e| e.to_string())?;
            Ok(image::load_from_memory(&message.data).map_err(|e| e.to_string())?.into_rgb8())
        }
        "foxglove.RawImage" => {
            let raw = RawImage::decode(&*message.data).map_err(|e| e.to_string())?;
            let rows = rows(&raw, "rgb8", 3)?;
            RgbImage::from_raw(raw.width, raw.height, rows).ok_or_else(|| "too large".to_string())
        }
        other => Err(format!("an image of schema {other:?}; known are foxglove.CompressedImage and foxglove.RawImage")),
    }
}

/// The pixels of a raw image without padding, after checking every length.
fn rows(raw: &RawImage, encoding: &str, bytes_per_pixel: usize) -> Result<Vec<u8>, String> {
    if raw.encoding != encoding {
        return Err(format!("pixel format {:?} where {encoding:?} is expected", raw.encoding));
    }
    let row = raw.width as usize * bytes_per_pixel;
    let (step, height) = (raw.step as usize, raw.height as usize);
    let needed = step.checked_mul(height).ok_or("size overflows")?;
    if step < row || raw.data.len() < needed {
        return Err(format!(
            "{} bytes with a step of {step} for {} x {} pixels of {bytes_per_pixel} bytes",
            raw.data.len(),
            raw.width,
            raw.height
        ));
    }
    if row == 0 {
        return Ok(Vec::new());
    }
    Ok(raw.data.chunks_exact(step).take(height).flat_map(|line| &line[..row]).copied().collect())
}

fn sized(message: &[u8], size: (u32, u32)) -> Result<RawImage, String> {
    let raw = RawImage::decode(message).map_err(|e| e.to_string())?;
    if (raw.width, raw.height) != size {
        return Err(format!("{} x {} pixels, the camera image has {} x {}", raw.width, raw.height, size.0, size.1));
    }
    Ok(raw)
}

fn floats(bytes: &[u8]) -> impl Iterator<Item = f32> {
    bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b))
}

pub(super) fn decode_labels(message: &[u8], size: (u32, u32)) -> Result<Vec<u32>, String> {
    let raw = sized(message, size)?;
    if raw.encoding == "32FC1" {
        return Ok(floats(&rows(&raw, "32FC1", 4)?).map(|l| l as u32).collect());
    }
    let bytes = rows(&raw, "mono16", 2)?;
    Ok(bytes.as_chunks::<2>().0.iter().map(|b| u16::from_le_bytes(*b).into()).collect())
}

pub(super) fn decode_saliency(message: &[u8], size: (u32, u32)) -> Result<Vec<f32>, String> {
    let raw = sized(message, size)?;
    if raw.encoding == "32FC1" {
        return Ok(floats(&rows(&raw, "32FC1", 4)?).collect());
    }
    Ok(rows(&raw, "mono8", 1)?.into_iter().map(|s| f32::from(s) / 255.0).collect())
}

pub(super) fn decode_masks(message: &[u8], size: (u32, u32)) -> Result<Vec<u8>, String> {
    rows(&sized(message, size)?, "mono8", 1)
}

fn decode_outlines(message: &Message<'_>) -> Result<Vec<Outline>, String> {
    let annotations = ImageAnnotations::decode(&*message.data).map_err(|e| e.to_string())?;
    let outline = |points: &[foxglove::messages::Point2]| points.iter().map(|p| [p.x as u32, p.y as u32]).collect();
    Ok(annotations.points.iter().map(|p| outline(&p.points)).collect())
}

/// Outlines and arrows: the arrow is the last of what is drawn of a detection.
fn decode_detections(message: &Message<'_>) -> Result<Vec<SeenDetection>, String> {
    let annotations = ImageAnnotations::decode(&*message.data).map_err(|e| e.to_string())?;
    let mut detections = Vec::new();
    let mut outlines: Vec<Outline> = Vec::new();
    for drawn in &annotations.points {
        if drawn.r#type == i32::from(points_annotation::Type::LineList) {
            let ends = drawn.points.as_chunks::<2>().0;
            let arrow = ends.iter().map(|[from, to]| [[from.x, from.y], [to.x, to.y]]).collect();
            detections.push(SeenDetection {
                outlines: std::mem::take(&mut outlines),
                arrow,
                ..SeenDetection::default()
            });
        } else {
            outlines.push(drawn.points.iter().map(|p| [p.x as u32, p.y as u32]).collect());
        }
    }
    Ok(detections)
}

/// Names and angles stand in the figures of the scene, which come after the drawing.
fn name_detections(message: &Message<'_>, detections: &mut [SeenDetection]) -> Result<(), String> {
    let fields: Fields = serde_json::from_slice(&message.data).map_err(|e| e.to_string())?;
    let figures = fields.get("detections").and_then(serde_json::Value::as_array).map_or(&[][..], Vec::as_slice);
    for (detection, figures) in detections.iter_mut().zip(figures) {
        detection.name = figures["name"].as_str().map(str::to_owned);
        detection.angle_deg = figures["image"]["angle_deg"].as_f64().unwrap_or_default();
    }
    Ok(())
}
