//! Deviation from the sphere, and the force beside it: what the thesis measured in its section 5.3.

use maud::{Markup, html};
use plotters::style::RGBColor;

use super::runs;
use crate::evaluate::{Deviation, Elongation, OffSphere, SphereDeviation};
use crate::model::ParameterId;
use crate::report::page::Page;
use crate::report::page::drawing::figures::{HALF, TimeAxis, WIDE, dots};
use crate::report::page::drawing::plot::{BLUE, FONT, GREEN, GREY, Mark, ORANGE, Panel, PlotError, Series};
use crate::report::page::sections::svg;

/// Samples that a map shows, at most.
const DOTS_MAX: usize = 1500;

/// Each run by itself: another force, another place of the bar.
pub(in crate::report::page) fn section(page: &Page<'_>) -> Result<Markup, PlotError> {
    let mut all = Vec::new();
    for (sphere, name) in page.evidence.spheres.iter().zip(runs::names(page)) {
        all.push(of_run(sphere, name.as_ref())?);
    }
    Ok(html! { @for one in all { (one) } })
}

fn of_run(sphere: &SphereDeviation, name: Option<&String>) -> Result<Markup, PlotError> {
    let over_time = over_time(sphere)?;
    let elongation = sphere.elongation;
    let forces = elongation.map(|elongation| forces(&sphere.after, &elongation)).transpose()?;
    Ok(html! {
        (runs::title("Deviation from the sphere", name))
        (figures_of(sphere))
        @if let Some(elongation) = elongation { p { (sentence(&elongation)) } }
        figure {
            @for panel in over_time { (svg(panel)) }
            figcaption {
                "How much farther out the robot's end is than the bar would hold it if it were rigid. "
                @if elongation.is_some() { "Green: minus what the force explains." }
            }
        }
        figure {
            div.panels {
                (svg(map("Nominal robot", &sphere.before, |one| one.off_m)))
                (svg(map("Calibrated robot", &sphere.after, |one| one.off_m)))
            }
            figcaption {
                "The same over the part of the sphere where the bar was, from above, the robot's x to the right: blue inside, orange "
                "outside of it. Each map has its own scale. Regions of one colour are errors of the geometry or of the bar; a "
                "mixture of colours is noise, gears and forces."
            }
        }
        @if let Some(panels) = forces { figure {
            div.panels { @for panel in panels { (svg(panel)) } }
            figcaption { "The force as its log counts it, and the deviation of the calibrated robot beside it. The line is what the solve found." }
        } }
    })
}

fn um(metres: f64) -> String {
    let um = metres * 1e6;
    let decimals = match um {
        ..1.0 => 3,
        ..100.0 => 1,
        _ => 0,
    };
    format!("{um:.decimals$} µm")
}

fn figures_of(sphere: &SphereDeviation) -> Markup {
    let row = |name: &str, deviation: &Deviation| {
        html! { div.number {
            b { (um(deviation.rms_m)) }
            span { (name) ", RMS; median " (um(deviation.size_m.median)) ", 95 % below " (um(deviation.size_m.p95)) ", largest "
                (um(deviation.size_m.max)) }
        } }
    };
    html! {
        div.numbers {
            (row("nominal robot", &sphere.before))
            (row("calibrated robot", &sphere.after))
            @if sphere.elongation.is_some() {
                div.number {
                    b { (um(sphere.after.unexplained_rms_m)) }
                    span { "calibrated robot, RMS without what the force explains" }
                }
            }
        }
    }
}

fn sentence(elongation: &Elongation) -> Markup {
    let measured = &elongation.measured;
    let [low, high] = measured.range;
    let unit = measured.unit();
    html! {
        "Measured: " (measured.kind.describe()) " on the " (measured.clock.name()) "'s clock, "
        (format!("{low:.1} to {high:.1} {unit}")) " along the bar. Found: " b { (elongation.sentence()) } ". "
        @if measured.uncovered > 0 { (measured.uncovered) " samples without a force were left out. " }
        @if let Some(rms_nm) = measured.torque_rms_nm {
            "The force was taken from the joints' torques: gravity, friction, inertia and one force along the bar leave "
            (format!("{rms_nm:.2}")) " N m of them unexplained. "
        }
    }
}

