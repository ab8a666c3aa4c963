//! The real-time cycle. The inputs are the time and the process image of the bus. The output is one record for each cycle.
//!
//! [`Acquisition::next_cycle`] takes these steps:
//! 1. sleep until the absolute deadline of the cycle
//! 2. exchange one frame with the bus
//! 3. pass one record to a sink, for each cycle that was due
//!
//! The sink is a bounded ring. The cycle allocates nothing, takes no lock and writes no file. While the bus is down, it may
//! do these things, because no deadline can be missed then, and bringing up a bus takes long.
//!
//! With distributed clocks, the terminals sample cycle `k` on their signal SYNC0, when the clock of the bus shows `origin +
//! k * period`. The frame of the cycle follows half a period later. The clock fit converts both times to host time.

mod clock_fit;
mod continuity;
mod events;
mod links;
mod realtime;
mod recovery;
mod sampler;
mod timing;

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use shared::recording::schema::{CycleRecord, DeviceInfo, flags};
use shared::time::{DcNs, MonoNs, UtcNs};

pub use clock_fit::{ClockFit, ClockPair, PairStatus};
pub use continuity::Continuity;
pub use events::{BusNames, CycleEvent, Down, Happening, Origin};
pub use links::Links;
pub use realtime::RealtimeReport;
pub use recovery::{BusState, Outage};
pub use sampler::{SampleTime, Sampler};
pub use timing::{CycleTiming, TimingSource, Timings, timing_ring};

use crate::bus::{Bus, BusError, BusPlan, CyclicExchange, Operational, WireCounters};
use crate::clock::Clock;
use crate::devices::el5021::{self, Output};
use recovery::{Health, is_misread};

/// Number of cycles before the first run. In this time the fit of bus time to host time converges.
const CLOCK_FIT_CYCLES: u32 = 100;
/// Number of cycles from the announcement of a run to its first sample.
const CYCLES_AHEAD: u64 = 2;

/// Largest number of events in the queue. One cycle never adds this many.
const EVENTS_MAX: usize = 32;

/// A bus with its clocks, which is in operation or is being brought up again.
pub struct Acquisition {
    bus: Bus,
    plan: BusPlan,
    /// `None` while the bus is down.
    operational: Option<Operational>,
    devices: Vec<DeviceInfo>,
    clock: Clock,
    period_ns: i64,
    /// Time from SYNC0 of a cycle to its frame \[ns\].
    sync0_shift_ns: i64,
    reply_timeout_ns: i64,
    distributed_clocks: bool,
    utc_minus_monotonic_ns: i64,
    fit: ClockFit,
    /// Lead of the bus' clock over a clock without interruptions \[ns\]. Each time the clock of the bus is set after an
    /// outage, a small error is made; the lead is the sum of these errors.
    bus_lead_ns: i64,
    sampler: Sampler,
    continuity: Continuity,
    health: Health,
    links: Links,
    events: VecDeque<CycleEvent>,
    /// Sample time of cycle 0 on the clock of the bus. Without distributed clocks, it is the time of the frame of cycle 0 on
    /// the clock of the host.
    origin_ns: i64,
    next_cycle: u64,
    /// When the last frame with a reply was sent.
    replied_last: Option<MonoNs>,
    /// Sample time of the previous cycle.
    time_last: Option<UtcNs>,
    /// Timing of the last cycle. `None` while the bus is down, because no deadline can be missed then.
    timing: Option<CycleTiming>,
}

impl Acquisition {
    /// Brings the bus up and waits until the clock fit has converged. Must be called on the thread that will run the cycle.
    pub fn start(mut bus: Bus, plan: &BusPlan, clock: Clock) -> Result<Self, BusError> {
        let operational = bus.bring_up(plan)?;
        Ok(Self::on(bus, operational, plan, clock))
    }

