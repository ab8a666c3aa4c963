//! Publishes the messages of a run to other programs while the recorder writes them. A listener that reads too slowly misses
//! messages. The recorder never waits for a listener.

use std::sync::Arc;

use shared::recording::{Tap, Topic};
use tokio::sync::broadcast;

/// Capacity of a listener's queue, in messages. It holds a few seconds of a run at 100 Hz.
const WAITING_MAX: usize = 1024;

/// One message of a run.
#[derive(Debug)]
pub struct Message {
    /// Topic of the message.
    pub topic: &'static Topic,
    /// Log time of the message, as in the file \[ns since 1970\].
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
    /// Creates a tap without listeners. Programs and pages of this machine may always listen. Pages of
    /// the web origins in `origins` may listen, too.
    pub fn new(origins: Vec<String>) -> Self {
        Self { messages: broadcast::Sender::new(WAITING_MAX), origins }
    }

    /// The function by which the recorder publishes each message that it writes.
    pub fn writer_end(&self) -> Tap {
        let messages = self.messages.clone();
        Box::new(move |topic, log_time_ns, data| {
            if messages.receiver_count() > 0 {
                // The last listener may have disconnected since the check above; the error is then irrelevant.
                let _ = messages.send(Arc::new(Message { topic, log_time_ns, data: data.to_vec() }));
            }
        })
    }

    /// Subscribes to all messages from now on. If the listener is too slow, the receiver returns the
    /// number of missed messages.
    pub fn listen(&self) -> broadcast::Receiver<Arc<Message>> {
        self.messages.subscribe()
    }

    /// Web origins, other than this machine, whose pages may listen.
    pub fn origins(&self) -> &[String] {
        &self.origins
    }
}
