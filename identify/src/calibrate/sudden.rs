//! What changes at one instant of a run: the offset of an encoder, or a clock. Against nominal links a small change drowns in the
//! errors of the geometry (`prepare::judge` finds the large ones); against the calibrated ones it stands out.
//!
//! A change of a parameter from an instant on is one more column of the problem: the parameter's own, zero before the
//! instant. How much the sum of squares would fall with it, everything else solved anew, follows from the normal
//! equations: `fall = (p - n' N^-1 g)^2 / (s - n' N^-1 n)` with `n = J' c`, `s = c' c`, `p = c' r`, `g = J' r`
//! (score test, Rao 1948). `n`, `s` and `p` are sums over the folds from the instant on.

use std::iter;
use std::ops::Range;

use nalgebra::DVector;

use crate::kinematics::{BAR_JOINTS, LinkParameter};
use crate::model::{Model, ParameterId};
use crate::prepare::{PrepareError, PrepareOptions, Prepared};
use crate::solver::{Loss, Normal, Normals, Options, Problem, ScaledCholesky};

/// Samples of a run that are looked at, at most: what only more would show is too small to matter.
const SAMPLES_MAX: usize = 3000;
/// Samples to either side of an instant.
const BESIDE: usize = 20;
/// Instants that are tried at first; then all samples about the best.
const COARSE: usize = 250;
/// Part of the squared residuals that a change must take away.
const EXPLAINED: f64 = 0.5;
/// Part of what the right instant explains that the nearest of those tried at first explains at least: of the samples after
/// the last change, or before the first, [`BESIDE`] at least, it misses half a step of [`SAMPLES_MAX`] / [`COARSE`].
const NEAR: f64 = 0.5;
/// Jumps of a clock smaller than this are not looked for \[s\].
const JUMP_S_MIN: f64 = 0.002;
/// Part of a column that other columns must leave of it.
const INDEPENDENT: f64 = 1e-6;

/// What can change.
#[derive(Debug, Clone, Copy, PartialEq)]
enum What {
    /// The offset of the encoder of this joint, from 0.
    Zero(usize),
    Clock,
}

/// A change of a parameter at an instant.
#[derive(Debug, Clone, Copy)]
struct Change {
    what: What,
    /// First sample after it, among those that are looked at.
    at: usize,
    /// In the parameter's unit.
    by: f64,
    /// Of the squared residuals.
    fall: f64,
    /// The squared residuals.
    squared: f64,
}

/// The change that a run shows, as what the preparation would have said of it. `problem` is the run alone, with the columns
/// of its model.
pub(super) fn change(
    model: &Model,
    prepared: &Prepared,
    problem: &impl Problem,
    loss: Loss,
    options: &PrepareOptions,
) -> Option<PrepareError> {
    let every = problem.samples().div_ceil(SAMPLES_MAX).max(1);
    let samples: Vec<usize> = (0..problem.samples()).step_by(every).collect();
    let best = |folds: Vec<Range<usize>>| best(model, problem, loss, &samples, &folds);
    let stride = (samples.len() / COARSE).max(1);
    let borders = (0..samples.len()).step_by(stride);
    let coarse = best(borders.map(|from| from..(from + stride).min(samples.len())).collect())?;
    if coarse.fall < NEAR * EXPLAINED * coarse.squared {
        return None;
    }
    let near = coarse.at.saturating_sub(stride)..(coarse.at + stride + 1).min(samples.len());
    let singles = near.clone().map(|at| at..at + 1);
    let (before, after) = (0..near.start, near.end..samples.len());
    let found = best(iter::once(before).chain(singles).chain(iter::once(after)).collect())?;
    if found.fall < EXPLAINED * found.squared {
        return None;
    }
    let time_s = |at: usize| Some(prepared.observations.get(*samples.get(at)?)?.t_s);
    // Somewhere between two samples that may be apart.
    let at_s = 0.5 * (time_s(found.at - 1)? + time_s(found.at)?) - prepared.timeline.points.first()?.t_s;
    match found.what {
        // What the encoder shows too much its zero has to take away.
        What::Zero(joint) => (found.by.abs() > options.slip_min_mrad * 1e-3)
            .then_some(PrepareError::EncoderSlip { joint: joint as u8 + 1, at_s, by_mrad: -found.by * 1e3 }),
        What::Clock => {
            (found.by.abs() > JUMP_S_MIN).then_some(PrepareError::ClockJump { at_s, by_ms: found.by * 1e3 })
        }
    }
}

/// The change that takes most away, over the instants where a fold begins.
fn best(
    model: &Model,
    problem: &impl Problem,
    loss: Loss,
    samples: &[usize],
    folds: &[Range<usize>],
) -> Option<Change> {
    /// Keeps combinations that only other runs determine from dividing by zero.
    const RIDGE: f64 = 1e-12;
    let of_fold: Vec<Vec<usize>> = folds.iter().map(|fold| samples[fold.clone()].to_vec()).collect();
    let options = Options { loss, ..Options::default() };
    let normals = Normals::new(problem, &model.start(), &options, &of_fold)?;
    let Normal { matrix, gradient, squared, .. } = normals.whole();
    let factor = ScaledCholesky::damped(matrix.clone(), &matrix.diagonal(), RIDGE)?;
    let pulled = factor.solve(&gradient);
    let mut best: Option<Change> = None;
    for (what, column) in candidates(model) {
        let (mut n, mut s, mut p) = (DVector::zeros(gradient.len()), 0.0, 0.0);
        // From the end, so that the rows from an instant on are those that have been added.
        for (range, fold) in folds.iter().zip(normals.of_folds()).rev() {
            n += fold.matrix.column(column);
            s += fold.matrix[(column, column)];
            p += fold.gradient[column];
            let at = range.start;
            if at < BESIDE || samples.len() - at < BESIDE {
                continue;
            }
            let stiffness = s - n.dot(&factor.solve(&n));
            let pull = p - n.dot(&pulled);
            let fall = pull * pull / stiffness;
            if stiffness > INDEPENDENT * s && best.is_none_or(|best| fall > best.fall) {
                best = Some(Change { what, at, by: -pull / stiffness, fall, squared });
            }
        }
    }
    best
}

fn candidates(model: &Model) -> Vec<(What, usize)> {
    let zeros = (0..BAR_JOINTS)
        .map(|joint| (What::Zero(joint), ParameterId::Bar { link: joint, parameter: LinkParameter::Theta }));
    let all = zeros.chain([(What::Clock, ParameterId::ClockShift)]);
    all.filter_map(|(what, id)| Some((what, model.column_of(id)?))).collect()
}
