//! Arms with any number of revolute or prismatic axes. Tests cover import from URDF in both conventions, inverse kinematics,
//! calibration, and the check of a robot's file.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]
#![allow(clippy::approx_constant, reason = "as people write it who mean radians")]

use std::f64::consts::FRAC_PI_2;
use std::path::PathBuf;
use std::process::Command;

use identify::calibrate::{IdentifyConfig, JointTermsConfig, calibrate_run};
use identify::cost::{Length, LoopProblem, Position, Residual};
use identify::evaluate::workspace_error;
use identify::kinematics::{
    Chain, InverseError, Joints, LinkParameter, Pose, Trace, Tracer, ball_bar_chain, flange_chain,
    robot_chain, robot_inverse, robot_inverse_all,
};
use identify::logs::PoseRow;
use identify::model::{
    DriveTrain, JointTerm, Load, Model, Observation, Owner, ParameterId, PerObservation, Period, Phase,
    Selection,
};
use identify::plan::Design;
use identify::report::result::robot_files::urdf;
use identify::robot::{ImportError, Imported, check, import};
use identify::simulate::{self, Effects, Experiment, StaticErrors};
use identify::solver::stacked;
use nalgebra::{Rotation3, Vector3};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use rand_distr::StandardNormal;
use shared::config::{self, JointKind, LinkConfig, RobotConfig, TransformConfig, Validate};

use crate::support::independent::{Matrix, identity, product, shift, turn};
use crate::support::repository;
use crate::support::rows::{Alone, Found};

/// Name of the URDF file, base link and tip link of each arm.
const ARMS: [(&str, &str, &str); 3] =
    [("ur10", "base_link", "tool0"), ("seven_axes", "base", "flange"), ("on_a_track", "cell", "tool")];

fn text(name: &str) -> String {
    std::fs::read_to_string(repository("identify/tests/data").join(format!("{name}.urdf"))).unwrap()
}

fn imported((name, base, tip): (&str, &str, &str)) -> Imported {
    import(&text(name), Some(base), Some(tip)).unwrap()
}

fn parsed(toml: &str) -> RobotConfig {
    let robot: RobotConfig = toml::from_str(toml).unwrap();
    robot.validate().unwrap();
    robot
}

/// Forward kinematics of a URDF, implemented from the specification of URDF. The crate `urdf-rs` reads the file. Right
/// angles with nine decimals are replaced by exact ones.
fn by_urdf(text: &str, base: &str, tip: &str, joints: &[f64]) -> Matrix<f64> {
    let robot = urdf_rs::read_from_string(text).unwrap();
    let mut path = Vec::new();
    let mut link = tip;
    while link != base {
        let joint = robot.joints.iter().find(|joint| joint.child.link == link).unwrap();
        path.push(joint);
        link = &joint.parent.link;
    }
    let mut variables = joints.iter();
    path.iter().rev().fold(identity(), |pose, joint| {
        let right = |rad: f64| {
            if (rad.abs() - FRAC_PI_2).abs() < 2e-9 { FRAC_PI_2.copysign(rad) } else { rad }
        };
        let ([x, y, z], [roll, pitch, yaw]) = (joint.origin.xyz.0, joint.origin.rpy.0.map(right));
        let origin = [shift(x, y, z), turn(0, 1, yaw), turn(2, 0, pitch), turn(1, 2, roll)];
        let pose = origin.iter().fold(pose, |pose, factor| product(&pose, factor));
        let [x, y, z] = joint.axis.xyz.0;
        let axis = Vector3::new(x, y, z).normalize();
        match joint.joint_type {
            urdf_rs::JointType::Fixed => pose,
            urdf_rs::JointType::Prismatic => {
                let way = axis * *variables.next().unwrap();
                product(&pose, &shift(way.x, way.y, way.z))
            }
            _ => {
                // Rodrigues' formula.
                let (sin, cos) = variables.next().unwrap().sin_cos();
                let k = axis.cross_matrix();
                let turned = nalgebra::Matrix3::identity() + k * sin + k * k * (1.0 - cos);
                let mut matrix = identity();
                (0..9).for_each(|at| matrix[at / 3][at % 3] = turned[(at / 3, at % 3)]);
                product(&pose, &matrix)
            }
        }
    })
}

/// Largest difference between the entries of two poses.
fn pose_error(found: &Pose, expected: &Matrix<f64>) -> f64 {
    let found = found.to_homogeneous();
    (0..16).map(|at| (found[(at / 4, at % 4)] - expected[at / 4][at % 4]).abs()).fold(0.0, f64::max)
}

fn random_joints(robot: &RobotConfig, random: &mut StdRng) -> Joints {
    robot.joint_limits().iter().map(|&[low, high]| random.random_range(low..high)).collect()
}

#[test]
fn a_urdf_becomes_a_configuration_with_the_same_forward_kinematics() {
    let mut random = StdRng::seed_from_u64(1);
    for arm in ARMS {
        let imported = imported(arm);
        let written = imported.to_toml(arm.0);
        let robot = parsed(&written);
        assert_eq!(robot, imported.config, "{written}");
        assert_eq!(flange_chain(&robot).forward(&[]).rotation.matrix().determinant().round(), 1.0);
        for _ in 0..50 {
            let joints = random_joints(&robot, &mut random);
            let off = pose_error(
                &flange_chain(&robot).forward(&joints),
                &by_urdf(&text(arm.0), arm.1, arm.2, &joints),
            );
            assert!(off < 1e-12, "{}: {off:e}", arm.0);
        }
    }
}

#[test]
fn links_of_a_urdf_are_those_of_the_data_sheet_where_it_has_any() {
    let robot = imported(ARMS[0]).config;
    let lengths: Vec<[f64; 2]> = robot.links.iter().map(|link| [link.a_m, link.d_m]).collect();
    let rounded = lengths.iter().flatten().map(|length| (length.abs() * 1e6).round() / 1e6);
    // The offset along three parallel axes can be assigned to any of the three. The import assigns the
    // sum of all offsets to the shoulder.
    let expected = [0.0, 0.1273, 0.612, 0.0, 0.5723, 0.0, 0.0, 0.163941, 0.0, 0.1157, 0.0, 0.0922];
    assert_eq!(rounded.collect::<Vec<f64>>(), expected);
    assert_eq!(imported(ARMS[1]).joints, ["a1", "a2", "a3", "a4", "a5", "a6", "a7"]);
    let on_track = imported(ARMS[2]);
    assert_eq!(on_track.config.links[0].joint, JointKind::Prismatic);
    assert_eq!(on_track.config.joint_limits_m, [[0.0, 3.0]]);
    assert!(on_track.assumed[0].contains("`turntable` has no limits"), "{:?}", on_track.assumed);
    assert!(on_track.to_toml("x").contains("# Please correct: joint `turntable`"));
}

