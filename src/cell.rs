//! A robot cell: parameters, scratch memory and the chain of stages.

use std::time::Instant;

use samsod_camera::Camera;
use samsod_recognize::{Catalogue, RecognizeError, RecognizeParamError, RecognizeParams, Recognizer, settle};
use samsod_saliency::{
    RegionError, Saliency, SaliencyError, SaliencyParamError, SaliencyParams, Threshold, salient_regions_into,
};
use samsod_segment::{RgbView, SegmentError, SegmentParamError, SegmentParams, Segmenter};
use samsod_shadow::{ShadowError, ShadowParamError, ShadowParams, ShadowSeparator, bare_regions};
use serde::{Deserialize, Serialize};

use crate::{Scene, StageTimes};

/// Parameters of the vision chain; every field has a default.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CellParams {
    /// Mean shift and partitions.
    pub segment: SegmentParams,
    /// Saliency scales and method.
    pub saliency: SaliencyParams,
    /// Threshold of the salient regions.
    pub regions: RegionParams,
    /// Separation of objects from their shadows. Without a least area of an object, that follows from the least area of
    /// a partition or the spatial bandwidth if `segment` gives one, else from the size of the frame.
    pub shadow: ShadowParams,
    /// Recognition of the objects; of use to a cell with a catalogue.
    pub recognize: RecognizeParams,
}

impl CellParams {
    /// The parameters of the separation with what follows from the segmentation: who asks for finer partitions wants
    /// smaller objects.
    fn shadow_in_force(&self) -> ShadowParams {
        // Two thirds of the smallest partition, and half of the squared bandwidth, as the separator does by itself.
        let from_area = self.segment.min_area_px.map(|area| area - area / 3);
        let from_bandwidth = self.segment.spatial_bandwidth_px.map(|px| (px * px * 0.5) as u32);
        let follows = from_area.or(from_bandwidth).map(|area| area.max(1));
        let min_object_area_px = self.shadow.min_object_area_px.or(follows);
        ShadowParams { min_object_area_px, ..self.shadow.clone() }
    }
}

/// Parameters of the salient regions.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct RegionParams {
    /// `"positive"`, `"adaptive"` or a number in [0, 1].
    pub threshold: Threshold,
}

