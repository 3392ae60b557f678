//! samsod's vision chain as one library: from a frame to the objects on the table, without I/O.
//!
//! [`Cell`] holds the parameters of a robot cell and the scratch memory of every stage;
//! [`Cell::inspect`] turns a borrowed RGB frame into a [`Scene`].

mod cell;
mod scene;

pub use cell::{Cell, CellError, CellParams, RegionParams};
pub use samsod_camera as camera;
pub use samsod_recognize as recognize;
pub use samsod_saliency as saliency;
pub use samsod_segment as segment;
pub use samsod_shadow as shadow;
pub use scene::{Scene, StageTimes};
