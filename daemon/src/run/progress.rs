//! What other threads see of a run and of the bus while they go on, without making them wait.

use std::sync::atomic::{AtomicI64, AtomicU32, AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

use shared::recording::TimingSummary;
use shared::recording::schema::{CycleRecord, MAX_ENCODERS, flags};
use shared::time::MonoNs;

use crate::bus::{DEVICES_MAX, PORTS};
use crate::cycle::{BusState, Links, PortErrors};

/// What of a run is really on disk.
#[derive(Debug, Default)]
pub struct Progress {
    cycles: AtomicU64,
    cycles_valid: AtomicU64,
    cycles_lost: AtomicU64,
    bytes: AtomicU64,
    synced_at_ns: AtomicI64,
    /// Shared by the recorder and those who ask; the cycle knows nothing of it.
    timing: Mutex<Option<TimingSummary>>,
}

/// [`Progress`] at one moment.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Synced {
    /// Cycles on disk.
    pub cycles: u64,
    /// Cycles among them in which every encoder is valid.
    pub cycles_valid: u64,
    /// Cycles among them that were lost between bus and file.
    pub cycles_lost: u64,
    /// Length of the file \[bytes\].
    pub bytes: u64,
    /// When it was synchronised.
    pub at: MonoNs,
}

impl Progress {
    /// The recorder has synchronised the file.
    pub fn set(&self, synced: Synced) {
        self.cycles_valid.store(synced.cycles_valid, Ordering::Relaxed);
        self.cycles_lost.store(synced.cycles_lost, Ordering::Relaxed);
        self.bytes.store(synced.bytes, Ordering::Relaxed);
        self.synced_at_ns.store(synced.at.0, Ordering::Relaxed);
        self.cycles.store(synced.cycles, Ordering::Release);
    }

    /// How well the loop kept its time so far.
    pub fn set_timing(&self, timing: Option<TimingSummary>) {
        *self.timing.lock().unwrap_or_else(PoisonError::into_inner) = timing;
    }

    /// How well the loop kept its time up to the last synchronisation; none on virtual time.
    pub fn timing(&self) -> Option<TimingSummary> {
        self.timing.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// As of now.
    pub fn get(&self) -> Synced {
        Synced {
            cycles: self.cycles.load(Ordering::Acquire),
            cycles_valid: self.cycles_valid.load(Ordering::Relaxed),
            cycles_lost: self.cycles_lost.load(Ordering::Relaxed),
            bytes: self.bytes.load(Ordering::Relaxed),
            at: MonoNs(self.synced_at_ns.load(Ordering::Relaxed)),
        }
    }
}

/// Reasons that stand for the bus itself, and not for one encoder or this PC.
pub const BUS_FLAGS: u32 =
    flags::NO_REPLY | flags::WORKING_COUNTER | flags::NOT_OPERATIONAL | flags::BUS_DOWN;

/// The latest sample of each encoder, for people. Each encoder is consistent in itself, not with the others.
#[derive(Debug, Default)]
pub struct Live {
    at_ns: AtomicI64,
    /// Of the latest cycle without any of [`BUS_FLAGS`].
    whole_at_ns: AtomicI64,
    /// Of the latest valid sample of each encoder.
    valid_at_ns: [AtomicI64; MAX_ENCODERS],
    flags: AtomicU64,
    encoders: [AtomicU64; MAX_ENCODERS],
    latches: [AtomicU32; MAX_ENCODERS],
    /// 0 where no device is missing: before the coupler there is nothing that could stay in use.
    missing_from: AtomicU32,
    outage: Mutex<Option<String>>,
    links_revision: AtomicU64,
    links: [[LivePort; PORTS]; DEVICES_MAX],
}

/// Errors of one port.
#[derive(Debug, Default)]
struct LivePort {
    invalid_frames: AtomicU32,
    receive_errors: AtomicU32,
    lost_links: AtomicU32,
}

/// The latest sample of one encoder.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct LiveEncoder {
    /// Counter.
    pub count: u32,
    /// Status word of its terminal.
    pub status: u16,
    /// Fresh and without error.
    pub valid: bool,
}

