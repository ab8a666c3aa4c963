//! Section on the deviation of the robot's end from the sphere of a rigid bar, over time and by direction, and on the force
//! on the bar. It corresponds to section 5.3 of the thesis (Brand and Nilsson 2016).

use maud::{Markup, html};
use plotters::style::RGBColor;

use super::runs;
use crate::evaluate::{Elongation, ModelDeviation, OffSphere, SphereDeviation};
use crate::model::ParameterId;
use crate::report::page::Page;
use crate::report::page::drawing::figures::{HALF, TimeAxis, WIDE, dots, from_above, sphere_from_above};
use crate::report::page::drawing::plot::{BLUE, GREEN, GREY, Mark, ORANGE, Panel, Series};
use crate::report::page::sections::number;
use crate::statistics::Sizes;

/// Largest number of samples in a map.
const DOTS_MAX: usize = 1500;

/// One section for each run, because runs differ in force and position of the bar.
pub(in crate::report::page) fn section(page: &Page<'_>) -> Markup {
    html! { @for (sphere, name) in page.evidence.spheres.iter().zip(runs::names(page)) {
        (runs::title("Deviation from the sphere", name.as_ref()))
        (of_run(sphere))
    } }
}

/// Figures of one run.
fn of_run(sphere: &SphereDeviation) -> Markup {
    let elongation = sphere.elongation;
    html! {
        (error_numbers(sphere))
        @if let Some(elongation) = elongation { p { (force_text(&elongation)) } }
        figure {
            (deviation_over_time(sphere))
            figcaption {
                "Distance of the robot's end from the centre of the gimbal, minus the length of the bar if it were rigid. "
                @if elongation.is_some() { "Green: minus the elongation by the force." }
            }
        }
        figure {
            div.panels {
                (sphere_map("Nominal robot", &sphere.before))
                (sphere_map("Calibrated robot", &sphere.after))
            }
            figcaption {
                "The same over the part of the sphere where the bar was, from above, the robot's x to the right: blue inside, orange "
                "outside of it. Each map has its own scale. Regions of one colour are errors of the geometry or of the bar; a "
                "mixture of colours is noise, gears and forces."
            }
        }
        @if let Some(elongation) = elongation { figure {
            div.panels { (forces(&sphere.after, &elongation)) }
            figcaption { "The force with the sign of its log, and the deviation of the calibrated robot over it. The line is the estimated elongation." }
        } }
    }
}

/// A length in micrometres, as text.
fn um(metres: f64) -> String {
    let um = metres * 1e6;
    let decimals = match um {
        ..1.0 => 3,
        ..100.0 => 1,
        _ => 0,
    };
    format!("{um:.decimals$} µm")
}

/// RMS and quantiles of the deviations as large numbers.
fn error_numbers(sphere: &SphereDeviation) -> Markup {
    let row = |name: &str, deviation: &ModelDeviation| {
        let Sizes { rms, median, p95, max, .. } = deviation.size_m;
        let [median, p95, max] = [median, p95, max].map(um);
        let label = format!("{name}, RMS; median {median}, 95 % below {p95}, largest {max}");
        number(um(rms), label)
    };
    html! {
        div.numbers {
            (row("nominal robot", &sphere.before))
            (row("calibrated robot", &sphere.after))
            @if sphere.elongation.is_some() {
                @let label = "calibrated robot, RMS without the elongation by the force";
                (number(um(sphere.after.unexplained_rms_m), label))
            }
        }
    }
}

