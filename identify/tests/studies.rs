//! `identify study`: results must not depend on order or machine, and answers must be correct for known cases.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test stops at the first surprise")]

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use identify::calibrate::{BarRun, DataSets, calibrate};
use identify::robot::import;
use identify::simulate::{Effects, Experiment, LEAD_ROWS, pairs};
use identify::study::{Definition, Results, THESIS, prepared, run, trials};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use shared::config::JointKind;

use crate::support::{irb2400, repository};

/// Writes a small study of 12 experiments: two estimators, two series, three seeds. Returns the path of its file.
fn small(directory: &Path, path: &str) -> String {
    let (robot, bar) = (repository("config/robots/irb2400_16.toml"), repository("config/ball_bar.toml"));
    let text = format!(
        r#"
title = "small"
robot = {robot:?}
bar = {bar:?}
seeds = 3
points = 200
duration_s = 60.0
limit_mm_mrad = 0.5
{path}
[[estimators]]
name = "transform"
label = "C_T"
config = {{ cost = "transform", selection = "thesis", fix = ["clock_shift", "clock_skew"] }}
[[estimators]]
name = "length"
label = "C_l"
config = {{ cost = "length", selection = "thesis", fix = ["clock_shift", "clock_skew"] }}
[[figures]]
id = "exact"
title = "nothing varies"
kind = "levels"
estimators = ["transform"]
[[figures.series]]
x = [0]
[[figures]]
id = "noise"
title = "noise"
x = "[urad]"
estimators = ["transform", "length"]
[[figures.series]]
name = "both"
x = [5, 50]
vary = {{ robot_noise_urad = 1, encoder_noise_urad = 1 }}
[[figures.series]]
name = "steps"
x = [20]
vary = {{ encoder_step_urad = 1 }}
[[statements]]
text = "the length is worse"
of = {{ figure = "noise", series = "both", estimator = "length" }}
against = {{ figure = "noise", series = "both", estimator = "transform" }}
at_least = 1.5
[[statements]]
text = "exact"
of = {{ figure = "exact", estimator = "transform" }}
at_most = 1e-6
"#
    );
    let file = directory.join("study.toml");
    fs::write(&file, text).unwrap();
    file.to_str().unwrap().to_owned()
}

fn command(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_identify"));
    command.arg("study").args(arguments).env("RUST_LOG", "off");
    command
}

fn study(arguments: &[&str]) -> Output {
    command(arguments).output().unwrap()
}

/// Content of every file in a directory, by its name.
fn files(directory: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = fs::read_dir(directory).unwrap().map(|entry| entry.unwrap().path());
    entries
        .map(|path| (path.file_name().unwrap().to_str().unwrap().into(), fs::read(path).unwrap()))
        .collect()
}

fn assert_same(a: &Path, b: &Path) {
    let (a, b) = (files(a), files(b));
    assert_eq!(a.keys().collect::<Vec<_>>(), b.keys().collect::<Vec<_>>());
    for (name, bytes) in &a {
        assert!(bytes == &b[name], "{name} differs");
    }
}

