//! Finds joint, direction and offset of each encoder of the bar, and faults of encoders.

pub(super) mod circular;
pub(super) mod encoder_map;
pub(super) mod frozen;
pub(super) mod origins;
pub(super) mod segments;
pub(super) mod slip;
