//! Which figure shows what.

use plotters::prelude::RGBColor;

use super::plot::{BLUE, COLOURS, GREEN, GREY, Mark, ORANGE, Panel, PlotError, Series};
use crate::cost::Closure;
use crate::evaluate::{Evidence, JointGap, RunEvidence, ShiftCurve};
use crate::prepare::LocalShift;
use crate::statistics::extremes;

pub(in crate::report::page) const WIDE: (u32, u32) = (920, 250);
pub(in crate::report::page) const HALF: (u32, u32) = (450, 270);
pub(in crate::report::page) const THIRD: (u32, u32) = (340, 230);
/// Axes of equal length once the labels have their room.
pub(in crate::report::page) const ROUND: (u32, u32) = (450, 444);

pub(in crate::report::page) fn dots(
    name: impl Into<String>,
    colour: RGBColor,
    points: Vec<(f64, f64)>,
) -> Series {
    Series::new(name, colour, Mark::Dots, points)
}

/// Time in the unit in which people read a run of this length.
#[derive(Debug, Clone, Copy)]
pub(in crate::report::page) struct TimeAxis {
    seconds: f64,
    pub label: &'static str,
    /// Title of the axis where times count from the first reading.
    pub since_first: &'static str,
    /// Unit alone.
    pub unit: &'static str,
}

impl TimeAxis {
    const fn new(seconds: f64, label: &'static str, since_first: &'static str, unit: &'static str) -> Self {
        Self { seconds, label, since_first, unit }
    }

    /// For times from the middle of a run.
    pub fn of(times_s: impl Iterator<Item = f64>) -> Self {
        /// Longest of each unit \[s\].
        const SECONDS_MAX: f64 = 900.0;
        const MINUTES_MAX: f64 = 3.0 * 3600.0;
        let [low, high] = extremes(times_s);
        match high - low {
            span_s if span_s > MINUTES_MAX => Self::new(
                3600.0,
                "time from the middle of the run [h]",
                "time from the first reading [h]",
                "h",
            ),
            span_s if span_s > SECONDS_MAX => Self::new(
                60.0,
                "time from the middle of the run [min]",
                "time from the first reading [min]",
                "min",
            ),
            _ => {
                Self::new(1.0, "time from the middle of the run [s]", "time from the first reading [s]", "s")
            }
        }
    }

    fn of_run(run: &RunEvidence) -> Self {
        Self::of(run.after.iter().map(|closure| closure.t_s))
    }

    /// Seconds in the axis' unit.
    pub fn at(&self, t_s: f64) -> f64 {
        t_s / self.seconds
    }
}

/// Distance of robot and bar over time, nominal and calibrated.
pub(in crate::report::page) fn gap_over_time(
    run: &RunEvidence,
    by_encoders: bool,
) -> Result<[String; 2], PlotError> {
    let gap_mm = |closure: &Closure| 1e3 * closure.gap_m(by_encoders);
    let time = TimeAxis::of_run(run);
    let panel = |title: &str, colour, closures: &[Closure]| Panel {
        title: title.into(),
        x: time.label,
        y: "distance [mm]".into(),
        size: WIDE,
        series: vec![dots("", colour, closures.iter().map(|one| (time.at(one.t_s), gap_mm(one))).collect())],
        from_zero: true,
    };
    Ok([
        panel("Nominal robot, the bar fitted to it", GREY, &run.before).draw()?,
        panel("Calibrated robot", BLUE, &run.after).draw()?,
    ])
}

/// Components of the calibrated gap over time: position, and rotation where it means something.
pub(in crate::report::page) fn components_over_time(
    run: &RunEvidence,
    rotations: bool,
) -> Result<Vec<String>, PlotError> {
    let time = TimeAxis::of_run(run);
    let panel = |title: &str, y: &str, component: &dyn Fn(&Closure, usize) -> f64| {
        let axis = |axis: usize, name, colour| {
            let point = |one: &Closure| (time.at(one.t_s), component(one, axis));
            dots(name, colour, run.after.iter().map(point).collect())
        };
        Panel {
            title: title.into(),
            x: time.label,
            y: y.into(),
            size: HALF,
            series: vec![axis(0, "x", BLUE), axis(1, "y", ORANGE), axis(2, "z", GREEN)],
            from_zero: false,
        }
        .draw()
    };
    let mut panels =
        vec![panel("Position, robot minus bar", "[µm]", &|one, axis| one.position_error_m[axis] * 1e6)?];
    if rotations {
        panels.push(panel("Rotation, robot minus bar", "[µrad]", &|one, axis| one.turned_rad[axis] * 1e6)?);
    }
    Ok(panels)
}

