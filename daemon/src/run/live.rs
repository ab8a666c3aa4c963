//! The latest samples and state of the bus, for other threads. The cycle thread stores each record in atomics, so that it
//! never waits for a reader. The status, the pre-flight check and the start of a run read these values.

use std::sync::atomic::{AtomicI64, AtomicU32, AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

use shared::recording::schema::{CycleRecord, MAX_ENCODERS, PortCounts, flags};
use shared::time::MonoNs;

use crate::bus::{DEVICES_MAX, PORTS};
use crate::cycle::{BusState, Links};
use crate::problem::Fact;

/// Flags with a cause in the bus itself, as opposed to one encoder or this PC.
pub const BUS_FLAGS: u32 =
    flags::NO_REPLY | flags::WORKING_COUNTER | flags::NOT_OPERATIONAL | flags::BUS_DOWN;

/// The latest sample of each encoder, for display. Count, status and validity of one encoder always belong to the same cycle.
/// Samples of different encoders may belong to different cycles.
#[derive(Debug, Default)]
pub struct LatestSamples {
    /// Time of the latest cycle \[ns\]. Like the times in the next two fields, it is the time at which the frame was sent.
    at_ns: AtomicI64,
    /// Time of the latest cycle without any of [`BUS_FLAGS`] \[ns\].
    whole_at_ns: AtomicI64,
    /// Time of the latest valid sample of each encoder \[ns\].
    valid_at_ns: [AtomicI64; MAX_ENCODERS],
    /// Number of cycles, with valid or invalid samples.
    cycles: AtomicU64,
    /// Number of valid cycles of each encoder.
    encoder_cycles_valid: [AtomicU64; MAX_ENCODERS],
    /// Number of cycles in which every encoder was valid.
    cycles_valid: AtomicU64,
    /// Number of cycles that missed their deadline.
    cycles_late: AtomicU64,
    flags: AtomicU64,
    origin: AtomicU32,
    /// Latest sample of each encoder. Bits 0 to 31 are the count, 32 to 47 the status word, 48 is set if the sample is
    /// valid. One word contains all three, so that they always belong to the same cycle.
    encoders: [AtomicU64; MAX_ENCODERS],
    latches: [AtomicU32; MAX_ENCODERS],
    /// Position of the first missing device; 0 if no device is missing. No device at position 0 can be missing here: without
    /// the coupler at position 0, the whole bus is down.
    missing_from: AtomicU32,
    /// Number and cause of the latest outage of the bus.
    outage: Mutex<(u32, Option<Fact>)>,
    links_revision: AtomicU64,
    /// Counts of each port: invalid frames, receive errors, lost links.
    links: [[[AtomicU32; 3]; PORTS]; DEVICES_MAX],
}

/// The latest sample of one encoder.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct LiveEncoder {
    /// Value of the counter.
    pub count: u32,
    /// Status word of the encoder's terminal.
    pub status: u16,
    /// Whether the sample is new and without error.
    pub valid: bool,
}

impl LatestSamples {
    /// Publishes a record. Wait-free, for the real-time thread.
    pub fn publish(&self, record: &CycleRecord) {
        for (slot, encoder) in self.encoders.iter().zip(record.encoders()) {
            let packed = u64::from(encoder.count)
                | u64::from(encoder.status) << 32
                | u64::from(u8::from(encoder.valid)) << 48;
            slot.store(packed, Ordering::Relaxed);
        }
        let slots = self.valid_at_ns.iter().zip(&self.encoder_cycles_valid);
        for ((valid_at_ns, cycles_valid), encoder) in slots.zip(record.encoders()) {
            if encoder.valid {
                valid_at_ns.store(record.send_time.0, Ordering::Relaxed);
                cycles_valid.fetch_add(1, Ordering::Relaxed);
            }
        }
        self.cycles.fetch_add(1, Ordering::Relaxed);
        // A cycle that missed its deadline sent no frame, so its flags contain no information about the bus.
        if record.flags & flags::DEADLINE_MISSED != 0 {
            self.cycles_late.fetch_add(1, Ordering::Relaxed);
        } else {
            if record.flags & BUS_FLAGS == 0 {
                self.whole_at_ns.store(record.send_time.0, Ordering::Relaxed);
            }
            self.flags.store(record.flags.into(), Ordering::Relaxed);
        }
        if record.is_valid() {
            self.cycles_valid.fetch_add(1, Ordering::Relaxed);
            for (slot, encoder) in self.latches.iter().zip(record.encoders()) {
                slot.store(encoder.latch, Ordering::Relaxed);
            }
        }
        self.origin.store(record.origin, Ordering::Relaxed);
        self.at_ns.store(record.send_time.0, Ordering::Release);
    }

