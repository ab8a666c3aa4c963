//! Counts the cycles of a bus in operation, and derives checks from the counts. Records and events of a session are counted
//! by flag, by working counter, by encoder status and by event code. A check compares a count with the limit in `smoke.toml`.
//! The smoke test uses this module at each rate, and while the cable is pulled.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::Serialize;
use shared::recording::TimingSummary;
use shared::recording::schema::{CycleRecord, PortCounts, SIMULATED_BUS, flags};
use shared::time::{DcNs, UtcNs};

use super::check::{Outcome, Reason, Subject};
use super::config::{CyclesConfig, SmokeConfig};
use crate::bus::DeviceClock;
use crate::cycle::{BusNames, CycleEvent};
use crate::devices::el5021::StatusWord;
use crate::problem::{Fact, Problem};
use crate::run::{Session, Stop};
use crate::scheduler::until;

/// Period in which the ring is emptied.
const PERIOD: Duration = Duration::from_millis(10);
/// Flags that make a cycle bad for [`Subject::Cycles`]. The other flags belong to other checks.
const CYCLE_FLAGS: u32 = flags::NO_REPLY | flags::DEADLINE_MISSED | flags::BUS_DOWN | flags::LOST;
/// Flags that make a cycle bad for [`Subject::WorkingCounter`].
const DEVICE_FLAGS: u32 = flags::WORKING_COUNTER | flags::NOT_OPERATIONAL;

/// Figures of a series of cycles.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Figures {
    /// Cycles per second \[Hz\].
    pub rate_hz: u32,
    /// Cycles that were due.
    pub cycles: u64,
    /// Cycles in which every encoder was valid.
    pub cycles_valid: u64,
    /// Number of cycles with each flag.
    pub flags: BTreeMap<&'static str, u64>,
    /// Working counter of a reply to a frame that all devices processed.
    pub working_counter_expected: u16,
    /// Number of replies with each working counter.
    pub working_counters: BTreeMap<u16, u64>,
    /// Figures of each encoder, in bus order.
    pub encoders: Vec<EncoderFigures>,
    /// Clocks of the devices and of this PC.
    pub clocks: ClockFigures,
    /// Number and first text of the events with each code.
    pub events: BTreeMap<String, EventFigures>,
    /// Ports that have counted errors.
    pub ports: Vec<PortCounts>,
    /// Lateness of cycles and duration of replies; `None` on virtual time.
    pub timing: Option<TimingSummary>,
    /// Real-time permissions of the cycle thread; `None` on virtual time.
    pub realtime: Option<String>,
    #[serde(skip)]
    names: BusNames,
    /// Number of cycles that are bad because of [`CYCLE_FLAGS`].
    #[serde(skip)]
    bad_cycles: u64,
    /// Number of cycles that are bad because of [`DEVICE_FLAGS`].
    #[serde(skip)]
    device_bad_cycles: u64,
    /// Number of cycles in which a new synchronised sample is missing and no other fault explains why.
    #[serde(skip)]
    unsynchronised_cycles: u64,
    /// Whether the previous cycle was bad. It matters because a terminal that misses a frame reports the
    /// loss in the next cycle.
    #[serde(skip)]
    was_bad: bool,
    /// Time of the first sample, on the clock of the bus and in UTC.
    #[serde(skip)]
    first_sample: Option<(DcNs, UtcNs)>,
}

/// Figures of the terminal of one encoder.
#[derive(Debug, Clone, Default, Serialize)]
pub struct EncoderFigures {
    /// Bar joint that the encoder measures, 1 to 5.
    pub joint: u8,
    /// Number of cycles with a valid sample.
    pub valid: u64,
    /// Number of cycles with an amplitude error.
    pub amplitude_errors: u64,
    /// Number of cycles with a frequency error.
    pub frequency_errors: u64,
    /// Number of cycles with a synchronisation error.
    pub sync_errors: u64,
    /// Count of the last cycle.
    pub count: u32,
    /// Status word of the last cycle.
    pub status: u16,
}

