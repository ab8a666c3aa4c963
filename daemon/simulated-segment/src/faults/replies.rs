//! Queue of the replies on their way from the segment to the receiver, in order of arrival.

use crate::FRAME_BYTES_MAX;

/// Capacity of the queue. A MainDevice never has this many frames on the wire.
const REPLIES_MAX: usize = 64;

/// A reply that has not arrived yet.
struct OnTheWay {
    due_ns: i64,
    length: usize,
    bytes: [u8; FRAME_BYTES_MAX],
}

/// Replies that have left the segment. They are taken in order of arrival. If several replies arrive at the same time, the
/// reply that left first is taken first.
pub struct Replies {
    on_the_way: Vec<OnTheWay>,
}

impl Replies {
    pub fn new() -> Self {
        // The memory is allocated here, so that a cycle allocates none when segment and daemon run in the same process.
        Self { on_the_way: Vec::with_capacity(REPLIES_MAX) }
    }

    /// Adds a reply. If the queue is full, the reply is lost.
    pub fn push(&mut self, due_ns: i64, reply: &[u8]) {
        if self.on_the_way.len() == REPLIES_MAX || reply.len() > FRAME_BYTES_MAX {
            return;
        }
        let mut bytes = [0; FRAME_BYTES_MAX];
        bytes[..reply.len()].copy_from_slice(reply);
        self.on_the_way.push(OnTheWay { due_ns, length: reply.len(), bytes });
    }

    /// Time of arrival of the next reply.
    pub fn next_due_ns(&self) -> Option<i64> {
        self.on_the_way.iter().map(|reply| reply.due_ns).min()
    }

    /// Takes the next reply if it has arrived by `now_ns`. Returns its length.
    pub fn take(&mut self, now_ns: i64, buffer: &mut [u8; FRAME_BYTES_MAX]) -> Option<usize> {
        let due_ns = self.next_due_ns().filter(|due_ns| *due_ns <= now_ns)?;
        let index = self.on_the_way.iter().position(|reply| reply.due_ns == due_ns)?;
        let reply = self.on_the_way.remove(index);
        *buffer = reply.bytes;
        Some(reply.length)
    }
}
