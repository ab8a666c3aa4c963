//! Comparison of several calibrations. If the robot is the same, the calibrations agree. After a change of
//! the robot they contradict each other.
#![allow(clippy::unwrap_used, reason = "tests")]

use crate::support::campaign::size;
use crate::support::{bar, irb2400};
use identify::calibrate::{IdentifyConfig, calibrate_run};
use identify::evaluate::Validity;
use identify::report::result::file::{CalibrationFile, ParameterEntry, ParameterStatus, SolveEntry};
use identify::report::side_by_side;
use identify::report::{Consistency, ConsistencyError};
use identify::simulate::{self, Effects, Experiment, StaticErrors};

const NOISE: Effects =
    Effects { robot_noise_urad: 15.0, encoder_noise_urad: 5.0, base_tilt_urad: 5000.0, ..Effects::NONE };

/// A calibration of a robot. The seed `errors` determines the errors of the robot, the seed `path` the path.
fn file(path: u64, errors: u64) -> CalibrationFile {
    let (robot, bar) = (irb2400(), bar());
    let errors = StaticErrors::Drawn { seed: errors };
    let experiment = Experiment { seed: path, errors, effects: NOISE, ..Experiment::new(&robot, &bar) };
    let run = simulate::run(&experiment).unwrap();
    let config = IdentifyConfig { encoder_harmonics_urad: 0.0, ..IdentifyConfig::default() };
    let found = calibrate_run(&run.cycles, &run.encoders, &run.robot_log, &robot, &bar, &config).unwrap();
    let (model, solution) = (found.model(), found.solution());
    CalibrationFile::new(
        &robot.name,
        &bar.name,
        SolveEntry::new(found.cost_name(), &solution.summary, &solution.identifiability),
        Vec::new(),
        ParameterEntry::all(model, |id| {
            model.column_of(id).and_then(|column| solution.covariance.sigma(column))
        }),
    )
}

#[test]
#[ignore = "takes a quarter of a minute"]
fn other_paths_of_one_robot_agree_and_another_robot_does_not() {
    let same = Consistency::new(&[file(1, 9), file(2, 9), file(3, 9)]).unwrap();
    assert!(same.is_consistent(), "{:?}", same.p_corrected);
    let files = [file(1, 9), file(2, 10)];
    let other = Consistency::new(&files).unwrap();
    assert!(!other.is_consistent(), "{:?}", other.p_corrected);
    let names = ["monday".to_owned(), "<tuesday>".to_owned()];
    let table = side_by_side::table(&other, &names);
    assert!(table.contains("not consistent") && table.contains("corrections were applied"), "{table}");
    let page = side_by_side::page(&other, "robot", &names).into_string();
    assert!(page.contains("not consistent") && page.contains("&lt;tuesday&gt;") && page.contains("<svg"));
}

/// If all intervals were exact, half of the probabilities would be above 0.5. Probabilities from one robot are correlated,
/// so the test needs several robots. Intervals may be too wide, but not too narrow.
#[test]
#[ignore = "30 calibrations: a minute"]
fn probabilities_of_ten_robots_are_spread_as_true_intervals_spread_them() {
    let robots = 9..9 + size(3, 10);
    let count = robots.clone().count();
    let all =
        robots.map(|robot| Consistency::new(&[file(1, robot), file(2, robot), file(3, robot)]).unwrap());
    let p: Vec<f64> = all.flat_map(|one| one.parameters).map(|one| one.p.unwrap()).collect();
    let high = p.iter().filter(|p| **p > 0.5).count() as f64 / p.len() as f64;
    // Probabilities from one robot are correlated, so the standard deviation of the fraction depends on
    // the number of robots. The expected fraction is above 0.5, because the tolerances bias all
    // calibrations of one robot in the same direction.
    let spread = 0.553 / (count as f64).sqrt();
    assert!(p.len() == 22 * count && (0.65 - spread..0.65 + spread).contains(&high), "{high} of {}", p.len());
}

#[test]
#[ignore = "takes ten seconds"]
fn the_probability_is_that_of_the_chi_square_table() {
    let of_sigma = |value: f64, sigma: f64| {
        let mut file = file(1, 9);
        file.parameters.retain(|entry| entry.name == "ra1");
        file.parameters[0].value = value;
        file.parameters[0].sigma = Some(sigma);
        file
    };
    let of = |value: f64| of_sigma(value, 1e-3);
    // The two values differ by 2.7718 sigma. Chi-square is then 3.8415 with one degree of freedom, so p is 5 %.
    let pair = Consistency::new(&[of(0.0), of(2.7718e-3)]).unwrap();
    assert!((pair.parameters[0].p.unwrap() - 0.05).abs() < 1e-4);
    assert!((pair.parameters[0].mean - 1.3859e-3).abs() < 1e-9);
    // The square of this difference is the smallest positive floating-point number.
    let alike = Consistency::new(&[of(0.0), of_sigma(1.8e-162, 1.0)]).unwrap();
    assert_eq!(alike.parameters[0].p, Some(1.0));
}

