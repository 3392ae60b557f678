//! A frame that is shown, with what was seen in it: its scene as JSON, its picture, and the layers over it.
//!
//! Input: the pixels of the frame and its scene. Output: JSON, a JPEG and PNGs, each made when it is first asked for, once for
//! all viewers, on a thread that gives way to vision. Everything is of the same frame.
//!
//! Pictures are as large as the frame, of a large frame a whole fraction of it, at most 2048 px on the longer side; the pixels
//! that the scene tells are those of the frame.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use axum::body::Bytes;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder, RgbImage, imageops};
use samsod::Scene;
use samsod_camera::nalgebra::Isometry3;
use serde::Serialize;
use tokio::sync::{OnceCell, Semaphore};

use super::outline::simplified;
use crate::caption::Arrow;
use crate::masks;
use crate::masks::Shown as Code;
use crate::pick::Pick;
use crate::picture::{mask_outlines, object_outlines, region_colour};
use crate::place::Place;
use crate::scene_sender::{Findings, FrameFacts, SceneJson};

/// Longest side of a picture, px.
const LONGEST_PX: u32 = 2048;
const JPEG_QUALITY: u8 = 82;
/// How far a line that is drawn may lie beside the border, px.
const OUTLINE_TOLERANCE_PX: f64 = 0.8;
/// One picture at a time is made: the cores are vision's.
static ENCODERS: Semaphore = Semaphore::const_new(1);

/// What lies over the picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum Layer {
    /// Proto-object partitions in their mean colours, with white borders.
    Partition,
    /// Saliency: the more salient, the less transparent.
    Saliency,
    /// Objects in their colours and their shadows in white; transparent elsewhere.
    Shadow,
}

impl Layer {
    pub(crate) const ALL: [Self; 3] = [Self::Partition, Self::Saliency, Self::Shadow];

    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Partition => "partition",
            Self::Saliency => "saliency",
            Self::Shadow => "shadow",
        }
    }
}

/// A frame and its scene, as vision hands them on.
#[derive(Debug)]
pub(crate) struct Raw {
    /// Counted by this run of the service from 1, whatever client the frame came from.
    pub(crate) number: u64,
    pub(crate) sequence: u64,
    pub(crate) timestamp_ns: u64,
    pub(crate) camera: String,
    pub(crate) size_px: [u32; 2],
    pub(crate) age: Option<Duration>,
    pub(crate) total: Duration,
    pub(crate) rgb: Vec<u8>,
    pub(crate) scene: Arc<Scene>,
    pub(crate) places: Vec<Option<Place>>,
    pub(crate) base_from_world: Option<Isometry3<f64>>,
    pub(crate) pick: Option<Pick>,
    pub(crate) grasp: Option<samsod_robot::Pose>,
    /// Whether the region of interest has each detection, and each object.
    pub(crate) detections_inside: Vec<bool>,
    pub(crate) objects_inside: Vec<bool>,
}

/// See the module documentation.
#[derive(Debug)]
pub(crate) struct Shown {
    pub(crate) frame: u64,
    /// The question that it answers.
    pub(crate) ticket: u64,
    raw: Mutex<Option<Arc<Raw>>>,
    json: OnceCell<Bytes>,
    jpeg: OnceCell<Bytes>,
    layers: [OnceCell<Bytes>; Layer::ALL.len()],
}

/// Why there is no picture.
#[derive(Debug, thiserror::Error)]
pub(crate) enum ShownError {
    /// Nobody had asked for it while the frame was the newest.
    #[error("a newer frame has come, and this of the older one was not kept")]
    Gone,
    #[error("it cannot be made: {0}")]
    Encode(String),
}

impl Shown {
    pub(crate) fn new(raw: Raw, ticket: u64) -> Self {
        let (frame, raw) = (raw.number, Mutex::new(Some(Arc::new(raw))));
        Self { frame, ticket, raw, json: OnceCell::new(), jpeg: OnceCell::new(), layers: Default::default() }
    }

    /// Lets go of the pixels; gives back their memory if nobody is at work on them.
    pub(crate) fn forget_pixels(&self) -> Option<Vec<u8>> {
        let raw = self.raw.lock().unwrap_or_else(PoisonError::into_inner).take()?;
        Some(Arc::into_inner(raw)?.rgb)
    }

    /// Pixels and scene, while no newer frame has come.
    pub(crate) fn raw(&self) -> Result<Arc<Raw>, ShownError> {
        self.raw.lock().unwrap_or_else(PoisonError::into_inner).clone().ok_or(ShownError::Gone)
    }