#[test]
fn axes_a_little_from_parallel_become_links_of_a_robot_s_size() {
    let mut random = StdRng::seed_from_u64(4);
    for roll_rad in [1e-4, 3e-3, 0.02, 0.06, 0.3] {
        let skew = format!("0.612\" rpy=\"{roll_rad} 0 0\"");
        let urdf = text("ur10").replacen("0.612\" rpy=\"0 0 0\"", &skew, 1);
        assert!(urdf.contains(&skew));
        let imported = import(&urdf, Some("base_link"), Some("tool0")).unwrap();
        let robot = parsed(&imported.to_toml("x"));
        assert!(check(&robot).suspicious.is_empty(), "{roll_rad}: {:?}", check(&robot).suspicious);
        for _ in 0..20 {
            let joints = random_joints(&robot, &mut random);
            let off = pose_error(
                &flange_chain(&robot).forward(&joints),
                &by_urdf(&urdf, "base_link", "tool0", &joints),
            );
            assert!(off < 1e-12, "{roll_rad}: {off:e}");
        }
    }
}

#[test]
fn what_is_assumed_of_limits_says_what_the_file_has() {
    let limits = |lower: &str, upper: &str| {
        let range = "lower=\"-2.96706\" upper=\"2.96706\"";
        let urdf = text("seven_axes").replacen(range, &format!("lower=\"{lower}\" upper=\"{upper}\""), 1);
        import(&urdf, None, None).unwrap().assumed
    };
    assert!(limits("-2", "2").is_empty());
    assert!(limits("2", "-2")[0].contains("has limits of 114.591559026 to -114.591559026 deg in the file"));
    assert!(limits("1", "1")[0].contains("which are not a range"));
    assert!(limits("0", "0")[0].contains("no limits in the file, or both are zero"));
}

#[test]
fn a_urdf_that_gives_no_serial_arm_is_refused_with_what_to_do() {
    let refusal = |text: &str, base: Option<&str>, tip: Option<&str>| import(text, base, tip).unwrap_err();
    let ur10 = text("ur10");
    assert!(matches!(refusal("<robot", None, None), ImportError::NotUrdf(_)));
    assert!(matches!(refusal("rod_m = 0.3", None, None), ImportError::NotUrdf(_)));
    let binary = refusal("<\u{1}\u{7}></\u{1}\u{7}>", None, None).to_string();
    assert!(!binary.contains(char::is_control), "{binary:?}");
    let frames = ur10.replace("tool0", "left_frame").replace("ee_link", "right_frame");
    let told = refusal(&frames, None, None).to_string();
    assert!(told.contains("right_frame (6), left_frame (6)") && told.contains("--tip"), "{told}");
    let told = refusal(&ur10, Some("nowhere"), Some("tool0")).to_string();
    assert!(told.contains("no link `nowhere`") && told.contains("base_link"), "{told}");
    assert!(matches!(refusal(&ur10, Some("ee_link"), Some("tool0")), ImportError::NotConnected { .. }));
    assert!(matches!(refusal(&ur10, Some("wrist_2_link"), Some("tool0")), ImportError::Axes { axes: 1, .. }));
    let seven = text("seven_axes");
    let floating = seven.replace("name=\"a3\" type=\"revolute\"", "name=\"a3\" type=\"floating\"");
    assert!(refusal(&floating, None, None).to_string().contains("joint `a3` is floating"));
    let mimic = seven.replacen("<axis", "<mimic joint=\"a2\"/><axis", 1);
    assert!(refusal(&mimic, None, None).to_string().contains("follows joint `a2`"));
    let nowhere = seven.replacen("<axis xyz=\"0 0 1\"/>", "<axis xyz=\"0 0 0\"/>", 1);
    assert!(refusal(&nowhere, None, None).to_string().contains("axis without direction"));
    // URDF files that are not supported or contradict themselves are refused.
    for (from, to, told) in [
        ("xyz=\"0 0 0.2025\"", "xyz=\"nan 0 0.2025\"", "joint `a2` has NaN in its origin or axis"),
        ("xyz=\"0 0 0.2025\"", "xyz=\"0 0 202.5\"", "links[0].d_m: 202.6575 is outside -10 to 10"),
        ("joint name=\"a3\"", "joint name=\"a2\"", "several joints have the name `a2`"),
        ("link name=\"l3\"", "link name=\"l2\"", "several links have the name `l2`"),
        ("child link=\"l3\"", "child link=\"l2\"", "several joints lead to link `l2`"),
    ] {
        let error = refusal(&seven.replacen(from, to, 1), None, None).to_string();
        assert!(error.contains(told) && error.contains("correct the file"), "{told}: {error}");
    }
}

/// Text of a URDF joint with these attributes. `rest` contains the further elements of the joint, such as origin and axis.
fn joint(name: &str, kind: &str, [parent, child]: [&str; 2], rest: &str) -> String {
    format!(
        "<joint name=\"{name}\" type=\"{kind}\"><parent link=\"{parent}\"/><child link=\"{child}\"/>{rest}</joint>\n"
    )
}

/// A URDF in the style of ROS-Industrial. The arm has the six axes of a FANUC arm with spherical wrist, of which axes
/// 2 and 3 have opposite directions. The file also contains frames `base` and `tool0`, duplicate materials, sensors
/// of a simulator, and transmissions.
fn fanuc_urdf() -> String {
    let links =
        ["base_link", "link_1", "link_2", "link_3", "link_4", "link_5", "link_6", "base", "flange", "tool0"];
    let shape = "<visual><origin xyz=\"nowhere\"/><geometry><mesh filename=\"a.stl\"/></geometry><material name=\"yellow\"/>\
                 <material name=\"\"><color rgba=\"1 1 0 1\"/></material></visual><inertial/>";
    let mut text = "<?xml version=\"1.0\" ?>\n<robot name=\"fanuc_lrmate200id\">\n".to_owned();
    links.iter().for_each(|link| text += &format!("<link name=\"{link}\">{shape}</link>\n"));
    for (number, (xyz, axis)) in [
        ("0 0 0.330", "0 0 1"),
        ("0.050 0 0", "0 1 0"),
        ("0 0 0.330", "0 -1 0"),
        ("0 0 0.035", "-1 0 0"),
        ("0.335 0 0", "0 -1 0"),
        ("0.080 0 0", "-1 0 0"),
    ]
    .into_iter()
    .enumerate()
    {
        let rest = format!(
            "<origin xyz=\"{xyz}\" rpy=\"0 0 0\"/><axis xyz=\"{axis}\"/><limit lower=\"-1.7453\" upper=\"1.7453\" effort=\"0\"/>"
        );
        text +=
            &joint(&format!("joint_{}", number + 1), "revolute", [links[number], links[number + 1]], &rest);
    }
    let to = |xyz: &str, rpy: &str| format!("<origin xyz=\"{xyz}\" rpy=\"{rpy}\"/>");
    text += &joint("base_link-base", "fixed", ["base_link", "base"], &to("0 0 0.330", "0 0 0"));
    text += &joint("link_6-flange", "fixed", ["link_6", "flange"], &to("0 0 0", "0 0 0"));
    text += &joint("flange-tool0", "fixed", ["flange", "tool0"], &to("0 0 0", "3.1415926535 -1.570796327 0"));
    text += "<transmission name=\"t\"><joint name=\"joint_1\"><hardwareInterface>P</hardwareInterface></joint></transmission>\n\
             <gazebo reference=\"link_6\"><sensor:camera name=\"c\"><joint/><link/></sensor:camera></gazebo>\n</robot>\n";
    text
}

