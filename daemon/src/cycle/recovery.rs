//! How the acquisition gets over faults: what each bad cycle leads to, and how no cycle gets lost meanwhile.
//!
//! A single bad cycle is flagged and forgotten. A terminal in SAFE-OP is asked back to OP between two frames. Silence is
//! met with further frames: a bus that answers again goes on where it was. Terminals before one that is gone stay in use
//! until it is back. Only when that does not help is the bus brought up again; cycles that become due meanwhile are given
//! afterwards, flagged, and the bus' clock is set to go on, so that numbers and times stay those of one run.

use shared::recording::schema::{CycleRecord, flags};
use shared::time::{DcNs, MonoNs, NS_PER_S};

use super::events::{Down, Happening};
use super::{Acquisition, ClockPair, Observation, Sampler};
use crate::bus::{CyclicExchange, Lift, Operational, Reply, absent};
use crate::problem::Fact;

/// A terminal that nobody hears is lost when the cycle after confirms it.
const LOST_CYCLES: u32 = 2;
/// A bus time that is this far off and that no delay explains says nothing about its sample \[ns\].
const MISREAD_NS: u64 = 100_000;
/// Bad cycles in a row, of any other kind, after which the bus is brought up again.
const BAD_CYCLES_MAX: u32 = 10;
/// A terminal that was asked back to OP gets this long \[ns\] ...
const LIFT_TIMEOUT_NS: i64 = NS_PER_S / 2;
/// ... and is asked again after this long \[ns\].
const LIFT_PERIOD_NS: i64 = NS_PER_S / 20;
/// Clocks of terminals that nobody synchronised for longer are no longer trusted \[ns\].
const SILENCE_NS_MAX: i64 = NS_PER_S;
/// Between two looks whether terminals that are missing are back \[ns\].
const LOOK_PERIOD_NS: i64 = NS_PER_S / 20;
/// A bus that was brought up shows the time that it was set to, but for this \[ns\]: what a few frames take that a busy machine
/// repeats. A time that is further off was misread, and would be believed for as many cycles as it is ahead.
const SET_TIME_NS_MAX: u64 = NS_PER_S as u64 / 10;
/// Between two attempts to bring the bus up \[ns\].
const RETRY_PERIOD_NS: i64 = NS_PER_S / 5;

/// What went wrong lately.
#[derive(Debug, Default)]
pub(super) struct Health {
    /// Bad replies in a row.
    bad: u32,
    /// When the first of the frames without reply was sent.
    silent_since: Option<MonoNs>,
    /// When a terminal was first and last asked back to OP.
    lifting: Option<(MonoNs, MonoNs)>,
    /// First position whose device is missing while those before it stay in use, and when it was last looked whether
    /// it is back.
    missing: Option<(u8, MonoNs)>,
    /// Attempts to bring up the bus since it was given up.
    attempts: u32,
    /// Not before this is it tried again.
    retry_at: Option<MonoNs>,
    /// Cycles without valid sample that go on.
    gap: Option<Gap>,
    /// Why the bus was given up.
    down: Option<Down>,
    /// Why the bus is still down.
    outage: Option<Fact>,
    /// Rises with every change of the latter two.
    outages: u32,
    /// How many devices answered when the bus was last found incomplete.
    answering: Option<usize>,
}

/// Cycles without valid sample.
#[derive(Debug, Clone, Copy)]
struct Gap {
    first: u64,
    /// Reasons of the first, which are the cause, and all since.
    cause: u32,
    flags: u32,
    /// Encoders that were invalid in the first, as bits.
    invalid: u8,
}

/// How much of the bus is in operation.
#[derive(Debug)]
pub enum BusState<'a> {
    /// All of it, or what is wrong with it shows in its records only.
    Whole,
    /// What lies before this position; from there on nobody answers.
    Before(u8),
    /// Nothing, and why.
    Down(Outage<'a>),
}

/// Why no device is in operation.
#[derive(Debug, Clone, Copy)]
pub struct Outage<'a> {
    /// Why the bus was given up.
    pub down: Option<Down>,
    /// What the last attempt to bring it up met; known later.
    pub error: Option<&'a Fact>,
    /// Differs from one outage to the next.
    pub number: u32,
}

