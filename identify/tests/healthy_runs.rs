//! Runs without faults must not be refused. The set-ups of robot and bar in these runs were not used in
//! the development of the preparation.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use crate::support::{bar, irb2400, nj220};
use identify::prepare::{PrepareOptions, prepare};
use identify::simulate::{self, Clocks, Design, Effects, Experiment, Simulated, StaticErrors};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use shared::config::{BallBarConfig, RobotConfig};
use shared::time::UtcNs;

/// A run with random link errors, base position, base tilt and clocks. Errors of gears and gratings are four
/// times as large as usual.
fn worn(robot: &RobotConfig, bar: &BallBarConfig, seed: u64) -> Simulated {
    let mut random = ChaCha8Rng::seed_from_u64(77_000 + seed);
    let mut between = |low: f64, high: f64| random.random_range(low..high);
    let effects = Effects {
        robot_noise_urad: between(5.0, 30.0),
        encoder_noise_urad: between(2.0, 15.0),
        gear_sine_urad: 4.0 * between(20.0, 80.0),
        cycloid_urad: 4.0 * between(0.0, 40.0),
        encoder_eccentricity_urad: 4.0 * between(20.0, 80.0),
        encoder_ellipticity_urad: 4.0 * between(0.0, 30.0),
        base_tilt_urad: between(-10_000.0, 10_000.0).abs(),
        ..Effects::NONE
    };
    let clocks = Clocks {
        bar_start: UtcNs(1_780_000_000_000_000_000),
        robot_at_bar_start_ns: between(0.0, 7e12) as i64,
        skew: between(-80e-6, 80e-6),
    };
    let mut design = Design::for_robot(robot);
    for base_m in &mut design.base_m {
        *base_m += between(-0.1, 0.1);
    }
    let errors = StaticErrors::Drawn { seed: 500 + seed };
    let experiment =
        Experiment { seed: 900 + seed, errors, effects, clocks, design, ..Experiment::new(robot, bar) };
    simulate::run(&experiment).unwrap()
}

#[test]
fn what_worn_gears_do_to_the_angles_is_no_slip() {
    let bar = bar();
    for robot in [irb2400(), nj220()] {
        for seed in 1..=3 {
            let run = worn(&robot, &bar, seed);
            let found =
                prepare(&run.cycles, &run.encoders, &run.robot_log, &robot, &bar, &PrepareOptions::default());
            assert!(found.is_ok(), "{} {seed}: {}", robot.name, found.unwrap_err());
        }
    }
}

/// The robot log begins after the recording and ends before the end of the recording. During the search for the time shift,
/// the first samples are therefore outside the log.
#[test]
#[ignore = "several calibrations: a quarter of a minute"]
fn a_robot_log_that_is_shorter_than_the_recording_is_aligned_as_well() {
    let bar = bar();
    for robot in [irb2400(), nj220()] {
        for seed in 1..=4 {
            let design = Design { duration_s: 60.0, ..Design::for_robot(&robot) };
            let errors = StaticErrors::Drawn { seed };
            let mut run =
                simulate::run(&Experiment { seed, errors, design, ..Experiment::new(&robot, &bar) }).unwrap();
            let log = &mut run.robot_log;
            log.q_rad = log.q_rad.slice(250 + 7 * seed as usize..log.q_rad.len() - 500).into();
            let found =
                prepare(&run.cycles, &run.encoders, &run.robot_log, &robot, &bar, &PrepareOptions::default())
                    .unwrap();
            let truth_ns = run.truth.clock.robot_ns(found.t_ref) - found.t_ref.0;
            let error_ms = (found.alignment.clock_difference_ns - truth_ns) as f64 * 1e-6;
            assert!(error_ms.abs() < 0.2, "{} {seed}: {error_ms} ms", robot.name);
            assert!(found.offsets.iter().all(|one| one.spread_rad < 50e-6), "{:?}", found.offsets);
        }
    }
}
