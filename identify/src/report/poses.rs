//! Tables of a calibration by measured poses.

use std::fmt::Write;

use crate::calibrate::measured_pose::{PoseFigures, PoseReport, Sizes, Stages};
use crate::model::{JointWaves, Model, ParameterId, Phase};

/// The calibrated robot on another file.
#[derive(Debug, Clone, PartialEq)]
pub struct Validation {
    /// The file.
    pub name: String,
    /// With the nominal and with the calibrated robot.
    pub figures: [PoseFigures; 2],
}

fn line(text: &mut String, name: &str, figures: &PoseFigures) {
    let sizes = |sizes: &Sizes| {
        let Sizes { mean, rms, p95, max } = sizes;
        format!("{:>8.3} {:>8.3} {:>8.3} {:>8.3}", mean * 1e3, rms * 1e3, p95 * 1e3, max * 1e3)
    };
    let rotation = figures.rotation_rad.as_ref().map(sizes).unwrap_or_default();
    // Writing to a string cannot fail.
    let _ = writeln!(text, "{name:<44}{:>6} {}   {rotation}", figures.rows, sizes(&figures.position_m));
}

fn stages(text: &mut String, name: &str, stages: &Stages) {
    let _ = writeln!(text, "{name}");
    line(text, "  nominal robot, tracker and probe fitted", &stages.nominal);
    line(text, "  and links", &stages.links);
    line(text, "  and joint errors", &stages.joints);
}

/// Position and orientation errors of fitted, held-out and other rows, and which joint errors were taken.
pub fn table(report: &PoseReport, validations: &[Validation]) -> String {
    let mut text = String::new();
    let _ = writeln!(
        text,
        "{:<44}{:>6} {:>35}   {:>35}\n{:<44}{:>6} {:>8} {:>8} {:>8} {:>8}   {:>8} {:>8} {:>8} {:>8}",
        "error",
        "",
        "position [mm]",
        "orientation [mrad]",
        "",
        "rows",
        "mean",
        "RMS",
        "p95",
        "max",
        "mean",
        "RMS",
        "p95",
        "max",
    );
    stages(&mut text, "fitted", &report.fitted);
    stages(&mut text, "held out", &report.held_out);
    for Validation { name, figures: [nominal, calibrated] } in validations {
        let _ = writeln!(text, "{name}, tracker and probe fitted to other rows of it");
        line(&mut text, "  nominal robot", nominal);
        line(&mut text, "  calibrated robot", calibrated);
    }
    text.push_str(&terms(report));
    text
}

fn terms(report: &PoseReport) -> String {
    let mut text = String::new();
    if !report.terms.is_empty() {
        let _ = writeln!(
            text,
            "\njoint errors, by the RMS of fitting rows left out in turn (standard deviations)"
        );
    }
    for term in &report.terms {
        let _ = match term.sigma {
            Some(sigma) => writeln!(
                text,
                "  {}: taken, {} parameters, prior {:.0} urad|ppm|urad/m, {:.4} -> {:.4}",
                term.name(),
                term.parameters,
                sigma * 1e6,
                term.held_out_before,
                term.held_out_after,
            ),
            None => writeln!(text, "  {}: left out, nothing gained", term.name()),
        };
    }
    for joint in 0..report.model.axes() {
        let strongest = strongest_waves(&report.model, joint);
        if !strongest.is_empty() {
            let _ = writeln!(text, "  strongest waves of joint {}: {strongest}", joint + 1);
        }
    }
    text
}

/// The five largest waves of a joint with their amplitudes.
fn strongest_waves(model: &Model, joint: usize) -> String {
    const SHOWN: usize = 5;
    let amplitude = |order| {
        let value = |phase| {
            model.parameter(ParameterId::JointWave { axis: joint, order, phase }).map_or(0.0, |one| one.value)
        };
        (order, f64::hypot(value(Phase::Sine), value(Phase::Cosine)))
    };
    let mut waves: Vec<(u8, f64)> = (JointWaves::FIRST..=JointWaves::LAST).map(amplitude).collect();
    waves.retain(|wave| wave.1 > 0.0);
    waves.sort_by(|a, b| b.1.total_cmp(&a.1));
    let shown =
        waves.iter().take(SHOWN).map(|(order, rad)| format!("{order} per turn {:.0} urad", rad * 1e6));
    shown.collect::<Vec<_>>().join(", ")
}
