//! A start for solves where so many samples are grossly wrong that no loss leads away from them.
//!
//! Random samples few enough to be all good by chance are solved for (RANSAC: Fischler and Bolles 1981). Trials are ranked
//! without a threshold, by the squared residual that a given share of all samples stays below (least quantile of squares:
//! Rousseeuw 1984), and the best are solved again with the samples that fit them best until those no longer change
//! (concentration steps: Rousseeuw and Van Driessen 2006). Equal seeds give equal results.

use rand::seq::index;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use super::pass::{squared_norms, squared_norms_of_all};
use super::{Loss, Options, Problem, SolveError, Subset, minimise};

/// How to look for a start.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RansacOptions {
    /// Of the random choices.
    pub seed: u64,
    /// Random subsets tried.
    pub trials: usize,
    /// Samples of a subset; none: half as many rows as columns. Few are good together more often, and directions that they
    /// leave open stay at the start.
    pub subset: Option<usize>,
    /// Share of all samples that is certainly good.
    pub good_share: f64,
    /// Best trials that are refined.
    pub refined: usize,
}

impl Default for RansacOptions {
    fn default() -> Self {
        Self { seed: 1, trials: 300, subset: None, good_share: 0.4, refined: 5 }
    }
}

/// Steps of each trial and each refinement.
const ITERATIONS: usize = 8;
/// Refinements of a trial at most.
const CONCENTRATIONS: usize = 10;
/// A refinement that gains less is the last one.
const GAIN_MIN: f64 = 1e-3;

/// Parameters with the squared residual that the good share stays below.
struct Candidate {
    x: Vec<f64>,
    quantile: f64,
}

struct Search<'a, P> {
    problem: &'a P,
    start: &'a [f64],
    good: usize,
    options: Options<'a>,
}

impl<P: Problem> Search<'_, P> {
    /// Solves for some samples from some parameters on; none where these samples cannot be solved for.
    fn solved(&self, samples: Vec<usize>, from: &[f64]) -> Result<Option<Candidate>, SolveError> {
        let subset = Subset { of: self.problem, samples };
        match minimise(&subset, from, &self.options) {
            Ok((x, _)) => Ok(self.ranked(x)),
            Err(error @ SolveError::Cancelled { .. }) => Err(error),
            Err(_) => Ok(None),
        }
    }

    fn ranked(&self, x: Vec<f64>) -> Option<Candidate> {
        let mut squares = squared_norms(self.problem, &x);
        let at = self.good.min(squares.len()).checked_sub(1)?;
        let quantile = *squares.select_nth_unstable_by(at, f64::total_cmp).1;
        quantile.is_finite().then_some(Candidate { x, quantile })
    }

    /// Solves for the samples that fit best, again and again.
    fn concentrated(&self, mut best: Candidate) -> Result<Candidate, SolveError> {
        for _ in 0..CONCENTRATIONS {
            let squares = squared_norms_of_all(self.problem, &best.x);
            let mut order: Vec<usize> = (0..squares.len()).collect();
            order.sort_by(|&a, &b| squares[a].total_cmp(&squares[b]));
            order.truncate(self.good);
            order.sort_unstable();
            let Some(next) = self.solved(order, &best.x)? else { break };
            let gained = next.quantile < (1.0 - GAIN_MIN) * best.quantile;
            if next.quantile < best.quantile {
                best = next;
            }
            if !gained {
                break;
            }
        }
        Ok(best)
    }
}

/// Parameters that fit the good share of the samples, near those at `start`: not a solution but where to begin one with a
/// bounded loss.
///
/// # Errors
/// [`SolveError`] where not even the start has a value, or who looks on ended it.
pub fn ransac<P: Problem>(
    problem: &P,
    start: &[f64],
    ransac: &RansacOptions,
    options: &Options<'_>,
) -> Result<Vec<f64>, SolveError> {
    let samples = problem.samples();
    let wanted = problem.columns().div_ceil(2 * problem.rows().max(1));
    let subset = ransac.subset.unwrap_or(wanted).clamp(1, samples.max(1));
    let good = ((ransac.good_share.clamp(0.0, 1.0) * samples as f64) as usize).max(subset);
    let options = Options { loss: Loss::Squared, iterations_max: ITERATIONS, ..*options };
    let search = Search { problem, start, good, options };
    let Some(from_start) = search.ranked(start.to_vec()) else {
        return Err(SolveError::NoSamples { samples });
    };
    let mut random = ChaCha8Rng::seed_from_u64(ransac.seed);
    let mut best = vec![from_start];
    for _ in 0..ransac.trials {
        let drawn = index::sample(&mut random, samples, subset).into_vec();
        best.extend(search.solved(drawn, search.start)?);
        best.sort_by(|a, b| a.quantile.total_cmp(&b.quantile));
        best.truncate(ransac.refined.max(1));
    }
    let refined = best.into_iter().map(|one| search.concentrated(one)).collect::<Result<Vec<_>, _>>()?;
    let best = refined.into_iter().min_by(|a, b| a.quantile.total_cmp(&b.quantile));
    Ok(best.map_or_else(|| start.to_vec(), |best| best.x))
}
