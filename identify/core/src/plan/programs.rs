//! Writes a path, or poses at which the robot stops, as programs for robot controllers. Three steps: the joints
//! are converted to the controller's values, the values to a list of instructions, and the instructions to text
//! in the controller's language.
//!
//! The points of a path are close enough that the robot leaves the sphere between them by at most [`OFF_SPHERE_M_MAX`].
//! Controllers interpolate between points in different ways: along lines in joint space (RAPID, FANUC), or along curves
//! (KRL's splines, URScript's servo loop).
//!
//! Sources: ABB, Technical reference manual RAPID (3HAC050917), `MoveAbsJ`; KUKA System Software 8.3, Operating and
//! Programming Instructions for System Integrators, `PTP_SPLINE` with `TIME_BLOCK`; Universal Robots, Script Manual,
//! `servoj`, `get_steptime`; FANUC, R-30iA Operator's Manual, motion instructions (joint motion by time, `CNT`), and
//! programs that controllers have written as text.

use std::fmt::Write;

use nalgebra::Vector3;
use shared::config::{AngleUnit, JointKind, LogConversion, Maker, RobotConfig};

use super::check::curve;
use super::{CheckError, Constraints, PlannedPoses, Way};
use crate::kinematics::{Joints, Trace, Tracer, flange_chain};
use crate::logs::{CubicSpline, JointConversion, LogError, RobotLog};

/// Times between two points of a path that are tried, longest first \[s\].
const PERIODS_S: [f64; 6] = [0.2, 0.1, 0.05, 0.04, 0.02, 0.01];
/// Largest distance of the robot from the sphere between two points \[m\].
const OFF_SPHERE_M_MAX: f64 = 0.1e-3;
/// Standstill at the start of a path, before the motion begins \[s\].
const SETTLE_S: f64 = 1.0;
/// Largest number of points that a KUKA controller accepts in a spline block.
const BLOCK_POINTS_MAX: usize = 1000;

/// Programming language of a robot controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Language {
    /// ABB RAPID
    Rapid,
    /// KUKA KRL
    Krl,
    /// Universal Robots URScript
    Urscript,
    /// FANUC: text that FANUC controllers and offline tools convert to a program
    Fanuc,
}

/// Why a program cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum ProgramError {
    /// The path cannot be interpolated, because it has gaps.
    #[error(transparent)]
    Path(#[from] CheckError),
    /// The joints cannot be converted to the controller's values.
    #[error(transparent)]
    Log(#[from] LogError),
    /// The log has motor angles, which a controller does not accept.
    #[error(
        "the joint angles of {robot}'s controller are unknown: `raw_to_joint` of its configuration has gear ratios, so its log has \
         motor angles; take the joints from the table, or configure a log of joint angles"
    )]
    Motors {
        /// Name of the robot.
        robot: String,
    },
    /// The robot does not have six axes. A target in these languages has six axes; additional axes would need another
    /// field of the target.
    #[error("{robot} has {axes} axes, programs are written for six; take the joints from the table")]
    Axes {
        /// Name of the robot.
        robot: String,
        /// Number of its axes.
        axes: usize,
    },
    /// An axis of the robot is prismatic. The programs write all joints as angles.
    #[error(
        "axis {axis} of {robot} is prismatic, programs are written for revolute axes; take the joints from the table"
    )]
    Prismatic {
        /// Name of the robot.
        robot: String,
        /// Number (from 1) of its first prismatic axis.
        axis: usize,
    },
    /// The controller measures joint 3 from the horizontal, but the configuration has no coupling of joints 2 and 3.
    #[error(
        "the controller measures joint 3 from the horizontal, but `raw_to_joint` of {robot} does not, so joint 3 of the program would \
         be wrong;\nwrite {row:?} as its second row: the robot's log needs it too"
    )]
    Coupling {
        /// The robot's name.
        robot: String,
        /// The row that `raw_to_joint` must contain: the contributions of the controller's joint 2 to the
        /// joints of the model.
        row: Vec<f64>,
    },
    /// The robot leaves the sphere between points even if the points are as close as possible.
    #[error(
        "between points {period_s} s apart the robot leaves the sphere by {off_mm:.3} mm; plan with a lower \
         --speed or --acceleration"
    )]
    Coarse {
        /// Time between points \[s\].
        period_s: f64,
        /// Distance from the sphere \[mm\].
        off_mm: f64,
    },
}