#[test]
fn an_arm_is_found_among_the_frames_shapes_and_sensors_of_its_urdf() {
    let imported = import(&fanuc_urdf(), None, None).unwrap();
    assert_eq!((imported.base.as_str(), imported.tip.as_str()), ("base_link", "tool0"));
    assert_eq!(imported.joints, ["joint_1", "joint_2", "joint_3", "joint_4", "joint_5", "joint_6"]);
    assert_eq!(imported.config.links[0].d_m, 0.33);
    // Adds fixed links before the first and after the last axis, a gripper, and a second end that has fewer axes.
    let fixed = |parent: &str, child: &str| {
        format!("<link name=\"{child}\"/>{}", joint(child, "fixed", [parent, child], ""))
    };
    let moving = |parent: &str, child: &str| {
        format!("<link name=\"{child}\"/>{}", joint(child, "revolute", [parent, child], ""))
    };
    let ends = |added: &[String], tip_name: &str| {
        let text =
            fanuc_urdf().replace("\"tool0\"", &format!("\"{tip_name}\"")).replace("\"flange\"", "\"plate\"");
        let imported = import(&text.replace("</robot>", &(added.concat() + "</robot>")), None, None);
        imported.map(|imported| (imported.base, imported.tip, imported.left_out))
    };
    let of = |added: &[String], tip_name: &str| ends(added, tip_name).unwrap();
    assert_eq!(of(&[], "tcp").1, "tcp");
    assert_eq!(of(&[fixed("link_5", "camera")], "tcp").1, "tcp");
    assert_eq!(of(&[fixed("link_6", "ee_link")], "tcp").1, "ee_link");
    let (base, tip, left_out) = of(&[moving("tcp", "left_finger"), moving("tcp", "right_finger")], "tcp");
    assert_eq!((base.as_str(), tip.as_str()), ("base_link", "tcp"));
    assert!(left_out[0].contains("joint `left_finger` is taken for a gripper's"), "{left_out:?}");
    let (base, _, left_out) = of(
        &["<link name=\"world\"/>".to_owned() + &joint("on_world", "fixed", ["world", "base_link"], "")],
        "tcp",
    );
    assert_eq!(base, "base_link");
    assert!(left_out[0].contains("--base world"), "{left_out:?}");
    // If there is a link with the standard name of a flange, parts that are mounted on it are ignored. The last link of the
    // arm may have a name that is usual for a gripper.
    assert_eq!(of(&[fixed("tcp", "hand"), fixed("link_6", "arm_link8")], "tcp").1, "arm_link8");
    let wrist = fanuc_urdf().replace("\"link_6\"", "\"gripper\"").replace("\"tool0\"", "\"tcp\"");
    assert_eq!(import(&wrist.replace("\"flange\"", "\"plate\""), None, None).unwrap().config.axes(), 6);
    // If the file has two arms, the user must select the tip.
    let told = ends(&[moving("link_4", "other")], "tcp").unwrap_err().to_string();
    assert!(told.ends_with(": tcp (6), other (5)"), "{told}");
}

#[test]
fn a_urdf_that_is_none_is_told_by_what_is_wrong_with_it() {
    let told = |text: &str| import(text, None, None).unwrap_err().to_string();
    let xacro = fanuc_urdf().replacen("<link", "<xacro:include filename=\"x\"/><link", 1);
    assert!(
        told(&xacro).contains("<xacro:include>") && told(&xacro).contains("`xacro arm"),
        "{}",
        told(&xacro)
    );
    for (text, expected) in [
        ("<sdf><model/></sdf>".to_owned(), "its first element is <sdf>, not <robot>"),
        (fanuc_urdf().replace("</robot>", ""), "it ends within <robot>"),
        (
            fanuc_urdf().replace("<link name=\"base_link\">", "<link name=\"elsewhere\">"),
            "joint `joint_1` has the parent `base_link`, which is not a link",
        ),
        (fanuc_urdf().replacen("0.330", "0,330", 1), "joint `joint_1` has `0 0 0,330` as xyz of its origin"),
        ("<robot name=\"empty\"/>".to_owned(), "no joint moves in it"),
        (
            fanuc_urdf().replacen("<parent link=\"base_link\"", "<parent link=\"link_5\"", 1),
            "its joints form a circle through joint `joint_",
        ),
    ] {
        let told = told(&text);
        assert!(told.contains(expected) && !told.contains("xacro"), "{told}");
    }
    // Joints that are not part of the arm may be of any type.
    let broken = "<link name=\"lamp\"/><joint name=\"x\" type=\"planar\"><parent link=\"base\"/><child link=\"lamp\"/>\
                  <axis/></joint></robot>";
    let beside = fanuc_urdf().replace("</robot>", broken);
    assert_eq!(
        import(&beside, None, None).unwrap().config,
        import(&fanuc_urdf(), None, None).unwrap().config
    );
}

#[test]
fn numbers_are_written_as_people_mean_them() {
    let urdf = fanuc_urdf().replacen("rpy=\"0 0 0\"", "rpy=\"1.5708 -3.1416 1.57\"", 1).replacen(
        "0.335 0 0\" rpy=\"0 0 0\"",
        "0.335 0 0\" rpy=\"0.523598775 0 0\"",
        1,
    );
    let imported = import(&urdf, None, None).unwrap();
    let written = imported.to_toml("x");
    // Joint limits are not rounded, so their lines are skipped here.
    let lines = written.lines().filter(|line| !line.starts_with('#') && !line.starts_with("joint_limits"));
    let numbers = lines.flat_map(|line| {
        line.split(|c: char| !(c.is_ascii_alphanumeric() || ".-".contains(c)))
            .filter_map(|word| word.parse::<f64>().ok())
    });
    for number in numbers {
        let (places, text) = (number * 1e6, number.to_string());
        assert!(places == places.round() && !text.starts_with("-0") || text.len() < 9, "{text} in {written}");
    }
    assert!(
        !written.contains("e-") && !written.contains("-0.0,") && !written.contains("= -0.0\n"),
        "{written}"
    );
    assert_eq!(check(&imported.config).suspicious, Vec::<String>::new());
    // If the import rounds an angle by more than the repeatability of a robot, it must report this.
    let told = imported.assumed.concat();
    assert!(told.contains("turned by 1.57 rad in the file: 90 deg are taken"), "{told}");
    assert_eq!(told.matches("are taken").count(), 1, "{told}");
    // Many URDF files of UR robots have angles with nine decimals. The import rounds these angles without a report.
    let turned = |rpy: &str| {
        let urdf = fanuc_urdf().replacen("rpy=\"0 0 0\"", &format!("rpy=\"{rpy}\""), 1);
        import(&urdf, None, None).unwrap().config
    };
    assert_eq!(turned("1.570796325 0 0"), turned("1.5707963267948966 0 0"));
    // An angle that was measured must not be rounded.
    let measured = fanuc_urdf().replacen("rpy=\"0 0 0\"", "rpy=\"1.5702 0 1.5699\"", 1);
    assert!(!import(&measured, None, None).unwrap().assumed.concat().contains("are taken"));
}

