//! A robot's configuration from a URDF: the joints between two of its links as Denavit-Hartenberg links.

use std::collections::HashSet;
use std::fmt::Write;

use nalgebra::{Rotation3, Unit, Vector3};
use shared::config::{
    AXES_MAX, AXES_MIN, AngleUnit, Convention, DrivesConfig, JointKind, LinkConfig, LogConversion,
    RobotConfig, TransformConfig, Validate, Violation,
};
use urdf_rs::{Joint, JointType};

use crate::kinematics::{AxisLine, Chain, DhLink, Pose};

/// Why a URDF gives no robot.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// It is none.
    #[error("it is no URDF: {0}; a xacro file has to be expanded first (`xacro arm.urdf.xacro > arm.urdf`)")]
    NotUrdf(String),
    /// There is no such link.
    #[error("it has no link `{link}`; its links are {known}")]
    UnknownLink {
        /// As asked for.
        link: String,
        /// All that it has.
        known: String,
    },
    /// No joints lead from one to the other.
    #[error("link `{tip}` does not hang on link `{base}`; going up from it one comes to {above}")]
    NotConnected {
        /// As asked for.
        base: String,
        /// As asked for.
        tip: String,
        /// Links above the tip.
        above: String,
    },
    /// The end of the arm has to be said.
    #[error("it ends in several links; say with --tip which is the flange: {tips}")]
    SeveralTips {
        /// Links on which nothing hangs.
        tips: String,
    },
    /// A joint that is no axis of a serial arm.
    #[error("joint `{joint}` {problem}; choose --base and --tip so that it is not between them")]
    Joint {
        /// Its name.
        joint: String,
        /// What is wrong with it.
        problem: String,
    },
    /// It contradicts itself, or describes what is no robot.
    #[error("{0}; correct the file")]
    Wrong(String),
    /// Too few or too many.
    #[error(
        "{axes} axes are between `{base}` and `{tip}`, a robot has {AXES_MIN} to {AXES_MAX}; choose other links"
    )]
    Axes {
        /// How many.
        axes: usize,
        /// From here.
        base: String,
        /// To here.
        tip: String,
    },
}

/// What a URDF says of an arm.
#[derive(Debug, Clone, PartialEq)]
pub struct Imported {
    /// The robot.
    pub config: RobotConfig,
    /// Link where it begins.
    pub base: String,
    /// Link where it ends.
    pub tip: String,
    /// Name of each axis' joint.
    pub joints: Vec<String>,
    /// What the file does not say and was assumed.
    pub assumed: Vec<String>,
}

/// The arm between links `base` (the file's root where not given) and `tip` (its only end where not given). Forward
/// kinematics from `base` to `tip` at the joints' values are those of the file.
///
/// # Errors
/// [`ImportError`].
pub fn import(text: &str, base: Option<&str>, tip: Option<&str>) -> Result<Imported, ImportError> {
    let robot = urdf_rs::read_from_string(text).map_err(|error| ImportError::NotUrdf(error.to_string()))?;
    let joints = || robot.joints.iter();
    for (what, name) in [
        ("links have the name", repeated(robot.links.iter().map(|link| &link.name))),
        ("joints have the name", repeated(joints().map(|joint| &joint.name))),
        ("joints lead to link", repeated(joints().map(|joint| &joint.child.link))),
    ] {
        if let Some(name) = name {
            return Err(ImportError::Wrong(format!("several {what} `{name}`")));
        }
    }
    let base = end_of(&robot, base, |joint| &joint.child.link)?;
    let tip = end_of(&robot, tip, |joint| &joint.parent.link)?;
    let mut assumed = Vec::new();
    let (mut pose, mut axes, mut names) = (Pose::identity(), Vec::new(), Vec::new());
    let (mut limits_deg, mut limits_m) = (Vec::new(), Vec::new());
    for joint in between(&robot, &base, &tip)? {
        let numbers = [joint.origin.xyz.0, joint.origin.rpy.0, joint.axis.xyz.0];
        if let Some(number) = numbers.as_flattened().iter().find(|number| !number.is_finite()) {
            let what = format!("joint `{}` has {number} in its origin or axis", joint.name);
            return Err(ImportError::Wrong(what));
        }
        pose *= origin(joint);
        let Some(kind) = kind(joint)? else { continue };
        let direction = Unit::try_new(Vector3::from(joint.axis.xyz.0), 1e-6);
        let direction = direction.ok_or_else(|| problem(joint, "has an axis without direction"))?;
        axes.push(AxisLine {
            joint: kind,
            point_m: pose.translation.vector,
            direction: pose.rotation * direction.into_inner(),
        });
        names.push(joint.name.clone());
        match kind {
            JointKind::Revolute => {
                limits_deg.push(limits(joint, 180.0, "deg", f64::to_degrees, &mut assumed))
            }
            JointKind::Prismatic => limits_m.push(limits(joint, 1.0, "m", |value| value, &mut assumed)),
        }
    }
    if !(AXES_MIN..=AXES_MAX).contains(&axes.len()) {
        return Err(ImportError::Axes { axes: axes.len(), base, tip });
    }
    let chain = Chain::from_axes(&axes, &pose);
    let config = RobotConfig {
        name: robot.name,
        convention: Convention::Standard,
        base: transform(&chain.root_from_base),
        flange: transform(&chain.last_from_end),
        links: chain.links.iter().map(link).collect(),
        joint_limits_deg: limits_deg,
        joint_limits_m: limits_m,
        log: LogConversion::direct(AngleUnit::Rad, axes.len()),
        drives: DrivesConfig::default(),
    };
    // What no other command would load is not written either.
    config.validate().map_err(|Violation { key, problem, remedy }| {
        ImportError::Wrong(format!("its links `{base}` to `{tip}` are no robot: {key}: {problem}, {remedy}"))
    })?;
    Ok(Imported { config, base, tip, joints: names, assumed })
}