/// Figures of the distributed clocks.
#[derive(Debug, Clone, Default, Serialize)]
pub struct ClockFigures {
    /// Clocks of the devices at the time when the bus came into operation.
    pub devices: Vec<DeviceClock>,
    /// Rate difference of the host's UTC relative to the clock of the bus; `None` without distributed clocks \[ppm\].
    pub host_rate_ppm: Option<f64>,
    /// Largest standard deviation of a sample time \[ns\].
    pub uncertainty_ns_max: u32,
}

/// Events with the same code.
#[derive(Debug, Clone, Default, Serialize)]
pub struct EventFigures {
    /// Number of these events.
    pub count: u64,
    /// Text of the first of these events.
    pub first: String,
}

impl Figures {
    /// Creates figures without cycles.
    pub fn new(session: &Session, rate_hz: u32) -> Self {
        let joints = session.encoders.iter().map(|encoder| encoder.joint);
        let encoders = joints.clone().map(|joint| EncoderFigures { joint, ..EncoderFigures::default() });
        let devices = session.devices().to_vec();
        Self {
            rate_hz,
            encoders: encoders.collect(),
            clocks: ClockFigures { devices: session.clocks().to_vec(), ..ClockFigures::default() },
            realtime: session.realtime().map(ToString::to_string),
            names: BusNames { bus: session.bus.clone(), devices, joints: joints.collect() },
            ..Self::default()
        }
    }

    /// Counts cycles until this duration is over, `stop` is set, or `continues` returns false for a cycle.
    pub async fn count(
        &mut self,
        session: &Session,
        duration: Option<Duration>,
        stop: &Stop,
        mut continues: impl FnMut(&CycleRecord) -> bool,
    ) {
        let watch_stop = Stop::default();
        let mut source = session.begin_watch(duration, &watch_stop);
        until(&*session.setup.scheduler, PERIOD, || {
            if stop.is_stopped() {
                watch_stop.stop(&stop.cause());
            }
            // Read this before the ring is emptied, so that cycles before the end are still counted.
            let is_last = source.is_over();
            while let Some(record) = source.take() {
                self.add(&record);
                if !continues(&record) {
                    watch_stop.stop("nothing more to count");
                }
            }
            while let Some(event) = source.take_event() {
                self.add_event(&event);
            }
            // This call also empties the ring of timing values.
            self.timing = source.timing();
            is_last.then_some(())
        })
        .await;
    }

    fn add(&mut self, record: &CycleRecord) {
        // Cycle numbers are consecutive. If numbers are missing, the ring was full and these cycles were lost.
        let lost = record.cycle.saturating_sub(self.cycles);
        if lost > 0 {
            *self.flags.entry("lost").or_default() += lost;
            self.bad_cycles += lost;
        }
        self.cycles = record.cycle + 1;
        self.cycles_valid += u64::from(record.is_valid());
        for (_, name) in flags::NAMES.iter().filter(|(bit, _)| record.flags & bit != 0) {
            *self.flags.entry(name).or_default() += 1;
        }
        // Classify the cycle. An unsynchronised sample counts only if no other fault of this cycle or
        // the previous one explains it.
        let is_bad = record.flags & CYCLE_FLAGS != 0;
        let is_device_bad = record.flags & DEVICE_FLAGS != 0;
        let follows_bad = std::mem::replace(&mut self.was_bad, is_bad || is_device_bad) || lost > 0;
        let is_sync_error = record.encoders().iter().any(|encoder| StatusWord(encoder.status).sync_error());
        let is_unsynchronised = record.flags & flags::STALE_INPUT != 0 || is_sync_error;
        let has_other_cause = is_bad || is_device_bad || follows_bad;
        self.bad_cycles += u64::from(is_bad);
        self.device_bad_cycles += u64::from(is_device_bad);
        self.unsynchronised_cycles += u64::from(is_unsynchronised && !has_other_cause);
        self.working_counter_expected = record.working_counter_expected;
        if is_bad {
            return;
        }
        *self.working_counters.entry(record.working_counter).or_default() += 1;
        if is_device_bad {
            // An absent terminal writes no inputs, so the samples of this cycle are not counted.
            return;
        }
        // Count the samples, and compare the clocks since the first sample.
        for (figures, encoder) in self.encoders.iter_mut().zip(record.encoders()) {
            let status = StatusWord(encoder.status);
            figures.valid += u64::from(encoder.valid);
            figures.amplitude_errors += u64::from(status.amplitude_error());
            figures.frequency_errors += u64::from(status.frequency_error());
            figures.sync_errors += u64::from(status.sync_error());
            (figures.count, figures.status) = (encoder.count, encoder.status);
        }
        let clocks = &mut self.clocks;
        clocks.uncertainty_ns_max = clocks.uncertainty_ns_max.max(record.sample_time_uncertainty_ns);
        let (dc_time, sample_time) = (record.dc_time, record.sample_time);
        let (first_dc_time, first_sample_time) = *self.first_sample.get_or_insert((dc_time, sample_time));
        let (bus_ns, utc_ns) = (dc_time.ns_since(first_dc_time), sample_time.ns_since(first_sample_time));
        clocks.host_rate_ppm = (bus_ns > 0).then(|| 1e6 * (utc_ns - bus_ns) as f64 / bus_ns as f64);
    }

