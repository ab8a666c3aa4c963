//! Calibration from measured poses, both on simulated rows with known truth and on a real UR10 with a laser tracker.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]
#![allow(clippy::print_stdout, reason = "figures of a run")]

use std::path::Path;

use identify::calibrate::rows::validate;
use identify::calibrate::rows::{PoseFigures, Stages, is_surely_better};
use identify::calibrate::validation::deployment::Deployment;
use identify::instrument::{HoldOut, Instrument, Tracker};
use identify::kinematics::{Chain, Pose, flange_chain};
use identify::logs::{MeasuredPoseMapping, MeasuredPoses, PoseRow, PoseUncertainty};
use identify::model::{JointState, Model, ParameterId};
use identify::report::result::corrections::Correction;
use identify::report::result::file::CalibrationFile;
use nalgebra::{Rotation3, Vector3};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use rand_distr::StandardNormal;
use shared::config;

use crate::support::rows::{Alone, Found};
use crate::support::ur10;

/// Rows of a real robot that a tracker measured, from a file of this repository.
pub fn fixture(name: &str) -> Vec<PoseRow> {
    real_rows(&crate::support::repository("identify/tests/data/ur10").join(name))
}

fn real_rows(path: &Path) -> Vec<PoseRow> {
    let mapping: MeasuredPoseMapping =
        config::load(&crate::support::repository("config/measured_pose.toml")).unwrap();
    MeasuredPoses::load(path, &mapping).unwrap().rows
}

/// Rows of a tracker at a random position. Also returns the true robot, the pose of the tracker and the pose of the probe.
/// The robot has errors of some mm and mrad, and a harmonic of order 17 on joint 2.
fn made_up(count: usize, noise: f64, wave_rad: f64) -> (Vec<PoseRow>, Chain, Pose, Pose) {
    let mut random = StdRng::seed_from_u64(5);
    let mut truth = flange_chain(&ur10());
    for link in truth.links.iter_mut().take(5) {
        link.a_m += random.random_range(-1e-3..1e-3);
        link.theta_rad += random.random_range(-4e-3..4e-3);
        link.alpha_rad += random.random_range(-2e-3..2e-3);
    }
    let place =
        Pose::from_parts(Vector3::new(-3.0, 0.5, 1.3).into(), Rotation3::new(Vector3::new(0.4, 1.9, -2.1)));
    let probe =
        Pose::from_parts(Vector3::new(0.0, -0.03, 0.09).into(), Rotation3::new(Vector3::new(0.1, -1.5, 0.3)));
    let rows = (0..count).map(|_| {
        let joints_rad: [f64; 6] = std::array::from_fn(|_| random.random_range(-1.5..1.5));
        let mut moved = joints_rad;
        moved[1] += wave_rad * (17.0 * joints_rad[1] + 0.4).sin();
        let mut seen = place.inverse() * truth.forward(&moved) * probe;
        let mut white = || noise * random.sample::<f64, _>(StandardNormal);
        seen.translation.vector += Vector3::new(white(), white(), white());
        seen.rotation = Rotation3::new(Vector3::new(white(), white(), white())) * seen.rotation;
        PoseRow {
            joints_rad: joints_rad.into(),
            position_m: seen.translation.vector,
            rotation: Some(seen.rotation),
            ..PoseRow::default()
        }
    });
    (rows.collect(), truth, place, probe)
}

/// Root mean square difference between the estimated and the true error of joint 2 \[rad\]. The constant part is subtracted,
/// because it belongs to the link.
fn wave_error_rad(geometry: &identify::model::Geometry) -> f64 {
    let wrong = |k: i32| {
        let angle = 0.01 * f64::from(k);
        let reported = JointState::at_rest([0.0, angle, 0.0, 0.0, 0.0, 0.0]);
        geometry.corrected(&reported).q[1] - angle - 3e-4 * (17.0 * angle + 0.4).sin()
    };
    let wrong: Vec<f64> = (-140..=140).map(wrong).collect();
    let mean = wrong.iter().sum::<f64>() / wrong.len() as f64;
    (wrong.iter().map(|w| (w - mean).powi(2)).sum::<f64>() / wrong.len() as f64).sqrt()
}