/// The force and the estimated elongation as text.
fn force_text(elongation: &Elongation) -> Markup {
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

/// Deviations of the nominal and the calibrated robot over time.
fn deviation_over_time(sphere: &SphereDeviation) -> Markup {
    let time = TimeAxis::spanning(sphere.after.samples.iter().map(|one| one.t_s));
    let series = |name: &str, colour, deviation: &ModelDeviation, off_m: fn(&OffSphere) -> f64| {
        let point = |sample: &OffSphere| (time.at(sample.t_s), off_m(sample) * 1e6);
        dots(name, colour, deviation.samples.iter().map(point).collect())
    };
    let panel =
        |title: &str, series| Panel::new(title, [&time.label(), "off the sphere [µm]"], WIDE, series).draw();
    let mut after = vec![series("rigid bar", BLUE, &sphere.after, |one| one.off_m)];
    if sphere.elongation.is_some() {
        after.push(series("force explained", GREEN, &sphere.after, |one| one.unexplained_m));
    }
    let before = vec![series("", GREY, &sphere.before, |one| one.off_m)];
    html! { (panel("Nominal robot, the bar fitted to it", before)) (panel("Calibrated robot", after)) }
}

/// Two figures: the force over time, and the deviation from the sphere over the force. The line in the second figure is the
/// estimated elongation: compliance \[m/N\] times force \[N\], or half of the play \[m\] times the sign of the force.
fn forces(after: &ModelDeviation, elongation: &Elongation) -> Markup {
    // Play is identified from the sign of the force alone.
    let has_only_signs = elongation.parameter == ParameterId::BarPlay;
    let axis = if has_only_signs { "sign of the force" } else { "force along the bar [N]" };
    let samples = &after.samples;
    let time = TimeAxis::spanning(samples.iter().map(|one| one.t_s));
    let [low, high] = if has_only_signs { [-1.0, 1.0] } else { elongation.measured.range };
    let line = [low, high].map(|force| (force, elongation.value * force * 1e6));
    let force = dots("", ORANGE, samples.iter().map(|one| (time.at(one.t_s), one.force)).collect());
    let off = dots("samples", BLUE, samples.iter().map(|one| (one.force, one.off_m * 1e6)).collect());
    let bar = Series::new("bar", ORANGE, Mark::Line, line.into());
    html! {
        (Panel::new("Force", [&time.label(), axis], HALF, vec![force]).draw())
        (Panel::new("Calibrated robot", [axis, "off the sphere [µm]"], HALF, vec![off, bar]).draw())
    }
}

/// Map of the deviation by direction of the bar, as seen from above. Colours are strongest at the 95 %
/// quantile of the deviations.
fn sphere_map(title: &str, deviation: &ModelDeviation) -> Markup {
    /// Number of colours for each sign.
    const STEPS: i32 = 10;
    let every = deviation.samples.len().div_ceil(DOTS_MAX).max(1);
    let full_m = deviation.size_m.p95.max(f64::MIN_POSITIVE);
    let step_of = |sample: &OffSphere| (sample.off_m / full_m * f64::from(STEPS)).round() as i32;
    let series = |step: i32| {
        let shown = deviation.samples.iter().step_by(every);
        let of_step = shown.filter(|sample| step_of(sample).clamp(-STEPS, STEPS) == step);
        let sign = if step < 0 { "-" } else { "+" };
        let name = if step.abs() == STEPS { format!("{sign}{}", um(full_m)) } else { String::new() };
        let colour = colour(f64::from(step) / f64::from(STEPS));
        dots(name, colour, of_step.map(|sample| from_above(&sample.direction)).collect())
    };
    // The strongest colours are drawn last, so that they are on top. Zero has no sign and is drawn once.
    sphere_from_above(title, (0..=STEPS).flat_map(|size| [-size, size]).skip(1).map(series))
}

/// Colour of a value between -1 and 1: from blue at -1 over light grey at 0 to orange at 1.
fn colour(part: f64) -> RGBColor {
    const MIDDLE: RGBColor = RGBColor(232, 235, 239);
    let (end, strength) = if part < 0.0 { (BLUE, -part) } else { (ORANGE, part) };
    let strength = strength.clamp(0.0, 1.0);
    let mixed =
        |from: u8, to: u8| (f64::from(from) + strength * (f64::from(to) - f64::from(from))).round() as u8;
    RGBColor(mixed(MIDDLE.0, end.0), mixed(MIDDLE.1, end.1), mixed(MIDDLE.2, end.2))
}
