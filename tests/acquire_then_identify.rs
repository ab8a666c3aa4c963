//! Tests the main purpose of the programs from end to end. An experiment with known errors is simulated and recorded over
//! the simulated bus. The calibration of the recorded files must identify these errors.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

use std::path::Path;

use ballbard::control::recordings::table::{Layout, write_csv};
use ballbard::run::{BusChoice, RunRequest};
use identify::calibrate::{CalibrateError, IdentifyConfig, SelectionName, calibrate_run};
use identify::instrument::CostName;
use identify::logs::{self, BarLog};
use identify::model::ParameterId;
use identify::prepare::{SampleStatus, bar_angles};
use identify::simulate::Comparison;
use identify::simulate::{self, Design, Effects, Experiment};
use shared::config::{self, BallBarConfig, RobotConfig};
use shared::recording::schema::{CycleRecord, EncoderInfo, flags};
use shared::recording::{Recording, SystemDisk};
use system_tests::{ball_bar, config_directory, record, request};

fn robot(name: &str) -> RobotConfig {
    config::load(&config_directory().join("robots").join(name)).unwrap()
}

/// Simulates an experiment and records it over the bus. Returns the recording and the robot log, both read from the files.
/// Also returns the true errors of the simulation.
fn simulate_and_record(
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
        let (recording, log, truth) = simulate_and_record(
            directory.path(),
            &Experiment { seed, ..Experiment::new(&robot, &bar) },
            &bar,
        );
        assert!(truth.clock.shift_s.abs() > 1.0 && (truth.clock.skew - 25e-6).abs() < 1e-12);
        let config = IdentifyConfig { selection: SelectionName::Thesis, ..IdentifyConfig::default() };
        let calibration =
            calibrate_run(&recording.cycles, &recording.run.encoders, &log, &robot, &bar, &config).unwrap();
        assert_eq!(calibration.cost(), Some(CostName::Pose));
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
fn the_bar_of_the_thesis_without_encoder_3_calibrates_too() {
    let robot = robot("irb2400_16.toml");
    let mut bar = ball_bar();
    bar.encoders.retain(|encoder| encoder.joint != 3);
    let directory = tempfile::tempdir().unwrap();
    let (recording, log, truth) = simulate_and_record(directory.path(), &Experiment::new(&robot, &bar), &bar);
    assert_eq!(recording.run.encoders.len(), 4);
    let config = IdentifyConfig { selection: SelectionName::Thesis, ..IdentifyConfig::default() };
    let calibration =
        calibrate_run(&recording.cycles, &recording.run.encoders, &log, &robot, &bar, &config).unwrap();
    assert_eq!(calibration.cost(), Some(CostName::Pose));
    let robot_error = Comparison::new(&calibration, &truth)
        .only(|id| matches!(id, ParameterId::Robot { .. }))
        .euclidean_mm_mrad();
    assert!(robot_error < 0.05, "{robot_error} mm|mrad");
}

/// Faults of frames, terminals, cable and clock. They occur one after the other within two minutes.
const FAULTS: [&str; 9] = [
    "lost:0.02@5s-20s",
    "late:0.02,6ms@20s-30s",
    "corrupted:0.02@30s-40s",
    "short:0.02,1@40s-50s",
    "gone:4@55s-57s",
    "safe-op:3,0x001b@70s",
    "no-signal:5@80s-82s",
    "link-down@90s-91s",
    "clock-step:3ms@100s",
];

/// Errors of the robot's parameters \[mm|mrad\] after two calibrations: first from a recording without faults,
/// then from a recording with faults. Both calibrations use the same number of valid cycles. The recording
/// without faults is cut to this number.
fn errors_clean_and_faulty(seed: u64) -> [f64; 2] {
    let (robot, bar) = (robot("irb2400_16.toml"), ball_bar());
    let directory = tempfile::tempdir().unwrap();
    let effects = Effects {
        robot_noise_urad: 15.0,
        encoder_noise_urad: 5.0,
        gear_sine_urad: 20.0,
        encoder_eccentricity_urad: 40.0,
        base_tilt_urad: 5000.0,
        ..Effects::NONE
    };
    let (clean, log, truth) = simulate_and_record(
        directory.path(),
        &Experiment { seed, effects, ..Experiment::new(&robot, &bar) },
        &bar,
    );
    let replay = BusChoice::Replay(directory.path().join("recording.mcap"));
    let faults = FAULTS.iter().map(|fault| fault.parse().unwrap()).collect();
    let (_, faulty) =
        record(directory.path(), &RunRequest { faults, ..request("faulty", replay, None, true) }, &bar);
    let is_valid = |cycle: &&CycleRecord| cycle.encoders.iter().all(|encoder| encoder.valid);
    let valid = faulty.cycles.iter().filter(is_valid).count();
    // The faults make about 480 cycles invalid. A lost cycle does not make the next cycle invalid.
    assert!(valid < clean.cycles.len() - 400, "{valid} of {}", clean.cycles.len());
    // Cycles from the middle of the run without faults are used, as many as are valid in the run with faults.
    let skipped = (clean.cycles.len() - valid) / 2;
    let error = |cycles: &[CycleRecord], encoders: &[EncoderInfo]| {
        let config = IdentifyConfig::default();
        let calibration = calibrate_run(cycles, encoders, &log, &robot, &bar, &config).unwrap();
        let comparison = Comparison::new(&calibration, &truth);
        let error = comparison.only(|id| matches!(id, ParameterId::Robot { .. })).euclidean_mm_mrad();
        let prepared = calibration.prepared().unwrap();
        println!("{error:.4} mm|mrad, {} origins, {:?}", prepared.origins.len(), prepared.counts);
        error
    };
    [
        error(&clean.cycles[skipped..skipped + valid], &clean.run.encoders),
        error(&faulty.cycles, &faulty.run.encoders),
    ]
}

#[test]
fn runs_with_faults_calibrate_as_well_as_clean_ones_of_the_same_valid_length() {
    let [mut clean_mean, mut faulty_mean] = [0.0, 0.0];
    for seed in [1, 2] {
        let [clean, faulty] = errors_clean_and_faulty(seed);
        clean_mean += clean / 2.0;
        faulty_mean += faulty / 2.0;
    }
    // With faults, the calibration selects other samples. This selection alone changes the errors by up to half.
    assert!(faulty_mean < 1.6 * clean_mean, "{faulty_mean} mm|mrad with faults, {clean_mean} without");
}

#[test]
fn a_run_exported_as_a_table_of_counters_calibrates_as_the_recording_does() {
    let (robot, bar) = (robot("irb2400_16.toml"), ball_bar());
    let directory = tempfile::tempdir().unwrap();
    let design = Design { duration_s: 80.0, ..Design::for_robot(&robot) };
    let mut simulated = simulate::run(&Experiment { design, ..Experiment::new(&robot, &bar) }).unwrap();
    // Simulate cycles without a reply. After them, the counters start from a new origin.
    for cycle in &mut simulated.cycles[5000..5030] {
        cycle.flags |= flags::NO_REPLY;
        cycle.encoders.iter_mut().for_each(|sample| sample.valid = false);
    }
    simulated.cycles[5030..].iter_mut().for_each(|cycle| cycle.origin = 1);
    for sample in simulated.cycles[5030..].iter_mut().flat_map(|cycle| &mut cycle.encoders) {
        sample.count = sample.count.wrapping_add(123_456_789 * u32::from(sample.joint));
    }
    let files = simulate::write(directory.path(), &simulated, &robot, &bar).unwrap();
    let recording = Recording::open(&files.recording).unwrap();
    let table = directory.path().join("exported.csv");
    let sink = std::fs::File::create(&table).unwrap();
    write_csv(&SystemDisk, &files.recording, Layout::default(), sink).unwrap();

    let bar_log = BarLog::load(&table, &bar, None).unwrap();
    let BarLog::Other(other) = &bar_log else { panic!("the table was read as a recording") };
    assert!(other.simulated);
    assert_eq!(other.unknown, ["how certain its times are", "the times of a second clock"]);
    let log = logs::load(&files.robot_log, &robot).unwrap();
    let (cycles, encoders) = (bar_log.cycles(), bar_log.encoders());
    // Times, angles and origins are equal bit by bit. All results are therefore equal, too.
    assert_eq!(
        bar_angles(cycles, encoders).unwrap(),
        bar_angles(&recording.cycles, &recording.run.encoders).unwrap()
    );
    let config = IdentifyConfig::default();
    let calibration = calibrate_run(cycles, encoders, &log, &robot, &bar, &config).unwrap();
    let prepared = calibration.prepared().unwrap();
    assert_eq!((prepared.counts.of(SampleStatus::Invalid), prepared.origins.len()), (30, 2));
    let error = Comparison::new(&calibration, &simulated.truth)
        .only(|id| matches!(id, ParameterId::Robot { .. }))
        .euclidean_mm_mrad();
    assert!(error < 0.05, "{error} mm|mrad");
}

#[test]
fn the_log_of_another_run_is_refused() {
    let (robot, bar) = (robot("irb2400_16.toml"), ball_bar());
    let (one, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let (recording, _, _) = simulate_and_record(one.path(), &Experiment::new(&robot, &bar), &bar);
    let (_, log, _) =
        simulate_and_record(other.path(), &Experiment { seed: 7, ..Experiment::new(&robot, &bar) }, &bar);
    let config = IdentifyConfig::default();
    let error = calibrate_run(&recording.cycles, &recording.run.encoders, &log, &robot, &bar, &config)
        .map(|_| ())
        .unwrap_err();
    assert!(matches!(error, CalibrateError::Prepare { run: 0, .. }), "{error}");
}
