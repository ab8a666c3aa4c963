//! Requests to end a run.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

/// Requests the end of a run. The request may come from any thread or from a signal handler.
#[derive(Debug, Clone, Default)]
pub struct Stop {
    stopped: Arc<AtomicBool>,
    cause: Arc<OnceLock<String>>,
}

impl Stop {
    /// Requests the end of the run. If the end is requested several times, the file contains the first cause.
    pub fn stop(&self, cause: &str) {
        let _ = self.cause.set(cause.to_owned());
        self.stopped.store(true, Ordering::Release);
    }

    /// The flag that [`Self::stop`] sets.
    pub fn flag(&self) -> Arc<AtomicBool> {
        Arc::clone(&self.stopped)
    }

    /// Whether the end of the run was requested.
    pub fn is_stopped(&self) -> bool {
        self.stopped.load(Ordering::Acquire)
    }

    /// Cause of the first request.
    pub fn cause(&self) -> String {
        self.cause.get().cloned().unwrap_or_else(|| "the cycle ended without a request".into())
    }
}
