//! Time series: rows on one clock, the regular clock behind stamps, interpolation between stamps.

mod average;
pub(super) mod excursions;
pub(super) mod frozen;
pub(super) mod sampling;
pub(super) mod shared;
pub(super) mod spline;
pub(super) mod stream;
pub(super) mod unwrapped;
