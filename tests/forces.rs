//! Reads forces on the bar from robot logs that other programs wrote. Unit and sign of the forces must be correct. The
//! calibration must identify the compliance of the bar.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::process::Command;

use identify::calibrate::{Calibration, IdentifyConfig, JointTermsConfig, calibrate_run};
use identify::evaluate::{Elongation, PositiveForce};
use identify::instrument::CostName;
use identify::kinematics::{Chain, Joints};
use identify::logs::{ForceClock, ForceKind, LogOptions, RobotLog, RobotLogMapping, load, load_with};
use identify::simulate::{self, BarLoad, Design, Effects, Experiment, Simulated};
use shared::config::{self, AngleUnit, LogConversion, RobotConfig};
use system_tests::{ball_bar as shipped_bar, config_directory, python_with};

/// Load in the runs of the thesis. The force changes the length of the bar by +-25 um (TFRT-6017 section 5.3).
const LOAD: BarLoad = BarLoad { force_n: 150.0, compliance_um_per_n: 0.17, play_um: 0.0, noise_n: 1.0 };
const COMPLIANCE_M_PER_N: f64 = 0.17e-6;
const GRAVITY_M_PER_S2: f64 = 9.80665;

/// The robot of the reference set-up, with a controller that logs joint angles.
fn robot() -> RobotConfig {
    let robot: RobotConfig = config::load(&config_directory().join("robots/irb2400_16.toml")).unwrap();
    RobotConfig { log: LogConversion::direct(AngleUnit::Rad, 6), ..robot }
}

fn simulated() -> Simulated {
    let (robot, bar) = (robot(), shipped_bar());
    let effects =
        Effects { robot_noise_urad: 15.0, encoder_noise_urad: 5.0, base_tilt_urad: 3000.0, ..Effects::NONE };
    let design = Design { duration_s: 60.0, ..Design::for_robot(&robot) };
    simulate::run(&Experiment { seed: 2, design, effects, load: LOAD, ..Experiment::new(&robot, &bar) })
        .unwrap()
}

/// One row of the table that `write_robot_log.py` reads: stamp \[ns\], joints \[rad\], and the
/// output of the robot's force sensor.
type ForceRow = (i64, Joints, Vec<f64>);

/// The rows of a run. `sensor` returns the output of the force sensor. Its arguments are the robot, the joints \[rad\], and
/// the force of the robot on the bar \[N\].
fn table_rows(run: &Simulated, sensor: impl Fn(&Chain, &Joints, [f64; 3]) -> Vec<f64>) -> Vec<ForceRow> {
    let (robot, log) = (&run.motion.robot, &run.robot_log);
    let centre_m = run.motion.bar.root_from_base.translation.vector;
    let force = log.force.as_ref().unwrap();
    (0..log.q_rad.t_s.len())
        .map(|index| {
            let q = &log.q_rad[index];
            let outward = (robot.forward(q).translation.vector - centre_m).normalize();
            let on_bar_n = outward * force.values[index][0];
            (log.q_rad.stamp_ns(index).unwrap(), *q, sensor(robot, q, on_bar_n.into()))
        })
        .collect()
}

/// Writes the rows to a log with `write_robot_log.py` and returns its path.
fn write_log(directory: &Path, modules: &[&str], kind: &str, rows: &[ForceRow]) -> PathBuf {
    let python = python_with(modules);
    let mut text = String::new();
    for (stamp_ns, joints, measured) in rows {
        let cells: Vec<String> = joints.iter().chain(measured).map(f64::to_string).collect();
        writeln!(text, "{stamp_ns},{}", cells.join(",")).unwrap();
    }
    let table = directory.join("table.csv");
    std::fs::write(&table, text).unwrap();
    let path = directory.join(kind.replace("force-", "log."));
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("write_robot_log.py");
    let output = Command::new(python).arg(script).arg(kind).arg(&path).arg(table).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    path
}

