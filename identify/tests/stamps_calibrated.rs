//! Calibrations from logs with the stamps of real controllers must be as accurate as with perfect stamps.
//!
//! `cargo test -p identify --test all stamps_calibrated -- --include-ignored --nocapture` prints the table. With
//! `IDENTIFY_SEEDS=6`, six runs are evaluated for each row of the table.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "figures of a run")]

use identify::calibrate::{IdentifyConfig, calibrate_run};
use identify::logs::RobotLog;
use identify::model::ParameterId;
use identify::prepare::{PrepareOptions, prepare};
use identify::simulate::Comparison;
use identify::simulate::{self, Clocks, Effects, Experiment, Simulated};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal};

use crate::support::stamped::{resampled, stamped};
use crate::support::{bar, irb2400};

/// Relation of a stamp to the time of its sample.
#[derive(Debug, Clone, Copy)]
enum Stamp {
    Exact,
    /// Rounded down to a multiple of this time \[ms\].
    Floor(f64),
    /// Rounded to the nearest multiple of this time \[ms\].
    Nearest(f64),
    /// Random error with this standard deviation \[ms\].
    Jittered(f64),
}

/// A row of the table: properties of the stamps of a log.
#[derive(Debug, Clone, Copy)]
struct Case {
    stamp: Stamp,
    rate_hz: f64,
    /// Rate of the robot's clock minus one \[%\].
    skew_percent: f64,
    /// Rate of the stamping clock relative to the sampling clock, minus one \[ppm\].
    stamp_ppm: f64,
    /// Percentage of rows that are missing.
    missing_percent: f64,
    decimals: usize,
}

const PERFECT: Case = Case {
    stamp: Stamp::Exact,
    rate_hz: 250.0,
    skew_percent: 0.0025,
    stamp_ppm: 0.0,
    missing_percent: 0.0,
    decimals: 9,
};

/// A log whose stamps come from another clock than its sampling times.
const STAMPED: Case = Case { stamp_ppm: 50.0, ..PERFECT };

const fn rounded(stamp: Stamp) -> Case {
    Case { stamp, ..STAMPED }
}

const fn clock_off(skew_percent: f64) -> Case {
    Case { skew_percent, ..PERFECT }
}

const fn incomplete(stamp: Stamp, missing_percent: f64) -> Case {
    Case { stamp, missing_percent, ..STAMPED }
}

const fn sampled(rate_hz: f64, stamp: Stamp) -> Case {
    Case { rate_hz, stamp, ..STAMPED }
}

/// Rates, resolutions, gaps and clocks that controllers have.
const CASES: [Case; 26] = [
    rounded(Stamp::Floor(4.0)),
    rounded(Stamp::Nearest(4.0)),
    Case { skew_percent: 0.1, ..rounded(Stamp::Floor(4.0)) },
    Case { skew_percent: -1.0, ..rounded(Stamp::Nearest(4.0)) },
    rounded(Stamp::Floor(1.0)),
    rounded(Stamp::Floor(10.0)),
    rounded(Stamp::Nearest(10.0)),
    Case { decimals: 2, ..STAMPED },
    rounded(Stamp::Jittered(2.0)),
    incomplete(Stamp::Floor(1.0), 1.0),
    incomplete(Stamp::Floor(1.0), 5.0),
    incomplete(Stamp::Floor(4.0), 0.01),
    incomplete(Stamp::Floor(4.0), 1.0),
    incomplete(Stamp::Exact, 5.0),
    // One clock determines sampling times and stamps, so all stamps are whole cycles.
    Case { stamp_ppm: 0.0, ..incomplete(Stamp::Nearest(4.0), 1.0) },
    Case { stamp_ppm: 0.0, ..incomplete(Stamp::Nearest(4.0), 5.0) },
    clock_off(0.01),
    clock_off(0.1),
    clock_off(-0.5),
    clock_off(1.0),
    sampled(1000.0 / 12.0, Stamp::Exact),
    sampled(1000.0 / 12.0, Stamp::Nearest(1.0)),
    sampled(1000.0 / 12.0, Stamp::Nearest(10.0)),
    sampled(4000.0 / 9.0, Stamp::Nearest(1.0)),
    sampled(4000.0 / 9.0, Stamp::Floor(12.0)),
    Case { skew_percent: 1.0, ..sampled(4000.0 / 9.0, Stamp::Floor(12.0)) },
];

