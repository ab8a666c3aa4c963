//! The verdict of a calibration (green, amber or red), and the files that the user gets to apply the calibration.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::collections::BTreeMap;
use std::path::Path;

use crate::support::command::identify;
use crate::support::{irb2400, lengths, repository};
use identify::calibrate::rows::{PoseFigures, Stages};
use identify::evaluate::{Budget, Expected, Limit, WorkspaceError};
use identify::instrument::{HoldOut, PoseError};
use identify::report::result::file::{CalibrationFile, SolveEntry};
use identify::report::result::validation::{HeldOutEntry, RowsEntry, UnseenEntry, ValidationEntry};
use identify::report::verdict::{CalibrationVerdict, Grade};
use identify::statistics::Sizes;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// The verdict for root mean square errors of position \[mm\] and rotation \[mrad\]. Each pair contains the error of the
/// nominal and of the calibrated robot.
fn judged(
    position: [f64; 2],
    rotation: [f64; 2],
    limits: &[Limit],
    required_m: Option<f64>,
) -> CalibrationVerdict {
    judged_within(0.1e-3, position, rotation, limits, required_m)
}

/// The verdict if positions are known within `expanded_m` over the workspace \[m\]. The nominal robot
/// has an error of a millimetre.
fn judged_within(
    expanded_m: f64,
    position: [f64; 2],
    rotation: [f64; 2],
    limits: &[Limit],
    required_m: Option<f64>,
) -> CalibrationVerdict {
    let (file, workspace) = file(expanded_m, position, rotation);
    file.with_verdict(&workspace, limits, required_m).verdict.unwrap()
}

fn file(expanded_m: f64, position: [f64; 2], rotation: [f64; 2]) -> (CalibrationFile, WorkspaceError) {
    let solve = SolveEntry {
        cost: "pose".into(),
        ended: String::new(),
        iterations: 1,
        samples: 1500,
        parameters: 40,
        condition: 1.0,
        residual_rms_start: 1.0,
        residual_rms: 1.0,
    };
    let mut file = CalibrationFile::new("robot", "bar", solve, Vec::new(), Vec::new());
    let entry =
        |at: usize| PoseError { position_m: position[at] * 1e-3, rotation_rad: Some(rotation[at] * 1e-3) };
    file.held_out =
        Some(HeldOutEntry { segments: 8, nominal: entry(0), calibrated: entry(1), fitted: entry(1) });
    let after =
        Expected { mean_m: 0.05e-3, p95_m: 0.1e-3, p95_upper_m: 0.15e-3, interval_m: [0.02e-3, 0.08e-3] };
    let before = Expected { mean_m: 1e-3, ..after };
    let budget = Budget { expanded_m, coverage_factor: 2.0, ..Budget::default() };
    (file, WorkspaceError { before, after, budget, ..WorkspaceError::default() })
}

fn figures(rows: usize, mm: f64) -> PoseFigures {
    PoseFigures { rows, position_m: Sizes { rms: mm * 1e-3, ..Sizes::default() }, rotation_rad: None }
}

/// The entry of a file of rows whose errors with the nominal and with the calibrated robot are given \[mm\].
fn rows_entry(rows: usize, [nominal_mm, calibrated_mm]: [f64; 2]) -> RowsEntry {
    let nominal = figures(rows, nominal_mm);
    let stages = Stages { nominal, joints: figures(rows, calibrated_mm), ..Stages::default() };
    RowsEntry {
        data_set: 1,
        hold_out: HoldOut::Rows,
        seed: 1,
        names: BTreeMap::new(),
        fitted: stages,
        held_out: stages,
        independent: None,
    }
}

#[test]
fn green_needs_unseen_data_within_the_claim_beyond_chance() {
    // The verdict for rows of another file with the error `calibrated_mm`, if the residuals of the
    // fitted file have the size `fitted_mm`.
    let verdict = |rows: usize, calibrated_mm: f64, fitted_mm: f64| {
        let (mut file, workspace) = file(0.1e-3, [1.0, 0.05], [1.0, 0.1]);
        file.rows.push(rows_entry(rows, [1.0, fitted_mm]));
        file.validations.push(ValidationEntry {
            name: "other.csv".into(),
            data_set: 1,
            nominal: figures(rows, 1.0),
            calibrated: figures(rows, calibrated_mm),
            unsupported: 0,
            left_out: 0,
        });
        file.with_verdict(&workspace, &[], None).verdict.unwrap()
    };
    let amber = verdict(100, 0.3, 0.05);
    let reason = amber.reason.unwrap();
    assert_eq!(amber.grade, Grade::Amber);
    assert!(
        reason.contains("rows of other.csv are 0.300 mm off")
            && reason.contains("stated uncertainty of 0.100 mm"),
        "{reason}"
    );
    assert_eq!(verdict(100, 0.1, 0.05).grade, Grade::Green);
    // Noise that the residuals of the fit also have does not count as an error of the robot. The errors of three
    // rows vary too much for a conclusion.
    assert_eq!(verdict(100, 0.42, 0.41).grade, Grade::Green);
    assert_eq!(verdict(3, 0.2, 0.15).grade, Grade::Green);
    assert_eq!(verdict(100, 1.5, 0.05).grade, Grade::Red);
}

