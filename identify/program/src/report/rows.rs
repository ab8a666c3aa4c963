//! Tables of a calibration by rows of a tracker, a wire or a ball in sockets.

use std::fmt::Write;

use shared::output::named;

use crate::calibrate::rows::{PoseFigures, RowSet, RunCause, Sizes, Stages, Validated};
use crate::evaluate::{Limit, Validity};
use crate::instrument::{Instrument, PoseError, Rejection, Run, Section};
use crate::kinematics::Joints;
use crate::model::{Model, ParameterId, Phase, Waves};
use crate::report::result::validation::ValidationEntry;

/// The calibrated robot on another file.
#[derive(Debug, Clone, PartialEq)]
pub struct Validation {
    /// Path of the file.
    pub name: String,
    /// Figures of its rows.
    pub found: Validated,
    /// Lines of rows that neither robot comes near.
    pub gross: Vec<u64>,
    /// Rows where the calibration is not supported: line of the file, and joints from 0 that were not measured there.
    pub outside: Vec<(u64, Vec<usize>)>,
}

/// Poses where a calibration is not supported, of a file's lines.
pub fn outside(
    validity: &Validity,
    joints: impl Iterator<Item = Joints>,
    lines: &[u64],
) -> Vec<(u64, Vec<usize>)> {
    let outside = |(q, line): (Joints, &u64)| Some((*line, validity.outside(&q)));
    joints.zip(lines).filter_map(outside).filter(|(_, joints)| !joints.is_empty()).collect()
}

impl Validation {
    /// For the file; `data_set` is that whose instrument measured it, from 1.
    pub fn entry(&self, data_set: usize) -> ValidationEntry {
        let Self { name, found: Validated { figures: [nominal, calibrated], gross }, outside, .. } = self;
        ValidationEntry {
            name: name.clone(),
            data_set,
            nominal: *nominal,
            calibrated: *calibrated,
            unsupported: outside.len(),
            left_out: gross.len(),
        }
    }

    /// One line for a terminal.
    pub fn line(&self) -> String {
        let [nominal, calibrated] = &self.found.figures;
        let mm = |figures: &PoseFigures| figures.position_m.rms * 1e3;
        let name = &self.name;
        format!(
            "{name}: {:.4} mm RMS with the nominal robot, {:.4} mm calibrated{}{}\n",
            mm(nominal),
            mm(calibrated),
            self.unsupported(),
            self.left_out(),
        )
    }

    /// Which rows are no measurements.
    fn left_out(&self) -> String {
        const NAMED: usize = 8;
        match self.gross.len() {
            0 => String::new(),
            count => format!(
                "; {count} rows (lines {}) are further from both robots than they can be off and do not count",
                named(&self.gross, NAMED)
            ),
        }
    }

