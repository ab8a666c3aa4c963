//! Calibration with a tip on the flange that touches the faces of a block. Rows are simulated with known truth, for arms
//! of six and seven axes.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "figures of a run")]

use std::path::Path;
use std::process::Command;

use identify::calibrate::{CalibrateError, Calibration, DataSets, IdentifyConfig, calibrate};
use identify::evaluate::{limits, workspace_error};
use identify::instrument::{FaceTable, Measures as _, Touch};
use identify::kinematics::flange_chain;
use identify::logs::{JointMistake, TipRow, TouchMapping};
use identify::model::{Axis, Model, ParameterId, Role};
use identify::report::result::file::CalibrationFile;
use identify::robot::import;
use identify::simulate::ArmErrors;
use identify::simulate::touch::{self, SimulatedTouches, TouchExperiment};
use nalgebra::Vector3;
use shared::config::{self, RobotConfig, Validate};

use crate::support::campaign::size;
use crate::support::truth::{apart_m, assert_claims_hold, draw_joint_errors};
use crate::support::{irb120, irb2400, repository};

fn seven_axes() -> RobotConfig {
    let text = std::fs::read_to_string(repository("identify/tests/data/seven_axes.urdf")).unwrap();
    import(&text, Some("base"), Some("flange")).unwrap().config
}

fn usual(robot: &RobotConfig, seed: u64) -> TouchExperiment<'_> {
    let errors = ArmErrors { robot_seed: seed, ..ArmErrors::default() };
    TouchExperiment { errors, seed, ..TouchExperiment::new(robot) }
}

fn try_calibrate(
    robot: &RobotConfig,
    rows: &[TipRow],
    table: &FaceTable,
    made: &SimulatedTouches,
) -> Result<Calibration, CalibrateError> {
    let touch = Touch::new(rows, &made.truth.faces, table, &flange_chain(robot));
    let data = DataSets { rows: vec![touch.into()], ..DataSets::default() };
    calibrate(&data, robot, &IdentifyConfig::default(), None)
}

fn calibrated(robot: &RobotConfig, made: &SimulatedTouches) -> Calibration {
    try_calibrate(robot, &made.rows, &made.table, made).unwrap()
}

/// Error of the calibrated robot divided by that of the nominal robot.
fn part_left(robot: &RobotConfig, made: &SimulatedTouches) -> f64 {
    let found = calibrated(robot, made);
    let before_m = apart_m(robot, &flange_chain(robot), &made.robot);
    let after_m = apart_m(robot, &found.runs[0].model.geometry(&[]).robot, &made.robot);
    println!("{}: {:.3} -> {:.4} mm", robot.name, before_m * 1e3, after_m * 1e3);
    after_m / before_m
}

#[test]
fn robots_of_six_and_seven_axes_are_calibrated_by_a_touch_probe_alone() {
    for robot in [irb2400(), irb120(), seven_axes()] {
        let left = part_left(&robot, &touch::run(&usual(&robot, 1)).unwrap());
        assert!(left < 0.15, "{}: {left}", robot.name);
    }
}

#[test]
fn readings_of_a_dial_gauge_serve_as_well() {
    let robot = irb120();
    let made = touch::run(&TouchExperiment { gauge_mm: 8.0, ..usual(&robot, 2) }).unwrap();
    assert!(made.rows.iter().all(|row| row.reading_m.abs() < 0.0081));
    let left = part_left(&robot, &made);
    assert!(left < 0.15, "{left}");
}

