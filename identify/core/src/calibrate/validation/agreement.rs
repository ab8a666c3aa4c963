//! Tests whether data sets that were solved together agree about the robot. The report lists disagreements as limitations.
//!
//! If a single data set were solved alone, its solution would differ from the joint solution. Let `H` be the normal
//! equations of this data set and `g` their gradient, both at the joint solution and with the priors. The sum of squares of
//! the data set is smaller by `g' H^-1 g` at its own solution.
//!
//! If all data sets are of one robot and in one unit, only noise causes this reduction (specification test, Hausman 1978).
//! The noise acts on the `p` effective parameters that the data set has in common with the other data sets. `p` is the
//! number of effective parameters minus the number of columns that only this data set has. Then `g' H^-1 g / (p s^2)` is not
//! larger than a variable with Fisher's F distribution with `p` and `folds - 1` degrees of freedom. `s^2` is the error
//! variance of the data set at its own solution, which accounts for correlated errors.

use nalgebra::DVector;
use statrs::distribution::{ContinuousCDF, FisherSnedecor};

use crate::calibrate::pipeline::{LEFT_OUT, differ, is_own};
use crate::instrument::Run;
use crate::solver::{Loss, Normals, Options};

/// Probability that at least one data set is reported although all agree.
const DISAGREES_BY_CHANCE: f64 = 1e-3;

/// A data set that contradicts the others.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Disagreement {
    /// Index of the data set, from 0.
    pub data_set: usize,
    /// Ratio of two root mean square residuals of this data set: in the joint solution and in its own solution.
    pub times: f64,
}

/// Finds the data sets that contradict the others. The models must be at the joint solution. `sigmas` contains the residual
/// standard deviation of each data set, and `loss` is the loss of the solve. Returns nothing if there is only one data set.
pub fn disagreeing(runs: &[Run], sigmas: &[f64], loss: Loss) -> Vec<Disagreement> {
    if runs.len() < 2 {
        return Vec::new();
    }
    let own_lengths = differ(runs);
    let test = |(data_set, (run, sigma)): (usize, (&Run, &f64))| {
        let Run { instrument, model } = run;
        let alone = instrument.data_set(model, *sigma).ok()?;
        // The normal equations of the data set alone, at the joint solution and at its own solution.
        let (x, groups) = (model.start(), instrument.independent(LEFT_OUT));
        let at_joint = Normals::new(&*alone, &x, &Options { loss, ..Options::default() }, &groups).ok()?;
        // `step` is `-H^-1 g`, and `reduction` is `g' H^-1 g`.
        let step = at_joint.step()?;
        let reduction = -at_joint.whole().gradient.dot(&step);
        let at_own = at_joint.about((DVector::from_vec(x) + step).as_slice());
        // `p`, the number of effective parameters in common with other data sets, and the error variance `s^2`.
        let rows: f64 = at_own.of_folds().iter().map(|fold| fold.rows).sum();
        let effective: f64 = at_own.taken()?.iter().sum();
        let not_shared = model.columns().filter(|parameter| is_own(parameter.id, &own_lengths)).count();
        let p = (effective - not_shared as f64).max(1.0);
        let residual_variance = at_own.whole().squared / (rows - effective).max(1.0);
        let s_squared = at_own.overdispersion()?.max(residual_variance);
        let fisher = FisherSnedecor::new(p, at_own.folds() as f64 - 1.0).ok()?;
        let chance = fisher.sf((reduction / (p * s_squared)).max(0.0));
        let times = (at_joint.whole().squared / rows / residual_variance).sqrt();
        (chance * (runs.len() as f64) < DISAGREES_BY_CHANCE).then_some(Disagreement { data_set, times })
    };
    runs.iter().zip(sigmas).enumerate().filter_map(test).collect()
}
