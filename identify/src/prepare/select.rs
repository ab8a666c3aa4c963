//! Which samples are worth keeping.

use crate::kinematics::BAR_JOINTS;

/// Rounds of halving the interval in which the distance between samples is sought.
const HALVINGS: usize = 40;

/// Indices of samples spread evenly over the *motion*: each kept one is at least some distance from the one before,
/// and the distance is `motion_min_rad` or so much more that at most `points_max` are kept. Standstill leaves one.
///
/// Distance is the largest travel of a joint. Spreading over time instead would weigh slow parts more.
pub fn select(angles_rad: &[[f64; BAR_JOINTS]], motion_min_rad: f64, points_max: usize) -> Vec<usize> {
    let kept = apart(angles_rad, motion_min_rad);
    if kept.len() <= points_max {
        return kept;
    }
    // Any distance up to the whole travel may be the one.
    let travel = angles_rad.windows(2).map(|pair| distance(&pair[0], &pair[1])).sum::<f64>();
    let (mut low, mut high) = (motion_min_rad, travel.max(motion_min_rad));
    for _ in 0..HALVINGS {
        let middle = 0.5 * (low + high);
        if apart(angles_rad, middle).len() > points_max { low = middle } else { high = middle }
    }
    let mut kept = apart(angles_rad, high);
    kept.truncate(points_max);
    kept
}

/// Indices of samples at least `step_rad` from the last one kept; the first is always kept.
pub(super) fn apart(angles_rad: &[[f64; BAR_JOINTS]], step_rad: f64) -> Vec<usize> {
    let mut kept: Vec<usize> = Vec::new();
    for (index, angles) in angles_rad.iter().enumerate() {
        let far_enough = match kept.last().and_then(|&last| angles_rad.get(last)) {
            Some(last) => distance(last, angles) >= step_rad,
            None => true,
        };
        if far_enough {
            kept.push(index);
        }
    }
    kept
}

fn distance(a: &[f64; BAR_JOINTS], b: &[f64; BAR_JOINTS]) -> f64 {
    a.iter().zip(b).fold(0.0, |most, (a, b)| most.max((a - b).abs()))
}
