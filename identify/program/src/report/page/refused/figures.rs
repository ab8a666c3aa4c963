//! Figures on the page of a refused calibration: joints over time, and residuals of the encoders relative to the motion of
//! the robot. A red line marks the time of the problem.

use maud::Markup;
use plotters::prelude::RGBColor;

use crate::inspect::curves::JointTrace;
use crate::prepare::Deviations;
use crate::report::page::drawing::figures::{THIRD, TimeAxis, dots};
use crate::report::page::drawing::plot::{BLUE, COLOURS, Mark, ORANGE, Panel, Series};
use crate::statistics::extremes;

const RED: RGBColor = COLOURS[5];
/// A curve that gaps divide into more parts than this is drawn as dots.
const PARTS_MAX: usize = 200;

/// One figure for each joint of a log. `at_s` is the time of the problem, if it is known \[s\].
pub(super) fn joints(curves: &[JointTrace], at_s: Option<f64>) -> Vec<Markup> {
    let figure = |curve: &JointTrace| {
        let points = || curve.parts.iter().flatten();
        let time = TimeAxis::spanning(points().map(|(t_s, _)| *t_s));
        let at = |(t_s, value): &(f64, f64)| (time.at(*t_s), *value);
        let series = if curve.parts.len() > PARTS_MAX {
            vec![dots("", BLUE, points().map(at).collect())]
        } else {
            let line =
                |part: &Vec<(f64, f64)>| Series::new("", BLUE, Mark::Line, part.iter().map(at).collect());
            curve.parts.iter().map(line).collect()
        };
        panel(curve.name.clone(), &format!("[{}]", curve.unit), &time, series, at_s)
    };
    curves.iter().map(figure).collect()
}

/// Residuals of each encoder, and the time alignment along the run. The time of the problem is marked in all figures. A step
/// of one encoder alone is a slip. Steps of several encoders at the same time are a clock step.
pub(super) fn deviations(deviations: &Deviations, at_s: Option<f64>) -> Vec<Markup> {
    let samples = &deviations.samples;
    let time = TimeAxis::spanning(samples.iter().map(|(t_s, _)| *t_s));
    let measured = deviations.measured.iter().enumerate().filter(|(_, measured)| **measured);
    let of_joint = |joint: usize| {
        let points = samples.iter().map(|(t_s, error_rad)| (time.at(*t_s), error_rad[joint] * 1e3));
        panel(format!("b{}", joint + 1), "[mrad]", &time, vec![dots("", BLUE, points.collect())], at_s)
    };
    let mut panels: Vec<Markup> = measured.map(|(joint, _)| of_joint(joint)).collect();
    if !deviations.local_shifts.is_empty() {
        let points = deviations.local_shifts.iter().map(|shift| (time.at(shift.t_s), shift.shift_s * 1e3));
        let series = vec![dots("", ORANGE, points.collect())];
        panels.push(panel("Alignment".into(), "shift [ms]", &time, series, at_s));
    }
    panels
}

fn panel(title: String, y: &str, time: &TimeAxis, mut series: Vec<Series>, at_s: Option<f64>) -> Markup {
    series.extend(mark(time, at_s, &series));
    Panel::new(title, [&time.since_first(), y], THIRD, series).draw()
}

/// Vertical line at the time of the problem. `None` if the time is unknown or the figure is empty.
fn mark(time: &TimeAxis, at_s: Option<f64>, series: &[Series]) -> Option<Series> {
    let x = time.at(at_s?);
    let heights = series.iter().flat_map(|one| &one.points).map(|(_, y)| *y);
    let [low, high] = extremes(heights);
    (low <= high).then(|| Series::new("", RED, Mark::Segments, vec![(x, low), (x, high)]))
}
