//! From the cycle to the file: the ring, the recorder, the progress of a run, and the directories of recordings.
//!
//! Nothing here depends on the bus: the cycle provides records, events and timing.

mod progress;
mod recorder;
mod stop;
mod storage;
mod synchroniser;

pub use progress::{Handed, Limits, RunProgress, Snapshot, Synced};
pub use recorder::{CycleSink, CycleSource, FullRing, Marker, Recorder, RunLink, RunSummary, ring};
pub use stop::Stop;
pub use storage::Storage;