fn calibrated(run: &Simulated, log: &RobotLog) -> Calibration {
    let config = IdentifyConfig {
        cost: Some(CostName::Length),
        encoder_harmonics_urad: 0.0,
        joint_terms: JointTermsConfig { candidates: Vec::new(), ..JointTermsConfig::default() },
        ..IdentifyConfig::default()
    };
    calibrate_run(&run.cycles, &run.encoders, log, &robot(), &shipped_bar(), &config).unwrap()
}

/// Root mean square error of the force along the bar \[N\], over the samples of a calibration. `sign` is the sign of a
/// tension in the log.
fn force_error_n(found: &Calibration, run: &Simulated, sign: f64) -> f64 {
    let (clock, force) = (run.truth.clock, run.robot_log.force.as_ref().unwrap());
    let bar_start_s = (clock.robot_at_bar_start_ns - force.values.first_stamp_ns) as f64 * 1e-9;
    let prepared = found.prepared().unwrap();
    let samples = &prepared.observations;
    let squares = samples.iter().map(|sample| {
        let since_start_s = prepared.t_ref.seconds_since(clock.bar_start) + sample.t_s;
        let true_n = force.values.at(bar_start_s + since_start_s * (1.0 + clock.skew)).unwrap()[0];
        (sample.force.along_n - sign * true_n).powi(2)
    });
    (squares.sum::<f64>() / samples.len() as f64).sqrt()
}

#[test]
#[ignore = "needs Python with tests/requirements.txt"]
fn the_tcp_force_of_an_rtde_log_is_the_force_of_the_bar_on_the_tool() {
    let (directory, run) = (tempfile::tempdir().unwrap(), simulated());
    // The controller reports the force of the bar on the tool. Its stamps begin when the controller starts.
    let mut rows = table_rows(&run, |_, _, [x, y, z]| vec![-x, -y, -z]);
    let first_ns = rows[0].0;
    rows.iter_mut().for_each(|(stamp_ns, ..)| *stamp_ns -= first_ns - 250_000_000_000);
    let path = write_log(directory.path(), &["csv"], "force-rtde", &rows);
    let log = load(&path, &robot()).unwrap();
    let force = log.force.clone().unwrap();
    assert_eq!((force.kind, force.clock), (ForceKind::InBase, ForceClock::Robot));
    assert_eq!((force.values.first_stamp_ns, force.values.len()), (250_000_000_000, rows.len()));
    for ((_, _, force_n), read) in rows.iter().zip(force.values.iter()) {
        assert!(force_n.iter().zip(read).all(|(a, b)| (a - b).abs() < 1e-9), "{force_n:?} {read:?}");
    }
    let found = calibrated(&run, &log);
    // A bar under tension pulls the tool back, so a tension is negative in this log.
    assert!(force_error_n(&found, &run, -1.0) < 1.0);
    let elongation = Elongation::all(&found)[0];
    println!("{}", elongation.sentence());
    assert_eq!(elongation.positive, PositiveForce::Compression);
    assert!(
        (elongation.value + COMPLIANCE_M_PER_N).abs() < 1.96 * elongation.sigma.unwrap(),
        "{elongation:?}"
    );
}

