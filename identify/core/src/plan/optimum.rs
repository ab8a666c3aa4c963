//! Lower bound of the variance for freely chosen poses, with any repetition and without motion between them. Its ratio to the
//! variance of a path or a selection of poses is their efficiency.
//!
//! Weights of poses as parts of a measurement are a design measure, and the variance is convex in it (Chaloner 1984 with
//! priors). The multiplicative algorithm (Silvey, Titterington and Torsney 1978) finds the optimal weights. With covariance
//! `P`, weight `W`, the largest decrease `d` of the variance `v` along any pose and the mean decrease `m`, no weights have a
//! variance below `v^2 / (v + d - m)`. This is the bound of duality, from `tr(W P') >= 2 s tr(W P) - s^2 tr(P W P P'^-1)` for
//! every covariance `P'` and number `s`.

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
/// The bound has converged if `(d - m) / v` is at most this.
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
    let mut largest: Vec<usize> = (0..best.parts.len()).collect();
    largest.sort_by(|a, b| best.parts[*b].total_cmp(&best.parts[*a]));
    largest.into_iter().take(GOALS).map(|pose| poses.bar_rad[pose]).collect()
}

/// Lower bound of the RMS position error with all terms of the axes \[m\] for every run of a path's length with the same elbow
/// and wrist, from its poses and random ones. `None` if they leave a parameter undetermined, if the bound did not converge, and
/// for arms with more than six axes.
pub fn position_m_min(
    checked: &Checked,
    constraints: &Constraints<'_>,
    information: &Information,
) -> Option<f64> {
    // The configuration of elbow and wrist is only known for six axes: with a free one the bound is far below any path.
    if constraints.limits.len() != 6 {
        return None;
    }
    let visited = &checked.visited;
    let random = &mut ChaCha8Rng::seed_from_u64(1);
    let mut poses = random_poses(constraints, visited.robot.first()?.q, RANDOM_POSES, random);
    let every = visited.robot.len().div_ceil(PATH_POSES_MAX).max(1);
    poses.bar_rad.extend(visited.bar_rad.iter().step_by(every));
    poses.robot.extend(visited.robot.iter().step_by(every));
    let best = information.optimum(&poses, checked.duration_s)?;
    (best.variance_min > TIGHT * best.variance).then(|| best.variance_min.sqrt())
}

/// Optimal parts of poses, with any repetition, of `measurements` of them for the least `tr(weight covariance)`. `prior` is the
/// information without measurements, `rows` has `of_pose` rows of each pose in standard deviations. `None` if the poses leave a
/// parameter undetermined.
pub(super) fn optimum(
    prior: &DMatrix<f64>,
    (rows, of_pose): (&DMatrix<f64>, usize),
    measurements: f64,
    weight: &DMatrix<f64>,
) -> Option<Optimum> {
    let poses = rows.nrows() / of_pose;
    if poses == 0 {
        return None;
    }
    let mut parts = vec![1.0 / poses as f64; poses];
    let (mut least, mut step) = (0.0_f64, 0);
    loop {
        let root = DVector::from_fn(rows.nrows(), |row, _| (measurements * parts[row / of_pose]).sqrt());
        let mut counted = rows.clone();
        counted.column_iter_mut().for_each(|mut column| column.component_mul_assign(&root));
        let covariance = ScaledCholesky::new(prior + squared(&counted))?.inverse();
        let variance = weight.dot(&covariance);
        // Decrease of the variance with the part of each pose.
        let worth = times(rows, &(&covariance * weight * &covariance));
        let falls = |pose: usize| {
            let [worth, own] = [&worth, rows].map(|all| all.rows(pose * of_pose, of_pose));
            (measurements * worth.dot(&own)).max(0.0)
        };
        let falls: Vec<f64> = (0..poses).map(falls).collect();
        let mean: f64 = parts.iter().zip(&falls).map(|(part, falls)| part * falls).sum();
        let gap = falls.iter().fold(0.0_f64, |most, one| most.max(*one)) - mean;
        least = least.max(variance.powi(2) / (variance + gap));
        step += 1;
        if gap <= GAP * variance || step == STEPS_MAX {
            return Some(Optimum { variance_min: least, variance, parts });
        }
        parts.iter_mut().zip(&falls).for_each(|(part, falls)| *part *= falls.sqrt());
        let sum: f64 = parts.iter().sum();
        parts.iter_mut().for_each(|part| *part /= sum);
    }
}
