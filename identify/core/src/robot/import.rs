//! Imports a robot's configuration from a URDF file. `urdf` reads the file, and `ends` selects base and tip of the arm. This
//! module converts the joints between base and tip to axis lines, computes Denavit-Hartenberg links along these lines, and
//! writes the configuration as a file with comments.

use std::collections::HashSet;
use std::fmt::Write;

use nalgebra::{Rotation3, Unit, Vector3};
use shared::config::{
    AXES_MAX, AXES_MIN, AngleUnit, Convention, DrivesConfig, JointKind, LinkConfig, LogConversion, Maker,
    RobotConfig, TransformConfig, Validate, Violation,
};

use super::ends::Ends;
use super::urdf::{DECIMALS_FINE, Urdf, UrdfJoint, angle_rad, decimals};
use crate::kinematics::{AxisLine, Chain, DhLink, Pose};

/// Why a URDF cannot be imported.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// The text is not a URDF.
    #[error("this is not a URDF: {0}")]
    NotUrdf(String),
    /// The text contains xacro macros that are not expanded.
    #[error(
        "it has <{0}>, so its macros are not expanded; run `xacro arm.urdf.xacro > arm.urdf` and import the result"
    )]
    Xacro(String),
    /// The parent link of a joint does not exist.
    #[error(
        "joint `{joint}` has the parent `{parent}`, which is not a link of the file; give the link where the arm begins with --base"
    )]
    NoParent {
        /// The joint's name.
        joint: String,
        /// Name of the missing link.
        parent: String,
    },
    /// The requested link does not exist.
    #[error("it has no link `{link}`; choose one of its links: {known}")]
    UnknownLink {
        /// Name of the requested link.
        link: String,
        /// Names of the file's links.
        known: String,
    },
    /// The requested base is not on the path from the root to the tip.
    #[error("link `{tip}` is not below link `{base}`; choose --base from the links above it: {above}")]
    NotConnected {
        /// Name of the requested base.
        base: String,
        /// Name of the requested tip.
        tip: String,
        /// Links above the tip.
        above: String,
    },
    /// Several links can be the tip of the arm.
    #[error(
        "it ends in several links; give the one of the flange with --tip (in brackets the number of axes before it): {tips}"
    )]
    SeveralTips {
        /// Names of the possible tips, each with its number of axes.
        tips: String,
    },
    /// Every moving joint has the name of a gripper's joint.
    #[error(
        "all joints that move have names of a gripper; if it is an arm, give the link of its flange with --tip: {tips}"
    )]
    Gripper {
        /// Names of the links without child joints.
        tips: String,
    },
    /// A joint between base and tip cannot be an axis of a serial arm.
    #[error("joint `{joint}` {problem}; choose --base and --tip so that it is not between them")]
    Joint {
        /// Name of the joint.
        joint: String,
        /// What is wrong with it.
        problem: String,
    },
    /// The file contradicts itself, or does not describe a robot.
    #[error("{0}; correct the file")]
    Wrong(String),
    /// The number of axes is not supported.
    #[error(
        "{axes} axes are between `{base}` and `{tip}`, {AXES_MIN} to {AXES_MAX} are supported; choose other links (--base, --tip)"
    )]
    Axes {
        /// Number of axes found.
        axes: usize,
        /// Link before the axes.
        base: String,
        /// Link after the axes.
        tip: String,
    },
}

/// An arm imported from a URDF.
#[derive(Debug, Clone, PartialEq)]
pub struct Imported {
    /// Configuration of the robot.
    pub config: RobotConfig,
    /// Link at the base of the arm.
    pub base: String,
    /// Link at the tip of the arm.
    pub tip: String,
    /// Name of the joint of each axis, base to tip.
    pub joints: Vec<String>,
    /// Assumptions for values that the file does not contain.
    pub assumed: Vec<String>,
    /// Sentences about links before `base` and joints after `tip` that were excluded by default.
    pub left_out: Vec<String>,
}

