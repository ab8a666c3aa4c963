//! Exports the identified robot to the formats of other programs, and compares the poses.
#![allow(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use std::f64::consts::FRAC_PI_2;
use std::path::Path;

use crate::support::independent::{Matrix, identity, product, shift, turn};
use identify::calibrate::validation::deployment::Deployment;
use identify::kinematics::{Chain, InverseError, Joints, Pose, robot_chain};
use identify::logs::{JointConversion, LoggedJoints, RobotLogMapping, read};
use identify::model::Model;
use identify::report::result::corrections::{Correction, corrections, csv, log_corrections};
use identify::report::result::file::{CalibrationFile, ParameterEntry, ParameterStatus, SolveEntry};
use identify::report::result::knowledge::CovarianceEntry;
use identify::report::result::robot_files::urdf;
use identify::report::{CalibratedRobot, CalibratedRobotError};
use identify::solver::{Identifiability, Summary, Termination};
use nalgebra::{DMatrix, Vector3};
use shared::config::{AngleUnit, JointKind, LogConversion, RobotConfig};

/// A robot that has a different error in every parameter, including Hayati's rotation of link 2.
fn identified(robot: &RobotConfig) -> Chain {
    let mut chain = robot_chain(robot, &crate::support::bar());
    for (i, link) in chain.links.iter_mut().enumerate() {
        let e = |k: usize| 2e-3 * (1.0 + 5.0 * i as f64 + k as f64).sin();
        link.a_m += e(0);
        link.d_m += e(1);
        link.alpha_rad += e(2);
        link.theta_rad += e(3);
    }
    chain.links[1].beta_rad = 1.5e-3;
    chain
}

fn file(robot: &RobotConfig) -> CalibrationFile {
    let nominal = robot_chain(robot, &crate::support::bar());
    let mut model = Model::ball_bar(&nominal, &identify::kinematics::ball_bar_chain(&crate::support::bar()));
    let chain = identified(robot);
    for (i, link) in chain.links.iter().enumerate() {
        let numbers = [link.a_m, link.d_m, link.alpha_rad, link.theta_rad, link.beta_rad];
        for (kind, value) in ["a", "d", "alpha", "theta", "beta"].into_iter().zip(numbers) {
            model.set_value(format!("r{kind}{}", i + 1).parse().unwrap(), value).unwrap();
        }
    }
    let summary = Summary {
        termination: Termination::SmallStep,
        iterations: 3,
        evaluations: 4,
        cost_end: 0.1,
        residual_rms_start: 1e-3,
        residual_rms: 1e-5,
        samples_used: 1500,
        samples_left_out: 0,
    };
    let identifiability = Identifiability {
        names: Vec::new(),
        prior_sigmas: Vec::new(),
        rank: 1,
        rank_of_samples: 1,
        singular_values: vec![1.0],
        zero_columns: Vec::new(),
        groups: Vec::new(),
        triangle: DMatrix::zeros(0, 0),
        samples: 1500,
    };
    let solve = SolveEntry::new("pose", &summary, &identifiability);
    CalibrationFile::new(&robot.name, "bar", solve, Vec::new(), ParameterEntry::all(&model, |_| None))
}

fn robots() -> [RobotConfig; 2] {
    [crate::support::irb2400(), crate::support::nj220()]
}

const JOINTS: [[f64; 6]; 3] =
    [[0.0; 6], [0.3, -0.4, 0.5, 0.6, -0.7, 0.8], [-1.2, 0.9, -0.6, 2.0, FRAC_PI_2, -3.0]];

/// Forward kinematics of a URDF, implemented from its specification and read with the crate `urdf-rs`.
fn by_urdf(robot: &urdf_rs::Robot, end: &str, joints: &[f64; 6]) -> Matrix<f64> {
    let mut path = Vec::new();
    let mut link = end.to_owned();
    while let Some(joint) = robot.joints.iter().find(|joint| joint.child.link == link) {
        link.clone_from(&joint.parent.link);
        path.push(joint);
    }
    assert_eq!(link, "base");
    let mut angles = joints.iter();
    path.iter().rev().fold(identity(), |pose, joint| {
        let ([x, y, z], [roll, pitch, yaw]) = (joint.origin.xyz.0, joint.origin.rpy.0);
        let factors = [shift(x, y, z), turn(0, 1, yaw), turn(2, 0, pitch), turn(1, 2, roll)];
        let pose = factors.iter().fold(pose, |pose, factor| product(&pose, factor));
        if joint.joint_type == urdf_rs::JointType::Fixed {
            return pose;
        }
        assert_eq!(joint.axis.xyz.0, [0.0, 0.0, 1.0]);
        product(&pose, &turn(0, 1, *angles.next().unwrap()))
    })
}

