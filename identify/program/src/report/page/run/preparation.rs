//! Section on the preparation of the two logs of a run. Its figures correspond to figures 5.2 to 5.4 of the thesis
//! (Brand and Nilsson 2016).

use maud::{Markup, html};

use super::readings;
use crate::kinematics::BAR_JOINTS;
use crate::prepare::{Prepared, SampleStatus, Timeline, TimelinePoint};
use crate::report::page::drawing::figures::{THIRD, TimeAxis, WIDE, dots};
use crate::report::page::drawing::plot::{BLUE, GREEN, GREY, Mark, ORANGE, Panel, Series};

/// Figures and tables of one run.
pub(in crate::report::page) fn section(prepared: &Prepared) -> Markup {
    let Prepared { timeline, measured, .. } = prepared;
    let joints = || (0..BAR_JOINTS).filter(|&joint| measured[joint]);
    html! {
        (readings::unwrapping(timeline))
        (readings::moving_average(timeline.averaged.as_ref()))
        (sphere(prepared))
        figure {
            (speeds(timeline))
            figcaption {
                "Speed of the fastest joint of robot and bar, on the bar's clock after the alignment. Both stand still together "
                (timeline.standstills.len()) " times, "
                (format!("{:.1}", timeline.standstills.iter().map(|one| one.duration_s()).sum::<f64>())) " s in all."
            }
        }
        figure {
            div.panels.three { @for joint in joints() { (angle_by_status(timeline, joint)) } }
            figcaption { "Joints of the bar: usable samples, and samples that were left out for one of the reasons below." }
        }
        figure {
            div.panels.three { @for joint in joints() { (residuals(timeline, joint)) } }
            figcaption {
                "Used samples of each joint minus the angles that the robot's log implies for the nominal robot and bar. Alignment "
                "and encoder offsets were estimated from these differences; they contain the errors of robot and bar."
            }
        }
        (encoders(prepared))
        (jitter(timeline))
        (statuses(prepared))
    }
}

fn time_axis(timeline: &Timeline) -> TimeAxis {
    TimeAxis::spanning(timeline.points.iter().map(|point| point.t_s))
}

/// Speed of the robot's and of the bar's fastest joint over time.
fn speeds(timeline: &Timeline) -> Markup {
    /// If the mean distance of points is larger than this, dots are drawn, because lines between the points
    /// would be misleading \[s\].
    const APART_S: f64 = 1.0;
    let time = time_axis(timeline);
    let span_s = match timeline.points.as_slice() {
        [first, .., last] => last.t_s - first.t_s,
        _ => 0.0,
    };
    let still =
        timeline.standstills.iter().flat_map(|one| [one.from_s, one.to_s].map(|t_s| (time.at(t_s), 0.0)));
    let is_sparse = span_s > APART_S * timeline.points.len() as f64;
    let mark = if is_sparse { Mark::Dots } else { Mark::Line };
    let line = |name, colour, speed: fn(&TimelinePoint) -> Option<f64>| {
        let point = |point: &TimelinePoint| Some((time.at(point.t_s), speed(point)?.to_degrees()));
        Series::new(name, colour, mark, timeline.points.iter().filter_map(point).collect())
    };
    let series = vec![
        line("bar", ORANGE, |point| point.bar_speed_rad_s),
        line("robot", BLUE, |point| point.robot_speed_rad_s),
        Series::new("both stand still", GREEN, Mark::Segments, still.collect()),
    ];
    Panel::new("Speed", [&time.label(), "fastest joint [deg/s]"], WIDE, series).with_zero().draw()
}

const fn is_usable(status: SampleStatus) -> bool {
    matches!(status, SampleStatus::Kept | SampleStatus::Thinned)
}

/// Angle of a bar joint over time, with a colour for usable samples and a colour for samples that were left out.
fn angle_by_status(timeline: &Timeline, joint: usize) -> Markup {
    let time = time_axis(timeline);
    let with_status = |name, colour, usable: bool| {
        let points = timeline.points.iter().filter(|point| is_usable(point.status) == usable);
        let angle =
            |point: &TimelinePoint| Some((time.at(point.t_s), point.measured_rad?[joint].to_degrees()));
        dots(name, colour, points.filter_map(angle).collect())
    };
    let series = vec![with_status("left out", GREY, false), with_status("usable", BLUE, true)];
    Panel::new(format!("b{}", joint + 1), [&time.label(), "[deg]"], THIRD, series).draw()
}

