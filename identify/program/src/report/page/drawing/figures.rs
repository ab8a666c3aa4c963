//! Figures of `report.html` about runs with a bar, each made from the evidence of a calibration. The module also contains
//! elements that several pages use: sizes of figures, time axes, and maps of directions.

use maud::Markup;
use nalgebra::Vector3;
use plotters::prelude::RGBColor;
use shared::config::JointKind;

use super::plot::{BLUE, COLOURS, GREEN, GREY, Mark, ORANGE, Panel, Series};
use crate::cost::Closure;
use crate::evaluate::{Evidence, JointGap, RunEvidence, ShiftCurve};
use crate::kinematics::Chain;
use crate::prepare::LocalShift;
use crate::statistics::extremes;

/// Width and height of a figure that takes up the whole width of the page, half of it, or a third of it \[px\].
pub(in crate::report::page) const WIDE: (u32, u32) = (920, 250);
pub(in crate::report::page) const HALF: (u32, u32) = (450, 270);
pub(in crate::report::page) const THIRD: (u32, u32) = (340, 230);
/// Width and height of a figure with square axes, including the labels \[px\].
pub(in crate::report::page) const ROUND: (u32, u32) = (450, 444);

/// A series that is drawn as dots.
pub(in crate::report::page) fn dots(
    name: impl Into<String>,
    colour: RGBColor,
    points: Vec<(f64, f64)>,
) -> Series {
    Series::new(name, colour, Mark::Dots, points)
}

/// A time axis in the unit that suits the duration of a run.
#[derive(Debug, Clone, Copy)]
pub(in crate::report::page) struct TimeAxis {
    /// Length of the unit \[s\].
    seconds: f64,
    /// `s`, `min` or `h`.
    pub unit: &'static str,
}

impl TimeAxis {
    /// The axis for all of these times.
    pub fn spanning(times_s: impl Iterator<Item = f64>) -> Self {
        /// Longest range of times that is displayed in seconds, and in minutes \[s\].
        const SECONDS_MAX: f64 = 900.0;
        const MINUTES_MAX: f64 = 3.0 * 3600.0;
        let [low, high] = extremes(times_s);
        let (seconds, unit) = match high - low {
            span_s if span_s > MINUTES_MAX => (3600.0, "h"),
            span_s if span_s > SECONDS_MAX => (60.0, "min"),
            _ => (1.0, "s"),
        };
        Self { seconds, unit }
    }

    fn of_run(run: &RunEvidence) -> Self {
        Self::spanning(run.after.iter().map(|closure| closure.t_s))
    }

    /// Label of the axis for times that count from the middle of the run.
    pub fn label(&self) -> String {
        format!("time from the middle of the run [{}]", self.unit)
    }

    /// Label of the axis for times that count from the first reading.
    pub fn since_first(&self) -> String {
        format!("time from the first reading [{}]", self.unit)
    }

    /// Converts seconds to the unit of the axis.
    pub fn at(&self, t_s: f64) -> f64 {
        t_s / self.seconds
    }
}

/// Projects a direction to the plane, as seen from above. The projection preserves areas (Lambert), so equal areas of the
/// sphere are equal areas of the figure. The horizon has radius one.
pub(in crate::report::page) fn from_above(direction: &Vector3<f64>) -> (f64, f64) {
    let across = direction.x.hypot(direction.y).max(1e-12);
    let radius = (1.0 - direction.z).max(0.0).sqrt();
    (direction.x / across * radius, direction.y / across * radius)
}

/// Map of directions as seen from above, with the horizon.
pub(in crate::report::page) fn sphere_from_above(
    title: &str,
    series: impl IntoIterator<Item = Series>,
) -> Markup {
    /// Number of corners of the polygon that is drawn as horizon.
    const CORNERS: usize = 90;
    let corner = |corner: usize| (std::f64::consts::TAU * corner as f64 / CORNERS as f64).sin_cos();
    let horizon = Series::new("horizon", GREY, Mark::Line, (0..=CORNERS).map(corner).collect());
    let series = [horizon].into_iter().chain(series).collect();
    Panel::new(title, ["towards the robot's x", "towards y"], ROUND, series).draw()
}

/// Distance between robot and bar over time, with the nominal and the calibrated robot;
/// `by_encoders` as in [`Closure::gap_m`].
pub(in crate::report::page) fn gap_over_time(run: &RunEvidence, by_encoders: bool) -> [Markup; 2] {
    let time = TimeAxis::of_run(run);
    let point = |one: &Closure| (time.at(one.t_s), 1e3 * one.gap_m(by_encoders));
    let panel = |title: &str, colour, closures: &[Closure]| {
        let series = vec![dots("", colour, closures.iter().map(point).collect())];
        Panel::new(title, [&time.label(), "distance [mm]"], WIDE, series).with_zero().draw()
    };
    [
        panel("Nominal robot, the bar fitted to it", GREY, &run.before),
        panel("Calibrated robot", BLUE, &run.after),
    ]
}