/// A name that is there more than once.
fn repeated<'a>(mut names: impl Iterator<Item = &'a String>) -> Option<&'a String> {
    let mut seen = HashSet::new();
    names.find(|name| !seen.insert(*name))
}

/// The link that is asked for, or the only one that is no joint's `other` end.
fn end_of(
    robot: &urdf_rs::Robot,
    asked: Option<&str>,
    other: fn(&Joint) -> &String,
) -> Result<String, ImportError> {
    let links = || robot.links.iter().map(|link| link.name.as_str());
    if let Some(link) = asked {
        let known = || links().collect::<Vec<_>>().join(", ");
        return if links().any(|name| name == link) {
            Ok(link.to_owned())
        } else {
            Err(ImportError::UnknownLink { link: link.to_owned(), known: known() })
        };
    }
    let ends: Vec<&str> =
        links().filter(|name| robot.joints.iter().all(|joint| other(joint) != name)).collect();
    match ends[..] {
        [end] => Ok(end.to_owned()),
        _ => Err(ImportError::SeveralTips { tips: ends.join(", ") }),
    }
}

/// The joints from one link to the other, base first.
fn between<'a>(robot: &'a urdf_rs::Robot, base: &str, tip: &str) -> Result<Vec<&'a Joint>, ImportError> {
    let mut joints: Vec<&Joint> = Vec::new();
    let mut link = tip;
    while link != base {
        // A link that hangs on itself would have no end.
        let above = robot.joints.iter().find(|joint| joint.child.link == link);
        match above.filter(|_| joints.len() < robot.joints.len()) {
            Some(joint) => {
                joints.push(joint);
                link = &joint.parent.link;
            }
            None => {
                let above =
                    joints.iter().map(|joint| joint.parent.link.as_str()).collect::<Vec<_>>().join(", ");
                return Err(ImportError::NotConnected { base: base.to_owned(), tip: tip.to_owned(), above });
            }
        }
    }
    joints.reverse();
    Ok(joints)
}

fn problem(joint: &Joint, problem: impl Into<String>) -> ImportError {
    ImportError::Joint { joint: joint.name.clone(), problem: problem.into() }
}

/// How it moves; none where it is fixed.
fn kind(joint: &Joint) -> Result<Option<JointKind>, ImportError> {
    if let Some(mimic) = &joint.mimic {
        return Err(problem(
            joint,
            format!("follows joint `{}` (mimic) and is no axis of its own", mimic.joint),
        ));
    }
    match joint.joint_type {
        JointType::Fixed => Ok(None),
        JointType::Revolute | JointType::Continuous => Ok(Some(JointKind::Revolute)),
        JointType::Prismatic => Ok(Some(JointKind::Prismatic)),
        JointType::Floating | JointType::Planar | JointType::Spherical => Err(problem(
            joint,
            format!("is {:?}, not revolute, prismatic or fixed", joint.joint_type).to_lowercase(),
        )),
    }
}