#[test]
fn rows_that_were_held_out_together_count_as_few_errors() {
    let grade = |independent: Option<usize>| {
        let (mut file, workspace) = file(0.1e-3, [1.0, 0.05], [1.0, 0.1]);
        file.rows.push(RowsEntry { independent, ..rows_entry(200, [0.4, 0.55]) });
        file.with_verdict(&workspace, &[], None).verdict.unwrap().grade
    };
    assert_eq!([grade(Some(200)), grade(Some(5)), grade(None)], [Grade::Red, Grade::Amber, Grade::Red]);
}

#[test]
fn green_needs_unseen_parts_within_the_claim_beyond_chance() {
    let verdict = |predicted_mm: f64, fitted_mm: f64| {
        let (mut file, workspace) = file(0.3e-3, [1.0, 0.05], [1.0, 0.1]);
        file.rows.push(rows_entry(30, [2.0, fitted_mm]));
        file.unseen = ["A", "B", "C", "D"]
            .map(|name| UnseenEntry {
                data_set: 1,
                name: name.into(),
                predicted: figures(30, predicted_mm),
                fitted: figures(30, fitted_mm),
            })
            .to_vec();
        file.with_verdict(&workspace, &[], None).verdict.unwrap()
    };
    let amber = verdict(1.05, 0.24);
    let reason = amber.reason.unwrap();
    assert_eq!(amber.grade, Grade::Amber);
    assert!(reason.contains("rows at unseen parts of data set 1 are 1.050 mm off"), "{reason}");
    assert_eq!(verdict(0.38, 0.24).grade, Grade::Green);
    assert_eq!(verdict(5.0, 0.24).grade, Grade::Red);
}

#[test]
fn a_rotation_that_is_predicted_worse_than_by_the_nominal_robot_is_red_however_good_the_position() {
    let red = judged([1.0, 0.2], [1.33, 3.07], &[], Some(0.5e-3));
    assert_eq!((red.grade, red.better), (Grade::Red, Some(false)));
    let reason = red.reason.unwrap();
    assert!(reason.contains("3.070 mrad") && reason.contains("1.330 mrad"), "{reason}");
    assert_eq!(judged([0.2, 1.0], [1.0, 0.5], &[], None).grade, Grade::Red);
}

#[test]
fn as_good_as_the_nominal_robot_but_for_chance_is_amber_and_not_for_use() {
    let same = judged([0.020, 0.021], [0.5, 0.4], &[], None);
    assert_eq!((same.grade, same.better), (Grade::Amber, Some(false)));
}

#[test]
fn green_needs_both_answers_and_amber_names_what_is_missed() {
    let good = |limits: &[Limit], required_m| judged([1.0, 0.05], [1.0, 0.1], limits, required_m);
    assert_eq!(good(&[], None).grade, Grade::Green);
    assert_eq!(good(&[], Some(0.2e-3)).grade, Grade::Green);
    for (required_m, why) in [(0.12e-3, "confidence bound of 0.150 mm"), (0.04e-3, "95 % of the workspace")] {
        let missed = good(&[], Some(required_m));
        assert_eq!(missed.grade, Grade::Amber);
        assert!(missed.reason.unwrap().contains(why));
    }
    // The covariance predicts an accuracy that contradicts the held-out data.
    let belied = judged([1.0, 0.4], [1.0, 0.1], &[], Some(0.2e-3)).reason.unwrap();
    assert!(belied.contains("required 0.2 mm") && belied.contains("0.400 mm"), "{belied}");
    let limit = |serious| Limit { sentence: "Joint 3 turned by 2 degrees only.".into(), serious };
    assert_eq!(good(&[limit(false)], None).grade, Grade::Green);
    assert_eq!(good(&[limit(true)], None).reason.unwrap(), limit(true).sentence);
    // All rows are in one corner of the workspace, so the held-out rows are predicted well by the other rows.
    let of_a_corner = judged_within(1.5e-3, [1.0, 0.05], [1.0, 0.1], &[], None);
    assert_eq!(of_a_corner.grade, Grade::Amber);
    assert!(of_a_corner.reason.unwrap().contains("valid near the measured poses only"));
}