#[test]
fn tracker_probe_robot_and_joint_waves_are_found_and_what_is_not_there_is_left_out() {
    let (rows, truth, place, _) = made_up(800, 2e-5, 3e-4);
    let report = Alone::quick().poses(&rows, &ur10()).unwrap();
    println!("{}", report.table());
    let Stages { nominal, links, joints, .. } = report.held_out();
    assert_eq!((nominal.rows, report.fitted().joints.rows), (160, 640));
    assert!(nominal.position_m.rms > 1e-3 && links.position_m.rms > 1e-4);
    // The errors were evaluated on held-out rows. The final fit then used all rows.
    assert_eq!(report.0.solved.solution.summary.samples_used, 800);
    // The norm of the noise of three coordinates has an RMS of 3.5e-5 m.
    assert!(joints.position_m.rms < 4.5e-5, "{joints:?}");
    assert!(joints.rotation_rad.unwrap().rms < 4.5e-5, "{joints:?}");
    let taken: Vec<&str> =
        report.0.solved.candidates.iter().filter(|t| t.sigma.is_some()).map(|t| t.name.as_str()).collect();
    assert!(taken.contains(&"11 to 20 waves per turn"), "{taken:?}");
    assert!(taken.iter().all(|name| name.contains("waves")), "{taken:?}");
    let geometry = report.model().geometry(&report.model().start());
    assert!(wave_error_rad(&geometry) < 2e-5, "{}", wave_error_rad(&geometry));
    let value = |name: &str| report.model().parameter(name.parse().unwrap()).unwrap().value;
    // Height and rotation of the tracker absorb errors of the length and the offset of link 1.
    // Therefore compare other parameters.
    let tracker = geometry.tracker.places[0].pose();
    assert!((tracker.translation.vector - place.translation.vector).norm() < 2e-2);
    assert!((value("ra2") - truth.links[1].a_m).abs() < 5e-5);
    let sigma = report.sigma("ra2".parse().unwrap()).unwrap();
    assert!((value("ra2") - truth.links[1].a_m).abs() < 4.0 * sigma && sigma < 5e-5, "{sigma}");
}

#[test]
fn a_fifth_of_gross_faults_changes_little() {
    let (mut rows, ..) = made_up(600, 2e-5, 0.0);
    let links = Alone::quick().without_joint_errors();
    let clean = links.poses(&rows, &ur10()).unwrap();
    let untouched = rows.clone();
    for row in rows.iter_mut().step_by(5) {
        row.position_m += Vector3::new(0.05, -0.08, 0.02);
        row.rotation = row.rotation.map(|r| Rotation3::new(Vector3::new(0.1, 0.2, 0.0)) * r);
    }
    let faulty = links.poses(&rows, &ur10()).unwrap();
    let on_clean = |report: &Found| {
        validate(&Tracker::new(&untouched).into(), 1, &ur10(), report.model(), 1).unwrap().figures[1]
            .position_m
            .rms
    };
    println!("{:.2e} -> {:.2e}", on_clean(&clean), on_clean(&faulty));
    assert!(on_clean(&faulty) < 1.5 * on_clean(&clean));
}

#[test]
fn rows_that_are_no_measurements_are_named_and_judge_nothing() {
    let (rows, ..) = made_up(120, 3e-5, 0.0);
    let links = Alone::quick().without_joint_errors();
    let clean = links.poses(&rows, &ur10()).unwrap();
    let wrong: Vec<usize> = (3..120).step_by(10).collect();
    type Spoil = fn(&mut PoseRow);
    let ways: [(&str, Spoil); 3] = [
        ("far", |row| row.position_m.x += 0.05),
        ("a beam that broke", |row| row.position_m = Vector3::zeros()),
        ("another target", |row| row.rotation = row.rotation.map(|r| Rotation3::new(Vector3::x()) * r)),
    ];
    for (name, spoil) in ways {
        let mut spoiled = rows.clone();
        wrong.iter().for_each(|row| spoil(&mut spoiled[*row]));
        let found = links.poses(&spoiled, &ur10()).unwrap();
        let rejected: Vec<usize> = found.rows().rejected.iter().map(|one| one.row).collect();
        assert_eq!(rejected, wrong, "{name}");
        let [held_out, of_clean] = [&found, &clean].map(|found| found.held_out().joints.position_m.max);
        assert!(held_out < 1.5 * of_clean, "{name}: {held_out} {of_clean}");
        assert!(found.table().contains("12 of"), "{}", found.table());
    }
    assert!(clean.rows().rejected.is_empty());
}