    /// Uses a bus that is already in operation. Runs cycles until the clock fit has converged. Must be called on the thread
    /// that will run the cycle.
    pub fn on(bus: Bus, operational: Operational, plan: &BusPlan, clock: Clock) -> Self {
        let joints = plan.encoders.iter().map(|encoder| encoder.joint);
        let mut acquisition = Self {
            sampler: Sampler::new(joints, operational.working_counter_expected, plan.distributed_clocks),
            bus,
            plan: plan.clone(),
            devices: operational.devices.clone(),
            operational: Some(operational),
            period_ns: nanoseconds(plan.cycle_period),
            sync0_shift_ns: nanoseconds(plan.sync0_shift),
            reply_timeout_ns: nanoseconds(plan.reply_timeout),
            distributed_clocks: plan.distributed_clocks,
            utc_minus_monotonic_ns: clock.utc_minus_monotonic_ns(),
            fit: ClockFit::default(),
            bus_lead_ns: 0,
            continuity: Continuity::new(&plan.encoders),
            health: Health::default(),
            links: Links::default(),
            events: VecDeque::with_capacity(EVENTS_MAX),
            origin_ns: 0,
            next_cycle: 0,
            replied_last: None,
            time_last: None,
            timing: None,
            clock,
        };
        acquisition.lock_on();
        acquisition
    }

    /// Sets a flag that interrupts later attempts to bring up the bus.
    pub fn interrupt_by(&mut self, interrupt: Arc<AtomicBool>) {
        self.bus.interrupt_by(interrupt);
    }

    /// The devices of the bus, as they identified themselves.
    pub fn devices(&self) -> &[DeviceInfo] {
        &self.devices
    }

    /// The difference `UTC - monotonic` that all sample times of this run contain \[ns\].
    pub fn utc_minus_monotonic_ns(&self) -> i64 {
        self.utc_minus_monotonic_ns
    }

    /// Counters of the wire so far.
    pub fn wire_counters(&self) -> WireCounters {
        self.bus.wire_counters()
    }

    /// Lateness and duration of the last cycle. `None` while the bus is down.
    pub fn last_timing(&self) -> Option<CycleTiming> {
        self.timing
    }

    /// Sets the outputs of one terminal from the next cycle on. `encoder` is its number in bus order, from 0. No effect
    /// while the bus is down. When the bus comes up again, the outputs are not restored.
    pub fn set_output(&mut self, encoder: usize, output: Output) {
        if let Some(operational) = &self.operational {
            self.bus.set_output(operational, encoder, output);
        }
    }

    /// Takes the oldest event. Must be called after each cycle until there are no more events.
    pub fn take_event(&mut self) -> Option<CycleEvent> {
        self.events.pop_front()
    }

    /// Sets the sample time of cycle 0 in the next run. Has no effect in real time, where the host determines UTC.
    pub fn set_first_sample_time(&mut self, utc: UtcNs) {
        if !self.clock.is_real() {
            self.utc_minus_monotonic_ns =
                utc.ns_since(UtcNs(self.sample_monotonic(self.next_cycle + CYCLES_AHEAD).0));
        }
    }

    /// Sets the difference `UTC - monotonic` for the sample times of later runs \[ns\].
    pub fn set_utc_minus_monotonic_ns(&mut self, utc_minus_monotonic_ns: i64) {
        self.utc_minus_monotonic_ns = utc_minus_monotonic_ns;
    }

    /// Runs one cycle without passing on its record, for example while a run is being prepared.
    pub fn idle(&mut self) {
        self.next_cycle(&mut |_| ());
    }

