//! Calibration with a ball on the flange that is placed in sockets at known distances. Rows are simulated with known truth,
//! for arms of six and seven axes.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "figures of a run")]

use std::path::Path;

use identify::calibrate::rows::PoseFigures;
use identify::calibrate::validation::unseen::{UnseenPart, unseen_parts};
use identify::calibrate::{Calibration, DataSets, IdentifyConfig, calibrate};
use identify::instrument::{
    Contact, HoldOut, KnownDistance, Knowns as _, PlacedSocket, RowError, Rows, SocketTable, Sockets,
};
use identify::kinematics::{Chain, Pose, flange_chain};
use identify::logs::{ContactMapping, TipRow};
use identify::model::{DriveTrain, Geometry, JointState, Model, Owner};
use identify::report::result::residuals::residuals_csv;
use identify::report::result::validation::UnseenEntry;
use identify::robot::import;
use identify::simulate::ArmErrors;
use identify::simulate::contact::{self, ContactExperiment, SimulatedContacts};
use nalgebra::{DVector, Rotation3, Vector3};
use shared::config::{self, RobotConfig, Validate};

use crate::support::campaign::size;
use crate::support::command::identify;
use crate::support::truth::{apart_m, assert_claims_hold, draw_joint_errors, rigid_motion};
use crate::support::{irb120, irb2400, repository};

fn seven_axes() -> RobotConfig {
    let text = std::fs::read_to_string(repository("identify/tests/data/seven_axes.urdf")).unwrap();
    import(&text, Some("base"), Some("flange")).unwrap().config
}

fn simulated(robot: &RobotConfig, seed: u64) -> SimulatedContacts {
    let errors = ArmErrors { robot_seed: seed, ..ArmErrors::default() };
    contact::run(&ContactExperiment { errors, seed, ..ContactExperiment::new(robot) }).unwrap()
}

fn calibrated(robot: &RobotConfig, rows: &[TipRow], table: &SocketTable) -> Calibration {
    let data = DataSets { rows: vec![Contact::new(rows, table).unwrap().into()], ..DataSets::default() };
    calibrate(&data, robot, &IdentifyConfig::default(), None).unwrap()
}

#[test]
fn robots_of_six_and_seven_axes_are_calibrated_by_a_ball_in_sockets_alone() {
    for robot in [irb2400(), irb120(), seven_axes()] {
        let SimulatedContacts { rows, table, robot: truth, .. } = simulated(&robot, 1);
        let found = calibrated(&robot, &rows, &table);
        let model = &found.runs[0].model;
        let before_mm = apart_m(&robot, &flange_chain(&robot), &truth) * 1e3;
        let after_mm = apart_m(&robot, &model.geometry(&[]).robot, &truth) * 1e3;
        println!("{}: {before_mm:.3} -> {after_mm:.4} mm", robot.name);
        assert!(after_mm < 0.1 * before_mm, "{}: {before_mm} -> {after_mm}", robot.name);
    }
}

#[test]
fn distances_serve_as_well_as_places_and_two_sockets_are_enough() {
    let robot = irb2400();
    let usual = ContactExperiment::new(&robot);
    let after_mm = |experiment: &ContactExperiment<'_>| {
        let SimulatedContacts { rows, table, robot: truth, .. } = contact::run(experiment).unwrap();
        let model = calibrated(&robot, &rows, &table).runs[0].model.clone();
        apart_m(&robot, &model.geometry(&[]).robot, &truth) * 1e3
    };
    let places = after_mm(&usual);
    let distances = after_mm(&ContactExperiment { distances: true, ..usual.clone() });
    let socket = |name: &str, x| PlacedSocket { name: name.into(), position_mm: [x, 0.0, 0.0], u_um: None };
    let bar = SocketTable {
        u_um: 5.0,
        sockets: vec![socket("one", 0.0), socket("two", 500.0)],
        distances: Vec::new(),
    };
    let two = after_mm(&ContactExperiment { sockets: Some(bar), distances: true, ..usual });
    println!("places {places:.4}, distances {distances:.4}, two sockets {two:.4} mm");
    assert!(places < 0.1 && distances < 0.1 && two < 0.2, "{places} {distances} {two}");
}

