//! Compares sample times with the true sampling instants of the simulated terminals, in virtual time. The tests vary delays
//! and drift. They also wake the cycle late, and step the clocks.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};

use crate::support::{Stamped, TrueInstants, plan};
use ballbard::bus::{Bus, BusPlan};
use ballbard::clock::Clock;
use ballbard::cycle::{Acquisition, CycleEvent, Happening};
use ballbard::segment::simulated::{SegmentConfig, SimulatedSegment, SmoothMotion};
use ballbard::segment::{FRAME_BYTES_MAX, FrameWire};
use rand::{Rng, SeedableRng, rngs::StdRng};
use shared::recording::schema::{CycleRecord, flags};
use shared::time::{MonoNs, UtcNs};

/// Delays that the host adds to the delays of the wire. System calls, interrupts and a busy processor cause them. The first
/// value of a pair is for sending, the second for receiving.
#[derive(Clone, Copy)]
struct Delays {
    /// Smallest additional delay \[ns\].
    least_ns: (i64, i64),
    /// Mean of the exponentially distributed delay that is added to `least_ns` \[ns\].
    mean_ns: (f64, f64),
    /// One in this number of frames is late by a millisecond. The same number is used for replies.
    rare: u32,
}

const QUIET: Delays = Delays { least_ns: (5_000, 8_000), mean_ns: (500.0, 1_000.0), rare: u32::MAX };
const LOADED: Delays = Delays { least_ns: (6_000, 15_000), mean_ns: (10_000.0, 40_000.0), rare: 200 };
/// A network card that coalesces interrupts delays them. Therefore mainly replies are late.
const ONE_SIDED: Delays = Delays { least_ns: (5_000, 60_000), mean_ns: (1_000.0, 60_000.0), rare: 50 };

/// A simulated segment behind a host with these delays. The test can change the clocks of the segment and of the host. It can
/// also discard a frame.
struct DelayedWire {
    segment: SimulatedSegment,
    clock: Clock,
    delays: Delays,
    random: StdRng,
    faults: Arc<Faults>,
    reply: Box<[u8; FRAME_BYTES_MAX]>,
    reply_len: Option<usize>,
}

#[derive(Default)]
struct Faults {
    /// Difference between true bus time and the host's clock \[ns\]. It changes when the machine is suspended.
    leap_ns: AtomicI64,
    /// Step of the reference clock that occurs with the next frame \[ns\].
    step_ns: AtomicI64,
    /// Whether the next frame is lost.
    loses_frame: AtomicBool,
}

impl DelayedWire {
    fn wait(&mut self, least_ns: i64, mean_ns: f64) {
        let extra_ns = -mean_ns * (1.0 - self.random.random::<f64>()).ln();
        let rare_ns = if self.random.random_ratio(1, self.delays.rare) { 1_000_000 } else { 0 };
        self.clock.sleep_until(self.clock.now().plus_ns(least_ns + extra_ns as i64 + rare_ns));
    }
}

impl FrameWire for DelayedWire {
    fn send(&mut self, frame: &[u8]) -> io::Result<()> {
        if self.faults.loses_frame.swap(false, Ordering::Relaxed) {
            self.reply_len = None;
            return Ok(());
        }
        self.wait(self.delays.least_ns.0, self.delays.mean_ns.0);
        let now = self.clock.now();
        let true_ns = now.0 + self.faults.leap_ns.load(Ordering::Relaxed);
        let step_ns = self.faults.step_ns.swap(0, Ordering::Relaxed);
        if step_ns != 0 {
            self.segment.step_reference_clock(true_ns, step_ns);
        }
        self.reply_len = self.segment.exchange(true_ns, frame, &mut self.reply[..]);
        self.clock.sleep_until(now.plus_ns(self.segment.round_trip_ns(frame.len())));
        self.wait(self.delays.least_ns.1, self.delays.mean_ns.1);
        Ok(())
    }

    fn receive(&mut self, buffer: &mut [u8; FRAME_BYTES_MAX], until: MonoNs) -> io::Result<Option<usize>> {
        let Some(length) = self.reply_len.take() else {
            self.clock.sleep_until(until);
            return Ok(None);
        };
        buffer[..length].copy_from_slice(&self.reply[..length]);
        Ok(Some(length))
    }
}

struct Experiment {
    acquisition: Acquisition,
    clock: Clock,
    instants: TrueInstants,
    faults: Arc<Faults>,
    events: Vec<CycleEvent>,
    utc_minus_monotonic_ns: i64,
    period_ns: i64,
}

impl Experiment {
    fn new(plan: &BusPlan, delays: Delays, seed: u64) -> Self {
        Self::begin(plan, delays, seed, false)
    }