#[test]
fn a_tracker_that_was_moved_by_half_a_millimetre_is_named_in_short_files_too() {
    for (count, with_rotations) in [(120, false), (250, false), (120, true)] {
        let (mut rows, ..) = made_up(count, 3e-5, 0.0);
        rows.iter_mut().for_each(|row| row.rotation = row.rotation.filter(|_| with_rotations));
        let links = Alone::quick().without_joint_errors();
        assert_eq!(links.poses(&rows, &ur10()).unwrap().0.changed, []);
        rows[count / 2..].iter_mut().for_each(|row| row.position_m.x += 5e-4);
        let changed = links.poses(&rows, &ur10()).unwrap().0.changed;
        let causes: Vec<&str> = changed.iter().map(|one| one.likeliest.cause.name.as_str()).collect();
        assert_eq!(causes, ["the place of the tracker"], "{count} rows, {with_rotations}");
        assert_eq!(changed[0].others, [], "{count} rows, {with_rotations}");
    }
}

#[test]
fn positions_alone_calibrate_too() {
    let (mut rows, ..) = made_up(500, 2e-5, 0.0);
    rows.iter_mut().for_each(|row| row.rotation = None);
    let report = Alone::quick().without_joint_errors().poses(&rows, &ur10()).unwrap();
    assert_eq!(report.0.runs[0].instrument.cost(), "measured_position");
    assert!(report.held_out().links.rotation_rad.is_none());
    assert!(report.held_out().links.position_m.rms < 4.5e-5, "{:?}", report.held_out().links);
}

/// Half of the rows have fifteen times as much noise, and the file states this uncertainty for them.
#[test]
fn rows_of_two_qualities_calibrate_better_with_their_uncertainties() {
    let (clean, ..) = made_up(500, 2e-5, 0.0);
    let (good, bad) = (2e-5, 3e-4);
    let mut random = StdRng::seed_from_u64(9);
    let mut stated = clean.clone();
    for row in stated.iter_mut().skip(1).step_by(2) {
        let mut white = || bad * random.sample::<f64, _>(StandardNormal);
        row.position_m += Vector3::new(white(), white(), white());
        row.rotation = row.rotation.map(|r| Rotation3::new(Vector3::new(white(), white(), white())) * r);
    }
    let untold = stated.clone();
    let state = |rows: &mut [PoseRow], times: f64| {
        for (row, u) in rows.iter_mut().zip([good, bad].into_iter().cycle()) {
            row.uncertainty = PoseUncertainty { position_m: Some(times * u), rotation_rad: Some(times * u) };
        }
    };
    state(&mut stated, 1.0);
    // If all stated uncertainties are wrong by the same factor, the relative weights remain correct.
    let (mut too_small, mut too_large) = (stated.clone(), stated.clone());
    state(&mut too_small, 0.5);
    state(&mut too_large, 5.0);
    let links = Alone::quick().without_joint_errors();
    let error_m = |rows: &[PoseRow]| {
        let found = links.poses(rows, &ur10()).unwrap();
        let truly = validate(&Tracker::new(&clean).into(), 1, &ur10(), found.model(), 1).unwrap().figures[1]
            .position_m
            .rms;
        // Error that the calibration causes: the noise of the held-out rows is subtracted.
        let beyond = |rms: f64| (rms.powi(2) - 3.0 * good * good).max(0.0).sqrt();
        (beyond(truly), found.sigma("ra2".parse().unwrap()).unwrap())
    };
    let [untold, stated, too_small, too_large] =
        [&untold, &stated, &too_small, &too_large].map(|rows| error_m(rows));
    println!("without {untold:?}, with {stated:?}, too small {too_small:?}, too large {too_large:?}");
    assert!(stated.1 < 0.7 * untold.1, "{stated:?} {untold:?}");
    assert!(stated.0 < untold.0 && too_large.0 < untold.0 && too_small.0 < untold.0);
}

