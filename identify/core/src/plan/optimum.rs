//! The least variance that poses can leave which are chosen freely, as often as one likes and without any motion between them: the ratio
//! of this variance to that of a path or a choice of poses is its efficiency.
//!
//! Weights of poses that count as parts of a measurement are a design measure, in which the variance is convex (Chaloner 1984 with
//! priors). The multiplicative algorithm (Silvey, Titterington and Torsney 1978) finds the best ones. With covariance `P`, weight `W` and
//! `d` the largest fall of the variance `v` along any pose against the mean fall `m`, no weights leave less than `v^2 / (v + d - m)`: the
//! bound of duality, as `tr(W P') >= 2 s tr(W P) - s^2 tr(P W P P'^-1)` for every covariance `P'` and number `s`.

use nalgebra::{DMatrix, DVector};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

use super::poses::{squared, times};
use super::{Checked, Constraints, Information, random_poses};
use crate::solver::ScaledCholesky;

/// Steps of the algorithm at most.
const STEPS_MAX: usize = 300;
/// The bound is found where `(d - m) / v` is no more than this.
const GAP: f64 = 0.05;
/// The bound is used if it is more than this part of the variance of the best parts that were found.
const TIGHT: f64 = 0.9;
/// Random poses that a path is compared with.
const RANDOM_POSES: usize = 1000;
/// Poses of the path beside them at most: those of four minutes. Of a longer path every second or third says as much.
const PATH_POSES_MAX: usize = 2400;
/// Those of the best parts that a path is drawn towards: about twice as many as share most of the time.
const GOALS: usize = 60;

/// The best parts of poses, nearly.
#[derive(Debug, Clone, PartialEq)]
pub struct Optimum {
    /// No parts leave less \[SI\].
    pub variance_min: f64,
    /// What these parts leave \[SI\].
    pub variance: f64,
    /// Of each pose, one in all.
    pub parts: Vec<f64>,
}

/// Poses of the bar that a run learns most from, those with the largest parts of the optimum of random ones \[rad\]; empty where these
/// leave a parameter open.
pub(super) fn goals(
    constraints: &Constraints<'_>,
    information: &Information,
    random: &mut impl Rng,
) -> Vec<[f64; 5]> {
    let poses = random_poses(constraints, RANDOM_POSES / 2, random);
    let Some(best) = information.optimum(&poses, constraints.design.duration_s) else { return Vec::new() };
    let mut largest: Vec<usize> = (0..best.parts.len()).collect();
    largest.sort_by(|a, b| best.parts[*b].total_cmp(&best.parts[*a]));
    largest.into_iter().take(GOALS).map(|pose| poses.bar_rad[pose]).collect()
}

/// What every run of a path's length leaves at least of the RMS position error with all terms of the axes \[m\], if it bends elbow and wrist
/// as the path does, by its poses and random ones. None if they leave a parameter open, if the bound did not
/// converge, and for an arm that has more than six axes.
pub fn position_m_min(
    checked: &Checked,
    constraints: &Constraints<'_>,
    information: &Information,
) -> Option<f64> {
    // How elbow and wrist are bent is known of six axes only: freely bent ones leave far less than any path.
    if constraints.limits.len() != 6 {
        return None;
    }
    let mut poses = random_poses(constraints, RANDOM_POSES, &mut ChaCha8Rng::seed_from_u64(1));
    let visited = &checked.visited;
    let every = visited.robot.len().div_ceil(PATH_POSES_MAX).max(1);
    poses.bar_rad.extend(visited.bar_rad.iter().step_by(every));
    poses.robot.extend(visited.robot.iter().step_by(every));
    let best = information.optimum(&poses, checked.duration_s)?;
    (best.variance_min > TIGHT * best.variance).then(|| best.variance_min.sqrt())
}

/// The parts of poses, as often as one likes, that `measurements` of them should have so that `tr(weight covariance)` is least.
/// `prior` is the information without any, `rows` has `of_pose` rows of each pose in standard deviations. `None` if the poses leave
/// a parameter undetermined.
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
        // By how much the variance falls with the part of each pose.
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
