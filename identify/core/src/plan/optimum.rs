//! Lower bound of the variance for freely chosen poses, with any repetition and without motion between them. Its ratio to the
//! variance of a path or a selection of poses is their efficiency. A search moves its path towards the poses of the optimum.
//!
//! Pose `i` with whitened rows `J_i` has the part `w_i` of `n` measurements: `P = (prior + n sum w_i J_i^T J_i)^-1`. The
//! variance `v = tr(W P)` is convex in the parts (Chaloner 1984 with priors); `d_i = n tr(J_i P W P J_i^T)` is its decrease with
//! `w_i`. The multiplicative algorithm (Silvey, Titterington and Torsney 1978) repeats `w_i <- w_i sqrt(d_i)`, normalised. With
//! `m = sum w_i d_i` no parts have a variance below `v^2 / (v + max d_i - m)`, by duality: `tr(W P') >= 2 s tr(W P) - s^2
//! tr(P W P P'^-1)` for every covariance `P'` and number `s`.

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
/// The bound is used if it exceeds this part of the variance of the best weights found.
const TIGHT: f64 = 0.9;
/// Number of random poses for comparison with a path.
const RANDOM_POSES: usize = 1000;
/// Highest number of poses of the path in addition: those of four minutes. Longer paths are thinned without loss of
/// information.
const PATH_POSES_MAX: usize = 2400;
/// Number of poses with the largest weights that attract a path: about twice the number that has most of the weight.
const GOALS: usize = 60;

/// Nearly optimal weights of poses.
#[derive(Debug, Clone, PartialEq)]
pub struct Optimum {
    /// Lower bound of the variance for any weights \[SI\].
    pub variance_min: f64,
    /// Variance for these weights \[SI\].
    pub variance: f64,
    /// Weight of each pose; their sum is one.
    pub parts: Vec<f64>,
}

/// The most informative poses of the bar, those with the largest optimal weights among random ones \[rad\]; empty if these
/// leave a parameter undetermined.
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

/// Lower bound of the RMS position error with all terms of the axes \[m\] for every run of a path's length in the same
/// configuration of shoulder, elbow and wrist, from its poses and random ones. `None` if they leave a parameter undetermined, if
/// the bound did not converge, and for arms without exactly six axes.
pub fn position_m_min(
    checked: &Checked,
    constraints: &Constraints<'_>,
    information: &Information,
) -> Option<f64> {
    // The configuration is only known for six axes: with a free one the bound is far below any path.
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

/// Optimal parts of poses, with any repetition, of `measurements` of them for the least `tr(weight covariance)`. `prior` is the
/// information without measurements, `rows` has `rows_per_pose` rows of each pose in standard deviations. `None` if the poses
/// leave a parameter undetermined.
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
        let mut weighted_rows = rows.clone();
        weighted_rows.column_iter_mut().for_each(|mut column| column.component_mul_assign(&root));
        let covariance = ScaledCholesky::new(prior + squared(&weighted_rows))?.inverse();
        let variance = weight.dot(&covariance);
        // J P W P
        let jpwp = times(rows, &(&covariance * weight * &covariance));
        let decrease = |pose: usize| {
            let [jpwp_of_pose, rows_of_pose] =
                [&jpwp, rows].map(|matrix| matrix.rows(pose * rows_per_pose, rows_per_pose));
            (measurements * jpwp_of_pose.dot(&rows_of_pose)).max(0.0)
        };
        let decreases: Vec<f64> = (0..poses).map(decrease).collect();
        let mean: f64 = parts.iter().zip(&decreases).map(|(part, decrease)| part * decrease).sum();
        let gap = decreases.iter().fold(0.0_f64, |largest, decrease| largest.max(*decrease)) - mean;
        bound = bound.max(variance.powi(2) / (variance + gap));
        step += 1;
        if gap <= GAP * variance || step == STEPS_MAX {
            return Some(Optimum { variance_min: bound, variance, parts });
        }
        parts.iter_mut().zip(&decreases).for_each(|(part, decrease)| *part *= decrease.sqrt());
        let sum: f64 = parts.iter().sum();
        parts.iter_mut().for_each(|part| *part /= sum);
    }
}
