//! Damages the replies of a simulated bus. The bytes of the fuzzer determine the damage.

use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use ballbard::segment::{FRAME_BYTES_MAX, FrameWire, InProcessWire};
use shared::time::MonoNs;

use super::UnusedBytes;

/// A script that damages replies. Each entry waits for a number of replies, and then damages one reply. If `only_mailbox` is
/// set, only replies that read a mailbox count.
pub struct Script {
    entries: Vec<DamagedReply>,
    passed: u16,
}

struct DamagedReply {
    after: u16,
    only_mailbox: bool,
    damage: ReplyDamage,
}

enum ReplyDamage {
    Drop,
    Cut(usize),
    /// Position of the first damaged byte in the data of the first datagram, and the bytes to write there.
    Overwrite(usize, Vec<u8>),
}

impl Script {
    /// Parses the entries of a script until the bytes end.
    pub fn for_robot(bytes: &[u8]) -> Self {
        let mut input = UnusedBytes(bytes);
        let mut entries = Vec::new();
        while !input.is_empty() {
            let (kind, after, at) = (input.byte(), input.word(), usize::from(input.byte()));
            let damage = match kind & 3 {
                0 => ReplyDamage::Drop,
                1 => ReplyDamage::Cut(at),
                _ => ReplyDamage::Overwrite(at, {
                    let length = usize::from(input.byte());
                    input.take(length).to_vec()
                }),
            };
            entries.push(DamagedReply { after, only_mailbox: kind & 4 != 0, damage });
        }
        entries.reverse();
        Self { entries, passed: 0 }
    }

    /// Damages the reply if the script requires it. Returns its length, or `None` if the reply is lost.
    fn apply(&mut self, reply: &mut [u8]) -> Option<usize> {
        let Some(next) = self.entries.last() else { return Some(reply.len()) };
        if next.only_mailbox && !is_mailbox_reply(reply) {
            return Some(reply.len());
        }
        if self.passed < next.after {
            self.passed += 1;
            return Some(reply.len());
        }
        self.passed = 0;
        match self.entries.pop().map(|entry| entry.damage) {
            Some(ReplyDamage::Drop) => None,
            Some(ReplyDamage::Cut(at)) => Some(at.min(reply.len())),
            Some(ReplyDamage::Overwrite(at, bytes)) => {
                reply.iter_mut().skip(26 + at).zip(bytes).for_each(|(byte, other)| *byte = other);
                Some(reply.len())
            }
            None => Some(reply.len()),
        }
    }
}

/// Whether the first datagram of the reply has read the mailbox of a terminal and the mailbox was not empty.
fn is_mailbox_reply(frame: &[u8]) -> bool {
    frame.get(16) == Some(&4)
        && frame.get(20..22) == Some(&[0x80, 0x10])
        && frame.len() >= 26 + 128 + 2
        && frame.get(26 + 128) == Some(&1)
}

/// A wire to a segment. A script damages the replies. The segment can be replaced by a new one, so that the same wire and
/// the frame storage that ethercrab lends only once per process can be used again. Clones share the wire.
#[derive(Clone)]
pub struct DamagedWire(Arc<Mutex<(InProcessWire, Script)>>);

impl DamagedWire {
    /// A wire that does not damage its replies.
    pub fn new(segment: InProcessWire) -> Self {
        Self(Arc::new(Mutex::new((segment, Script::for_robot(&[])))))
    }

    pub fn exchange_segment(&self, segment: InProcessWire) {
        self.lock().0 = segment;
    }

    /// Starts a script. It is valid from the next reply on.
    pub fn play(&self, script: Script) {
        self.lock().1 = script;
    }

    /// Whether the script has ended.
    pub fn is_over(&self) -> bool {
        self.lock().1.entries.is_empty()
    }

    fn lock(&self) -> MutexGuard<'_, (InProcessWire, Script)> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl FrameWire for DamagedWire {
    fn send(&mut self, frame: &[u8]) -> io::Result<()> {
        self.lock().0.send(frame)
    }

    fn receive(&mut self, buffer: &mut [u8; FRAME_BYTES_MAX], until: MonoNs) -> io::Result<Option<usize>> {
        let mut inner = self.lock();
        let (wire, script) = &mut *inner;
        Ok(wire.receive(buffer, until)?.and_then(|length| script.apply(&mut buffer[..length])))
    }
}