/// One instruction of a program. Joints are the controller's values, with angles in radians.
enum Instruction {
    /// Moves slowly to these joints and stops.
    Go(Joints),
    /// Waits at a pose \[s\].
    Wait(f64),
    /// Stops until the operator continues the program.
    Halt {
        /// Message for the operator on the controller's display. The smallest display shows 24 characters.
        message: String,
        /// Reason for the stop, written as a comment.
        reason: String,
        /// Number (from 1) of the pose to which the operator jogs the arm; `None` if the arm is not jogged.
        jogged_to: Option<usize>,
    },
    /// Waits between two moves of a path \[s\].
    Stand(f64),
    /// Moves through points that are `period_s` apart, and stops at the last one.
    Drive {
        /// Time between two points \[s\].
        period_s: f64,
        /// The points in the controller's values, with angles in radians.
        raw_rad: Vec<Joints>,
    },
    /// Moves along a path and passes its points with the given rates.
    Servo(Points),
}

/// Points of a path. The robot is at the first point before the motion begins.
struct Points {
    /// Time between two points \[s\].
    period_s: f64,
    /// The points in the controller's values, with angles in radians.
    raw_rad: Vec<Joints>,
    /// Rates of the controller's values at each point \[rad/s\].
    rate_rad_s: Vec<Joints>,
}

impl Points {
    /// Divides the points into alternating moves and standstills. Points count as a standstill if they are equal in all
    /// digits of the program. Controllers refuse segments of zero length, or stop at them.
    fn segments(&self, digits: i32) -> Vec<Instruction> {
        let written = |q: &Joints| q.map(|angle| (angle.to_degrees() * 10f64.powi(digits)).round());
        let moves = |pair: &&[Joints]| written(&pair[0]) != written(&pair[1]);
        let pairs: Vec<&[Joints]> = self.raw_rad.windows(2).collect();
        let period_s = self.period_s;
        pairs
            .chunk_by(|one, next| moves(one) == moves(next))
            .map(|run| match run.first().is_some_and(moves) {
                true => Instruction::Drive { period_s, raw_rad: run.iter().map(|pair| pair[1]).collect() },
                false => Instruction::Stand(period_s * run.len() as f64),
            })
            .collect()
    }
}

/// Purpose of a program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ProgramPurpose {
    /// Moves along a path.
    Path,
    /// Stops at each pose.
    Poses,
}

impl Language {
    /// The language of the robot's maker, if the robot's name contains the name of a known maker.
    pub fn for_robot(robot: &RobotConfig) -> Option<Self> {
        Some(match robot.maker()? {
            Maker::Abb => Self::Rapid,
            Maker::Kuka => Self::Krl,
            Maker::UniversalRobots => Self::Urscript,
            Maker::Fanuc => Self::Fanuc,
        })
    }

    /// Name of the program's file.
    pub fn file_name(self, purpose: ProgramPurpose) -> String {
        let extension = match self {
            Self::Rapid => "mod",
            Self::Krl => "src",
            Self::Urscript => "script",
            Self::Fanuc => "ls",
        };
        format!("{}.{extension}", self.name(purpose))
    }