/// The held-out regions contain all rows of a socket, so that the other rows do not determine its position.
#[test]
fn rows_that_cannot_be_held_out_are_all_fitted() {
    let robot = irb2400();
    let socket = |number: u8| PlacedSocket {
        name: number.to_string(),
        position_mm: [350.0 * f64::from(number % 3), 350.0 * f64::from(number / 3), 0.0],
        u_um: None,
    };
    let table = SocketTable { u_um: 5.0, sockets: (0..6).map(socket).collect(), distances: Vec::new() };
    let experiment = ContactExperiment { sockets: Some(table), rows: 50, ..ContactExperiment::new(&robot) };
    let SimulatedContacts { rows, table, robot: truth, .. } = contact::run(&experiment).unwrap();
    let rows = Rows { hold_out: Some(HoldOut::Regions), ..Contact::new(&rows, &table).unwrap().into() };
    let data = DataSets { rows: vec![rows], ..DataSets::default() };
    let found = calibrate(&data, &robot, &IdentifyConfig::default(), None).unwrap();
    assert!(found.rows[0].held_out_rows.is_empty());
    let after_mm = apart_m(&robot, &found.model().geometry(&[]).robot, &truth) * 1e3;
    assert!(after_mm < 0.2, "{after_mm}");
}

/// The rows at a socket are predicted by a fit without these rows, which is one step on the normal equations. The prediction
/// is compared with a calibration of the other rows, in which the plate determines the position of the socket.
#[test]
fn rows_at_an_unseen_socket_are_predicted_as_by_a_calibration_without_them() {
    let robot = irb2400();
    let SimulatedContacts { rows, table, .. } = simulated(&robot, 1);
    let found = unseen_parts(&calibrated(&robot, &rows, &table));
    assert_eq!(
        found.iter().map(|part| part.name.as_str()).collect::<Vec<_>>(),
        ["A", "B", "C", "D", "E", "F"]
    );
    assert!(found.iter().all(|part| part.data_set == 0 && UnseenEntry::from(part).data_set == 1));
    for part in &found {
        let left_out = table.names().iter().position(|name| *name == part.name).unwrap();
        let others: Vec<TipRow> = rows.iter().filter(|row| row.part != left_out).copied().collect();
        let calibration = calibrated(&robot, &others, &table);
        let geometry = calibration.runs[0].model.geometry(&[]);
        let ball_m = |row: &TipRow| {
            let state = JointState::at_rest(row.joints_rad);
            geometry.robot_end(&state).transform_point(&geometry.contact.ball_m.into()).coords
        };
        // The other sockets determine the pose of the plate.
        let mut placed = table.sockets.clone();
        let socket_m = Vector3::from(placed.remove(left_out).position_mm) * 1e-3;
        let known_m = placed.iter().map(|one| Vector3::from(one.position_mm) * 1e-3);
        let pairs: Vec<_> =
            geometry.contact.sockets_m.iter().zip(known_m).map(|(at, known)| [*at, known]).collect();
        let there_m = rigid_motion(&pairs).transform_point(&socket_m.into()).coords;
        let squares =
            rows.iter().filter(|row| row.part == left_out).map(|row| (ball_m(row) - there_m).norm_squared());
        let squares: Vec<f64> = squares.collect();
        let refitted_mm = (squares.iter().sum::<f64>() / squares.len() as f64).sqrt() * 1e3;
        let [predicted_mm, fitted_mm] = [part.predicted, part.fitted].map(|one| one.position_m.rms * 1e3);
        println!("{}: {fitted_mm:.4} fitted, {predicted_mm:.4} by the step, {refitted_mm:.4} mm", part.name);
        // The tolerance is wide, because the calibration of the other rows chooses widths of priors and terms again.
        assert!((predicted_mm / refitted_mm).ln().abs() < 0.3, "{predicted_mm} {refitted_mm}");
    }
}

/// Joint 2 has an error that depends on two other joints together, which no term describes. In the fit, each socket is free
/// to move and absorbs some of this error.
#[test]
fn an_error_that_no_term_describes_is_larger_at_unseen_sockets_than_in_the_fit() {
    let robot = irb2400();
    let SimulatedContacts { rows, table, .. } = simulated(&robot, 1);
    let unseen_to_fitted = |rows: &[TipRow]| {
        let found = unseen_parts(&calibrated(&robot, rows, &table));
        let rms = |errors: fn(&UnseenPart) -> &PoseFigures| {
            let squares = found.iter().map(|part| errors(part).position_m.rms.powi(2));
            (squares.sum::<f64>() / found.len() as f64).sqrt()
        };
        rms(|part| &part.predicted) / rms(|part| &part.fitted)
    };
    let mut coupled = rows.clone();
    for TipRow { joints_rad: q, .. } in &mut coupled {
        q[1] += 4e-4 * q[0].sin() * q[2].sin();
    }
    let ratios = [&rows, &coupled].map(|rows| unseen_to_fitted(rows));
    println!("{ratios:.2?}");
    assert!(ratios[0] < 1.5 && ratios[1] > 1.8, "{ratios:?}");
}

