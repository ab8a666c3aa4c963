//! Checks a robot's configuration (`identify robot check`). The result contains properties such as the reach, probable
//! mistakes such as radians instead of degrees, and points for a drawing. Reach and rank of the Jacobian are computed at
//! random postures within the joint limits.

use nalgebra::{Matrix6xX, Vector3, Vector6};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use shared::config::{JointKind, RobotConfig};

use crate::kinematics::{
    Chain, InverseError, Joints, LENGTH_M_MAX, Trace, Tracer, flange_chain, robot_inverse_all,
};
use crate::statistics::extremes;

/// Number of random postures at which the reach is computed.
const POSTURES: usize = 20_000;
/// The rank of the Jacobian is computed only at this number of these postures.
const RANK_POSTURES: usize = 50;
/// Singular values below this fraction of the largest one count as zero.
const RANK_TOLERANCE: f64 = 1e-6;
/// Numbers of decimals to which files usually round a right angle in radians. In degrees, a multiple of a right angle is
/// exact, so a rounded one shows a conversion.
const RADIAN_DECIMALS: std::ops::RangeInclusive<i32> = 2..=5;
/// Of an angle in degrees that was converted from radians, at most this number of decimals is compared.
const CONVERTED_DECIMALS: usize = 9;
/// An angle in degrees was probably meant as radians if its number is pi / 2 or pi. This is the tolerance, as a fraction
/// of pi / 2.
const AS_RADIANS: f64 = 1e-3;
/// Two neighbouring axes coincide if their distance is below this limit \[m\] and the sine of the angle between them is
/// below the next limit, `SAME_DIRECTION`. A calibration cannot separate coinciding axes.
const SAME_AXIS_M: f64 = 1e-3;
const SAME_DIRECTION: f64 = 1e-3;
/// Largest plausible range of a revolute axis, from data sheets \[deg\].
const RANGE_DEG_MAX: f64 = 1440.0;