    /// Name of the program.
    const fn name(self, purpose: ProgramPurpose) -> &'static str {
        match (self, purpose) {
            (Self::Rapid, ProgramPurpose::Path) => "BallBarPath",
            (Self::Rapid, ProgramPurpose::Poses) => "MeasurePoses",
            (_, ProgramPurpose::Path) => "ballbar_path",
            (_, ProgramPurpose::Poses) => "measure_poses",
        }
    }

    /// Number of decimals of a degree in the program.
    const fn digits(self) -> i32 {
        if matches!(self, Self::Fanuc) { 3 } else { 6 }
    }

    /// Whether the controller interpolates along a curve that has the given rates at the points. If not,
    /// it interpolates along lines.
    const fn is_smooth(self) -> bool {
        !matches!(self, Self::Rapid | Self::Fanuc)
    }
}

/// Checks that a program for this robot can be written in this language.
///
/// # Errors
/// [`ProgramError`].
pub fn can_be_programmed(language: Language, robot: &RobotConfig) -> Result<(), ProgramError> {
    conversion(language, robot).map(drop)
}

/// Writes the program that moves the robot along a path.
///
/// # Errors
/// [`ProgramError`].
pub fn program(
    language: Language,
    path: &RobotLog,
    robot: &RobotConfig,
    constraints: &Constraints<'_>,
) -> Result<String, ProgramError> {
    let (points, off_sphere_m) = points(language, path, robot, constraints)?;
    let about = format!(
        "{}: path with the ball-bar, {:.1} s, points {} s apart, at most {:.3} mm off the sphere between them",
        robot.name,
        path.q_rad.duration_s(),
        points.period_s,
        off_sphere_m * 1e3
    );
    let start = points.raw_rad.first().copied().unwrap_or_default();
    let attach = Instruction::Halt {
        message: "attach the ball-bar now".into(),
        reason: "the arm is at the start of the path".into(),
        jogged_to: None,
    };
    let mut steps = vec![Instruction::Go(start), attach, Instruction::Wait(SETTLE_S)];
    match language {
        Language::Urscript => steps.push(Instruction::Servo(points)),
        _ => steps.extend(points.segments(language.digits())),
    }
    Ok(text(language, ProgramPurpose::Path, &about, &steps))
}

/// Writes the program that stops at each pose for `wait_s` \[s\]. If no collision-free path to a pose is known, the program
/// waits for the operator before this pose.
///
/// # Errors
/// [`ProgramError`].
pub fn pose_program(
    language: Language,
    poses: &PlannedPoses,
    robot: &RobotConfig,
    wait_s: f64,
) -> Result<String, ProgramError> {
    let conversion = conversion(language, robot)?;
    let mut steps = Vec::new();
    for ((q, way), number) in poses.joints.iter().zip(&poses.ways).zip(1..) {
        match way {
            Way::Straight => {}
            Way::Through(postures) => {
                steps.extend(postures.iter().map(|q| Instruction::Go(conversion.to_raw(q))));
            }
            Way::Blocked => steps.push(Instruction::Halt {
                message: format!("jog by hand to pose {number}"),
                reason: format!(
                    "no path without collision from pose {} to pose {number} was found",
                    number - 1
                ),
                jogged_to: Some(number),
            }),
        }
        steps.extend([Instruction::Go(conversion.to_raw(q)), Instruction::Wait(wait_s)]);
    }
    let about = format!("{}: {} poses, {wait_s} s at each", robot.name, poses.joints.len());
    Ok(text(language, ProgramPurpose::Poses, &about, &steps))
}

fn text(language: Language, purpose: ProgramPurpose, about: &str, steps: &[Instruction]) -> String {
    let name = language.name(purpose);
    match language {
        Language::Rapid => rapid(name, about, steps),
        Language::Krl => krl(name, about, steps),
        Language::Urscript => ur_script(name, about, steps),
        Language::Fanuc => fanuc(name, about, steps),
    }
}

