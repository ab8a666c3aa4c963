//! The recording of a run: an MCAP file with one record for each bus cycle, valid or not. It also contains messages for
//! other programs, derived from the cycles: joint states, a log, diagnostics.
//!
//! The profile is `ros2`: messages in CDR with `ros2msg` schemas. Foxglove, PlotJuggler, `ros2 bag` and Python can therefore
//! read a recording without our software. During a run the file has the ending `.mcap.active` and is locked. It gets the
//! ending `.mcap` only when it is complete and synchronised to disk. After a crash, [`recover_leftovers`] completes the
//! files that were still being written.

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
    recover_file_on, recover_leftovers, recover_leftovers_on, salvage, set_aside, verify,
};
pub use run_file::{ACTIVE_ENDING, FINISHED_ENDING, RunFile, RunPlace, RunSync, TORN_ENDING, run_name};
pub use timing::{Bin, DiskTiming, Durations, TimingSummary};
pub use writer::{RecordingWriter, Tap, WriteError};
