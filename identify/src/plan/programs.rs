//! A path, or poses to stop at, as programs of robot controllers.
//!
//! Points of a path are so close that the robot leaves the sphere by no more than [`OFF_SPHERE_M_MAX`] between them, as each
//! controller interpolates: joints along lines (RAPID, FANUC), or along curves (KRL's splines, URScript's servo loop).
//! Sources: ABB, Technical reference manual RAPID (3HAC050917), `MoveAbsJ`; KUKA System Software 8.3, Operating and
//! Programming Instructions for System Integrators, `PTP_SPLINE` with `TIME_BLOCK`; Universal Robots, Script Manual,
//! `servoj`, `get_steptime`; FANUC, R-30iA Operator's Manual, motion instructions (joint motion by time, `CNT`), and programs that
//! controllers have written as text.

use std::fmt::Write;

use shared::config::{AngleUnit, LogConversion, RobotConfig};

use super::check::curve;
use super::{CheckError, Constraints};
use crate::kinematics::Joints;
use crate::logs::{CubicSpline, JointConversion, LogError, RobotLog};

/// Times between two points that are tried, longest first \[s\].
const PERIODS_S: [f64; 6] = [0.2, 0.1, 0.05, 0.04, 0.02, 0.01];
/// How far the robot may leave the sphere between two points \[m\].
const OFF_SPHERE_M_MAX: f64 = 0.1e-3;
/// Points of a spline block that a KUKA controller takes.
const BLOCK_POINTS_MAX: usize = 1000;

/// A controller's language.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Language {
    /// ABB
    Rapid,
    /// KUKA
    Krl,
    /// Universal Robots
    Urscript,
    /// FANUC, as text that its controllers and its offline tools turn into a program
    Fanuc,
}

/// Why there is no program.
#[derive(Debug, thiserror::Error)]
pub enum ProgramError {
    /// The path has gaps.
    #[error(transparent)]
    Path(#[from] CheckError),
    /// Joints do not become the controller's numbers.
    #[error(transparent)]
    Log(#[from] LogError),
    /// The log has something else than what a controller takes.
    #[error(
        "how the controller of {robot} counts its joints is not known: `raw_to_joint` of its configuration has gear ratios, so \
         its log has motor angles; take the joints from the table that was written, or configure a log of joint angles"
    )]
    Motors {
        /// Its name.
        robot: String,
    },
    /// The language has six axes, others are additional axes somewhere else in its targets.
    #[error(
        "{robot} has {axes} axes, programs are written for six; take the joints from the table that was written"
    )]
    Axes {
        /// Its name.
        robot: String,
        /// How many.
        axes: usize,
    },
    /// Even the closest points leave the sphere.
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

/// Points of a program.
struct Points {
    task: Task,
    /// Time between two points of a path \[s\].
    period_s: f64,
    /// How long the robot stands at the first point of a path, and at each pose \[s\].
    wait_s: f64,
    /// The controller's numbers, angles in radians.
    raw_rad: Vec<Joints>,
    rate_rad_s: Vec<Joints>,
}

impl Points {
    /// The robot goes to this one at leisure and stands there.
    fn stops(&self, index: usize) -> bool {
        index == 0 || self.task == Task::Poses
    }
}

/// What a program does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Task {
    /// Drives along a path.
    Path,
    /// Stops at poses.
    Poses,
}

impl Language {
    /// That of a robot's maker, by the robot's name.
    pub fn of(robot: &RobotConfig) -> Option<Self> {
        let first = robot.name.split_whitespace().next()?;
        match first {
            "ABB" => Some(Self::Rapid),
            "KUKA" => Some(Self::Krl),
            "UR" | "Universal" => Some(Self::Urscript),
            "FANUC" | "Fanuc" => Some(Self::Fanuc),
            _ => first
                .strip_prefix("UR")
                .filter(|model| model.starts_with(|c: char| c.is_ascii_digit()))
                .map(|_| Self::Urscript),
        }
    }

