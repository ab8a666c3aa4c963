//! Text about data sets that consist of rows, such as those of a tracker or wire, for terminal and page. [`table`] lists
//! the errors of fitted and held-out rows in each stage of the model, then the rejected rows. [`Validation`] contains
//! the errors on a file of `--validate`. [`left_out`] reports rejected rows as a limit. [`waves`] lists the largest
//! harmonics of the joint errors.

use std::fmt::Write;

use shared::output::named;

use crate::calibrate::rows::{PoseFigures, RowSet, RunCause, Stages};
use crate::calibrate::validation::unseen::UnseenPart;
use crate::evaluate::Limit;
use crate::instrument::{Instrument, PoseError, Rejection, Run, Section};
use crate::model::{Model, ParameterId, Phase, Waves};
use crate::report::result::validation::ValidationEntry;
use crate::statistics::Sizes;

/// Largest number of line numbers that are listed.
const NAMED: usize = 8;

/// Errors of the nominal and the calibrated robot on a file that the calibration did not use.
#[derive(Debug, Clone, PartialEq)]
pub struct Validation {
    /// Statistics of the errors, as in `calibration.toml`.
    pub entry: ValidationEntry,
    /// Line numbers of rows that are gross errors for both robots. These rows are not in the statistics.
    pub gross: Vec<u64>,
    /// Rows outside the joint ranges for which the calibration is supported: line number in the file, and joints (from 0)
    /// that were not measured there.
    pub outside: Vec<(u64, Vec<usize>)>,
}

impl Validation {
    /// One line for a terminal.
    pub fn line(&self) -> String {
        let ValidationEntry { name, nominal, calibrated, .. } = &self.entry;
        format!(
            "{name}: {:.4} mm RMS with the nominal robot, {:.4} mm calibrated{}{}\n",
            nominal.position_m.rms * 1e3,
            calibrated.position_m.rms * 1e3,
            self.unsupported(),
            self.left_out(),
        )
    }

    /// Clause about the rows with gross errors; empty if there are none.
    fn left_out(&self) -> String {
        match self.gross.len() {
            0 => String::new(),
            count => format!(
                "; {count} rows (lines {}) are gross errors for both robots and are not in the figures",
                named(&self.gross, NAMED)
            ),
        }
    }

    /// Clause about the rows for which the calibration is not supported; empty if there are none.
    fn unsupported(&self) -> String {
        let (outside, rows) = (self.outside.len(), self.entry.nominal.rows + self.gross.len());
        if outside == 0 {
            return String::new();
        }
        let mut joints: Vec<usize> =
            self.outside.iter().flat_map(|(_, joints)| joints).map(|joint| joint + 1).collect();
        joints.sort_unstable();
        joints.dedup();
        let listed = |numbers: &mut dyn Iterator<Item = String>| numbers.collect::<Vec<_>>().join(", ");
        let lines = listed(&mut self.outside.iter().take(NAMED).map(|(line, _)| line.to_string()));
        let joints = listed(&mut joints.iter().map(ToString::to_string));
        let more = if outside > NAMED { " .." } else { "" };
        format!(
            "; {outside} of {rows} rows are where the calibration is not supported (joints {joints} were not measured there; lines \
             {lines}{more})"
        )
    }
}

/// Appends a line with the number of rows and the statistics of their errors \[mm, mrad\]: mean, RMS,
/// 95 % quantile and largest.
fn append_errors(text: &mut String, name: &str, figures: &PoseFigures) {
    let sizes = |Sizes { mean, rms, p95, max, .. }: &Sizes| {
        format!("{:>8.3} {:>8.3} {:>8.3} {:>8.3}", mean * 1e3, rms * 1e3, p95 * 1e3, max * 1e3)
    };
    let rotation = figures.rotation_rad.as_ref().map(sizes).unwrap_or_default();
    // Writing to a string cannot fail.
    let _ = writeln!(text, "{name:<44}{:>6} {}   {rotation}", figures.rows, sizes(&figures.position_m));
}

/// Appends a line for each stage of the model. `instrument_parts` names the parts of the instrument, which were
/// fitted in every stage.
fn append_stages(text: &mut String, name: &str, instrument_parts: &str, stages: &Stages) {
    let _ = writeln!(text, "{name}");
    append_errors(text, &format!("  nominal robot, {instrument_parts} fitted"), &stages.nominal);
    append_errors(text, "  and joint offsets", &stages.offsets);
    append_errors(text, "  and the other numbers of links", &stages.links);
    append_errors(text, "  and joint errors", &stages.joints);
}

/// Heading of the four statistics in a line.
const FIGURES: &str = "    mean      RMS      p95      max";

