//! Runs that pass singular poses of the bar and in which the counters lose their origin. All segments of
//! such runs must be used.
#![allow(clippy::unwrap_used, reason = "tests")]

use crate::support::{bar, irb2400};
use identify::calibrate::{Calibration, IdentifyConfig, calibrate_run};
use identify::model::ParameterId;
use identify::prepare::SampleStatus;
use identify::simulate::Comparison;
use identify::simulate::{self, Design, Effects, Experiment, Simulated};

/// A run on whose path the rod passes through the axis of the base.
fn crossing(effects: Effects) -> Simulated {
    crossing_with(effects, 1, [-60.0, 85.0])
}

/// A run on whose path joint `joint` (from 0) of the bar has this range instead of the default range.
fn crossing_with(effects: Effects, joint: usize, range_deg: [f64; 2]) -> Simulated {
    let (robot, bar) = (irb2400(), bar());
    let usual = Design::for_robot(&robot);
    let mut bar_range_deg = usual.bar_range_deg;
    bar_range_deg[joint] = range_deg;
    let design = Design { bar_range_deg, bar_margin_deg: 0.0, ..usual };
    simulate::run(&Experiment { design, effects, ..Experiment::new(&robot, &bar) }).unwrap()
}

fn calibrated(run: &Simulated) -> Calibration {
    let config = IdentifyConfig::default();
    calibrate_run(&run.cycles, &run.encoders, &run.robot_log, &irb2400(), &bar(), &config).unwrap()
}

fn robot_error(found: &Calibration, run: &Simulated) -> f64 {
    let comparison = Comparison::new(found, &run.truth);
    comparison.only(|id| matches!(id, ParameterId::Robot { .. })).euclidean_mm_mrad()
}

/// Changes the origin of the counters from cycle `at` on.
fn new_origin(run: &mut Simulated, at: usize) {
    for (k, cycle) in run.cycles.iter_mut().enumerate().skip(at) {
        for (place, encoder) in cycle.encoders.iter_mut().enumerate() {
            encoder.count = encoder.count.wrapping_add((1 + place as u32) * 123_457 * (at as u32 / 100));
        }
        if k < at + 30 {
            cycle.encoders[0].valid = false;
        }
    }
    // A new origin counts from the first valid record after the change, as in the daemon.
    run.cycles[at + 30..].iter_mut().for_each(|cycle| cycle.origin += 1);
}

#[test]
fn samples_of_all_configurations_are_used_and_those_near_singular_poses_left_out() {
    let run = crossing(Effects::default());
    let found = calibrated(&run);
    let path = &run.motion.path;
    let since_start_s = found.prepared().unwrap().t_ref.seconds_since(run.truth.clock.bar_start);
    let mut sides = [0usize; 2];
    for observation in &found.prepared().unwrap().observations {
        let joints = path.at(since_start_s + observation.t_s);
        sides[usize::from(joints[1].sin() > 0.0)] += 1;
        assert!(joints[1].sin().abs() > 0.08 && joints[3].sin().abs() > 0.08, "{joints:?}");
    }
    println!("{sides:?} {:?}", found.prepared().unwrap().counts);
    assert!(sides.iter().all(|count| *count > 50), "{sides:?}");
    let singular = found
        .prepared()
        .unwrap()
        .timeline
        .points
        .iter()
        .filter(|point| point.status == SampleStatus::Singular);
    assert!(singular.count() > 10);
    let error = robot_error(&found, &run);
    println!("{error:.5} mm|mrad");
    assert!(error < 0.05, "{error}");
}

#[test]
fn a_cardan_that_passes_its_singular_pose_calibrates_from_both_sides() {
    let effects = Effects { robot_noise_urad: 15.0, encoder_noise_urad: 5.0, ..Effects::default() };
    let run = crossing_with(effects, 3, [100.0, 230.0]);
    let found = calibrated(&run);
    let since_start_s = found.prepared().unwrap().t_ref.seconds_since(run.truth.clock.bar_start);
    let mut sides = [0usize; 2];
    for observation in &found.prepared().unwrap().observations {
        let joints = run.motion.path.at(since_start_s + observation.t_s);
        sides[usize::from(joints[3].sin() > 0.0)] += 1;
        assert!(joints[3].sin().abs() > 0.08, "{joints:?}");
    }
    let error = robot_error(&found, &run);
    println!("{sides:?}, {error:.5} mm|mrad, {:?}", found.prepared().unwrap().counts);
    assert!(sides.iter().all(|count| *count > 50), "{sides:?}");
    assert!(found.prepared().unwrap().counts.of(SampleStatus::Singular) > 10);
    assert!(error < 0.1, "{error}");
}

#[test]
#[ignore = "takes more than four seconds"]
fn a_run_with_lost_origins_is_used_whole_and_calibrates_as_well_as_a_clean_one() {
    let effects = Effects {
        robot_noise_urad: 15.0,
        encoder_noise_urad: 5.0,
        gear_sine_urad: 20.0,
        encoder_eccentricity_urad: 40.0,
        base_tilt_urad: 5000.0,
        ..Effects::NONE
    };
    let (robot, bar) = (irb2400(), bar());
    for seed in [1, 2] {
        let clean = simulate::run(&Experiment { seed, effects, ..Experiment::new(&robot, &bar) }).unwrap();
        let mut lossy = clean.clone();
        for at in [2500, 5000, 9000] {
            new_origin(&mut lossy, at);
        }
        // The origin is marked as new, although it has not changed.
        lossy.cycles[10_500..].iter_mut().for_each(|cycle| cycle.origin += 1);
        let [of_clean, of_lossy] = [&clean, &lossy].map(calibrated);
        let errors = [robot_error(&of_clean, &clean), robot_error(&of_lossy, &clean)];
        let origins = &of_lossy.prepared().unwrap().origins;
        println!("clean {:.3}, with four origins {:.3} mm|mrad; {origins:#?}", errors[0], errors[1]);
        assert_eq!(origins.len(), 5);
        assert!(origins.iter().all(|origin| origin.used));
        assert!(of_lossy.prepared().unwrap().counts.of(SampleStatus::OtherOrigin) == 0);
        assert!(errors[1] < 1.5 * errors[0] + 0.002, "{errors:?}");
    }
}

#[test]
fn origins_change_where_configurations_do() {
    let mut run = crossing(Effects { robot_noise_urad: 15.0, encoder_noise_urad: 5.0, ..Effects::default() });
    for at in [3000, 7000] {
        new_origin(&mut run, at);
    }
    let found = calibrated(&run);
    let error = robot_error(&found, &run);
    println!("{error:.5} mm|mrad, {:#?}", found.prepared().unwrap().origins);
    assert!(error < 0.1, "{error}");
}
