//! The recording: an MCAP file with one record per bus cycle, valid or not.
//!
//! Profile `ros2`, CDR messages with `ros2msg` schemas, so that Foxglove, PlotJuggler, `ros2 bag` and
//! Python read it without our software. While a run goes on its file ends in `.mcap.active`; only a file that
//! was finished and synchronised to disk bears the name `.mcap`.

mod messages;
mod reader;
pub mod schema;
mod writer;

pub use messages::MessageError;
pub use reader::{ReadError, ReadErrorKind, Recording};
pub use writer::{ACTIVE_ENDING, FINISHED_ENDING, RecordingWriter, RunFile, WriteError};

/// Names of the metadata records at the beginning and the end of a run.
const RUN_METADATA: &str = "ballbard.run";
const END_METADATA: &str = "ballbard.end";

/// Key under which those records hold their content as JSON.
const CONTENT_KEY: &str = "json";
