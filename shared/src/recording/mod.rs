//! The recording: an MCAP file with one record per bus cycle, valid or not.
//!
//! Profile `ros2`, CDR messages with `ros2msg` schemas, so that Foxglove, PlotJuggler, `ros2 bag` and
//! Python read it without our software.

pub mod schema;