/// Readings that vary less than the errors of the nominal robot do not determine the outer sides of the faces.
#[test]
fn readings_of_a_short_travel_give_a_green_verdict_whose_claim_holds() {
    let (robot, folder) = (irb120(), tempfile::tempdir().unwrap());
    for seed in [1, 6, 11] {
        let at = folder.path().join(seed.to_string());
        let made = touch::run(&TouchExperiment { gauge_mm: 1.0, ..usual(&robot, seed) }).unwrap();
        touch::write(&at, &made, &robot).unwrap();
        let arguments =
            ["calibrate", "touch", "touches.csv", "--mapping", "touch.toml", "--faces", "faces.toml"];
        let (done, text) =
            run_identify(&at, &[&arguments[..], &["--robot", "irb120_3", "--out", "result"]].concat());
        assert!(done && text.contains("verdict green"), "seed {seed}: {text}");
        let file = CalibrationFile::open(&at.join("result")).unwrap();
        let after_m = apart_m(&robot, &file.robot_chain(&robot, None), &made.robot);
        let claimed_m = file.budget.unwrap().expanded_m;
        assert!(after_m < claimed_m, "seed {seed}: {after_m} m, {claimed_m} m claimed");
    }
}

#[test]
fn a_simulated_touch_has_the_flange_on_the_outer_side_of_its_face() {
    for robot in [irb2400(), irb120(), seven_axes()] {
        for gauge_mm in [0.0, 1.0] {
            let made = touch::run(&TouchExperiment { gauge_mm, ..usual(&robot, 1) }).unwrap();
            for row in &made.rows {
                let number = |name: &str| made.truth.parameters[&format!("face{}_{name}", row.part + 1)];
                let normal = Vector3::from(["nx", "ny", "nz"].map(number));
                let flange_m = made.robot.forward(&row.joints_rad).translation.vector;
                let outside_m = (normal.dot(&flange_m) - number("d")) / normal.norm();
                // A fifth of the distance from the flange to the tip, less the travel of the gauge.
                assert!(outside_m > 0.023, "{} {}: {outside_m}", robot.name, made.truth.faces[row.part]);
            }
        }
    }
}

#[test]
fn faces_of_which_nothing_is_known_leave_the_scale_to_the_robots_file_and_say_so() {
    let robot = irb2400();
    let made = touch::run(&TouchExperiment { known: false, ..usual(&robot, 3) }).unwrap();
    let found = calibrated(&robot, &made);
    let workspace = workspace_error(&found, &robot.joint_limits());
    let scale = identify::evaluate::scale_sentence(
        [],
        found.runs.iter().map(|run| (run, Path::new("touch.toml"))),
        &workspace.budget,
    );
    assert!(scale.contains("no distance between the faces is known"), "{scale}");
    // The data are correct, so no value may be reported as a contradiction.
    let limits = limits(&found, &workspace);
    assert!(limits.iter().all(|limit| !limit.sentence.contains("contradict")), "{limits:?}");
    // The uncertainty of positions that the result states includes the uncertainty of the
    // common scale of the known distances.
    let after_m = apart_m(&robot, &found.model().geometry(&[]).robot, &made.robot);
    assert!(workspace.budget.expanded_m > 0.9e-3, "{}", workspace.budget.expanded_m);
    assert!(after_m < 1.5 * workspace.budget.expanded_m, "{after_m}");
}

#[test]
fn touches_of_another_face_take_no_part_and_joints_of_another_pose_are_refused_with_their_cause() {
    let robot = irb120();
    let made = touch::run(&usual(&robot, 4)).unwrap();
    let mut rows = made.rows.clone();
    for row in [20, 77, 131] {
        rows[row].part = (rows[row].part + 1) % 5;
    }
    let found = try_calibrate(&robot, &rows, &made.table, &made).unwrap();
    let run = &found.runs[0];
    let rejected: Vec<usize> = run.instrument.rejected().iter().map(|one| one.row).collect();
    assert_eq!(rejected, [20, 77, 131]);
    let remarks = run.instrument.remarks(&run.model.geometry(&[]));
    let right = &made.truth.faces[made.rows[20].part];
    assert!(remarks[0].1.contains(&format!("from `{right}`: look for a wrong name")), "{remarks:?}");
    let mut rows = made.rows.clone();
    for row in &mut rows {
        row.joints_rad = JointMistake::Reversed(1).undone(&row.joints_rad, robot.joint_kinds());
    }
    let error = try_calibrate(&robot, &rows, &made.table, &made).unwrap_err().to_string();
    assert!(error.contains("joint 2 counts the other way"), "{error}");
}