fn said(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

#[test]
fn threads_shards_and_a_torn_line_make_no_difference() {
    let room = tempfile::tempdir().unwrap();
    let at = |name: &str| room.path().join(name).to_str().unwrap().to_owned();
    let file = small(room.path(), "");
    let whole = study(&[&file, "--out", &at("whole"), "--threads", "3"]);
    assert!(whole.status.success(), "{}", said(&whole));
    assert!(said(&whole).contains("holds: the length is worse"), "{}", said(&whole));
    assert!(said(&whole).contains("holds: exact"), "{}", said(&whole));

    assert!(study(&[&file, "--out", &at("one"), "--threads", "1"]).status.success());
    assert_same(Path::new(&at("whole")), Path::new(&at("one")));

    let shards: Vec<String> = (1..=5).map(|number| at(&format!("shard{number}"))).collect();
    for (number, shard) in shards.iter().enumerate() {
        let share = format!("{}/5", number + 1);
        assert!(study(&[&file, "--out", shard, "--shard", &share]).status.success());
    }
    let mut merge = vec!["merge", "--out"];
    let merged = at("merged");
    merge.push(&merged);
    // Without the first shard, experiments are missing. The message states their number.
    let incomplete = study(&[merge.clone(), shards[1..].iter().map(String::as_str).collect()].concat());
    assert!(!incomplete.status.success());
    assert!(said(&incomplete).contains("3 of 12 experiments are missing"), "{}", said(&incomplete));
    merge.extend(shards.iter().map(String::as_str));
    assert!(study(&merge).status.success());
    assert_same(Path::new(&at("whole")), Path::new(&merged));

    // A process that was killed while it wrote a line leaves such a file.
    let lines = fs::read_to_string(Path::new(&at("whole")).join("trials.jsonl")).unwrap();
    let half: Vec<&str> = lines.split_inclusive('\n').take(6).collect();
    fs::create_dir(at("resumed")).unwrap();
    let torn = Path::new(&at("resumed")).join("trials.jsonl");
    fs::write(&torn, format!("{}{{\"trial\":7,\"ro", half.concat())).unwrap();
    assert!(study(&[&file, "--out", &at("resumed")]).status.success());
    assert_same(Path::new(&at("whole")), Path::new(&at("resumed")));

    // If the output directory contains results of another study, they are not changed, even if a line is incomplete.
    let results = Path::new(&at("one")).join("trials.jsonl");
    fs::write(&results, &lines[..lines.len() - 1]).unwrap();
    let other = study(&[&file, "--out", &at("one"), "--seeds", "4"]);
    assert!(!other.status.success());
    assert!(said(&other).contains("results of another study"), "{}", said(&other));
    assert_eq!(fs::read_to_string(&results).unwrap(), lines[..lines.len() - 1]);
}

#[test]
fn a_study_that_makes_no_sense_is_refused_by_key() {
    let room = tempfile::tempdir().unwrap();
    let file = small(room.path(), "");
    let text = fs::read_to_string(&file).unwrap();
    let out = room.path().join("out");
    for (from, to, expected) in [
        ("encoder_step_urad = 1", "encoder_stepp_urad = 1", "figures[1].series[1].vary"),
        (
            "estimators = [\"transform\", \"length\"]",
            "estimators = [\"nobody\"]",
            "no estimator is called `nobody`",
        ),
        ("x = [20]", "x = [20]\nwith = { gear_sine_urad = -1 }", "figures[1].series[1].with.gear_sine_urad"),
        ("duration_s = 60.0", "duration_s = 1.0", "key `duration_s`: 1 s is too short for a random path"),
        ("figure = \"exact\"", "figure = \"exct\"", "statements[1].of"),
        ("x = [20]", "x = [nan]", "figures[1].series[1].x"),
        ("cost = \"length\"", "cost = \"lenght\"", "lenght"),
        ("points = 200", "points = 3", "points = 3 is invalid"),
        ("title = \"small\"", "title = \"small\"\ntypo = 1", "typo"),
        ("encoder_step_urad = 1", "bar_play_um = -1", "give no negative number"),
        ("encoder_step_urad = 1", "stations = 0.1", "stations = 2 needs another place"),
        ("id = \"noise\"", "id = \"exact\"", "`exact` is there already"),
    ] {
        assert!(text.contains(from), "{from}");
        fs::write(&file, text.replacen(from, to, 1)).unwrap();
        let refused = study(&[&file, "--out", out.to_str().unwrap()]);
        assert!(!refused.status.success() && !out.exists(), "{to}");
        assert!(said(&refused).contains(expected), "{to}: {}", said(&refused));
    }
    fs::write(&file, text).unwrap();
    let refused = study(&[&file, "--out", out.to_str().unwrap(), "--figures", "3.2"]);
    assert!(said(&refused).contains("no figure `3.2`; choose from exact, noise"), "{}", said(&refused));
}

#[test]
fn a_study_without_a_single_estimate_ends_with_an_error_and_its_reason() {
    let room = tempfile::tempdir().unwrap();
    let file = small(room.path(), "");
    let text = fs::read_to_string(&file).unwrap();
    // An encoder that the cost requires is missing.
    let text = text.replace("x = [0]\n", "x = [0]\nwith = { encoders = 0 }\n");
    fs::write(&file, text).unwrap();
    for (out, shard) in [("whole", &[][..]), ("shard", &["--shard", "1/2"])] {
        let out = room.path().join(out);
        let failed =
            study(&[&[&file, "--out", out.to_str().unwrap(), "--figures", "exact"][..], shard].concat());
        assert_eq!(failed.status.code(), Some(1));
        assert!(said(&failed).contains("estimates failed, the first: "), "{}", said(&failed));
        assert_eq!(out.join("study.html").exists(), shard.is_empty());
    }
}

#[test]
fn an_arm_that_is_not_simulated_is_refused_before_the_first_experiment() {
    let room = tempfile::tempdir().unwrap();
    let file = small(room.path(), "");
    let arm = room.path().join("arm.toml");
    let urdf = fs::read_to_string(repository("identify/tests/data/seven_axes.urdf")).unwrap();
    let imported = import(&urdf, Some("base"), Some("flange")).unwrap().config;
    // A robot of six axes whose first axis is a track.
    let mut on_track = irb2400();
    on_track.links[0].joint = JointKind::Prismatic;
    on_track.joint_limits_deg.remove(0);
    on_track.joint_limits_m.push([0.0, 1.0]);
    let text = fs::read_to_string(&file).unwrap();
    let shipped = text.lines().find(|line| line.starts_with("robot = ")).unwrap();
    fs::write(&file, text.replace(shipped, &format!("robot = {arm:?}"))).unwrap();
    let out = room.path().join("out");
    for robot in [imported, on_track] {
        fs::write(&arm, toml::to_string(&robot).unwrap()).unwrap();
        let refused = study(&[&file, "--out", out.to_str().unwrap()]);
        assert!(!refused.status.success() && !out.exists());
        assert!(said(&refused).contains("is not an arm of six revolute axes"), "{}", said(&refused));
    }
}

#[test]
fn the_help_lists_every_condition_and_the_log_of_a_batch_job_has_lines_of_progress() {
    let help = String::from_utf8(command(&["--help"]).output().unwrap().stdout).unwrap();
    for condition in ["encoder_bits", "wire_noise_um", "stations", "encoder_step_urad", "rd3"] {
        assert!(help.contains(condition), "{condition}: {help}");
    }
    let room = tempfile::tempdir().unwrap();
    let file = small(room.path(), "");
    let out = room.path().join("out");
    let mut batch = command(&[&file, "--figures", "exact", "--out", out.to_str().unwrap()]);
    let log = said(&batch.env("RUST_LOG", "info").output().unwrap());
    assert!(log.contains("1 of 3 experiments") && log.contains("3 of 3 experiments"), "{log}");
}

/// The log of a real robot can be the path of a study. The joints of the bar follow from the path. On this path, all costs
/// must find the errors of the robot.
#[test]
fn the_log_of_a_run_is_a_path_for_a_study() {
    let room = tempfile::tempdir().unwrap();
    let run = crate::support::command::identify(
        &["simulate", "--bar", repository("config/ball_bar.toml").to_str().unwrap(), "--duration", "40s"],
        "irb2400_16.toml",
        &room.path().join("run"),
    );
    assert!(run.status.success());
    let file = small(room.path(), "[path]\nlog = \"run/robot_log.csv\"");
    let out = room.path().join("out");
    let done = study(&[&file, "--out", out.to_str().unwrap(), "--seeds", "1"]);
    assert!(done.status.success(), "{}", said(&done));
    assert!(said(&done).contains("holds: exact") && !said(&done).contains("failed"), "{}", said(&done));
}

/// The shipped study of the thesis: without errors in the data, every cost finds the errors of the robot. The cost `length`
/// is the most sensitive to noise.
#[test]
fn the_shipped_study_is_that_of_the_file_and_checks_itself() {
    let definition = Definition::load(THESIS).unwrap();
    let of_file = Definition::load(repository("config/studies/thesis.toml").to_str().unwrap()).unwrap();
    assert_eq!(definition, of_file);
    let room = tempfile::tempdir().unwrap();
    let mut results = Results::open(room.path(), &definition).unwrap();
    let first = trials(&definition).next().unwrap();
    assert_eq!(first.figure.id, "check");
    results.add(run(&definition, &first)).unwrap();
    for row in &results.done()[&0].rows {
        assert!(row.euclidean_mm_mrad.unwrap() < 2e-3 && row.largest_mm_mrad.unwrap() < 1e-3, "{row:?}");
    }
    // A study that is written and read again must count as the same study, so that it can be continued.
    drop(results);
    assert_eq!(Results::open(room.path(), &definition).unwrap().done().len(), 1);
}

/// Reads `points.parquet` with an independent program and compares it with `points.csv`.
#[test]
#[ignore = "needs Python with pyarrow: set BALLBAR_PYTHON"]
fn an_independent_reader_finds_the_same_in_both_tables() {
    let room = tempfile::tempdir().unwrap();
    let (file, out) = (small(room.path(), ""), room.path().join("out"));
    assert!(study(&[&file, "--out", out.to_str().unwrap()]).status.success());
    let python =
        std::env::var_os("BALLBAR_PYTHON").expect("BALLBAR_PYTHON: a Python with tests/requirements.txt");
    let script = r#"
import csv, sys
import pyarrow.parquet as parquet
table = parquet.read_table(sys.argv[1] + "/points.parquet").to_pylist()
rows = list(csv.DictReader(open(sys.argv[1] + "/points.csv")))
assert len(table) == len(rows) == 3 * (1 + 2 * 3), (len(table), len(rows))
for a, b in zip(table, rows):
    assert list(a) == list(b), (list(a), list(b))
    for key, value in a.items():
        text = b[key]
        same = text == "" if value is None else value == type(value)(text)
        assert same, (key, value, text)
"#;
    let checked = Command::new(python).args(["-c", script]).arg(&out).output().unwrap();
    assert!(checked.status.success(), "{}", said(&checked));
}

/// Python code that computes the residuals of the cost `transform` from Denavit-Hartenberg matrices, and
/// minimises these residuals with SciPy.
const SCIPY: &str = r#"
import json, sys, time
import numpy as np
from scipy.optimize import least_squares
data = json.load(open(sys.argv[1]))
robot_rad, bar_rad = np.array(data["robot_rad"]), np.array(data["bar_rad"])
nominal, free = data["nominal"], data["free"]

def chain(values, letter, angles):
    pose = np.broadcast_to(np.eye(4), (len(angles), 4, 4))
    for link in range(angles.shape[1]):
        a, d, alpha, theta = (values[f"{letter}{kind}{link + 1}"] for kind in ("a", "d", "alpha", "theta"))
        turn = angles[:, link] + theta
        c, s, ca, sa, zero = np.cos(turn), np.sin(turn), np.cos(alpha), np.sin(alpha), np.zeros(len(angles))
        rows = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s],
                [zero, zero + sa, zero + ca, zero + d], [zero, zero, zero, zero + 1]]
        pose = pose @ np.moveaxis(np.array(rows), 2, 0)
    return pose