#[test]
fn joint_3_of_a_fanuc_controller_does_not_include_joint_2() {
    let imported = import(&fanuc_urdf(), None, None).unwrap();
    let coupling: Vec<f64> = imported.config.log.raw_to_joint.iter().map(|row| row[2]).collect();
    assert_eq!(coupling, [0.0, 1.0, 1.0, 0.0, 0.0, 0.0]);
    let written = imported.to_toml("x");
    assert!(written.contains("# Please correct: the log has J1 to J6 of a FANUC controller"), "{written}");
    let other = import(&fanuc_urdf().replace("fanuc_lrmate200id", "arm"), None, None).unwrap();
    assert_eq!(other.config.log.raw_to_joint[1][2], 0.0);
    assert_eq!(other.assumed, Vec::<String>::new());
    // If axes 2 and 3 are reversed, the user must decide whether the joints are coupled.
    let along = import(&fanuc_urdf().replacen("0 -1 0", "0 1 0", 1), None, None).unwrap();
    assert_eq!(along.config.log.raw_to_joint[1][2], 0.0);
    assert!(along.assumed[0].contains("J3 of a FANUC controller does not include J2"), "{:?}", along.assumed);
}

/// Axes 2 and 3 of ABB's arms point to the same side, but the coupling depends on the type of arm.
#[test]
fn joint_3_of_an_abb_arm_with_a_parallel_rod_does_not_include_joint_2() {
    let of = |name: &str| fanuc_urdf().replace("fanuc_lrmate200id", name).replacen("0 -1 0", "0 1 0", 1);
    let imported = import(&of("abb_irb2400_12_155"), None, None).unwrap();
    let coupling: Vec<f64> = imported.config.log.raw_to_joint.iter().map(|row| row[2]).collect();
    assert_eq!(coupling, [0.0, -1.0, 1.0, 0.0, 0.0, 0.0]);
    let written = imported.to_toml("x");
    assert!(written.contains("# Please correct: the log has J1 to J6 of an ABB controller"), "{written}");
    assert!(written.contains("joint 3 = J3 - J2"), "{written}");
    for name in ["abb_irb4600_20_250", "abb_irb14000"] {
        let without_rod = import(&of(name), None, None).unwrap();
        assert_eq!(without_rod.config.log.raw_to_joint[1][2], 0.0, "{name}");
        assert_eq!(without_rod.assumed, Vec::<String>::new(), "{name}");
    }
}

#[test]
fn a_wrist_is_spherical_behind_axes_that_are_parallel_in_either_sense() {
    let mut random = StdRng::seed_from_u64(7);
    for (from, to) in [("", ""), ("0 -1 0", "0 1 0"), ("0 0 0.330\" rpy", "0 0.02 0.330\" rpy")] {
        let robot = import(&fanuc_urdf().replacen(from, to, 1), None, None).unwrap().config;
        let closed = check(&robot).facts.into_iter().find(|fact| fact.0 == "inverse kinematics").unwrap();
        assert!(closed.1.contains("closed form"), "{}", closed.1);
        let chain = flange_chain(&robot);
        for _ in 0..50 {
            let joints = random_joints(&robot, &mut random);
            if joints[4].abs() < 0.1 {
                continue;
            }
            let target = chain.forward(&joints);
            let solutions = robot_inverse_all(&chain, &target).unwrap();
            let matches = |found: &Joints| found.iter().zip(&joints).all(|(a, b)| (a - b).abs() < 1e-6);
            assert!(solutions.iter().any(matches), "{joints:?} is not in {solutions:?}");
            for found in &solutions {
                let off = chain.forward(found).to_homogeneous() - target.to_homogeneous();
                assert!(off.amax() < 1e-9, "{off}");
            }
        }
    }
}

#[test]
fn a_wrist_with_an_offset_has_no_closed_form_and_is_inverted_numerically() {
    for (from, to, key) in [
        ("0.080 0 0", "0.080 0 0.08", "link 5 has a_m = "),
        ("0.335 0 0", "0.335 0 0.08", "link 4 has a_m = "),
        ("0.080 0 0", "0.080 0.05 0", "link 5 has d_m = "),
    ] {
        let robot = import(&fanuc_urdf().replacen(from, to, 1), None, None).unwrap().config;
        let chain = flange_chain(&robot);
        let fact = check(&robot).facts.into_iter().find(|fact| fact.0 == "inverse kinematics").unwrap();
        assert!(fact.1.contains("numerical") && fact.1.contains(key), "{key}: {}", fact.1);
        let joints = [0.3, -0.2, 0.4, 0.5, 0.7, -0.6];
        let target = chain.forward(&joints);
        let all = robot_inverse_all(&chain, &target);
        assert!(matches!(all, Err(InverseError::Structure { .. })), "{all:?}");
        let found = robot_inverse(&chain, &target, &joints.map(|q| q + 0.05)).unwrap();
        assert!((chain.forward(&found).to_homogeneous() - target.to_homogeneous()).amax() < 1e-9);
    }
}

#[test]
fn two_axes_on_one_line_are_reported_also_where_others_make_up_for_them() {
    // An arm that is mounted in the centre of a turntable.
    let table = "<link name=\"table\"/><link name=\"floor\"/>".to_owned()
        + &joint("turn", "continuous", ["floor", "table"], "<axis xyz=\"0 0 1\"/>")
        + &joint("mount", "fixed", ["table", "base_link"], "<origin xyz=\"0 0 0.4\"/>")
        + "</robot>";
    let urdf = fanuc_urdf().replace("</robot>", &table);
    let found = |urdf: &str| check(&import(urdf, Some("floor"), None).unwrap().config).suspicious;
    assert!(found(&urdf)[0].starts_with("axes 1 and 2 rotate about the same line"), "{:?}", found(&urdf));
    assert_eq!(found(&urdf.replace("0 0 0.4", "0.1 0 0.4")), Vec::<String>::new());
    let slides = urdf.replace("continuous", "prismatic");
    assert_eq!(found(&slides), Vec::<String>::new());
}

/// A Franka Emika Panda in Craig's convention as its manufacturer published it, here mounted on a linear track.
const MODIFIED: &str = r#"
name = "seven axes on a track"
convention = "modified"
joint_limits_deg = [[-166, 166], [-101, 101], [-166, 166], [-176, -4], [-166, 166], [-1, 215], [-166, 166]]
joint_limits_m = [[0, 2]]
base = { xyz_m = [0.1, 0.2, 0.3], rpy_deg = [10, 20, 30] }
flange = { xyz_m = [0, 0, 0.107], rpy_deg = [0, 0, -45] }
links = [
    { joint = "prismatic", a_m = 0.05, alpha_deg = -90, d_m = 0.1, theta_deg = 15 },
    { a_m = 0, alpha_deg = 90, d_m = 0.333, theta_deg = 0 },
    { a_m = 0, alpha_deg = -90, d_m = 0, theta_deg = 0 },
    { a_m = 0, alpha_deg = 90, d_m = 0.316, theta_deg = 0 },
    { a_m = 0.0825, alpha_deg = 90, d_m = 0, theta_deg = 0 },
    { a_m = -0.0825, alpha_deg = -90, d_m = 0.384, theta_deg = 0 },
    { a_m = 0, alpha_deg = 90, d_m = 0, theta_deg = 0 },
    { a_m = 0.088, alpha_deg = 90, d_m = 0, theta_deg = 0 },
]
log = { column = "joint", unit = "rad", raw_offset_rad = [0, 0, 0, 0, 0, 0, 0, 0], raw_to_joint = [
    [1, 0, 0, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0, 0, 0], [0, 0, 0, 1, 0, 0, 0, 0],
    [0, 0, 0, 0, 1, 0, 0, 0], [0, 0, 0, 0, 0, 1, 0, 0], [0, 0, 0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, 0, 0, 1]] }
