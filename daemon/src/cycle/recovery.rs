//! Fault recovery of the acquisition: the reaction to each bad cycle. No cycle number is lost.
//!
//! - After a single bad cycle, nothing is done. The record only gets a flag.
//! - If a terminal is in SAFE-OP, it is restored to OP between two frames.
//! - If replies are missing, frames continue to be sent. If the bus answers again in time, the cycle continues as before.
//! - If terminals are missing, the terminals before them stay in use until all devices answer again.
//! - If none of this helps, the bus is given up and brought up again. The records of the cycles that become due in that time
//!   are passed on with a flag. The clock of the bus is set so that its time continues. Cycle numbers and times are
//!   therefore consecutive within the run.

use shared::recording::schema::{CycleRecord, flags};
use shared::time::{DcNs, MonoNs, NS_PER_S};

use super::events::{Down, Happening};
use super::{Acquisition, ClockPair, PairStatus, Sampler};
use crate::bus::{CyclicExchange, CyclicReply, Operational, RestoreToOp, absent};
use crate::problem::Fact;

/// Number of consecutive cycles without an answer of a terminal. After this number the terminal counts as lost.
const LOST_CYCLES: u32 = 2;
/// Largest unexplained error of a bus time \[ns\]. With a larger error, the bus time does not show which cycle was sampled.
const MISREAD_NS: u64 = 100_000;
/// Number of consecutive bad cycles. After this number the bus is brought up again, even if all terminals reply in OP.
const BAD_CYCLES_MAX: u32 = 10;
/// Time limit for restoring a terminal to OP \[ns\].
const RESTORE_TIMEOUT_NS: i64 = NS_PER_S / 2;
/// Time between two requests for OP \[ns\].
const RESTORE_PERIOD_NS: i64 = NS_PER_S / 20;
/// Longest time without a reply \[ns\]. After a longer time, the clocks of the terminals are not synchronous enough.
const SILENCE_NS_MAX: i64 = NS_PER_S;
/// Time between two checks whether missing terminals answer again \[ns\].
const CHECK_PERIOD_NS: i64 = NS_PER_S / 20;
/// Largest difference between the time of a bus that was brought up and the time to which its clock was set \[ns\]. A few
/// repeated frames on a busy machine cause smaller differences. A larger difference means that the time was misread. If this
/// time were used, all cycles up to it would be skipped.
const SET_TIME_NS_MAX: u64 = NS_PER_S as u64 / 10;
/// Time between two attempts to bring the bus up \[ns\].
const RETRY_PERIOD_NS: i64 = NS_PER_S / 5;

/// State of the fault recovery.
#[derive(Debug, Default)]
pub(super) struct Health {
    /// Number of consecutive bad replies.
    bad: u32,
    /// When the first of the consecutive frames without a reply was sent. `None` if the last frame had a reply.
    silent_since: Option<MonoNs>,
    /// Times of the first and of the last request to return to OP. `None` if no terminal is being restored.
    restoring: Option<(MonoNs, MonoNs)>,
    /// First position that is missing, while the devices before this position stay in use. The time is that of the last
    /// check whether the missing devices answer.
    missing: Option<(u8, MonoNs)>,
    /// Number of attempts to bring up the bus since it was given up.
    attempts: u32,
    /// Earliest time of the next attempt.
    retry_at: Option<MonoNs>,
    /// The current period of cycles without a valid sample. `None` if the last cycle was valid.
    gap: Option<Gap>,
    /// Why the bus was given up.
    down: Option<Down>,
    /// Why the bus is still down.
    outage: Option<Fact>,
    /// Incremented whenever `down` or `outage` is set.
    outages: u32,
    /// Number of devices that answered in the last count that found devices missing.
    answering: Option<usize>,
}

/// A period of cycles without a valid sample.
#[derive(Debug, Clone, Copy)]
struct Gap {
    /// Number of the first of these cycles.
    first: u64,
    /// Flags of the first of these cycles. They show the cause of the gap.
    cause: u32,
    /// Flags that at least one of these cycles has.
    flags: u32,
    /// Encoders that were invalid in at least one of these cycles, one bit each in bus order.
    invalid: u8,
}

/// How many of the devices are in operation.
#[derive(Debug)]
pub enum BusState<'a> {
    /// All devices are in operation. Other problems are visible only in the records.
    Whole,
    /// The devices before this position are in operation. No device from this position on answers.
    Before(u8),
    /// No device is in operation. The value is the reason.
    Down(Outage<'a>),
}

/// Why no device is in operation.
#[derive(Debug, Clone, Copy)]
pub struct Outage<'a> {
    /// Why the bus was given up.
    pub down: Option<Down>,
    /// Why the bus cannot be brought up: devices are missing, or the last attempt failed with this error. `None` until the
    /// first count or attempt after the bus was given up.
    pub error: Option<&'a Fact>,
    /// A number that changes with every change of the outage.
    pub number: u32,
}

impl Outage<'_> {
    /// The reason of the outage in the form in which it is reported. Allocates memory.
    pub fn fact(&self, bus: &str) -> Option<Fact> {
        self.error.cloned().or_else(|| self.down.map(|down| down.fact(bus)))
    }
}

impl Health {
    /// Starts a run. The current gap is removed, because its cycle number is from before the run.
    pub(super) fn begin_run(&mut self) {
        self.gap = None;
    }
}

