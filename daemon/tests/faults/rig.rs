//! An acquisition on a simulated segment whose faults the test controls. The rig also has the true motion of the encoders,
//! for comparison with the records.

use std::f64::consts::TAU;
use std::time::Duration;

use ballbard::bus::{Bus, BusPlan};
use ballbard::clock::Clock;
use ballbard::cycle::{Acquisition, BusNames, CycleEvent};
use ballbard::segment::InProcessWire;
use ballbard::segment::faults::{FaultHandle, FaultySegment};
use ballbard::segment::simulated::{Periods, SegmentConfig, SimulatedSegment, SmoothMotion};
use shared::config::EncoderConfig;
use shared::recording::schema::{CycleRecord, Event};
use shared::time::UtcNs;

const TERMINALS: usize = 5;
const LINES: u32 = 3600;
const BITS: u8 = 12;
/// Largest speed of an encoder, 0.4 rad/s, in counts per second.
const COUNTS_PER_S_MAX: f64 = 0.4 / TAU * 3600.0 * 4096.0;

pub struct Rig {
    pub acquisition: Acquisition,
    pub faults: FaultHandle,
    pub clock: Clock,
    motion: SmoothMotion,
    pub records: Vec<CycleRecord>,
    pub events: Vec<CycleEvent>,
    period_ns: i64,
}

pub fn plan(period_ns: i64, distributed_clocks: bool) -> BusPlan {
    BusPlan {
        name: "simulated".into(),
        encoders: (1..=TERMINALS as u8).map(EncoderConfig::ern_1080).collect(),
        cycle_period: Duration::from_nanos(period_ns as u64),
        distributed_clocks,
        sync0_shift: Duration::from_nanos(period_ns as u64 / 2),
        reply_timeout: Duration::from_nanos(period_ns as u64 * 2 / 5),
    }
}

impl Rig {
    /// Brings the bus into OP, at 100 Hz and with distributed clocks. The next cycle is cycle 0 of a run.
    pub fn new(seed: u64) -> Self {
        Self::with(seed, 10_000_000, true)
    }

    /// Brings the bus into OP, with this period \[ns\] and with or without distributed clocks.
    pub fn with(seed: u64, period_ns: i64, distributed_clocks: bool) -> Self {
        let config = SegmentConfig { seed, ..SegmentConfig::default() };
        let motion = SmoothMotion::new(TERMINALS, LINES, seed);
        let (segment, faults) =
            FaultySegment::new(SimulatedSegment::new(&config, Box::new(motion.clone())), seed);
        let clock = Clock::virtual_from(UtcNs(0));
        let wire = InProcessWire::with_faults(segment, clock.clone());
        let plan = plan(period_ns, distributed_clocks);
        let bus = Bus::new(Box::new(wire), clock.clone(), plan.reply_timeout);
        let mut acquisition = Acquisition::start(bus, &plan, clock.clone()).unwrap();
        acquisition.begin_run(|_| ());
        Self { acquisition, faults, clock, motion, records: Vec::new(), events: Vec::new(), period_ns }
    }

    /// Runs the acquisition until it has recorded this number of cycles.
    pub fn run_to(&mut self, cycles: usize) {
        while self.records.len() < cycles {
            let records = &mut self.records;
            self.acquisition.next_cycle(&mut |record| records.push(*record));
            let told = std::iter::from_fn(|| self.acquisition.take_event());
            self.events.extend(told.filter(CycleEvent::is_news));
        }
    }

    /// All events so far, in the form in which the file stores them.
    pub fn reported_events(&self) -> Vec<Event> {
        let names = BusNames {
            bus: "simulated".into(),
            devices: self.acquisition.devices().to_vec(),
            joints: (1..=TERMINALS as u8).collect(),
        };
        self.events.iter().map(|event| event.to_event(&names)).collect()
    }

    /// Checks that each cycle that was due has exactly one record, and that the records are in order. Their times must
    /// advance with the period of the cycle.
    pub fn assert_complete(&self) {
        for (number, record) in self.records.iter().enumerate() {
            assert_eq!(record.cycle, number as u64);
        }
        for pair in self.records.windows(2) {
            let step_ns = pair[1].sample_time.ns_since(pair[0].sample_time);
            assert!(step_ns > 0, "time runs backwards at cycle {}", pair[1].cycle);
        }
        let (first, last) = (self.records.first().unwrap(), self.records.last().unwrap());
        let span_ns = last.sample_time.ns_since(first.sample_time);
        let due = 1 + (span_ns as f64 / self.period_ns as f64).round() as i64;
        // The rate error of the bus' crystal is at most 20 ppm, and the bus clock is set with an error of a few ms.
        let tolerance = 1 + span_ns / self.period_ns / 40_000;
        assert!((self.records.len() as i64 - due).abs() <= tolerance, "{due} cycles were due");
        let now = self.clock.now().plus_ns(self.acquisition.utc_minus_monotonic_ns());
        // Just after an outage, the clock of the bus may have an error. The record states the uncertainty of its time.
        let (late_ns, uncertain_ns) =
            (now.0 - last.sample_time.0, i64::from(last.sample_time_uncertainty_ns));
        assert!(
            late_ns < self.period_ns + uncertain_ns,
            "a due cycle was not given: {late_ns} ns, {uncertain_ns} ns uncertain"
        );
    }

    /// Checks all valid counts, even in cycles in which another encoder is invalid. Each count must equal the count of the
    /// simulated encoder at the sample time. After a recorded change of origin, the two may differ by a constant number of
    /// whole periods. Returns the number of valid records.
    pub fn assert_true(&self) -> usize {
        let mut origins = [Some(0i64); TERMINALS];
        let (mut valid, mut origin) = (0, 0);
        for record in &self.records {
            if std::mem::replace(&mut origin, record.origin) != record.origin {
                origins = [None; TERMINALS];
            }
            valid += usize::from(record.is_valid());
            let tolerance = 3.0 + 3e-9 * f64::from(record.sample_time_uncertainty_ns) * COUNTS_PER_S_MAX;
            // If the sample time is so uncertain that the tolerance exceeds half a signal period, the whole period of the
            // new origin cannot be determined. The count may then differ by one period.
            let tolerance = if tolerance > 2048.0 { tolerance + 4096.0 } else { tolerance };
            for (joint, (encoder, origin)) in record.encoders().iter().zip(&mut origins).enumerate() {
                if !encoder.valid {
                    continue;
                }
                let excess = f64::from(encoder.count.wrapping_sub(self.true_count(joint, record)) as i32);
                let origin = *origin.get_or_insert((excess / 4096.0).round() as i64 * 4096);
                assert!(
                    (excess - origin as f64).abs() <= tolerance,
                    "cycle {} joint {}: {} counts off, {tolerance} allowed",
                    record.cycle,
                    joint + 1,
                    excess - origin as f64,
                );
            }
        }
        valid
    }

    fn true_count(&self, joint: usize, record: &CycleRecord) -> u32 {
        let true_ns = record.sample_time.0 - self.acquisition.utc_minus_monotonic_ns();
        let turned = self.motion.angle_rad(joint, true_ns) * f64::from(LINES) / TAU;
        let position = self.motion.start_periods(joint).0 + Periods::from_f64(turned).0;
        (position >> (32 - BITS)) as u32
    }
}