    /// Name of the file that a controller takes.
    pub fn file_name(self, task: Task) -> String {
        let extension = match self {
            Self::Rapid => "mod",
            Self::Krl => "src",
            Self::Urscript => "script",
            Self::Fanuc => "ls",
        };
        format!("{}.{extension}", self.name(task))
    }

    /// Name of the program.
    const fn name(self, task: Task) -> &'static str {
        match (self, task) {
            (Self::Rapid, Task::Path) => "BallBarPath",
            (Self::Rapid, Task::Poses) => "MeasurePoses",
            (_, Task::Path) => "ballbar_path",
            (_, Task::Poses) => "measure_poses",
        }
    }

    /// The controller goes from point to point along curves that pass their speeds.
    const fn is_smooth(self) -> bool {
        !matches!(self, Self::Rapid | Self::Fanuc)
    }
}

/// The controller of this robot takes programs.
///
/// # Errors
/// [`ProgramError`].
pub fn can_be_programmed(robot: &RobotConfig) -> Result<(), ProgramError> {
    conversion(robot).map(drop)
}

/// The program of a path.
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
    Ok(text(language, &about, &points))
}

/// The program that stops at poses, for so long at each \[s\].
///
/// # Errors
/// [`ProgramError`].
pub fn pose_program(
    language: Language,
    poses: &[Joints],
    robot: &RobotConfig,
    wait_s: f64,
) -> Result<String, ProgramError> {
    let conversion = conversion(robot)?;
    let raw_rad = poses.iter().map(|q| conversion.to_raw(q)).collect();
    let points = Points { task: Task::Poses, period_s: 0.0, wait_s, raw_rad, rate_rad_s: Vec::new() };
    let about = format!("{}: {} poses, {wait_s} s at each", robot.name, poses.len());
    Ok(text(language, &about, &points))
}

fn text(language: Language, about: &str, points: &Points) -> String {
    let name = language.name(points.task);
    match language {
        Language::Rapid => rapid(name, about, points),
        Language::Krl => krl(name, about, points),
        Language::Urscript => ur_script(name, about, points),
        Language::Fanuc => fanuc(name, about, points),
    }
}

/// From joints to the numbers that the controller takes, angles in radians.
fn conversion(robot: &RobotConfig) -> Result<JointConversion, ProgramError> {
    if robot.axes() != 6 {
        return Err(ProgramError::Axes { robot: robot.name.clone(), axes: robot.axes() });
    }
    // A controller takes the angles that its log has where these are joint angles, whatever their signs and coupling.
    let is_joint = |entry: &f64| [-1.0, 0.0, 1.0].contains(entry);
    if !robot.log.raw_to_joint.iter().flatten().all(is_joint) {
        return Err(ProgramError::Motors { robot: robot.name.clone() });
    }
    Ok(JointConversion::new(&LogConversion { unit: AngleUnit::Rad, ..robot.log.clone() })?)
}

/// Points of a path, and how far it leaves the sphere between them \[m\].
fn points(
    language: Language,
    path: &RobotLog,
    robot: &RobotConfig,
    constraints: &Constraints<'_>,
) -> Result<(Points, f64), ProgramError> {
    let conversion = conversion(robot)?;
    let curve = curve(path)?;
    let mut off_sphere_m = 0.0;
    for period_s in PERIODS_S {
        off_sphere_m = off_sphere(language, &curve, period_s, constraints);
        if off_sphere_m <= OFF_SPHERE_M_MAX {
            let at: Vec<_> = times(&curve, period_s).filter_map(|t_s| curve.at(t_s)).collect();
            let raw_rad: Vec<Joints> = at.iter().map(|point| conversion.to_raw(&point.value)).collect();
            let none = conversion.to_raw(&Joints::zeros(robot.axes()));
            let rate = |rate: &Joints| {
                let raw = conversion.to_raw(rate);
                Joints::from_fn(raw.len(), |axis| raw[axis] - none[axis])
            };
            let rate_rad_s = at.iter().map(|point| rate(&point.rate)).collect();
            let points = Points { task: Task::Path, period_s, wait_s: 1.0, raw_rad, rate_rad_s };
            return Ok((points, off_sphere_m));
        }
    }
    let period_s = PERIODS_S.last().copied().unwrap_or_default();
    Err(ProgramError::Coarse { period_s, off_mm: off_sphere_m * 1e3 })
}