/// Why a cell could not be made or a frame not be inspected.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum CellError {
    /// A segmentation parameter is out of range.
    #[error("segment: {0}")]
    SegmentParams(#[from] SegmentParamError),
    /// A saliency parameter is out of range.
    #[error("saliency: {0}")]
    SaliencyParams(#[from] SaliencyParamError),
    /// A parameter of the shadow separation is out of range.
    #[error("shadow: {0}")]
    ShadowParams(#[from] ShadowParamError),
    /// A frame could not be segmented.
    #[error("segment: {0}")]
    Segment(#[from] SegmentError),
    /// The saliency of a frame could not be computed.
    #[error("saliency: {0}")]
    Saliency(#[from] SaliencyError),
    /// The salient regions of a frame could not be found.
    #[error("regions: {0}")]
    Regions(#[from] RegionError),
    /// Objects could not be separated from shadows.
    #[error("shadow: {0}")]
    Shadow(#[from] ShadowError),
    /// A parameter of the recognition is out of range.
    #[error("recognize: {0}")]
    RecognizeParams(#[from] RecognizeParamError),
    /// Objects could not be recognised.
    #[error("recognize: {0}")]
    Recognize(#[from] RecognizeError),
}

/// The vision chain of one robot cell.
///
/// A cell keeps the scratch memory of its stages: inspecting a stream of frames of one size into the same
/// [`Scene`] with [`Cell::inspect_into`] allocates nothing large after the first.
///
/// ```
/// use samsod::segment::RgbView;
/// let pixels = vec![90u8; 64 * 48 * 3];
/// let frame = RgbView::from_raw(64, 48, pixels.as_slice()).ok_or("size")?;
/// let mut cell = samsod::Cell::new(samsod::CellParams::default())?;
/// let scene = cell.inspect(&frame)?;
/// assert_eq!(scene.partition.len(), 1);
/// assert!(scene.regions.is_empty() && scene.objects.is_empty());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Cell {
    params: CellParams,
    segmenter: Segmenter,
    saliency: Saliency,
    separator: ShadowSeparator,
    recognizer: Option<Recognizer>,
    camera: Option<Camera>,
}

impl Cell {
    /// Makes a cell without a catalogue: it finds objects and does not name them.
    ///
    /// # Errors
    /// The parameter that is out of range, with the value and what is allowed.
    pub fn new(params: CellParams) -> Result<Self, CellError> {
        let segmenter = Segmenter::new(params.segment.clone())?;
        let saliency = Saliency::new(params.saliency.clone())?;
        params.regions.threshold.check()?;
        params.shadow.check()?;
        let separator = ShadowSeparator::new(params.shadow_in_force())?;
        params.recognize.check()?;
        Ok(Self { params, segmenter, saliency, separator, recognizer: None, camera: None })
    }

    /// Makes a cell that names its objects.
    ///
    /// # Errors
    /// As [`Cell::new`], and a catalogue that cannot be used.
    pub fn with_catalogue(params: CellParams, catalogue: Catalogue) -> Result<Self, CellError> {
        let mut cell = Self::new(params)?;
        cell.recognizer = Some(Recognizer::new(catalogue, cell.params.recognize.clone())?);
        Ok(cell)
    }

    /// The catalogue, of a cell that has one.
    pub fn catalogue(&self) -> Option<&Catalogue> {
        self.recognizer.as_ref().map(Recognizer::catalogue)
    }

    /// The camera that takes the frames to come, with its pose over the table; `None` for one that is not known:
    /// detections then have no place in the world.
    pub fn set_camera(&mut self, camera: Option<Camera>) {
        self.camera = camera;
    }

    /// The parameters in force.
    pub fn params(&self) -> &CellParams {
        &self.params
    }

    /// Inspects one frame.
    ///
    /// # Errors
    /// [`CellError`] for a frame without pixels or one that is too large.
    pub fn inspect(&mut self, frame: &RgbView<'_>) -> Result<Scene, CellError> {
        let mut scene = Scene::default();
        self.inspect_into(frame, &mut scene)?;
        Ok(scene)
    }

    /// Inspects one frame into a scene whose memory is reused.
    ///
    /// # Errors
    /// As [`Cell::inspect`]; the scene then holds no usable result.
    pub fn inspect_into(&mut self, frame: &RgbView<'_>, scene: &mut Scene) -> Result<(), CellError> {
        let start = Instant::now();
        self.segmenter.segment_into(frame, &mut scene.partition)?;
        let segmented = Instant::now();
        self.saliency.compute_into(&scene.partition, &mut scene.saliency)?;
        let weighed = Instant::now();
        salient_regions_into(&scene.saliency, &scene.partition, self.params.regions.threshold, &mut scene.regions)?;
        let joined = Instant::now();
        let Scene { partition, saliency, regions, objects, detections, times } = scene;
        self.separator.separate_into(frame, partition, saliency, regions, objects)?;
        let separated = Instant::now();
        detections.clear();
        if let Some(recognizer) = &self.recognizer {
            let bare = bare_regions(partition, regions, objects);
            *detections = recognizer.recognize_all(frame, objects, &bare, self.camera.as_ref())?;
            let (width, height) = frame.dimensions();
            *objects = settle(objects, detections, self.separator.params().min_object_area_for(width, height));
        }
        *times = StageTimes {
            segment: segmented - start,
            saliency: weighed - segmented,
            regions: joined - weighed,
            shadow: separated - joined,
            recognize: separated.elapsed(),
        };
        Ok(())
    }
}
