//! Picture of a robot for `identify robot check`, seen from the side and from above. It shows the robot's axes, two postures,
//! and positions of the flange in random postures.

use nalgebra::Vector3;
use shared::config::JointKind;

use super::plot::{BLUE, GREEN, GREY, Mark, ORANGE, Panel, Series};
use crate::robot::RobotCheck;
use crate::statistics::extremes;

/// Length of the longer side of each view, without the labels of its axes \[px\].
const WIDTH_PX: f64 = 620.0;
/// Width and height that axis labels add to a view \[px\].
const LABELS_PX: (f64, f64) = (76.0, 100.0);
/// Length by which the drawing of an axis extends from the joint, as a fraction of the arm's reach. A revolute axis extends
/// to both sides of the joint, a prismatic axis to one side.
const AXIS_PART: f64 = 0.07;

/// Both views as one SVG.
pub fn picture(check: &RobotCheck) -> String {
    let (side, side_px) = view(check, "from the side", ["x [m]", "z [m]"], |p| (p.x, p.z));
    let (above, above_px) = view(check, "from above", ["x [m]", "y [m]"], |p| (p.x, p.y));
    let (width_px, height_px) = (side_px.0 + above_px.0, side_px.1.max(above_px.1));
    format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width_px}\" height=\"{height_px}\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n{}{}</svg>\n",
        placed(&side, 0, side_px),
        placed(&above, side_px.0, above_px)
    )
}

/// Embeds the SVG of a view into the picture, at this horizontal position.
fn placed(svg: &str, x_px: u32, (width_px, height_px): (u32, u32)) -> String {
    let inner = svg.split_once('>').map_or(svg, |(_, inner)| inner);
    let view = format!("0 0 {} {}", width_px * super::plot::FINE, height_px * super::plot::FINE);
    format!("<svg x=\"{x_px}\" width=\"{width_px}\" height=\"{height_px}\" viewBox=\"{view}\">{inner}")
}

/// One view as an SVG, with its width and height \[px\].
fn view(
    check: &RobotCheck,
    from: &str,
    axes: [&str; 2],
    project: fn(&Vector3<f64>) -> (f64, f64),
) -> (String, (u32, u32)) {
    let reach_m = check.reached_m.iter().map(|p| p.norm()).fold(0.0, f64::max);
    let reached = check.reached_m.iter().take(3000).map(project).collect();
    let mut series = vec![Series::new("flange, random postures", GREY, Mark::Dots, reached)];
    for ((name, points), colour) in check.postures.iter().zip([BLUE, GREEN]) {
        series.push(Series::new(*name, colour, Mark::Line, points.iter().map(project).collect()));
    }
    let ends = |(kind, point, along): &(JointKind, Vector3<f64>, Vector3<f64>)| {
        let half = along * AXIS_PART * reach_m;
        let from = if *kind == JointKind::Prismatic { *point } else { point - half };
        [from, point + half]
    };
    let lines = check.axes.iter().flat_map(ends);
    series.push(Series::new("axes at zero", ORANGE, Mark::Segments, lines.map(|p| project(&p)).collect()));
    // Both axes have the same scale.
    let span = |coordinate: fn(&(f64, f64)) -> f64| {
        let [low, high] = extremes(series.iter().flat_map(|one| &one.points).map(coordinate));
        (high - low).max(1e-3)
    };
    let (across_m, up_m) = (span(|p| p.0), span(|p| p.1));
    let scale = WIDTH_PX / across_m.max(up_m);
    let size = ((across_m * scale + LABELS_PX.0) as u32, (up_m * scale + LABELS_PX.1) as u32);
    let title = format!("{} {from}", check.facts.first().map_or("", |(_, name)| name));
    (Panel::new(title, axes, size, series).draw().into_string(), size)
}
