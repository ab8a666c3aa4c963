//! Stores runs in files. A ring takes the records from the cycle, the recorder writes them, and other threads read the
//! progress of the run. The directories of recordings are also here.
//!
//! Nothing here depends on the bus, because the cycle provides records, events and timing.

mod progress;
mod recorder;
mod stop;
mod storage;
mod synchroniser;

pub use progress::{Handed, Limits, RunProgress, Snapshot, Synced};
pub use recorder::{CycleSink, CycleSource, FullRing, Marker, Recorder, RunLink, RunSummary, ring};
pub use stop::Stop;
pub use storage::Storage;