/// `T(xyz) Rz(yaw) Ry(pitch) Rx(roll)`.
fn origin(joint: &Joint) -> Pose {
    let ([roll, pitch, yaw], xyz_m) = (joint.origin.rpy.0, Vector3::from(joint.origin.xyz.0));
    Pose::from_parts(xyz_m.into(), Rotation3::from_euler_angles(roll, pitch, yaw))
}

/// Lower and upper limit in the configuration's unit; so much to either side where the file has none.
fn limits(
    joint: &Joint,
    otherwise: f64,
    unit: &str,
    convert: fn(f64) -> f64,
    assumed: &mut Vec<String>,
) -> [f64; 2] {
    let limits = [joint.limit.lower, joint.limit.upper].map(|limit| (convert(limit) * 1e9).round() / 1e9);
    let [low, high] = limits;
    let found = match joint.joint_type {
        JointType::Continuous => "no limits in the file".to_owned(),
        _ if low < high && low.is_finite() && high.is_finite() => return limits,
        // What a file without limits gives, too.
        _ if low == 0.0 && high == 0.0 => "no limits in the file, or both are zero".to_owned(),
        _ => format!("limits of {low} to {high} {unit} in the file, which are no range"),
    };
    assumed.push(format!("joint `{}` has {found}: +-{otherwise} {unit} are taken", joint.name));
    [-otherwise, otherwise]
}

fn link(link: &DhLink) -> LinkConfig {
    LinkConfig {
        joint: link.joint,
        a_m: link.a_m,
        alpha_deg: link.alpha_rad.to_degrees(),
        d_m: link.d_m,
        theta_deg: link.theta_rad.to_degrees(),
        beta_deg: link.beta_rad.to_degrees(),
    }
}

fn transform(pose: &Pose) -> TransformConfig {
    let rpy_deg = crate::kinematics::roll_pitch_yaw(&pose.rotation).map(f64::to_degrees);
    TransformConfig { xyz_m: pose.translation.vector.into(), rpy_deg }
}

impl Imported {
    /// The configuration as a file that says what its numbers are; `source` is where they come from.
    pub fn to_toml(&self, source: &str) -> String {
        let Self { config, base, tip, joints, assumed } = self;
        let quoted = |text: &str| toml::Value::from(text).to_string();
        let mut text = format!(
            "# {}, link `{base}` to link `{tip}` of {}, written by `identify robot import`.\n\
             # Look at it with `identify robot check` before you use it.\n",
            one_line(&config.name),
            one_line(source)
        );
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
                    "\n# From {} to {}.\n[{key}]\nxyz_m = {xyz_m:?}\nrpy_deg = {rpy_deg:?}\n",
                    one_line(&from),
                    one_line(to)
                );
            }
        }
        for (link, joint) in config.links.iter().zip(joints) {
            let _ = writeln!(text, "\n# Joint `{}`\n[[links]]", one_line(joint));
            if link.joint == JointKind::Prismatic {
                text += "joint = \"prismatic\"\n";
            }
            let beta = ("beta_deg", link.beta_deg);
            let standard = [
                ("a_m", link.a_m),
                ("alpha_deg", link.alpha_deg),
                ("d_m", link.d_m),
                ("theta_deg", link.theta_deg),
            ];
            for (key, value) in
                standard.into_iter().chain([beta].into_iter().filter(|(_, value)| *value != 0.0))
            {
                let _ = writeln!(text, "{key} = {value:?}");
            }
        }
        let _ = write!(
            text,
            "\n# How the robot's log becomes joint variables: q = (raw * unit - raw_offset_rad) * raw_to_joint. As it stands\n\
             # here: columns joint1_rad, joint2_rad .. (joint1_m where the joint is prismatic) with the joint variables\n\
             # themselves. Correct it for a log in degrees (unit = \"deg\") or of motors.\n\
             [log]\ncolumn = \"{}\"\nunit = \"rad\"\nraw_offset_rad = {:?}\nraw_to_joint = [\n",
            config.log.column, config.log.raw_offset_rad
        );
        config.log.raw_to_joint.iter().for_each(|row| text += &format!("    {row:?},\n"));
        text + "]\n"
    }
}

/// A comment ends with its line.
fn one_line(text: &str) -> String {
    text.replace(|letter: char| letter.is_control(), " ")
}