/// The conversion from joints of the model to the controller's values, with angles in radians.
fn conversion(language: Language, robot: &RobotConfig) -> Result<JointConversion, ProgramError> {
    if robot.axes() != 6 {
        return Err(ProgramError::Axes { robot: robot.name.clone(), axes: robot.axes() });
    }
    if let Some(index) = robot.joint_kinds().position(|kind| kind == JointKind::Prismatic) {
        return Err(ProgramError::Prismatic { robot: robot.name.clone(), axis: index + 1 });
    }
    // If the conversion has only signs and couplings and no gear ratios, the log's values are joint angles. Controllers
    // accept only joint angles as targets.
    let is_joint = |entry: &f64| [-1.0, 0.0, 1.0].contains(entry);
    if !robot.log.raw_to_joint.iter().flatten().all(is_joint) {
        return Err(ProgramError::Motors { robot: robot.name.clone() });
    }
    if language == Language::Fanuc || language == Language::Rapid && robot.counts_joint_3_from_horizontal() {
        check_joint_3_coupling(robot)?;
    }
    Ok(JointConversion::new(&LogConversion { unit: AngleUnit::Rad, ..robot.log.clone() })?)
}

/// Checks that the conversion includes the measurement of the controller's joint 3 from the horizontal. If only joint 2 of
/// the controller turns, the forearm keeps its direction. Joint 3 of the model is measured from the upper arm, so it turns
/// back by the same angle. The entry `(2, 3)` of `raw_to_joint` represents this.
fn check_joint_3_coupling(robot: &RobotConfig) -> Result<(), ProgramError> {
    let mut trace = Trace::default();
    Tracer::new(&flange_chain(robot)).trace(&Joints::zeros(robot.axes()), &mut trace);
    let axes: Vec<Vector3<f64>> = trace.joint_twists().map(|twist| twist.angular).collect();
    // 1 if axes 2 and 3 have the same direction, -1 if they have opposite directions.
    let axes_2_3 = axes[1].dot(&axes[2]).round();
    let configured_row = &robot.log.raw_to_joint[1];
    let mut row = configured_row.clone();
    // Adding zero converts -0.0 to 0.0, because the message would show the sign.
    row[2] = -axes_2_3 * row[1] + 0.0;
    if row == *configured_row {
        return Ok(());
    }
    Err(ProgramError::Coupling { robot: robot.name.clone(), row })
}

/// Points of a path, and the largest distance of the robot from the sphere between them \[m\]. The time between points is
/// the longest of [`PERIODS_S`] for which this distance is at most [`OFF_SPHERE_M_MAX`].
fn points(
    language: Language,
    path: &RobotLog,
    robot: &RobotConfig,
    constraints: &Constraints<'_>,
) -> Result<(Points, f64), ProgramError> {
    let conversion = conversion(language, robot)?;
    let curve = curve(path)?;
    let mut off_sphere_m = 0.0;
    for period_s in PERIODS_S {
        off_sphere_m = off_sphere(language, &curve, period_s, constraints);
        if off_sphere_m <= OFF_SPHERE_M_MAX {
            let on_path: Vec<_> = times(&curve, period_s).filter_map(|t_s| curve.at(t_s)).collect();
            let raw_rad: Vec<Joints> = on_path.iter().map(|point| conversion.to_raw(&point.value)).collect();
            // The conversion of joints adds offsets. Rates do not have offsets, so the offsets are subtracted again.
            let offset_rad = conversion.to_raw(&Joints::zeros(robot.axes()));
            let raw_rate = |rate: &Joints| {
                let with_offset = conversion.to_raw(rate);
                Joints::from_fn(with_offset.len(), |axis| with_offset[axis] - offset_rad[axis])
            };
            let rate_rad_s = on_path.iter().map(|point| raw_rate(&point.rate)).collect();
            return Ok((Points { period_s, raw_rad, rate_rad_s }, off_sphere_m));
        }
    }
    let period_s = PERIODS_S.last().copied().unwrap_or_default();
    Err(ProgramError::Coarse { period_s, off_mm: off_sphere_m * 1e3 })
}

