//! From the cycle to the file: the ring, the recorder, how far a run is, and where recordings go.
//!
//! Nothing here knows the bus: the cycle hands over records, events and timing.

mod progress;
mod recorder;
mod stop;
mod storage;
mod synchroniser;

pub use progress::{Handed, Limits, Progress, Snapshot, Synced};
pub use recorder::{CycleSink, CycleSource, FullRing, Mark, Recorder, RunLink, RunSummary, ring};
pub use stop::Stop;
pub use storage::Storage;
