//! Computes the optimal weights of poses. A weight is the fraction of the measurements at a pose. Poses may be repeated any
//! number of times, and motion between them takes no time. The variance at this optimum is therefore a lower bound for every
//! path and every selection of poses. The efficiency of a path or selection is the ratio of this bound to its variance. A
//! search moves its path towards the poses of the optimum.
//!
//! Of `n` measurements, the fraction `w_i` is at pose `i`, whose Jacobian in units of standard deviations is `J_i`. The
//! covariance is `P = (prior + n sum w_i J_i^T J_i)^-1`. The variance `v = tr(W P)` with the weight matrix `W` is convex in
//! the fractions (Chaloner 1984 with priors). Its decrease with `w_i` is `d_i = n tr(J_i P W P J_i^T)`. The multiplicative
//! algorithm (Silvey, Titterington and Torsney 1978) repeats `w_i <- w_i sqrt(d_i)`, followed by normalisation.
//!
//! Let `m = sum w_i d_i`. For any choice of fractions, the variance is at least `v^2 / (v + max d_i - m)`. This follows from
//! duality: `tr(W P') >= 2 s tr(W P) - s^2 tr(P W P P'^-1)` for every covariance `P'` and number `s`.

use nalgebra::{DMatrix, DVector};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use super::poses::{squared, times};
use super::random::{random_poses, start};
use super::{Checked, Constraints, Information};
use crate::solver::ScaledCholesky;

/// Highest number of steps of the algorithm.
const STEPS_MAX: usize = 300;
/// The bound has converged if `(max d_i - m) / v` is at most this.
const GAP: f64 = 0.05;
/// The bound is used only if it exceeds this fraction of the variance of the best weights found.
const TIGHT: f64 = 0.9;
/// Number of random poses that are combined with the poses of a path.
const RANDOM_POSES: usize = 1000;
/// Largest number of poses of the path that are used. It corresponds to four minutes of a path. Longer paths are thinned,
/// without loss of information.
const PATH_POSES_MAX: usize = 2400;
/// Number of poses towards which a search moves its path. They are the poses with the largest weights. About half of them
/// have most of the weight.
const GOALS: usize = 60;

/// Nearly optimal weights of poses.
#[derive(Debug, Clone, PartialEq)]
pub struct Optimum {
    /// Lower bound of the variance for any choice of weights \[SI\].
    pub variance_min: f64,
    /// Variance for the weights `parts` \[SI\].
    pub variance: f64,
    /// Weight of each pose; their sum is one.
    pub parts: Vec<f64>,
}

/// The most informative poses of the bar \[rad\]: the poses with the largest optimal weights among a set of random poses.
/// Empty if the random poses leave a parameter undetermined.
pub(super) fn goals(
    constraints: &Constraints<'_>,
    information: &Information,
    random: &mut impl Rng,
) -> Vec<[f64; 5]> {
    let Ok((_, near_rad)) = start(constraints, random) else { return Vec::new() };
    let poses = random_poses(constraints, near_rad, RANDOM_POSES / 2, random);
    let Some(best) = information.optimum(&poses, constraints.design.duration_s) else { return Vec::new() };
    let mut by_part: Vec<usize> = (0..best.parts.len()).collect();
    by_part.sort_by(|a, b| best.parts[*b].total_cmp(&best.parts[*a]));
    by_part.into_iter().take(GOALS).map(|pose| poses.bar_rad[pose]).collect()
}

/// Lower bound of the RMS position error when all terms of the axes are estimated \[m\]. It holds for every run that has
/// the path's length and the path's configuration of shoulder, elbow and wrist. It is computed from the poses of the
/// path and random poses.
///
/// `None` if the poses leave a parameter undetermined, if the bound did not converge, or if the arm does not have six axes.
pub fn position_m_min(
    checked: &Checked,
    constraints: &Constraints<'_>,
    information: &Information,
) -> Option<f64> {
    // The configuration is known only for arms with six axes. If the configuration were free, the bound would be far below
    // the variance of any path.
    if constraints.limits.len() != 6 {
        return None;
    }
    let visited = &checked.visited;
    let random = &mut ChaCha8Rng::seed_from_u64(1);
    let mut poses = random_poses(constraints, visited.robot.first()?.q, RANDOM_POSES, random);
    let stride = visited.robot.len().div_ceil(PATH_POSES_MAX).max(1);
    poses.bar_rad.extend(visited.bar_rad.iter().step_by(stride));
    poses.robot.extend(visited.robot.iter().step_by(stride));
    let best = information.optimum(&poses, checked.duration_s)?;
    (best.variance_min > TIGHT * best.variance).then(|| best.variance_min.sqrt())
}

/// Computes the weights of poses with the least `tr(weight covariance)`, for `measurements` measurements. `prior` is the
/// information without measurements. `rows` is the Jacobian in units of standard deviations, with `rows_per_pose` rows for
/// each pose. `None` if the poses leave a parameter undetermined.
pub(super) fn optimum(
    prior: &DMatrix<f64>,
    (rows, rows_per_pose): (&DMatrix<f64>, usize),
    measurements: f64,
    weight: &DMatrix<f64>,
) -> Option<Optimum> {
    let poses = rows.nrows() / rows_per_pose;
    if poses == 0 {
        return None;
    }
    let mut parts = vec![1.0 / poses as f64; poses];
    let (mut bound, mut step) = (0.0_f64, 0);
    loop {
        let root =
            DVector::from_fn(rows.nrows(), |row, _| (measurements * parts[row / rows_per_pose]).sqrt());
        // Covariance and variance for the current weights.
        let mut weighted_rows = rows.clone();
        weighted_rows.column_iter_mut().for_each(|mut column| column.component_mul_assign(&root));
        let covariance = ScaledCholesky::new(prior + squared(&weighted_rows))?.inverse();
        let variance = weight.dot(&covariance);
        // The product J P W P.
        let jpwp = times(rows, &(&covariance * weight * &covariance));
        let decrease = |pose: usize| {
            let [jpwp_of_pose, rows_of_pose] =
                [&jpwp, rows].map(|matrix| matrix.rows(pose * rows_per_pose, rows_per_pose));
            (measurements * jpwp_of_pose.dot(&rows_of_pose)).max(0.0)
        };
        let decreases: Vec<f64> = (0..poses).map(decrease).collect();
        // The bound: `gap` is `max d_i - m`.
        let mean: f64 = parts.iter().zip(&decreases).map(|(part, decrease)| part * decrease).sum();
        let gap = decreases.iter().fold(0.0_f64, |largest, decrease| largest.max(*decrease)) - mean;
        bound = bound.max(variance.powi(2) / (variance + gap));
        step += 1;
        if gap <= GAP * variance || step == STEPS_MAX {
            return Some(Optimum { variance_min: bound, variance, parts });
        }
        // The multiplicative step of the weights.
        parts.iter_mut().zip(&decreases).for_each(|(part, decrease)| *part *= decrease.sqrt());
        let sum: f64 = parts.iter().sum();
        parts.iter_mut().for_each(|part| *part /= sum);
    }
}