#[test]
fn a_fixed_tip_is_at_the_position_in_its_table() {
    let robot = irb120();
    let chain = flange_chain(&robot);
    let made = touch::run(&usual(&robot, 1)).unwrap();
    let tip_mm = [1.0, -2.0, 150.0];
    let table = FaceTable { tip_mm: Some(tip_mm), ..made.table };
    let touch = Touch::new(&made.rows, &made.truth.faces, &table, &chain);
    let mut model = touch.fitted_out(Model::alone(&chain));
    let tip = Axis::ALL.map(|axis| ParameterId::Tip { axis });
    assert!(touch.place(&mut model, &tip).unwrap());
    assert_eq!(model.geometry(&[]).touch.tip_m, Vector3::from(tip_mm) * 1e-3);
    assert!(tip.iter().all(|id| model.role(*id) == Some(Role::Fixed)));
}

#[test]
#[ignore = "takes minutes"]
fn intervals_of_links_hold_95_percent_over_robots_that_touch() {
    for robot in [irb2400(), irb120()] {
        let simulated = |seed, gear_sine_urad| {
            let errors = ArmErrors { gear_sine_urad, robot_seed: seed, ..ArmErrors::default() };
            touch::run(&TouchExperiment { errors, ..usual(&robot, seed) }).unwrap()
        };
        let with_truth = |made: SimulatedTouches| (calibrated(&robot, &made), made.truth.parameters);
        let seeds = 1..=size(10, 50);
        // These robots have smaller joint errors than a calibration assumes, ..
        assert_claims_hold(&robot, seeds.clone().map(|seed| with_truth(simulated(seed, 30.0))));
        // .. and these robots have the assumed ones.
        let model = calibrated(&robot, &simulated(1, 0.0)).model().clone();
        let drawn = seeds.map(|seed| {
            let mut made = simulated(seed, 0.0);
            draw_joint_errors(&model, &mut made.rows, &mut made.truth.parameters, seed);
            with_truth(made)
        });
        assert_claims_hold(&robot, drawn);
    }
}

/// Runs `identify` in a directory. Returns whether it succeeded, and its output.
fn run_identify(directory: &Path, arguments: &[&str]) -> (bool, String) {
    let run = Command::new(env!("CARGO_BIN_EXE_identify"))
        .current_dir(directory)
        .args(arguments)
        .env("RUST_LOG", "off")
        .output()
        .unwrap();
    let texts = [run.stdout, run.stderr].map(|text| String::from_utf8(text).unwrap());
    // The output is wrapped to the width of a terminal, so line breaks are removed.
    let words: Vec<String> = texts.concat().split_whitespace().map(Into::into).collect();
    (run.status.success(), words.join(" "))
}

