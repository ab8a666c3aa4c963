//! How a run is asked to end.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

/// Asks a run to end, from any thread or a signal.
#[derive(Debug, Clone, Default)]
pub struct Stop {
    stopped: Arc<AtomicBool>,
    cause: Arc<OnceLock<String>>,
}

impl Stop {
    /// Ends the run; the first cause given is the one that the file states.
    pub fn stop(&self, cause: &str) {
        let _ = self.cause.set(cause.to_owned());
        self.stopped.store(true, Ordering::Release);
    }

    /// Set by [`Self::stop`].
    pub fn flag(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.stopped)
    }

    /// Whether somebody has asked.
    pub fn is_stopped(&self) -> bool {
        self.stopped.load(Ordering::Acquire)
    }

    /// Why the run ends.
    pub fn cause(&self) -> String {
        self.cause.get().cloned().unwrap_or_else(|| "the cycle ended by itself".into())
    }
}
