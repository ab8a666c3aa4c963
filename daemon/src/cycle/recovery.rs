//! Fault recovery of the acquisition: the reaction to each bad cycle, without losing a cycle number.
//!
//! A single bad cycle is only flagged. A terminal in SAFE-OP is restored to OP between two frames. Without replies frames
//! continue to be sent, and a bus that answers again continues where it was. Terminals before a missing one stay in use
//! until it is back. Only if that does not help is the bus brought up again; cycles that become due in that time are given
//! afterwards, flagged, and the bus' clock continues its time, so that numbers and times stay those of one run.

use shared::recording::schema::{CycleRecord, flags};
use shared::time::{DcNs, MonoNs, NS_PER_S};

use super::events::{Down, Happening};
use super::{Acquisition, ClockPair, PairStatus, Sampler};
use crate::bus::{CyclicExchange, CyclicReply, Operational, RestoreToOp, absent};
use crate::problem::Fact;

/// A terminal without a reply counts as lost after this number of cycles.
const LOST_CYCLES: u32 = 2;
/// A bus time with a larger unexplained error does not show which cycle was sampled \[ns\].
const MISREAD_NS: u64 = 100_000;
/// Number of bad cycles in a row, although all terminals reply in OP, after which the bus is brought up again.
const BAD_CYCLES_MAX: u32 = 10;
/// Time limit for restoring a terminal to OP \[ns\] ...
const RESTORE_TIMEOUT_NS: i64 = NS_PER_S / 2;
/// ... and the period of the requests \[ns\].
const RESTORE_PERIOD_NS: i64 = NS_PER_S / 20;
/// Clocks of terminals that were not synchronised for longer are unreliable \[ns\].
const SILENCE_NS_MAX: i64 = NS_PER_S;
/// Period of the checks whether missing terminals are back \[ns\].
const CHECK_PERIOD_NS: i64 = NS_PER_S / 20;
/// Tolerance of the time of a bus that was brought up: the duration of a few frames that a busy machine repeats \[ns\]. A
/// time beyond that was misread, and using it would skip as many cycles as it is ahead.
const SET_TIME_NS_MAX: u64 = NS_PER_S as u64 / 10;
/// Period of attempts to bring the bus up \[ns\].
const RETRY_PERIOD_NS: i64 = NS_PER_S / 5;

/// State of the fault recovery.
#[derive(Debug, Default)]
pub(super) struct Health {
    /// Bad replies in a row.
    bad: u32,
    /// When the first of the frames without reply was sent.
    silent_since: Option<MonoNs>,
    /// Times of the first and last request to return to OP.
    restoring: Option<(MonoNs, MonoNs)>,
    /// First position whose device is missing while those before it stay in use, and the time of the last check whether it is
    /// back.
    missing: Option<(u8, MonoNs)>,
    /// Attempts to bring up the bus since it was given up.
    attempts: u32,
    /// Earliest time of the next attempt.
    retry_at: Option<MonoNs>,
    /// Current cycles without valid sample.
    gap: Option<Gap>,
    /// Why the bus was given up.
    down: Option<Down>,
    /// Why the bus is still down.
    outage: Option<Fact>,
    /// Increases with every change of `down` and `outage`.
    outages: u32,
    /// Number of devices that answered when the bus was last incomplete.
    answering: Option<usize>,
}

/// Cycles without valid sample.
#[derive(Debug, Clone, Copy)]
struct Gap {
    first: u64,
    /// Flags of the first, which are the cause.
    cause: u32,
    /// Flags of any of these cycles.
    flags: u32,
    /// Encoders that were invalid in the first, as bits.
    invalid: u8,
}

/// Extent to which the bus is in operation.
#[derive(Debug)]
pub enum BusState<'a> {
    /// Completely; its problems, if any, only show in its records.
    Whole,
    /// Up to this position; from there on no device answers.
    Before(u8),
    /// Not at all, and why.
    Down(Outage<'a>),
}

/// Why no device is in operation.
#[derive(Debug, Clone, Copy)]
pub struct Outage<'a> {
    /// Why the bus was given up.
    pub down: Option<Down>,
    /// Why it cannot be brought up: missing devices, or the error of the last attempt; `None` just after it was given up.
    pub error: Option<&'a Fact>,
    /// Differs from one outage to the next.
    pub number: u32,
}

impl Outage<'_> {
    /// The outage as it is reported. Allocates.
    pub fn fact(&self, bus: &str) -> Option<Fact> {
        self.error.cloned().or_else(|| self.down.map(|down| down.fact(bus)))
    }
}