impl Live {
    /// Wait-free, for the real-time thread.
    pub fn publish(&self, record: &CycleRecord) {
        for (place, encoder) in self.encoders.iter().zip(record.encoders()) {
            let packed = u64::from(encoder.count)
                | u64::from(encoder.status) << 32
                | u64::from(u8::from(encoder.valid)) << 48;
            place.store(packed, Ordering::Relaxed);
        }
        for (place, encoder) in self.valid_at_ns.iter().zip(record.encoders()) {
            if encoder.valid {
                place.store(record.send_time.0, Ordering::Relaxed);
            }
        }
        if record.flags & BUS_FLAGS == 0 {
            self.whole_at_ns.store(record.send_time.0, Ordering::Relaxed);
        }
        if record.is_valid() {
            for (place, encoder) in self.latches.iter().zip(record.encoders()) {
                place.store(encoder.latch, Ordering::Relaxed);
            }
        }
        self.flags.store(record.flags.into(), Ordering::Relaxed);
        self.at_ns.store(record.send_time.0, Ordering::Release);
    }

    /// Says how much of the bus is in operation. Wait-free, unless it is down: then nothing can be late.
    pub fn publish_bus(&self, state: &BusState<'_>) {
        let missing_from = match state {
            BusState::Before(from) => (*from).into(),
            BusState::Whole | BusState::Down(_) => 0,
        };
        self.missing_from.store(missing_from, Ordering::Relaxed);
        if let BusState::Down(why) = state {
            *self.outage.lock().unwrap_or_else(PoisonError::into_inner) = why.map(ToString::to_string);
        }
    }

    /// Says what the ports have counted. Wait-free.
    pub fn publish_links(&self, links: &Links) {
        if self.links_revision.swap(links.revision(), Ordering::Relaxed) == links.revision() {
            return;
        }
        for (place, errors) in self.links.iter().flatten().zip(links.errors().iter().flatten()) {
            place.invalid_frames.store(errors.invalid_frames, Ordering::Relaxed);
            place.receive_errors.store(errors.receive_errors, Ordering::Relaxed);
            place.lost_links.store(errors.lost_links, Ordering::Relaxed);
        }
    }

    /// Ports that have counted errors since the run began: position of the device, port, and how many.
    pub fn bad_ports(&self) -> Vec<(usize, usize, PortErrors)> {
        let ports = self.links.iter().enumerate().flat_map(|(position, ports)| {
            ports.iter().enumerate().map(move |(port, errors)| {
                let errors = PortErrors {
                    invalid_frames: errors.invalid_frames.load(Ordering::Relaxed),
                    receive_errors: errors.receive_errors.load(Ordering::Relaxed),
                    lost_links: errors.lost_links.load(Ordering::Relaxed),
                };
                (position, port, errors)
            })
        });
        ports.filter(|(_, _, errors)| errors.all() > 0).collect()
    }

    /// First position whose device does not answer while those before it stay in use.
    pub fn missing_from(&self) -> Option<usize> {
        let from = self.missing_from.load(Ordering::Relaxed);
        (from != 0).then_some(from as usize)
    }

    /// What the last attempt to bring up a bus that is down met; none if it is not down.
    pub fn outage(&self) -> Option<String> {
        let is_down = self.flags() & flags::BUS_DOWN != 0;
        self.outage.lock().unwrap_or_else(PoisonError::into_inner).clone().filter(|_| is_down)
    }

    /// When the latest cycle was, 0 before the first.
    pub fn at(&self) -> MonoNs {
        MonoNs(self.at_ns.load(Ordering::Acquire))
    }

    /// When the latest cycle was that the whole bus answered, 0 before the first.
    pub fn whole_at(&self) -> MonoNs {
        MonoNs(self.whole_at_ns.load(Ordering::Relaxed))
    }

    /// When each encoder gave its latest valid sample, 0 before the first, in bus order.
    pub fn valid_at(&self) -> [MonoNs; MAX_ENCODERS] {
        std::array::from_fn(|index| MonoNs(self.valid_at_ns[index].load(Ordering::Relaxed)))
    }

    /// What the terminals' latches showed in the latest cycle in which every encoder was valid, in bus order.
    pub fn latches(&self) -> [u32; MAX_ENCODERS] {
        std::array::from_fn(|index| self.latches[index].load(Ordering::Relaxed))
    }

    /// Reasons of the latest cycle, see `schema::flags`.
    pub fn flags(&self) -> u32 {
        self.flags.load(Ordering::Relaxed) as u32
    }

    /// The encoders, in bus order.
    pub fn encoders(&self) -> [LiveEncoder; MAX_ENCODERS] {
        std::array::from_fn(|index| {
            let packed = self.encoders[index].load(Ordering::Relaxed);
            LiveEncoder { count: packed as u32, status: (packed >> 32) as u16, valid: packed >> 48 & 1 == 1 }
        })
    }
}