    /// Runs cycles until the next cycle is cycle 0 of a run. Before these cycles, `announce` receives the sample time of
    /// cycle 0 on the clock of the bus.
    pub fn begin_run(&mut self, announce: impl FnOnce(DcNs)) {
        let first = self.next_cycle + CYCLES_AHEAD;
        let origin_ns = self.instant_ns(first);
        announce(DcNs(origin_ns));
        // A frame is sent in each of these cycles, because a terminal without a frame reports a synchronisation error.
        while self.next_cycle < first {
            self.idle();
        }
        // If the thread woke late, it may have missed cycles between the announcement and the start. These cycles do not
        // belong to the run.
        let overslept = (self.next_cycle - first) as i64;
        self.next_cycle = 0;
        self.origin_ns = origin_ns.wrapping_add(overslept * self.period_ns);
        self.time_last = None;
        self.continuity.begin_run();
        self.health.begin_run();
        self.links.begin_run();
        self.events.clear();
    }

    /// Deadline of the next frame.
    pub fn due(&self) -> MonoNs {
        self.frame_deadline(self.next_cycle)
    }

    /// Waits for the next cycle and exchanges its frame. Passes one record to `sink` for each cycle that was due, even while
    /// the bus is down.
    pub fn next_cycle(&mut self, sink: &mut dyn FnMut(&CycleRecord)) {
        let deadline = self.due();
        self.clock.sleep_until(deadline);
        let woken = self.clock.now();
        self.timing = None;
        let Some(operational) = &self.operational else { return self.cycle_down(sink) };
        let exchange = self.bus.exchange(operational);
        self.cycle(&exchange, sink);
        self.timing = Some(CycleTiming {
            late_ns: woken.ns_since(deadline),
            round_trip_ns: exchange.reply.map(|_| exchange.received.ns_since(exchange.sent)),
            duration_ns: self.clock.now().ns_since(woken),
        });
        self.read_links(&exchange);
    }

    /// Passes on the records of all cycles that were due when `exchange` took place. Then reacts to faults.
    fn cycle(&mut self, exchange: &CyclicExchange, sink: &mut dyn FnMut(&CycleRecord)) {
        let seen = self.observe_clocks(exchange);
        let misread = seen.is_some_and(is_misread);
        let sampled = if misread { self.next_cycle } else { self.cycle_sampled(exchange) };
        // If the thread woke too late, SYNC0 has overwritten samples before their frames were sent. The records of these
        // cycles get the flag `DEADLINE_MISSED`.
        while self.next_cycle < sampled {
            let time = self.sample_time(self.next_cycle);
            let missed = self.sampler.missed(self.next_cycle, time, exchange);
            self.emit(missed, sink);
        }
        let time = self.sample_time(self.next_cycle);
        let mut record = self.sampler.sample(self.next_cycle, time, exchange);
        if sampled < self.next_cycle || !self.follows_a_frame(exchange) {
            Sampler::invalidate(&mut record, flags::STALE_INPUT);
        }
        if misread {
            Sampler::invalidate(&mut record, flags::NO_DC);
        } else if record.flags & flags::STALE_INPUT != 0 && self.is_past_next_sample(exchange) {
            record.flags |= flags::DEADLINE_MISSED;
        }
        self.emit(record, sink);
        self.react(&record, exchange, seen);
    }

    /// Whether the sample in a reply belongs to the cycle. Without distributed clocks, a terminal samples when a
    /// frame arrives, and the next frame fetches this sample. The sample belongs to the cycle only if the previous
    /// frame was sent on time.
    fn follows_a_frame(&mut self, exchange: &CyclicExchange) -> bool {
        let before = self.replied_last;
        if exchange.reply.is_some() {
            self.replied_last = Some(exchange.sent);
        }
        let due_before = self.frame_deadline(self.next_cycle).plus_ns(-self.period_ns);
        let off_ns = before.map_or(i64::MAX, |before| before.ns_since(due_before).abs());
        self.distributed_clocks || off_ns <= self.period_ns / 4
    }

    fn report(&mut self, what: Happening) {
        if self.events.len() < EVENTS_MAX {
            let time = self.sample_time(self.next_cycle).utc;
            self.events.push_back(CycleEvent { time, cycle: self.next_cycle, what });
        }
    }