#[test]
fn a_simulated_block_is_inspected_and_calibrates_from_its_files_and_its_experiment() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let done =
        run_identify(at, &["simulate", "touch", "--robot", "irb120_3", "--out", "cube", "--gauge-mm", "5"]);
    assert!(done.0, "{}", done.1);
    let inspect = ["inspect", "cube/touches.csv", "--mapping", "cube/touch.toml", "--robot", "irb120_3"];
    let (done, text) = run_identify(at, &inspect);
    assert!(done && text.contains("faces 5: right, left, back, front, top"), "{text}");
    assert!(text.contains("nothing suspicious"), "{text}");
    let (done, text) = run_identify(at, &[&inspect[..5], &["nj220_2_7"]].concat());
    assert!(done && text.contains("differ from the nominal robot by more than"), "{text}");
    let calibrate = ["calibrate", "touch", "cube/touches.csv", "--mapping", "cube/touch.toml", "--verbose"];
    let known = ["--faces", "cube/faces.toml", "--robot", "irb120_3", "--out", "result"];
    let (done, text) = run_identify(at, &[&calibrate[..], &known].concat());
    assert!(done && text.contains("verdict"), "{text}");
    assert!(text.contains("right face1 60"), "{text}");
    let page = std::fs::read_to_string(at.join("result/report.html")).unwrap();
    assert!(page.contains("SIMULATED") && page.contains("the distances between faces"));
    let again = ["calibrate", "--experiment", "result/experiment.toml", "--out", "again"];
    let (done, text) = run_identify(at, &again);
    assert!(done, "{text}");
    let [first, second] = ["result", "again"]
        .map(|out| std::fs::read_to_string(at.join(out).join("corrections.csv")).unwrap_or_default());
    assert!(!first.is_empty() && first == second);

    // A block that is longer than its table states is reported.
    let faces = std::fs::read_to_string(at.join("cube/faces.toml")).unwrap();
    let line = faces.lines().find(|line| line.starts_with("distance_mm")).unwrap();
    let mm: f64 = line.split_once("= ").unwrap().1.parse().unwrap();
    std::fs::write(at.join("longer.toml"), faces.replacen(line, &format!("distance_mm = {}", mm + 0.5), 1))
        .unwrap();
    let wrong = ["--faces", "longer.toml", "--robot", "irb120_3", "--out", "wrong"];
    let (done, text) = run_identify(at, &[&calibrate[..], &wrong].concat());
    assert!(done && text.contains("verdict amber"), "{text}");
    assert!(text.contains("the table of sockets or faces: the distance between faces `"), "{text}");
    // Known values of a face without rows are not used, and the command prints a warning.
    std::fs::write(at.join("spelt.toml"), faces.replace("\"right\"", "\"rihgt\"")).unwrap();
    let spelt = ["--faces", "spelt.toml", "--robot", "irb120_3", "--out", "spelt"];
    let mut command = Command::new(env!("CARGO_BIN_EXE_identify"));
    command.current_dir(at).args(calibrate).args(spelt).env("RUST_LOG", "warn");
    let warned = String::from_utf8(command.output().unwrap().stderr).unwrap();
    assert!(warned.contains("touches face `rihgt`"), "{warned}");
}

#[test]
fn the_shipped_tables_are_valid_and_wrong_ones_are_refused() {
    let table: FaceTable = config::load(&repository("config/faces.toml")).unwrap();
    assert!(!table.distances.is_empty() && !table.angles.is_empty());
    let mapping: TouchMapping = config::load(&repository("config/touch.toml")).unwrap();
    assert_eq!(mapping.joints.len(), 6);
    let refused = |of: fn(&mut FaceTable)| {
        let mut wrong = table.clone();
        of(&mut wrong);
        wrong.validate().unwrap_err().key
    };
    assert!(refused(|of| of.u_um = 0.0).contains("u_um"));
    assert!(refused(|of| of.tip_diameter_mm = f64::NAN).contains("tip_diameter_mm"));
    assert!(refused(|of| of.tip_mm = Some([0.0, f64::INFINITY, 0.0])).contains("tip_mm"));
    assert!(refused(|of| of.distances[0].distance_mm = -1.0).contains("distance[0].distance_mm"));
    assert!(refused(|of| of.angles[1].angle_deg = 91.0).contains("angle[1].angle_deg"));
    assert!(refused(|of| of.angles[0].between[1] = "left".into()).contains("angle[0].between"));
    // Two values of the same quantity would count as independent.
    assert_eq!(
        refused(|of| of.distances[1].between = ["right".into(), "left".into()]),
        "distance[1].between"
    );
    assert_eq!(refused(|of| of.angles[1].between = of.angles[0].between.clone()), "angle[1].between");
}