/// Compares the derivatives of known positions and distances of sockets with finite differences.
#[test]
fn what_is_known_of_sockets_has_the_derivatives_of_their_places() {
    let placed = |name: &str, at, u_um| PlacedSocket { name: name.into(), position_mm: at, u_um };
    let distance = KnownDistance { between: ["d".into(), "a".into()], distance_mm: 310.0, u_um: Some(7.0) };
    let table = SocketTable {
        u_um: 5.0,
        sockets: vec![
            placed("a", [0.0, 0.0, 0.0], None),
            placed("b", [300.0, 20.0, 0.0], Some(9.0)),
            placed("c", [80.0, 200.0, 0.0], None),
            placed("d", [10.0, 30.0, 150.0], Some(3.0)),
        ],
        distances: vec![distance],
    };
    table.validate().unwrap();
    let sockets = Sockets::new(&table, &table.names());
    let turn = Rotation3::new(Vector3::new(0.4, -1.9, 0.7));
    // Compare derivatives at the best fit of the plate. As in the Gauss-Newton method, they
    // omit terms that contain residuals.
    let at: Vec<Vector3<f64>> = table
        .sockets
        .iter()
        .map(|one| turn * Vector3::from(one.position_mm) * 1e-3 + Vector3::new(0.7, 0.1, 0.4))
        .collect();
    let with = |sockets_m: &[Vector3<f64>]| {
        let mut geometry = Geometry::new(Chain::new(Pose::identity(), Vec::new()), None);
        geometry.contact.sockets_m = sockets_m.to_vec();
        geometry
    };
    assert_eq!(sockets.knowns(), 5);
    for known in 0..sockets.knowns() {
        let (residual, by) = sockets.known(known, &with(&at)).unwrap();
        assert_eq!(residual.len(), sockets.rows_of(known));
        assert!(known == 4 || residual.amax() < 1e-6, "{residual}");
        for column in 0..12 {
            let moved = |step: f64| -> DVector<f64> {
                let mut at = at.clone();
                at[column / 3][column % 3] += step;
                sockets.known(known, &with(&at)).unwrap().0
            };
            let expected = (moved(1e-7) - moved(-1e-7)) / 2e-7;
            let off = (by.column(column) - expected).amax();
            assert!(off < 1e-3 * by.amax().max(1.0), "{known} by {column}: {off:e}");
        }
    }
    let mut wrong = at.clone();
    assert!(sockets.contradicted(&with(&at)).iter().all(|one| one.contains("the distance between")));
    wrong[1] += Vector3::new(1e-3, 0.0, 0.0);
    let contradicted = sockets.contradicted(&with(&wrong));
    assert!(
        contradicted.iter().any(|one| one.starts_with("the place of socket `b` by ")),
        "{contradicted:?}"
    );
}

/// The two rows differ by the noise of the encoders only.
#[test]
fn a_socket_whose_only_pose_was_logged_twice_is_refused_by_name() {
    let SimulatedContacts { mut rows, table, .. } = simulated(&irb120(), 1);
    let socket = table.names().iter().position(|name| *name == "D").unwrap();
    let row = *rows.iter().find(|row| row.part == socket).unwrap();
    let mut again = row;
    again.joints_rad[0] += 1e-6;
    rows.retain(|row| row.part != socket);
    rows.extend([row, again]);
    let error = Contact::new(&rows, &table).unwrap_err();
    assert!(matches!(&error, RowError::VisitedOnce { socket } if socket == "D"), "{error}");
}

/// Two distances of the same sockets would count as independent.
#[test]
fn a_second_distance_between_two_sockets_is_refused() {
    let distance =
        |names: [&str; 2]| KnownDistance { between: names.map(Into::into), distance_mm: 250.0, u_um: None };
    let table = |second| SocketTable {
        u_um: 5.0,
        sockets: Vec::new(),
        distances: vec![distance(["A", "B"]), distance(second)],
    };
    assert!(table(["A", "C"]).validate().is_ok());
    assert_eq!(table(["B", "A"]).validate().unwrap_err().key, "distance[1].between");
}