#[test]
fn rows_and_options_that_make_no_sense_are_errors() {
    let (mut rows, ..) = made_up(100, 2e-5, 0.0);
    let text = |rows: &[PoseRow]| match Alone::quick().poses(rows, &ur10()) {
        Ok(_) => String::new(),
        Err(error) => error.to_string(),
    };
    assert!(text(&rows[..20]).contains("at least 20"));
    assert!(text(&vec![rows[0]; 50]).contains("on a line"));
    rows[7].position_m.x = f64::NAN;
    assert!(text(&rows).contains("row 8"));
    let few: Instrument = Tracker::new(&rows[..5]).into();
    let nominal = Model::alone(&flange_chain(&ur10()));
    let error = validate(&few, 3, &ur10(), &nominal, 1).unwrap_err().to_string();
    assert!(error.starts_with("data set 3: 5 usable rows"), "{error}");
}

/// The rows as a table for the shipped mapping.
fn csv(rows: &[PoseRow]) -> String {
    let mut text = String::from(
        "shoulder_pan_joint;shoulder_lift_joint;elbow_joint;wrist_1_joint;wrist_2_joint;wrist_3_joint;measurement_x;\
         measurement_y;measurement_z;measurement_rx;measurement_ry;measurement_rz\n",
    );
    for row in rows {
        let m = *row.rotation.unwrap().matrix();
        // Intrinsic rotations about x, y and z.
        let angles = [(-m[(1, 2)]).atan2(m[(2, 2)]), m[(0, 2)].asin(), (-m[(0, 1)]).atan2(m[(0, 0)])];
        let position = row.position_m.iter().map(|p| p * 1e3);
        let numbers = row.joints_rad.into_iter().chain(position).chain(angles.map(f64::to_degrees));
        let cells: Vec<String> = numbers.map(|number| number.to_string().replace('.', ",")).collect();
        text += &(cells.join(";") + "\n");
    }
    text
}

