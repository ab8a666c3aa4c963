//! Stores runs in files. The cycle puts its records into a ring, the recorder takes them out and writes them, and other
//! threads read the progress of the run. This module also manages the directories of recordings.
//!
//! This module does not depend on the bus, because the cycle provides records, events and timing.

mod progress;
mod recorder;
mod stop;
mod storage;
mod synchroniser;

pub use progress::{Handed, Limits, RunProgress, Snapshot, Synced};
pub use recorder::{CycleSink, CycleSource, FullRing, Marker, Recorder, RunLink, RunSummary, ring};
pub use stop::Stop;
pub use storage::Storage;
