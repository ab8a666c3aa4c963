//! Which figure shows what.

use plotters::prelude::*;

use super::plot::{BLUE, GREEN, GREY, Mark, ORANGE, Panel, PlotError, Series};
use crate::cost::Closure;
use crate::kinematics::ROBOT_JOINTS;
use crate::study::{Evidence, JointGap, ShiftCurve};

pub(super) const WIDE: (u32, u32) = (920, 250);
const HALF: (u32, u32) = (450, 270);
pub(super) const THIRD: (u32, u32) = (340, 230);
/// Axes of equal length once the labels have their room.
const ROUND: (u32, u32) = (450, 420);

pub(super) fn dots(name: &'static str, colour: RGBColor, points: Vec<(f64, f64)>) -> Series {
    Series { name, colour, mark: Mark::Dots, points }
}

/// Distance of robot and bar over time, nominal and calibrated.
pub(super) fn gap_over_time(evidence: &Evidence) -> Result<[String; 2], PlotError> {
    let gap_mm = |closure: &Closure| {
        1e3 * if evidence.by_encoders { closure.apart_m.norm() } else { closure.off_sphere_m.abs() }
    };
    let panel = |title: &str, colour, closures: &[Closure]| Panel {
        title: title.into(),
        x: "time from the middle of the run [s]",
        y: "distance [mm]".into(),
        size: WIDE,
        series: vec![dots("", colour, closures.iter().map(|one| (one.t_s, gap_mm(one))).collect())],
        from_zero: true,
    };
    Ok([
        panel("Nominal robot, the bar fitted to it", GREY, &evidence.before).draw()?,
        panel("Calibrated robot", BLUE, &evidence.after).draw()?,
    ])
}

/// Components of the calibrated gap over time.
pub(super) fn components_over_time(evidence: &Evidence) -> Result<[String; 2], PlotError> {
    let panel = |title: &str, y: &str, component: &dyn Fn(&Closure, usize) -> f64| {
        let axis = |axis: usize, name, colour| {
            dots(name, colour, evidence.after.iter().map(|one| (one.t_s, component(one, axis))).collect())
        };
        Panel {
            title: title.into(),
            x: "time from the middle of the run [s]",
            y: y.into(),
            size: HALF,
            series: vec![axis(0, "x", BLUE), axis(1, "y", ORANGE), axis(2, "z", GREEN)],
            from_zero: false,
        }
    };
    Ok([
        panel("Position, robot minus bar", "[um]", &|one, axis| one.apart_m[axis] * 1e6).draw()?,
        panel("Rotation, robot minus bar", "[urad]", &|one, axis| one.turned_rad[axis] * 1e6).draw()?,
    ])
}

/// What is left, seen from each joint and by its direction of motion.
pub(super) fn by_joint(evidence: &Evidence) -> Result<Vec<String>, PlotError> {
    let panel = |joint: usize| {
        let side = |name, colour, forward: bool| {
            let seen = |gap: &&JointGap| (gap.qd_rad_s > 0.0) == forward;
            let point = |gap: &JointGap| (gap.q_rad.to_degrees(), gap.turn_rad * 1e6);
            dots(name, colour, evidence.joints[joint].iter().filter(seen).map(point).collect())
        };
        Panel {
            title: format!("Joint {}", joint + 1),
            x: "joint angle [deg]",
            y: "[urad]".into(),
            size: THIRD,
            series: vec![side("forward", BLUE, true), side("back", ORANGE, false)],
            from_zero: false,
        }
    };
    (0..ROBOT_JOINTS).map(|joint| panel(joint).draw()).collect()
}

/// What becomes of the gap when one log is moved in time.
pub(super) fn shift(title: &str, curve: &ShiftCurve) -> Result<String, PlotError> {
    let points = curve.shift_s.iter().zip(&curve.rms_m).map(|(shift_s, rms_m)| (shift_s * 1e3, rms_m * 1e3));
    Panel {
        title: title.into(),
        x: "added time shift [ms]",
        y: "RMS distance [mm]".into(),
        size: HALF,
        series: vec![Series { name: "", colour: BLUE, mark: Mark::Line, points: points.collect() }],
        from_zero: true,
    }
    .draw()
}

/// Directions of the bar, seen from above: equal areas of the sphere are equal areas of the figure (Lambert).
pub(super) fn coverage(evidence: &Evidence) -> Result<String, PlotError> {
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
    Panel {
        title: "Directions of the bar, from above".into(),
        x: "towards the robot's x",
        y: "towards y".into(),
        size: ROUND,
        series: vec![
            Series { name: "horizon", colour: GREY, mark: Mark::Line, points: horizon.collect() },
            dots("samples", BLUE, evidence.after.iter().map(seen).collect()),
        ],
        from_zero: false,
    }
    .draw()
}

/// Distance from singular poses over time.
pub(super) fn margin(evidence: &Evidence) -> Result<String, PlotError> {
    let points = evidence.after.iter().map(|one| (one.t_s, one.margin_rad.to_degrees()));
    Panel {
        title: "Distance of the bar from a singular pose".into(),
        x: "time from the middle of the run [s]",
        y: "[deg]".into(),
        size: ROUND,
        series: vec![dots("", BLUE, points.collect())],
        from_zero: true,
    }
    .draw()
}

/// Correlations of the free parameters, blue together, orange against each other.
pub(super) fn correlations(evidence: &Evidence) -> String {
    /// Weaker ones are left white \[1\].
    const LEAST: f64 = 0.1;
    const CELL: usize = 12;
    const NAMES: usize = 84;
    let (names, rows) = &evidence.correlations;
    let side = NAMES + names.len() * CELL;
    let mut svg = format!("<svg viewBox=\"0 0 {side} {side}\" role=\"img\" aria-label=\"correlations\">");
    for (row, values) in rows.iter().enumerate() {
        let y = NAMES + row * CELL;
        let name = maud::html! { (names.get(row).map_or("", String::as_str)) }.into_string();
        let label = "font-size=\"9\" fill=\"#46505c\" font-family=\"system-ui, sans-serif\"";
        svg.push_str(&format!(
            "<text x=\"{}\" y=\"{}\" text-anchor=\"end\" {label}>{name}</text>",
            NAMES - 4,
            y + 9
        ));
        svg.push_str(&format!(
            "<text transform=\"translate({} {}) rotate(-90)\" {label}>{name}</text>",
            NAMES + row * CELL + 9,
            NAMES - 4
        ));
        for (column, value) in values.iter().enumerate().filter(|(_, value)| value.abs() > LEAST) {
            let colour = if *value > 0.0 { BLUE } else { ORANGE };
            svg.push_str(&format!(
                "<rect x=\"{}\" y=\"{y}\" width=\"{CELL}\" height=\"{CELL}\" fill=\"rgb({},{},{})\" fill-opacity=\"{:.2}\"/>",
                NAMES + column * CELL,
                colour.0,
                colour.1,
                colour.2,
                value.abs()
            ));
        }
    }
    svg.push_str("</svg>");
    svg
}
