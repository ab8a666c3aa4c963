//! Solves with a robust loss whose scale is estimated from the residuals, as the scale of good samples is unknown.
//!
//! The *spread* is a robust estimate of the standard deviation of a residual. At the start it is large: residuals show errors of
//! the model rather than outliers, and a narrow bounded loss would have many local minima. A schedule therefore begins with a
//! Cauchy loss as wide as the spread, and narrows it as the spread decreases (graduated non-convexity, Blake and Zisserman 1987,
//! with a schedule from the data). Only the last solve uses the requested loss.

use super::loss::{CLEAN_QUANTILE, squared_norm_quantile};
use super::pass::fits;
use super::{LeastSquares, Loss, LossName, Options, SolveError, Summary, minimise};

/// Standard normal quantile of 0.95, which defines the scale of intermediate losses.
const INTERMEDIATE_QUANTILE: f64 = 1.645;
/// Accepted steps between two estimates of the spread.
const STEPS_BETWEEN: usize = 2;
/// The spread has converged if a round reduces it by less than this part.
const DECREASE_MIN: f64 = 0.02;
/// Residuals below this are rounding errors: no robust loss is needed.
const SPREAD_MIN: f64 = 1e-12;

/// Part of the samples that is assumed to be good, with its standard normal quantile.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GoodShare {
    share: f64,
    quantile: f64,
}

impl GoodShare {
    /// Half of the samples: the others may be wrong.
    pub const HALF: Self = Self { share: 0.5, quantile: 0.0 };
    /// Nine tenths of the samples: all except gross outliers.
    pub const NINE_TENTHS: Self = Self { share: 0.9, quantile: 1.2816 };

    /// The spread, from the squared norm and the number `n` of residuals of each sample: root of the `share` quantile of
    /// `squared norm / q(n)`, with `q(n)` the same quantile for `n` standard normal variables; zero without samples.
    pub fn spread(self, samples: impl Iterator<Item = (f64, usize)>) -> f64 {
        let mut variances: Vec<f64> =
            samples.map(|(squared, rows)| squared / squared_norm_quantile(rows, self.quantile)).collect();
        if variances.is_empty() {
            return 0.0;
        }
        let rank = ((variances.len() as f64 * self.share) as usize).min(variances.len() - 1);
        variances.select_nth_unstable_by(rank, f64::total_cmp).1.sqrt()
    }

    /// [`Self::spread`] of the samples that have a value at `x`.
    pub fn spread_at(self, problem: &dyn LeastSquares, x: &[f64]) -> f64 {
        self.spread(fits(problem, x).iter().filter(|fit| fit.present).map(|fit| (fit.squared, fit.rows)))
    }
}

/// How the loss is narrowed, in rounds: each improves the parameters with a loss for the spread before it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Schedule {
    /// Part of the samples that is assumed to be good, for the spread at the start and for those after the rounds.
    pub good: [GoodShare; 2],
    /// Lowest ratio of the scales of consecutive rounds: a faster decrease can converge to samples that fit by chance.
    pub narrowing: f64,
    /// After convergence one more round is tried, with a loss narrower by `narrowing`. If its spread is at most this part of the
    /// spread before, it has found a better minimum, and the rounds continue from there. `None`: it is not tried.
    pub better_max: Option<f64>,
    /// Highest number of rounds.
    pub rounds_max: usize,
}

impl Schedule {
    /// Half of the samples are assumed to be good throughout.
    const USUAL: Self = Self { good: [GoodShare::HALF; 2], narrowing: 0.0, better_max: None, rounds_max: 20 };

