//! Figures on the readings of a run: readings that were unwrapped, and the effect of the moving average, if it is configured.

use std::f64::consts::TAU;

use maud::{Markup, html};

use crate::logs::{Unwrapped, UnwrappedPoint};
use crate::prepare::{Averaged, AveragedJoints, AveragedPoint, Timeline};
use crate::report::page::drawing::figures::{HALF, TimeAxis, dots};
use crate::report::page::drawing::plot::{BLUE, GREY, Mark, ORANGE, Panel, Series};

/// Width and height of a panel \[px\]. The height is small, because a run may have eleven pairs of panels: five
/// encoders and six joints.
const PAIR_SIZE: (u32, u32) = (450, 170);
/// Readings with a longer period are drawn in turns, not degrees \[turns\].
const TURNS_MIN: f64 = 1.5;

/// Two figures for each reading that wrapped: the reading as in its file, and the continuous reading that was used.
pub(in crate::report::page) fn unwrapping(timeline: &Timeline) -> Markup {
    let unwrapped: Vec<&Unwrapped> =
        timeline.unwrapped_encoders.iter().chain(&timeline.unwrapped_joints).collect();
    if unwrapped.is_empty() {
        return html! {
            p { b { "Unwrapping: " } "no counter of the bar and no joint in the robot's log wrapped; nothing was to be unwrapped." }
        };
    }
    html! {
        p { b { "Unwrapping: " } "these readings wrapped during the run and were made continuous; the others did not wrap." }
        figure {
            div.panels { @for reading in &unwrapped { (pair(reading)) } }
            figcaption {
                "Left: as in the file. Right: as used. The section with the most wraps is shown. b: encoder of the bar by "
                "the joint that its file states, q: joint in the robot's log. "
                @for (index, reading) in unwrapped.iter().enumerate() {
                    @if index > 0 { "; " }
                    (reading.name) ": " (reading.wraps) @if reading.wraps == 1 { " time" } @else { " times" }
                    ", largest step " (percent(reading.step_part)) " of the largest that can be unwrapped"
                }
                "."
            }
        }
    }
}

fn percent(part: f64) -> String {
    if part < 1e-3 { "less than 0.1 %".into() } else { format!("{:.1} %", 100.0 * part) }
}

/// Two figures of a reading over time: as in the file, and continuous.
fn pair(reading: &Unwrapped) -> Markup {
    let time = TimeAxis::spanning(reading.points.iter().map(|point| point.t_s));
    let panel = |title: &str, unit: &str, scale: f64, colour, angle_rad: fn(&UnwrappedPoint) -> f64| {
        let points = reading.points.iter().map(|point| (time.at(point.t_s), angle_rad(point) * scale));
        let series = vec![Series::new("", colour, Mark::Line, points.collect())];
        Panel::new(format!("{} {title}", reading.name), [&time.since_first(), unit], PAIR_SIZE, series).draw()
    };
    let degrees = 1f64.to_degrees();
    let in_turns = reading.period_rad > TURNS_MIN * TAU;
    let (unit, scale) = if in_turns { ("counter [turns]", TAU.recip()) } else { ("[deg]", degrees) };
    html! {
        (panel("in the file", unit, scale, GREY, |point| point.shown_rad))
        (panel("continuous", "[deg]", degrees, BLUE, |point| point.continuous_rad))
    }
}