impl Acquisition {
    /// Reacts to a cycle: does nothing, restores a terminal to OP, or gives the bus up. `seen` states how the clock fit
    /// classified the bus time of this cycle.
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
            // The bus is given up even after a small step. The clocks of the terminals would take long to follow the step,
            // and the sample times would be unknown until then.
            self.report(Happening::ClockStep { by_ns });
            self.give_up(Down::ClockStep);
            return;
        }
        // Errors of an encoder's signal are ignored here, because a bring-up of the bus cannot repair the signal.
        let bus_flags = self.sampler.flags_of(record) & !(flags::TERMINAL_ERROR | flags::DEADLINE_MISSED);
        if record.is_valid() || bus_flags == 0 {
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
        // If the bus time was misread, the bus is not given up here. If the deviation persists, the clock
        // fit will report a step.
        } else if self.health.bad >= BAD_CYCLES_MAX && !seen.is_some_and(is_misread) {
            self.give_up(Down::Bad { flags: bus_flags });
        }
    }

    /// Before the next frame is due, requests OP from all terminals that are not in OP.
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

    /// Reacts to missing terminals. If no terminal is valid, the bus is given up at once. Otherwise the remaining terminals
    /// stay in use until all devices answer again, because a bring-up would interrupt the remaining terminals.
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

    /// Runs a cycle while the bus is down. One small frame counts the devices that answer. If all devices answer,
    /// the bus is brought up.
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

    /// How many of the devices are in operation. Allocates no memory.
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

    /// Continues the run after the bus was brought up. The first exchange provides the bus time and the toggle bits. Its
    /// inputs are not used, because nothing proves that they are new.
    fn resume(&mut self, operational: Operational, sink: &mut dyn FnMut(&CycleRecord)) {
        let exchange = self.bus.exchange(&operational);
        let bus_time = exchange.reply.and_then(|reply| reply.dc_time);
        if exchange.reply.is_none() || (self.distributed_clocks && bus_time.is_none()) {
            return self.catch_up(self.clock.now(), sink);
        }
        // Compare the time of the bus with the time to which its clock was set.
        let set_to = DcNs(exchange.sent.0).plus_ns(self.bus_minus_monotonic_ns());
        let off_ns = bus_time.map_or(0, |time| time.ns_since(set_to));
        if off_ns.unsigned_abs() > SET_TIME_NS_MAX {
            tracing::warn!(
                off_ns,
                "the bus time differs from the time that was set; the bus is brought up again"
            );
            return self.retry_later(sink);
        }
        // Restart the clock fit with the new bus time.
        let attempts = self.health.attempts;
        self.operational = Some(operational);
        let Health { gap, outages, .. } = self.health;
        self.health = Health { gap, outages, ..Health::default() };
        let before_ns = self.bus_minus_monotonic_ns();
        let restarted = self.fit.restarted();
        let fit_before = std::mem::replace(&mut self.fit, restarted);
        self.observe_clocks(&exchange);
        // Setting the clock of the bus takes some frames, so the clock is then slightly wrong. The next time the clock is
        // set, this error is subtracted, so that errors do not add up.
        let change_ns = self.bus_minus_monotonic_ns().wrapping_sub(before_ns);
        self.bus_lead_ns = self.bus_lead_ns.wrapping_add(change_ns);
        let sampled = self.cycle_sampled(&exchange);
        // The cycles during the outage get their times from the fit before the outage.
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

    /// Lead of the bus' clock over the host's clock at the time of the next cycle, according to the clock fit \[ns\].
    fn bus_minus_monotonic_ns(&self) -> i64 {
        let next = DcNs(self.instant_ns(self.next_cycle));
        next.0.wrapping_sub(self.fit.monotonic_from_dc(next).0)
    }

    /// Passes on the records of all cycles that were due before `now`.
    fn catch_up(&mut self, now: MonoNs, sink: &mut dyn FnMut(&CycleRecord)) {
        while self.frame_deadline(self.next_cycle) < now {
            self.emit_down(now, sink);
        }
    }

    /// Passes on the record of the next cycle. The record contains no sample, because the bus is down.
    fn emit_down(&mut self, at: MonoNs, sink: &mut dyn FnMut(&CycleRecord)) {
        let nothing = CyclicExchange { sent: at, received: at, reply: None };
        let mut record = self.sampler.missed(self.next_cycle, self.sample_time(self.next_cycle), &nothing);
        record.flags = self.sampler.flags_always() | flags::BUS_DOWN;
        self.emit(record, sink);
    }

    /// Completes the record of the next cycle and passes it to `sink`. Just after the clock of the bus was set,
    /// the time of a record may not be later than that of the previous record. Such a time is increased, and the
    /// counts are marked as invalid.
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
            let flags = self.sampler.flags_of(&record);
            let first = Gap { first: record.cycle, cause: flags, flags: 0, invalid: 0 };
            let gap = self.health.gap.get_or_insert(first);
            gap.flags |= flags;
            let encoders = record.encoders().iter().enumerate().filter(|(_, encoder)| !encoder.valid);
            encoders.for_each(|(index, _)| gap.invalid |= 1 << index);
        }
        sink(&record);
        self.next_cycle += 1;
    }

    /// Passes the bus time in a reply to the clock fit. Returns `None` if the reply contains no bus time.
    pub(super) fn observe_clocks(&mut self, exchange: &CyclicExchange) -> Option<PairStatus> {
        let dc = exchange.reply?.dc_time?;
        let CyclicExchange { sent, received, .. } = *exchange;
        Some(self.fit.observe(ClockPair { dc, sent, received, frame_ns: self.bus.frame_ns() }))
    }
}

/// Whether the bus time deviates so much that it does not show which cycle was sampled.
pub(super) fn is_misread(seen: PairStatus) -> bool {
    match seen {
        PairStatus::Followed => false,
        PairStatus::Gated(by_ns) | PairStatus::Stepped(by_ns) => by_ns.unsigned_abs() > MISREAD_NS,
    }
}