/// What is left, seen from each joint and by its direction of motion.
pub(in crate::report::page) fn by_joint(evidence: &Evidence) -> Result<Vec<String>, PlotError> {
    let panel = |joint: usize| {
        let side = |name, colour, forward: bool| {
            let seen = |gap: &&JointGap| (gap.qd_rad_s > 0.0) == forward;
            let point = |gap: &JointGap| (gap.q_rad.to_degrees(), gap.turn_rad * 1e6);
            dots(name, colour, evidence.joints[joint].iter().filter(seen).map(point).collect())
        };
        Panel {
            title: format!("Joint {}", joint + 1),
            x: "joint angle [deg]",
            y: "[µrad]".into(),
            size: THIRD,
            series: vec![side("forward", BLUE, true), side("back", ORANGE, false)],
            from_zero: false,
        }
    };
    (0..evidence.joints.len()).map(|joint| panel(joint).draw()).collect()
}

/// What becomes of the gap when one log is moved in time.
pub(in crate::report::page) fn shift(title: &str, curve: &ShiftCurve) -> Result<String, PlotError> {
    let points = curve.shift_s.iter().zip(&curve.rms_m).map(|(shift_s, rms_m)| (shift_s * 1e3, rms_m * 1e3));
    Panel {
        title: title.into(),
        x: "added time shift [ms]",
        y: "RMS distance [mm]".into(),
        size: THIRD,
        series: vec![Series::new("", BLUE, Mark::Line, points.collect())],
        from_zero: true,
    }
    .draw()
}

/// How the alignment varies along a run.
pub(in crate::report::page) fn local_shifts(shifts: &[LocalShift]) -> Result<String, PlotError> {
    let time = TimeAxis::of(shifts.iter().map(|shift| shift.t_s));
    let points = shifts.iter().map(|shift| (time.at(shift.t_s), shift.shift_s * 1e3));
    Panel {
        title: "Along the run".into(),
        x: time.label,
        y: "shift of 5 s parts [ms]".into(),
        size: THIRD,
        series: vec![dots("", BLUE, points.collect())],
        from_zero: false,
    }
    .draw()
}

/// One series of each run, named where there are several.
fn by_run(evidence: &Evidence, point: impl Fn(&Closure) -> (f64, f64)) -> Vec<Series> {
    let several = evidence.runs.len() > 1;
    let series = |(number, run): (usize, &RunEvidence)| {
        let name = if several { format!("run {}", number + 1) } else { String::new() };
        dots(name, COLOURS[number % COLOURS.len()], run.after.iter().map(&point).collect())
    };
    evidence.runs.iter().enumerate().map(series).collect()
}

/// Directions of the bar, seen from above: equal areas of the sphere are equal areas of the figure (Lambert).
pub(in crate::report::page) fn coverage(evidence: &Evidence) -> Result<String, PlotError> {
    /// Horizon as a polygon of so many corners.
    const CORNERS: usize = 90;
    let seen = |closure: &Closure| {
        let d = closure.direction;
        let across = (d.x * d.x + d.y * d.y).sqrt().max(1e-12);
        let radius = (1.0 - d.z).max(0.0).sqrt();
        (d.x / across * radius, d.y / across * radius)
    };
    let horizon = (0..=CORNERS).map(|corner| {
        let angle = std::f64::consts::TAU * corner as f64 / CORNERS as f64;
        (angle.cos(), angle.sin())
    });
    let mut series = vec![Series::new("horizon", GREY, Mark::Line, horizon.collect())];
    series.extend(by_run(evidence, seen));
    Panel {
        title: "Directions of the bar, from above".into(),
        x: "towards the robot's x",
        y: "towards y".into(),
        size: ROUND,
        series,
        from_zero: false,
    }
    .draw()
}

/// Distance from singular poses over time.
pub(in crate::report::page) fn margin(evidence: &Evidence) -> Result<String, PlotError> {
    let times = evidence.runs.iter().flat_map(|run| &run.after).map(|closure| closure.t_s);
    let time = TimeAxis::of(times);
    Panel {
        title: "Distance of the bar from a singular pose".into(),
        x: time.label,
        y: "[deg]".into(),
        size: ROUND,
        series: by_run(evidence, |one| (time.at(one.t_s), one.margin_rad.to_degrees())),
        from_zero: true,
    }
    .draw()
}