/// Imports the arm between the links `base` and `tip`. The default of `base` is a link with the name of a robot's base, such
/// as `base_link`, or else the link that carries the first axis. The default of `tip` is the link named `tool0` or `flange`,
/// or else the only end of the longest chain of axes; grippers are excluded.
///
/// The forward kinematics from `base` to `tip` are those of the file, except that rounded right angles are
/// replaced by exact ones.
///
/// # Errors
/// [`ImportError`].
pub fn import(text: &str, base: Option<&str>, tip: Option<&str>) -> Result<Imported, ImportError> {
    let urdf = Urdf::read(text)?;
    check_unique(&urdf)?;
    let Ends { base, tip, joints, left_out } = Ends::find(&urdf, base, tip)?;
    let mut assumed = Vec::new();
    let (mut axes, mut names) = (Vec::new(), Vec::new());
    let (mut limits_deg, mut limits_m) = (Vec::new(), Vec::new());
    // With all joints at zero: the frame of the current joint. After the loop it is the frame of the tip.
    let mut base_from_joint = Pose::identity();
    for joint in joints {
        base_from_joint *= origin(joint, &mut assumed)?;
        let Some(kind) = kind(joint)? else { continue };
        let direction = Unit::try_new(Vector3::from(joint.axis()?), 1e-6);
        let direction = direction.ok_or_else(|| problem(joint, "has an axis without direction"))?;
        axes.push(AxisLine {
            joint: kind,
            point_m: base_from_joint.translation.vector,
            direction: base_from_joint.rotation * direction.into_inner(),
        });
        names.push(joint.name.clone());
        match kind {
            JointKind::Revolute => limits_deg.push(limits(
                joint,
                180.0,
                "deg",
                |text| Some(angle_rad(text)?.to_degrees()),
                &mut assumed,
            )),
            JointKind::Prismatic => {
                limits_m.push(limits(joint, 1.0, "m", |text| text.parse().ok(), &mut assumed))
            }
        }
    }
    // The loop has converted the moving joints to axis lines and limits. Compute the chain and the configuration from them.
    if !(AXES_MIN..=AXES_MAX).contains(&axes.len()) {
        return Err(ImportError::Axes { axes: axes.len(), base, tip });
    }
    let chain = Chain::from_axes(&axes, &base_from_joint);
    let mut config = RobotConfig {
        name: urdf.name,
        convention: Convention::Standard,
        base: transform(&chain.root_from_base),
        flange: transform(&chain.last_from_end),
        links: chain.links.iter().map(link).collect(),
        joint_limits_deg: limits_deg,
        joint_limits_m: limits_m,
        log: LogConversion::direct(AngleUnit::Rad, axes.len()),
        drives: DrivesConfig::default(),
    };
    if config.counts_joint_3_from_horizontal() {
        assumed.push(couple_joint_3(&mut config, &axes));
    }
    // Refuse a configuration that other commands would refuse.
    config.validate().map_err(|Violation { key, problem, remedy }| {
        ImportError::Wrong(format!(
            "its links `{base}` to `{tip}` do not form a robot: {key}: {problem}, {remedy}"
        ))
    })?;
    Ok(Imported { config, base, tip, joints: names, assumed, left_out })
}

/// Couples joint 3 of the model to J2 of the controller, in the conversion of the log. Returns a
/// description of this assumption.
///
/// The controller measures J3 from the horizontal, so J3 does not change when joint 2 turns. A URDF file measures joint 3
/// from the upper arm. In ROS-Industrial models of FANUC robots, axes 2 and 3 have opposite directions, so joint 3 is
/// `J3 + J2`. In models of ABB robots, both have the same direction, so joint 3 is `J3 - J2`. If the axes have other
/// directions, no coupling is written.
fn couple_joint_3(config: &mut RobotConfig, axes: &[AxisLine]) -> String {
    let (a_maker, factor, ros) = match config.maker() {
        Some(Maker::Fanuc) => ("a FANUC", 1.0, "has joint 3 already and"),
        _ => ("an ABB", -1.0, "may have joint 3 already and then"),
    };
    let is_usual = match axes {
        [_, second, third, ..] if config.joint_kinds().take(3).eq([JointKind::Revolute; 3]) => {
            -factor * second.direction.dot(&third.direction) > 0.999
        }
        _ => false,
    };
    match config.log.raw_to_joint.get_mut(1).and_then(|row| row.get_mut(2)) {
        Some(third) if is_usual => {
            *third = factor;
            format!(
                "the log has J1 to J6 of {a_maker} controller, whose J3 does not include J2: joint 3 is {} (raw_to_joint); a log of \
                 joint_states (ROS) {ros} needs a mapping without [[coupling]]",
                joint_3(factor)
            )
        }
        _ => format!(
            "J3 of {a_maker} controller does not include J2, but joint 3 of this file may; raw_to_joint has no such coupling"
        ),
    }
}

/// The formula of joint 3 of the model from the controller's joints.
fn joint_3(factor: f64) -> &'static str {
    if factor < 0.0 { "J3 - J2" } else { "J3 + J2" }
}

/// Checks that link names and joint names are unique and that no two joints have the same child link.
fn check_unique(urdf: &Urdf) -> Result<(), ImportError> {
    let joints = || urdf.joints.iter();
    for (what, name) in [
        ("links have the name", repeated(urdf.links.iter())),
        ("joints have the name", repeated(joints().map(|joint| &joint.name))),
        ("joints lead to link", repeated(joints().map(|joint| &joint.child))),
    ] {
        if let Some(name) = name {
            return Err(ImportError::Wrong(format!("several {what} `{name}`")));
        }
    }
    Ok(())
}

