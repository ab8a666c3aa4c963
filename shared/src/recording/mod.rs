//! The recording: an MCAP file with one record per bus cycle, valid or not, and what other programs
//! show of them: joint states, a log, diagnostics.
//!
//! Profile `ros2`, CDR messages with `ros2msg` schemas, so that Foxglove, PlotJuggler, `ros2 bag` and
//! Python read it without our software. While a run goes on its file ends in `.mcap.active` and is locked; only a
//! file that was finished and synchronised to disk bears the name `.mcap`. What a crash left is made whole by
//! [`recover_leftovers`].

mod content;
mod digest;
mod disk;
mod leftover;
mod lengths;
mod messages;
mod overview;
mod reader;
mod records;
mod recover;
mod resync;
mod run_file;
pub mod schema;
mod shown;
mod timing;
mod writer;

pub use digest::{Flagged, RunMark};
pub use disk::{Disk, FileId, OpenFile, Space, SystemDisk, is_absent};
pub use leftover::{
    Leftover, RecoverError, Recovery, is_in_use, recover_file, recover_file_on, recover_leftovers,
    recover_leftovers_on,
};
pub use lengths::{parse_record, up_to_broken_chunk};
pub use messages::{MessageError, TOPICS, Topic};
pub use overview::RunOverview;
pub use reader::{Outline, ReadError, ReadErrorKind, Recording};
pub use recover::{SalvageError, Salvaged, salvage, verify};
pub use resync::Damage;
pub use run_file::{ACTIVE_ENDING, FINISHED_ENDING, RunFile, RunPlace, RunSync, TORN_ENDING, run_name};
pub use timing::{Bin, DiskTiming, Durations, TimingSummary};
pub use writer::{RecordingWriter, Tap, WriteError};