#[test]
#[ignore = "needs chromium"]
fn the_command_calibrates_validates_and_writes_what_it_took() {
    let folder = tempfile::tempdir().unwrap();
    let (rows, ..) = made_up(500, 2e-5, 3e-4);
    std::fs::write(folder.path().join("poses.csv"), csv(&rows[..400])).unwrap();
    std::fs::write(folder.path().join("other.csv"), csv(&rows[400..])).unwrap();
    let command = |extra: &[&str]| {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_identify"));
        command.args(["calibrate", "tracker", "poses.csv", "--out", "out", "--joint-waves", "20"]);
        command.arg("--robot").arg(crate::support::repository("config/robots/ur10.toml"));
        command.args(extra).current_dir(folder.path()).output().unwrap()
    };
    let mapping = crate::support::repository("config/measured_pose.toml");
    let mapping = [
        "--mapping",
        mapping.to_str().unwrap(),
        "--validate",
        "other.csv",
        "--hold-out",
        "rows",
        "--verbose",
    ];
    let done = command(&mapping);
    let (out, err) = (String::from_utf8(done.stdout).unwrap(), String::from_utf8(done.stderr).unwrap());
    assert!(done.status.success(), "{err}");
    for part in
        ["held out", "other.csv", "calibrated robot", "11 to 20 waves per turn: taken", "joint offsets"]
    {
        assert!(out.contains(part), "{part} is not in\n{out}");
    }
    let written = std::fs::read_to_string(folder.path().join("out/calibration.toml")).unwrap();
    assert!(written.contains("rsin17_2") && written.contains("tracker_rx"));
    let corrections = |name: &str| -> Vec<Correction> {
        let mut read = csv::Reader::from_path(folder.path().join("out").join(name)).unwrap();
        read.deserialize().map(Result::unwrap).collect()
    };
    let (offsets, links) = (corrections("offsets.csv"), corrections("corrections.csv"));
    assert!(offsets.iter().all(|row| row.deployment == Deployment::Offsets && !row.what.starts_with("link")));
    assert!(links.iter().any(|row| row.what == "link 2 a") && links[0].held_out_mm < offsets[0].held_out_mm);
    // There is no robot log, so the columns of the table contain the joints of the controller.
    let of_table = corrections("corrections_log.csv");
    assert!(of_table[1].what == "shoulder_lift_joint" && of_table[1].unit == "rad", "{of_table:?}");
    // A row with a joint angle outside the measured range is reported.
    let mut beyond = rows[400..].to_vec();
    beyond[6].joints_rad[3] = 2.2;
    std::fs::write(folder.path().join("other.csv"), csv(&beyond)).unwrap();
    let said = String::from_utf8(command(&mapping[..6]).stdout).unwrap();
    let said = said.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(
        said.contains("1 of 100 rows are where")
            && said.contains("joints 4 were")
            && said.contains("lines 8"),
        "{said}"
    );
    assert!(said.contains("supported (deg): joint 1 -8"), "{said}");
    std::fs::write(folder.path().join("other.csv"), csv(&rows[400..])).unwrap();
    let page = std::fs::read_to_string(folder.path().join("out/report.html")).unwrap();
    // Rows without times have no parameters of a clock.
    assert!(!page.contains("clock_sk"));
    let shown = crate::support::browser::shown(&page);
    assert!(shown.foreign.is_empty(), "{:?}", shown.foreign);
    for part in ["tracker, 80 held-out rows, calibrated", "Rotation, calibrated", "tracker_rx", "other.csv"] {
        assert!(shown.document.contains(part), "{part}");
    }
    // The experiment file next to a result reproduces the result from any working directory.
    let experiment = |file: &Path| {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_identify"));
        command.args(["calibrate", "--out", "again", "--experiment"]).arg(file);
        let output = command.current_dir(folder.path()).output().unwrap();
        (output.status.success(), String::from_utf8(output.stderr).unwrap())
    };
    let found = |name: &str| CalibrationFile::open(&folder.path().join(name)).unwrap();
    let (repeated, err) = experiment(&folder.path().join("out/experiment.toml"));
    assert!(repeated, "{err}");
    assert_eq!(found("out").parameters, found("again").parameters);
    // Two files of one robot are combined in a single solve. Each file has its own tracker and probe.
    let text = std::fs::read_to_string(folder.path().join("out/experiment.toml")).unwrap();
    let second =
        "\n[[tracker]]\nfile = \"../other.csv\"\nmapping = \"MAPPING\"\n".replace("MAPPING", mapping[1]);
    let two = text.clone() + &second;
    // Paths in an experiment file are relative to the file itself.
    let path = folder.path().join("out/two.toml");
    std::fs::write(&path, &two).unwrap();
    let (solved, err) = experiment(&path);
    assert!(solved, "{err}");
    let names: Vec<String> = found("again").parameters.into_iter().map(|one| one.name).collect();
    // One fifth of the rows is held out. Of the second file, whole regions are held out, so the
    // fraction is only approximately one fifth.
    let held_out: Vec<(usize, u64)> =
        found("again").rows.iter().map(|rows| (rows.held_out.joints.rows, rows.seed)).collect();
    assert!(held_out[0] == (80, 1042) && (15..=25).contains(&held_out[1].0), "{held_out:?}");
    assert_eq!(held_out[1].1, 1042);
    let page = std::fs::read_to_string(folder.path().join("again/report.html")).unwrap();
    assert!(page.contains("tracker (data set 2)") && page.contains("tracker_x@2"));
    assert!(["ra2", "tracker_x", "tracker_x@2"].iter().all(|name| names.iter().any(|one| one == name)));
    let judged = text + &second.replace("[[tracker]]", "[[wire]]\nvalidate_mapping = \"other.toml\"");
    for (wrong, said) in
        [("recrding = 1\n".to_owned() + &two, "recrding"), (judged, "wire[0].validate_mapping")]
    {
        std::fs::write(&path, wrong).unwrap();
        let (solved, err) = experiment(&path);
        assert!(!solved && err.contains(said), "{err}");
    }
    let refused = |extra: &[&str]| {
        let output = command(extra);
        assert!(!output.status.success(), "{extra:?}");
        String::from_utf8(output.stderr).unwrap()
    };
    assert!(refused(&[]).contains("--mapping"));
    // Options that do not apply to a tracker are refused.
    for bar_only in [["--cost", "length"], ["--encoders", "find"], ["--truth", "truth.toml"]] {
        let said = refused(&[&mapping[..], &bar_only].concat());
        assert!(said.contains("unexpected argument") && said.contains(bar_only[0]), "{said}");
    }
    assert!(refused(&[&mapping[..2], &["--fix", "bd3"]].concat()).contains("bd3"));
    // Rows that were used in a fit cannot validate this fit.
    let said = refused(&[&mapping[..2], &["--validate", "poses.csv"]].concat());
    assert!(said.contains("poses.csv of --validate contains the rows of poses.csv"), "{said}");
    // If a file is missing, this is reported before the fit, and nothing is written.
    std::fs::remove_dir_all(folder.path().join("out")).unwrap();
    assert!(refused(&[&mapping[..2], &["--validate", "missing.csv"]].concat()).contains("missing.csv"));
    assert!(!folder.path().join("out").exists());
}

