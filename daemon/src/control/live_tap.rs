//! The messages of a run as they are written, for whoever listens. Who is slow misses some; the recorder waits for nobody.

use std::sync::Arc;

use shared::recording::{Tap, Topic};
use tokio::sync::broadcast;

/// Messages that wait for who listens: some seconds of a run at 100 Hz.
const WAITING_MAX: usize = 1024;

/// One message of a run.
#[derive(Debug)]
pub struct Message {
    /// Its topic.
    pub topic: &'static Topic,
    /// As in the file \[ns since 1970\].
    pub log_time_ns: u64,
    /// CDR.
    pub data: Vec<u8>,
}

/// Runs, one after the other, as they are written.
#[derive(Debug, Clone)]
pub struct LiveTap {
    messages: broadcast::Sender<Arc<Message>>,
    origins: Vec<String>,
}

impl LiveTap {
    /// For programs and pages of this machine, and for what sends one of these origins.
    pub fn new(origins: Vec<String>) -> Self {
        Self { messages: broadcast::Sender::new(WAITING_MAX), origins }
    }

    /// The recorder's end.
    pub fn writer_end(&self) -> Tap {
        let messages = self.messages.clone();
        Box::new(move |topic, log_time_ns, data| {
            if messages.receiver_count() > 0 {
                // Whoever listened may have gone by now.
                let _ = messages.send(Arc::new(Message { topic, log_time_ns, data: data.to_vec() }));
            }
        })
    }

    /// What is written from now on; says how many messages were missed.
    pub fn listen(&self) -> broadcast::Receiver<Arc<Message>> {
        self.messages.subscribe()
    }

    /// From where else it may be listened to.
    pub fn origins(&self) -> &[String] {
        &self.origins
    }
}
