//! Aligns the clock of the robot's log with the clock of a recording of the bar (`find`) or of a tracker's log (`tracker`).
//!
//! A first alignment compares speeds, which do not depend on offsets (`speeds`, `rate`, `correlate`). A fit of
//! angles (`refine`) or positions (`tracker`) then improves it. The result is a [`ClockRelation`](crate::model::Clock) and
//! a reference time (`reference`).

pub(super) mod aligned;
pub(super) mod clock;
pub(super) mod correlate;
pub(super) mod find;
pub(super) mod parts;
pub(super) mod placement;
pub(super) mod predict;
mod rate;
pub(super) mod reference;
pub(super) mod refine;
pub(super) mod speeds;
pub(super) mod tracker;
pub(super) mod window;