/// The first name that occurs a second time.
fn repeated<'a>(mut names: impl Iterator<Item = &'a String>) -> Option<&'a String> {
    let mut seen = HashSet::new();
    names.find(|name| !seen.insert(*name))
}

fn problem(joint: &UrdfJoint, problem: impl Into<String>) -> ImportError {
    ImportError::Joint { joint: joint.name.clone(), problem: problem.into() }
}

/// Type of a joint; `None` for a fixed joint.
fn kind(joint: &UrdfJoint) -> Result<Option<JointKind>, ImportError> {
    if let Some(other) = joint.value("mimic", "joint") {
        return Err(problem(
            joint,
            format!("follows joint `{other}` (mimic) and does not move independently"),
        ));
    }
    match joint.kind.as_str() {
        "fixed" => Ok(None),
        "revolute" | "continuous" => Ok(Some(JointKind::Revolute)),
        "prismatic" => Ok(Some(JointKind::Prismatic)),
        other => Err(problem(joint, format!("is {other}, not revolute, prismatic or fixed"))),
    }
}

/// Pose of a joint in its parent link with the joint at zero: `T(xyz) Rz(yaw) Ry(pitch) Rx(roll)`. Angles with few decimals
/// may be replaced by exact angles; a description is then added to `assumed`.
fn origin(joint: &UrdfJoint, assumed: &mut Vec<String>) -> Result<Pose, ImportError> {
    let [xyz_m, rpy_rad] = joint.origin()?;
    let written = joint.value("origin", "rpy").unwrap_or_default().split_whitespace();
    for (written, rad) in written.zip(rpy_rad) {
        if decimals(written) < DECIMALS_FINE && written.parse() != Ok(rad) {
            let (name, deg) = (&joint.name, rad.to_degrees());
            assumed.push(format!(
                "joint `{name}` is turned by {written} rad in the file: {deg:.0} deg are taken"
            ));
        }
    }
    let [roll, pitch, yaw] = rpy_rad;
    let rotation = Rotation3::from_euler_angles(roll, pitch, yaw);
    Ok(Pose::from_parts(Vector3::from(xyz_m).into(), rotation))
}

/// Lower and upper limit in the unit of the configuration. If the file has no valid limits, the limits are `-default` and
/// `default`, and a description is added to `assumed`.
fn limits(
    joint: &UrdfJoint,
    default: f64,
    unit: &str,
    read: fn(&str) -> Option<f64>,
    assumed: &mut Vec<String>,
) -> [f64; 2] {
    // A missing limit counts as zero, as in the URDF specification.
    let limit = |key| joint.value("limit", key).map_or(Some(0.0), read).unwrap_or(f64::NAN);
    // Rounding removes the errors of the conversion to degrees.
    let limits = ["lower", "upper"].map(|key| (limit(key) * 1e9).round() / 1e9);
    let [low, high] = limits;
    let found = match joint.kind.as_str() {
        "continuous" => "no limits in the file".to_owned(),
        _ if low < high && low.is_finite() && high.is_finite() => return limits,
        _ if low == 0.0 && high == 0.0 => "no limits in the file, or both are zero".to_owned(),
        _ => format!("limits of {low} to {high} {unit} in the file, which are not a range"),
    };
    assumed.push(format!("joint `{}` has {found}: +-{default} {unit} are taken", joint.name));
    [-default, default]
}

/// A length \[m\], from which rounding errors of the conversion are removed.
fn length_m(length_m: f64) -> f64 {
    without_rounding(length_m, 1e-12)
}

/// Converts an angle to degrees and removes rounding errors of the conversion.
fn angle_deg(angle_rad: f64) -> f64 {
    without_rounding(angle_rad.to_degrees(), 1e-9)
}

/// Rounds to six decimals if this changes the value by less than `rounding`. Otherwise rounds
/// to multiples of `rounding / 1000`.
fn without_rounding(value: f64, rounding: f64) -> f64 {
    let round_to = |scale: f64| (value * scale).round() / scale;
    let six_decimals = round_to(1e6);
    let significant = round_to(1e3 / rounding);
    // Adding zero converts -0 to 0.
    (if (value - six_decimals).abs() < rounding { six_decimals } else { significant }) + 0.0
}

fn link(link: &DhLink) -> LinkConfig {
    LinkConfig {
        joint: link.joint,
        a_m: length_m(link.a_m),
        alpha_deg: angle_deg(link.alpha_rad),
        d_m: length_m(link.d_m),
        theta_deg: angle_deg(link.theta_rad),
        beta_deg: angle_deg(link.beta_rad),
    }
}