#[test]
fn rows_of_a_wrong_socket_take_no_part() {
    let robot = irb120();
    let SimulatedContacts { mut rows, table, robot: truth, .. } = simulated(&robot, 2);
    for row in [20, 77, 131] {
        rows[row].part = (rows[row].part + 1) % 6;
    }
    let found = calibrated(&robot, &rows, &table);
    assert_eq!(
        found.runs[0].instrument.rejected().iter().map(|one| one.row).collect::<Vec<_>>(),
        [20, 77, 131]
    );
    // The file of residuals contains all rows with their line numbers, and marks unused rows. The residual of the unused row
    // is about the distance between two sockets.
    let lines: Vec<u64> = (2..).take(rows.len()).collect();
    let text = residuals_csv(&found, &[&lines]).unwrap();
    let table: Vec<Vec<&str>> = text.lines().skip(1).map(|line| line.split(',').collect()).collect();
    assert_eq!(table.len(), rows.len());
    for (row, cells) in table.iter().enumerate() {
        let [data_set, instrument, sample, line, _, used, why] = cells[..7] else { panic!() };
        assert_eq!((data_set, instrument), ("1", "contact"));
        assert_eq!((sample.parse(), line.parse()), (Ok(row + 1), Ok(row as u64 + 2)));
        let off_mm = cells[7..10].iter().map(|mm| mm.parse::<f64>().unwrap().powi(2)).sum::<f64>().sqrt();
        let is_wrong = [20, 77, 131].contains(&row);
        assert_eq!(
            (used, why.is_empty(), off_mm > 10.0),
            (if is_wrong { "false" } else { "true" }, !is_wrong, is_wrong)
        );
    }
    let after_m = apart_m(&robot, &found.runs[0].model.geometry(&[]).robot, &truth);
    assert!(after_m < 1e-4, "{after_m}");
}

#[test]
#[ignore = "takes minutes"]
fn intervals_of_links_hold_95_percent_over_robots() {
    for robot in [irb2400(), irb120(), seven_axes()] {
        let simulated = |seed, gear_sine_urad| {
            let errors = ArmErrors { gear_sine_urad, robot_seed: seed, ..ArmErrors::default() };
            contact::run(&ContactExperiment { errors, seed, ..ContactExperiment::new(&robot) }).unwrap()
        };
        let calibrated = |made: &SimulatedContacts| calibrated(&robot, &made.rows, &made.table);
        let with_truth = |made: SimulatedContacts| (calibrated(&made), made.truth.parameters);
        let seeds = 1..=size(6, 30);
        // These robots have smaller joint errors than a calibration assumes, ..
        assert_claims_hold(&robot, seeds.clone().map(|seed| with_truth(simulated(seed, 30.0))));
        // .. and these robots have the assumed ones.
        let model = calibrated(&simulated(1, 0.0)).model().clone();
        let drawn = seeds.map(|seed| {
            let mut made = simulated(seed, 0.0);
            draw_joint_errors(&model, &mut made.rows, &mut made.truth.parameters, seed);
            with_truth(made)
        });
        assert_claims_hold(&robot, drawn);
    }
}

/// Runs `identify` on files in this directory. Returns whether it succeeded, and its output as words.
fn run_identify(directory: &Path, rows: &str, sockets: &str) -> (bool, String) {
    let [rows, sockets, mapping] = [rows, sockets, "contact.toml"].map(|name| directory.join(name));
    let [rows, sockets, mapping] = [&rows, &sockets, &mapping].map(|path| path.to_str().unwrap());
    let arguments = ["calibrate", "contact", rows, "--sockets", sockets, "--mapping", mapping, "--verbose"];
    let output = identify(&arguments, "irb120_3.toml", &directory.join("out"));
    let texts = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
    // The output is wrapped to the width of a terminal, so line breaks are removed.
    let words: Vec<String> = texts.concat().split_whitespace().map(Into::into).collect();
    (output.status.success(), words.join(" "))
}

/// Runs `identify calibrate` on an experiment file, with further arguments `more`. Returns its output.
fn experiment(file: &Path, out: &Path, more: &[&str]) -> String {
    let run = std::process::Command::new(env!("CARGO_BIN_EXE_identify"))
        .args(["calibrate", "--verbose", "--experiment"])
        .arg(file)
        .arg("--out")
        .arg(out)
        .args(more)
        .output()
        .unwrap();
    String::from_utf8([run.stdout, run.stderr].concat()).unwrap()
}