"#;

#[test]
fn a_table_is_read_in_either_convention_with_prismatic_axes() {
    let mut random = StdRng::seed_from_u64(2);
    for convention in ["modified", "standard"] {
        let robot = parsed(&MODIFIED.replace("\"modified\"", &format!("\"{convention}\"")));
        let place = |[x, y, z]: [f64; 3], [roll, pitch, yaw]: [f64; 3]| {
            let turns = [(0, 1, yaw), (2, 0, pitch), (1, 2, roll)];
            turns
                .iter()
                .fold(shift(x, y, z), |pose, &(i, j, deg)| product(&pose, &turn(i, j, f64::to_radians(deg))))
        };
        for _ in 0..20 {
            let joints = random_joints(&robot, &mut random);
            let base = place(robot.base.xyz_m, robot.base.rpy_deg);
            let last = robot.links.iter().zip(&joints).fold(base, |pose, (link, &q)| {
                let (slide, turned) = if link.joint == JointKind::Prismatic { (q, 0.0) } else { (0.0, q) };
                let about_z = product(
                    &turn(0, 1, link.theta_deg.to_radians() + turned),
                    &shift(0.0, 0.0, link.d_m + slide),
                );
                let about_x = product(&turn(1, 2, link.alpha_deg.to_radians()), &shift(link.a_m, 0.0, 0.0));
                let link = if convention == "modified" {
                    product(&about_x, &about_z)
                } else {
                    product(&about_z, &about_x)
                };
                product(&pose, &link)
            });
            let expected = product(&last, &place(robot.flange.xyz_m, robot.flange.rpy_deg));
            let off = pose_error(&flange_chain(&robot).forward(&joints), &expected);
            assert!(off < 1e-13, "{convention}: {off:e}");
        }
    }
}

#[test]
fn twists_of_prismatic_axes_and_of_links_behind_them_are_the_derivatives() {
    let chain = flange_chain(&parsed(MODIFIED));
    let joints = Joints::from([0.7, 0.3, -0.4, 0.5, -1.2, 0.6, 0.9, -0.2]);
    let mut trace = Trace::default();
    Tracer::new(&chain).trace(&joints, &mut trace);
    assert!((trace.end().to_homogeneous() - chain.forward(&joints).to_homogeneous()).amax() < 1e-14);
    let moved = |change: &dyn Fn(&mut Chain, &mut Joints, f64)| {
        let end = |by: f64| {
            let (mut chain, mut joints) = (chain.clone(), joints);
            change(&mut chain, &mut joints, by);
            chain.forward(&joints)
        };
        let (before, after) = (end(-1e-6), end(1e-6));
        // The logarithm of nalgebra computes an arc cosine, which loses half of the digits for small angles. Compute the
        // rotation vector from the sine instead.
        let turn = *(after.rotation * before.rotation.inverse()).matrix();
        let turned = 0.5
            * Vector3::new(
                turn[(2, 1)] - turn[(1, 2)],
                turn[(0, 2)] - turn[(2, 0)],
                turn[(1, 0)] - turn[(0, 1)],
            );
        ((after.translation.vector - before.translation.vector) / 2e-6, turned / 2e-6)
    };
    for (axis, twist) in trace.joint_twists().enumerate() {
        let (linear, angular) = moved(&|_, joints, by| joints[axis] += by);
        assert!((twist.linear - linear).norm() < 1e-8 && (twist.angular - angular).norm() < 1e-8, "{axis}");
    }
    for (link, parameter) in (0..8).flat_map(|link| [(link, LinkParameter::A), (link, LinkParameter::Alpha)])
    {
        let (linear, angular) = moved(&|chain, _, by| match parameter {
            LinkParameter::A => chain.links[link].a_m += by,
            _ => chain.links[link].alpha_rad += by,
        });
        let twist = trace.twist(link, parameter).unwrap();
        assert!((twist.linear - linear).norm() < 1e-8 && (twist.angular - angular).norm() < 1e-8, "{link}");
    }
}

/// Checks that the derivative by a link parameter is zero if and only if the cost states that the parameter has no effect.
fn depends_as_stated<R: Residual>(residual: R, arm: &Chain, poses: &[Joints]) {
    let mut bar = ball_bar_chain(&crate::support::bar());
    bar.root_from_base.translation.vector = Vector3::new(1.0, 0.05, 0.35);
    let mut model = Model::ball_bar(arm, &bar);
    model.free_only(|id| matches!(id, ParameterId::Robot { .. }));
    let observation = |pose: usize| Observation::bar(PerObservation::time_s(pose), [0.3; 5]);
    let observations: Vec<Observation> = (0..poses.len()).map(observation).collect();
    let motion = PerObservation(poses.to_vec());
    let problem = LoopProblem::new(&model, &motion, &observations, residual, 1.0).unwrap();
    let (_, jacobian) = stacked(&problem, &model.start()).unwrap();
    for (column, parameter) in model.columns().enumerate() {
        let has_effect = jacobian.column(column).amax() > 1e-12;
        let stated = R::depends_on(parameter.id, arm);
        assert_eq!(has_effect, stated, "{} by {} of {} axes", R::NAME, parameter.id, model.axes());
    }
    // For costs that use only the end, a rotation after the last joint has the same effect
    // as `d` and `theta` of the last link.
    model.select(Selection::Cell, R::identifies);
    let is_free =
        |link: usize| model.column_of(ParameterId::Robot { link, parameter: LinkParameter::Alpha }).is_some();
    let last = model.axes() - 1;
    assert!(is_free(last - 1) && !is_free(last), "{} of {} axes", R::NAME, model.axes());
}

#[test]
fn positions_depend_on_all_rotations_of_an_arm_except_those_of_the_link_at_whose_end_they_are() {
    let (bar, mut random) = (crate::support::bar(), StdRng::seed_from_u64(9));
    for arm in ARMS {
        let mut robot = imported(arm).config;
        // The offset plate is part of the last link. With a displaced flange, the plate would follow the flange instead.
        robot.flange = TransformConfig::default();
        robot.links.last_mut().unwrap().alpha_deg = 0.0;
        let mut displaced = robot.clone();
        displaced.flange.xyz_m = [0.0, 0.02, 0.1];
        for robot in [robot, displaced] {
            let chain = robot_chain(&robot, &bar);
            let poses: Vec<Joints> = (0..20).map(|_| random_joints(&robot, &mut random)).collect();
            depends_as_stated(Length, &chain, &poses);
            depends_as_stated(Position, &chain, &poses);
        }
    }
}