/// Static joint torques \[N m\] from gravity and from the force of the flange on the bar. Gravity acts on two masses
/// on the arm. The torques are derivatives with respect to each joint: of the potential energy of the masses, and of
/// the work of the force.
fn holding_torques_nm(robot: &Chain, q: &Joints, force_n: [f64; 3]) -> Vec<f64> {
    // For each mass: number of links that carry it, mass \[kg\], and position in the frame of the last of these links \[m\].
    let masses = [(2, 80.0, [-0.3, 0.02, 0.1]), (4, 60.0, [0.03, 0.05, -0.2])].map(|(links, kg, place_m)| {
        (Chain::new(robot.root_from_base, robot.links[..links].to_vec()), kg, place_m)
    });
    let energy_j = |q: &Joints| {
        let flange = robot.forward(q).translation.vector;
        let work: f64 = (0..3).map(|axis| force_n[axis] * flange[axis]).sum();
        let potential = masses.iter().map(|(part, kg, place_m)| {
            kg * GRAVITY_M_PER_S2 * part.forward(q).transform_point(&(*place_m).into()).z
        });
        work + potential.sum::<f64>()
    };
    let moved = |joint: usize, by: f64| {
        let mut q = *q;
        q[joint] += by;
        energy_j(&q)
    };
    (0..6).map(|joint| (moved(joint, 1e-4) - moved(joint, -1e-4)) / 2e-4).collect()
}

/// Mapping for a driver that uses its own joint names and the opposite sign for joint 4. The text `more`
/// is inserted before the joints.
fn mapping(more: &str) -> LogOptions {
    let joint = |n: usize| {
        let sign = if n == 4 { -1 } else { 1 };
        format!("[[joints]]\ncolumn = \"arm_joint_{n}\"\nunit = \"rad\"\nsign = {sign}\n")
    };
    let text = format!("{more}\n{}", (1..=6).map(joint).collect::<String>());
    let mapping: RobotLogMapping = config::parse(&text, Path::new("mapping.toml")).unwrap();
    LogOptions { mapping: Some(mapping), ..LogOptions::default() }
}

#[test]
#[ignore = "needs Python with tests/requirements.txt"]
fn joint_efforts_of_bags_are_torques_from_which_the_force_on_the_bar_follows() {
    let (directory, run) = (tempfile::tempdir().unwrap(), simulated());
    let of_model = table_rows(&run, holding_torques_nm);
    let mut of_driver = of_model.clone();
    for (_, joints, torques) in &mut of_driver {
        joints[3] = -joints[3];
        torques[3] = -torques[3];
    }
    let bag = |kind: &str| write_log(directory.path(), &["rosbags"], kind, &of_driver);
    let (mcap, db3) = (bag("force-mcap"), bag("force-db3"));
    let options = mapping("force = { unit = \"Nm\" }");
    let log = load_with(&mcap, &robot(), &options).unwrap();
    assert_eq!(load_with(&db3, &robot(), &options).unwrap(), log);
    let force = log.force.clone().unwrap();
    assert_eq!((force.kind, force.clock), (ForceKind::JointTorques, ForceClock::Robot));
    assert_eq!((force.values.first_stamp_ns, force.values.len()), (of_model[0].0, of_model.len()));
    for ((_, _, torques_nm), read) in of_model.iter().zip(force.values.iter()) {
        assert!(torques_nm.iter().zip(read).all(|(a, b)| (a - b).abs() < 1e-9), "{torques_nm:?} {read:?}");
    }
    let found = calibrated(&run, &log);
    let (error_n, elongation) = (force_error_n(&found, &run, 1.0), Elongation::all(&found)[0]);
    println!("force from efforts: RMS error {error_n:.2} N; {}", elongation.sentence());
    assert!(error_n < 2.0, "{error_n}");
    assert_eq!(elongation.positive, PositiveForce::Tension);
    assert!(
        (elongation.value - COMPLIANCE_M_PER_N).abs() < 1.96 * elongation.sigma.unwrap(),
        "{elongation:?}"
    );

    // If the mapping names no force, efforts are read as joint torques. The log then contains no force.
    let plain = load_with(&mcap, &robot(), &mapping("")).unwrap();
    assert!(plain.force.is_none() && plain.torque.is_some());
    let columns = mapping("force = { columns = [\"Fx\", \"Fy\", \"Fz\"], unit = \"N\" }");
    let error = load_with(&mcap, &robot(), &columns).unwrap_err().to_string();
    assert!(error.contains("Fx, Fy, Fz") && error.contains("--force-log"), "{error}");
}
