//! How the two logs were brought together: what the thesis drew as its figures 5.2 to 5.4.

use maud::{Markup, html};

use super::figures::{THIRD, TimeAxis, WIDE, dots};
use super::plot::{BLUE, GREEN, GREY, Mark, ORANGE, Panel, PlotError, Series};
use super::sections::svg;
use crate::kinematics::BAR_JOINTS;
use crate::prepare::{Fate, Prepared, SampleCounts, Timeline, TimelinePoint};

/// Figures and tables of one run.
pub(super) fn section(prepared: &Prepared) -> Result<Markup, PlotError> {
    let timeline = &prepared.timeline;
    let speeds = speeds(timeline)?;
    let trimmed = trimmed(timeline, &prepared.measured)?;
    Ok(html! {
        figure {
            (svg(speeds))
            figcaption {
                "Fastest joint of robot and bar, on the bar's clock after the alignment. Both stand still together "
                (timeline.standstills.len()) " times, "
                (format!("{:.1}", timeline.standstills.iter().map(|one| one.duration_s()).sum::<f64>())) " s in all."
            }
        }
        figure {
            div.panels.three { @for panel in trimmed { (svg(panel)) } }
            figcaption { "Joints of the bar: what was used, and what was left out for one of the reasons below." }
        }
        (jitter(timeline))
        (fates(&prepared.counts))
    })
}

fn time_axis(timeline: &Timeline) -> TimeAxis {
    TimeAxis::of(timeline.points.iter().map(|point| point.t_s))
}

/// Fastest joint of either log over time.
fn speeds(timeline: &Timeline) -> Result<String, PlotError> {
    /// Points further apart belong to different motions \[s\].
    const APART_S: f64 = 1.0;
    let time = time_axis(timeline);
    let span_s = match timeline.points.as_slice() {
        [first, .., last] => last.t_s - first.t_s,
        _ => 0.0,
    };
    let still =
        timeline.standstills.iter().flat_map(|one| [one.from_s, one.to_s].map(|t_s| (time.at(t_s), 0.0)));
    let far = span_s > APART_S * timeline.points.len() as f64;
    let mark = if far { Mark::Dots } else { Mark::Line };
    let line = |name, colour, speed: fn(&TimelinePoint) -> Option<f64>| {
        let point = |point: &TimelinePoint| Some((time.at(point.t_s), speed(point)?.to_degrees()));
        Series::new(name, colour, mark, timeline.points.iter().filter_map(point).collect())
    };
    Panel {
        title: "Speed".into(),
        x: time.label,
        y: "fastest joint [deg/s]".into(),
        size: WIDE,
        series: vec![
            line("bar", ORANGE, |point| point.bar_speed_rad_s),
            line("robot", BLUE, |point| point.robot_speed_rad_s),
            Series::new("both stand still", GREEN, Mark::Segments, still.collect()),
        ],
        from_zero: true,
    }
    .draw()
}

/// Angle of each measured joint over time, by what became of the samples.
fn trimmed(timeline: &Timeline, measured: &[bool; BAR_JOINTS]) -> Result<Vec<String>, PlotError> {
    let time = time_axis(timeline);
    let panel = |joint: usize| {
        let of = |name, colour, wanted: fn(Fate) -> bool| {
            let angle =
                |point: &TimelinePoint| Some((time.at(point.t_s), point.measured_rad?[joint].to_degrees()));
            let points = timeline.points.iter().filter(|point| wanted(point.fate)).filter_map(angle);
            dots(name, colour, points.collect())
        };
        let used = |fate| matches!(fate, Fate::Kept | Fate::Surplus);
        Panel {
            title: format!("b{}", joint + 1),
            x: time.label,
            y: "[deg]".into(),
            size: THIRD,
            series: vec![
                of("left out", GREY, |fate| !matches!(fate, Fate::Kept | Fate::Surplus)),
                of("usable", BLUE, used),
            ],
            from_zero: false,
        }
        .draw()
    };
    (0..BAR_JOINTS).filter(|&joint| measured[joint]).map(panel).collect()
}

fn jitter(timeline: &Timeline) -> Markup {
    let jitter = &timeline.jitter;
    let cell = |value: &Option<f64>| value.map_or_else(|| "–".to_owned(), |urad| format!("{urad:.2}"));
    let row = |what: &str, values: &[Option<f64>]| {
        html! {
            tr { td { (what) } @for value in values { td { (cell(value)) } } @for _ in values.len()..6 { td {} } }
        }
    };
    html! {
        table {
            caption { "Jitter at standstill, standard deviation about a straight line [urad]" }
            thead { tr { th { "joint" } @for joint in 1..=6 { th { (joint) } } } }
            tbody { (row("robot", &jitter.robot_urad)) (row("bar", &jitter.bar_urad)) }
        }
    }
}

/// The table of what became of all samples.
fn fates(counts: &SampleCounts) -> Markup {
    let rows = [
        ("recorded", counts.recorded),
        ("not valid on the bus", counts.invalid),
        ("time did not increase", counts.time_not_increasing),
        ("other origin of the counters", counts.other_origin),
        ("outside the robot's log", counts.outside_robot_log),
        ("near a singular pose", counts.singular),
        ("do not fit those around them", counts.outliers),
        ("standstill", counts.standstill),
        ("more than wanted", counts.surplus),
        ("used", counts.kept),
    ];
    html! {
        table.narrow {
            caption { "What became of the samples" }
            tbody { @for (what, count) in rows { tr { td { (what) } td { (count) } } } }
        }
    }
}