/// Section on the effect of the moving average, or a note that no moving average is configured.
pub(in crate::report::page) fn moving_average(averaged: Option<&Averaged>) -> Markup {
    let Some(averaged) = averaged else {
        return html! {
            p {
                b { "Moving average: " } "off (default): the cost contains the noise of the angles. "
                code { "prepare.moving_average_ms" } " switches it on, for both logs alike."
            }
        };
    };
    let width_ms = averaged.width_s * 1e3;
    html! {
        p {
            b { "Moving average: " } "both logs were averaged over " (format!("{width_ms:.0}")) " ms, centred and in the same way. "
            "The mean of a curved motion lies inside the curve. This bias was estimated from the mean over twice the time, and corrected. "
            "Readings nearer than " (format!("{width_ms:.0}")) " ms to an end or a gap were left out."
        }
        figure {
            div.panels {
                (excerpt("Robot, q", &averaged.robot, BLUE))
                (excerpt("Bar, b", &averaged.bar, ORANGE))
            }
            figcaption {
                "The fastest joint of each log around its fastest moment. Left: its speed from the readings (grey) and from the "
                "averages. Right: reading minus average: noise. A wave is motion that is too fast for this width: samples there fit worse, "
                "and a shorter average is better."
            }
        }
        (removed_table(averaged))
    }
}

/// Two figures of the fastest joint of a log over time. The first figure shows the speed of the joint, computed from
/// readings and from averages. The second figure shows the difference between readings and averages.
fn excerpt(name: &str, joints: &AveragedJoints, colour: plotters::style::RGBColor) -> Markup {
    let points = &joints.fastest;
    let time = TimeAxis::spanning(points.iter().map(|point| point.t_s));
    let curve = |value: fn(&AveragedPoint) -> f64| -> Vec<(f64, f64)> {
        points.iter().map(|point| (time.at(point.t_s), value(point))).collect()
    };
    let panel = |title: &str, y: &str, series| {
        let title = format!("{name}{}: {title}", joints.fastest_joint);
        Panel::new(title, [&time.label(), y], HALF, series).draw()
    };
    let speeds = vec![
        dots("read", GREY, curve(|point| point.speed_rad_s.to_degrees())),
        Series::new("averaged", colour, Mark::Line, curve(|point| point.averaged_rad_s.to_degrees())),
    ];
    let removed = vec![dots("", colour, curve(|point| point.removed_rad * 1e6))];
    html! { (panel("speed", "[deg/s]", speeds)) (panel("reading minus average", "[µrad]", removed)) }
}

/// Table of the RMS difference between reading and average for each joint, at standstill and in motion.
fn removed_table(averaged: &Averaged) -> Markup {
    let rows = [
        ("robot, at standstill", &averaged.robot.still_rad),
        ("robot, moving", &averaged.robot.moving_rad),
        ("bar, at standstill", &averaged.bar.still_rad),
        ("bar, moving", &averaged.bar.moving_rad),
    ];
    let in_urad = |values: &[Option<f64>]| values.iter().map(|value| value.map(|rad| rad * 1e6)).collect();
    let rows = rows.map(|(what, values)| (what, in_urad(values)));
    by_joint("Reading minus average, RMS [µrad]", &rows)
}

/// A table with one row for each name and one column for each joint. The longest row determines the number of columns. `None`
/// is shown as a dash.
pub(in crate::report::page) fn by_joint(caption: &str, rows: &[(&str, Vec<Option<f64>>)]) -> Markup {
    let cell = |value: &Option<f64>| value.map_or_else(|| "–".to_owned(), |value| format!("{value:.2}"));
    let joints = rows.iter().map(|(_, values)| values.len()).max().unwrap_or_default();
    html! {
        table {
            caption { (caption) }
            thead { tr { th { "joint" } @for joint in 1..=joints { th { (joint) } } } }
            tbody {
                @for (name, values) in rows {
                    tr { td { (name) } @for value in values { td { (cell(value)) } } @for _ in values.len()..joints { td {} } }
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_by_joint_has_a_column_for_each_axis_of_the_robot() {
        for axes in [2, 6, 8] {
            let rows = [("robot", vec![Some(1.0); axes]), ("bar", vec![None; axes.min(5)])];
            let table = by_joint("Jitter", &rows).into_string();
            let cells: Vec<usize> =
                table.split("<tr>").skip(1).map(|row| row.matches("<t").count()).collect();
            assert_eq!(cells[1..], [axes + 1; 2], "{table}");
            assert!(table.contains(&format!("<th>{axes}</th></tr>")), "{table}");
        }
    }
}