    /// If `loses_first` is set, the first frame after the bring-up is lost.
    fn begin(plan: &BusPlan, delays: Delays, seed: u64, loses_first: bool) -> Self {
        let clock = Clock::virtual_from(UtcNs(1_800_000_000_000_000_000));
        let config = SegmentConfig { seed, drift_ppm: 100.0, ..SegmentConfig::default() };
        let (source, instants) = TrueInstants::watch(SmoothMotion::new(5, 3600, seed), 1 << 20);
        let faults = Arc::new(Faults::default());
        let wire = DelayedWire {
            segment: SimulatedSegment::new(&config, Box::new(source)),
            clock: clock.clone(),
            delays,
            random: StdRng::seed_from_u64(seed),
            faults: Arc::clone(&faults),
            reply: Box::new([0; FRAME_BYTES_MAX]),
            reply_len: None,
        };
        let mut bus = Bus::new(Box::new(wire), clock.clone(), plan.reply_timeout);
        let operational = bus.bring_up(plan).unwrap();
        faults.loses_frame.store(loses_first, Ordering::Relaxed);
        let mut acquisition = Acquisition::on(bus, operational, plan, clock.clone());
        acquisition.begin_run(|_| ());
        let utc_minus_monotonic_ns = acquisition.utc_minus_monotonic_ns();
        let period_ns = plan.cycle_period.as_nanos() as i64;
        let events = Vec::new();
        Self { acquisition, clock, instants, faults, events, utc_minus_monotonic_ns, period_ns }
    }

    fn cycles(&mut self, count: usize) -> Vec<CycleRecord> {
        self.cycles_woken_late(count, || 0)
    }

    /// Records `count` cycles. `late_ns` is called for each cycle, and returns by how much the cycle wakes late \[ns\].
    fn cycles_woken_late(&mut self, count: usize, mut late_ns: impl FnMut() -> i64) -> Vec<CycleRecord> {
        let mut records: Vec<CycleRecord> = Vec::new();
        while records.len() < count {
            let late_ns = late_ns();
            if let Some(last) = records.last().filter(|_| late_ns > 0) {
                self.clock.sleep_until(last.send_time.plus_ns(self.period_ns + late_ns));
            }
            self.acquisition.next_cycle(&mut |record| records.push(*record));
            self.events.extend(std::iter::from_fn(|| self.acquisition.take_event()));
        }
        for pair in records.windows(2) {
            assert!(pair[1].cycle == pair[0].cycle + 1, "{pair:?}");
            assert!(pair[1].sample_time > pair[0].sample_time, "{pair:?}");
        }
        records
    }

    fn judge(&self, records: &[CycleRecord]) -> Vec<Stamped> {
        let leap_ns = self.faults.leap_ns.load(Ordering::Relaxed);
        self.instants.judge(records, self.utc_minus_monotonic_ns - leap_ns)
    }
}

/// The 99.9th percentile of the absolute errors \[ns\].
fn p999_ns(stamped: &[Stamped]) -> i64 {
    let mut sizes_ns: Vec<i64> = stamped.iter().map(|one| one.error_ns.abs()).collect();
    sizes_ns.sort_unstable();
    sizes_ns[sizes_ns.len() * 999 / 1000]
}

fn assert_within(stamped: &[Stamped], sigmas: i64) {
    for one in stamped {
        assert!(one.error_ns.abs() < sigmas * one.sigma_ns, "{one:?}");
    }
}

#[test]
fn sample_times_are_right_within_their_uncertainty_on_quiet_and_loaded_hosts() {
    // The last column is a limit for the uncertainties in the records. Uncertainties that are too large would be useless.
    for (delays, bound_ns, sigma_bound_ns) in
        [(QUIET, 3_000, 10_000), (LOADED, 20_000, 40_000), (ONE_SIDED, 50_000, 60_000)]
    {
        for seed in 0..3 {
            let mut experiment = Experiment::new(&plan(100), delays, seed);
            let mut random = StdRng::seed_from_u64(seed);
            // Some wake-ups are late. A few of them are so late that the next sample has been taken.
            let late_ns = || if random.random_ratio(1, 50) { random.random_range(0..8_000_000) } else { 0 };
            let records = experiment.cycles_woken_late(5_000, late_ns);
            let stamped = experiment.judge(&records);
            assert!(stamped.len() > 4_700, "{}", stamped.len());
            assert!(p999_ns(&stamped) < bound_ns, "seed {seed}: {} ns", p999_ns(&stamped));
            assert_within(&stamped, 3);
            let sigma_ns = stamped.iter().map(|one| one.sigma_ns).max().unwrap();
            assert!(sigma_ns < sigma_bound_ns, "seed {seed}: {sigma_ns} ns, not below {sigma_bound_ns}");
            assert!(!experiment.events.iter().any(|event| matches!(event.what, Happening::Down(_))));
        }
    }
}

#[test]
fn a_frame_that_meets_the_conversion_of_the_next_sample_is_flagged_as_late() {
    let mut experiment = Experiment::new(&plan(100), QUIET, 5);
    let mut cycles = 0;
    // Each fifth frame is sent about half a period late. At that time the next SYNC0 occurs, or its conversion ends.
    let late_ns = || {
        cycles += 1;
        if cycles % 5 == 0 { 4_960_000 + 100 * cycles } else { 0 }
    };
    let records = experiment.cycles_woken_late(1_000, late_ns);
    let is_late = |record: &CycleRecord| record.flags & flags::DEADLINE_MISSED != 0;
    for pair in records.windows(2) {
        assert!(is_late(&pair[0]) || is_late(&pair[1]) || pair[1].is_valid(), "{pair:?}");
    }
    let late = records.iter().filter(|record| is_late(record)).count();
    assert!((50..200).contains(&late), "{late}");
    assert_within(&experiment.judge(&records), 3);
}