    /// Publishes which devices of the bus are in operation. Wait-free while the bus is in operation. While the bus is down,
    /// this function may wait for a lock, because no deadline can be missed then.
    pub fn publish_bus(&self, state: &BusState<'_>, bus: &str) {
        let missing_from = match state {
            BusState::Before(from) => (*from).into(),
            BusState::Whole | BusState::Down(_) => 0,
        };
        self.missing_from.store(missing_from, Ordering::Relaxed);
        if let BusState::Down(outage) = state {
            let mut published = self.outage.lock().unwrap_or_else(PoisonError::into_inner);
            let (number, fact) = &*published;
            if *number != outage.number || fact.is_none() {
                *published = (outage.number, outage.fact(bus));
            }
        }
    }

    /// Publishes the error counts of the ports. Wait-free.
    pub fn publish_links(&self, links: &Links) {
        if self.links_revision.swap(links.revision(), Ordering::Relaxed) == links.revision() {
            return;
        }
        for (slots, errors) in self.links.iter().flatten().zip(links.errors().iter().flatten()) {
            let counts = [errors.invalid_frames, errors.receive_errors, errors.lost_links];
            slots.iter().zip(counts).for_each(|(slot, count)| slot.store(count, Ordering::Relaxed));
        }
    }

    /// Ports that have counted errors since the run began.
    pub fn bad_ports(&self) -> Vec<PortCounts> {
        let ports = (0..).zip(&self.links).flat_map(|(position, ports)| {
            (0..).zip(ports).map(move |(port, counts)| {
                let [invalid_frames, receive_errors, lost_links] =
                    counts.each_ref().map(|count| count.load(Ordering::Relaxed));
                PortCounts { position, port, invalid_frames, receive_errors, lost_links }
            })
        });
        ports.filter(|counts| counts.all() > 0).collect()
    }

    /// Position of the first device that does not reply, if the devices before it are still in
    /// operation; `None` if no device is missing.
    pub fn missing_from(&self) -> Option<usize> {
        let from = self.missing_from.load(Ordering::Relaxed);
        (from != 0).then_some(from as usize)
    }

    /// Why the bus is down; `None` if the bus is not down.
    pub fn outage(&self) -> Option<Fact> {
        let is_down = self.flags() & flags::BUS_DOWN != 0;
        let (_, fact) = &*self.outage.lock().unwrap_or_else(PoisonError::into_inner);
        fact.clone().filter(|_| is_down)
    }

    /// Time of the latest cycle; 0 before the first cycle.
    pub fn at(&self) -> MonoNs {
        MonoNs(self.at_ns.load(Ordering::Acquire))
    }

    /// Time of the latest cycle without a fault of the bus; 0 before the first such cycle.
    pub fn whole_at(&self) -> MonoNs {
        MonoNs(self.whole_at_ns.load(Ordering::Relaxed))
    }

    /// Time of the latest valid sample of each encoder, in bus order; 0 before the first valid sample.
    pub fn valid_at(&self) -> [MonoNs; MAX_ENCODERS] {
        std::array::from_fn(|index| MonoNs(self.valid_at_ns[index].load(Ordering::Relaxed)))
    }

    /// Number of cycles so far, and number of valid cycles of each encoder, in bus order.
    pub fn counted(&self) -> (u64, [u64; MAX_ENCODERS]) {
        let valid = std::array::from_fn(|index| self.encoder_cycles_valid[index].load(Ordering::Relaxed));
        (self.cycles.load(Ordering::Relaxed), valid)
    }

    /// Three counts so far: all cycles, cycles in which every encoder was valid, and cycles that missed their deadline.
    pub fn totals(&self) -> [u64; 3] {
        [&self.cycles, &self.cycles_valid, &self.cycles_late].map(|count| count.load(Ordering::Relaxed))
    }

    /// Latch values of the terminals in the latest cycle in which every encoder was valid, in bus order.
    pub fn latches(&self) -> [u32; MAX_ENCODERS] {
        std::array::from_fn(|index| self.latches[index].load(Ordering::Relaxed))
    }

    /// Flags of the latest cycle that sent its frame; see `schema::flags`.
    pub fn flags(&self) -> u32 {
        self.flags.load(Ordering::Relaxed) as u32
    }

    /// Origin number of the counters in the latest cycle.
    pub fn origin(&self) -> u32 {
        self.origin.load(Ordering::Relaxed)
    }

    /// The latest samples of the encoders, in bus order.
    pub fn encoders(&self) -> [LiveEncoder; MAX_ENCODERS] {
        std::array::from_fn(|index| {
            let packed = self.encoders[index].load(Ordering::Relaxed);
            LiveEncoder { count: packed as u32, status: (packed >> 32) as u16, valid: packed >> 48 & 1 == 1 }
        })
    }
}
