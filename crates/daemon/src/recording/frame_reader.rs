//! Reading recordings frame by frame, every message as it was written, for those who compare.
//!
//! In: an MCAP file by samsod. Out: one [`RecordedFrame`] after the other, what the file was made with, and where the robot was
//! sent for which frame. What lies before damage is returned.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};

use foxglove::messages::{CompressedImage, RawImage};
use image::RgbImage;
use mcap::Message;
use mcap::records::Record;
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use prost::Message as _;

use super::messages::{COMMAND, IMAGE, LABELS, MASKS, SALIENCY, SCENE, TIMINGS};
use samsod_recording::{Messages, ReadError};

use super::reader;
use crate::made_with::{self, MadeWith};

/// Longest part of a file that is searched for what it was made with, bytes: it stands at the head.
const HEAD_BYTES: u64 = 16 << 20;

/// One frame with the messages of its stages.
#[derive(Debug, Clone, Default)]
pub(crate) struct RecordedFrame {
    /// When it was taken, ns since the Unix epoch.
    pub(crate) timestamp_ns: u64,
    /// Name of the camera.
    pub(crate) camera: String,
    /// The pixels.
    pub(crate) image: RgbImage,
    /// Whether these are the pixels that were seen: not so of JPEG.
    pub(crate) is_exact: bool,
    /// The last message is there, so that none before it is missing.
    pub(crate) is_whole: bool,
    /// The messages but that of the image, by topic.
    pub(crate) messages: BTreeMap<String, Vec<u8>>,
}

impl RecordedFrame {
    /// The figures of the scene.
    pub(crate) fn scene(&self) -> Option<serde_json::Value> {
        serde_json::from_slice(self.messages.get(SCENE)?).ok()
    }

    /// Label of each pixel.
    pub(crate) fn labels(&self) -> Option<Vec<u32>> {
        reader::decode_labels(self.messages.get(LABELS)?, self.image.dimensions()).ok()
    }

    /// Saliency of each pixel.
    pub(crate) fn saliency(&self) -> Option<Vec<f32>> {
        reader::decode_saliency(self.messages.get(SALIENCY)?, self.image.dimensions()).ok()
    }

    /// Code of each pixel.
    pub(crate) fn masks(&self) -> Option<Vec<u8>> {
        reader::decode_masks(self.messages.get(MASKS)?, self.image.dimensions()).ok()
    }

    /// Whether the saliency map was recorded as it was computed.
    pub(crate) fn has_float_saliency(&self) -> bool {
        let message = self.messages.get(SALIENCY).and_then(|data| RawImage::decode(&**data).ok());
        message.is_some_and(|image| image.encoding == "32FC1")
    }
}

/// Where the robot was sent for a frame, by the time of the frame: target and phase as in `/robot/command`.
pub(crate) type Targets = BTreeMap<u64, Vec<Target>>;

/// A command that moves the tool.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Target {
    /// Number of the command.
    pub(crate) command: u64,
    /// Step of the pick-and-place sequence, if it is one.
    pub(crate) phase: Option<String>,
    /// The pose, as JSON.
    pub(crate) pose: serde_json::Value,
}

/// The commands of a recording that follow from frames. Damage ends it: see [`FrameReader::damage`].
pub(crate) fn targets(path: &Path) -> Result<Targets, ReadError> {
    let mut messages = Messages::open(path)?;
    let mut targets = Targets::new();
    while let Some(Ok(message)) = messages.next()? {
        if message.channel.topic != COMMAND {
            continue;
        }
        let Ok(fields) = serde_json::from_slice::<serde_json::Value>(&message.data) else { continue };
        let (Some(frame), Some(command)) = (fields["frame_timestamp_ns"].as_u64(), fields["id"].as_u64()) else {
            continue;
        };
        if !fields["target"].is_null() {
            let phase = fields["phase"].as_str().map(str::to_owned);
            targets.entry(frame).or_default().push(Target { command, phase, pose: fields["target"].clone() });
        }
    }
    Ok(targets)
}

