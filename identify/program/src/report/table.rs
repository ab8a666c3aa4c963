//! Tables for the terminal: a calibration with `--verbose`, its data sets, its comparison with the true parameters of a
//! simulation, and the content of inspected files.

use std::fmt::Write;

use super::result::corrections::TO_JOINT;
use super::result::file::{CalibrationFile, ParameterEntry, ParameterStatus, ReadIn};
use super::result::validation::HeldOutEntry;
use crate::calibrate::Calibration;
use crate::calibrate::validation::deployment::Deployment;
use crate::inspect::{Inspection, JointLine};
use crate::instrument::{Noise, Run};
use crate::model::ParameterId;
use crate::simulate::Comparison;

/// Details of a calibration. Statistics of the solve, clocks, forces and noise come first. Then every identified parameter is
/// listed: nominal value, correction and sigma in its unit for display, such as mm or deg. Rank, uncertainty budget, tried
/// terms and errors on held-out segments follow.
pub fn calibration(file: &CalibrationFile) -> String {
    let mut text = String::new();
    let solve = &file.solve;
    // Writing to a string cannot fail.
    let _ = writeln!(text, "{} measured with {}", file.robot, file.instrument);
    let _ = writeln!(
        text,
        "cost {}: {} after {} iterations, {} samples, {} parameters, condition {:.0}, residual RMS {:.3e} -> {:.3e}",
        solve.cost,
        solve.ended,
        solve.iterations,
        solve.samples,
        solve.parameters,
        solve.condition,
        solve.residual_rms_start,
        solve.residual_rms,
    );
    let several = file.clocks.len() > 1;
    for clock in &file.clocks {
        let whose = if several { format!(" of data set {}", clock.data_set) } else { String::new() };
        let _ = writeln!(text, "clocks{whose}: {}", clock.sentence());
    }
    for force in &file.forces {
        let _ = writeln!(
            text,
            "force{}: {}; off the sphere {:.2} um RMS, {:.2} um of it not explained by the force",
            if several { format!(" (run {})", force.run) } else { String::new() },
            force.sentence,
            force.off_sphere_rms_m * 1e6,
            force.unexplained_rms_m * 1e6,
        );
    }
    for noise in &file.noise {
        let _ = writeln!(text, "{}", noise.sentence());
    }
    text.push_str(&parameters(file));
    if let Some(knowledge) = &file.knowledge {
        text.push_str(&knowledge.describe(solve.parameters));
    }
    text.push_str(&budget(file));
    text.push_str(&candidates(file));
    text.extend(file.held_out.as_ref().map(HeldOutEntry::line));
    text
}

/// One line for each data set of a calibration with several instruments: number of samples, and the noise by which
/// the solve weights them.
pub fn data_sets(calibration: &Calibration) -> String {
    let mut text = format!("{:<12}{:>8}{:>24}\n", "instrument", "samples", "noise");
    for (Run { instrument, .. }, sigma) in calibration.runs.iter().zip(&calibration.solved.sigmas) {
        let (name, samples) = (instrument.name(), instrument.samples());
        let noise = match instrument.noise() {
            Noise::Angles(angles) => {
                let urad = |rad: f64| sigma * rad * 1e6;
                format!(
                    "{:>12.1} urad (encoders), {:.1} urad (robot)",
                    urad(angles.encoder_rad),
                    urad(angles.robot_rad)
                )
            }
            Noise::Length(noise_m) => format!("{:>21.4} mm", sigma * noise_m * 1e3),
        };
        let left_out = match instrument.rejected().len() {
            0 => String::new(),
            rows => format!(", {rows} rows that do not fit the others are rejected"),
        };
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{name:<12}{samples:>8}{noise}{left_out}");
    }
    text
}

/// Lists every identified parameter and the names of the fixed parameters. The links are those that a controller applies.
fn parameters(file: &CalibrationFile) -> String {
    let mut text = String::new();
    let applied = file.applied();
    let _ = writeln!(text, "\n{:<16}{:>14}{:>12}{:>10}  unit", "parameter", "nominal", "correction", "sigma");
    let (entries, waves) = applied.reported();
    let [exact, uncertain] = ParameterEntry::fixed(entries.iter().copied());
    for entry in entries.into_iter().filter(|entry| entry.status != ParameterStatus::Fixed) {
        let ReadIn { factor, unit, decimals } = entry.read_in();
        let sigma = entry.sigma.map_or_else(|| "-".into(), |sigma| format!("{:.5}", sigma * factor));
        let prior = if entry.status == ParameterStatus::IdentifiedWithPrior { " (prior)" } else { "" };
        let _ = writeln!(
            text,
            "{:<16}{:>14.4}{:>+12.decimals$}{:>10}  {unit}{prior}",
            entry.name,
            entry.nominal * factor,
            entry.correction * factor,
            sigma,
        );
    }
    let _ = writeln!(text, "{}", about_links(file));
    if waves > 0 {
        let _ = writeln!(text, "and {waves} amplitudes of waves of the axes");
    }
    let _ = writeln!(text, "fixed: {}", exact.join(" "));
    if !uncertain.is_empty() {
        let _ =
            writeln!(text, "fixed, with an uncertainty that is part of all sigmas: {}", uncertain.join(", "));
    }
    text
}