impl Outage<'_> {
    /// As it is reported. Allocates.
    pub fn fact(&self, bus: &str) -> Option<Fact> {
        self.error.cloned().or_else(|| self.down.map(|down| down.fact(bus)))
    }
}

impl Health {
    /// Forgets the cycle numbers of what came before a run.
    pub(super) fn begin_run(&mut self) {
        self.gap = None;
    }
}

impl Acquisition {
    /// Draws the conclusions from a cycle: nothing, ask a terminal back, or give the bus up.
    pub(super) fn conclude(
        &mut self,
        record: &CycleRecord,
        exchange: &CyclicExchange,
        seen: Option<Observation>,
    ) {
        let Some(reply) = &exchange.reply else {
            let since = *self.health.silent_since.get_or_insert(exchange.sent);
            if exchange.sent.ns_since(since) > SILENCE_NS_MAX {
                self.give_up(Down::Silent);
            }
            return;
        };
        self.health.silent_since = None;
        if let Some(Observation::Stepped(by_ns)) = seen {
            // However small: the terminals' clocks would take long to follow, and meanwhile nobody knows when they
            // sample.
            self.tell(Happening::ClockStep { by_ns });
            self.give_up(Down::ClockStep);
            return;
        }
        // A broken signal is not mended by bringing up the bus.
        let matter = record.flags & !(flags::TERMINAL_ERROR | flags::DEADLINE_MISSED);
        if record.is_valid() || (matter & !self.sampler.flags_always()) == 0 {
            (self.health.bad, self.health.lifting, self.health.missing) = (0, None, None);
            return;
        }
        self.health.bad += 1;
        if reply.silent != 0 {
            if self.health.bad >= LOST_CYCLES {
                let some_left = record.encoders().iter().any(|encoder| encoder.valid);
                self.do_without(reply.silent, some_left, exchange.received);
            }
        } else if reply.not_operational != 0 {
            self.lift(reply, exchange.received);
        } else if self.health.bad >= BAD_CYCLES_MAX && !seen.is_some_and(is_misread) {
            self.give_up(Down::Bad { flags: matter });
        }
    }

    /// Asks terminals that fell to SAFE-OP back, in the time until the next frame.
    fn lift(&mut self, reply: &Reply, now: MonoNs) {
        let (first, last) = self.health.lifting.unwrap_or((now, MonoNs(i64::MIN / 2)));
        if now.ns_since(first) > LIFT_TIMEOUT_NS {
            self.give_up(Down::Bad { flags: flags::NOT_OPERATIONAL });
            return;
        }
        if now.ns_since(last) < LIFT_PERIOD_NS {
            return;
        }
        self.health.lifting = Some((first, now));
        let until = now.plus_ns(self.period_ns / 4);
        for position in (0..u32::BITS as usize).filter(|position| reply.not_operational >> position & 1 == 1)
        {
            match self.bus.lift(position, until) {
                Lift::Requested(code) if last < first => {
                    self.tell(Happening::FellToSafeOp { position: position as u8, code });
                }
                Lift::Requested(_) | Lift::Operational | Lift::Unknown => {}
                Lift::Beyond => {
                    self.give_up(Down::DeviceLost);
                    return;
                }
            }
        }
    }

    /// Terminals are gone. While some are left these stay in use, and the bus is brought up again, which none of them
    /// would survive, only when all devices answer.
    fn do_without(&mut self, silent: u32, some_left: bool, now: MonoNs) {
        let looked_at = self.health.missing.map(|(_, looked_at)| looked_at);
        if looked_at.is_some_and(|looked_at| some_left && now.ns_since(looked_at) < LOOK_PERIOD_NS) {
            return;
        }
        let all = self.devices.len();
        if !some_left || self.bus.answering(all, now.plus_ns(self.period_ns / 4)) == all {
            self.give_up(Down::DeviceLost);
            return;
        }
        let position = silent.trailing_zeros() as u8;
        if looked_at.is_none() {
            self.tell(Happening::Missing { position });
        }
        self.health.missing = Some((position, now));
    }

    fn give_up(&mut self, why: Down) {
        self.operational = None;
        let Health { gap, outages, .. } = self.health;
        self.health = Health { gap, outages: outages.wrapping_add(1), down: Some(why), ..Health::default() };
        self.tell(Happening::Down(why));
    }