/// Measured minus predicted angle of a bar joint over time.
fn residuals(timeline: &Timeline, joint: usize) -> Markup {
    let time = time_axis(timeline);
    let used = timeline.points.iter().filter(|point| point.status == SampleStatus::Kept);
    let off = |point: &TimelinePoint| Some((time.at(point.t_s), point.off_rad()?[joint] * 1e3));
    let title = format!("b{}, measured minus predicted", joint + 1);
    let series = vec![dots("", ORANGE, used.filter_map(off).collect())];
    Panel::new(title, [&time.label(), "[mrad]"], THIRD, series).draw()
}

/// Position and length of the bar, estimated from the robot's positions alone.
fn sphere(prepared: &Prepared) -> Markup {
    let sphere = &prepared.sphere;
    let centre_m = sphere.centre_m;
    html! {
        p {
            b { "Sphere: " } (format!("{:.1}", 100.0 * sphere.inliers)) " % of the positions in the robot's log lie on a sphere of radius "
            (format!("{:.2}", sphere.radius_m * 1e3)) " mm about (" (format!("{:.4}, {:.4}, {:.4}", centre_m.x, centre_m.y, centre_m.z))
            ") m, " (format!("{:.2}", sphere.rms_m * 1e3)) " mm from it (RMS, nominal robot)."
        }
    }
}

/// Table of the encoders. It lists joint, direction and offset of each encoder, and how well the angles of the encoder fit
/// the motion of the robot.
fn encoders(prepared: &Prepared) -> Markup {
    let encoder_map = &prepared.encoder_map;
    let offset = |joint: u8| prepared.offsets.iter().find(|offset| offset.joint == joint);
    html! {
        @if !encoder_map.used.encoders.is_empty() { table {
            caption {
                "Encoders of the bar: joint by the recording, joint and direction by the motion, offset, and 1.48 times the "
                "median deviation from the motion of the robot, nominal and with all lengths and angles moved within their tolerances"
                @if !encoder_map.others.is_empty() { "; " (encoder_map.others.len()) " other orders or directions fit within the limit, worse" }
            }
            thead { tr {
                th { "recorded as" } th { "used as" } th.text { "" } th { "offset [deg]" } th { "nominal [mrad]" } th { "fitted [mrad]" }
            } }
            tbody { @for place in &encoder_map.used.encoders { tr {
                td { "b" (place.recorded_joint) }
                td { "b" (place.joint) }
                td.unit { @if place.reversed { "counts the other way" } @else { "counts as recorded" } }
                td { @if let Some(offset) = offset(place.joint) { (format!("{:.3}", offset.offset_rad.to_degrees())) } }
                td { (format!("{:.2}", place.spread_mrad)) }
                td { @if let Some(offset) = offset(place.joint) { (format!("{:.3}", offset.spread_rad * 1e3)) } }
            } } }
        } }
    }
}

/// Table of the jitter of each joint of both logs at standstill.
fn jitter(timeline: &Timeline) -> Markup {
    let jitter = &timeline.jitter;
    let rows = [("robot", jitter.robot_urad.to_vec()), ("bar", jitter.bar_urad.to_vec())];
    let of = if timeline.averaged.is_some() { " of the averages" } else { "" };
    let caption = format!("Jitter{of} at standstill, standard deviation about a straight line [µrad]");
    readings::by_joint(&caption, &rows)
}

/// Table of the number of samples with each status.
fn statuses(prepared: &Prepared) -> Markup {
    let count = |what, status| Some((what, prepared.counts.of(status)));
    let average = prepared.timeline.averaged.as_ref();
    let rows = [
        Some(("recorded", prepared.counts.recorded())),
        count("not valid", SampleStatus::Invalid),
        count("time did not increase", SampleStatus::TimeNotIncreasing),
        average.and_then(|_| count("too near to an end or a gap for the average", SampleStatus::NotAveraged)),
        count("other origin of the counters", SampleStatus::OtherOrigin),
        count("outside the robot's log", SampleStatus::Outside),
        count("near a singular pose", SampleStatus::Singular),
        count("do not fit those around them", SampleStatus::Outlier),
        count("standstill", SampleStatus::Standstill),
        count("more than wanted", SampleStatus::Thinned),
        prepared.force.and_then(|_| count("the force was not measured then", SampleStatus::NoForce)),
        count("used", SampleStatus::Kept),
    ];
    html! {
        table.narrow {
            caption { "Status of the samples" }
            tbody { @for (what, count) in rows.into_iter().flatten() { tr { td { (what) } td { (count) } } } }
        }
    }
}