#[test]
fn identified_values_are_compared_whatever_the_nominal_ones_were() {
    let one = file(1, 9);
    let moved = |nominal_m: f64, value_m: f64| {
        let mut file = one.clone();
        let entry = file.parameters.iter_mut().find(|entry| entry.name == "ra2").unwrap();
        entry.nominal += nominal_m;
        entry.value += value_m;
        entry.correction = entry.value - entry.nominal;
        Consistency::new(&[one.clone(), file]).unwrap()
    };
    let names = ["monday".to_owned(), "tuesday".to_owned()];
    // The same robot compared with other nominal values: the value does not change, but the nominal value does.
    let same = moved(1e-3, 0.0);
    assert!(same.is_consistent() && same.other_nominals == ["ra2"], "{same:?}");
    assert!(side_by_side::table(&same, &names).contains("nominal values of ra2 differ"));
    // Another robot: value and nominal value change by the same amount, so the correction is equal.
    let other = moved(1e-3, 1e-3);
    assert!(!other.is_consistent() && other.other_nominals == ["ra2"], "{other:?}");
    let equal = moved(0.0, 0.0);
    assert!(equal.is_consistent() && equal.other_nominals.is_empty(), "{equal:?}");
    // Angles that differ by whole turns are equal.
    let mut turned = one.clone();
    let entry = turned.parameters.iter_mut().find(|entry| entry.name == "rtheta2").unwrap();
    entry.value += std::f64::consts::TAU;
    assert!(Consistency::new(&[one.clone(), turned]).unwrap().is_consistent());
}

#[test]
fn calibrations_with_plates_of_other_lengths_are_consistent() {
    let mut short = file(1, 9);
    let plate = short.parameters.iter().position(|entry| entry.name == "ra6").unwrap();
    let entry = &mut short.parameters[plate];
    (entry.status, entry.sigma) = (ParameterStatus::Identified, Some(1e-5));
    let mut long = short.clone();
    long.parameters[plate].nominal += 0.05;
    long.parameters[plate].value += 0.05;
    let found = Consistency::new(&[short.clone(), long]).unwrap();
    assert!(found.is_consistent() && found.other_nominals == ["ra6"], "{found:?}");
    // With equal nominal values, another length is a difference of the robot.
    let mut other = short.clone();
    other.parameters[plate].value += 0.05;
    assert!(!Consistency::new(&[short, other]).unwrap().is_consistent());
}

#[test]
fn the_robots_ends_are_as_far_apart_as_their_links_say() {
    let validity = Validity { joints: vec![vec![[-1.0, 1.0]]; 6], prismatic: Vec::new() };
    let one = CalibrationFile { validity: Some(validity), ..file(1, 9) };
    let mut longer = one.clone();
    let entry = longer.parameters.iter_mut().find(|entry| entry.name == "rd1").unwrap();
    entry.value += 2e-4;
    let found = Consistency::new(&[one.clone(), longer, file(1, 9)]).unwrap();
    let apart = found.apart[0].unwrap();
    assert!((apart.mean - 2e-4).abs() < 1e-9 && (apart.max - 2e-4).abs() < 1e-9, "{apart:?}");
    // A distance between the ends needs the joint ranges. This file has none, so no distance is computed.
    assert_eq!(found.apart[1], None);
    let names = ["monday", "tuesday", "none"].map(str::to_owned);
    let text = side_by_side::table(&found, &names);
    assert!(text.contains("the robot's end with [2] and with [1]: 0.200 mm apart in the mean"), "{text}");
}

#[test]
fn one_calibration_is_not_compared_with_itself() {
    let directory = tempfile::tempdir().unwrap();
    file(1, 9).write(directory.path()).unwrap();
    let twice = [directory.path(), &directory.path().join("calibration.json")];
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_identify"));
    let output = command.arg("compare").args(twice).output().unwrap();
    let text = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(1) && text.contains("are the same calibration"), "{text}");
}

#[test]
fn what_cannot_be_compared_is_refused() {
    let one = file(1, 9);
    assert_eq!(Consistency::new(std::slice::from_ref(&one)).unwrap_err(), ConsistencyError::One);
    let other = CalibrationFile { robot: "another".into(), ..one.clone() };
    assert!(matches!(Consistency::new(&[one, other]), Err(ConsistencyError::OtherRobot { .. })));
}

#[test]
fn calibrations_come_back_from_both_of_their_files() {
    let directory = tempfile::tempdir().unwrap();
    let written = file(1, 9);
    written.write(directory.path()).unwrap();
    assert_eq!(CalibrationFile::open(directory.path()).unwrap(), written);
    assert_eq!(CalibrationFile::open(&directory.path().join("calibration.toml")).unwrap(), written);
    let newer = std::fs::read_to_string(directory.path().join("calibration.toml")).unwrap();
    let path = directory.path().join("newer.toml");
    std::fs::write(&path, newer.replacen("schema = ", "schema = 9", 1)).unwrap();
    let message = CalibrationFile::open(&path).unwrap_err().to_string();
    assert!(message.contains("newer.toml") && message.contains("schema"), "{message}");

    for damage in [
        |entry: &mut ParameterEntry| entry.correction = f64::NAN,
        |entry: &mut ParameterEntry| entry.sigma = Some(1e-200),
    ] {
        let mut damaged = written.clone();
        damaged.parameters.iter_mut().filter(|entry| entry.name == "ra1").for_each(damage);
        damaged.write(directory.path()).unwrap();
        let message =
            CalibrationFile::open(&directory.path().join("calibration.toml")).unwrap_err().to_string();
        assert!(message.contains("`ra1`") && message.contains("calibrate again"), "{message}");
    }
}