fn pose_error(found: &Matrix<f64>, chain: &Chain, joints: &[f64; 6]) -> f64 {
    let expected = chain.forward(joints).to_homogeneous();
    (0..4)
        .flat_map(|i| (0..4).map(move |j| (i, j)))
        .fold(0.0, |worst, (i, j)| f64::max(worst, (found[i][j] - expected[(i, j)]).abs()))
}

#[test]
fn a_urdf_read_by_another_library_gives_the_poses_of_the_identified_robot() {
    let bar = crate::support::bar();
    for config in robots() {
        let chain = identified(&config);
        let robot = urdf_rs::read_from_string(&urdf(&config, &chain, Some(&bar), "")).unwrap();
        assert_eq!(robot.name, config.name);
        let mut flange = chain.clone();
        flange.links[5].a_m -= bar.plate_m;
        flange.links[5].d_m -= bar.tool_m;
        for joints in &JOINTS {
            assert!(pose_error(&by_urdf(&robot, "ball_bar_end", joints), &chain, joints) < 1e-12);
            assert!(pose_error(&by_urdf(&robot, "flange", joints), &flange, joints) < 1e-12);
        }
        let limits = &robot.joints.iter().find(|joint| joint.name == "joint_2").unwrap().limit;
        assert!((limits.lower.to_degrees() - config.joint_limits_deg[1][0]).abs() < 1e-9);
    }
}

fn read_back(text: &str) -> Vec<Correction> {
    csv::Reader::from_reader(text.as_bytes()).deserialize().map(|row| row.unwrap()).collect()
}

/// The nominal links, after the numbers of the rows are added to them, as a person would do.
fn corrected_links(nominal: &Chain, rows: &[Correction]) -> Chain {
    let mut chain = nominal.clone();
    for row in rows.iter().filter(|row| row.what.starts_with("link")) {
        let words: Vec<&str> = row.what.split(' ').collect();
        let link = &mut chain.links[words[1].parse::<usize>().unwrap() - 1];
        match (words[2], row.unit.as_str()) {
            ("a", "mm") => link.a_m += row.add * 1e-3,
            ("d", "mm") => link.d_m += row.add * 1e-3,
            ("alpha", "deg") => link.alpha_rad += row.add.to_radians(),
            ("beta", "deg") => link.beta_rad += row.add.to_radians(),
            other => unreachable!("{other:?}"),
        }
    }
    chain
}