/// `inspect` describes the rows without a calibration, even if a row has a wrong name. It proposes a mapping.
fn inspected(at: &Path, rows: &str) {
    let robot = repository("config/robots/irb120_3.toml");
    let inspect = |file: &str, more: &[&str]| {
        let run = std::process::Command::new(env!("CARGO_BIN_EXE_identify"))
            .current_dir(at)
            .args(["inspect", file, "--robot", robot.to_str().unwrap()])
            .args(more)
            .output()
            .unwrap();
        String::from_utf8([run.stdout, run.stderr].concat()).unwrap()
    };
    let usual = ["--sockets", "sockets.toml", "--contact-mapping", "contact.toml"];
    let text = inspect("contacts.csv", &usual);
    assert!(text.contains("200: A 34, B 34, C 33") && text.contains("nothing suspicious"), "{text}");
    std::fs::write(at.join("wrong.csv"), rows.replacen(",D\n", ",E\n", 1)).unwrap();
    let text = inspect("wrong.csv", &usual);
    assert!(
        text.contains("! line 5: the ball is") && text.contains("from `D`: look for a wrong name"),
        "{text}"
    );
    std::fs::write(at.join("copied.csv"), rows.to_owned() + rows.lines().last().unwrap()).unwrap();
    let text = inspect("copied.csv", &usual);
    assert!(text.contains("! 1 of 201 rows are copies of earlier rows"), "{text}");
    let text = inspect("contacts.csv", &["--propose", "proposed.toml"]);
    assert!(text.contains("`identify calibrate contact --mapping`"), "{text}");
    let [written, proposed] =
        ["contact.toml", "proposed.toml"].map(|name| config::load::<ContactMapping>(&at.join(name)).unwrap());
    let names = |mapping: &ContactMapping| {
        let joints =
            mapping.joints.iter().map(|joint| (joint.column.clone(), joint.unit)).collect::<Vec<_>>();
        (mapping.socket.clone(), joints)
    };
    assert_eq!(names(&proposed), names(&written));
}

/// The robot is exactly nominal. Any calibration predicts worse than the nominal robot, so the verdict is red.
#[test]
fn a_red_verdict_leaves_its_page_also_in_a_new_directory() {
    let directory = tempfile::tempdir().unwrap();
    let at = directory.path();
    let mut exact = vec!["simulate", "contact"];
    for option in ["--errors-mm-mrad", "--robot-noise-urad", "--gear-sine-urad", "--seating-um"] {
        exact.extend([option, "0"]);
    }
    assert!(identify(&exact, "irb120_3.toml", at).status.success());
    let (done, text) = run_identify(at, "contacts.csv", "sockets.toml");
    assert!(
        !done && text.contains("verdict red") && text.contains("report.html shows what was found"),
        "{text}"
    );
    assert!(at.join("out/report.html").exists() && at.join("out/experiment.toml").exists());
}

