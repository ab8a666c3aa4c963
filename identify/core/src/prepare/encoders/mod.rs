//! Which encoder of the bar sits where, which way it counts, and where its zero is.

pub(super) mod circular;
pub(super) mod encoder_map;
pub(super) mod frozen;
pub(super) mod origins;
pub(super) mod segments;
pub(super) mod slip;