    /// Which rows lie outside of what was measured.
    fn unsupported(&self) -> String {
        const NAMED: usize = 8;
        let (outside, rows) = (self.outside.len(), self.found.figures[0].rows + self.gross.len());
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

fn line(text: &mut String, name: &str, figures: &PoseFigures) {
    let sizes = |sizes: &Sizes| {
        let Sizes { mean, rms, p95, max } = sizes;
        format!("{:>8.3} {:>8.3} {:>8.3} {:>8.3}", mean * 1e3, rms * 1e3, p95 * 1e3, max * 1e3)
    };
    let rotation = figures.rotation_rad.as_ref().map(sizes).unwrap_or_default();
    // Writing to a string cannot fail.
    let _ = writeln!(text, "{name:<44}{:>6} {}   {rotation}", figures.rows, sizes(&figures.position_m));
}

/// `what` was fitted to the nominal robot, and what comes last beside the links.
fn stages(text: &mut String, name: &str, [what, last]: [&str; 2], stages: &Stages) {
    let _ = writeln!(text, "{name}");
    line(text, &format!("  nominal robot, {what} fitted"), &stages.nominal);
    line(text, "  and joint offsets", &stages.offsets);
    line(text, "  and the other numbers of links", &stages.links);
    line(text, &format!("  and {last}"), &stages.joints);
}

const FIGURES: &str = "    mean      RMS      p95      max";

/// Errors of rows that the fit saw and of rows that it did not, in each stage, on other files, and of parts of the instrument; then
/// the rejected rows. `lines` gives each row's line in its file.
pub fn table(
    set: &RowSet,
    instrument: &Instrument,
    model: &Model,
    lines: &[u64],
    validations: &[Validation],
) -> String {
    let (fitted, held_out, with_rejected) = (set.fitted(), set.held_out(), set.held_out_with_rejected());
    let mut text = if fitted.nominal.rotation_rad.is_some() {
        let head =
            format!("{:<44}{:>6} {:>35}   {:>35}\n", "error", "", "position [mm]", "orientation [mrad]");
        head + &format!("{:<44}{:>6} {FIGURES}   {FIGURES}\n", "", "rows")
    } else {
        let what = if instrument.lengths_m().is_empty() { "position" } else { "length" };
        format!("{:<44}{:>6} {FIGURES}\n", format!("{what} error [mm]"), "rows")
    };
    let last = if set.drift.is_some() { "joint errors and drift" } else { "joint errors" };
    let named = [instrument.parts(), last];
    stages(&mut text, "fitted", named, &fitted);
    stages(&mut text, "held out", named, &held_out);
    if with_rejected.nominal.rows != held_out.nominal.rows {
        stages(&mut text, "held out, with faulty rows", named, &with_rejected);
    }
    for validation in validations {
        let Validation { name, found: Validated { figures: [nominal, calibrated], .. }, .. } = validation;
        let beside = validation.unsupported() + &validation.left_out();
        let _ = writeln!(text, "{name}, {} fitted to other rows of it{beside}", instrument.parts());
        line(&mut text, "  nominal robot", nominal);
        line(&mut text, "  calibrated robot", calibrated);
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
    text.push_str(&sections(set, instrument, &instrument.errors(&geometry)));
    text.push_str(&rejected_rows(set, &instrument.remarks(&geometry), lines));
    text
}

/// Parts of an instrument, such as sockets, by their names and parameters.
fn sections(set: &RowSet, instrument: &Instrument, errors: &[PoseError]) -> String {
    let sections = instrument.sections();
    let mut text = String::new();
    if !sections.is_empty() {
        let _ = writeln!(text, "{:<12}{:<12}{:>6}{:>12}", "name", "parameters", "rows", "RMS [mm]");
    }
    let takes_part = |row: &&usize| set.rejected.binary_search_by_key(*row, |one| one.row).is_err();
    for Section { name, parameters, samples } in &sections {
        let sizes_m = samples.iter().filter(takes_part).filter_map(|row| Some(errors.get(*row)?.position_m));
        let sizes_m: Vec<f64> = sizes_m.collect();
        let (rows, rms_m) = (sizes_m.len(), Sizes::of(sizes_m.into_iter()).rms);
        let _ = writeln!(text, "{name:<12}{parameters:<12}{rows:>6}{:>12.4}", rms_m * 1e3);
    }
    text
}

fn rejected_rows(report: &RowSet, remarks: &[(usize, String)], lines: &[u64]) -> String {
    let mut text = String::new();
    let line = |row: usize| lines.get(row).copied().unwrap_or_default();
    let _ = writeln!(text, "{} of {} rows rejected:", report.rejected.len(), lines.len());
    for rejected in &report.rejected {
        let remark = remarks.iter().find(|(row, _)| *row == rejected.row);
        let remark = remark.map_or_else(String::new, |(_, remark)| format!(", {remark}"));
        let _ = match rejected.why {
            Rejection::FlangeContradicts { distance_m } => writeln!(
                text,
                "  line {}: the controller's position is {:.1} mm from its joint angles{remark}",
                line(rejected.row),
                distance_m * 1e3
            ),
            Rejection::GrossResidual { residual_m } => {
                writeln!(text, "  line {}: off by {:.2} mm{remark}", line(rejected.row), residual_m * 1e3)
            }
            // Listed with its run below.
            Rejection::FaultyRun { .. } => Ok(()),
        };
    }
    for run in &report.runs {
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
            "  lines {} to {}: deviate together by {:.1} mm{cause}",
            line(run.first),
            line(run.last),
            run.median_m * 1e3
        );
    }
    text
}

/// What lengths of links are off at most in arms that were typed by hand: a nominal robot further from its rows is another one \[m\].
pub(crate) const OTHER_ROBOT_M: f64 = 0.01;

/// Rows that are rejected in the last solve, `name` being what the file is called; `lines` gives each row's line in it.
pub fn left_out(set: &RowSet, run: &Run, [name, robot]: [&str; 2], lines: &[u64]) -> Option<Limit> {
    /// Named, at most.
    const NAMED: usize = 8;
    /// Where more than this part of a file is wrong, the others may be, too.
    const SERIOUS: f64 = 0.05;
    let (mut rejected, mut counts) = (Vec::new(), [0; 3]);
    for ((_, why), line) in set.deviations(run).into_iter().zip(lines) {
        let Some(why) = why else { continue };
        rejected.push(*line);
        counts[match why {
            Rejection::GrossResidual { .. } => 0,
            Rejection::FaultyRun { .. } => 1,
            Rejection::FlangeContradicts { .. } => 2,
        }] += 1;
    }
    let whys = [
        "deviate by more than errors of robot and instrument explain",
        "deviate together with the rows around them",
        "contradict the controller's own position",
    ];
    let counted = counts.iter().zip(whys).filter(|(count, _)| **count > 0);
    let whys: Vec<String> = counted.map(|(count, why)| format!("{count} {why}")).collect();
    let serious = rejected.len() as f64 > SERIOUS * lines.len() as f64;
    let nominal_m = set.fitted().nominal.position_m.rms;
    // With enough terms any robot fits most rows of a wire.
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
            whys.join(", ")
        ),
        serious,
    })
}

/// The strongest waves of each axis.
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

/// The five largest waves of a joint with their amplitudes.
fn strongest_waves(model: &Model, joint: usize) -> String {
    const SHOWN: usize = 5;
    let amplitude = |order| {
        let value = |phase| {
            model.parameter(ParameterId::JointWave { axis: joint, order, phase }).map_or(0.0, |one| one.value)
        };
        (order, f64::hypot(value(Phase::Sine), value(Phase::Cosine)))
    };
    let mut waves: Vec<(u8, f64)> = Waves::OF_AXIS.map(amplitude).collect();
    waves.retain(|wave| wave.1 > 0.0);
    waves.sort_by(|a, b| b.1.total_cmp(&a.1));
    let shown =
        waves.iter().take(SHOWN).map(|(order, rad)| format!("{order} per turn {:.0} urad", rad * 1e6));
    shown.collect::<Vec<_>>().join(", ")
}