#[test]
fn corrections_read_back_and_applied_to_joints_or_to_the_log_give_the_identified_poses() {
    for config in robots() {
        let chain = identified(&config);
        let rows = read_back(&csv(&corrections(&file(&config), &config, Deployment::Dh)).unwrap());
        let of_log = log_corrections(&file(&config), &config, None, Deployment::Dh).unwrap();
        let of_log = read_back(&csv(&of_log).unwrap());
        let links = corrected_links(&robot_chain(&config, &crate::support::bar()), &rows);
        let add = |rows: &[Correction], prefix: &str| -> [f64; 6] {
            let of = |i: usize| rows.iter().find(|row| row.what.starts_with(&format!("{prefix}{}", i + 1)));
            std::array::from_fn(|i| of(i).unwrap().add)
        };
        let conversion = JointConversion::new(&config.log).unwrap();
        // The log has the joints of the controller. One of them has the opposite sign, and one contains another joint.
        let joints = (1..=6).map(|joint| {
            let sign = if joint == 5 { -1 } else { 1 };
            format!(
                "[[joints]]\ncolumn = \"J{joint}\"\nunit = \"deg\"\nsign = {sign}\noffset_deg = {joint}\n"
            )
        });
        let coupling = "[[coupling]]\njoint = 3\nfrom = 2\nfactor = 1\n";
        let mapping: RobotLogMapping = toml::from_str(&(joints.collect::<String>() + coupling)).unwrap();
        let mapped = JointConversion::new(&mapping.conversion()).unwrap();
        let logged = LoggedJoints::of_mapping(&mapping).unwrap();
        let to_exported = log_corrections(&file(&config), &config, Some(&logged), Deployment::Dh).unwrap();
        assert!(to_exported.iter().all(|row| row.unit == "deg" && row.what.starts_with('J')));
        let (to_joints, to_log) = (add(&rows, "joint "), add(&of_log, &config.log.column));
        for joints in &JOINTS {
            let by_joints = Joints::from_fn(6, |i| joints[i] + to_joints[i].to_radians());
            let logged = conversion.to_raw(joints);
            let by_log = conversion.to_joint(&Joints::from_fn(6, |i| logged[i] + to_log[i]));
            let exported = mapped.to_raw(joints);
            let of = |i: usize| exported[i] + to_exported[i].add.to_radians();
            let by_mapped_log = mapped.to_joint(&Joints::from_fn(6, of));
            for corrected in [by_joints, by_log, by_mapped_log] {
                let found = links.forward(&corrected).to_homogeneous();
                // Poses are equal to as many digits as controllers accept.
                assert!((found - chain.forward(joints).to_homogeneous()).amax() < 5e-6);
            }
        }
    }
}

#[test]
fn corrections_of_a_log_have_its_names_and_its_unit_and_the_sigma_of_a_single_joint() {
    // The robot's own log is in degrees, that of the RTDE client in radians.
    let config = crate::support::nj220();
    let mut file = file(&config);
    file.parameters.iter_mut().for_each(|entry| entry.sigma = Some(1e-3));
    let names: Vec<String> = (0..6).map(|joint| format!("actual_q_{joint}")).collect();
    let mut text = format!("timestamp {}\n", names.join(" "));
    for row in 0..60 {
        let t_s = 0.008 * f64::from(row);
        text += &format!("{t_s}{}\n", format!(" {}", 0.1 * t_s).repeat(6));
    }
    let log = read(text.as_bytes(), Path::new("log.txt"), &config).unwrap();
    let of_log = log_corrections(&file, &config, log.logged.as_ref(), Deployment::Dh).unwrap();
    let of_own = log_corrections(&file, &config, None, Deployment::Dh).unwrap();
    assert_eq!(of_log.iter().map(|row| row.what.as_str()).collect::<Vec<_>>(), names);
    for (joint, (row, own)) in of_log.iter().zip(&of_own).enumerate() {
        assert!(row.unit == "rad" && own.unit == "deg", "{row:?} {own:?}");
        assert!((row.add - own.add.to_radians()).abs() < 2e-7, "{row:?} {own:?}");
        // Joints 2 and 3 both move column 3.
        assert_eq!(row.sigma, (joint != 2).then_some(1e-3), "{row:?}");
    }
}

#[test]
fn the_offset_of_a_prismatic_joint_is_its_d_and_its_theta_belongs_to_the_link() {
    let mut config = crate::support::irb2400();
    config.links[1].joint = JointKind::Prismatic;
    config.log = LogConversion::direct(AngleUnit::Rad, 6);
    let nominal = robot_chain(&config, &crate::support::bar()).links[1];
    let link = identified(&config).links[1];
    let (d_m, theta_deg) = (link.d_m - nominal.d_m, (link.theta_rad - nominal.theta_rad).to_degrees());
    let rows = corrections(&file(&config), &config, Deployment::Dh);
    let row = |what: &str| rows.iter().find(|row| row.what == what).unwrap();
    let (offset, theta) = (row("joint 2"), row("link 2 theta"));
    assert!(offset.unit == "mm" && (offset.add - d_m * 1e3).abs() < 1e-4, "{offset:?}");
    assert!(theta.unit == "deg" && (theta.add - theta_deg).abs() < 1e-5, "{theta:?}");
    assert!(rows.iter().all(|row| row.what != "link 2 d"), "{rows:?}");
    let of_log = log_corrections(&file(&config), &config, None, Deployment::Dh).unwrap();
    assert!(of_log[1].unit == "m" && (of_log[1].add - d_m).abs() < 1e-6, "{:?}", of_log[1]);
}

