//! Alignment of recording and robot log for any clocks, offsets and configuration of the bar. Logs that do
//! not belong together are refused.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::f64::consts::TAU;

use crate::support::{bar, irb2400, nj220};
use identify::kinematics::{Configuration, Joints, Side};
use identify::logs::{RobotLog, Stream};
use identify::model::RobotMotion;
use identify::prepare::{ComparedLog, PrepareError, PrepareOptions, Prepared, SampleStatus, prepare};
use identify::simulate::{self, Clocks, Design, Effects, Experiment, Simulated};
use shared::config::{BallBarConfig, RobotConfig};
use shared::encoder::Direction;
use shared::recording::schema::flags;
use shared::time::UtcNs;

const DAY_NS: i64 = 86_400_000_000_000;

fn short(robot: &RobotConfig) -> Design {
    Design { duration_s: 60.0, ..Design::for_robot(robot) }
}

fn clocks(shift_ns: i64, skew: f64) -> Clocks {
    let bar_start = Clocks::default().bar_start;
    Clocks { bar_start, robot_at_bar_start_ns: bar_start.0 + shift_ns, skew }
}

fn run(robot: &RobotConfig, bar: &BallBarConfig, change: impl Fn(&mut Experiment<'_>)) -> Simulated {
    let mut experiment = Experiment { design: short(robot), ..Experiment::new(robot, bar) };
    change(&mut experiment);
    simulate::run(&experiment).unwrap()
}

fn prepared(run: &Simulated, robot: &RobotConfig, bar: &BallBarConfig) -> Result<Prepared, PrepareError> {
    prepare(&run.cycles, &run.encoders, &run.robot_log, robot, bar, &PrepareOptions::default())
}

fn refusal(run: &Simulated, robot: &RobotConfig, bar: &BallBarConfig) -> String {
    prepared(run, robot, bar).unwrap_err().to_string()
}

/// Error of the estimated clock difference at the reference time \[ms\].
fn clock_error_ms(found: &Prepared, run: &Simulated) -> f64 {
    let truth = &run.truth.clock;
    // Compute in integers, except for the small drift, because the clocks may count nanoseconds since
    // 1970, which an f64 cannot represent.
    let passed_ns = found.t_ref.ns_since(truth.bar_start);
    let difference_ns = truth.robot_at_bar_start_ns - truth.bar_start.0;
    let drift_ns = passed_ns as f64 * truth.skew;
    ((found.alignment.clock_difference_ns - difference_ns) as f64 - drift_ns) * 1e-6
}

/// Largest error of the encoder offsets \[mrad\].
fn offset_error_mrad(found: &Prepared, run: &Simulated) -> f64 {
    assert_eq!(run.truth.encoders.len(), found.offsets.len());
    let errors = run.truth.encoders.iter().map(|truth| {
        let offset = found.offsets.iter().find(|offset| offset.joint == truth.joint).unwrap();
        let expected = truth.offset_rad + run.truth.error(&format!("btheta{}", truth.joint));
        let error = offset.offset_rad - expected;
        (error - (error / TAU).round() * TAU).abs() * 1e3
    });
    errors.fold(0.0, f64::max)
}

fn check(found: &Prepared, run: &Simulated, case: &str) {
    check_within(found, run, case, [2.0, 5.0]);
}

fn check_within(found: &Prepared, run: &Simulated, case: &str, [clock_ms_max, offsets_mrad_max]: [f64; 2]) {
    let (clock_ms, offsets_mrad) = (clock_error_ms(found, run), offset_error_mrad(found, run));
    println!(
        "{case}: clock {clock_ms:.3} ms, skew {:.0} ppm, offsets {offsets_mrad:.2} mrad, correlation {:.4}, next {:.3}",
        found.alignment.skew * 1e6,
        found.alignment.correlation,
        found.alignment.runner_up
    );
    assert!(clock_ms.abs() < clock_ms_max, "{case}: {clock_ms} ms");
    assert!(offsets_mrad < offsets_mrad_max, "{case}: {offsets_mrad} mrad");
}

#[test]
#[ignore = "takes more than four seconds"]
fn any_clock_difference_is_found_with_five_encoders_and_with_four_and_whichever_way_they_count() {
    for robot in [irb2400(), nj220()] {
        for (case, (shift_ns, skew)) in
            [(-3_600_000_000_000, 25e-6), (400_000_000, 80e-6), (-9_000 * DAY_NS, -80e-6)]
                .into_iter()
                .enumerate()
        {
            let mut bar = bar();
            if case > 0 {
                bar.encoders.remove(2);
                bar.encoders[0].direction = Direction::Negative;
                bar.encoders[3].direction = Direction::Negative;
                bar.encoders.swap(0, 2);
            }
            let run = run(&robot, &bar, |e| (e.clocks, e.seed) = (clocks(shift_ns, skew), case as u64 + 1));
            let found = prepared(&run, &robot, &bar).unwrap();
            check(&found, &run, &format!("{} shift {} s", robot.name, shift_ns / 1_000_000_000));
        }
    }
}

#[test]
fn noise_tilt_and_gear_errors_leave_the_alignment_within_its_bounds() {
    let (robot, bar) = (irb2400(), bar());
    let effects = Effects {
        robot_noise_urad: 50.0,
        encoder_noise_urad: 75.0,
        gear_sine_urad: 100.0,
        encoder_eccentricity_urad: 100.0,
        base_tilt_urad: 2000.0,
        ..Effects::default()
    };
    let run = run(&robot, &bar, |e| e.effects = effects);
    check(&prepared(&run, &robot, &bar).unwrap(), &run, "all effects");
}

#[test]
fn ten_minutes_with_a_fast_clock_are_aligned_to_their_ends() {
    let (robot, bar) = (irb2400(), bar());
    let run = run(&robot, &bar, |e| {
        e.design.duration_s = 600.0;
        e.clocks = clocks(5 * DAY_NS, 80e-6);
    });
    let found = prepared(&run, &robot, &bar).unwrap();
    check(&found, &run, "ten minutes");
    assert!((found.alignment.skew - 80e-6).abs() < 20e-6, "{}", found.alignment.skew);
}

#[test]
fn a_recording_of_a_part_of_the_log_is_placed_in_it() {
    let (robot, bar) = (irb2400(), bar());
    let mut run = run(&robot, &bar, |e| e.design.duration_s = 120.0);
    run.cycles = run.cycles[7000..9500].to_vec();
    // In so short a motion, errors of the nominal robot have a larger effect on the result.
    check_within(&prepared(&run, &robot, &bar).unwrap(), &run, "a part", [5.0, 8.0]);
}

#[test]
#[ignore = "takes more than four seconds"]
fn each_configuration_of_the_bar_is_recognised() {
    /// Offsets of joints 2 and 4 in the bar's file \[deg\].
    const THETA_DEG: [(usize, f64); 2] = [(1, 20.0), (3, -30.0)];
    let (robot, mut bar) = (irb2400(), bar());
    for (joint, theta_deg) in THETA_DEG {
        bar.links[joint].theta_deg += theta_deg;
    }
    for wanted in Configuration::ALL {
        let run = run(&robot, &bar, |e| {
            for (joint, side) in [(1, wanted.gimbal), (3, wanted.cardan)] {
                let [low, high] = e.design.bar_range_deg[joint];
                if side == Side::Negative {
                    e.design.bar_range_deg[joint] = [-high, -low];
                }
            }
            for (joint, theta_deg) in THETA_DEG {
                e.design.bar_range_deg[joint] = e.design.bar_range_deg[joint].map(|deg| deg - theta_deg);
            }
        });
        // In another configuration of the bar, the offsets of two joints differ by half a turn.
        check(&prepared(&run, &robot, &bar).unwrap(), &run, &format!("{wanted:?}"));
    }
}

#[test]
fn observations_carry_the_true_joints_and_the_motion_the_true_robot() {
    let (robot, bar) = (irb2400(), bar());
    let run = run(&robot, &bar, |_| {});
    let found = prepared(&run, &robot, &bar).unwrap();
    assert!(found.observations.len() <= 1500 && found.observations.len() > 1000);
    assert_eq!(found.counts.of(SampleStatus::Kept), found.observations.len());
    let since_start_s = found.t_ref.seconds_since(run.truth.clock.bar_start);
    let late_s = clock_error_ms(&found, &run) * 1e-3;
    for observation in &found.observations {
        let t_s = since_start_s + observation.t_s;
        let bar_joints = run.motion.path.at(t_s);
        for encoder in &run.truth.encoders {
            let joint = usize::from(encoder.joint) - 1;
            let error = observation.bar_rad[joint] + encoder.offset_rad - bar_joints[joint];
            assert!((error - (error / TAU).round() * TAU).abs() < 0.3e-6);
        }
        // The interpolated motion is that of the true robot, except for the error of the alignment.
        let tau_s = observation.t_s * (1.0 + run.truth.clock.skew) - late_s;
        let state = found.motion.at(tau_s).unwrap();
        let pose = run.motion.robot.forward(&state.q);
        assert!((pose.translation.vector - run.motion.pose(t_s).translation.vector).norm() < 2e-6);
    }
    let first = found.observations.first().unwrap().t_s;
    assert!((found.observations.last().unwrap().t_s + first).abs() < 10.0, "t_ref is in the middle");
}

#[test]
fn bad_cycles_are_dropped_and_counted_and_a_new_origin_begins_a_new_run() {
    let (robot, bar) = (irb2400(), bar());
    let mut run = run(&robot, &bar, |_| {});
    for cycle in &mut run.cycles[500..520] {
        cycle.flags = flags::STALE_INPUT;
        cycle.encoders[1].valid = false;
    }
    run.cycles[900].sample_time = run.cycles[899].sample_time;
    for cycle in run.cycles.iter_mut().skip(4500) {
        cycle.encoders[0].count = cycle.encoders[0].count.wrapping_add(123_456);
        cycle.origin = 1;
    }
    let found = prepared(&run, &robot, &bar).unwrap();
    check(&found, &run, "with losses");
    let count = |status| found.counts.of(status);
    assert_eq!(found.counts.recorded(), 6001);
    assert_eq!((count(SampleStatus::Invalid), count(SampleStatus::TimeNotIncreasing)), (20, 1));
    assert_eq!(count(SampleStatus::OtherOrigin), 0);
    let [first, second] = found.origins[..] else { panic!("{:?}", found.origins) };
    assert!(first.used && second.used && !second.unchanged && first.shift_rad == [0.0; 5]);
    let moved = -123_456.0 * run.encoders[0].scale.rad_per_count();
    let error = second.shift_rad[0] - moved;
    assert!((error - (error / TAU).round() * TAU).abs() < 3e-6, "{second:?} {moved}");
    assert!(second.shift_rad[1..].iter().all(|shift| shift.abs() < 3e-6), "{second:?}");
    assert_eq!(count(SampleStatus::Outlier), 0);
    assert!(count(SampleStatus::Standstill) > 300);
}

/// Each origin has five parameters. A solve with thousands of origins would take hours.
#[test]
fn counters_that_start_anew_all_the_time_are_refused_at_once() {
    let (robot, bar) = (irb2400(), bar());
    let mut run = run(&robot, &bar, |_| {});
    for (number, cycle) in run.cycles.iter_mut().enumerate() {
        cycle.origin = number as u32 / 20;
    }
    let message = refusal(&run, &robot, &bar);
    assert!(
        message.contains("at 300 places, at most 60") && message.contains("interpolation_bits"),
        "{message}"
    );
}

#[test]
fn stamps_in_bunches_are_named_where_they_leave_no_speed_to_compare() {
    let (robot, bar) = (irb2400(), bar());
    let mut run = run(&robot, &bar, |_| {});
    let first = run.cycles[0].sample_time;
    for (number, cycle) in run.cycles.iter_mut().enumerate() {
        let number = number as i64;
        cycle.sample_time = first.plus_ns((number - number % 10) * 10_000_000 + number % 10 * 100);
    }
    let message = refusal(&run, &robot, &bar);
    assert!(message.contains("cannot be compared") && message.contains("bunches"), "{message}");
}

#[test]
fn two_logs_of_the_same_motion_done_twice_are_matched_over_their_whole_length() {
    let (robot, bar) = (irb2400(), bar());
    let mut run = run(&robot, &bar, |_| {});
    let pause_ns = 70_000_000_000;
    let again: Vec<_> = run
        .cycles
        .iter()
        .map(|cycle| {
            let mut cycle = *cycle;
            cycle.sample_time = cycle.sample_time.plus_ns(pause_ns);
            cycle
        })
        .collect();
    run.cycles.extend(again);
    let log = &mut run.robot_log;
    let again = log.q_rad.clone();
    let late = again.t_s.iter().map(|t| t + pause_ns as f64 * 1e-9 * (1.0 + 25e-6));
    log.q_rad.t_s.extend(late);
    log.q_rad.rows.extend(&*again.rows);
    let found = prepared(&run, &robot, &bar).unwrap();
    check(&found, &run, "twice");
    assert!(found.alignment.ambiguous && found.alignment.runner_up > 0.97);
}

#[test]
fn logs_that_do_not_overlap_or_are_of_other_runs_are_refused() {
    let (robot, bar) = (irb2400(), bar());
    let whole = run(&robot, &bar, |e| e.design.duration_s = 120.0);
    let mut apart = whole.clone();
    apart.cycles.truncate(5500);
    let q_rad = &apart.robot_log.q_rad;
    apart.robot_log.q_rad = q_rad.slice(q_rad.t_s.partition_point(|&t| t <= 62.0)..q_rad.len()).into();
    let message = refusal(&apart, &robot, &bar);
    println!("no overlap: {message}");
    assert!(message.contains("do not match at any clock difference"), "{message}");
    for seed in 2..6 {
        let mut other = whole.clone();
        other.robot_log = run(&robot, &bar, |e| e.seed = seed).robot_log;
        let message = refusal(&other, &robot, &bar);
        println!("other run: {message}");
        assert!(message.contains("different runs"), "{message}");
    }
}

#[test]
fn that_the_bar_came_off_is_a_cause_beside_a_recording_alone() {
    let message =
        |other| PrepareError::NoMatch { other, correlation: 0.3, overlap_s: 20.0, needed: 0.9 }.to_string();
    let [recording, tracker] = [ComparedLog::Recording, ComparedLog::Tracker].map(message);
    assert!(recording.starts_with("robot log and recording do not match"), "{recording}");
    assert!(tracker.starts_with("robot log and tracker's log do not match"), "{tracker}");
    assert!(
        recording.contains("bar came off") && !tracker.contains("bar came off"),
        "{recording}\n{tracker}"
    );
}

#[test]
fn another_robot_or_another_rod_is_refused() {
    let (robot, bar) = (irb2400(), bar());
    let run = run(&robot, &bar, |_| {});
    let message = refusal(&run, &robot, &BallBarConfig { length_m: 0.9, ..bar.clone() });
    assert!(message.contains("sphere of 59") && message.contains("900 mm"), "{message}");
    let message = refusal(&run, &nj220(), &bar);
    assert!(message.contains("one sphere"), "{message}");
}

#[test]
fn logs_without_motion_too_short_or_without_valid_cycles_are_refused() {
    let (robot, bar) = (irb2400(), bar());
    let run = run(&robot, &bar, |_| {});
    let mut still = run.clone();
    still.cycles.truncate(200);
    assert!(matches!(
        prepared(&still, &robot, &bar),
        Err(PrepareError::NoMotion { what: "the recording", .. })
    ));
    let mut still = run.clone();
    let first = still.robot_log.q_rad[0];
    still.robot_log.q_rad.fill(first);
    assert!(matches!(
        prepared(&still, &robot, &bar),
        Err(PrepareError::NoMotion { what: "the robot log", .. })
    ));
    let mut short = run.clone();
    short.cycles.truncate(800);
    assert!(matches!(
        prepared(&short, &robot, &bar),
        Err(PrepareError::TooShort { what: "the recording", .. })
    ));
    let mut stepped = run.clone();
    for cycle in &mut stepped.cycles[3000..] {
        cycle.sample_time = cycle.sample_time.plus_ns(9_000 * DAY_NS);
    }
    assert!(matches!(
        prepared(&stepped, &robot, &bar),
        Err(PrepareError::TooLong { what: "the recording", .. })
    ));
    let mut invalid = run.clone();
    invalid.cycles.iter_mut().for_each(|cycle| cycle.encoders[3].valid = false);
    assert!(matches!(prepared(&invalid, &robot, &bar), Err(PrepareError::NoValidCycle { cycles: 6001 })));
    let mut empty = run.clone();
    empty.cycles.clear();
    assert!(matches!(prepared(&empty, &robot, &bar), Err(PrepareError::NoValidCycle { cycles: 0 })));
    let mut damaged = run;
    damaged.cycles[77].encoders[0].joint = 2;
    assert!(matches!(
        prepared(&damaged, &robot, &bar),
        Err(PrepareError::EncoderOrder { cycle: 77, declared: 1, found: 2 })
    ));
}

#[test]
fn a_log_that_also_holds_the_way_to_the_bar_is_used() {
    let (robot, bar) = (irb2400(), bar());
    let mut run = run(&robot, &bar, |_| {});
    // Before the run, the robot moves for 20 s far from the sphere of the bar.
    let start = run.robot_log.q_rad[0];
    let way: Vec<Joints> = (0..5000)
        .map(|k| {
            let s = 0.5 * (1.0 - (TAU * f64::from(k) / 5000.0).cos());
            Joints::from_fn(6, |j| start[j] + s * [0.5, -0.6, 0.3, 0.2, 0.4, 1.0][j])
        })
        .collect();
    let log = RobotLog {
        q_rad: Stream::new(
            run.robot_log.q_rad.first_stamp_ns - 20_000_000_000,
            (0..5000 + run.robot_log.q_rad.len()).map(|k| k as f64 * 0.004).collect(),
            way.into_iter().chain(run.robot_log.q_rad.iter().copied()).collect(),
        )
        .into(),
        ..RobotLog::default()
    };
    run.robot_log = log;
    let found = prepared(&run, &robot, &bar).unwrap();
    assert!(found.sphere.inliers < 0.95);
    check(&found, &run, "with the way to the bar");
    let centre = found.sphere.centre_m;
    assert!((centre - nalgebra::Vector3::new(1.0, 0.05, 0.35)).norm() < 0.01, "{centre}");
}

#[test]
fn times_before_1970_and_clocks_that_begin_at_zero_are_no_obstacle() {
    let (robot, bar) = (irb2400(), bar());
    let run = run(&robot, &bar, |e| {
        e.clocks = Clocks { bar_start: UtcNs(-5), robot_at_bar_start_ns: 0, skew: -25e-6 };
    });
    check(&prepared(&run, &robot, &bar).unwrap(), &run, "clocks at zero");
}