/// Result of a check of a configuration.
#[derive(Debug, Clone, PartialEq)]
pub struct RobotCheck {
    /// Properties of the robot: name and value.
    pub facts: Vec<(&'static str, String)>,
    /// Probable mistakes with their remedies.
    pub suspicious: Vec<String>,
    /// Two postures, each with its name and points along the arm from base to flange \[m\]. All joints are at zero in the
    /// first posture and in the middle of their ranges in the second.
    pub postures: [(&'static str, Vec<Vector3<f64>>); 2],
    /// Each axis with all joints at zero: type of the joint, a point on the axis \[m\], and its direction.
    pub axes: Vec<(JointKind, Vector3<f64>, Vector3<f64>)>,
    /// Positions of the flange at random postures within the limits \[m\].
    pub reached_m: Vec<Vector3<f64>>,
}

/// Checks a configuration for probable mistakes.
pub fn check(robot: &RobotConfig) -> RobotCheck {
    let (chain, limits) = (flange_chain(robot), robot.joint_limits());
    let zero = Joints::zeros(limits.len());
    let middle: Joints = limits.iter().map(|[low, high]| 0.5 * (low + high)).collect();
    // The reach, and the rank of the Jacobian, at random postures.
    let mut trace = Trace::default();
    let tracer = Tracer::new(&chain);
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let mut rank = 0;
    let reached_m: Vec<Vector3<f64>> = (0..POSTURES)
        .map(|posture| {
            let joints: Joints = limits.iter().map(|&[low, high]| random.random_range(low..high)).collect();
            tracer.trace(&joints, &mut trace);
            if posture < RANK_POSTURES {
                rank = rank.max(jacobian_rank(&trace));
            }
            trace.position_m()
        })
        .collect();
    // The axes with all joints at zero.
    tracer.trace(&zero, &mut trace);
    let kinds_and_axes = robot.joint_kinds().zip(trace.joint_axes());
    let axes: Vec<_> = kinds_and_axes.map(|(kind, (point, along))| (kind, point, along)).collect();
    RobotCheck {
        facts: facts(robot, &chain, &trace, &reached_m),
        suspicious: suspicious(robot, &chain, rank, &axes),
        postures: [
            ("all joints at zero", arm_points(&chain, &zero)),
            ("middle of all ranges", arm_points(&chain, &middle)),
        ],
        axes,
        reached_m,
    }
}

/// Origins of the frames of all links, base to flange. Between two origins is the corner where the common normal meets the
/// first of the two axes.
fn arm_points(chain: &Chain, joints: &[f64]) -> Vec<Vector3<f64>> {
    let mut frame = chain.root_from_base;
    let mut points = vec![Vector3::zeros(), frame.translation.vector];
    for (link, joint) in chain.joined(joints) {
        let next = frame * link.transform(joint);
        let along = frame.rotation * Vector3::z();
        let from = frame.translation.vector;
        points.push(from + along * along.dot(&(next.translation.vector - from)));
        points.push(next.translation.vector);
        frame = next;
    }
    points.push((frame * chain.last_from_end).translation.vector);
    points
}

/// Number of independent directions in which the joints move the flange. Metres and radians have equal weight.
fn jacobian_rank(trace: &Trace) -> usize {
    let columns: Vec<Vector6<f64>> = trace.joint_twists().map(|twist| twist.column()).collect();
    let values = Matrix6xX::from_columns(&columns).singular_values();
    values.iter().filter(|value| **value > RANK_TOLERANCE * values.max()).count()
}

fn facts(
    robot: &RobotConfig,
    chain: &Chain,
    at_zero: &Trace,
    reached_m: &[Vector3<f64>],
) -> Vec<(&'static str, String)> {
    let kinds: Vec<JointKind> = robot.joint_kinds().collect();
    let prismatic = kinds.iter().filter(|kind| **kind == JointKind::Prismatic).count();
    let range = |distance_m: fn(&Vector3<f64>) -> f64| {
        let [low, high] = extremes(reached_m.iter().map(distance_m));
        format!("{low:.3} to {high:.3} m")
    };
    let p = at_zero.position_m();
    let inverse = match (kinds.len(), robot_inverse_all(chain, at_zero.end())) {
        (..6, _) => "none: fewer than six axes cannot take any pose",
        (6, Err(InverseError::Structure { link, key, value, expected })) => {
            &format!("numerical: link {link} has {key} = {value:.4}, a closed form needs {expected}")
        }
        (6, Err(InverseError::Prismatic { link })) => &format!("numerical: axis {link} is prismatic"),
        (6, _) => "closed form, up to eight solutions",
        _ => "numerical: more than six axes, the solution nearest to the posture before",
    };
    let mut facts = vec![
        ("robot", robot.name.clone()),
        ("axes", format!("{}, {prismatic} of them prismatic", kinds.len())),
        ("convention", format!("{:?} Denavit-Hartenberg", robot.convention).to_lowercase()),
        ("inverse kinematics", inverse.into()),
        ("flange at zero", format!("x {:.4}, y {:.4}, z {:.4} m", p.x, p.y, p.z)),
        ("flange from the base", range(|p| p.norm())),
        ("flange from the z axis", range(|p| p.x.hypot(p.y))),
        ("flange above the base", range(|p| p.z)),
        ("log columns", format!("{}1 to {}{}", robot.log.column, robot.log.column, kinds.len())),
    ];
    let limits = robot.joint_limits().into_iter().zip(1..);
    let without_zero = limits.filter(|([low, high], _)| *low > 0.0 || *high < 0.0);
    let without_zero: Vec<String> = without_zero.map(|(_, axis)| axis.to_string()).collect();
    if !without_zero.is_empty() {
        facts.push(("limits without zero", format!("axis {}", without_zero.join(", "))));
    }
    if kinds.len() > 6 {
        facts.push(("to calibrate it", "postures that differ in all axes, not only poses that do".into()));
    }
    facts
}

/// Detects an angle that was probably written in radians, rounded, and then converted to degrees, although it was meant as a
/// multiple of a right angle. Returns the rounded number \[rad\] and the exact multiple \[deg\]. The angle must agree with
/// the converted number to its last digit, which is improbable for a measured or calibrated angle.
fn rounded_right_angle(degrees: f64) -> Option<(f64, f64)> {
    let exact_deg = (degrees / 90.0).round() * 90.0;
    if degrees == exact_deg {
        return None;
    }
    let written = degrees.to_string();
    let decimals = written.split_once('.').map_or(0, |(_, decimals)| decimals.len()).min(CONVERTED_DECIMALS);
    let as_written = |degrees: f64| (degrees * 10f64.powi(decimals as i32)).round();
    RADIAN_DECIMALS
        .flat_map(|radian_decimals| {
            let scale = 10f64.powi(radian_decimals);
            let exact = exact_deg.to_radians() * scale;
            // Some files round angles, others truncate them.
            [exact.round(), exact.trunc()].map(|digits| digits / scale)
        })
        .find(|rounded_rad| as_written(rounded_rad.to_degrees()) == as_written(degrees))
        .map(|rounded_rad| (rounded_rad, exact_deg))
}

fn suspicious(
    robot: &RobotConfig,
    chain: &Chain,
    rank: usize,
    axes: &[(JointKind, Vector3<f64>, Vector3<f64>)],
) -> Vec<String> {
    let mut found = Vec::new();
    let mut add = |sentence: String| found.push(sentence);
    let expected = robot.axes().min(6);
    if rank < expected {
        add(format!(
            "the axes move the flange in {rank} independent directions, {expected} are expected: two axes are one and the same \
             line, or more than three are parallel; check alpha_deg and a_m"
        ));
    }
    // Distance and angle of neighbouring axes are the same in all postures, so it is sufficient to check them with
    // all joints at zero.
    for ((axis, next_axis), number) in axes.iter().zip(&axes[1..]).zip(1..) {
        let (kind, point, along) = axis;
        let (next_kind, next_point, next_along) = next_axis;
        let apart_m = match kind {
            JointKind::Revolute => (next_point - point).cross(along).norm(),
            JointKind::Prismatic => 0.0,
        };
        if kind == next_kind && along.cross(next_along).norm() < SAME_DIRECTION && apart_m < SAME_AXIS_M {
            let (does, line) = match kind {
                JointKind::Revolute => ("rotate", "about the same line"),
                JointKind::Prismatic => ("slide", "in the same direction"),
            };
            add(format!(
                "axes {number} and {} {does} {line}: a calibration finds only what both do together; check alpha_deg and a_m",
                number + 1
            ));
        }
    }
    for (link, number) in robot.links.iter().zip(1..) {
        for (key, degrees) in [("alpha_deg", link.alpha_deg), ("theta_deg", link.theta_deg)] {
            let quarters = degrees.abs() / std::f64::consts::FRAC_PI_2;
            if (0.5..2.5).contains(&quarters) && (quarters - quarters.round()).abs() < AS_RADIANS {
                add(format!("link {number}: {key} = {degrees} looks like radians; write degrees"));
            }
            if let Some((rounded_rad, exact_deg)) = rounded_right_angle(degrees) {
                add(format!(
                    "link {number}: {key} = {degrees} may be {rounded_rad} rad, rounded from a whole right angle; if so, write \
                     {exact_deg}; if it was calibrated, leave it"
                ));
            }
        }
        for (key, length_m) in [("a_m", link.a_m), ("d_m", link.d_m)] {
            if length_m.abs() > LENGTH_M_MAX {
                add(format!("link {number}: {key} = {length_m} m is longer than robots are; is it correct?"));
            }
        }
    }
    for ((kind, [low, high]), number) in robot.joint_kinds().zip(robot.joint_limits()).zip(1..) {
        if kind == JointKind::Revolute {
            let (low, high) = (low.to_degrees(), high.to_degrees());
            if high - low > RANGE_DEG_MAX {
                add(format!("axis {number}: a range of {low:.0} to {high:.0} deg is more than four turns"));
            } else if high - low < 4.0 * std::f64::consts::PI && high - low > 1.0 {
                add(format!(
                    "axis {number}: limits of {low:.4} to {high:.4} look like radians; write degrees"
                ));
            }
        }
    }
    if chain.links.iter().all(|link| link.a_m == 0.0 && link.d_m == 0.0) {
        add("all lengths are zero".into());
    }
    found
}