impl Health {
    /// Forgets the cycle numbers before a run.
    pub(super) fn begin_run(&mut self) {
        self.gap = None;
    }
}

impl Acquisition {
    /// Reacts to a cycle: nothing, restore a terminal to OP, or give the bus up.
    pub(super) fn react(
        &mut self,
        record: &CycleRecord,
        exchange: &CyclicExchange,
        seen: Option<PairStatus>,
    ) {
        let Some(reply) = &exchange.reply else {
            let since = *self.health.silent_since.get_or_insert(exchange.sent);
            if exchange.sent.ns_since(since) > SILENCE_NS_MAX {
                self.give_up(Down::Silent);
            }
            return;
        };
        self.health.silent_since = None;
        if let Some(PairStatus::Stepped(by_ns)) = seen {
            // Even a small step: the terminals' clocks would take long to follow, and until then the sampling times
            // are unknown.
            self.report(Happening::ClockStep { by_ns });
            self.give_up(Down::ClockStep);
            return;
        }
        // Bringing up the bus does not repair a broken signal.
        let bus_flags = record.flags & !(flags::TERMINAL_ERROR | flags::DEADLINE_MISSED);
        if record.is_valid() || (bus_flags & !self.sampler.flags_always()) == 0 {
            (self.health.bad, self.health.restoring, self.health.missing) = (0, None, None);
            return;
        }
        self.health.bad += 1;
        if reply.silent != 0 {
            if self.health.bad >= LOST_CYCLES {
                let others_are_valid = record.encoders().iter().any(|encoder| encoder.valid);
                self.continue_without(reply.silent, others_are_valid, exchange.received);
            }
        } else if reply.not_operational != 0 {
            self.restore_to_op(reply, exchange.received);
        // A misread time is left to the clock fit, which reports a step if it persists.
        } else if self.health.bad >= BAD_CYCLES_MAX && !seen.is_some_and(is_misread) {
            self.give_up(Down::Bad { flags: bus_flags });
        }
    }

    /// Requests OP from terminals in SAFE-OP, in the time until the next frame.
    fn restore_to_op(&mut self, reply: &CyclicReply, now: MonoNs) {
        let is_first_request = self.health.restoring.is_none();
        let (first, last) = self.health.restoring.unwrap_or((now, MonoNs(i64::MIN / 2)));
        if now.ns_since(first) > RESTORE_TIMEOUT_NS {
            self.give_up(Down::Bad { flags: flags::NOT_OPERATIONAL });
            return;
        }
        if now.ns_since(last) < RESTORE_PERIOD_NS {
            return;
        }
        self.health.restoring = Some((first, now));
        let until = now.plus_ns(self.period_ns / 4);
        for position in (0..u32::BITS as usize).filter(|position| reply.not_operational >> position & 1 == 1)
        {
            match self.bus.restore_to_op(position, until) {
                RestoreToOp::Requested(code) if is_first_request => {
                    self.report(Happening::FellToSafeOp { position: position as u8, code });
                }
                RestoreToOp::Requested(_) | RestoreToOp::Operational | RestoreToOp::Unknown => {}
                RestoreToOp::Beyond => {
                    self.give_up(Down::DeviceLost);
                    return;
                }
            }
        }
    }

    /// Terminals are missing. While one of the others is valid they stay in use; the bus is brought up again, which interrupts
    /// them, only when all devices answer.
    fn continue_without(&mut self, silent: u32, others_are_valid: bool, now: MonoNs) {
        let last_check = self.health.missing.map(|(_, checked)| checked);
        if last_check.is_some_and(|checked| others_are_valid && now.ns_since(checked) < CHECK_PERIOD_NS) {
            return;
        }
        let devices = self.devices.len();
        let until = now.plus_ns(self.period_ns / 4);
        if !others_are_valid || self.bus.answering(devices, until) == devices {
            self.give_up(Down::DeviceLost);
            return;
        }
        let position = silent.trailing_zeros() as u8;
        if last_check.is_none() {
            self.report(Happening::Missing { position });
        }
        self.health.missing = Some((position, now));
    }

    fn give_up(&mut self, why: Down) {
        self.operational = None;
        let Health { gap, outages, .. } = self.health;
        self.health = Health { gap, outages: outages.wrapping_add(1), down: Some(why), ..Health::default() };
        self.report(Happening::Down(why));
    }

