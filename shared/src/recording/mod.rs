//! The recording: an MCAP file with one record per bus cycle, valid or not, and what other programs
//! show of them: joint states, a log, diagnostics.
//!
//! Profile `ros2`, CDR messages with `ros2msg` schemas, so that Foxglove, PlotJuggler, `ros2 bag` and
//! Python read it without our software. During a run its file ends in `.mcap.active` and is locked; only a file that was
//! finished and synchronised to disk has the ending `.mcap`. [`recover_leftovers`] finishes files that a crash left.

mod content;
mod digest;
mod disk;
mod messages;
mod overview;
mod reader;
mod records;
mod recover;
mod run_file;
pub mod schema;
mod shown;
mod timing;
mod writer;

pub use digest::{Flagged, RunMark};
pub use disk::{Disk, FileId, OpenFile, Space, SystemDisk, is_absent};
pub use messages::{MessageError, TOPICS, Topic};
pub use overview::RunOverview;
pub use reader::{Outline, ReadError, ReadErrorKind, Recording};
pub use records::lengths::{parse_record, up_to_broken_chunk};
pub use recover::{
    Damage, Leftover, RecoverError, Recovery, SalvageError, Salvaged, is_in_use, recover_file,
    recover_file_on, recover_leftovers, recover_leftovers_on, salvage, verify,
};
pub use run_file::{ACTIVE_ENDING, FINISHED_ENDING, RunFile, RunPlace, RunSync, TORN_ENDING, run_name};
pub use timing::{Bin, DiskTiming, Durations, TimingSummary};
pub use writer::{RecordingWriter, Tap, WriteError};