    fn add_event(&mut self, event: &CycleEvent) {
        if let Some(counts) = event.port_counts() {
            self.ports.retain(|port| (port.position, port.port) != (counts.position, counts.port));
            self.ports.push(counts);
        }
        let event = event.to_event(&self.names);
        let figures = self.events.entry(event.code).or_default();
        figures.count += 1;
        if figures.first.is_empty() {
            figures.first = event.text;
        }
    }

    /// Derives the checks from the figures.
    pub fn checks(
        &self,
        config: &SmokeConfig,
        wanted: CyclesConfig,
        distributed_clocks: bool,
    ) -> [(Subject, Outcome); 5] {
        let needs_replies = |outcome: Outcome| match self.working_counters.is_empty() {
            true => Outcome::NotDone { because: Reason::After(Subject::Cycles) },
            false => outcome,
        };
        let if_enabled = |is_enabled: bool, key, outcome: Outcome| match is_enabled {
            true => needs_replies(outcome),
            false => Outcome::NotDone { because: Reason::NotAsked(key) },
        };
        let allowed = (config.bad_share_max * wanted.cycles() as f64) as u64;
        let clocks = if_enabled(distributed_clocks, "distributed_clocks", self.clocks_outcome(allowed));
        [
            (Subject::Cycles, self.cycles_outcome(wanted, allowed)),
            (Subject::WorkingCounter, needs_replies(self.devices_outcome())),
            (Subject::DistributedClocks, clocks),
            (Subject::Signals, if_enabled(config.signals, "signals", self.signals_outcome(allowed))),
            (Subject::Cables, needs_replies(self.cables_outcome())),
        ]
    }

    fn cycles_outcome(&self, wanted: CyclesConfig, allowed: u64) -> Outcome {
        let bad = self.bad_cycles;
        let flagged: Vec<_> = self.flags.iter().map(|(name, count)| format!("{name} {count}")).collect();
        let found = format!("{} of {} cycles without reply, late or lost", bad, self.cycles);
        let found = if flagged.is_empty() { found } else { format!("{found} ({})", flagged.join(", ")) };
        if bad <= allowed && self.cycles >= wanted.cycles() {
            return Outcome::passed(found);
        }
        let bus = &self.names.bus;
        let problem = Problem::from(match self.flags.get("no_reply") {
            Some(_) => Fact::BusNoAnswer { bus: bus.clone() },
            None => Fact::CyclesLate {},
        });
        // Without any reply, the bus is the cause. Otherwise this PC may be late.
        let is_silent = self.flags.contains_key("no_reply") && self.working_counters.is_empty();
        let interface = if bus == SIMULATED_BUS { String::new() } else { format!(" --interface {bus}") };
        let remedy = match is_silent {
            true => problem.remedy.clone(),
            false => format!(
                "run `ballbard tune{interface}`; if this PC is not late, replace the cable to the coupler"
            ),
        };
        let expected = format!("{} cycles, of which at most {allowed} are bad", wanted.cycles());
        Outcome::Failed { expected, found, remedy, code: Some(problem.code()) }
    }

