//! Errors of the robot's joints: which are taken, decided by fitting rows that were left out.

use super::samples::Weighing;
use super::{Fit, PoseError};
use crate::calibrate::terms::{Offer, select};
use crate::model::{JointTerm, JointWaves, Model, ParameterId, Period, Role};

/// Parts that the fitting rows are dealt into.
pub(super) const FOLDS: usize = 8;

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
    /// Standard deviations to choose from.
    pub(super) sigmas: &'static [f64],
}

fn joint_terms(wanted: fn(JointTerm) -> bool) -> Vec<ParameterId> {
    let term = |id: &ParameterId| matches!(*id, ParameterId::Joint { term, .. } if wanted(term));
    ParameterId::joint_terms().filter(term).collect()
}

/// What a robot's joints can be wrong by, but for parameters that are fixed.
pub(super) fn kinds(waves_last: u8, fix: &[ParameterId]) -> Vec<Kind> {
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
    kinds.iter_mut().for_each(|kind| kind.ids.retain(|id| !fix.contains(id)));
    kinds.retain(|kind| !kind.ids.is_empty());
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

/// Chooses among `kinds`, all of which are columns of `model` at its values, by the folds of the fit's samples, and gives
/// the model their roles.
pub(super) fn choose(
    fit: &Fit<'_>,
    model: &mut Model,
    kinds: &[Kind],
    folds: &[Vec<usize>],
    weighing: Weighing,
) -> Result<Vec<TermReport>, PoseError> {
    let columns = |kind: &Kind| {
        let own = model.columns().enumerate().filter(|(_, parameter)| kind.ids.contains(&parameter.id));
        own.map(|(column, _)| column).collect()
    };
    let scales = |kind: &Kind| kind.sigmas.iter().map(|sigma| sigma / kind.sigmas[0]).collect();
    let offers: Vec<Offer> =
        kinds.iter().map(|kind| Offer { columns: columns(kind), scales: scales(kind) }).collect();
    let offered = |column: &usize| offers.iter().any(|offer| offer.columns.contains(column));
    let (own, always): (Vec<usize>, Vec<usize>) = (0..model.columns().len()).partition(offered);
    // About the model without any of them, weighed as they are.
    let mut without = model.start();
    own.iter().for_each(|&column| without[column] = 0.0);
    let verdicts = match fit.samples.normals(model, weighing, folds)? {
        Some(normals) => select(&normals.about(&without), &always, &offers),
        None => Vec::new(),
    };
    let last = verdicts.iter().rev().find(|one| one.accepted).map_or(0.0, |one| one.after);
    let mut reports = Vec::new();
    for (index, kind) in kinds.iter().enumerate() {
        let taken = verdicts.iter().find(|one| one.offer == index && one.accepted);
        let sigma = taken.map(|one| one.scale * kind.sigmas[0]);
        let role = sigma.map_or(Role::Fixed, |sigma| Role::Prior { value: 0.0, sigma });
        model.set_roles(kind.ids.iter().copied(), role)?;
        if taken.is_none() {
            kind.ids.iter().try_for_each(|&id| model.set_value(id, 0.0))?;
        }
        reports.push(TermReport {
            name: kind.name.clone(),
            parameters: kind.ids.len(),
            sigma,
            rms_before: taken.map_or(last, |one| one.before).sqrt(),
            rms_after: taken.map_or(last, |one| one.after).sqrt(),
        });
    }
    Ok(reports)
}
