//! The main job, end to end: an experiment with known errors is recorded over the simulated bus, and the errors are
//! found again.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::path::Path;

use ballbard::run::BusChoice;
use identify::calibrate::ball_bar::{self, CalibrateError};
use identify::calibrate::truth::Comparison;
use identify::calibrate::{CostName, IdentifyConfig, SelectionName};
use identify::logs;
use identify::model::ParameterId;
use identify::simulate::{self, Experiment};
use shared::config::{self, BallBarConfig, RobotConfig};
use shared::recording::Recording;
use system_tests::{ball_bar, config_directory, record, request};

fn robot(name: &str) -> RobotConfig {
    config::load(&config_directory().join("robots").join(name)).unwrap()
}

/// Simulates, records over the bus, and reads everything back from files.
fn experiment(
    directory: &Path,
    experiment: &Experiment<'_>,
    bar: &BallBarConfig,
) -> (Recording, logs::RobotLog, simulate::Truth) {
    let simulated = simulate::run(experiment).unwrap();
    let files = simulate::write(directory, &simulated, experiment.robot, bar).unwrap();
    let replay = request("recorded", BusChoice::Replay(files.recording.clone()), None, true);
    let (_, recorded) = record(directory, &replay, bar);
    let replayed = Recording::open(&files.recording).unwrap();
    assert_eq!(recorded.cycles.len(), replayed.cycles.len());
    let log = logs::load(&files.robot_log, experiment.robot).unwrap();
    let truth = toml::from_str(&std::fs::read_to_string(&files.truth).unwrap()).unwrap();
    (recorded, log, truth)
}

#[test]
fn all_38_parameters_are_recovered_for_both_robots() {
    for (name, seed) in [("irb2400_16.toml", 1), ("nj220_2_7.toml", 2)] {
        let (robot, bar) = (robot(name), ball_bar());
        let directory = tempfile::tempdir().unwrap();
        let (recording, log, truth) =
            experiment(directory.path(), &Experiment { seed, ..Experiment::new(&robot, &bar) }, &bar);
        assert!(truth.clock.shift_s.abs() > 1.0 && (truth.clock.skew - 25e-6).abs() < 1e-12);
        let config = IdentifyConfig { selection: SelectionName::Thesis, ..IdentifyConfig::default() };
        let calibration =
            ball_bar::calibrate(&recording.cycles, &recording.run.encoders, &log, &robot, &bar, &config)
                .unwrap();
        assert_eq!(calibration.cost, CostName::Pose);
        let comparison = Comparison::new(&calibration, &truth);
        assert_eq!(comparison.parameters.len(), 38);
        let error = comparison.euclidean_mm_mrad();
        println!("{name}: {error:.5} mm|mrad, shift {:.3e} s", comparison.clock_shift_error_s);
        assert!(error < 0.02, "{name}: {error} mm|mrad");
        assert!(comparison.clock_shift_error_s.abs() < 1e-4, "{}", comparison.clock_shift_error_s);
        assert!(comparison.clock_skew_error.abs() < 2e-6, "{}", comparison.clock_skew_error);
    }
}

#[test]
fn the_bar_of_the_thesis_without_encoder_3_calibrates_by_position_and_two_angles() {
    let robot = robot("irb2400_16.toml");
    let mut bar = ball_bar();
    bar.encoders.retain(|encoder| encoder.joint != 3);
    let directory = tempfile::tempdir().unwrap();
    let (recording, log, truth) = experiment(directory.path(), &Experiment::new(&robot, &bar), &bar);
    assert_eq!(recording.run.encoders.len(), 4);
    let config = IdentifyConfig { selection: SelectionName::Thesis, ..IdentifyConfig::default() };
    let calibration =
        ball_bar::calibrate(&recording.cycles, &recording.run.encoders, &log, &robot, &bar, &config).unwrap();
    assert_eq!(calibration.cost, CostName::PositionAngles);
    let robot_error = Comparison::new(&calibration, &truth)
        .only(|id| matches!(id, ParameterId::Robot { .. }))
        .euclidean_mm_mrad();
    assert!(robot_error < 0.05, "{robot_error} mm|mrad");
}

#[test]
fn the_log_of_another_run_is_refused() {
    let (robot, bar) = (robot("irb2400_16.toml"), ball_bar());
    let (one, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let (recording, _, _) = experiment(one.path(), &Experiment::new(&robot, &bar), &bar);
    let (_, log, _) =
        experiment(other.path(), &Experiment { seed: 7, ..Experiment::new(&robot, &bar) }, &bar);
    let config = IdentifyConfig::default();
    let error = ball_bar::calibrate(&recording.cycles, &recording.run.encoders, &log, &robot, &bar, &config)
        .map(|_| ())
        .unwrap_err();
    assert!(matches!(error, CalibrateError::Prepare(_)), "{error}");
}