#[test]
fn arms_without_a_closed_form_are_inverted_from_near_and_move_no_further_than_they_must() {
    let mut random = StdRng::seed_from_u64(3);
    for arm in ARMS {
        let robot = imported(arm).config;
        let chain = flange_chain(&robot);
        for _ in 0..20 {
            let joints = random_joints(&robot, &mut random).map(|q| 0.6 * q);
            let by: Joints = joints.iter().map(|_| random.random_range(-0.02..0.02)).collect();
            let target = chain.forward(&Joints::from_fn(joints.len(), |axis| joints[axis] + by[axis]));
            let Ok(found) = robot_inverse(&chain, &target, &joints) else { continue };
            assert!((chain.forward(&found).to_homogeneous() - target.to_homogeneous()).amax() < 1e-9);
            let moved = found.iter().zip(&joints).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
            let known = by.iter().map(|by| by * by).sum::<f64>().sqrt();
            // With more than six axes, the solver may find a solution with a shorter motion than the known one. It may also
            // find a slightly longer one, because it follows the curved path.
            assert!(moved < 1.05 * known + 1e-9, "{}: {moved} {known}", arm.0);
        }
        let regular = Joints::from_fn(robot.axes(), |axis| 0.4 + 0.1 * axis as f64);
        let found = robot_inverse(&chain, &chain.forward(&regular.map(|q| q + 0.01)), &regular).unwrap();
        assert_eq!(found.len(), robot.axes());
        let all = robot_inverse_all(&chain, &chain.forward(&regular));
        assert!(matches!(all, Err(InverseError::Structure { .. } | InverseError::Links { .. })), "{all:?}");
    }
    let scara = flange_chain(&imported(ARMS[0]).config);
    let three = Chain::new(Pose::identity(), scara.links[..3].to_vec());
    let refused = robot_inverse(&three, &Pose::identity(), &[0.0; 3]).unwrap_err();
    assert_eq!(refused, InverseError::Links { found: 3, expected: 6 });
}

/// Rows of a tracker for an arm with errors in all links, and the true chain of the arm. The
/// rows have noise of 20 um and 20 urad.
fn tracked(robot: &RobotConfig, count: usize) -> (Vec<PoseRow>, Chain) {
    const NOISE: f64 = 2e-5;
    let mut random = StdRng::seed_from_u64(5);
    let mut truth = flange_chain(robot);
    for link in &mut truth.links {
        link.a_m += random.random_range(-1e-3..1e-3);
        link.d_m += random.random_range(-1e-3..1e-3);
        link.theta_rad += random.random_range(-3e-3..3e-3);
        link.alpha_rad += random.random_range(-2e-3..2e-3);
    }
    let place =
        Pose::from_parts(Vector3::new(-3.0, 0.5, 1.3).into(), Rotation3::new(Vector3::new(0.4, 1.9, -2.1)));
    let probe = Pose::from_parts(
        Vector3::new(0.02, -0.03, 0.09).into(),
        Rotation3::new(Vector3::new(0.1, -1.5, 0.3)),
    );
    let rows = (0..count).map(|_| {
        let joints_rad = random_joints(robot, &mut random);
        let mut seen = place.inverse() * truth.forward(&joints_rad) * probe;
        let mut white = || NOISE * random.sample::<f64, _>(StandardNormal);
        seen.translation.vector += Vector3::new(white(), white(), white());
        seen.rotation = Rotation3::new(Vector3::new(white(), white(), white())) * seen.rotation;
        PoseRow {
            joints_rad,
            position_m: seen.translation.vector,
            rotation: Some(seen.rotation),
            ..PoseRow::default()
        }
    });
    (rows.collect(), truth)
}

fn calibrated(robot: &RobotConfig) -> Found {
    let (rows, _) = tracked(robot, 500);
    Alone { joint_waves: Some(6), ..Alone::quick() }.poses(&rows, robot).unwrap()
}

#[test]
fn seven_axes_and_an_arm_on_a_track_are_calibrated_by_a_tracker_and_written_as_urdf() {
    for (arm, free) in [(ARMS[1], 4 * 7 + 6 - 12), (ARMS[2], 4 * 7 + 2 + 6 - 12)] {
        let robot = imported(arm).config;
        let report = calibrated(&robot);
        let (nominal, found) = (report.held_out().nominal.position_m, report.held_out().joints.position_m);
        // The norm of the noise of three coordinates has an RMS of 35 um.
        assert!(nominal.rms > 1e-3 && found.rms < 4.2e-5, "{}: {nominal:?} {found:?}", arm.0);
        assert!(report.held_out().joints.rotation_rad.unwrap().rms < 4.2e-5, "{}", arm.0);
        // The data determine 4 parameters for each revolute axis, 2 for each prismatic axis, and 6 others. Of all these
        // parameters, 12 are the poses of tracker and probe. The others belong to the links, and the data determine
        // them much better than their priors do.
        let links = report.model().ids().into_iter();
        let links = links.filter(|id| matches!(id, ParameterId::Robot { .. }));
        let sigmas: Vec<_> = links.filter_map(|id| Some((id, report.sigma(id)?))).collect();
        assert_eq!(sigmas.len(), free, "{}: {sigmas:?}", arm.0);
        assert!(sigmas.iter().all(|(_, sigma)| *sigma < 1e-3), "{}: {sigmas:?}", arm.0);
        let chain = report.model().geometry(&report.model().start()).robot;
        let written = urdf(&robot, &chain, None, "");
        let mut random = StdRng::seed_from_u64(6);
        for _ in 0..20 {
            let joints = random_joints(&robot, &mut random);
            let off = pose_error(&chain.forward(&joints), &by_urdf(&written, "base", "flange", &joints));
            assert!(off < 1e-12, "{}: {off:e}", arm.0);
        }
        // Exporting and importing again must restore the joints.
        let again = import(&written, None, None).unwrap().config;
        assert!(
            (flange_chain(&again).forward(&[]).to_homogeneous() - chain.forward(&[]).to_homogeneous()).amax()
                < 1e-12
        );
    }
}