/// Lists the errors of fitted and held-out rows in each stage, the errors on other files (`validations`), the errors of
/// each section of the instrument, and the rejected rows. A section is one part of the instrument, such as a socket.
/// `unseen` contains the errors of sections that were predicted by a fit to all other data. `lines` are the line numbers of
/// the rows in their file.
pub fn table(
    set: &RowSet,
    run: &Run,
    lines: &[u64],
    validations: &[Validation],
    unseen: &[&UnseenPart],
) -> String {
    let Run { instrument, model } = run;
    let (fitted, held_out, with_rejected) = (set.fitted(), set.held_out(), set.held_out_with_rejected());
    let mut text = if fitted.nominal.rotation_rad.is_some() {
        let head =
            format!("{:<44}{:>6} {:>35}   {:>35}\n", "error", "", "position [mm]", "orientation [mrad]");
        head + &format!("{:<44}{:>6} {FIGURES}   {FIGURES}\n", "", "rows")
    } else {
        let what = if instrument.lengths_m().is_empty() { "position" } else { "length" };
        format!("{:<44}{:>6} {FIGURES}\n", format!("{what} error [mm]"), "rows")
    };
    let drifts = if set.drift.is_some() { " and its drift" } else { "" };
    let parts = format!("{}{drifts}", instrument.parts());
    append_stages(&mut text, "fitted", &parts, &fitted);
    append_stages(&mut text, "held out", &parts, &held_out);
    if with_rejected.nominal.rows != held_out.nominal.rows {
        append_stages(&mut text, "held out, with faulty rows", &parts, &with_rejected);
    }
    for validation in validations {
        let ValidationEntry { name, nominal, calibrated, .. } = &validation.entry;
        let remarks = validation.unsupported() + &validation.left_out();
        let _ = writeln!(text, "{name} ({} fitted to other rows of this file){remarks}", instrument.parts());
        append_errors(&mut text, "  nominal robot", nominal);
        append_errors(&mut text, "  calibrated robot", calibrated);
    }
    if let Some(drift) = &set.drift {
        let _ = writeln!(
            text,
            "drift of the zero along the file: {:.2} mm over {:.0} rows, beside {:.2} mm white; rows of the fit, each predicted \
             without itself: RMS {:.3} -> {:.3} mm",
            drift.size_m * 1e3,
            drift.memory_rows,
            drift.white_m * 1e3,
            drift.rms_without_m * 1e3,
            drift.rms_with_m * 1e3,
        );
    }
    let geometry = model.geometry(&[]);
    text.push_str(&sections(set, instrument, &instrument.errors(&geometry), unseen));
    text.push_str(&rejected_rows(set, run, &instrument.remarks(&geometry), lines));
    text
}

/// Lists the sections of an instrument, such as sockets, with their names and parameters. Each line contains the RMS
/// error of the section's rows in the fit. If `unseen` contains the section, the RMS error as predicted by a fit to
/// all other data follows.
fn sections(set: &RowSet, instrument: &Instrument, errors: &[PoseError], unseen: &[&UnseenPart]) -> String {
    let sections = instrument.sections();
    let mut text = String::new();
    if !sections.is_empty() {
        let predicted = if unseen.is_empty() { "" } else { "   by a fit without them" };
        let _ =
            writeln!(text, "{:<12}{:<12}{:>6}{:>12}{predicted}", "name", "parameters", "rows", "RMS [mm]");
    }
    let is_used = |row: &&usize| set.rejected.binary_search_by_key(*row, |one| one.row).is_err();
    for Section { name, parameters, samples } in &sections {
        let used = samples.iter().filter(is_used).filter_map(|row| errors.get(*row).copied());
        let PoseFigures { rows, position_m, .. } = PoseFigures::from_errors(used);
        let predicted = unseen.iter().find(|part| part.name == *name);
        let predicted = predicted.map(|part| format!("{:>24.4}", part.predicted.position_m.rms * 1e3));
        let predicted = predicted.unwrap_or_default();
        let _ =
            writeln!(text, "{name:<12}{parameters:<12}{rows:>6}{:>12.4}{predicted}", position_m.rms * 1e3);
    }
    text
}

/// Lists the rows that the result does not use, with the reason. Sequences of consecutive faulty rows follow, one line each.
fn rejected_rows(set: &RowSet, run: &Run, remarks: &[(usize, String)], lines: &[u64]) -> String {
    let mut text = String::new();
    let line = |row: usize| lines.get(row).copied().unwrap_or_default();
    let rejected = set.deviations(run).into_iter().enumerate();
    let rejected: Vec<_> = rejected.filter_map(|(row, (_, why))| Some((row, why?))).collect();
    let _ = writeln!(text, "{} of {} rows rejected:", rejected.len(), lines.len());
    for (row, why) in rejected {
        let remark = remarks.iter().find(|(other, _)| *other == row);
        let remark = remark.map_or_else(String::new, |(_, remark)| format!(", {remark}"));
        let what = match why {
            Rejection::FlangeContradicts { distance_m } => {
                format!("the controller's position is {:.1} mm from its joint angles", distance_m * 1e3)
            }
            Rejection::GrossResidual { residual_m } => format!("off by {:.2} mm", residual_m * 1e3),
            // This row is listed below, as part of its sequence of faulty rows.
            Rejection::FaultyRun { .. }
                if set.runs.iter().any(|run| (run.first..=run.last).contains(&row)) =>
            {
                continue;
            }
            Rejection::FaultyRun { .. } => "deviates together with the rows around it".to_owned(),
        };
        let _ = writeln!(text, "  line {}: {what}{remark}", line(row));
    }
    for run in &set.runs {
        let cause = match run.cause {
            Some(RunCause::ZeroMoved { by_m }) => {
                format!("; a zero moved by {:+.1} mm would explain it", by_m * 1e3)
            }
            Some(RunCause::SignReversed { joint }) => {
                format!("; joint {joint} logged with the other sign would explain it")
            }
            None => String::new(),
        };
        let _ = writeln!(
            text,
            "  lines {} to {}: all deviate by about {:.1} mm{cause}",
            line(run.first),
            line(run.last),
            run.median_m * 1e3
        );
    }
    text
}