#[test]
fn at_250_hz_and_1_khz_every_cycle_is_sampled_and_stamped_like_at_100() {
    for rate_hz in [250, 1000] {
        let mut experiment = Experiment::new(&plan(rate_hz), QUIET, 7);
        let records = experiment.cycles(20_000);
        assert!(records.iter().all(|record| record.is_valid() && record.flags == 0));
        let stamped = experiment.judge(&records);
        assert_eq!(stamped.len(), records.len());
        assert!(p999_ns(&stamped) < 3_000, "{rate_hz} Hz: {} ns", p999_ns(&stamped));
        assert_within(&stamped, 3);
    }
}

#[test]
fn the_first_frame_may_be_lost() {
    let mut experiment = Experiment::begin(&plan(100), QUIET, 7, true);
    let records = experiment.cycles(1_000);
    let stamped = experiment.judge(&records);
    assert_eq!(stamped.len(), records.len());
    assert!(p999_ns(&stamped) < 3_000, "{} ns", p999_ns(&stamped));
    assert_within(&stamped, 3);
}

#[test]
fn a_step_of_the_reference_clock_is_reported_whatever_its_size_and_no_time_is_wrong_unsaid() {
    for step_ns in [15_000, -50_000, 90_000, -300_000, 3_000_000, -2_000_000_000] {
        let mut experiment = Experiment::new(&plan(100), QUIET, 2);
        let mut records = experiment.cycles(500);
        experiment.faults.step_ns.store(step_ns, Ordering::Relaxed);
        records.extend(experiment.cycles(500));
        let told = |event: &CycleEvent| match event.what {
            Happening::ClockStep { by_ns } => Some(by_ns),
            _ => None,
        };
        let steps: Vec<i64> = experiment.events.iter().filter_map(told).collect();
        let [found_ns] = steps[..] else { panic!("{step_ns}: {steps:?}") };
        assert!((found_ns - step_ns).abs() < 2_000 + step_ns.abs() / 20, "{found_ns} instead of {step_ns}");
        assert_within(&experiment.judge(&records), 3);
        assert!(records[800..].iter().all(CycleRecord::is_valid), "{step_ns}");
        assert!(p999_ns(&experiment.judge(&records[800..])) < 3_000, "{step_ns}");
    }
}

#[test]
fn after_a_suspended_host_times_go_on_forwards_and_are_right_again() {
    let mut experiment = Experiment::new(&plan(100), QUIET, 3);
    let before = experiment.cycles(500);
    experiment.faults.leap_ns.store(370_000_000, Ordering::Relaxed);
    let records = experiment.cycles(500);
    assert!(records[0].sample_time > before[499].sample_time);
    assert!(records[300..].iter().all(CycleRecord::is_valid));
    let stamped = experiment.judge(&records[300..]);
    assert_within(&stamped, 3);
    assert!(p999_ns(&stamped) < 3_000, "{} ns", p999_ns(&stamped));
}

#[test]
fn a_host_whose_utc_is_stepped_keeps_the_times_of_a_run() {
    let mut experiment = Experiment::new(&plan(100), QUIET, 4);
    let mut records = experiment.cycles(300);
    for step_ns in [-3_600_000_000_000, 7_200_000_000_000] {
        experiment.clock.step_utc(step_ns);
        records.extend(experiment.cycles(300));
    }
    for pair in records.windows(2) {
        let step_ns = pair[1].sample_time.ns_since(pair[0].sample_time);
        assert!((9_900_000..10_100_000).contains(&step_ns), "{pair:?}");
    }
    let stamped = experiment.judge(&records);
    assert_eq!(stamped.len(), 900);
    assert!(p999_ns(&stamped) < 3_000, "{} ns", p999_ns(&stamped));
}

#[test]
fn without_distributed_clocks_the_age_is_bounded_and_says_so() {
    let free_running = BusPlan { distributed_clocks: false, ..plan(100) };
    let mut experiment = Experiment::new(&free_running, LOADED, 5);
    let records = experiment.cycles(500);
    for record in &records {
        assert!(record.flags & flags::NO_DC != 0 && record.dc_time.0 == 0);
        // The true age is uniformly distributed over one period. The width of this distribution follows from the standard
        // deviation in the record.
        let width_ns = f64::from(record.sample_time_uncertainty_ns) * 12f64.sqrt();
        assert!((9_999_000.0..10_001_000.0).contains(&width_ns), "{width_ns}");
    }
    let stamped = experiment.instants.judge_free_running(&records, experiment.utc_minus_monotonic_ns);
    assert!(stamped.len() > 450, "{}", stamped.len());
    assert_within(&stamped, 2);
}