#[test]
#[ignore = "takes more than four seconds"]
fn seven_axes_and_an_arm_on_a_track_are_calibrated_by_the_ball_bar() {
    let bar = crate::support::bar();
    for arm in &ARMS[1..] {
        let robot = imported(*arm).config;
        let mut experiment = Experiment::new(&robot, &bar);
        experiment.errors = StaticErrors::Drawn { seed: 3 };
        experiment.effects =
            Effects { robot_noise_urad: 15.0, encoder_noise_urad: 5.0, ..Effects::default() };
        let run = simulate::run(&experiment).unwrap();
        for (q, [low, high]) in
            run.robot_log.q_rad.rows.iter().flat_map(|q| q.iter().zip(robot.joint_limits()))
        {
            assert!((low..=high).contains(q), "{}: {q} is outside {low} to {high}", arm.0);
        }
        let terms = JointTermsConfig { candidates: Vec::new(), ..JointTermsConfig::default() };
        let config = IdentifyConfig { joint_terms: terms, ..IdentifyConfig::default() };
        let found = calibrate_run(&run.cycles, &run.encoders, &run.robot_log, &robot, &bar, &config).unwrap();
        // Compare distances between two positions, because they do not depend on the frame. The
        // position of a track's frame is arbitrary.
        let nominal = robot_chain(&robot, &bar);
        let truth = run.truth.robot_chain(&nominal);
        let mut random = StdRng::seed_from_u64(8);
        let pairs: Vec<[Joints; 2]> =
            (0..500).map(|_| [0, 1].map(|_| random_joints(&robot, &mut random))).collect();
        let distance_m = |chain: &Chain, [one, other]: &[Joints; 2]| {
            (chain.forward(one).translation.vector - chain.forward(other).translation.vector).norm()
        };
        let error_m = |chain: &Chain| {
            let off = pairs.iter().map(|pair| (distance_m(chain, pair) - distance_m(&truth, pair)).powi(2));
            (off.sum::<f64>() / pairs.len() as f64).sqrt()
        };
        let [before_m, after_m] = [&nominal, &found.model().geometry(&[]).robot].map(error_m);
        println!("{}: {:.3} mm before, {:.3} mm after", arm.0, before_m * 1e3, after_m * 1e3);
        assert!(before_m > 1e-3 && after_m < 5e-5, "{}: {before_m} {after_m}", arm.0);
    }
}

/// The position of the probe is known by its prior alone, because a gantry never turns it. Error terms that were rejected
/// must be a part of the uncertainty nevertheless.
#[test]
fn rejected_terms_of_a_gantry_are_a_part_of_its_uncertainty() {
    let link = |alpha_deg: f64| {
        format!(
            "[[links]]\njoint = \"prismatic\"\na_m = 0.0\nalpha_deg = {alpha_deg:?}\nd_m = 0.5\ntheta_deg = 90.0\n"
        )
    };
    let unit = |axis: usize| [0, 1, 2].map(|other| if other == axis { 1.0 } else { 0.0 });
    let robot = parsed(&format!(
        "name = \"Gantry\"\njoint_limits_deg = []\njoint_limits_m = [[0.0, 1.5], [0.0, 1.0], [0.0, 0.8]]\n\
         {}[log]\ncolumn = \"joint\"\nunit = \"rad\"\nraw_offset_rad = [0.0, 0.0, 0.0]\nraw_to_joint = {:?}\n",
        [90.0, 90.0, 0.0].map(link).concat(),
        [0, 1, 2].map(unit)
    ));
    let (mut rows, _) = tracked(&robot, 500);
    rows.iter_mut().for_each(|row| row.rotation = None);
    let found = Alone::quick().poses(&rows, &robot).unwrap();
    let rejected = found.0.solved.candidates.iter().filter(|candidate| !candidate.accepted).count();
    let beside = found.0.solution().covariance.beside().len();
    println!("{:?}, {rejected} groups rejected, {beside} columns", found.0.solution().covariance.sigmas_from);
    assert!(beside > 0);
}

#[test]
fn a_posture_has_millimetres_for_a_prismatic_axis() {
    let robot = imported(ARMS[2]).config;
    let (chain, limits) = (flange_chain(&robot), robot.joint_limits());
    let mut posture_deg = Joints::zeros(limits.len());
    (posture_deg[0], posture_deg[1]) = (500.0, 90.0);
    let design = Design { posture_deg, ..Design::for_robot(&robot) };
    let posture = design.posture_rad(&chain, &limits, &mut StdRng::seed_from_u64(1));
    assert_eq!(posture[..2], [0.5, FRAC_PI_2]);
}

/// A rotation of the lift about its axis has the same effect as an offset of the next joint, because the tracker may stand
/// at any angle about this axis. The stated uncertainty must account for this.
#[test]
fn an_arm_on_a_lift_is_known_as_well_as_the_tracker_shows_it() {
    let link = |joint: &str, [a_m, alpha_deg, d_m]: [f64; 3]| {
        format!(
            "[[links]]\njoint = \"{joint}\"\na_m = {a_m:?}\nalpha_deg = {alpha_deg:?}\nd_m = {d_m:?}\ntheta_deg = 0.0\n"
        )
    };
    let links = [
        link("prismatic", [0.0, 0.0, 0.5]),
        link("revolute", [0.1, 90.0, 0.2]),
        link("revolute", [0.6, 0.0, 0.0]),
        link("revolute", [0.5, 0.0, 0.05]),
    ];
    let unit = |axis: usize| [0, 1, 2, 3].map(|other| if other == axis { 1.0 } else { 0.0 });
    let robot = parsed(&format!(
        "name = \"Lift\"\njoint_limits_deg = [[-170.0, 170.0], [-120.0, 120.0], [-150.0, 150.0]]\njoint_limits_m = [[0.0, 0.8]]\n\
         {}[log]\ncolumn = \"joint\"\nunit = \"rad\"\nraw_offset_rad = [0.0, 0.0, 0.0, 0.0]\nraw_to_joint = {:?}\n",
        links.concat(),
        [0, 1, 2, 3].map(unit)
    ));
    let (rows, truth) = tracked(&robot, 300);
    // Errors of the last link cannot be separated from the position of the probe, nor can the offset along the axis that is
    // parallel to the last one. Set these parameters to their true values, so that the ends can be compared.
    let (mut robot, last) = (robot, truth.links[3]);
    robot.links[2].d_m = truth.links[2].d_m;
    robot.links[3] = LinkConfig {
        a_m: last.a_m,
        d_m: last.d_m,
        theta_deg: last.theta_rad.to_degrees(),
        alpha_deg: last.alpha_rad.to_degrees(),
        ..robot.links[3]
    };
    let found = Alone::quick().without_joint_errors().poses(&rows, &robot).unwrap();
    let chain = found.model().geometry(&found.model().start()).robot;
    let mut random = StdRng::seed_from_u64(8);
    // Distances between two positions do not depend on the base. The error of a distance contains one of the three
    // coordinates of each of two position errors. This explains the factor 1.5.
    let off = (0..500).map(|_| {
        let [one, other] = [0, 1].map(|_| random_joints(&robot, &mut random));
        let distance_m = |chain: &Chain| {
            (chain.forward(&one).translation.vector - chain.forward(&other).translation.vector).norm()
        };
        1.5 * (distance_m(&chain) - distance_m(&truth)).powi(2)
    });
    let error_m = (off.sum::<f64>() / 500.0).sqrt();
    let known_m = workspace_error(&found.0, &robot.joint_limits()).budget.expanded_m;
    println!("error {:.4} mm, known within {:.4} mm (k = 2)", error_m * 1e3, known_m * 1e3);
    assert!((1.0..8.0).contains(&(known_m / error_m)), "{error_m} {known_m}");
}

