//! The verdict on a calibration. It answers two questions. Does the calibrated robot predict held-out data better than the
//! nominal robot, in position and in rotation? Does the calibrated robot have the required accuracy? The verdict is red if
//! any set of held-out data is predicted significantly worse than by the nominal robot. It is amber if another condition is
//! not met, otherwise green. Inputs are the RMS errors on held-out data and the error expected over the workspace. Terminal
//! and page show the verdict. The verdict also determines which files are written.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::result::file::CalibrationFile;
use super::result::knowledge::ExpectedEntry;
use super::result::validation::{HeldOutErrors, ValidationEntry};
use crate::calibrate::rows::is_surely_worse;
use crate::calibrate::validation::deployment::Deployment;
use crate::evaluate::{Limit, WorkspaceError};
use crate::instrument::PoseError;

/// Grade of a calibration, as a colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Grade {
    /// Better than the nominal robot. If an accuracy is required, the calibrated robot has it.
    Green,
    /// A condition of green is not met or could not be tested.
    Amber,
    /// Significantly worse than the nominal robot. No part of the calibration may be applied.
    Red,
}

/// The verdict on a calibration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CalibrationVerdict {
    /// Answer to both questions.
    pub grade: Grade,
    /// Whether all held-out data are predicted better than by the nominal robot. Absent if no data were held out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub better: Option<bool>,
    /// Required position error, if the user gave one \[m\].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub required_m: Option<f64>,
    /// The most important limitation, as a sentence. Absent if the grade is green.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
}

impl fmt::Display for Grade {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Green => "green",
            Self::Amber => "amber",
            Self::Red => "red",
        })
    }
}

impl fmt::Display for CalibrationVerdict {
    /// Writes the reason, without grade and position error. For a green grade, it writes which conditions are met.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match (&self.reason, self.required_m) {
            (Some(reason), _) => f.write_str(reason),
            (None, Some(required_m)) => {
                write!(f, "Better than the nominal robot, and within the required {} mm.", in_mm(required_m))
            }
            (None, None) => f.write_str(
                "Better than the nominal robot; --require 0.2mm also checks whether that is accurate enough.",
            ),
        }
    }
}

/// RMS errors of one set of held-out data, in position \[m\] or rotation \[rad\].
pub(super) struct Predicted {
    pub(super) what: String,
    pub(super) nominal: f64,
    pub(super) calibrated: f64,
    /// RMS error of the calibrated robot on the data of the fit.
    fitted: f64,
    /// Number of independent errors in each RMS.
    independent: usize,
    pub(super) unit: &'static str,
    is_position: bool,
}

impl Predicted {
    /// Errors in position and, if `nominal`, `calibrated` and `fitted` all have a rotation, also in rotation. Empty without
    /// an error of the calibrated robot.
    fn from_errors(errors: HeldOutErrors) -> Vec<Self> {
        let HeldOutErrors { what, independent, nominal, calibrated, fitted } = errors;
        let Some(calibrated) = calibrated else { return Vec::new() };
        let predicted = |of: &str, unit, is_position, value: &dyn Fn(PoseError) -> Option<f64>| {
            let (nominal, calibrated, fitted) = (value(nominal)?, value(calibrated)?, value(fitted)?);
            let what = format!("{of} of {what}");
            Some(Self { what, nominal, calibrated, fitted, independent, unit, is_position })
        };
        let position = predicted("Positions", "mm", true, &|error| Some(error.position_m));
        let rotation = predicted("Rotations", "mrad", false, &|error| error.rotation_rad);
        position.into_iter().chain(rotation).collect()
    }

    fn is_better(&self) -> bool {
        self.calibrated < self.nominal
    }

    /// Whether the error of the calibrated robot exceeds that of the nominal robot by more than random scatter explains. The
    /// scatter of an RMS error depends on the number of independent errors.
    fn is_worse_beyond_chance(&self) -> bool {
        is_surely_worse(self.independent, [self.nominal, self.calibrated])
    }