    /// A cycle without a bus: one small frame counts the devices that answer; when all do, the bus is brought up.
    pub(super) fn cycle_down(&mut self, sink: &mut dyn FnMut(&CycleRecord)) {
        let now = self.clock.now();
        let answering = self.bus.answering(self.devices.len(), now.plus_ns(self.reply_timeout_ns));
        self.emit_down(now, sink);
        if answering != self.devices.len() {
            return self.note_incomplete(answering);
        }
        if self.health.retry_at.is_some_and(|retry_at| now < retry_at) {
            return;
        }
        self.health.attempts += 1;
        match self.try_bring_up_again() {
            Some(operational) => self.resume(operational, sink),
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

    /// Extent to which the bus is in operation. Allocates nothing.
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
        self.continuity.bus_reset(self.sample_time(self.next_cycle).utc);
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
                    self.report(Happening::StaysDown { code });
                }
                self.health.answering = None;
                self.health.outages = self.health.outages.wrapping_add(1);
                None
            }
        }
    }

    /// The first exchange after the bus came up gives the time and the state of the toggles; its inputs are not used, because
    /// nothing proves that they are new.
    fn resume(&mut self, operational: Operational, sink: &mut dyn FnMut(&CycleRecord)) {
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
                "the bus time differs from the time that was set; the bus is brought up again"
            );
            return self.retry_later(sink);
        }
        let attempts = self.health.attempts;
        self.operational = Some(operational);
        let Health { gap, outages, .. } = self.health;
        self.health = Health { gap, outages, ..Health::default() };
        let before_ns = self.bus_minus_monotonic_ns();
        let restarted = self.fit.restarted();
        let fit_before = std::mem::replace(&mut self.fit, restarted);
        self.observe_clocks(&exchange);
        // Setting the bus' clock takes some frames, so it is a little off. The next setting corrects this: errors do not add up.
        let change_ns = self.bus_minus_monotonic_ns().wrapping_sub(before_ns);
        self.bus_lead_ns = self.bus_lead_ns.wrapping_add(change_ns);
        let sampled = self.cycle_sampled(&exchange);
        // Cycles without a bus have their times from the fit before the outage.
        let fit_after = std::mem::replace(&mut self.fit, fit_before);
        while self.next_cycle < sampled {
            self.emit_down(exchange.sent, sink);
        }
        self.fit = fit_after;
        if self.next_cycle == sampled {
            let time = self.sample_time(sampled);
            let mut record = self.sampler.sample(sampled, time, &exchange);
            Sampler::invalidate(&mut record, flags::BUS_DOWN);
            self.emit(record, sink);
        }
        self.report(Happening::Up { attempts });
    }

    /// Lead of the bus' clock over the host's at the next cycle, according to the fit \[ns\].
    fn bus_minus_monotonic_ns(&self) -> i64 {
        let next = DcNs(self.instant_ns(self.next_cycle));
        next.0.wrapping_sub(self.fit.monotonic_from_dc(next).0)
    }

    /// Gives the cycles that were due before `now`.
    fn catch_up(&mut self, now: MonoNs, sink: &mut dyn FnMut(&CycleRecord)) {
        while self.frame_deadline(self.next_cycle) < now {
            self.emit_down(now, sink);
        }
    }

    /// Gives the record of the next cycle, which has no sample because the bus is down.
    fn emit_down(&mut self, at: MonoNs, sink: &mut dyn FnMut(&CycleRecord)) {
        let nothing = CyclicExchange { sent: at, received: at, reply: None };
        let mut record = self.sampler.missed(self.next_cycle, self.sample_time(self.next_cycle), &nothing);
        record.flags = self.sampler.flags_always() | flags::BUS_DOWN;
        self.emit(record, sink);
    }

    /// Gives the record of the next cycle to `sink`. Time never runs backwards, also after the bus' clock was set.
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
            self.report(Happening::OriginChanged(origin));
        }
        if record.is_valid() {
            if let Some(Gap { first, cause, flags, invalid }) = self.health.gap.take() {
                self.report(Happening::Gap { first, cycles: record.cycle - first, cause, flags, invalid });
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

    /// Takes a reading of the bus' clock into account; `None` without one.
    pub(super) fn observe_clocks(&mut self, exchange: &CyclicExchange) -> Option<PairStatus> {
        let dc = exchange.reply?.dc_time?;
        let CyclicExchange { sent, received, .. } = *exchange;
        Some(self.fit.observe(ClockPair { dc, sent, received, frame_ns: self.bus.frame_ns() }))
    }
}

/// Whether a bus time is too far off to be used, also to find the cycle that was sampled.
pub(super) fn is_misread(seen: PairStatus) -> bool {
    match seen {
        PairStatus::Followed => false,
        PairStatus::Gated(by_ns) | PairStatus::Stepped(by_ns) => by_ns.unsigned_abs() > MISREAD_NS,
    }
}
