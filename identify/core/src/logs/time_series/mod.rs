//! Time series: rows of numbers, each with a time on one clock.
//!
//! `stream` contains the rows. `sampling` estimates the regular clock by which they were sampled. `excursions` and `frozen`
//! find rows that were not measured; `resolution` estimates the step to which values are rounded. `unwrapped` makes readings
//! continuous if they wrap. `spline` interpolates between rows, and `average` smooths them. `shared` contains data that several
//! users read.

mod average;
pub(super) mod excursions;
pub(super) mod frozen;
pub(super) mod resolution;
pub(super) mod sampling;
pub(super) mod shared;
pub(super) mod spline;
pub(super) mod stream;
pub(super) mod unwrapped;