    /// Whether the position error on held-out data is significantly larger than on the data of the fit, and the excess is
    /// larger than `expanded_m`. The excess is the square root of the difference of the squared errors.
    fn is_beyond(&self, expanded_m: f64) -> bool {
        let excess_m = (self.calibrated.powi(2) - self.fitted.powi(2)).max(0.0).sqrt();
        self.is_position
            && excess_m > expanded_m
            && is_surely_worse(self.independent, [self.fitted, self.calibrated])
    }

    fn sentence(&self) -> String {
        let Self { what, nominal, calibrated, unit, .. } = self;
        format!(
            "{what} are {:.3} {unit} off (RMS), with the nominal robot {:.3} {unit}",
            calibrated * 1e3,
            nominal * 1e3
        )
    }
}

impl CalibrationFile {
    /// Adds the verdict. The verdict depends on the held-out data in the file, the error expected over the workspace, and
    /// the limits. Also adds the uncertainty budget, the expected errors and the limits. The largest contribution to the
    /// uncertainty is added as one more limit.
    pub fn with_verdict(
        mut self,
        workspace: &WorkspaceError,
        limits: &[Limit],
        required_m: Option<f64>,
    ) -> Self {
        self.budget = Some(workspace.budget.clone());
        self.limits = limits.to_vec();
        let after_serious = limits.iter().rposition(|limit| limit.serious).map_or(0, |last| last + 1);
        self.limits.splice(after_serious..after_serious, largest_contribution(workspace));
        self.expected = Some(ExpectedEntry::from_workspace(workspace));
        let predicted = self.predicted();
        let better = (!predicted.is_empty()).then(|| predicted.iter().all(Predicted::is_better));
        let worse = predicted.iter().find(|one| one.is_worse_beyond_chance());
        let (grade, reason) = if let Some(worse) = worse {
            let reason = format!(
                "The calibrated robot predicts held-out data worse than the nominal robot: {}. Free fewer parameters, measure \
                 poses that are spread further, or use the default cost.",
                worse.sentence()
            );
            (Grade::Red, Some(reason))
        } else {
            // Each of these variables yields a reason for grade amber if its condition applies.
            let not_better = predicted.iter().find(|one| !one.is_better()).map(|not_better| {
                format!(
                    "The calibrated robot predicts held-out data no better than the nominal robot: {}.",
                    not_better.sentence()
                )
            });
            let serious = || limits.iter().find(|limit| limit.serious).map(|limit| limit.sentence.clone());
            let untested = || better.is_none().then(|| "No data were held out to check it.".to_owned());
            let missed = || missed(workspace, &predicted, required_m);
            let beyond = || beyond(workspace, &predicted);
            let nowhere_else = || known_nowhere_else(workspace);
            // The first reason that applies is reported.
            let reason = not_better
                .or_else(missed)
                .or_else(beyond)
                .or_else(serious)
                .or_else(nowhere_else)
                .or_else(untested);
            (if reason.is_some() { Grade::Amber } else { Grade::Green }, reason)
        };
        self.verdict = Some(CalibrationVerdict { grade, better, required_m, reason });
        self
    }

    /// One sentence with the grade, the position error on held-out data and the reason. Empty without a verdict.
    pub fn verdict_sentence(&self) -> String {
        let Some(verdict) = &self.verdict else { return String::new() };
        let number = self.held_out_m(Deployment::Full).map(|[nominal_m, calibrated_m]| {
            let [nominal, calibrated] = [nominal_m, calibrated_m].map(|metres| metres * 1e3);
            format!("{calibrated:.3} mm RMS on held-out data, nominal {nominal:.3} mm. ")
        });
        format!("verdict {}: {}{verdict}", verdict.grade, number.unwrap_or_default())
    }

    /// All limits except the reason of the verdict, the most important first.
    pub fn other_limits(&self) -> impl Iterator<Item = &Limit> {
        let reason = self.verdict.as_ref().and_then(|verdict| verdict.reason.as_ref());
        self.limits.iter().filter(move |limit| Some(&limit.sentence) != reason)
    }