fn times(curve: &CubicSpline<Joints>, period_s: f64) -> impl Iterator<Item = f64> {
    let count = (curve.duration_s() / period_s + 1e-9).floor() as usize;
    (0..=count).map(move |point| point as f64 * period_s)
}

/// Largest distance of the robot from the sphere, evaluated at one, two and three quarters of each interval between points
/// \[m\]. Joints are interpolated in the same way as in the controller.
fn off_sphere(
    language: Language,
    curve: &CubicSpline<Joints>,
    period_s: f64,
    constraints: &Constraints<'_>,
) -> f64 {
    let gimbal = constraints.bar.root_from_base.translation.vector;
    let radius_m = |q: &Joints| (constraints.robot.forward(q).translation.vector - gimbal).norm();
    let points: Vec<_> = times(curve, period_s).filter_map(|t_s| curve.at(t_s)).collect();
    let start_m = points.first().map_or(0.0, |point| radius_m(&point.value));
    let mut most_m = 0.0_f64;
    for pair in points.windows(2) {
        for part in [0.25, 0.5, 0.75] {
            let q = Joints::from_fn(pair[0].value.len(), |axis| {
                let (a, b) = (pair[0].value[axis], pair[1].value[axis]);
                let line = a + part * (b - a);
                if !language.is_smooth() {
                    return line;
                }
                hermite(part, [a, b], [pair[0].rate[axis] * period_s, pair[1].rate[axis] * period_s])
            });
            most_m = most_m.max((radius_m(&q) - start_m).abs());
        }
    }
    most_m
}

/// Cubic Hermite polynomial from `a` to `b` with the slopes `slope_a` and `slope_b`, at the fraction `u` of the interval.
fn hermite(u: f64, [a, b]: [f64; 2], [slope_a, slope_b]: [f64; 2]) -> f64 {
    let (u2, u3) = (u * u, u * u * u);
    (2.0 * u3 - 3.0 * u2 + 1.0) * a
        + (3.0 * u2 - 2.0 * u3) * b
        + (u3 - 2.0 * u2 + u) * slope_a
        + (u3 - u2) * slope_b
}

fn list(numbers: &[f64], factor: f64) -> String {
    numbers.iter().map(|number| format!("{:.6}", number * factor)).collect::<Vec<_>>().join(",")
}

fn rapid(name: &str, about: &str, steps: &[Instruction]) -> String {
    let target = |raw_rad: &Joints| {
        format!("MoveAbsJ [[{}],[9E9,9E9,9E9,9E9,9E9,9E9]]\\NoEOffs", list(raw_rad, 1f64.to_degrees()))
    };
    let instruction = |step: &Instruction| match step {
        Instruction::Go(raw_rad) => format!("    {},v50,fine,tool0;\n", target(raw_rad)),
        Instruction::Wait(wait_s) => format!("    WaitTime {wait_s};\n"),
        Instruction::Halt { message, reason, jogged_to } => {
            // After the operator has jogged the arm, it must not return to the previous position.
            let stop = if jogged_to.is_some() { "Stop\\NoRegain" } else { "Stop" };
            format!("    ! {reason}\n    TPWrite \"{message}\";\n    {stop};\n")
        }
        Instruction::Stand(wait_s) => format!("    WaitTime {wait_s:.3};\n"),
        Instruction::Drive { period_s, raw_rad: points } => {
            let point = |(index, raw_rad): (usize, &Joints)| {
                let zone = if index + 1 == points.len() { "fine" } else { "z1" };
                format!("    {},v1000\\T:={period_s},{zone},tool0;\n", target(raw_rad))
            };
            points.iter().enumerate().map(point).collect()
        }
        Instruction::Servo(_) => String::new(),
    };
    let instructions: String = steps.iter().map(instruction).collect();
    format!("MODULE {name}\n  ! {about}\n  PROC {name}()\n{instructions}  ENDPROC\nENDMODULE\n")
}