fn times(curve: &CubicSpline<Joints>, period_s: f64) -> impl Iterator<Item = f64> {
    let count = (curve.duration_s() / period_s + 1e-9).floor() as usize;
    (0..=count).map(move |point| point as f64 * period_s)
}

/// Largest distance from the sphere between points \[m\].
fn off_sphere(
    language: Language,
    curve: &CubicSpline<Joints>,
    period_s: f64,
    constraints: &Constraints<'_>,
) -> f64 {
    let gimbal = constraints.bar().root_from_base.translation.vector;
    let radius_m = |q: &Joints| (constraints.robot().forward(q).translation.vector - gimbal).norm();
    let at: Vec<_> = times(curve, period_s).filter_map(|t_s| curve.at(t_s)).collect();
    let start_m = at.first().map_or(0.0, |point| radius_m(&point.value));
    let mut most_m = 0.0_f64;
    for pair in at.windows(2) {
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

/// Cubic from `a` to `b` with these slopes for a part of the way.
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

fn rapid(name: &str, about: &str, points: &Points) -> String {
    let mut text = format!("MODULE {name}\n  ! {about}\n  PROC {name}()\n");
    for (index, raw_rad) in points.raw_rad.iter().enumerate() {
        let target = format!("[[{}],[9E9,9E9,9E9,9E9,9E9,9E9]]", list(raw_rad, 1f64.to_degrees()));
        // Writing to a string cannot fail.
        let _ = if points.stops(index) {
            let wait_s = points.wait_s;
            write!(text, "    MoveAbsJ {target}\\NoEOffs,v50,fine,tool0;\n    WaitTime {wait_s};\n")
        } else {
            writeln!(text, "    MoveAbsJ {target}\\NoEOffs,v1000\\T:={},z1,tool0;", points.period_s)
        };
    }
    text.push_str("  ENDPROC\nENDMODULE\n");
    text
}

fn krl(name: &str, about: &str, points: &Points) -> String {
    let target = |raw_rad: &Joints| {
        let axes = raw_rad.iter().enumerate();
        let axes: Vec<String> =
            axes.map(|(axis, angle)| format!("A{} {:.6}", axis + 1, angle.to_degrees())).collect();
        format!("{{{}}}", axes.join(","))
    };
    let mut text = format!("&ACCESS RVP\nDEF {name}()\n; {about}\nBAS(#INITMOV,0)\nBAS(#VEL_PTP,10)\n");
    let stops = points.raw_rad.iter().enumerate().take_while(|(index, _)| points.stops(*index)).count();
    let (stops, others) = points.raw_rad.split_at(stops);
    for raw_rad in stops {
        let _ = write!(text, "PTP {}\nWAIT SEC {}\n", target(raw_rad), points.wait_s);
    }
    for block in others.chunks(BLOCK_POINTS_MAX) {
        text.push_str("PTP_SPLINE\n  TIME_BLOCK START\n");
        for (index, raw_rad) in block.iter().enumerate() {
            let _ = writeln!(text, "  SPTP {}", target(raw_rad));
            if index + 1 < block.len() {
                text.push_str("  TIME_BLOCK PART = 1\n");
            }
        }
        let _ = write!(text, "  TIME_BLOCK END = {:.3}\nENDSPLINE\n", points.period_s * block.len() as f64);
    }
    text.push_str("END\n");
    text
}

fn ur_script(name: &str, about: &str, points: &Points) -> String {
    let Some(first) = points.raw_rad.first() else { return String::new() };
    let axes = first.len();
    let mut text = format!("def {name}():\n  # {about}\n");
    if points.task == Task::Poses {
        for raw_rad in &points.raw_rad {
            let (q, wait_s) = (list(raw_rad, 1.0), points.wait_s);
            let _ = write!(text, "  movej([{q}], a=0.3, v=0.2)\n  sleep({wait_s})\n");
        }
        let _ = write!(text, "end\n{name}()\n");
        return text;
    }
    let _ = write!(
        text,
        "  global q0 = [{}]\n  global v0 = [{}]\n  global t = 0\n  movej(q0, a=0.3, v=0.2)\n  sleep(1)\n",
        list(first, 1.0),
        list(&Joints::zeros(axes), 1.0)
    );
    // A cubic between two points with the path's speeds at both, one step of the controller at a time. What is over of a
    // point's time belongs to the next: steps of 8 ms are no parts of 50.
    let entries: Vec<String> =
        (0..axes).map(|i| format!("a*q0[{i}]+b*q1[{i}]+c*v0[{i}]+d*v1[{i}]")).collect();
    let _ = write!(
        text,
        "  def go(q1, v1):\n    local dt = get_steptime()\n    while t + dt < {period} + 0.000001:\n      t = t + dt\n      \
         local u = t / {period}\n      local a = 2*u*u*u - 3*u*u + 1\n      \
         local b = 3*u*u - 2*u*u*u\n      local c = (u*u*u - 2*u*u + u) * {period}\n      \
         local d = (u*u*u - u*u) * {period}\n      servoj([{entries}], t=dt, lookahead_time=0.03, gain=500)\n    end\n    \
         q0 = q1\n    v0 = v1\n    t = t - {period}\n  end\n",
        period = points.period_s,
        entries = entries.join(", ")
    );
    for (raw_rad, rate_rad_s) in points.raw_rad.iter().zip(&points.rate_rad_s).skip(1) {
        let _ = writeln!(text, "  go([{}], [{}])", list(raw_rad, 1.0), list(rate_rad_s, 1.0));
    }
    let _ = write!(text, "  stopj(2)\nend\n{name}()\n");
    text
}

/// Joint 3 is what the controller calls so, from the horizontal, where `raw_to_joint` of the robot's configuration has the
/// coupling: the numbers are those of its log.
fn fanuc(name: &str, about: &str, points: &Points) -> String {
    /// Characters of a remark that a controller takes.
    const REMARK: usize = 32;
    let mut lines: Vec<String> =
        textwrap::wrap(about, REMARK).into_iter().map(|part| format!("!{part}")).collect();
    lines.extend(["UFRAME_NUM=0".into(), "UTOOL_NUM=0".into()]);
    let period_ms = (points.period_s * 1e3).round();
    for point in 1..=points.raw_rad.len() {
        if points.stops(point - 1) {
            lines.extend([format!("J P[{point}] 10% FINE"), format!("WAIT {:>6.2}(sec)", points.wait_s)]);
        } else {
            lines.push(format!("J P[{point}] {period_ms}msec CNT100"));
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
        let _ = writeln!(text, "{:>4}:{}{line} ;", index + 1, if line.starts_with('J') { "" } else { "  " });
    }
    text.push_str("/POS\n");
    for (index, raw_rad) in points.raw_rad.iter().enumerate() {
        let joint =
            |(axis, angle): (usize, &f64)| format!("J{}= {:.3} deg", axis + 1, angle.to_degrees() + 0.0);
        let joints: Vec<String> = raw_rad.iter().enumerate().map(joint).collect();
        let _ =
            writeln!(text, "P[{}]{{\n   GP1:\n\tUF : 0, UT : 0,\n\t{}\n}};", index + 1, joints.join(",\n\t"));
    }
    text.push_str("/END\n");
    text
}