    /// Whether the calibration may be applied: all held-out data are predicted better than by the nominal robot, or
    /// no data were held out.
    pub fn may_be_applied(&self) -> bool {
        self.verdict.as_ref().and_then(|verdict| verdict.better) != Some(false)
    }

    /// Errors on each held-out data set and each file of `--validate`, in position and, if it was measured, in rotation.
    pub(super) fn predicted(&self) -> Vec<Predicted> {
        let of_file = |ValidationEntry { name, data_set, nominal, calibrated, .. }: &ValidationEntry| {
            let rows = self.rows.iter().find(|rows| rows.data_set == *data_set);
            HeldOutErrors {
                what: format!("the rows of {name}"),
                independent: calibrated.rows,
                nominal: nominal.rms(),
                calibrated: Some(calibrated.rms()),
                fitted: rows.map_or(calibrated, |rows| &rows.fitted.joints).rms(),
            }
        };
        let held_out = self.held_out_with(Deployment::Full).into_iter();
        held_out.chain(self.validations.iter().map(of_file)).flat_map(Predicted::from_errors).collect()
    }
}

/// The largest contribution to the uncertainty of positions, as a limit.
fn largest_contribution(WorkspaceError { budget, .. }: &WorkspaceError) -> Option<Limit> {
    let most = budget.contributions.first().filter(|most| most.u_m > 0.0)?;
    let sentence =
        format!("{}: {:.0} % of the variance of a position.", most.source, 100.0 * budget.part(most));
    Some(Limit { sentence, serious: false })
}

/// Returns a reason if the uncertainty of the calibrated robot over the workspace is larger than the mean error of the
/// nominal robot. In this case the measurements cover too little of the workspace.
fn known_nowhere_else(workspace: &WorkspaceError) -> Option<String> {
    let (expanded_m, before_m) = (workspace.budget.expanded_m, workspace.before.mean_m);
    (expanded_m > before_m).then(|| {
        format!(
            "The result is valid near the measured poses only: over the whole workspace the robot is known within {:.3} mm (k = 2), \
             while the nominal one is off by {:.3} mm in the mean. Measure poses that are spread further.",
            expanded_m * 1e3,
            before_m * 1e3
        )
    })
}

/// Returns a reason if the error on held-out data is too large to be explained by the stated uncertainty and the
/// residuals of the fit.
fn beyond(WorkspaceError { budget, .. }: &WorkspaceError, predicted: &[Predicted]) -> Option<String> {
    let one = predicted.iter().find(|one| one.is_beyond(budget.expanded_m))?;
    let [calibrated, fitted, expanded] = [one.calibrated, one.fitted, budget.expanded_m].map(|m| m * 1e3);
    Some(format!(
        "{} are {calibrated:.3} mm off (RMS), data of the fit {fitted:.3} mm: more than the stated uncertainty of {expanded:.3} mm \
         (k = 2) explains. Measure more poses like these, or look for a change in between.",
        one.what
    ))
}

/// Returns a reason if the required accuracy is not met, either over the workspace or on held-out positions.
fn missed(workspace: &WorkspaceError, predicted: &[Predicted], required_m: Option<f64>) -> Option<String> {
    let required_m = required_m?;
    let expected_m = workspace.after.p95_upper_m;
    let of_workspace = (expected_m > required_m).then(|| {
        format!(
            "the error in 95 % of the workspace has an upper 97.5 % confidence bound of {:.3} mm",
            expected_m * 1e3
        )
    });
    let missed = of_workspace.or_else(|| {
        let one = predicted.iter().find(|one| one.is_position && one.calibrated > required_m)?;
        Some(one.sentence())
    })?;
    Some(format!("The required {} mm are not met: {missed}.", in_mm(required_m)))
}

/// Length in millimetres as the user entered it, without the rounding error of the conversion to metres.
fn in_mm(length_m: f64) -> f64 {
    (length_m * 1e9).round() / 1e6
}