impl Case {
    fn run(&self, seed: u64) -> Simulated {
        let clocks = Clocks { skew: self.skew_percent * 1e-2, ..Clocks::default() };
        let (robot, bar) = (irb2400(), bar());
        let experiment =
            Experiment { seed, clocks, effects: Effects::LABORATORY, ..Experiment::new(&robot, &bar) };
        simulate::run(&experiment).unwrap()
    }

    fn log(&self, run: &Simulated, seed: u64) -> RobotLog {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        let is_other = self.rate_hz != PERFECT.rate_hz;
        let log = if is_other { resampled(&run.robot_log, self.rate_hz) } else { run.robot_log.clone() };
        let first_s = log.q_rad.first_stamp_ns as f64 * 1e-9;
        let jitter = Normal::new(0.0, 1e-3).unwrap();
        let mut last_s = f64::MIN;
        let mut stamp = |t_s: f64| {
            let t_s = first_s + t_s * (1.0 + self.stamp_ppm * 1e-6);
            let stamp_s = match self.stamp {
                Stamp::Exact => t_s,
                Stamp::Floor(step_ms) => (t_s / step_ms * 1e3).floor() * step_ms * 1e-3,
                Stamp::Nearest(step_ms) => (t_s / step_ms * 1e3).round() * step_ms * 1e-3,
                Stamp::Jittered(by_ms) => t_s + by_ms * jitter.sample(&mut random),
            };
            last_s = last_s.max(stamp_s);
            (!random.random_bool(self.missing_percent * 1e-2)).then_some(last_s)
        };
        let stamps_s: Vec<Option<f64>> = log.q_rad.t_s.iter().map(|t_s| stamp(*t_s)).collect();
        stamped(&log, &irb2400(), stamps_s, self.decimals)
    }

    /// Error of the robot's parameters after a calibration \[mm|mrad\], or the reason why the calibration failed.
    fn calibrated(&self, seed: u64) -> Result<f64, String> {
        let run = self.run(seed);
        let log = self.log(&run, seed);
        let config = IdentifyConfig::default();
        calibrate_run(&run.cycles, &run.encoders, &log, &irb2400(), &bar(), &config)
            .map(|found| {
                let all = Comparison::new(&found, &run.truth);
                all.only(|id| matches!(id, ParameterId::Robot { .. })).euclidean_mm_mrad()
            })
            .map_err(|error| error.to_string())
    }
}

#[test]
fn a_clock_that_is_off_by_up_to_one_percent_has_another_rate() {
    for skew_percent in [-1.0, -0.1, 0.1, 0.3, 1.0] {
        let run = clock_off(skew_percent).run(1);
        let options = PrepareOptions::default();
        let found = prepare(&run.cycles, &run.encoders, &run.robot_log, &irb2400(), &bar(), &options);
        let rate = found.unwrap().alignment.skew;
        assert!((rate - skew_percent * 1e-2).abs() < 1e-5, "{skew_percent} %: {rate}");
    }
}

#[test]
#[ignore = "some thirty calibrations: a minute"]
fn what_controllers_write_calibrates_as_perfect_stamps_do() {
    let seeds: u64 = std::env::var("IDENTIFY_SEEDS").map_or(1, |seeds| seeds.parse().unwrap());
    let mut wrong = Vec::new();
    for seed in 1..=seeds {
        let perfect = PERFECT.calibrated(seed).unwrap();
        println!("perfect stamps: {perfect:.4} mm|mrad");
        for case in CASES {
            let found = case.calibrated(seed);
            println!("{seed} {case:?}: {found:.4?}");
            if found.as_ref().map_or(true, |error| *error > LIMIT_MM_MRAD) {
                wrong.push((seed, case, found));
            }
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// Largest permitted error \[mm|mrad\]. With perfect stamps, errors are 0.007 to 0.034. They depend on the rate of the
/// clock, because each rate leads to a different run.
const LIMIT_MM_MRAD: f64 = 0.04;