    pub(crate) async fn json(&self) -> Result<Bytes, ShownError> {
        self.made(&self.json, None, Raw::json).await
    }

    pub(crate) async fn jpeg(&self) -> Result<Bytes, ShownError> {
        self.made(&self.jpeg, None, Raw::jpeg).await
    }

    pub(crate) async fn layer(&self, layer: Layer) -> Result<Bytes, ShownError> {
        self.made(&self.layers[layer as usize], None, move |raw| raw.layer(layer)).await
    }

    /// Makes everything that viewers of these layers ask for, also when newer frames come meanwhile: where frames come faster
    /// than pictures can be made, none would ever be complete.
    pub(crate) async fn make_all(&self, layers: impl Iterator<Item = Layer>) -> Result<(), ShownError> {
        let raw = self.raw().ok();
        self.made(&self.json, raw.clone(), Raw::json).await?;
        self.made(&self.jpeg, raw.clone(), Raw::jpeg).await?;
        for layer in layers {
            self.made(&self.layers[layer as usize], raw.clone(), move |raw| raw.layer(layer)).await?;
        }
        Ok(())
    }

    async fn made(
        &self,
        cell: &OnceCell<Bytes>,
        raw: Option<Arc<Raw>>,
        make: impl FnOnce(&Raw) -> Result<Vec<u8>, String> + Send + 'static,
    ) -> Result<Bytes, ShownError> {
        let made = cell.get_or_try_init(|| async {
            let raw = raw.map_or_else(|| self.raw(), Ok)?;
            // Never closed.
            let _turn = ENCODERS.acquire().await;
            let made = tokio::task::spawn_blocking(move || make(&raw)).await;
            let made = made.map_err(|e| ShownError::Encode(e.to_string()))?;
            made.map(Bytes::from).map_err(ShownError::Encode)
        });
        made.await.cloned()
    }
}

/// The scene as the page reads it: that of local clients, and what is drawn.
#[derive(Debug, Serialize)]
struct PageScene<'a> {
    frame: u64,
    #[serde(flatten)]
    scene: SceneJson<'a>,
    /// From the frame in hand to its scene and order handed on.
    total_ms: f64,
    drawing: Drawing,
}

#[derive(Debug, Serialize)]
struct Drawing {
    objects: Vec<Drawn>,
    detections: Vec<Drawn>,
}

#[derive(Debug, Serialize)]
struct Drawn {
    id: usize,
    /// Closed lines through pixel centres, the outer ones and those of holes.
    outlines_px: Vec<Vec<[f64; 2]>>,
    /// An arrow along the x axis of a part, or a line along the longest axis.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    arrow_px: Vec<[[f64; 2]; 2]>,
    colour: String,
    inside: bool,
}

impl Raw {
    fn json(&self) -> Result<Vec<u8>, String> {
        let Self { number, sequence, timestamp_ns, size_px, age, .. } = *self;
        let facts = FrameFacts { sequence, timestamp_ns, camera: &self.camera, size_px, age };
        let findings = Findings {
            places: &self.places,
            base_from_world: self.base_from_world.as_ref(),
            pick: self.pick,
            grasp: self.grasp,
        };
        let scene = &*self.scene;
        let message = PageScene {
            frame: number,
            scene: SceneJson::new(&facts, scene, scene.regions.len(), &findings),
            total_ms: self.total.as_secs_f64() * 1e3,
            drawing: self.drawing(),
        };
        serde_json::to_vec(&message).map_err(|e| e.to_string())
    }

    fn drawing(&self) -> Drawing {
        let colour = |id| {
            let [r, g, b] = region_colour(id).0;
            format!("#{r:02x}{g:02x}{b:02x}")
        };
        let lines = |outline: Vec<[u32; 2]>| {
            let points: Vec<[f64; 2]> = outline.iter().map(|point| point.map(f64::from)).collect();
            simplified(&points, OUTLINE_TOLERANCE_PX)
        };
        let inside = |inside: &[bool], id: usize| inside.get(id).copied().unwrap_or(true);
        let objects = self.scene.objects.iter().enumerate().map(|(id, object)| Drawn {
            id,
            outlines_px: object_outlines(object).map(lines).collect(),
            arrow_px: Vec::new(),
            colour: colour(id),
            inside: inside(&self.objects_inside, id),
        });
        let detections = self.scene.detections.iter().enumerate().map(|(id, detection)| Drawn {
            id,
            outlines_px: mask_outlines(&detection.mask).into_iter().map(lines).collect(),
            arrow_px: Arrow::of(detection).lines(),
            colour: colour(id),
            inside: inside(&self.detections_inside, id),
        });
        Drawing { objects: objects.collect(), detections: detections.collect() }
    }

