//! Separation of objects from their shadows inside salient regions (section 4.1 of the paper).
//!
//! In: a frame, its [`Partition`](samsod_segment::Partition), its saliency and its
//! [`SalientRegion`](samsod_saliency::SalientRegion)s. Out: the [`ObjectRegion`]s: exact pixels, outline, holes,
//! oriented box and shadow of every object. One region gives none (it is all shadow), one, or several (parts that only a
//! shadow joined).
//!
//! The stages, one file each:
//!
//! 1. `crop`: whose pixel is which, within the box of every region.
//! 2. A method decides what each of them shows, object, shadow or table: `paper` by the normalised cut (`ncut`) of
//!    hue histograms (`hue`), `evidence` by what tells a shadow from a dark part: the bare table (`table_model`), pieces
//!    (`basins`), their tones (`tone`) and the rim of the region (`rim`), which with what stands around them (`signs`,
//!    `groups`) are put to fitted trees (`judgement`, `forest`); `holes` are cut, outlines settled pixel by pixel (`fringe`),
//!    and `necks` cut.
//! 3. `objects`: connected components of object pixels (`components`); shadow pixels go to the nearest of them (`nearest`).
//! 4. `outline` and `oriented_box` measure.
//!
//! Where parts are recognised afterwards, `settle` gives them the pixels that are theirs.
//!
//! Regions are worked on side by side; results do not depend on the number of threads.

mod bare;
mod basins;
mod components;
mod crop;
mod evidence;
mod forest;
mod fringe;
mod groups;
mod holes;
mod hue;
mod judgement;
mod mask;
mod ncut;
mod nearest;
mod necks;
mod objects;
mod oriented_box;
mod outline;
mod paper;
mod params;
mod rim;
mod separator;
mod settle;
mod signs;
mod table_model;
mod tone;

pub use bare::{BareRegion, bare_regions};
pub use fringe::{FRINGE_SIGNS, FringeSigns};
pub use mask::{Mask, MaskRun};
pub use ncut::NcutError;
pub use objects::ObjectRegion;
pub use oriented_box::OrientedBox;
pub use params::{ObjectSide, ShadowParamError, ShadowParams};
pub use separator::{FringePixels, Pieces, ShadowError, ShadowSeparator};
pub use settle::{KnownPart, Settled, settle_objects};
pub use signs::{PIECE_SIGNS, Signs};