/// If the RMS error of the nominal robot is larger than this, the rows probably belong to another robot \[m\]. Inaccurate
/// link lengths that were typed by hand cause smaller errors.
pub(crate) const OTHER_ROBOT_M: f64 = 0.01;

/// A limit that reports the rejected rows of a data set, with their number for each reason; `None` if no row is rejected.
/// `name` names the instrument and its data set, `robot` names the robot, and `lines` are the line numbers of the rows.
pub fn left_out(set: &RowSet, run: &Run, [name, robot]: [&str; 2], lines: &[u64]) -> Option<Limit> {
    /// If more than this fraction of a file is rejected, the remaining rows may be wrong, too.
    const SERIOUS: f64 = 0.05;
    let mut rejected = Vec::new();
    let (mut gross, mut faulty_runs, mut contradicting) = (0, 0, 0);
    for ((_, rejection), line) in set.deviations(run).into_iter().zip(lines) {
        let Some(rejection) = rejection else { continue };
        rejected.push(*line);
        *match rejection {
            Rejection::GrossResidual { .. } => &mut gross,
            Rejection::FaultyRun { .. } => &mut faulty_runs,
            Rejection::FlangeContradicts { .. } => &mut contradicting,
        } += 1;
    }
    let counts = [
        (gross, "deviate by more than errors of robot and instrument explain"),
        (faulty_runs, "deviate together with the rows around them"),
        (contradicting, "contradict the controller's own position"),
    ];
    let counted = counts.iter().filter(|(count, _)| *count > 0);
    let reasons: Vec<String> = counted.map(|(count, reason)| format!("{count} {reason}")).collect();
    let serious = rejected.len() as f64 > SERIOUS * lines.len() as f64;
    let nominal_m = set.fitted().nominal.position_m.rms;
    // The check uses residuals of the nominal robot, because with enough terms even the calibration of a wrong robot fits
    // most rows of a wire.
    let advice = if serious && nominal_m > OTHER_ROBOT_M {
        format!(
            "The nominal robot is {:.1} mm (RMS) from the others, more than robots deviate: check that they are rows of {robot}, and \
             their units, signs and frames.",
            nominal_m * 1e3
        )
    } else {
        "Look for interruptions, a wrong target or socket, or joints of another pose.".to_owned()
    };
    (!rejected.is_empty()).then(|| Limit {
        sentence: format!(
            "{} of {} rows of the {name} are rejected (lines {}): {}. {advice}",
            rejected.len(),
            lines.len(),
            named(&rejected, NAMED),
            reasons.join(", ")
        ),
        serious,
    })
}

/// The largest harmonics of the joint errors, one line for each axis.
pub fn waves(model: &Model) -> String {
    let mut text = String::new();
    for joint in 0..model.axes() {
        let strongest = strongest_waves(model, joint);
        if !strongest.is_empty() {
            let _ = writeln!(text, "strongest waves of joint {}: {strongest}", joint + 1);
        }
    }
    text
}

/// The five largest harmonics of a joint's errors, with their amplitudes.
fn strongest_waves(model: &Model, joint: usize) -> String {
    const SHOWN: usize = 5;
    let order_and_amplitude = |order| {
        let value = |phase| {
            model.parameter(ParameterId::JointWave { axis: joint, order, phase }).map_or(0.0, |one| one.value)
        };
        (order, f64::hypot(value(Phase::Sine), value(Phase::Cosine)))
    };
    let mut waves: Vec<(u8, f64)> = Waves::OF_AXIS.map(order_and_amplitude).collect();
    waves.retain(|(_, amplitude_rad)| *amplitude_rad > 0.0);
    waves.sort_by(|(_, a_rad), (_, b_rad)| b_rad.total_cmp(a_rad));
    let shown =
        waves.iter().take(SHOWN).map(|(order, rad)| format!("{order} per turn {:.0} urad", rad * 1e6));
    shown.collect::<Vec<_>>().join(", ")
}