def residual(x):
    values = {**nominal, **dict(zip(free, x))}
    bar = chain(values, "b", bar_rad).copy()
    bar[:, :3, 3] += [values["ox"], values["oy"], values["oz"]]
    return (chain(values, "r", robot_rad) - bar)[:, :3, :].ravel()

began = time.perf_counter()
found = least_squares(residual, [nominal[name] for name in free], x_scale="jac", xtol=1e-13, ftol=1e-13, gtol=1e-13)
print(json.dumps({"x": list(found.x), "seconds": time.perf_counter() - began}))
"#;

#[test]
#[ignore = "needs Python with scipy: set BALLBAR_PYTHON"]
fn scipy_finds_the_same_from_the_same_angles_and_takes_longer() {
    let definition = Definition::load(THESIS).unwrap();
    let effects = Effects { robot_noise_urad: 10.0, encoder_noise_urad: 10.0, ..Effects::NONE };
    let experiment = Experiment { effects, ..Experiment::new(&definition.robot, &definition.bar) };
    let (path, start_rad) = experiment.drive().unwrap();
    let pairs = pairs(&experiment, &path, start_rad, 1500, 0.0).unwrap();
    let config = definition.study.estimator("transform").unwrap().config.clone();
    let began = Instant::now();
    let prepared = prepared(&pairs, [true; 5], experiment.design.base_m).unwrap();
    let data = DataSets { bars: vec![BarRun { prepared, bar: &definition.bar }], rows: Vec::new() };
    let found = calibrate(&data, &definition.robot, &config, None).unwrap();
    let ours_s = began.elapsed().as_secs_f64();
    let free: Vec<String> = found.model().columns().map(|parameter| parameter.id.to_string()).collect();
    let room = tempfile::tempdir().unwrap();
    let file = room.path().join("pairs.json");
    let robot_rad = &pairs.robot_rad[LEAD_ROWS..LEAD_ROWS + pairs.bar_rad.len()];
    let robot_rad: Vec<Vec<f64>> = robot_rad.iter().map(|q_rad| q_rad.to_vec()).collect();
    let truth = &pairs.truth.nominal;
    let data = serde_json::json!({
        "robot_rad": robot_rad, "bar_rad": pairs.bar_rad, "nominal": truth, "free": free,
    });
    fs::write(&file, data.to_string()).unwrap();
    let python =
        std::env::var_os("BALLBAR_PYTHON").expect("BALLBAR_PYTHON: a Python with tests/requirements.txt");
    let solved = Command::new(python).args(["-c", SCIPY]).arg(&file).output().unwrap();
    assert!(solved.status.success(), "{}", said(&solved));
    let solved: serde_json::Value = serde_json::from_slice(&solved.stdout).unwrap();
    let theirs_s = solved["seconds"].as_f64().unwrap();
    println!("one solve of 1500 pairs: {:.0} ms, scipy {:.0} ms", 1e3 * ours_s, 1e3 * theirs_s);
    for (parameter, x) in found.model().columns().zip(solved["x"].as_array().unwrap()) {
        let apart = parameter.value - x.as_f64().unwrap();
        assert!(apart.abs() < 1e-8, "{}: {apart:e}", parameter.id);
    }
}