    /// Runs rounds from the parameters `x` until the spread converges; returns the parameters and their spread. `spread` computes
    /// the spread at parameters; `solve` is a round, which improves parameters with a loss for a spread
    /// ([`Loss::intermediate`]).
    ///
    /// # Errors
    /// As `solve`.
    pub fn converge<E>(
        &self,
        mut x: Vec<f64>,
        spread: impl Fn(&[f64], GoodShare) -> f64,
        solve: impl Fn(&[f64], f64) -> Result<Vec<f64>, E>,
    ) -> Result<(Vec<f64>, f64), E> {
        let [first, later] = self.good;
        let mut sigma = spread(&x, first);
        for _ in 0..self.rounds_max {
            if sigma <= SPREAD_MIN {
                break;
            }
            x = solve(&x, sigma)?;
            let mut new_sigma = spread(&x, later);
            if new_sigma > (1.0 - DECREASE_MIN) * sigma {
                let Some(better_max) = self.better_max else { return Ok((x, new_sigma)) };
                let narrower = solve(&x, self.narrowing * sigma)?;
                let narrower_sigma = spread(&narrower, later);
                if narrower_sigma > better_max * sigma {
                    return Ok((x, new_sigma));
                }
                (x, new_sigma) = (narrower, narrower_sigma);
            }
            sigma = new_sigma.max(self.narrowing * sigma);
        }
        Ok((x, sigma))
    }
}

impl Loss {
    /// Loss of a round of a schedule, for samples of `rows` residuals with this spread.
    pub fn intermediate(sigma: f64, rows: usize) -> Self {
        let scale = sigma * squared_norm_quantile(rows, INTERMEDIATE_QUANTILE).sqrt();
        Self { name: LossName::Cauchy, scale }
    }
}

impl LossName {
    /// Loss for samples of `rows` residuals with this spread: one good sample in a hundred is beyond its scale.
    pub fn for_spread(self, sigma: f64, rows: usize) -> Loss {
        let scale = sigma * squared_norm_quantile(rows, CLEAN_QUANTILE).sqrt();
        if sigma <= SPREAD_MIN { Loss::SQUARED } else { Loss { name: self, scale } }
    }

    /// The loss for the spread at `x`, where it has converged.
    pub fn for_spread_at(self, problem: &dyn LeastSquares, x: &[f64]) -> Loss {
        if self == Self::None {
            return Loss::SQUARED;
        }
        self.for_spread(GoodShare::HALF.spread_at(problem, x), problem.rows())
    }
}

/// Minimises with a loss whose scale is estimated during the solve; computes no rank and covariance.
///
/// # Errors
/// As [`minimise`].
pub fn minimise_robust(
    problem: &dyn LeastSquares,
    start: &[f64],
    loss: LossName,
    options: &Options<'_>,
) -> Result<(Vec<f64>, Summary), SolveError> {
    if loss == LossName::None {
        return minimise(problem, start, options);
    }
    let spread = |x: &[f64], good: GoodShare| good.spread_at(problem, x);
    let (x, sigma) = Schedule::USUAL.converge(start.to_vec(), spread, |x, sigma| {
        let intermediate = Options {
            loss: Loss::intermediate(sigma, problem.rows()),
            iterations_max: STEPS_BETWEEN,
            ..*options
        };
        Ok(minimise(problem, x, &intermediate)?.0)
    })?;
    minimise(problem, &x, &Options { loss: loss.for_spread(sigma, problem.rows()), ..*options })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The spread falls from 1 to 0.99 in the first solve, and no narrower loss reduces it further.
    #[test]
    fn the_spread_is_that_at_the_solution_whether_or_not_a_narrower_loss_was_tried() {
        for better_max in [None, Some(0.8)] {
            let schedule = Schedule { better_max, narrowing: 0.5, ..Schedule::USUAL };
            let spread = |x: &[f64], _: GoodShare| if x == [0.0] { 1.0 } else { 0.99 };
            let found = schedule.converge(vec![0.0], spread, |x, _| Ok::<_, SolveError>(vec![x[0] + 1.0]));
            assert!(matches!(found, Ok((x, sigma)) if x == [1.0] && sigma == 0.99));
        }
    }
}
