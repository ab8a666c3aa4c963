//! Compares the kinematics of arms of all types with other programs. Imported and exported URDF files are compared with
//! yourdfpy, and Denavit-Hartenberg tables in both conventions with numpy.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use identify::calibrate::{DataSets, IdentifyConfig, JointTermsConfig, calibrate};
use identify::instrument::HoldOut;
use identify::instrument::{Rows, Tracker};
use identify::kinematics::{Chain, Joints, Pose, flange_chain};
use identify::logs::PoseRow;
use identify::report::result::robot_files::urdf;
use identify::robot::import;
use serde_json::{Value, json};
use shared::config::{self, JointKind, RobotConfig};
use system_tests::{config_directory, python_with};

/// URDF file, base link and tip link of each arm.
const ARMS: [(&str, &str, &str); 3] =
    [("ur10", "base_link", "tool0"), ("seven_axes", "base", "flange"), ("on_a_track", "cell", "tool")];

fn file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("../identify/tests/data/{name}.urdf"))
}

fn imported((name, base, tip): (&str, &str, &str)) -> RobotConfig {
    import(&std::fs::read_to_string(file(name)).unwrap(), Some(base), Some(tip)).unwrap().config
}

/// Deterministic postures that are spread over the joint limits. Each axis advances by a different increment. The increments
/// have no common multiple, so no posture repeats.
fn postures(robot: &RobotConfig, count: usize) -> Vec<Joints> {
    let part = |posture: usize, axis: usize| (posture as f64 * (0.618_034 + 0.137 * axis as f64)).fract();
    let limits = robot.joint_limits();
    let posture = |at: usize| {
        Joints::from_fn(limits.len(), |axis| {
            limits[axis][0] + (limits[axis][1] - limits[axis][0]) * part(at, axis)
        })
    };
    (1..=count).map(posture).collect()
}

/// Computes poses with `forward.py` and returns them as homogeneous matrices \[m\].
fn by_python(modules: &[&str], arguments: &[&str], asked: &Value) -> Vec<[[f64; 4]; 4]> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("forward.py");
    let mut child = Command::new(python_with(modules))
        .arg(script)
        .args(arguments)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    child.stdin.take().unwrap().write_all(asked.to_string().as_bytes()).unwrap();
    let output = child.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// Largest difference between the entries of the homogeneous matrices of the chain and the expected entries \[m, 1\].
fn pose_error(chain: &Chain, postures: &[Joints], expected: &[[[f64; 4]; 4]]) -> f64 {
    assert_eq!(postures.len(), expected.len());
    let of = |(joints, expected): (&Joints, &[[f64; 4]; 4])| {
        let found = chain.forward(joints).to_homogeneous();
        (0..16).map(|at| (found[(at / 4, at % 4)] - expected[at / 4][at % 4]).abs()).fold(0.0, f64::max)
    };
    postures.iter().zip(expected).map(of).fold(0.0, f64::max)
}

#[test]
#[ignore = "needs Python with tests/requirements.txt"]
fn a_urdf_has_the_forward_kinematics_that_yourdfpy_gives_it() {
    for arm in ARMS {
        let robot = imported(arm);
        let postures = postures(&robot, 200);
        let path = file(arm.0);
        let expected = by_python(
            &["yourdfpy"],
            &["urdf", path.to_str().unwrap(), arm.1, arm.2],
            &json!({ "joints": postures }),
        );
        let off_m = pose_error(&flange_chain(&robot), &postures, &expected);
        println!("{}: {} axes, largest difference {off_m:.1e} m", arm.0, robot.axes());
        // One of the files contains right angles with nine decimals. The import rounds these values to exact right angles.
        assert!(off_m < 1e-8, "{}: {off_m:e}", arm.0);
    }
}

/// Noise-free measurements of a tracker, on an arm with small errors in all links. Each row is one measurement.
fn rows(robot: &RobotConfig) -> Vec<PoseRow> {
    let mut truth = flange_chain(robot);
    for (link, sign) in truth.links.iter_mut().zip([1.0, -1.0].into_iter().cycle()) {
        link.a_m += 8e-4 * sign;
        link.alpha_rad += 1.5e-3;
        link.theta_rad -= 2e-3 * sign;
    }
    let place = Pose::translation(-2.0, 0.7, 1.1);
    let row = |joints: &Joints| {
        let seen = place.inverse() * truth.forward(joints);
        PoseRow {
            joints_rad: *joints,
            position_m: seen.translation.vector,
            rotation: Some(seen.rotation),
            ..PoseRow::default()
        }
    };
    postures(robot, 300).iter().map(row).collect()
}

#[test]
#[ignore = "needs Python with tests/requirements.txt"]
fn a_calibrated_arm_is_the_same_for_yourdfpy_in_the_urdf_that_is_written() {
    let directory = tempfile::tempdir().unwrap();
    for arm in ARMS {
        let robot = imported(arm);
        let joint_terms = JointTermsConfig { candidates: Vec::new(), ..JointTermsConfig::default() };
        let config = IdentifyConfig { joint_terms, ..IdentifyConfig::default() };
        let rows = Rows { hold_out: Some(HoldOut::Rows), ..Rows::from(Tracker::new(&rows(&robot))) };
        let data = DataSets { rows: vec![rows], ..DataSets::default() };
        let found = calibrate(&data, &robot, &config, None).unwrap();
        let chain = found.runs[0].model.geometry(&[]).robot;
        let path = directory.path().join("robot.urdf");
        std::fs::write(&path, urdf(&robot, &chain, None, "")).unwrap();
        let postures = postures(&robot, 200);
        let expected = by_python(
            &["yourdfpy"],
            &["urdf", path.to_str().unwrap(), "base", "flange"],
            &json!({ "joints": postures }),
        );
        let (off_m, corrected_m) = (
            pose_error(&chain, &postures, &expected),
            pose_error(&flange_chain(&robot), &postures, &expected),
        );
        println!("{}: written {off_m:.1e} m off, nominal {corrected_m:.1e} m", arm.0);
        assert!(off_m < 1e-9 && corrected_m > 1e-3, "{}: {off_m:e} {corrected_m:e}", arm.0);
    }
}

#[test]
#[ignore = "needs Python with tests/requirements.txt"]
fn tables_in_either_convention_have_the_forward_kinematics_that_numpy_gives_them() {
    let six: RobotConfig = config::load(&config_directory().join("robots/irb2400_16.toml")).unwrap();
    let mut on_a_track = six.clone();
    on_a_track.links[0].joint = JointKind::Prismatic;
    on_a_track.joint_limits_m = vec![[-1.0, 2.0]];
    on_a_track.joint_limits_deg.remove(0);
    for robot in [six, on_a_track] {
        for convention in ["standard", "modified"] {
            let robot = RobotConfig {
                convention: serde_json::from_value(json!(convention)).unwrap(),
                ..robot.clone()
            };
            let link = |link: &shared::config::LinkConfig| {
                let prismatic = link.joint == JointKind::Prismatic;
                json!([
                    prismatic,
                    link.a_m,
                    link.alpha_deg.to_radians(),
                    link.d_m,
                    link.theta_deg.to_radians()
                ])
            };
            let links: Vec<Value> = robot.links.iter().map(link).collect();
            let postures = postures(&robot, 50);
            let asked = json!({ "convention": convention, "links": links, "joints": postures });
            let off_m = pose_error(&flange_chain(&robot), &postures, &by_python(&["numpy"], &["dh"], &asked));
            assert!(off_m < 1e-12, "{convention}: {off_m:e}");
        }
    }
}