#[test]
fn what_is_fixed_by_name_stays_where_it_starts() {
    let (rows, ..) = made_up(300, 2e-5, 3e-4);
    let fixed = ["ra2", "probe_x", "rsin1_3"].map(|name| name.parse::<ParameterId>().unwrap());
    let report = Alone::quick().with_fixed(&fixed).poses(&rows, &ur10()).unwrap();
    for id in fixed {
        let parameter = report.model().parameter(id).unwrap();
        assert_eq!(parameter.value, parameter.nominal, "{id}");
        assert!(!parameter.role.is_estimated(), "{id}");
    }
}

/// Checks that mean, 95th percentile and maximum of the position error are below these limits \[mm\].
fn below(figures: &PoseFigures, [mean, p95, max]: [f64; 3]) {
    let of = figures.position_m;
    assert!(of.mean < 1e-3 * mean && of.p95 < 1e-3 * p95 && of.max < 1e-3 * max, "{of:?}");
}

/// Best published results for these data, with 30 DH and Hayati parameters on random held-out rows:
/// mean, 95th percentile, maximum \[mm\].
const GRID: [f64; 3] = [0.399, 0.76, 1.18];
const CUBES: [f64; 3] = [0.354, 0.71, 1.28];

/// The fit uses one in 32 of the 11 911 rows. Its errors are smaller than those published for all rows.
#[test]
#[ignore = "two calibrations with hundreds of terms: half a minute"]
fn the_real_ur10_on_its_grid_and_from_its_grid_to_its_cubes() {
    let (grid, cubes) = (fixture("grid.csv"), fixture("iso_cubes.csv"));
    assert_eq!((grid.len(), cubes.len()), (373, 316));
    let (Stages { nominal, offsets, links, .. }, independent, on_cubes) =
        grid_and_from_grid_to_cubes(&grid, &cubes);
    // On held-out rows, a fit of joint offsets alone is slightly better than the nominal robot, which may
    // be chance. On the cubes it is worse.
    let is_better = |stage: PoseFigures| is_surely_better(independent, [nominal.rms(), stage.rms()]);
    assert!(is_better(links) && !is_better(offsets));
    assert!(offsets.position_m.rms < nominal.position_m.rms && on_cubes[1] > on_cubes[0], "{on_cubes:?}");
}

