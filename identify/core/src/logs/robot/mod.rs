//! The robot's own log in the formats that controllers and drivers write.

pub(super) mod conversion;
pub(super) mod egm;
pub(super) mod format;
pub(super) mod mapping;
pub(super) mod mistake;
pub(super) mod raw;
pub(super) mod reader;
pub(super) mod ros;
pub(super) mod rsi;
pub(super) mod table;
pub(super) mod writer;
