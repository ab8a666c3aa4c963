//! Readings made continuous, and averaged if this is configured.

use std::f64::consts::TAU;

use maud::{Markup, html};

use crate::logs::{Unwrapped, UnwrappedPoint};
use crate::prepare::{Averaged, AveragedJoints, AveragedPoint, Timeline};
use crate::report::page::drawing::figures::{HALF, TimeAxis, dots};
use crate::report::page::drawing::plot::{BLUE, GREY, Mark, ORANGE, Panel, PlotError, Series};

/// Lower than others: a run may have eleven pairs of them.
const LOW: (u32, u32) = (450, 170);
/// A longer period is shown in turns, not degrees \[turns\].
const TURNS_MIN: f64 = 1.5;

/// Readings as they were shown and as they were used.
pub(in crate::report::page) fn unwrapping(timeline: &Timeline) -> Result<Markup, PlotError> {
    let unwrapped: Vec<&Unwrapped> =
        timeline.unwrapped_encoders.iter().chain(&timeline.unwrapped_joints).collect();
    if unwrapped.is_empty() {
        return Ok(html! {
            p { b { "Unwrapping: " } "no counter of the bar and no joint in the robot's log began anew; nothing was to be unwrapped." }
        });
    }
    Ok(html! {
        p { b { "Unwrapping: " } "these began anew while the logs were taken, and were made continuous; all others never did." }
        figure {
            div.panels { @for one in &unwrapped { (pair(one)?) } }
            figcaption {
                "Left as the file shows them, right as they are used, where they begin anew most often; b: encoder of the bar by "
                "the joint that its file states, q: joint in the robot's log. "
                @for (index, one) in unwrapped.iter().enumerate() {
                    @if index > 0 { "; " }
                    (one.name) ": " (one.wraps) @if one.wraps == 1 { " time" } @else { " times" }
                    ", largest step " (percent(one.step_part)) " of what can be followed"
                }
                "."
            }
        }
    })
}

fn percent(part: f64) -> String {
    match 100.0 * part {
        percent if percent < 0.1 => "less than 0.1 %".into(),
        percent => format!("{percent:.1} %"),
    }
}

fn pair(one: &Unwrapped) -> Result<Markup, PlotError> {
    let time = TimeAxis::of(one.points.iter().map(|point| point.t_s));
    let panel = |title: &str, unit: &str, scale: f64, colour, of: fn(&UnwrappedPoint) -> f64| {
        let points = one.points.iter().map(|point| (time.at(point.t_s), of(point) * scale));
        let series = vec![Series::new("", colour, Mark::Line, points.collect())];
        Panel::new(format!("{} {title}", one.name), [&time.since_first(), unit], LOW, series).draw()
    };
    let degrees = 1f64.to_degrees();
    let in_turns = one.period_rad > TURNS_MIN * TAU;
    let (unit, scale) = if in_turns { ("counter [turns]", TAU.recip()) } else { ("[deg]", degrees) };
    Ok(html! {
        (panel("as shown", unit, scale, GREY, |point| point.shown_rad)?)
        (panel("continuous", "[deg]", degrees, BLUE, |point| point.continuous_rad)?)
    })
}

/// What the moving average did; that it is off, and why, where it is.
pub(in crate::report::page) fn moving_average(averaged: Option<&Averaged>) -> Result<Markup, PlotError> {
    let Some(averaged) = averaged else {
        return Ok(html! {
            p {
                b { "Moving average: " } "off, as usual: the cost knows the noise of the angles and weighs it. "
                code { "prepare.moving_average_ms" } " switches it on, for both logs alike."
            }
        });
    };
    let width_ms = averaged.width_s * 1e3;
    Ok(html! {
        p {
            b { "Moving average: " } "both logs were averaged over " (format!("{width_ms:.0}")) " ms, centred and in the same way. "
            "A mean of a curved motion lies inside the curve; by how much is known from the mean over twice the time, and was given back. "
            "Readings nearer than " (format!("{width_ms:.0}")) " ms to an end or a hole were left out."
        }
        figure {
            div.panels {
                (excerpt("Robot, q", &averaged.robot, BLUE)?)
                (excerpt("Bar, b", &averaged.bar, ORANGE)?)
            }
            figcaption {
                "The fastest joint of each log about its fastest moment. Left: its speed from the readings (grey) and from the "
                "averages. Right: what the average took from its angle: noise. Waves are turns too sharp for it: samples there fit worse, "
                "and a shorter average is better."
            }
        }
        (removed(averaged))
    })
}

/// Speed before and after, and what was taken from the angle.
fn excerpt(
    name: &str,
    joints: &AveragedJoints,
    colour: plotters::style::RGBColor,
) -> Result<Markup, PlotError> {
    let points = &joints.fastest;
    let time = TimeAxis::of(points.iter().map(|point| point.t_s));
    let of = |value: fn(&AveragedPoint) -> f64| -> Vec<(f64, f64)> {
        points.iter().map(|point| (time.at(point.t_s), value(point))).collect()
    };
    let panel = |title: &str, y: &str, series| {
        let title = format!("{name}{}: {title}", joints.fastest_joint);
        Panel::new(title, [&time.label(), y], HALF, series).draw()
    };
    let speeds = vec![
        dots("read", GREY, of(|point| point.speed_rad_s.to_degrees())),
        Series::new("averaged", colour, Mark::Line, of(|point| point.averaged_rad_s.to_degrees())),
    ];
    let removed = vec![dots("", colour, of(|point| point.removed_rad * 1e6))];
    Ok(html! { (panel("speed", "[deg/s]", speeds)?) (panel("taken from the angle", "[µrad]", removed)?) })
}

fn removed(averaged: &Averaged) -> Markup {
    let rows = [
        ("robot, at standstill", &averaged.robot.still_rad),
        ("robot, moving", &averaged.robot.moving_rad),
        ("bar, at standstill", &averaged.bar.still_rad),
        ("bar, moving", &averaged.bar.moving_rad),
    ];
    let in_urad = |values: &[Option<f64>]| values.iter().map(|value| value.map(|rad| rad * 1e6)).collect();
    let rows = rows.map(|(what, values)| (what, in_urad(values)));
    by_joint("What the average took from the angles, RMS [µrad]", &rows)
}

/// A table with a column for each joint.
pub(in crate::report::page) fn by_joint(caption: &str, rows: &[(&str, Vec<Option<f64>>)]) -> Markup {
    let cell = |value: &Option<f64>| value.map_or_else(|| "–".to_owned(), |urad| format!("{urad:.2}"));
    html! {
        table {
            caption { (caption) }
            thead { tr { th { "joint" } @for joint in 1..=6 { th { (joint) } } } }
            tbody {
                @for (what, values) in rows {
                    tr { td { (what) } @for value in values { td { (cell(value)) } } @for _ in values.len()..6 { td {} } }
                }
            }
        }
    }
}