#[test]
fn a_person_simulates_calibrates_and_repeats_it() {
    let directory = tempfile::tempdir().unwrap();
    let at = directory.path();
    assert!(identify(&["simulate", "contact"], "irb120_3.toml", at).status.success());
    let (done, text) = run_identify(at, "contacts.csv", "sockets.toml");
    assert!(done && text.contains("verdict green") && text.contains("SIMULATED"), "{text}");
    assert!(text.contains("socket6_z") && text.contains("robot.urdf"), "{text}");
    let page = std::fs::read_to_string(at.join("out/report.html")).unwrap();
    assert!(page.contains("contact, ") && page.contains("held-out rows, calibrated, RMS"));
    assert!(page.contains("stated geometry of sockets or faces") && page.contains("mounting of the ball"));
    // The name `ball_x` begins like names of the bar's parameters, but is not one of them.
    assert!(page.contains(">ball_x") && !page.contains("Ball-bar and encoders"));
    // The experiment file also names a second plate that was measured with the same robot.
    let other = at.join("other");
    let simulated =
        identify(&["simulate", "contact", "--seed", "2", "--robot-seed", "1"], "irb120_3.toml", &other);
    assert!(simulated.status.success(), "{}", String::from_utf8_lossy(&simulated.stderr));
    let block = |place: &str| {
        format!(
            "[[contact]]\nfile = \"{place}contacts.csv\"\nmapping = \"{place}contact.toml\"\nsockets = \"{place}sockets.toml\"\n"
        )
    };
    let robot = repository("config/robots/irb120_3.toml");
    let both = format!("robot = {:?}\n{}{}", robot.to_str().unwrap(), block(""), block("other/"));
    std::fs::write(at.join("both.toml"), both).unwrap();
    let text = experiment(&at.join("both.toml"), &at.join("both"), &[]);
    assert!(text.contains("verdict green") && text.contains("contact (data set 2)"), "{text}");
    let of_both = std::fs::read_to_string(at.join("both/calibration.toml")).unwrap();
    assert!(
        of_both.contains("instrument = \"2 times contact\"") && of_both.contains("socket6_z@2"),
        "{of_both}"
    );
    // Measurements that occur in two data sets do not count twice.
    let twice = format!("robot = {:?}\n{}{}", robot.to_str().unwrap(), block(""), block("copy/"));
    std::fs::create_dir(at.join("copy")).unwrap();
    for name in ["contacts.csv", "contact.toml", "sockets.toml"] {
        std::fs::copy(at.join(name), at.join("copy").join(name)).unwrap();
    }
    std::fs::write(at.join("twice.toml"), twice).unwrap();
    let text = experiment(&at.join("twice.toml"), &at.join("twice"), &[]);
    assert!(text.contains("data sets 1 and 2 are the same measurements"), "{text}");
    assert!(!at.join("twice").exists());
    // A table of sockets is only accepted for the instrument with a ball in sockets.
    let without = format!("robot = {:?}\n{}", robot.to_str().unwrap(), block("").replace("sockets =", "#"));
    std::fs::write(at.join("without.toml"), without).unwrap();
    let text = experiment(&at.join("without.toml"), &at.join("without"), &[]);
    assert!(text.contains("contact[0].sockets"), "{text}");
    // The experiment file next to a result reproduces the result to the last digit.
    let values = |out: &Path| {
        let text = std::fs::read_to_string(out.join("calibration.toml")).unwrap();
        text.lines().filter(|line| line.starts_with("value")).map(str::to_owned).collect::<Vec<_>>()
    };
    let again = at.join("again");
    let text = experiment(&at.join("out/experiment.toml"), &again, &[]);
    assert!(text.contains("verdict green"), "{text}");
    assert!(!values(&again).is_empty() && values(&again) == values(&at.join("out")));
    // The result is also the same after the directory of data and result was moved, and with another required accuracy.
    let moved = at.join("moved");
    std::fs::create_dir_all(moved.join("out")).unwrap();
    for name in ["contacts.csv", "contact.toml", "sockets.toml", "out/experiment.toml"] {
        std::fs::copy(at.join(name), moved.join(name)).unwrap();
    }
    std::fs::rename(at.join("contacts.csv"), at.join("gone.csv")).unwrap();
    let text = experiment(&moved.join("out/experiment.toml"), &again, &["--require", "0.0001mm"]);
    assert!(
        text.contains("verdict amber: ") && text.contains("The required 0.0001 mm are not met"),
        "{text}"
    );
    assert_eq!(values(&again), values(&at.join("out")));
    std::fs::rename(at.join("gone.csv"), at.join("contacts.csv")).unwrap();

    // Removes the comment that marks the rows as simulated.
    let rows = std::fs::read_to_string(at.join("contacts.csv")).unwrap();
    let rows = rows.split_once('\n').unwrap().1.to_owned();
    inspected(at, &rows);
    let sockets = std::fs::read_to_string(at.join("sockets.toml")).unwrap();
    let with = |rows: String, sockets: String| {
        std::fs::write(at.join("rows.csv"), rows).unwrap();
        std::fs::write(at.join("table.toml"), sockets).unwrap();
        run_identify(at, "rows.csv", "table.toml")
    };
    let header = rows.lines().next().unwrap();
    let of_sockets = |count: usize, names: &str| {
        let kept = rows.lines().skip(1).filter(|row| row.ends_with(|end: char| names.contains(end)));
        let kept = kept.take(count).map(|row| format!("{row}\n"));
        format!("{header}\n{}", kept.collect::<String>())
    };
    let refused = |rows: String, sockets: &str, why: &[&str]| {
        let (done, text) = with(rows, sockets.to_owned());
        assert!(!done && why.iter().all(|why| text.contains(why)), "{why:?}: {text}");
    };
    let renamed = rows.replacen(",C\n", ",Z\n", 1);
    refused(renamed, &sockets, &["line 4", "no socket is called `Z`", "A, B, C, D, E, F"]);
    let second = rows.lines().nth(2).unwrap();
    let not_a_number = format!("NaN{}", &second[second.find(',').unwrap()..]);
    refused(rows.replacen(second, &not_a_number, 1), &sockets, &["line 3", "q1_deg", "not a finite number"]);
    refused(of_sockets(40, "B"), &sockets, &["all rows are of socket `B`", "at least two"]);
    refused(of_sockets(20, "AB"), &sockets, &["20 rows in 2 sockets are too few, at least 22"]);
    let once = of_sockets(60, "AB") + rows.lines().nth(4).unwrap() + "\n";
    refused(once, &sockets, &["the rows of socket `D` have one posture"]);
    let apart = "u_um = 5.0\n[[distance]]\nbetween = [\"C\", \"D\"]\ndistance_mm = 250.0\n[[socket]]\nname = \"A\"\n\
                 position_mm = [0, 0, 0]\n[[distance]]\nbetween = [\"B\", \"E\"]\ndistance_mm = 250.0\n";
    refused(of_sockets(60, "AB"), apart, &["no distance is known between the sockets of these rows (A, B)"]);
    refused(rows.clone(), "u_um = 5.0\n", &["key `socket`", "no distance between sockets is known"]);
    refused(rows.clone(), &sockets.replace("u_um = 5.0", "u_um = 0"), &["key `u_um`", "above zero"]);

    let doubled =
        "u_um = 5.0\n".to_owned() + &"[[socket]]\nname = \"A\"\nposition_mm = [0, 0, 0]\n".repeat(2);
    refused(rows.clone(), &doubled, &["key `socket[1].name`", "two sockets have the name `A`"]);
    refused(rows.clone(), &doubled.replacen("\"A\"", "\"B\"", 1), &["`A` has the position of `B`"]);

    // A wrong position of a socket is named, and the verdict is not green.
    let place = sockets
        .lines()
        .find(|line| line.starts_with("position_mm = [") && !line.contains("[0.0, 0.0"))
        .unwrap();
    let (done, text) = with(rows.clone(), sockets.replacen(place, &place.replacen("0.0,", "1.0,", 1), 1));
    assert!(
        done && text.contains("verdict amber: ")
            && text.contains("The rows contradict the table of sockets or faces: the place of socket `"),
        "{text}"
    );
    // The message about a row with a wrong socket names the right one.
    let (done, text) = with(rows.replacen(",D\n", ",E\n", 1), sockets.clone());
    assert!(
        done && text.contains("line 5: off by ") && text.contains("from `D`: look for a wrong name"),
        "{text}"
    );
}