    /// How many pixels of the frame are one of a picture, and the size of the picture.
    fn scale(&self) -> (u32, [u32; 2]) {
        let step = self.size_px[0].max(self.size_px[1]).div_ceil(LONGEST_PX).max(1);
        (step, self.size_px.map(|side| side.div_ceil(step)))
    }

    fn jpeg(&self) -> Result<Vec<u8>, String> {
        let (step, size) = self.scale();
        let small;
        let pixels = if step == 1 {
            &self.rgb
        } else {
            let [width, height] = self.size_px;
            let frame = RgbImage::from_raw(width, height, self.rgb.clone()).ok_or("the frame has other pixels")?;
            small = imageops::thumbnail(&frame, size[0], size[1]).into_raw();
            &small
        };
        let [width, height] = size.map(|side| u16::try_from(side).unwrap_or(u16::MAX));
        let mut jpeg = Vec::with_capacity(pixels.len() / 8);
        let mut encoder = jpeg_encoder::Encoder::new(&mut jpeg, JPEG_QUALITY);
        encoder.set_sampling_factor(jpeg_encoder::SamplingFactor::F_2_2);
        encoder.encode(pixels, width, height, jpeg_encoder::ColorType::Rgb).map_err(|e| e.to_string())?;
        Ok(jpeg)
    }

    fn layer(&self, layer: Layer) -> Result<Vec<u8>, String> {
        match layer {
            Layer::Partition => self.partition(),
            Layer::Saliency => self.saliency(),
            Layer::Shadow => self.shadow(),
        }
    }

    fn partition(&self) -> Result<Vec<u8>, String> {
        let (labels, parts) = (self.scene.partition.labels(), self.scene.partition.objects());
        let width = self.size_px[0] as usize;
        self.rgba(|pixel, step| {
            let own = labels.get(pixel);
            let differs = |other: usize| labels.get(other).is_some_and(|other| Some(other) != own);
            let is_last = pixel % width + step >= width;
            if !is_last && differs(pixel + step) || differs(pixel + step * width) {
                return [255; 4];
            }
            let mean = own.and_then(|&label| parts.get(label as usize)).map_or([0.0; 3], |part| part.mean);
            let [r, g, b] = mean.map(|c| c.round() as u8);
            [r, g, b, 255]
        })
    }

    fn saliency(&self) -> Result<Vec<u8>, String> {
        let values = self.scene.saliency.values();
        let most = values.iter().copied().fold(0.0f32, f32::max);
        let scale = if most > 0.0 { 1.0 / most } else { 0.0 };
        self.rgba(|pixel, _| {
            // The square root lets a faint region be seen beside a strong one.
            let share = (values.get(pixel).copied().unwrap_or(0.0).max(0.0) * scale).sqrt();
            [255, (90.0 + 140.0 * share) as u8, (60.0 * share) as u8, (255.0 * share).round() as u8]
        })
    }

    fn shadow(&self) -> Result<Vec<u8>, String> {
        let mut codes = Vec::new();
        masks::paint(self.size_px.into(), &self.scene.objects, &mut codes);
        self.rgba(|pixel, _| match Code::from_code(codes.get(pixel).copied().unwrap_or(0)) {
            Code::Table => [0; 4],
            Code::Object(index) => {
                let [r, g, b] = region_colour(index).0;
                [r, g, b, 255]
            }
            Code::Shadow(_) => [255; 4],
        })
    }

    /// A PNG of the colours of pixels; `colour` is given the index of a pixel and how far its neighbour is.
    fn rgba(&self, colour: impl Fn(usize, usize) -> [u8; 4]) -> Result<Vec<u8>, String> {
        let (step, [width, height]) = self.scale();
        let mut pixels = Vec::with_capacity(width as usize * height as usize * 4);
        for y in 0..height {
            let row = (y * step) as usize * self.size_px[0] as usize;
            for x in 0..width {
                pixels.extend_from_slice(&colour(row + (x * step) as usize, step as usize));
            }
        }
        let mut png = Vec::new();
        let encoder = PngEncoder::new_with_quality(&mut png, CompressionType::Fast, FilterType::Up);
        encoder.write_image(&pixels, width, height, ExtendedColorType::Rgba8).map_err(|e| e.to_string())?;
        Ok(png)
    }
}
