//! Errors of the robot's joints: which are taken, decided by fitting rows that were left out.

use nalgebra::DVector;

use super::samples::{Samples, Weighing};
use super::{PoseError, PoseRow};
use crate::calibrate::cross_validation::{Candidate, CrossValidation, Normal, StepPrior};
use crate::kinematics::ROBOT_JOINTS;
use crate::model::{JointTerm, JointWaves, Model, ParameterId, Period, Role};

/// Parts that the fitting rows are dealt into.
pub(super) const FOLDS: usize = 5;
/// Rows that are linearised at once: some megabytes.
const ROWS_AT_ONCE: usize = 128;

/// A kind of joint error, the same for all axes.
#[derive(Debug, Clone, PartialEq)]
pub struct TermReport {
    /// What it is.
    pub name: String,
    /// Its parameters.
    pub parameters: usize,
    /// Standard deviation of its prior around zero, in the parameter's SI unit; none where it was not taken.
    pub sigma: Option<f64>,
    /// Root mean square of left-out rows before it was taken, in standard deviations.
    pub rms_before: f64,
    /// And with it.
    pub rms_after: f64,
}

/// A candidate before columns are known.
pub(super) struct Kind {
    pub(super) name: String,
    pub(super) ids: Vec<ParameterId>,
    sigmas: &'static [f64],
}

fn joint_terms(wanted: fn(JointTerm) -> bool) -> Vec<ParameterId> {
    let term = |id: &ParameterId| matches!(*id, ParameterId::Joint { term, .. } if wanted(term));
    ParameterId::joint_terms().filter(term).collect()
}

/// What a robot's joints can be wrong by.
pub(super) fn kinds(waves_last: u8) -> Vec<Kind> {
    const ANGLES_RAD: &[f64] = &[20e-6, 100e-6, 500e-6];
    const SHARES: &[f64] = &[20e-6, 100e-6, 500e-6];
    use JointTerm::{Backlash, Compliance, Cosine, Ratio, Sine};
    let kind = |name: &str, ids, sigmas| Kind { name: name.into(), ids, sigmas };
    let mut kinds = vec![
        kind(
            "waves once and twice per turn",
            joint_terms(|term| {
                matches!(term, Sine(Period::Once | Period::Twice) | Cosine(Period::Once | Period::Twice))
            }),
            ANGLES_RAD,
        ),
        kind("backlash by direction of approach", joint_terms(|term| matches!(term, Backlash)), ANGLES_RAD),
        kind("transmission ratio", joint_terms(|term| matches!(term, Ratio)), SHARES),
        kind(
            "compliance under gravity",
            joint_terms(|term| matches!(term, Compliance(_))),
            &[100e-6, 1e-3, 1e-2],
        ),
    ];
    kinds.extend(BANDS.iter().filter_map(|band| waves(band, waves_last)));
    kinds
}

/// Waves per turn that are judged together: what is left of eccentric gears, encoders and flexsplines, fine teeth.
const BANDS: [std::ops::RangeInclusive<u8>; 3] = [JointWaves::FIRST..=10, 11..=30, 31..=JointWaves::LAST];

/// The waves of a band, as far as they are wanted.
fn waves(band: &std::ops::RangeInclusive<u8>, last: u8) -> Option<Kind> {
    const SIGMAS_RAD: &[f64] = &[10e-6, 20e-6, 50e-6, 100e-6];
    let (first, last) = (*band.start(), last.min(*band.end()));
    let within = |id: &ParameterId| matches!(id, ParameterId::JointWave { order, .. } if *order >= first);
    let ids: Vec<ParameterId> = ParameterId::joint_waves(last).filter(within).collect();
    let name = format!("{first} to {last} waves per turn");
    (!ids.is_empty()).then_some(Kind { name, ids, sigmas: SIGMAS_RAD })
}