fn over_time(sphere: &SphereDeviation) -> Result<[String; 2], PlotError> {
    let time = TimeAxis::of(sphere.after.samples.iter().map(|one| one.t_s));
    let series = |name: &str, colour, deviation: &Deviation, of: fn(&OffSphere) -> f64| {
        dots(name, colour, deviation.samples.iter().map(|one| (time.at(one.t_s), of(one) * 1e6)).collect())
    };
    let panel = |title: &str, series| Panel {
        title: title.into(),
        x: time.label,
        y: "off the sphere [µm]".into(),
        size: WIDE,
        series,
        from_zero: false,
    };
    let mut after = vec![series("rigid bar", BLUE, &sphere.after, |one| one.off_m)];
    if sphere.elongation.is_some() {
        after.push(series("force explained", GREEN, &sphere.after, |one| one.unexplained_m));
    }
    Ok([
        panel("Nominal robot, the bar fitted to it", vec![series("", GREY, &sphere.before, |one| one.off_m)])
            .draw()?,
        panel("Calibrated robot", after).draw()?,
    ])
}

/// The force over time, and the deviation against it.
fn forces(after: &Deviation, elongation: &Elongation) -> Result<[String; 2], PlotError> {
    let of_signs = elongation.parameter == ParameterId::BarPlay;
    let axis = if of_signs { "sign of the force" } else { "force along the bar [N]" };
    let samples = &after.samples;
    let time = TimeAxis::of(samples.iter().map(|one| one.t_s));
    let [low, high] = if of_signs { [-1.0, 1.0] } else { elongation.measured.range };
    let line = [low, high].map(|force| (force, elongation.value * force * 1e6));
    Ok([
        Panel {
            title: "Force".into(),
            x: time.label,
            y: axis.into(),
            size: HALF,
            series: vec![dots("", ORANGE, samples.iter().map(|one| (time.at(one.t_s), one.force)).collect())],
            from_zero: false,
        }
        .draw()?,
        Panel {
            title: "Calibrated robot".into(),
            x: axis,
            y: "off the sphere [µm]".into(),
            size: HALF,
            series: vec![
                dots("samples", BLUE, samples.iter().map(|one| (one.force, one.off_m * 1e6)).collect()),
                Series::new("bar", ORANGE, Mark::Line, line.into()),
            ],
            from_zero: false,
        }
        .draw()?,
    ])
}

