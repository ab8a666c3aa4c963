//! Whether data sets that were solved together agree about the robot.
//!
//! A data set by itself would have the robot elsewhere than all together. With `H` and `g` its normal equations and their gradient
//! at the common solution, both with what is expected of the parameters, it would gain `g' H^-1 g` squares there. Where all data
//! sets are of one robot in one unit these are noise, at most that of the `p` numbers which it determines of what it shares
//! with the others (specification test, Hausman 1978): `g' H^-1 g / (p s^2)` is Fisher's F at most, with `s^2` what errors of
//! the data set are worth at its own solution, those that last for several samples counted as one.

use nalgebra::DVector;
use statrs::distribution::{ContinuousCDF, FisherSnedecor};

use crate::calibrate::pipeline::{LEFT_OUT, differ, is_own};
use crate::cost::{DataSets, SharedColumns};
use crate::instrument::Run;
use crate::solver::{Loss, Normals, Options};

/// Chance that something is said although all data sets agree.
const DISAGREES_BY_CHANCE: f64 = 1e-3;

/// A data set that contradicts the others.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Disagreement {
    /// From 0.
    pub data_set: usize,
    /// How many times larger its residuals are than by itself.
    pub times: f64,
}

/// Data sets that contradict the others at their common solution, which the runs' models are at; `sigmas` are what residuals of each
/// are worth, `loss` that of the solve. One alone agrees with itself.
pub fn disagreeing(runs: &[Run], sigmas: &[f64], loss: Loss) -> Vec<Disagreement> {
    if runs.len() < 2 {
        return Vec::new();
    }
    let differ = differ(runs);
    let one = |(data_set, (run, sigma)): (usize, (&Run, &f64))| {
        let Run { instrument, model } = run;
        let columns = SharedColumns::new([model], |_| false);
        let alone = DataSets::new(vec![instrument.data_set(model, *sigma).ok()?], &columns);
        let (x, groups) = (model.start(), instrument.independent(LEFT_OUT));
        let here = Normals::new(&alone, &x, &Options { loss, ..Options::default() }, &groups).ok()?;
        let step = here.step()?;
        let gained = -here.whole().gradient.dot(&step);
        let there = here.about((DVector::from_vec(x) + step).as_slice());
        let rows: f64 = there.of_folds().iter().map(|fold| fold.rows).sum();
        let taken: f64 = there.taken()?.iter().sum();
        let own = model.columns().filter(|parameter| is_own(parameter.id, &differ)).count();
        let shared = (taken - own as f64).max(1.0);
        let squared = there.whole().squared / (rows - taken).max(1.0);
        let lasting = there.overdispersion()?.max(squared);
        let fisher = FisherSnedecor::new(shared, there.folds() as f64 - 1.0).ok()?;
        let chance = fisher.sf((gained / (shared * lasting)).max(0.0));
        let times = (here.whole().squared / rows / squared).sqrt();
        (chance * (runs.len() as f64) < DISAGREES_BY_CHANCE).then_some(Disagreement { data_set, times })
    };
    runs.iter().zip(sigmas).enumerate().filter_map(one).collect()
}