    fn devices_outcome(&self) -> Outcome {
        let bad = self.device_bad_cycles;
        let expected = self.working_counter_expected;
        if bad == 0 {
            return Outcome::passed(format!("{expected} in every reply"));
        }
        let counts: Vec<_> = self
            .working_counters
            .iter()
            .map(|(counter, replies)| format!("{counter} ({replies} replies)"))
            .collect();
        let problem = Fact::of_flags(flags::WORKING_COUNTER, &self.names.bus, Vec::new(), None).into();
        let found = format!("{bad} cycles in which a device was absent or not in OP: {}", counts.join(", "));
        Outcome::failed(format!("{expected} in every reply"), &problem, Some(found))
    }

    fn clocks_outcome(&self, allowed: u64) -> Outcome {
        let unsynchronised = self.unsynchronised_cycles;
        let jumps = self.flags.get("no_dc").copied().unwrap_or(0);
        let found = format!(
            "{unsynchronised} cycles stale or with a synchronisation error, {jumps} with a wrong bus time; clock of the host {:+.2} ppm against that of the bus, \
             sigma of sample times {:.1} us",
            self.clocks.host_rate_ppm.unwrap_or(f64::NAN),
            f64::from(self.clocks.uncertainty_ns_max) * 1e-3
        );
        if unsynchronised <= allowed && jumps <= allowed {
            return Outcome::passed(found);
        }
        Outcome::Failed {
            expected: format!("a new sample in each cycle; at most {allowed} cycles without"),
            found,
            remedy: "send the report: SYNC0 and SYNC1 do not suit these terminals, or this PC is late".into(),
            code: None,
        }
    }

    fn signals_outcome(&self, allowed: u64) -> Outcome {
        let has_errors = |encoder: &&EncoderFigures| {
            encoder.amplitude_errors > allowed || encoder.frequency_errors > allowed
        };
        let bad: Vec<_> = self.encoders.iter().filter(has_errors).collect();
        let Some(first) = bad.first() else {
            let counts: Vec<_> = self.encoders.iter().map(|encoder| encoder.count.to_string()).collect();
            return Outcome::passed(format!("last counts {}", counts.join(", ")));
        };
        let describe = |encoder: &&EncoderFigures| {
            let EncoderFigures { joint, amplitude_errors, frequency_errors, .. } = encoder;
            format!("joint {joint}: {amplitude_errors} amplitude errors, {frequency_errors} frequency errors")
        };
        let found = bad.iter().map(describe).collect::<Vec<_>>().join("; ");
        let joints = bad.iter().map(|encoder| encoder.joint).collect();
        // The last status may contain no error, although the counted cycles had one. It is omitted then.
        let status = Some(first.status).filter(|status| StatusWord(*status).has_error());
        let problem = Fact::EncoderInvalid { joints, status, valid_share: 0.0 }.into();
        Outcome::failed(
            format!("at most {allowed} cycles with an error of an encoder"),
            &problem,
            Some(found),
        )
    }

    fn cables_outcome(&self) -> Outcome {
        let problems: Vec<Problem> = self.ports.iter().map(|counts| Fact::from(*counts).into()).collect();
        let Some(first) = problems.first() else { return Outcome::passed("no port has counted an error") };
        let found = problems.iter().map(|problem| problem.text.as_str()).collect::<Vec<_>>().join("; ");
        Outcome::failed("no error of any port", first, Some(found))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_remedy_for_late_cycles_names_the_interface_of_the_bus() {
        for (bus, command) in [("eth1", "`ballbard tune --interface eth1`"), ("simulated", "`ballbard tune`")]
        {
            let names = BusNames { bus: bus.into(), ..BusNames::default() };
            let figures = Figures { cycles: 10, bad_cycles: 5, names, ..Figures::default() };
            let outcome = figures.cycles_outcome(CyclesConfig { rate_hz: 10, duration_s: 1 }, 0);
            let Outcome::Failed { remedy, .. } = outcome else { panic!("{outcome:?}") };
            assert!(remedy.contains(command), "{remedy}");
        }
    }
}