/// Everything that the choice needs of one linearisation.
pub(super) struct Left<'a> {
    pub(super) rows: &'a [PoseRow],
    pub(super) directions: &'a [[f64; ROBOT_JOINTS]],
    pub(super) fitting: &'a [usize],
    /// Fold of each fitting row.
    pub(super) folds: &'a [usize],
    pub(super) weighing: Weighing,
}

impl Left<'_> {
    /// Normal equations of each fold at the model's values.
    pub(super) fn normals(&self, model: &Model) -> Result<Vec<Normal>, PoseError> {
        let of_fold = |fold: usize| -> Result<Normal, PoseError> {
            let mut normal = Normal::zeros(model.columns().len());
            let chosen: Vec<usize> = self.of_fold(fold).collect();
            for some in chosen.chunks(ROWS_AT_ONCE) {
                Samples::of(self.rows, self.directions, some).add_to(&mut normal, model, self.weighing)?;
            }
            Ok(normal)
        };
        (0..FOLDS).map(of_fold).collect()
    }

    fn of_fold(&self, fold: usize) -> impl Iterator<Item = usize> {
        let mine = self.folds.iter().zip(self.fitting).filter(move |(of, _)| **of == fold);
        mine.map(|(_, &row)| row)
    }

    /// Chooses among `kinds`, all of which are columns of `model` at its values, and gives the model their roles.
    pub(super) fn choose(&self, model: &mut Model, kinds: &[Kind]) -> Result<Vec<TermReport>, PoseError> {
        let candidates: Vec<Candidate> = kinds.iter().map(|kind| candidate(model, kind)).collect();
        let of_candidate = |column: usize| candidates.iter().any(|one| one.columns.contains(&column));
        let always = model.columns().enumerate().filter(|(column, _)| !of_candidate(*column));
        let prior = |(column, parameter): (usize, &crate::model::Parameter)| match parameter.role {
            Role::Prior { value, sigma } => StepPrior { column, expected: value - parameter.value, sigma },
            Role::Free | Role::Fixed => StepPrior { column, expected: 0.0, sigma: f64::INFINITY },
        };
        let always = always.map(prior).collect();
        let rows_each = Samples::of(self.rows, self.directions, self.fitting).rows();
        // About the model without any of them, weighed as they are.
        let away = model.columns().enumerate().map(
            |(column, parameter)| {
                if of_candidate(column) { -parameter.value } else { 0.0 }
            },
        );
        let away = DVector::from_iterator(model.columns().len(), away);
        let cross_validation = CrossValidation {
            folds: self.normals(model)?.iter().map(|fold| fold.about(&away)).collect(),
            always,
            residuals: rows_each * self.fitting.len(),
        };
        let chosen = cross_validation.choose(&candidates);
        let mut reports = Vec::new();
        for (index, kind) in kinds.iter().enumerate() {
            let taken = chosen.iter().find(|one| one.candidate == index);
            let role = taken.map_or(Role::Fixed, |one| Role::Prior { value: 0.0, sigma: one.sigma });
            model.set_roles(kind.ids.iter().copied(), role)?;
            if taken.is_none() {
                kind.ids.iter().try_for_each(|&id| model.set_value(id, 0.0))?;
            }
            let last = chosen.last().map_or(0.0, |one| one.rms_after);
            reports.push(TermReport {
                name: kind.name.clone(),
                parameters: kind.ids.len(),
                sigma: taken.map(|one| one.sigma),
                rms_before: taken.map_or(last, |one| one.rms_before),
                rms_after: taken.map_or(last, |one| one.rms_after),
            });
        }
        Ok(reports)
    }
}

fn candidate(model: &Model, kind: &Kind) -> Candidate {
    let columns = model.columns().enumerate().filter(|(_, parameter)| kind.ids.contains(&parameter.id));
    Candidate {
        name: kind.name.clone(),
        columns: columns.map(|(column, _)| column).collect(),
        sigmas: kind.sigmas.to_vec(),
    }
}
