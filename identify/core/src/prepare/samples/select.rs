//! Selects samples that are spread over the motion, for fits of the alignment, or over the sphere, for the solve.

use std::f64::consts::PI;

use nalgebra::Vector3;

use crate::statistics::largest_difference;

/// Rounds of halving the interval in which the distance between samples is sought.
const HALVINGS: usize = 40;

/// Indices of samples spread evenly over the *motion*: each kept one is at least some distance from the one before,
/// and the distance is `motion_min_rad`, or larger if more than `points_max` would be kept. A standstill leaves one sample.
///
/// Distance is the largest travel of a joint. Spreading over time instead would weigh slow parts more.
pub fn select<R: AsRef<[f64]>>(angles_rad: &[R], motion_min_rad: f64, points_max: usize) -> Vec<usize> {
    let kept = spaced(angles_rad, motion_min_rad);
    if kept.len() <= points_max {
        return kept;
    }
    // Bisection: the distance sought is at most the whole travel.
    let travel =
        angles_rad.windows(2).map(|pair| largest_difference(pair[0].as_ref(), pair[1].as_ref())).sum::<f64>();
    let (mut low, mut high) = (motion_min_rad, travel.max(motion_min_rad));
    for _ in 0..HALVINGS {
        let middle = 0.5 * (low + high);
        if spaced(angles_rad, middle).len() > points_max { low = middle } else { high = middle }
    }
    let mut kept = spaced(angles_rad, high);
    kept.truncate(points_max);
    kept
}

/// Indices, in order, of at most `points_max` of `samples`, spread over the sphere of directions as evenly as they lie
/// there: the sphere is cut into cells of equal area, each cell gives the same number or all it has, evenly taken in the
/// order of the samples. A path that crosses one region ten times would otherwise weigh it tenfold.
///
/// `directions` are unit vectors, one for each of `samples`.
pub fn spread_over_sphere(samples: &[usize], directions: &[Vector3<f64>], points_max: usize) -> Vec<usize> {
    if samples.len() <= points_max {
        return samples.to_vec();
    }
    let mut cells = vec![Vec::new(); CELLS];
    for (sample, direction) in samples.iter().zip(directions) {
        if let Some(cell) = cells.get_mut(cell_of(direction)) {
            cell.push(*sample);
        }
    }
    cells.retain(|cell| !cell.is_empty());
    cells.sort_by_key(Vec::len);
    // From the smallest cell on: what it has less than its share is shared by the larger ones.
    let (mut remaining, mut selected) = (points_max, Vec::with_capacity(points_max));
    let count = cells.len();
    for (number, cell) in cells.iter().enumerate() {
        let share = (remaining / (count - number)).min(cell.len());
        remaining -= share;
        // The middles of `share` equal parts.
        selected.extend((0..share).filter_map(|k| cell.get((2 * k + 1) * cell.len() / (2 * share))));
    }
    selected.sort_unstable();
    selected
}

/// Cells of equal area on the sphere: rings of equal height, each cut into the same number.
const RINGS: usize = 12;
const SECTORS: usize = 24;
const CELLS: usize = RINGS * SECTORS;

fn cell_of(direction: &Vector3<f64>) -> usize {
    let interval = |part: f64, count: usize| ((part * count as f64) as usize).min(count - 1);
    let ring = interval(0.5 * (1.0 + direction.z), RINGS);
    let sector = interval(0.5 * (1.0 + direction.y.atan2(direction.x) / PI), SECTORS);
    ring * SECTORS + sector
}

/// Indices of samples at least `step_rad` from the last one kept; the first is always kept.
pub(in crate::prepare) fn spaced<R: AsRef<[f64]>>(angles_rad: &[R], step_rad: f64) -> Vec<usize> {
    let mut kept: Vec<usize> = Vec::new();
    for (index, angles) in angles_rad.iter().enumerate() {
        let far_enough = match kept.last().and_then(|&last| angles_rad.get(last)) {
            Some(last) => largest_difference(last.as_ref(), angles.as_ref()) >= step_rad,
            None => true,
        };
        if far_enough {
            kept.push(index);
        }
    }
    kept
}