/// Simulates a robot with gear errors. If the true gear terms correct the joints, the ball must be in its sockets.
#[test]
fn gear_errors_of_the_truth_seat_the_ball() {
    for robot in [irb120(), seven_axes()] {
        let experiment = ContactExperiment {
            rows: 30,
            errors: ArmErrors { robot_noise_urad: 0.0, gear_sine_urad: 50.0, ..ArmErrors::default() },
            seating_um: 0.0,
            ..ContactExperiment::new(&robot)
        };
        let made = contact::run(&experiment).unwrap();
        let mut model = Model::alone(&made.robot)
            .with_set_ups(Owner::Contact, [made.truth.sockets.len(), 1])
            .without_clocks()
            .with_drives(DriveTrain::from_robot(&robot, &made.robot));
        let mut terms = 0;
        for (name, value) in made
            .truth
            .parameters
            .iter()
            .filter(|(name, _)| name.starts_with("rsin") || name.starts_with("rcos"))
        {
            model.set_value(name.parse().unwrap(), *value).unwrap();
            terms += 1;
        }
        assert_eq!(terms, 2 * robot.axes());
        let geometry = model.geometry(&[]);
        let place = |name: &str| {
            Vector3::from(["x", "y", "z"].map(|axis| made.truth.parameters[&format!("{name}_{axis}")]))
        };
        for row in &made.rows {
            let end = geometry.robot_end(&JointState::at_rest(row.joints_rad));
            let ball = end * nalgebra::Point3::from(place("ball"));
            let off_m = (ball.coords - place(&format!("socket{}", row.part + 1))).norm();
            assert!(off_m < 1e-7, "{off_m}");
        }
    }
}