/// The deviation by direction of the bar, seen from above: equal areas of the sphere are equal areas of the map (Lambert),
/// which shows the part where the bar was. Colours reach their full strength where 95 % of the samples are below.
fn map(title: &str, deviation: &Deviation, of: impl Fn(&OffSphere) -> f64) -> String {
    /// Steps of the scale.
    const STEPS: i32 = 10;
    let every = deviation.samples.len().div_ceil(DOTS_MAX).max(1);
    let shown = || deviation.samples.iter().step_by(every);
    let full_m = deviation.size_m.p95.max(f64::MIN_POSITIVE);
    let frame = Frame::around(shown().map(place));
    let mut text =
        format!("<svg viewBox=\"0 0 {SIDE} {}\" role=\"img\" aria-label=\"{title}\">", SIDE + 45.0);
    let label = |x: f64, y: f64, words: &str| {
        let style =
            format!("font-size=\"15\" fill=\"#46505c\" font-family=\"{FONT}\" text-anchor=\"middle\"");
        format!("<text x=\"{x}\" y=\"{y}\" {style}>{words}</text>")
    };
    text.push_str(&label(0.5 * SIDE, 20.0, title));
    text.push_str(&format!("<svg x=\"0\" y=\"{TOP}\" width=\"{SIDE}\" height=\"{}\">", SIDE - TOP));
    // The horizon, as far as it is in sight.
    let (x, y) = frame.at([0.0, 0.0]);
    text.push_str(&format!(
        "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{:.1}\" fill=\"none\" stroke=\"#d9dee5\" stroke-width=\"2\"/>",
        frame.scale
    ));
    // One path for all dots of a colour, the strongest on top.
    let step_of = |sample: &OffSphere| (of(sample) / full_m * f64::from(STEPS)).round() as i32;
    for step in (0..=STEPS).flat_map(|size| [-size, size]).skip(1) {
        let dots = shown().filter(|sample| step_of(sample).clamp(-STEPS, STEPS) == step);
        let path: String =
            dots.map(|sample| frame.at(place(sample))).map(|(x, y)| format!("M{x:.1} {y:.1}h0")).collect();
        let RGBColor(r, g, b) = colour(f64::from(step) / f64::from(STEPS));
        if !path.is_empty() {
            text.push_str(&format!(
                "<path d=\"{path}\" fill=\"none\" stroke=\"rgb({r},{g},{b})\" stroke-width=\"7\" stroke-linecap=\"round\"/>"
            ));
        }
    }
    text.push_str("</svg>");
    for step in -STEPS..=STEPS {
        let RGBColor(r, g, b) = colour(f64::from(step) / f64::from(STEPS));
        let x = 0.5 * SIDE + f64::from(step) * 8.0 - 4.0;
        let y = SIDE + 5.0;
        text.push_str(&format!(
            "<rect x=\"{x}\" y=\"{y}\" width=\"8\" height=\"10\" fill=\"rgb({r},{g},{b})\"/>"
        ));
    }
    text.push_str(&label(0.5 * SIDE - 84.0, SIDE + 35.0, &format!("-{}", um(full_m))));
    text.push_str(&label(0.5 * SIDE + 84.0, SIDE + 35.0, &format!("+{}", um(full_m))));
    text.push_str("</svg>");
    text
}

/// Width of a map, and where it begins below its title \[px\].
const SIDE: f64 = 450.0;
const TOP: f64 = 30.0;

/// Lambert's projection from above; the horizon is at radius one.
fn place(sample: &OffSphere) -> [f64; 2] {
    let d = sample.direction;
    let across = (d.x * d.x + d.y * d.y).sqrt().max(1e-12);
    let radius = (1.0 - d.z).max(0.0).sqrt();
    [d.x / across * radius, d.y / across * radius]
}

/// The part of the projection that a map shows.
struct Frame {
    middle: [f64; 2],
    /// Pixels per unit.
    scale: f64,
}

impl Frame {
    fn around(points: impl Iterator<Item = [f64; 2]>) -> Self {
        /// Part of the map that stays free on each side.
        const ROOM: f64 = 0.06;
        let empty = [[f64::INFINITY, f64::NEG_INFINITY]; 2];
        let range = points.fold(empty, |range, point| {
            std::array::from_fn(|axis| [range[axis][0].min(point[axis]), range[axis][1].max(point[axis])])
        });
        let width = range.map(|[low, high]| high - low).into_iter().fold(1e-3, f64::max);
        let middle = range.map(|[low, high]| if low <= high { 0.5 * (low + high) } else { 0.0 });
        Self { middle, scale: (1.0 - 2.0 * ROOM) * (SIDE - TOP) / width }
    }

    /// In the map \[px\].
    fn at(&self, point: [f64; 2]) -> (f64, f64) {
        let right = 0.5 * SIDE + (point[0] - self.middle[0]) * self.scale;
        (right, 0.5 * (SIDE - TOP) - (point[1] - self.middle[1]) * self.scale)
    }
}

/// From blue at -1 over light grey to orange at 1.
fn colour(part: f64) -> RGBColor {
    const MIDDLE: RGBColor = RGBColor(232, 235, 239);
    let (end, strength) = if part < 0.0 { (BLUE, -part) } else { (ORANGE, part) };
    let strength = strength.clamp(0.0, 1.0);
    let mixed =
        |from: u8, to: u8| (f64::from(from) + strength * (f64::from(to) - f64::from(from))).round() as u8;
    RGBColor(mixed(MIDDLE.0, end.0), mixed(MIDDLE.1, end.1), mixed(MIDDLE.2, end.2))
}