/// Returns the errors on held-out rows of the grid, the number of independent rows among them, and two RMS errors on the
/// cubes \[m\]. The first RMS error is that of the nominal robot, the second that of a fit of joint offsets alone.
fn grid_and_from_grid_to_cubes(grid: &[PoseRow], cubes: &[PoseRow]) -> (Stages, usize, [f64; 2]) {
    let report = Alone { joint_waves: Some(40), ..Alone::default() }.poses(grid, &ur10()).unwrap();
    let others = Instrument::from(Tracker::new(cubes));
    let figures = validate(&others, 1, &ur10(), report.model(), 1).unwrap().figures;
    println!("{}cubes: {figures:?}", report.table());
    below(&report.held_out().joints, GRID);
    below(&figures[1], CUBES);
    // If a controller applies only some parameters, these are fitted alone. On another file, this fit is better than the
    // same parameters of the full model.
    let Stages { nominal, offsets, links, joints } = report.held_out();
    let held_out = [nominal, offsets, links, joints].map(|of| of.position_m.rms);
    assert!(held_out.is_sorted_by(|more, less| more > less), "{held_out:?}");
    let on_cubes = |model: &Model| validate(&others, 1, &ur10(), model, 1).unwrap().figures[1].position_m.rms;
    let [offsets, links] =
        Deployment::PARTIAL.map(|part| on_cubes(report.0.deployed(part, None).unwrap().unwrap().model()));
    let mut truncated = report.model().clone();
    let terms = truncated.ids();
    for id in terms {
        if matches!(id, ParameterId::Joint { .. } | ParameterId::JointWave { .. }) {
            truncated.set_value(id, 0.0).unwrap();
        }
    }
    let (nominal, truncated) = (figures[0].position_m.rms, on_cubes(&truncated));
    println!(
        "cubes, RMS: nominal {nominal:.2e}, offsets {offsets:.2e}, links {links:.2e}, of full {truncated:.2e}"
    );
    assert!(links < 0.7 * nominal && links < truncated, "{links} {truncated}");
    (report.held_out(), report.rows().independent_held_out(), [nominal, offsets])
}

#[test]
#[ignore = "terms of hundreds of rows: a quarter of a minute"]
fn the_real_ur10_on_its_cubes() {
    cubes_whatever_is_held_out(&fixture("iso_cubes.csv"));
}

fn cubes_whatever_is_held_out(cubes: &[PoseRow]) {
    for (hold_out, seeds) in [(HoldOut::Rows, 2), (HoldOut::Blocks, 1), (HoldOut::Regions, 1)] {
        let mut worst = [0.0_f64; 3];
        for seed in 1..=seeds {
            let alone = Alone {
                hold_out: Some(hold_out),
                seed: Some(seed),
                joint_waves: Some(40),
                ..Alone::default()
            };
            let report = alone.poses(cubes, &ur10()).unwrap();
            println!("{hold_out:?}, seed {seed}\n{}", report.table());
            let of = report.held_out().joints.position_m;
            worst = std::array::from_fn(|i| worst[i].max(1e3 * [of.mean, of.p95, of.max][i]));
        }
        println!("{hold_out:?}: worst {worst:.3?}");
        assert!(worst.iter().zip(CUBES).all(|(found, best)| *found < best), "{hold_out:?} {worst:?}");
    }
}

#[test]
#[ignore = "needs the whole measured data in the folder BALLBAR_DATA"]
fn all_rows_of_the_real_ur10() {
    let Some(data) = crate::support::measured_data() else { return };
    let folder = data.join("ur10-tracker");
    let cubes = real_rows(&folder.join("iso_cubes_632.csv"));
    cubes_whatever_is_held_out(&cubes);
    // Use every fourth row, because the whole file takes minutes and gives the same result.
    let grid: Vec<PoseRow> = real_rows(&folder.join("grid_11911.csv")).into_iter().step_by(4).collect();
    grid_and_from_grid_to_cubes(&grid, &cubes);
}
