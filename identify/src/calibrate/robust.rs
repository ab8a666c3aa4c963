//! Losses by name, with scales that follow the spread of the residuals.

use serde::{Deserialize, Serialize};

use crate::solver::{
    self, Loss, Options, Problem, RansacOptions, Solution, SolveError, minimise, ransac, squared_norms,
};

/// How much a sample counts that does not fit. Scales are such that one clean sample in a hundred is beyond them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "snake_case")]
#[value(rename_all = "snake_case")]
pub enum LossName {
    /// Every sample counts fully.
    None,
    /// Beyond the scale a sample pulls no harder: costs nothing where there are no outliers.
    Huber,
    /// Beyond the scale a sample pulls ever less.
    Cauchy,
    /// A gross outlier has no pull: for many of them.
    GemanMcclure,
}

impl LossName {
    /// The loss of samples of `rows` residuals each that are in standard deviations.
    pub(super) fn for_whitened(self, rows: usize) -> Loss {
        self.with_scale(squared_norm_quantile(rows, NORMAL[2]).sqrt())
    }

    fn with_scale(self, scale: f64) -> Loss {
        match self {
            Self::None => Loss::Squared,
            Self::Huber => Loss::Huber { scale },
            Self::Cauchy => Loss::Cauchy { scale },
            Self::GemanMcclure => Loss::GemanMcClure { scale },
        }
    }
}

/// Standard normal quantiles of one half, 0.95 and 0.99.
const NORMAL: [f64; 3] = [0.0, 1.645, 2.326];
/// Accepted steps between two looks at the spread.
const STEPS_BETWEEN: usize = 2;
const LOOKS_MAX: usize = 20;
/// The spread has settled when it falls by less than this part.
const SETTLED: f64 = 0.02;
/// Residuals below this are rounding: there is nothing to be robust against.
const SPREAD_MIN: f64 = 1e-12;

/// Quantile of the squared norm of `rows` standard normal numbers (Wilson and Hilferty 1931).
fn squared_norm_quantile(rows: usize, normal: f64) -> f64 {
    let n = rows as f64;
    let ninth = 2.0 / (9.0 * n);
    n * (1.0 - ninth + normal * ninth.sqrt()).powi(3)
}

/// A share of the samples that is taken as good, and the standard normal quantile of that share.
#[derive(Debug, Clone, Copy)]
pub(super) struct GoodShare {
    share: f64,
    normal: f64,
}

/// Of what is usual: half of the samples may be wrong.
pub(super) const HALF: GoodShare = GoodShare { share: 0.5, normal: NORMAL[0] };
/// Where more than half may be.
pub(super) const TWO_FIFTHS: GoodShare = GoodShare { share: 0.4, normal: -0.2533 };

/// Standard deviation of a residual row, from the samples that fit best.
fn spread<P: Problem>(problem: &P, x: &[f64], good: GoodShare) -> f64 {
    let mut squared = squared_norms(problem, x);
    if squared.is_empty() {
        return 0.0;
    }
    let last = ((squared.len() as f64 * good.share) as usize).min(squared.len() - 1);
    let quantile = *squared.select_nth_unstable_by(last, f64::total_cmp).1;
    (quantile / squared_norm_quantile(problem.rows(), good.normal)).sqrt()
}

/// Solves with a loss whose scale is found on the way.
///
/// At the start residuals show the geometry's errors, not outliers. A Cauchy loss whose scale follows the median residual
/// down leaves outliers behind as the fit improves (graduated non-convexity with the data's own schedule); the loss asked
/// for, at the spread so found, has the last word.
///
/// # Errors
/// As [`solver::solve`].
pub fn solve_robust<P: Problem>(
    problem: &P,
    start: &[f64],
    loss: LossName,
    options: &Options,
) -> Result<Solution, SolveError> {
    narrowed(problem, start.to_vec(), loss, options, HALF)
}

/// The same where up to three fifths of the samples may be wrong however far: a start from random subsets ([`ransac`]), then
/// the loss, whose scale follows the best two fifths.
///
/// # Errors
/// As [`solver::solve`].
pub fn solve_from_subsets<P: Problem>(
    problem: &P,
    start: &[f64],
    loss: LossName,
    options: &Options<'_>,
) -> Result<Solution, SolveError> {
    let choice = RansacOptions { good_share: TWO_FIFTHS.share, ..RansacOptions::default() };
    let x = ransac(problem, start, &choice, options)?;
    narrowed(problem, x, loss, options, TWO_FIFTHS)
}

/// The loss asked for with the scale of the residuals at `x`, where the spread has settled already.
pub(super) fn settled<P: Problem>(problem: &P, x: &[f64], loss: LossName, good: GoodShare) -> Loss {
    let sigma = spread(problem, x, good);
    if loss == LossName::None || sigma <= SPREAD_MIN {
        return Loss::Squared;
    }
    loss.with_scale(sigma * squared_norm_quantile(problem.rows(), NORMAL[2]).sqrt())
}

fn narrowed<P: Problem>(
    problem: &P,
    mut x: Vec<f64>,
    loss: LossName,
    options: &Options<'_>,
    good: GoodShare,
) -> Result<Solution, SolveError> {
    if loss == LossName::None {
        return solver::solve(problem, &x, options);
    }
    let mut sigma = spread(problem, &x, good);
    for _ in 0..LOOKS_MAX {
        if sigma <= SPREAD_MIN {
            return solver::solve(problem, &x, options);
        }
        let scale = sigma * squared_norm_quantile(problem.rows(), NORMAL[1]).sqrt();
        let between = Options { loss: Loss::Cauchy { scale }, iterations_max: STEPS_BETWEEN, ..*options };
        x = minimise(problem, &x, &between)?.0;
        let before = std::mem::replace(&mut sigma, spread(problem, &x, good));
        if sigma > (1.0 - SETTLED) * before {
            break;
        }
    }
    let scale = sigma * squared_norm_quantile(problem.rows(), NORMAL[2]).sqrt();
    solver::solve(problem, &x, &Options { loss: loss.with_scale(scale), ..*options })
}
