//! Terms that a robot may have or not: each kind is taken in only where it predicts data that it was not fitted to.

use serde::{Deserialize, Serialize};

use super::blocks::Blocks;
use crate::model::{JointTerm, ParameterId, Period};
use crate::solver::Prior;

/// Kinds of errors that come together or not at all.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TermGroup {
    /// Robot axes once per turn.
    GearOnce,
    /// Robot axes twice per turn.
    GearTwice,
    /// Robot axes per lobe of their cycloid gears.
    Cycloid,
    /// Robot axes per turn of their motors.
    Motor,
    /// Robot axes by waves whose number per turn is found in what is left.
    Ripple,
    /// Robot axes by the sign of their speed.
    Backlash,
    /// Gear ratios.
    Ratio,
    /// Axes that give way under weight.
    Compliance,
    /// Bar encoders once and twice per turn.
    EncoderHarmonics,
    /// The bar's length by its direction.
    BarLength,
}

impl TermGroup {
    /// Those of the robot.
    pub const OF_ROBOT: [Self; 8] = [
        Self::GearOnce,
        Self::GearTwice,
        Self::Cycloid,
        Self::Motor,
        Self::Ripple,
        Self::Backlash,
        Self::Ratio,
        Self::Compliance,
    ];

    /// Name in reports.
    pub const fn name(self) -> &'static str {
        match self {
            Self::GearOnce => "gear, once per turn",
            Self::GearTwice => "gear, twice per turn",
            Self::Cycloid => "gear, per cycloid lobe",
            Self::Motor => "gear, per motor turn",
            Self::Ripple => "gear, at orders found in the residual",
            Self::Backlash => "backlash",
            Self::Ratio => "gear ratio",
            Self::Compliance => "compliance under gravity",
            Self::EncoderHarmonics => "bar encoders, once and twice per turn",
            Self::BarLength => "bar length by direction",
        }
    }

    /// The group of a parameter; none for geometry and clocks.
    pub const fn of(id: ParameterId) -> Option<Self> {
        let term = match id {
            ParameterId::Joint { term, .. } => term,
            ParameterId::Harmonic { .. } => return Some(Self::EncoderHarmonics),
            ParameterId::JointWave { .. } => return Some(Self::Ripple),
            ParameterId::BarWave { .. } => return Some(Self::BarLength),
            _ => return None,
        };
        Some(match term {
            JointTerm::Sine(period) | JointTerm::Cosine(period) => match period {
                Period::Once => Self::GearOnce,
                Period::Twice => Self::GearTwice,
                Period::Cycloid => Self::Cycloid,
                Period::Motor => Self::Motor,
            },
            JointTerm::Backlash => Self::Backlash,
            JointTerm::Ratio => Self::Ratio,
            JointTerm::Compliance(_) => Self::Compliance,
        })
    }
}

/// What became of one kind of terms.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Candidate {
    /// Which.
    pub group: TermGroup,
    /// How many parameters it has.
    pub parameters: usize,
    /// Root mean square residual of held-out stretches without it, in standard deviations of the cost.
    pub held_out_before: f64,
    /// With it.
    pub held_out_after: f64,
    /// It predicts held-out stretches better by more than chance.
    pub accepted: bool,
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0), |(sum, count), value| (sum + value, count + 1.0));
    if count > 0.0 { sum / count } else { 0.0 }
}

/// The error falls by more than the standard error of its fall over the blocks, and not by a trifle.
fn falls(before: &[f64], after: &[f64]) -> bool {
    /// Part of the mean squared residual.
    const TRIFLE: f64 = 1e-3;
    let fall = || before.iter().zip(after).map(|(before, after)| before - after);
    let by = mean(fall());
    let spread = mean(fall().map(|one| (one - by).powi(2)));
    let standard_error = (spread / (before.len() as f64 - 1.0).max(1.0)).sqrt();
    by > standard_error && by > TRIFLE * mean(before.iter().copied())
}

/// Forward selection: of all groups the one that predicts held-out blocks best is taken in, then the best of the rest
/// beside it, until none improves the prediction. `groups` are the columns of each on offer, `always` those in any case.
/// Returns a report on each, and the columns that stay.
pub fn choose(
    blocks: &Blocks,
    always: &[usize],
    groups: &[(TermGroup, Vec<usize>)],
) -> (Vec<Candidate>, Vec<usize>) {
    let mut columns = always.to_vec();
    let mut report = Vec::new();
    let mut open: Vec<&(TermGroup, Vec<usize>)> = groups.iter().collect();
    let Some(mut before) = blocks.held_out(&columns) else { return (report, columns) };
    let root = |errors: &[f64]| mean(errors.iter().copied()).sqrt();
    loop {
        let tried = open.iter().enumerate().filter_map(|(at, (group, own))| {
            let with: Vec<usize> = columns.iter().chain(own).copied().collect();
            let after = blocks.held_out(&with)?;
            let candidate = Candidate {
                group: *group,
                parameters: own.len(),
                held_out_before: root(&before),
                held_out_after: root(&after),
                accepted: falls(&before, &after),
            };
            Some((at, candidate, after))
        });
        let tried: Vec<(usize, Candidate, Vec<f64>)> = tried.collect();
        let accepted = tried.iter().filter(|(_, candidate, _)| candidate.accepted);
        let best = accepted.min_by(|a, b| a.1.held_out_after.total_cmp(&b.1.held_out_after)).cloned();
        let Some((at, candidate, after)) = best else {
            report.extend(tried.into_iter().map(|(_, candidate, _)| candidate));
            return (report, columns);
        };
        columns.extend(&open.remove(at).1);
        report.push(candidate);
        before = after;
    }
}

/// By how much to scale the standard deviations of the priors on some columns: the value on a grid that predicts held-out
/// blocks best, if it does so by more than chance, otherwise one.
pub fn prior_scale(blocks: &Blocks, columns: &[usize], scaled: impl Fn(usize) -> bool) -> f64 {
    const GRID: [f64; 8] = [0.1, 0.2, 0.5, 2.0, 5.0, 10.0, 30.0, 100.0];
    let errors = |scale: f64| {
        let of = |prior: &Prior| if scaled(prior.column) { prior.sigma * scale } else { prior.sigma };
        let priors: Vec<Prior> =
            blocks.priors().iter().map(|prior| Prior { sigma: of(prior), ..*prior }).collect();
        blocks.held_out_with(columns, &priors)
    };
    let Some(unscaled) = errors(1.0) else { return 1.0 };
    let better = GRID.into_iter().filter_map(|scale| {
        let errors = errors(scale).filter(|errors| falls(&unscaled, errors))?;
        Some((scale, mean(errors.into_iter())))
    });
    better.min_by(|a, b| a.1.total_cmp(&b.1)).map_or(1.0, |(scale, _)| scale)
}
