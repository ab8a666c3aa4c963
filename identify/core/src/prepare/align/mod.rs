//! Aligns two logs on two clocks: coarsely by speeds, which do not depend on offsets, then by angles or positions.

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
