//! Selects samples that are spread over the motion (for fits of the alignment) or over the sphere (for the solve).

use std::f64::consts::PI;

use nalgebra::Vector3;

use crate::statistics::largest_difference;

/// Number of bisections in the search for the distance between samples.
const HALVINGS: usize = 40;

/// Selects samples that are spread evenly over the *motion*, and returns their indices. The distance between consecutive
/// selected samples is at least `motion_min_rad`. If this would select more than `points_max` samples, a larger distance is
/// used. A standstill gives one sample.
///
/// The distance of two samples is the largest difference of a joint. With samples spread evenly over time, slow parts of the
/// motion would have more weight.
pub fn select<R: AsRef<[f64]>>(angles_rad: &[R], motion_min_rad: f64, points_max: usize) -> Vec<usize> {
    let kept = spaced(angles_rad, motion_min_rad);
    if kept.len() <= points_max {
        return kept;
    }
    // The distance is found by bisection. It is at most the travel of the whole motion.
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

/// Selects at most `points_max` of `samples`, spread over the sphere of directions as evenly as the samples allow. Returns
/// their indices in increasing order.
///
/// The sphere is divided into cells of equal area. Each cell contributes the same number of samples, or all if it has fewer.
/// In a cell, the selected samples are spaced evenly in the order of the samples. Without cells, a path that crosses one
/// region ten times would give this region ten times the weight.
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
    // The cells are processed from the smallest to the largest. Samples that a small cell lacks are taken
    // from the larger cells.
    let (mut remaining, mut selected) = (points_max, Vec::with_capacity(points_max));
    let count = cells.len();
    for (number, cell) in cells.iter().enumerate() {
        let share = (remaining / (count - number)).min(cell.len());
        remaining -= share;
        // The samples of the cell are divided into `share` equal parts. The middle sample of each part is selected.
        selected.extend((0..share).filter_map(|k| cell.get((2 * k + 1) * cell.len() / (2 * share))));
    }
    selected.sort_unstable();
    selected
}

/// The sphere is divided into cells of equal area: rings of equal height, each divided into the same number of sectors.
const RINGS: usize = 12;
const SECTORS: usize = 24;
const CELLS: usize = RINGS * SECTORS;

/// Index of the cell that contains a direction.
fn cell_of(direction: &Vector3<f64>) -> usize {
    let interval = |part: f64, count: usize| ((part * count as f64) as usize).min(count - 1);
    let ring = interval(0.5 * (1.0 + direction.z), RINGS);
    let sector = interval(0.5 * (1.0 + direction.y.atan2(direction.x) / PI), SECTORS);
    ring * SECTORS + sector
}

/// Indices of samples whose distance from the last kept sample is at least `step_rad`. The first sample is always kept.
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
