//! Structure-aware saliency (section 3.1 of the paper, eqs 2 to 14) and salient regions.
//!
//! In: a [`Partition`](samsod_segment::Partition) of an image of H x W pixels. Out: [`SaliencyMap`], S in [0, 1] for
//! every pixel, and the connected [`SalientRegion`]s.
//!
//! A mask of eq 11 is constant on a partition, so a scale sigma needs one vector a pixel: the mask-weighted mean colour
//!
//! ```text
//! M_sigma(c) = sum_i w_i A_i m_i / sum_i w_i A_i
//! ```
//!
//! with A_i and m_i the area and mean colour of partition i, and w_i its mask value: the mean of the Gaussian over the
//! part of P_i within 3 sigma, times the extent measure D_i (eqs 5, 9, 10); for the partition of the centre pixel the
//! Gaussian at its centre (eq 7). Then S_kt(c) = |M_k(c) - M_t(c)| (eqs 12, 13; the second numerator of eq 12 is that of
//! sigma_t) and S is the sum of all S_kt over their maxima (eq 14), divided by their number.
//!
//! [`Method::Exact`] evaluates every pixel by row runs and prefix sums of the Gaussian. [`Method::Fast`] evaluates
//! coarse nodes from label counts of cells, and interpolates all but the centre partition's own term.
//!
//! That is [`Variant::Paper`]. [`Variant::Averaged`] takes its mean over every partition, [`Variant::Background`] asks what
//! is unlike the border of the image, which suits still photos, and [`Variant::Centred`] prefers the centre as well.

mod background;
mod border_colour;
mod cells;
mod exact;
mod fast;
mod geodesic;
mod lab;
mod map;
mod params;
mod regions;
mod saliency;

pub use map::{MapError, SaliencyMap};
pub use params::{Method, SaliencyParamError, SaliencyParams, Scales, Variant};
pub use regions::{RegionError, SalientRegion, Threshold, longest_axis_rad, salient_regions, salient_regions_into};
pub use saliency::{Saliency, SaliencyError};