#[test]
fn a_prismatic_axis_has_a_scale_but_no_waves_and_other_arms_have_loads_of_the_tool() {
    let robot = imported(ARMS[2]).config;
    let chain = flange_chain(&robot);
    let drives = DriveTrain::from_robot(&robot, &chain);
    assert!(drives.has(0, JointTerm::Ratio) && !drives.has(0, JointTerm::Backlash));
    let eccentric = JointTerm::Wave(Period::Once, Phase::Sine);
    assert!(!drives.has(0, eccentric) && drives.has(1, eccentric));
    assert!(
        drives.has(3, JointTerm::Compliance(Load::Tool))
            && !drives.has(3, JointTerm::Compliance(Load::Wrist))
    );
    assert!(!drives.has(8, JointTerm::Ratio));
    let model = Model::alone(&chain).with_set_ups(Owner::Tracker, [1, 1]).with(ParameterId::joint_waves(3));
    let has = |name: &str| model.parameter(name.parse().unwrap()).is_some();
    assert!(has("rsin3_2") && !has("rsin3_1") && has("ra8") && has("rratio_1") && !has("rsin1_1"));
}

#[test]
fn a_check_states_what_an_arm_is_and_what_looks_wrong() {
    for name in ["irb120_3", "irb2400_16", "nj220_2_7", "ur10"] {
        let robot: RobotConfig =
            config::load(&repository("config/robots").join(format!("{name}.toml"))).unwrap();
        assert_eq!(check(&robot).suspicious, Vec::<String>::new(), "{name}");
    }
    let ur10 = check(&imported(ARMS[0]).config);
    let fact = |what: &str| ur10.facts.iter().find(|fact| fact.0 == what).unwrap().1.clone();
    assert!(fact("inverse kinematics").contains("numerical"), "{}", fact("inverse kinematics"));
    // The reach is the length of the stretched arm plus the offsets of shoulder and wrist.
    let reach_m: f64 = fact("flange from the z axis").split(' ').nth(2).unwrap().parse().unwrap();
    assert!((1.25..1.40).contains(&reach_m), "{reach_m}");
    let on_a_track = check(&imported(ARMS[2]).config);
    assert_eq!(on_a_track.suspicious, Vec::<String>::new());
    assert!(on_a_track.facts.iter().any(|fact| fact.1.contains("postures that differ in all axes")));
    let wrong = |change: &dyn Fn(&mut RobotConfig), told: &str| {
        let mut robot: RobotConfig = config::load(&repository("config/robots/ur10.toml")).unwrap();
        change(&mut robot);
        let found = check(&robot).suspicious;
        assert!(found.iter().any(|sentence| sentence.contains(told)), "{told}: {found:?}");
    };
    wrong(&|robot| robot.links[0].alpha_deg = 1.5708, "alpha_deg = 1.5708 looks like radians");
    for (rounded_deg, rad) in [
        (1.57_f64.to_degrees(), "1.57 rad"),
        (-1.571_f64.to_degrees(), "-1.571 rad"),
        (3.1416_f64.to_degrees(), "3.1416 rad"),
        (3.14159_f64.to_degrees(), "3.14159 rad"),
        (89.9544, "1.57 rad"),
    ] {
        wrong(&|robot| robot.links[1].alpha_deg = rounded_deg, &format!("may be {rad}"));
    }
    // The message must not appear for a robot that is already calibrated.
    for calibrated_deg in [-0.06499325789, 0.001, 89.95321, 179.9981237, 90.0, 180.0] {
        let mut robot: RobotConfig = config::load(&repository("config/robots/ur10.toml")).unwrap();
        robot.links[0].alpha_deg = calibrated_deg;
        let found = check(&robot).suspicious;
        assert!(!found.iter().any(|sentence| sentence.contains("may be")), "{calibrated_deg}: {found:?}");
    }
    wrong(
        &|robot| robot.joint_limits_deg[2] = [-3.1416, 3.1416],
        "axis 3: limits of -3.1416 to 3.1416 look like radians",
    );
    // These joint limits are typical of cobots, except that joint 5 cannot reach zero.
    let mut without_zero: RobotConfig = config::load(&repository("config/robots/ur10.toml")).unwrap();
    without_zero.joint_limits_deg[4] = [10.0, 50.0];
    let without_zero = check(&without_zero);
    assert_eq!(without_zero.suspicious, Vec::<String>::new());
    assert!(without_zero.facts.contains(&("limits without zero", "axis 5".to_owned())));
    wrong(&|robot| robot.links[3] = robot.links[1], "independent directions");
    wrong(&|robot| robot.links[2].a_m = 5.7, "longer than robots are");
}

#[test]
fn import_and_check_on_the_command_line() {
    let directory = tempfile::tempdir().unwrap();
    let identify = |arguments: &[&str]| {
        let output = Command::new(env!("CARGO_BIN_EXE_identify"))
            .current_dir(directory.path())
            .args(arguments)
            .env("RUST_LOG", "off")
            .output()
            .unwrap();
        let texts = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
        (output.status.success(), texts.concat())
    };
    let run = |arguments: &[&str]| identify(&[&["robot"], arguments].concat());
    let urdf: PathBuf = repository("identify/tests/data/seven_axes.urdf");
    let urdf = urdf.to_str().unwrap();
    let (done, told) = run(&["import", urdf, "--base", "base", "--tip", "flange"]);
    assert!(done && told.contains("7 axes from link `base` to link `flange`"), "{told}");
    // The user may have edited an existing file. Therefore it is only overwritten on request.
    let file = directory.path().join("seven_axes.toml");
    std::fs::write(&file, "edited").unwrap();
    for out in [&[][..], &["--out", "seven_axes.toml"]] {
        let (done, told) = run(&[&["import", urdf], out].concat());
        assert!(!done && told.contains("seven_axes.toml exists") && told.contains("--force"), "{told}");
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "edited");
    }
    let (done, told) = run(&["import", urdf, "--force"]);
    assert!(done, "{told}");
    let (done, told) = run(&["check", "seven_axes.toml"]);
    assert!(done && told.contains("7, 0 of them prismatic") && told.contains("seven_axes.svg"), "{told}");
    let picture = std::fs::read_to_string(directory.path().join("seven_axes.svg")).unwrap();
    assert!(picture.starts_with("<svg") && picture.contains("from above"));
    let bar = repository("config/ball_bar.toml");
    let (done, told) = identify(&["examine", "--robot", "seven_axes.toml", "--bar", bar.to_str().unwrap()]);
    assert!(done && told.contains("300 random poses"), "{told}");
    let two_axes = r#"
        name = "two axes"
        joint_limits_deg = [[-90, 90], [-90, 90]]
        links = [
            { a_m = 0.4, alpha_deg = 0, d_m = 0.3, theta_deg = 0 },
            { a_m = 0.3, alpha_deg = 0, d_m = 0, theta_deg = 0 },
        ]
        [log]
        column = "joint"
        unit = "rad"
        raw_offset_rad = [0, 0]
        raw_to_joint = [[1, 0], [0, 1]]
    "#;
    std::fs::write(directory.path().join("two.toml"), two_axes).unwrap();
    let (done, told) = identify(&["examine", "--robot", "two.toml"]);
    assert!(!done && told.contains("two axes has 2 axes; an arm needs 6 to follow the bar"), "{told}");
}