#[test]
fn a_written_calibration_is_read_from_either_file_and_gives_the_same_robot() {
    let config = crate::support::irb2400();
    let directory = tempfile::tempdir().unwrap();
    let written = file(&config);
    let toml = written.write(directory.path()).unwrap();
    for path in [toml.clone(), directory.path().join("calibration.json")] {
        let read = CalibrationFile::open(&path).unwrap();
        assert_eq!(read, written);
        assert_eq!(read.robot_chain(&config, Some(&crate::support::bar())), identified(&config));
    }
    let newer = std::fs::read_to_string(&toml).unwrap().replace("schema = 2", "schema = 99");
    std::fs::write(&toml, newer).unwrap();
    let error = CalibrationFile::open(&toml).unwrap_err().to_string();
    assert!(error.contains("schema 99"), "{error}");
    std::fs::write(&toml, "something = \"else\"").unwrap();
    assert!(CalibrationFile::open(&toml).is_err());
    assert!(CalibrationFile::open(&directory.path().join("none.toml")).is_err());
}

#[test]
fn a_calibration_of_schema_1_is_read_with_all_of_its_clocks() {
    let written = file(&crate::support::irb2400());
    let directory = tempfile::tempdir().unwrap();
    let toml = written.write(directory.path()).unwrap();
    // In files of schema 1, the first clock was stored separately from the others. The oldest files had no schema
    // number and used another name.
    let of_schema_1 = std::fs::read_to_string(&toml).unwrap().replace("schema = 2", "schema = 1")
        + r#"
        [clock]
        reference_utc = "2024-05-06T07:08:09.000Z"
        robot_minus_bar_ns = 5
        skew_ppm = 1.0
        correlation = 0.99
        overlap_s = 60.0
        [[other_clocks]]
        data_set = 3
        instrument = "tracker"
        reference_utc = "12.000 s (the tracker's clock, its epoch is unknown)"
        robot_minus_instrument_ns = 7
        skew_ppm = 2.0
        correlation = 0.98
        overlap_s = 50.0
    "#;
    std::fs::write(&toml, of_schema_1).unwrap();
    let read = CalibrationFile::open(&toml).unwrap();
    let clocks = read.clocks.iter();
    let clocks = clocks.map(|one| (one.data_set, one.instrument.as_str(), one.robot_minus_instrument_ns));
    assert_eq!(clocks.collect::<Vec<_>>(), [(1, "ball-bar", 5), (3, "tracker", 7)]);
    assert_eq!(CalibrationFile { clocks: Vec::new(), ..read }, written);
}

/// Terms of the robot: a gear error of the first joint, a gear error of a wrist joint with a high harmonic order, and the
/// deflection under the weight of the tool.
const TERMS: [(&str, f64); 3] = [("rsin1_1", 2e-4), ("rcos17_5", 3e-5), ("rtool_2", 1e-4)];

fn file_with_terms(robot: &RobotConfig) -> CalibrationFile {
    let mut file = file(robot);
    file.parameters.extend(TERMS.map(|(name, value)| ParameterEntry {
        name: name.into(),
        unit: "rad".into(),
        nominal: 0.0,
        value,
        correction: value,
        sigma: None,
        status: ParameterStatus::Identified,
    }));
    file
}

fn calibrated(file: &CalibrationFile, robot: &RobotConfig) -> CalibratedRobot {
    CalibratedRobot::new(file, robot, Some(&crate::support::bar())).unwrap()
}