/// Runs the commands that the documentation states for several machines.
#[test]
#[ignore = "computes figure 3.2 twice: half a minute"]
fn the_documented_shards_give_what_one_machine_gives() {
    let text = fs::read_to_string(repository("docs/src/how-to/study.md")).unwrap();
    let script = text.split("```sh\n").find(|block| block.starts_with("for k in")).unwrap();
    let script = script.split("```").next().unwrap();
    let room = tempfile::tempdir().unwrap();
    let program = Path::new(env!("CARGO_BIN_EXE_identify")).parent().unwrap();
    let path = format!("{}:{}", program.display(), std::env::var("PATH").unwrap());
    let done =
        Command::new("sh").args(["-ec", script]).current_dir(&room).env("PATH", path).output().unwrap();
    assert!(done.status.success(), "{}", said(&done));
    let whole = room.path().join("whole");
    let one = study(&["thesis", "--figures", "3.2", "--seeds", "2", "--out", whole.to_str().unwrap()]);
    assert!(one.status.success(), "{}", said(&one));
    assert_same(&whole, &room.path().join("merged"));
}

#[test]
#[ignore = "kills ten studies: a quarter of a minute"]
fn a_study_that_is_killed_ten_times_ends_as_one_that_is_not() {
    let room = tempfile::tempdir().unwrap();
    let at = |name: &str| room.path().join(name);
    let file = small(room.path(), "");
    let arguments = |out: &str| {
        let out = at(out).to_str().unwrap().to_owned();
        [file.clone(), "--out".into(), out, "--seeds".into(), "20".into(), "--threads".into(), "1".into()]
    };
    let run = |out: &str| {
        let arguments = arguments(out);
        command(&arguments.each_ref().map(String::as_str))
    };
    assert!(run("whole").output().unwrap().status.success());
    let mut random = StdRng::seed_from_u64(7);
    let mut lines = 0;
    for _ in 0..10 {
        let mut child = run("killed").stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        std::thread::sleep(Duration::from_millis(random.random_range(50..900)));
        child.kill().unwrap();
        child.wait().unwrap();
        let text = fs::read_to_string(at("killed").join("trials.jsonl")).unwrap_or_default();
        let now = text.lines().count();
        assert!(now >= lines, "{now} after {lines}");
        lines = now;
    }
    println!("{lines} lines after ten kills");
    assert!(run("killed").output().unwrap().status.success());
    assert_same(&at("whole"), &at("killed"));
}