/// What a recording was made with; `None` when it does not say so.
///
/// # Errors
/// [`ReadError`] when the file cannot be read or is no recording.
pub fn made_with(path: &Path) -> Result<Option<MadeWith>, ReadError> {
    let io = |cause| ReadError::Io { path: path.to_path_buf(), cause };
    // Says what is no recording.
    let length = Messages::open(path)?.file_bytes();
    let mut file = BufReader::new(File::open(path).map_err(io)?).take(HEAD_BYTES);
    let limit = usize::try_from(length).unwrap_or(usize::MAX);
    let options = LinearReaderOptions::default().with_emit_chunks(true).with_record_length_limit(limit);
    let mut reader = LinearReader::new_with_options(options);
    while let Some(event) = reader.next_event() {
        match event {
            Ok(LinearReadEvent::ReadRequest(bytes)) => {
                let read = file.read(reader.insert(bytes)).map_err(io)?;
                reader.notify_read(read);
            }
            Ok(LinearReadEvent::Record { opcode, data }) => match mcap::parse_record(opcode, data) {
                Ok(Record::Metadata(record)) if record.name == made_with::METADATA => {
                    return Ok(Some(MadeWith::from_metadata(record.metadata)));
                }
                // It stands before the first message.
                Ok(Record::Chunk { .. } | Record::DataEnd(_)) | Err(_) => break,
                Ok(_) => {}
            },
            Err(_) => break,
        }
    }
    Ok(None)
}

/// The codes in a message on `/masks`.
pub(crate) fn mask_codes(message: &[u8], size: (u32, u32)) -> Option<Vec<u8>> {
    reader::decode_masks(message, size).ok()
}

/// Streams frames.
pub(crate) struct FrameReader {
    path: PathBuf,
    messages: Messages,
    /// The image that ended the frame before.
    next: Option<Message<'static>>,
    images: u64,
    damage: Option<String>,
}

impl FrameReader {
    pub(crate) fn open(path: &Path) -> Result<Self, ReadError> {
        let messages = Messages::open(path)?;
        Ok(Self { path: path.to_path_buf(), messages, next: None, images: 0, damage: None })
    }

    /// Why the file is not whole, if that has been found.
    pub(crate) fn damage(&self) -> Option<&str> {
        self.damage.as_deref()
    }

    fn message(&mut self) -> Result<Option<Message<'static>>, ReadError> {
        if self.damage.is_some() {
            return Ok(None);
        }
        match self.messages.next()? {
            Some(Err(damage)) => {
                self.damage = Some(damage);
                Ok(None)
            }
            Some(Ok(message)) => Ok(Some(message)),
            None => Ok(None),
        }
    }

    /// The next frame; `None` at the end or at damage. The recorder writes the messages of a frame one after the other, the
    /// image first and the times last, with commands and log lines between them.
    ///
    /// # Errors
    /// [`ReadError`]: the file cannot be read, or an image cannot be decoded.
    pub(crate) fn next(&mut self) -> Result<Option<RecordedFrame>, ReadError> {
        let image = loop {
            let message = match self.next.take() {
                Some(message) => Some(message),
                None => self.message()?,
            };
            match message {
                Some(message) if message.channel.topic == IMAGE => break message,
                Some(_) => {}
                None => return Ok(None),
            }
        };
        let number = self.images;
        self.images += 1;
        let failed =
            |cause: String| ReadError::Message { path: self.path.clone(), topic: IMAGE.to_owned(), number, cause };
        let (camera, is_exact) = about_image(&image).map_err(failed)?;
        let timestamp_ns = image.log_time;
        let image = reader::decode_image(&image).map_err(failed)?;
        let mut frame = RecordedFrame { timestamp_ns, camera, image, is_exact, ..RecordedFrame::default() };
        while let Some(message) = self.message()? {
            if message.channel.topic == IMAGE {
                self.next = Some(message);
                break;
            }
            if message.log_time != timestamp_ns {
                continue;
            }
            let is_last = message.channel.topic == TIMINGS;
            frame.messages.insert(message.channel.topic.clone(), message.data.into_owned());
            if is_last {
                frame.is_whole = true;
                break;
            }
        }
        Ok(Some(frame))
    }
}

/// Name of the camera, and whether the pixels are those that were seen.
fn about_image(message: &Message<'_>) -> Result<(String, bool), String> {
    let is_compressed = message.channel.schema.as_ref().is_some_and(|s| s.name == "foxglove.CompressedImage");
    if is_compressed {
        let image = CompressedImage::decode(&*message.data).map_err(|e| e.to_string())?;
        return Ok((image.frame_id, image.format == "png"));
    }
    let image = RawImage::decode(&*message.data).map_err(|e| e.to_string())?;
    Ok((image.frame_id, true))
}