#[test]
fn a_calibrated_robot_is_where_its_links_and_the_errors_of_its_gears_put_it_and_is_brought_back_there() {
    // Each drive of this robot moves only one joint, so the errors can be written explicitly.
    let config = crate::support::nj220();
    let robot = calibrated(&file_with_terms(&config), &config);
    let without_weight = {
        let mut file = file_with_terms(&config);
        file.parameters.pop();
        calibrated(&file, &config)
    };
    for q in &JOINTS {
        let mut moved = *q;
        moved[0] += 2e-4 * q[0].sin();
        moved[4] += 3e-5 * (17.0 * q[4]).cos();
        let expected = identified(&config).forward(&moved);
        let found = without_weight.forward(q).unwrap();
        assert!((found.to_homogeneous() - expected.to_homogeneous()).amax() < 1e-12);
        let pose = robot.forward(q).unwrap();
        assert_ne!(pose, found);
        let near: Vec<f64> = q.iter().map(|joint| joint + 0.02).collect();
        let back = robot.inverse(&pose, &near).unwrap();
        assert!(back.iter().zip(q).all(|(found, joint)| (found - joint).abs() < 1e-9), "{back:?} for {q:?}");
    }
    let away = Pose::translation(9.0, 0.0, 0.0);
    let error = robot.inverse(&away, &JOINTS[0]).unwrap_err();
    assert!(matches!(error, CalibratedRobotError::Inverse(InverseError::Unreachable { .. })), "{error}");
    assert_eq!(robot.forward(&[0.0; 5]).unwrap_err(), CalibratedRobotError::Joints { found: 5, expected: 6 });
    assert_eq!(robot.covariance(&JOINTS[0]).unwrap_err(), CalibratedRobotError::NoCovariance);
}

#[test]
fn the_uncertainty_of_a_pose_is_that_of_moving_each_parameter() {
    const H: f64 = 1e-6;
    let config = crate::support::irb2400();
    let mut file = file_with_terms(&config);
    // Terms of another run and of the bar do not affect the robot.
    let others = ["clock_shift", "btheta2@2"];
    let links = ["ra2", "rd4", "ralpha1", "rbeta2", "rtheta6"];
    let names: Vec<String> =
        links.into_iter().chain(TERMS.map(|(name, _)| name)).chain(others).map(str::to_owned).collect();
    let root = DMatrix::from_fn(names.len(), names.len(), |i, j| {
        1e-4 * (1.0 + 3.0 * i as f64 + 7.0 * j as f64).sin()
    });
    let covariance = &root * root.transpose();
    file.covariance = Some(CovarianceEntry {
        names: names.clone(),
        rows: covariance.row_iter().map(|row| row.iter().copied().map(Some).collect()).collect(),
    });
    let moved = |name: &str, by: f64| {
        let mut file = file.clone();
        file.parameters.iter_mut().filter(|entry| entry.name == name).for_each(|entry| entry.value += by);
        calibrated(&file, &config)
    };
    for q in &JOINTS {
        let mut by_parameter = DMatrix::zeros(6, names.len());
        for (column, name) in names.iter().enumerate() {
            let [less, more] = [-H, H].map(|by| moved(name, by).forward(q).unwrap());
            let linear = (more.translation.vector - less.translation.vector) / (2.0 * H);
            // The rotations are small. If their angle were computed from the trace, only
            // half of the digits would be correct.
            let turn = (more.rotation * less.rotation.inverse()).into_inner();
            let angular = Vector3::new(
                turn[(2, 1)] - turn[(1, 2)],
                turn[(0, 2)] - turn[(2, 0)],
                turn[(1, 0)] - turn[(0, 1)],
            ) / (4.0 * H);
            by_parameter.view_mut((0, column), (3, 1)).copy_from(&linear);
            by_parameter.view_mut((3, column), (3, 1)).copy_from(&angular);
        }
        let expected = &by_parameter * &covariance * by_parameter.transpose();
        let found = calibrated(&file, &config).covariance(q).unwrap();
        assert!((found - &expected).amax() < 1e-6 * expected.amax(), "{found} for {expected}");
    }
    // A parameter that is not identified must not count as exact.
    let all = file.covariance.as_mut().unwrap();
    all.rows.iter_mut().skip(1).for_each(|row| row[1] = None);
    all.rows[1].fill(None);
    let error = calibrated(&file, &config).covariance(&JOINTS[0]).unwrap_err();
    assert_eq!(error, CalibratedRobotError::NotIdentified { name: "rd4".into() });
}

#[test]
fn a_calibration_of_an_arm_with_more_axes_is_no_calibration_of_this_one() {
    let mut config = crate::support::nj220();
    let file = file(&config);
    config.links.pop();
    let error = CalibratedRobot::new(&file, &config, Some(&crate::support::bar())).unwrap_err();
    assert!(matches!(error, CalibratedRobotError::Parameter { .. }), "{error}");
}
