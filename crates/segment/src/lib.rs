//! Proto-object partitions: mean shift in the joint spatial-range domain (Comaniciu and Meer), section 3.1 of the
//! paper.
//!
//! In: a packed 8-bit RGB image. Out: a [`Partition`]: 4-connected, disjoint, covering the image (eq 1), with area,
//! mean colour, box, centroid and neighbours of every part.
//!
//! The stages, one file each:
//!
//! 1. `working_image`: the image is reduced until the spatial bandwidth is below 8 pixels.
//! 2. `median`: structure much finer than the kernel is removed.
//! 3. `texture`: colour noise and texture of the table are measured, and colours are whitened by them, so that the
//!    range bandwidth is wide along the colours of the grain and narrow across them.
//! 4. `mean_shift`: the mode search, flat kernel, on all cores.
//! 5. `runs`: 4-connected components of alike modes.
//! 6. `merge`: like neighbours and too small components are joined.
//! 7. `table`: texture that still stands on the table goes back to it.
//! 8. `penumbra`: where a shadow fades out, it is table, too; `penumbrae` remembers where.
//! 9. `refine`: boundaries are decided again at full resolution.
//!
//! Cost is linear in the number of pixels: the kernel has the same size at every image size. Results do not depend on
//! the number of threads, nor on the SIMD path.

mod disjoint_sets;
mod mean_shift;
mod median;
mod merge;
mod params;
mod partition;
mod penumbra;
mod penumbrae;
mod refine;
mod runs;
mod segmenter;
mod table;
mod texture;
mod working_image;

pub use params::{SegmentParamError, SegmentParams};
pub use partition::{BoundingBox, LabelError, Partition, ProtoObject, RgbView};
pub use runs::{Run, Runs};
pub use segmenter::{MAX_SIDE_PX, SegmentError, Segmenter};