fn krl(name: &str, about: &str, steps: &[Instruction]) -> String {
    let target = |raw_rad: &Joints| {
        let axes = raw_rad.iter().enumerate();
        let axes: Vec<String> =
            axes.map(|(axis, angle)| format!("A{} {:.6}", axis + 1, angle.to_degrees())).collect();
        format!("{{{}}}", axes.join(","))
    };
    let instruction = |step: &Instruction| match step {
        Instruction::Go(raw_rad) => format!("PTP {}\n", target(raw_rad)),
        Instruction::Wait(wait_s) => format!("WAIT SEC {wait_s}\n"),
        Instruction::Halt { message, reason, .. } => format!("; {reason}\n; {message}\nHALT\n"),
        Instruction::Stand(wait_s) => format!("WAIT SEC {wait_s:.3}\n"),
        Instruction::Drive { period_s, raw_rad } => {
            let spline = |block: &[Joints]| {
                let points: Vec<String> =
                    block.iter().map(|raw_rad| format!("  SPTP {}\n", target(raw_rad))).collect();
                let block_s = period_s * block.len() as f64;
                format!(
                    "PTP_SPLINE\n  TIME_BLOCK START\n{}  TIME_BLOCK END = {block_s:.3}\nENDSPLINE\n",
                    points.join("  TIME_BLOCK PART = 1\n")
                )
            };
            raw_rad.chunks(BLOCK_POINTS_MAX).map(spline).collect()
        }
        Instruction::Servo(_) => String::new(),
    };
    let instructions: String = steps.iter().map(instruction).collect();
    // Targets are joint angles, so they do not depend on tool and base. A controller nevertheless needs a valid tool
    // and base to move.
    format!(
        "&ACCESS RVP\nDEF {name}()\n; {about}\nBAS(#INITMOV,0)\nBAS(#VEL_PTP,10)\n$TOOL=$NULLFRAME\n$BASE=$NULLFRAME\n\
         {instructions}END\n"
    )
}

fn ur_script(name: &str, about: &str, steps: &[Instruction]) -> String {
    let instruction = |step: &Instruction| match step {
        Instruction::Go(raw_rad) => format!("  movej([{}], a=0.3, v=0.2)\n", list(raw_rad, 1.0)),
        Instruction::Wait(wait_s) => format!("  sleep({wait_s})\n"),
        Instruction::Halt { message, reason, jogged_to: None } => {
            format!("  # {reason}\n  popup(\"{message}\", title=\"{name}\", blocking=True)\n")
        }
        // The operator cannot jog the arm while a program runs.
        Instruction::Halt { message, reason, jogged_to: Some(to) } => format!(
            "  # {reason}\n  \
             # stop here, {message}; delete the lines above and start again for poses {to} and following\n  \
             popup(\"{message}\", title=\"{name}\", warning=True)\n  halt\n"
        ),
        Instruction::Servo(points) => ur_script_path(points),
        Instruction::Stand(_) | Instruction::Drive { .. } => String::new(),
    };
    let instructions: String = steps.iter().map(instruction).collect();
    format!("def {name}():\n  # {about}\n{instructions}end\n{name}()\n")
}

