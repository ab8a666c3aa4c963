//! Reads the robot's own log in the formats that controllers and drivers write.
//!
//! `format` recognises the format, and `reader` calls the module for this format: `table`, `ros`, `egm` or `rsi`. These
//! collect rows in a `raw::RawLog`, which checks them and converts them with a `conversion`. A `mapping` file describes logs
//! with other columns or units. `logged_joints` describes the joints of a file. `mistake` contains common mistakes in logs, and
//! `writer` writes logs.

pub(super) mod conversion;
pub(super) mod egm;
pub(super) mod format;
pub(super) mod logged_joints;
pub(super) mod mapping;
pub(super) mod mistake;
pub(super) mod raw;
pub(super) mod reader;
pub(super) mod ros;
pub(super) mod rsi;
pub(super) mod table;
pub(super) mod writer;
