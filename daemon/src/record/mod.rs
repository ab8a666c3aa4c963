//! From the cycle to the file: the ring, the recorder, how far a run is, and where recordings go.
//!
//! Nothing here knows the bus: the cycle hands over records, events and timing.

mod progress;
mod recorder;
mod stop;
mod storage;
mod synchroniser;

pub use progress::{Handed, Limits, Progress, Snapshot, Synced};
pub use recorder::{CycleSink, CycleSource, Mark, Recorder, RunLink, RunSummary, ring};
pub use stop::Stop;
pub use storage::Storage;
pub use synchroniser::SyncWork;

/// Locked memory is really there, all of it: several times what these threads use.
pub(crate) const STACK_BYTES: usize = 512 << 10;