fn ur_script_path(points: &Points) -> String {
    let Some(first) = points.raw_rad.first() else { return String::new() };
    let axes = first.len();
    let entries: Vec<String> =
        (0..axes).map(|i| format!("a*q0[{i}]+b*q1[{i}]+c*v0[{i}]+d*v1[{i}]")).collect();
    let moves = points.raw_rad.iter().zip(&points.rate_rad_s).skip(1);
    let moves: String = moves
        .map(|(raw_rad, rate_rad_s)| format!("  go([{}], [{}])\n", list(raw_rad, 1.0), list(rate_rad_s, 1.0)))
        .collect();
    // Between two points the robot follows a cubic polynomial that has the path's rates at both points. The polynomial is
    // evaluated at each time step of the controller. If the time between points is not a multiple of this step (50 ms and 8
    // ms), the remainder is added to the next interval.
    format!(
        "  global q0 = [{q0}]\n  global v0 = [{v0}]\n  global t = 0\n  \
         def go(q1, v1):\n    local dt = get_steptime()\n    while t + dt < {period} + 0.000001:\n      t = t + dt\n      \
         local u = t / {period}\n      local a = 2*u*u*u - 3*u*u + 1\n      \
         local b = 3*u*u - 2*u*u*u\n      local c = (u*u*u - 2*u*u + u) * {period}\n      \
         local d = (u*u*u - u*u) * {period}\n      servoj([{entries}], t=dt, lookahead_time=0.03, gain=500)\n    end\n    \
         q0 = q1\n    v0 = v1\n    t = t - {period}\n  end\n{moves}  stopj(2)\n",
        q0 = list(first, 1.0),
        v0 = list(&Joints::zeros(axes), 1.0),
        period = points.period_s,
        entries = entries.join(", ")
    )
}

/// A FANUC controller measures joint 3 from the horizontal. The conversion of the
/// joints includes this ([`check_joint_3_coupling`]).
fn fanuc(name: &str, about: &str, steps: &[Instruction]) -> String {
    /// Highest number of characters of a remark.
    const REMARK: usize = 32;
    /// Highest number of characters of a message.
    const MESSAGE: usize = 24;
    let remark = |text: &str| -> Vec<String> {
        textwrap::wrap(text, REMARK).into_iter().map(|part| format!("!{part}")).collect()
    };
    let mut lines = remark(about);
    lines.extend(["UFRAME_NUM=0".into(), "UTOOL_NUM=0".into()]);
    let mut positions: Vec<&Joints> = Vec::new();
    for step in steps {
        match step {
            Instruction::Go(raw_rad) => {
                positions.push(raw_rad);
                lines.push(format!("J P[{}] 10% FINE", positions.len()));
            }
            Instruction::Wait(wait_s) | Instruction::Stand(wait_s) => {
                lines.push(format!("WAIT {wait_s:>6.2}(sec)"))
            }
            Instruction::Halt { message, reason, .. } => {
                lines.extend(remark(reason));
                let message: String = message.replace('-', " ").chars().take(MESSAGE).collect();
                lines.extend([format!("MESSAGE[{message}]"), "PAUSE".into()]);
            }
            Instruction::Drive { period_s, raw_rad: points } => {
                for (index, raw_rad) in points.iter().enumerate() {
                    positions.push(raw_rad);
                    let end = if index + 1 == points.len() { "FINE" } else { "CNT100" };
                    lines.push(format!("J P[{}] {}msec {end}", positions.len(), (period_s * 1e3).round()));
                }
            }
            Instruction::Servo(_) => {}
        }
    }
    let mut text = format!(
        "/PROG  {}\n/ATTR\nCOMMENT\t\t= \"\";\nLINE_COUNT\t= {};\nPROTECT\t\t= READ_WRITE;\n\
         DEFAULT_GROUP\t= 1,*,*,*,*;\n/MN\n",
        name.to_uppercase(),
        lines.len()
    );
    // Writing to a string cannot fail.
    for (index, line) in lines.iter().enumerate() {
        let _ = writeln!(text, "{:>4}:{}{line} ;", index + 1, if line.starts_with("J ") { "" } else { "  " });
    }
    text.push_str("/POS\n");
    for (index, raw_rad) in positions.iter().enumerate() {
        let joint =
            |(axis, angle): (usize, &f64)| format!("J{}= {:.3} deg", axis + 1, angle.to_degrees() + 0.0);
        let joints: Vec<String> = raw_rad.iter().enumerate().map(joint).collect();
        let _ =
            writeln!(text, "P[{}]{{\n   GP1:\n\tUF : 0, UT : 0,\n\t{}\n}};", index + 1, joints.join(",\n\t"));
    }
    text.push_str("/END\n");
    text
}
