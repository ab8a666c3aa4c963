//! The daemon's MainDevice against a bus whose replies are damaged as the fuzzer says.

use std::cell::RefCell;
use std::io;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use ballbard::bus::{Bus, BusPlan};
use ballbard::clock::Clock;
use ballbard::segment::simulated::{SegmentConfig, SimulatedSegment, SmoothMotion};
use ballbard::segment::{FRAME_BYTES_MAX, InProcessWire, Wire};
use shared::time::{MonoNs, NS_PER_S, UtcNs};

use super::{Input, explained};

/// Cyclic frames after the bus came up.
const CYCLES: usize = 5;
/// Bringing a bus up ends within this much of its own time, whatever it answers.
const BRING_UP_NS_MAX: i64 = 600 * NS_PER_S;

/// What happens to replies: each entry waits for a number of replies (of mailbox replies where so chosen).
struct Script {
    entries: Vec<Entry>,
    passed: u16,
}

struct Entry {
    after: u16,
    only_mailbox: bool,
    damage: Damage,
}

enum Damage {
    Drop,
    Cut(usize),
    /// From this byte of the first datagram's data on.
    Overwrite(usize, Vec<u8>),
}

impl Script {
    fn of(bytes: &[u8]) -> Self {
        let mut input = Input(bytes);
        let mut entries = Vec::new();
        while !input.is_empty() {
            let (kind, after, at) = (input.byte(), input.word(), usize::from(input.byte()));
            let damage = match kind & 3 {
                0 => Damage::Drop,
                1 => Damage::Cut(at),
                _ => Damage::Overwrite(at, {
                    let length = usize::from(input.byte());
                    input.take(length).to_vec()
                }),
            };
            entries.push(Entry { after, only_mailbox: kind & 4 != 0, damage });
        }
        entries.reverse();
        Self { entries, passed: 0 }
    }

    /// Damages a reply or not; none if it is lost.
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
            Some(Damage::Drop) => None,
            Some(Damage::Cut(at)) => Some(at.min(reply.len())),
            Some(Damage::Overwrite(at, bytes)) => {
                reply.iter_mut().skip(26 + at).zip(bytes).for_each(|(byte, other)| *byte = other);
                Some(reply.len())
            }
            None => Some(reply.len()),
        }
    }
}

/// The first datagram read the mailbox of a terminal, and something lay in it.
fn is_mailbox_reply(frame: &[u8]) -> bool {
    frame.get(16) == Some(&4)
        && frame.get(20..22) == Some(&[0x80, 0x10])
        && frame.len() >= 26 + 128 + 2
        && frame.get(26 + 128) == Some(&1)
}

/// A segment that can be exchanged for a new one: ethercrab lends its frame storage once per process.
#[derive(Clone)]
struct Exchangeable(Arc<Mutex<(InProcessWire, Script)>>);

impl Wire for Exchangeable {
    fn send(&mut self, frame: &[u8]) -> io::Result<()> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).0.send(frame)
    }

    fn receive(&mut self, buffer: &mut [u8; FRAME_BYTES_MAX], until: MonoNs) -> io::Result<Option<usize>> {
        let mut inner = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let (wire, script) = &mut *inner;
        Ok(wire.receive(buffer, until)?.and_then(|length| script.apply(&mut buffer[..length])))
    }
}

struct Rig {
    bus: Bus,
    clock: Clock,
    wire: Exchangeable,
}

fn segment(clock: &Clock) -> InProcessWire {
    let config = SegmentConfig { terminals: 1, ..SegmentConfig::default() };
    InProcessWire::new(SimulatedSegment::new(&config, Box::new(SmoothMotion::new(1, 3600, 1))), clock.clone())
}

impl Rig {
    fn new() -> Self {
        let clock = Clock::virtual_from(UtcNs(1_790_000_000_000_000_000));
        let wire = Exchangeable(Arc::new(Mutex::new((segment(&clock), Script::of(&[])))));
        let bus = Bus::new(Box::new(wire.clone()), clock.clone(), Duration::from_millis(4));
        Self { bus, clock, wire }
    }
}

/// The bus comes up and is cycled, or is refused with a reason; either way in bounded time.
pub fn any_replies(bytes: &[u8]) {
    thread_local!(static RIG: RefCell<Rig> = RefCell::new(Rig::new()));
    RIG.with_borrow_mut(|rig| {
        let fresh = (segment(&rig.clock), Script::of(bytes));
        *rig.wire.0.lock().unwrap_or_else(PoisonError::into_inner) = fresh;
        let begun = rig.clock.now();
        match rig.bus.bring_up(&plan()) {
            Ok(operational) => {
                for _ in 0..CYCLES {
                    rig.bus.exchange(&operational);
                    rig.clock.sleep_until(rig.clock.now().plus_ns(10_000_000));
                }
            }
            Err(error) => explained(&error),
        }
        assert!(rig.clock.now() < begun.plus_ns(BRING_UP_NS_MAX), "bringing the bus up took for ever");
    });
}

fn plan() -> BusPlan {
    let bar = crate::ball_bar();
    BusPlan {
        name: "simulated".into(),
        encoders: bar.encoders.into_iter().take(1).collect(),
        cycle_period: Duration::from_millis(10),
        distributed_clocks: true,
        sync0_shift: Duration::from_millis(5),
        reply_timeout: Duration::from_millis(4),
    }
}

/// Nothing wrong; a lost reply; an emergency and an abort instead of the first answers; a wrong length.
pub fn scripts() -> Vec<Vec<u8>> {
    vec![
        vec![],
        vec![0, 40, 0, 0],
        vec![6, 0, 0, 0, 16, 10, 0, 0, 0, 0, 0x13, 0, 0x10, 0, 0x10, 1, 0, 0, 0, 0, 0],
        vec![6, 1, 0, 0, 16, 10, 0, 0, 0, 0, 0x23, 0, 0x20, 0x80, 0x01, 0x80, 0x11, 0, 0, 2, 6],
        vec![6, 2, 0, 0, 2, 0xff, 0xff],
        vec![2, 10, 0, 0, 2, 0xff, 0xff, 1, 20, 0, 30],
    ]
}