fn transform(pose: &Pose) -> TransformConfig {
    let xyz_m = <[f64; 3]>::from(pose.translation.vector).map(length_m);
    TransformConfig { xyz_m, rpy_deg: crate::kinematics::roll_pitch_yaw(&pose.rotation).map(angle_deg) }
}

impl Imported {
    /// The configuration as a file with comments; `source` names the URDF.
    pub fn to_toml(&self, source: &str) -> String {
        let Self { config, base, tip, joints, assumed, left_out } = self;
        let quoted = |text: &str| toml::Value::from(text).to_string();
        let mut text = format!(
            "# {}, link `{base}` to link `{tip}` of {}, written by `identify robot import`.\n\
             # Look at it with `identify robot check` before you use it.\n",
            one_line(&config.name),
            one_line(source)
        );
        left_out.iter().for_each(|sentence| text += &format!("# {}.\n", one_line(sentence)));
        assumed.iter().for_each(|sentence| text += &format!("# Please correct: {}.\n", one_line(sentence)));
        let _ = write!(
            text,
            "name = {}\n\
             # Standard Denavit-Hartenberg links: Rz(theta) Tz(d) Tx(a) Rx(alpha), and Ry(beta) where the next axis is nearly\n\
             # parallel (Hayati). The joint variable is added to theta, or to d where the joint is prismatic.\n\
             convention = \"standard\"\n\
             # Lower and upper limit of each revolute joint, base to flange.\n\
             joint_limits_deg = {:?}\n",
            quoted(&config.name),
            config.joint_limits_deg
        );
        if !config.joint_limits_m.is_empty() {
            let _ = writeln!(
                text,
                "# And of each prismatic joint.\njoint_limits_m = {:?}",
                config.joint_limits_m
            );
        }
        for (key, from, to, TransformConfig { xyz_m, rpy_deg }) in [
            ("base", format!("link `{base}`"), "the first axis", config.base),
            ("flange", "the last axis' link".into(), tip.as_str(), config.flange),
        ] {
            if (TransformConfig { xyz_m, rpy_deg }) != TransformConfig::default() {
                let _ = write!(
                    text,
                    "\n# From {} to {}: translation xyz_m, then rotations rpy_deg about x, then y, then z of the first frame:\n\
                     # Rz(yaw) Ry(pitch) Rx(roll), as in a URDF.\n[{key}]\nxyz_m = {xyz_m:?}\nrpy_deg = {rpy_deg:?}\n",
                    one_line(&from),
                    one_line(to)
                );
            }
        }
        text + &link_blocks(&config.links, joints) + &log_block(&config.log)
    }
}

/// A `[[links]]` block for each link, with the name of its joint.
fn link_blocks(links: &[LinkConfig], joints: &[String]) -> String {
    let mut text = String::new();
    for (link, joint) in links.iter().zip(joints) {
        let _ = writeln!(text, "\n# Joint `{}`\n[[links]]", one_line(joint));
        if link.joint == JointKind::Prismatic {
            text += "joint = \"prismatic\"\n";
        }
        let standard = [
            ("a_m", link.a_m),
            ("alpha_deg", link.alpha_deg),
            ("d_m", link.d_m),
            ("theta_deg", link.theta_deg),
        ];
        let beta = Some(("beta_deg", link.beta_deg)).filter(|(_, value)| *value != 0.0);
        for (key, value) in standard.into_iter().chain(beta) {
            let _ = writeln!(text, "{key} = {value:?}");
        }
    }
    text
}

/// The `[log]` block with a comment on its keys.
fn log_block(log: &LogConversion) -> String {
    let factor = log.raw_to_joint.get(1).and_then(|row| row.get(2)).copied().unwrap_or_default();
    let meaning = if factor == 0.0 {
        "the joint variables themselves".into()
    } else {
        format!("J1, J2 .. of the controller (joint 3 = {})", joint_3(factor))
    };
    let mut text = format!(
        "\n# How the robot's log becomes joint variables: q = (raw * unit - raw_offset_rad) * raw_to_joint; row i is what\n\
         # column i of the log contributes to each joint. As written here, the log has columns joint1_rad, joint2_rad ..\n\
         # (joint1_m where the joint is prismatic) with {meaning}.\n\
         # Correct it for a log in degrees (unit = \"deg\") or of motors.\n\
         [log]\ncolumn = \"{}\"\nunit = \"rad\"\nraw_offset_rad = {:?}\nraw_to_joint = [\n",
        log.column, log.raw_offset_rad
    );
    log.raw_to_joint.iter().for_each(|row| text += &format!("    {row:?},\n"));
    text + "]\n"
}

/// Replaces control characters, such as line ends, by spaces, because a comment in TOML ends with its line.
fn one_line(text: &str) -> String {
    text.replace(|letter: char| letter.is_control(), " ")
}