/// Components of the difference between calibrated robot and bar over time: position, and rotation if it was measured.
pub(in crate::report::page) fn components_over_time(run: &RunEvidence, rotations: bool) -> Vec<Markup> {
    let time = TimeAxis::of_run(run);
    let panel = |title: &str, y: &str, component: &dyn Fn(&Closure, usize) -> f64| {
        let axis = |axis: usize, name, colour| {
            let point = |one: &Closure| (time.at(one.t_s), component(one, axis));
            dots(name, colour, run.after.iter().map(point).collect())
        };
        let series = vec![axis(0, "x", BLUE), axis(1, "y", ORANGE), axis(2, "z", GREEN)];
        Panel::new(title, [&time.label(), y], HALF, series).draw()
    };
    let mut panels =
        vec![panel("Position, robot minus bar", "[µm]", &|one, axis| one.position_error_m[axis] * 1e6)];
    if rotations {
        panels.push(panel("Rotation, robot minus bar", "[µrad]", &|one, axis| one.turned_rad[axis] * 1e6));
    }
    panels
}

/// Residuals over the position of each robot joint, with a colour for each direction of motion.
pub(in crate::report::page) fn by_joint(evidence: &Evidence, robot: &Chain) -> Vec<Markup> {
    let panel = |(joint, (gaps, kind)): (usize, (&Vec<JointGap>, JointKind))| {
        let in_direction = |name, colour, forward: bool| {
            let is_wanted = |gap: &&JointGap| (gap.qd > 0.0) == forward;
            let point = |gap: &JointGap| (gap.q * kind.display_factor(), gap.motion * 1e6);
            dots(name, colour, gaps.iter().filter(is_wanted).map(point).collect())
        };
        let series = vec![in_direction("forward", BLUE, true), in_direction("back", ORANGE, false)];
        let labels = match kind {
            JointKind::Revolute => ["joint angle [deg]", "[µrad]"],
            JointKind::Prismatic => ["joint position [mm]", "[µm]"],
        };
        Panel::new(format!("Joint {}", joint + 1), labels, THIRD, series).draw()
    };
    evidence.joints.iter().zip(robot.joint_kinds()).enumerate().map(panel).collect()
}

/// RMS distance between robot and bar as a function of an additional time shift between the two logs.
pub(in crate::report::page) fn shift(title: &str, curve: &ShiftCurve) -> Markup {
    let points = curve.shift_s.iter().zip(&curve.rms_m).map(|(shift_s, rms_m)| (shift_s * 1e3, rms_m * 1e3));
    let series = vec![Series::new("", BLUE, Mark::Line, points.collect())];
    Panel::new(title, ["added time shift [ms]", "RMS distance [mm]"], THIRD, series).with_zero().draw()
}

/// Figure of the time shift between the logs over time. Each point is the shift in a short part of the run.
pub(in crate::report::page) fn local_shifts(shifts: &[LocalShift]) -> Markup {
    let time = TimeAxis::spanning(shifts.iter().map(|shift| shift.t_s));
    let points = shifts.iter().map(|shift| (time.at(shift.t_s), shift.shift_s * 1e3));
    let series = vec![dots("", BLUE, points.collect())];
    Panel::new("Along the run", [&time.label(), "shift of 5 s parts [ms]"], THIRD, series).draw()
}

/// One series for each run. The series have names if there are several runs.
fn by_run(evidence: &Evidence, point: impl Fn(&Closure) -> (f64, f64)) -> Vec<Series> {
    let several = evidence.runs.len() > 1;
    let series = |(number, run): (usize, &RunEvidence)| {
        let name = if several { format!("run {}", number + 1) } else { String::new() };
        dots(name, COLOURS[number % COLOURS.len()], run.after.iter().map(&point).collect())
    };
    evidence.runs.iter().enumerate().map(series).collect()
}

/// Directions of the bar, as seen from above.
pub(in crate::report::page) fn coverage(evidence: &Evidence) -> Markup {
    let series = by_run(evidence, |one| from_above(&one.direction));
    sphere_from_above("Directions of the bar, from above", series)
}

/// Distance of the bar from singular poses over time.
pub(in crate::report::page) fn margin(evidence: &Evidence) -> Markup {
    let times = evidence.runs.iter().flat_map(|run| &run.after).map(|closure| closure.t_s);
    let time = TimeAxis::spanning(times);
    let series = by_run(evidence, |one| (time.at(one.t_s), one.margin_rad.to_degrees()));
    let title = "Distance of the bar from a singular pose";
    Panel::new(title, [&time.label(), "[deg]"], ROUND, series).with_zero().draw()
}