/// Uncertainty of positions, and the contributions that cause nearly all of it.
fn budget(file: &CalibrationFile) -> String {
    /// Contributions up to this fraction of the variance are not listed.
    const PART_MIN: f64 = 0.01;
    let Some(budget) = file.budget.as_ref().filter(|budget| budget.u_m > 0.0) else { return String::new() };
    let mut text = format!(
        "uncertainty of a position by the geometry, RMS over the workspace: {:.4} mm (k = {}), of it\n",
        budget.expanded_m * 1e3,
        budget.coverage_factor,
    );
    for contribution in budget.contributions.iter().filter(|one| budget.part(one) > PART_MIN) {
        let percent = 100.0 * budget.part(contribution);
        let _ = writeln!(text, "  {percent:>3.0} %  {}", contribution.source);
    }
    text
}

/// Groups of terms that were tried, and how well held-out segments are predicted without and with each group.
fn candidates(file: &CalibrationFile) -> String {
    if file.candidates.is_empty() {
        return String::new();
    }
    let mut text = String::from(
        "terms, tried on held-out samples (RMS of the weighted residuals without -> with them):\n",
    );
    for candidate in &file.candidates {
        let verdict = candidate.sigma.map_or_else(
            || "left out".into(),
            |sigma| format!("taken, expected within {:.0} urad|um|ppm", sigma * 1e6),
        );
        let _ = writeln!(
            text,
            "  {}: {verdict}, {} parameters, {:.4} -> {:.4}",
            candidate.name(),
            candidate.parameters,
            candidate.held_out_before,
            candidate.held_out_after,
        );
    }
    text
}

/// Sentences that state which links are printed, and where the offset of a joint is added.
pub(in crate::report) fn about_links(file: &CalibrationFile) -> String {
    let use_of_links = if file.serves(Deployment::Dh) {
        "Links as in corrections.csv, for a controller without the terms of joints (calibration.toml has those of the full model)"
    } else {
        "Links of the full model, valid only together with its terms"
    };
    format!("{use_of_links}. A joint's offset, rtheta (rd of a prismatic one), is added to {TO_JOINT}.")
}

/// True and identified parameters of a simulated experiment, with the two error measures of the thesis.
pub fn comparison(comparison: &Comparison) -> String {
    let mut text = String::new();
    let _ =
        writeln!(text, "the full model beside the truth; corrections.csv has what a controller takes of it");
    let _ = writeln!(text, "{:<16}{:>14}{:>14}{:>11}  unit", "parameter", "true", "identified", "error");
    for one in &comparison.parameters {
        let unit = one.id.unit();
        let factor = unit.display_factor();
        let _ = writeln!(
            text,
            "{:<16}{:>14.4}{:>14.4}{:>+11.5}  {}",
            one.id.to_string(),
            one.truth * factor,
            one.identified * factor,
            one.error_displayed(),
            unit.display_symbol(),
        );
    }
    let robot = comparison.only(|id| matches!(id, ParameterId::Robot { .. }));
    let _ = writeln!(
        text,
        "{} parameters: Euclidean error {:.5} mm|mrad, largest {:.5}; robot alone ({}): {:.5}",
        comparison.parameters.len(),
        comparison.euclidean_mm_mrad(),
        comparison.max_mm_mrad(),
        robot.parameters.len(),
        robot.euclidean_mm_mrad(),
    );
    let _ = writeln!(
        text,
        "clocks: shift off by {:.3} us, skew by {:.4} ppm",
        comparison.clock_shift_error_s * 1e6,
        comparison.clock_skew_error * 1e6,
    );
    text
}

/// Content of a log or recording, and suspicious findings in it.
pub fn inspection(inspection: &Inspection) -> String {
    let mut text = String::new();
    // Writing to a string cannot fail.
    for (what, value) in &inspection.facts {
        let _ = writeln!(text, "  {what:<24}{value}");
    }
    for group in inspection.joints_by_unit() {
        let unit = group.first().map_or("", |joint| joint.kind.display_symbol());
        let [from, to, most] = [format!("from {unit}"), format!("to {unit}"), format!("most {unit}/s")];
        let _ = writeln!(text, "  {:<8}{from:>10}{to:>10}{most:>12}", "joint");
        for JointLine { name, range: [low, high], speed_max, .. } in group {
            let _ = writeln!(text, "  {name:<8}{low:>10.2}{high:>10.2}{speed_max:>12.2}");
        }
    }
    match inspection.suspicious.len() {
        0 => text.push_str("  nothing suspicious\n"),
        _ => inspection.suspicious.iter().for_each(|sentence| {
            let _ = writeln!(text, "  ! {sentence}");
        }),
    }
    text
}
