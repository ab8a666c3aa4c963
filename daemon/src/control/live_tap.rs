//! The messages of a run as they are written, for other programs. A slow listener misses some; the recorder never waits.

use std::sync::Arc;

use shared::recording::{Tap, Topic};
use tokio::sync::broadcast;

/// Messages in the queue of a listener: some seconds of a run at 100 Hz.
const WAITING_MAX: usize = 1024;

/// One message of a run.
#[derive(Debug)]
pub struct Message {
    /// Topic of the message.
    pub topic: &'static Topic,
    /// As in the file \[ns since 1970\].
    pub log_time_ns: u64,
    /// Content, encoded in CDR.
    pub data: Vec<u8>,
}

/// Publishes the messages of runs, one run after the other.
#[derive(Debug, Clone)]
pub struct LiveTap {
    messages: broadcast::Sender<Arc<Message>>,
    origins: Vec<String>,
}

impl LiveTap {
    /// Without a listener yet. Besides programs and pages of this machine, pages of these web origins may listen.
    pub fn new(origins: Vec<String>) -> Self {
        Self { messages: broadcast::Sender::new(WAITING_MAX), origins }
    }

    /// The function by which the recorder publishes each message that it writes.
    pub fn writer_end(&self) -> Tap {
        let messages = self.messages.clone();
        Box::new(move |topic, log_time_ns, data| {
            if messages.receiver_count() > 0 {
                // The listener may have gone by now.
                let _ = messages.send(Arc::new(Message { topic, log_time_ns, data: data.to_vec() }));
            }
        })
    }

    /// Receives messages from now on, and the number of those that were missed.
    pub fn listen(&self) -> broadcast::Receiver<Arc<Message>> {
        self.messages.subscribe()
    }

    /// Additional origins whose pages may listen.
    pub fn origins(&self) -> &[String] {
        &self.origins
    }
}