    /// A cycle without a bus: one small frame looks who is there; when all are, the bus is brought up.
    pub(super) fn cycle_down(&mut self, sink: &mut dyn FnMut(&CycleRecord)) {
        let now = self.clock.now();
        let answering = self.bus.answering(self.devices.len(), now.plus_ns(self.reply_timeout_ns));
        self.emit_down(self.next_cycle, now, sink);
        if answering != self.devices.len() {
            return self.note_incomplete(answering);
        }
        if self.health.retry_at.is_some_and(|retry_at| now < retry_at) {
            return;
        }
        self.health.attempts += 1;
        match self.try_bring_up_again() {
            Some(operational) => self.go_on(operational, sink),
            None => self.retry_later(sink),
        }
    }

    fn retry_later(&mut self, sink: &mut dyn FnMut(&CycleRecord)) {
        let now = self.clock.now();
        self.health.retry_at = Some(now.plus_ns(RETRY_PERIOD_NS));
        self.catch_up(now, sink);
    }

    fn note_incomplete(&mut self, answering: usize) {
        if self.health.answering != Some(answering) {
            self.health.answering = Some(answering);
            self.health.outages = self.health.outages.wrapping_add(1);
            self.health.outage = Some(absent(&self.plan.name, &self.devices, answering));
        }
    }