fn wire(csv: &str, extra: &[&str], out: &Path) -> (std::process::Output, Vec<String>) {
    let inputs = tempfile::tempdir().unwrap();
    let path = inputs.path().join("lengths.csv");
    std::fs::write(&path, csv).unwrap();
    let mapping = repository("config/measured_length.toml");
    let arguments = ["calibrate", "wire", path.to_str().unwrap(), "--mapping", mapping.to_str().unwrap()];
    let output = identify(&[&arguments[..], extra].concat(), "irb2400_16.toml", out);
    let mut files: Vec<String> = std::fs::read_dir(out)
        .unwrap()
        .map(|one| one.unwrap().file_name().to_string_lossy().into_owned())
        .collect();
    files.sort();
    (output, files)
}

/// A table of lengths of a robot with errors of millimetres in two of its links, and with noise of 20 um.
fn of_another_robot() -> String {
    let mut robot = irb2400();
    robot.links[1].a_m += 2e-3;
    robot.links[3].d_m -= 3e-3;
    let mut random = ChaCha8Rng::seed_from_u64(7);
    // Positions of the controller are computed with the nominal robot.
    let csv = lengths::table(&robot, 300, 12.0);
    let nominal = lengths::table(&irb2400(), 300, 12.0);
    let rows = csv.lines().zip(nominal.lines()).map(|(measured, row)| {
        let (row, length) = (row.rsplit_once(',').unwrap().0, measured.rsplit_once(',').unwrap().1);
        match length.parse::<f64>() {
            Ok(length) => format!("{row},{:.3}\n", length + 0.02 * (2.0 * random.random::<f64>() - 1.0)),
            Err(_) => format!("{measured}\n"),
        }
    });
    rows.collect()
}

#[test]
fn a_required_accuracy_is_judged_and_repeated_for_every_instrument() {
    let csv = of_another_robot();
    for (required, grade) in [("10mm", "green"), ("0.001mm", "amber")] {
        let out = tempfile::tempdir().unwrap();
        let (output, files) = wire(&csv, &["--require", required], out.path());
        let text = String::from_utf8_lossy(&output.stdout);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        assert!(text.starts_with(&format!("verdict {grade}: ")), "{text}");
        // The output has verdict, errors before and after, deployments, scale, limits, parameters that are not separated,
        // files, and the next step. Everything else needs --verbose.
        let fits = |line: &str| line.chars().count() <= 100 || !line.trim().contains(' ');
        assert!(text.lines().all(fits), "{text}");
        assert_eq!(text.lines().filter(|line| !line.starts_with("  ")).count(), 8, "{text}");
        // The stated number is at the start of the output.
        assert!(
            text.starts_with(&format!("verdict {grade}: 0.0"))
                && text.contains("scale: the lengths of the wire")
        );
        assert!(text.contains("(k = 2)") && text.contains("robot.urdf, "), "{text}");
        assert!(files.iter().any(|file| file == "robot.urdf"), "{files:?}");
        let experiment = std::fs::read_to_string(out.path().join("experiment.toml")).unwrap();
        assert!(experiment.contains("require_mm"), "{experiment}");
        let page = std::fs::read_to_string(out.path().join("report.html")).unwrap();
        assert_eq!(page.contains("<div class=\"verdict doubt\">"), grade == "amber");
        // The certified values are also in the file that programs read.
        let expected = CalibrationFile::open(out.path()).unwrap().expected.unwrap();
        let cube = expected.cube.unwrap();
        assert!(expected.calibrated.mean_m < expected.nominal.mean_m, "{expected:?}");
        assert!(page.contains(&format!("cube of {:.0} mm", cube.edge_m * 1e3)), "{cube:?}");
        for part in [expected.nominal, expected.calibrated, cube.before, cube.after] {
            let [low_m, high_m] = part.interval_m;
            assert!(part.p95_upper_m >= part.p95_m && (low_m..=high_m).contains(&part.mean_m), "{part:?}");
        }
    }
    let out = tempfile::tempdir().unwrap();
    let (output, files) = wire(&csv, &["--require", "0"], out.path());
    assert!(!output.status.success() && files.is_empty());
    assert!(String::from_utf8_lossy(&output.stderr).contains("not a length above zero"));
}

#[test]
fn nothing_to_apply_is_written_where_the_nominal_robot_is_as_good_and_what_was_there_is_set_aside() {
    let out = tempfile::tempdir().unwrap();
    let (_, files) = wire(&of_another_robot(), &[], out.path());
    assert!(files.iter().any(|file| file == "corrections.csv"), "{files:?}");
    let (output, files) = wire(&lengths::table(&irb2400(), 300, 12.0), &[], out.path());
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success() && text.contains("verdict amber: "), "{text}");
    let expected = [
        "calibration.json",
        "calibration.toml",
        "earlier",
        "experiment.toml",
        "report.html",
        "residuals.csv",
    ];
    assert_eq!(files, expected);
    for name in ["corrections.csv", "experiment.toml"] {
        assert!(out.path().join("earlier").join(name).exists(), "{name}");
    }
}
