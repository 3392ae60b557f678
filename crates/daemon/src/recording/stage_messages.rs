//! The messages of a frame as the recorder writes them, made again: equal bytes say that every stage is the same.

use foxglove::Encode;

use super::detections::{DetectionMessage, detections};
use super::messages::{
    DETECTIONS, LABELS, MASKS, OUTLINES, PLACES, REGIONS, RegionMessage, SALIENCY, SCENE, SceneMessage, TRANSFORMS,
    raw_image, regions,
};
use super::objects::{ObjectMessage, outlines, places, transforms};
use super::recorder::{FrameRecord, FrameSlot, json, protobuf};
use super::{RecordError, SaliencyEncoding};
use crate::masks;
use crate::picture::region_outlines;

/// Topics and messages of all stages of a frame, without its image and its times.
///
/// # Errors
/// [`RecordError::Encode`]
pub(crate) fn stage_messages(
    frame: &FrameRecord<'_>,
    saliency_encoding: SaliencyEncoding,
) -> Result<Vec<(&'static str, Vec<u8>)>, RecordError> {
    let mut slot = FrameSlot::default();
    slot.fill(frame, saliency_encoding, 0);
    let (at, size, camera) = (slot.timestamp_ns, slot.size, slot.camera.as_str());
    let mut messages = Vec::new();
    let mut put = |topic: &'static str, message: &dyn Message| -> Result<(), RecordError> {
        messages.push((topic, message.bytes(topic)?));
        Ok(())
    };
    let (encoding, bytes) = if slot.wide_labels { ("32FC1", 4) } else { ("mono16", 2) };
    put(LABELS, &raw_image(at, camera, size, encoding, bytes, slot.labels.clone()))?;
    let (encoding, bytes) = match saliency_encoding {
        SaliencyEncoding::Mono8 => ("mono8", 1),
        SaliencyEncoding::Float32 => ("32FC1", 4),
    };
    put(SALIENCY, &raw_image(at, camera, size, encoding, bytes, slot.saliency.clone()))?;
    let label = |pixel: usize| frame.scene.partition.labels().get(pixel).copied().unwrap_or_default();
    let outlined: Vec<_> = slot.regions.iter().map(|r| (r, region_outlines(size.0, r, label))).collect();
    put(REGIONS, &regions(at, &outlined))?;
    let mut codes = Vec::new();
    masks::paint(size, &slot.objects, &mut codes);
    put(MASKS, &raw_image(at, camera, size, "mono8", 1, codes))?;
    let placed = slot.places.as_deref();
    put(OUTLINES, &outlines(at, &slot.objects, placed.unwrap_or_default()))?;
    if let Some(base_from_world) = &slot.base_from_world {
        put(TRANSFORMS, &transforms(at, base_from_world))?;
    }
    if let Some(placed) = placed {
        put(PLACES, &places(at, placed))?;
    }
    put(DETECTIONS, &detections(at, &slot.detections))?;
    let scene = SceneMessage {
        sequence: slot.sequence,
        camera,
        width_px: size.0,
        height_px: size.1,
        partitions: slot.partitions,
        regions: slot.regions.iter().enumerate().map(|(id, r)| RegionMessage::new(id, r)).collect(),
        objects: ObjectMessage::all(&slot.objects, placed.unwrap_or_default()),
        detections: DetectionMessage::all(&slot.detections, slot.base_from_world.as_ref()),
    };
    messages.push((SCENE, json(SCENE, &scene)?));
    Ok(messages)
}

/// A protobuf message, whatever its type.
trait Message {
    fn bytes(&self, topic: &'static str) -> Result<Vec<u8>, RecordError>;
}

impl<M: Encode> Message for M {
    fn bytes(&self, topic: &'static str) -> Result<Vec<u8>, RecordError> {
        protobuf(topic, self)
    }
}
