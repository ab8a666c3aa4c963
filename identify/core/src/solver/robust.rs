//! Solves with a robust loss. The scale of the loss is estimated from the residuals, because the noise of samples that are
//! not outliers is unknown.
//!
//! The *spread* is a robust estimate of the standard deviation of a residual. At the start, errors of the model dominate the
//! residuals rather than outliers, and the spread is large. A narrow bounded loss would have many local minima there. A
//! [`Schedule`] therefore begins with a Cauchy loss as wide as the spread, and narrows the loss as the spread decreases.
//! This is graduated non-convexity (Blake and Zisserman 1987), with a schedule that depends on the data. Only the last solve
//! uses the requested loss.

use super::loss::{CLEAN_QUANTILE, squared_norm_quantile};
use super::pass::fits;
use super::{LeastSquares, Loss, LossName, Options, SolveError, Summary, minimise};

/// Standard normal quantile of 0.95. It defines the scale of the Cauchy losses before the last solve.
const INTERMEDIATE_QUANTILE: f64 = 1.645;
/// Number of accepted steps between two estimates of the spread.
const STEPS_BETWEEN: usize = 2;
/// The rounds end if a round reduces the spread by less than this fraction.
const DECREASE_MIN: f64 = 0.02;
/// A smaller spread consists of rounding errors, so no robust loss is needed.
const SPREAD_MIN: f64 = 1e-12;

/// Fraction of the samples that are assumed not to be outliers (`share`), and the standard normal quantile of this fraction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GoodShare {
    share: f64,
    quantile: f64,
}

impl GoodShare {
    /// At least half of the samples are assumed not to be outliers.
    pub const HALF: Self = Self { share: 0.5, quantile: 0.0 };
    /// At least nine tenths of the samples are assumed not to be outliers, so only the largest residuals are ignored.
    pub const NINE_TENTHS: Self = Self { share: 0.9, quantile: 1.2816 };

    /// Computes the spread. `samples` contains the squared residual norm of each sample and its number `n` of residuals.
    /// Each squared norm is divided by `q(n)`, the `share` quantile of the squared norm of `n` standard normal variables.
    /// The spread is the root of the `share` quantile of these ratios. Zero without samples.
    pub fn spread(self, samples: impl Iterator<Item = (f64, usize)>) -> f64 {
        let mut variances: Vec<f64> =
            samples.map(|(squared, rows)| squared / squared_norm_quantile(rows, self.quantile)).collect();
        if variances.is_empty() {
            return 0.0;
        }
        let rank = ((variances.len() as f64 * self.share) as usize).min(variances.len() - 1);
        variances.select_nth_unstable_by(rank, f64::total_cmp).1.sqrt()
    }

    /// Computes the spread of the samples that have a value at `x`, see [`Self::spread`].
    pub fn spread_at(self, problem: &dyn LeastSquares, x: &[f64]) -> f64 {
        self.spread(fits(problem, x).iter().filter(|fit| fit.present).map(|fit| (fit.squared, fit.rows)))
    }
}

/// How the loss is narrowed in rounds. Each round improves the parameters, with a loss whose scale follows from the
/// spread before the round.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Schedule {
    /// Fractions of the samples that are assumed not to be outliers. The first is for the spread at the start, the second
    /// for the spread after each round.
    pub good: [GoodShare; 2],
    /// Smallest ratio of the scales of two consecutive rounds. If the scale decreased faster, the solution
    /// could converge to samples that agree by chance.
    pub narrowing: f64,
    /// If set, an additional round follows convergence, with a loss that is narrower by the factor `narrowing`. The
    /// additional round has found a better minimum if its spread is at most `better_max` times the spread before. The
    /// schedule then continues from this minimum; otherwise the result of the additional round is discarded.
    pub better_max: Option<f64>,
    /// Highest number of rounds.
    pub rounds_max: usize,
}

impl Schedule {
    /// Assumes for all spreads that half of the samples are not outliers.
    const USUAL: Self = Self { good: [GoodShare::HALF; 2], narrowing: 0.0, better_max: None, rounds_max: 20 };

    /// Runs rounds from the parameters `x` until the spread converges. Returns the parameters and their spread. `spread`
    /// computes the spread at given parameters. `solve` runs one round: it improves given parameters, with the loss
    /// [`Loss::intermediate`] for a given spread.
    ///
    /// # Errors
    /// The errors of `solve`.
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
    /// Cauchy loss of one round, for samples of `rows` residuals with the spread `sigma`.
    pub fn intermediate(sigma: f64, rows: usize) -> Self {
        let scale = sigma * squared_norm_quantile(rows, INTERMEDIATE_QUANTILE).sqrt();
        Self { name: LossName::Cauchy, scale }
    }
}

impl LossName {
    /// Loss of the last solve, for samples of `rows` residuals with the spread `sigma`. One in a hundred samples that are
    /// not outliers is beyond the scale of the loss.
    pub fn for_spread(self, sigma: f64, rows: usize) -> Loss {
        let scale = sigma * squared_norm_quantile(rows, CLEAN_QUANTILE).sqrt();
        if sigma <= SPREAD_MIN { Loss::SQUARED } else { Loss { name: self, scale } }
    }

    /// Loss of the last solve. Its scale follows from the spread at `x`, the parameters at which the rounds have converged.
    pub fn for_spread_at(self, problem: &dyn LeastSquares, x: &[f64]) -> Loss {
        if self == Self::None {
            return Loss::SQUARED;
        }
        self.for_spread(GoodShare::HALF.spread_at(problem, x), problem.rows())
    }
}

/// Minimises with a robust loss whose scale is estimated during the solve. Rank and covariance are not computed.
///
/// # Errors
/// The errors of [`minimise`].
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

    /// The spread falls from 1 to 0.99 in the first round. A narrower loss does not reduce it further.
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