    /// How much of the bus is in operation. Allocates nothing.
    pub fn bus_state(&self) -> BusState<'_> {
        match (&self.operational, self.health.missing) {
            (None, _) => {
                let Health { down, outages: number, .. } = self.health;
                BusState::Down(Outage { down, error: self.health.outage.as_ref(), number })
            }
            (Some(_), Some((from, _))) => BusState::Before(from),
            (Some(_), None) => BusState::Whole,
        }
    }

    fn try_bring_up_again(&mut self) -> Option<Operational> {
        if self.bus.was_powered_off(self.devices.len())? {
            self.continuity.powered_off();
        }
        self.continuity.resets(self.sample_time(self.next_cycle).utc);
        if self.distributed_clocks {
            self.bus.set_bus_minus_monotonic(self.bus_minus_monotonic_ns().wrapping_sub(self.bus_lead_ns));
        }
        match self.bus.bring_up(&self.plan) {
            Ok(operational) => Some(operational),
            Err(error) if *error.fact() == Fact::BusInterrupted {} => None,
            Err(error) => {
                tracing::warn!(attempt = self.health.attempts, "bus stays down: {error}");
                let code = error.fact().code();
                let before = self.health.outage.replace(error.fact().clone());
                if before.is_none_or(|before| before.code() != code) {
                    self.tell(Happening::StaysDown { code });
                }
                self.health.answering = None;
                self.health.outages = self.health.outages.wrapping_add(1);
                None
            }
        }
    }

    /// The first exchange after the bus came up tells the time and which way the toggles stand; its inputs are not
    /// used, because nothing proves yet that they are fresh.
    fn go_on(&mut self, operational: Operational, sink: &mut dyn FnMut(&CycleRecord)) {
        let exchange = self.bus.exchange(&operational);
        let bus_time = exchange.reply.and_then(|reply| reply.dc_time);
        if exchange.reply.is_none() || (self.distributed_clocks && bus_time.is_none()) {
            return self.catch_up(self.clock.now(), sink);
        }
        let set_to = DcNs(exchange.sent.0).plus_ns(self.bus_minus_monotonic_ns());
        let off_ns = bus_time.map_or(0, |time| time.ns_since(set_to));
        if off_ns.unsigned_abs() > SET_TIME_NS_MAX {
            tracing::warn!(
                off_ns,
                "the bus does not show the time that it was set to; it is brought up again"
            );
            return self.retry_later(sink);
        }
        let attempts = self.health.attempts;
        self.operational = Some(operational);
        let Health { gap, outages, .. } = self.health;
        self.health = Health { gap, outages, ..Health::default() };
        let difference_ns = self.bus_minus_monotonic_ns();
        let restarted = self.fit.restarted();
        let before = std::mem::replace(&mut self.fit, restarted);
        self.observe_clocks(&exchange);
        // Setting the bus' clock takes some frames: it comes out a little off. Remembered, so that it does not add up.
        let lead_ns = self.bus_minus_monotonic_ns().wrapping_sub(difference_ns);
        self.bus_lead_ns = self.bus_lead_ns.wrapping_add(lead_ns);
        let sampled = self.cycle_sampled(&exchange);
        let after = std::mem::replace(&mut self.fit, before);
        while self.next_cycle < sampled {
            self.emit_down(self.next_cycle, exchange.sent, sink);
        }
        self.fit = after;
        if self.next_cycle == sampled {
            let time = self.sample_time(sampled);
            let mut record = self.sampler.sample(sampled, time, &exchange);
            Sampler::invalidate(&mut record, flags::BUS_DOWN);
            self.emit(record, sink);
        }
        self.tell(Happening::Up { attempts });
    }

    /// How far the bus' clock is ahead of the host's around now, as the fit has it.
    fn bus_minus_monotonic_ns(&self) -> i64 {
        let next = DcNs(self.instant_ns(self.next_cycle));
        next.0.wrapping_sub(self.fit.monotonic_from_dc(next).0)
    }

    /// Gives the cycles that were due before `now`.
    fn catch_up(&mut self, now: MonoNs, sink: &mut dyn FnMut(&CycleRecord)) {
        while self.frame_deadline(self.next_cycle) < now {
            self.emit_down(self.next_cycle, now, sink);
        }
    }

    fn emit_down(&mut self, cycle: u64, at: MonoNs, sink: &mut dyn FnMut(&CycleRecord)) {
        let nothing = CyclicExchange { sent: at, received: at, reply: None };
        let mut record = self.sampler.missed(cycle, self.sample_time(cycle), &nothing);
        record.flags = self.sampler.flags_always() | flags::BUS_DOWN;
        self.emit(record, sink);
    }

    /// Hands out the record of the next cycle. Time never runs backwards, also where the bus' clock was set anew.
    pub(super) fn emit(&mut self, mut record: CycleRecord, sink: &mut dyn FnMut(&CycleRecord)) {
        if let Some(last) = self.time_last.filter(|last| record.sample_time <= *last) {
            let behind_ns =
                u32::try_from(last.ns_since(record.sample_time).saturating_add(1)).unwrap_or(u32::MAX);
            record.sample_time = last.plus_ns(1);
            record.sample_time_uncertainty_ns = record.sample_time_uncertainty_ns.saturating_add(behind_ns);
            Sampler::invalidate(&mut record, flags::BUS_DOWN);
        }
        self.time_last = Some(record.sample_time);
        if let Some(origin) = self.continuity.check(&mut record) {
            self.tell(Happening::OriginChanged(origin));
        }
        if record.is_valid() {
            if let Some(Gap { first, cause, flags, invalid }) = self.health.gap.take() {
                self.tell(Happening::Gap { first, cycles: record.cycle - first, cause, flags, invalid });
            }
        } else {
            let gap = self.health.gap.get_or_insert_with(|| {
                let encoders = record.encoders().iter().enumerate().filter(|(_, encoder)| !encoder.valid);
                let invalid = encoders.fold(0, |bits, (index, _)| bits | 1 << index);
                Gap { first: record.cycle, cause: record.flags, flags: 0, invalid }
            });
            gap.flags |= record.flags;
        }
        sink(&record);
        self.next_cycle += 1;
    }

    /// Takes a reading of the bus' clock into account; none without one.
    pub(super) fn observe_clocks(&mut self, exchange: &CyclicExchange) -> Option<Observation> {
        let dc = exchange.reply?.dc_time?;
        let CyclicExchange { sent, received, .. } = *exchange;
        Some(self.fit.observe(ClockPair { dc, sent, received, frame_ns: self.bus.frame_ns() }))
    }
}

/// Whether a bus time is too far off to be used, also for telling which cycle was sampled.
pub(super) fn is_misread(seen: Observation) -> bool {
    match seen {
        Observation::Followed => false,
        Observation::Doubted(by_ns) | Observation::Stepped(by_ns) => by_ns.unsigned_abs() > MISREAD_NS,
    }
}