    /// Finds the phase of SYNC0, then cycles until the clock fit has converged.
    fn lock_on(&mut self) {
        let Some(operational) = &self.operational else { return };
        let exchange = self.bus.exchange(operational);
        self.observe_clocks(&exchange);
        // The bring-up has set the clock of the bus to the time of the host, so the host's time replaces a missing reply.
        let now = exchange.reply.and_then(|reply| reply.dc_time).unwrap_or(DcNs(exchange.sent.0));
        let phase_ns = if self.distributed_clocks { now.0.rem_euclid(self.period_ns) } else { 0 };
        self.origin_ns = now.plus_ns(self.period_ns - phase_ns).0;
        (0..CLOCK_FIT_CYCLES).for_each(|_| self.idle());
    }

    /// Number of the cycle whose sample the reply contains. If the reply does not show this number,
    /// the expected one is returned.
    fn cycle_sampled(&self, exchange: &CyclicExchange) -> u64 {
        match exchange.reply.and_then(|reply| reply.dc_time) {
            Some(dc) => {
                let since_origin_ns = dc.plus_ns(-el5021::DATA_READY_NS).ns_since(DcNs(self.origin_ns));
                since_origin_ns.div_euclid(self.period_ns).max(0) as u64
            }
            None if self.distributed_clocks => self.next_cycle,
            None => {
                let since_origin_ns = exchange.sent.0 - self.origin_ns;
                (since_origin_ns.div_euclid(self.period_ns).max(0) as u64).max(self.next_cycle)
            }
        }
    }

    /// Whether the frame of the cycle passed the reference clock after the next SYNC0. At that time the terminals are
    /// converting, so the frame fetches the old sample from some terminals and the new sample from others.
    fn is_past_next_sample(&self, exchange: &CyclicExchange) -> bool {
        exchange
            .reply
            .and_then(|reply| reply.dc_time)
            .is_some_and(|dc| dc.0 >= self.instant_ns(self.next_cycle + 1))
    }

    /// Time of SYNC0 of a cycle \[ns\], on the same clock as [`Self::origin_ns`]. Sums wrap on overflow, because a damaged
    /// frame can contain any bus time.
    fn instant_ns(&self, cycle: u64) -> i64 {
        self.origin_ns.wrapping_add((cycle as i64).wrapping_mul(self.period_ns))
    }

    fn frame_deadline(&self, cycle: u64) -> MonoNs {
        let instant_ns = self.instant_ns(cycle);
        if self.distributed_clocks {
            self.fit.monotonic_from_dc(DcNs(instant_ns).plus_ns(self.sync0_shift_ns))
        } else {
            MonoNs(instant_ns)
        }
    }

    fn sample_monotonic(&self, cycle: u64) -> MonoNs {
        let instant_ns = self.instant_ns(cycle);
        if self.distributed_clocks {
            self.fit.monotonic_from_dc(DcNs(instant_ns))
        } else {
            // Without distributed clocks, the terminal samples at an unknown time between the previous frame and this one.
            // The middle of this interval has the smallest error.
            MonoNs(instant_ns).plus_ns(-self.period_ns / 2)
        }
    }

    fn sample_time(&self, cycle: u64) -> SampleTime {
        let utc = UtcNs(self.sample_monotonic(cycle).0.saturating_add(self.utc_minus_monotonic_ns));
        if self.distributed_clocks {
            let dc = DcNs(self.instant_ns(cycle));
            SampleTime { utc, uncertainty_ns: self.fit.uncertainty_ns(dc), dc }
        } else {
            // Standard deviation of a uniform distribution whose width is one period.
            let uncertainty_ns = (self.period_ns as f64 / 12f64.sqrt()) as u32;
            SampleTime { utc, uncertainty_ns, dc: DcNs(0) }
        }
    }
}

fn nanoseconds(duration: Duration) -> i64 {
    i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX)
}
