//! Divides samples into groups that are held out together. Assigns the groups at random to folds of about equal size.

use std::collections::BTreeMap;
use std::ops::Range;

use nalgebra::Vector3;
use rand::SeedableRng;
use rand::rngs::StdRng;
use rand::seq::SliceRandom;
use serde::{Deserialize, Serialize};

use super::standing::poses;
use crate::kinematics::{Chain, Joints};

/// How rows are grouped. Rows of one group are held out together.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HoldOut {
    /// Single poses, each with all rows measured at it. The fit uses the neighbours of a held-out pose.
    Rows,
    /// 25 segments of the file. A held-out segment has other times than the fitted rows, and mostly other poses.
    Blocks,
    /// Boxes of the workspace; their edge is a fifth of the workspace's longest side. The fit uses no pose in a held-out box.
    #[default]
    Regions,
}

/// Number of segments of a file.
const BLOCKS: usize = 25;
/// Number of boxes along the longest side of the workspace.
const BOXES: f64 = 5.0;

impl HoldOut {
    /// Group of each row. Poses of one group are held out together. `robot` is the nominal chain.
    pub(crate) fn groups(self, robot: &Chain, joints_rad: &[Joints]) -> Vec<usize> {
        let positions_m: Vec<Vector3<f64>> =
            joints_rad.iter().map(|q| robot.forward(q).translation.vector).collect();
        groups(self, &poses(joints_rad), &positions_m)
    }
}

/// Group of each row. `poses` contains the number of the pose of each row, in ascending order. `positions_m` contains the
/// nominal position of the robot's end at each row.
fn groups(hold_out: HoldOut, poses: &[usize], positions_m: &[Vector3<f64>]) -> Vec<usize> {
    match hold_out {
        HoldOut::Rows => poses.to_vec(),
        HoldOut::Blocks => {
            let count = poses.last().map_or(1, |last| last + 1);
            poses.iter().map(|pose| pose * BLOCKS / count).collect()
        }
        HoldOut::Regions => boxes(positions_m),
    }
}

/// Number of the box that contains each position. Boxes without positions have no number.
fn boxes(positions_m: &[Vector3<f64>]) -> Vec<usize> {
    let Some(first) = positions_m.first() else { return Vec::new() };
    let low = positions_m.iter().fold(*first, |low, p| low.inf(p));
    let high = positions_m.iter().fold(*first, |high, p| high.sup(p));
    let side_m = ((high - low).max() / BOXES).max(f64::MIN_POSITIVE);
    let mut numbers: BTreeMap<[i64; 3], usize> = BTreeMap::new();
    let boxes = positions_m.iter().map(|p| {
        let place = ((p - low) / side_m).map(|x| x.floor() as i64);
        let next = numbers.len();
        *numbers.entry(place.into()).or_insert(next)
    });
    boxes.collect()
}

/// Divides each run into `count` segments of nearly equal length. `starts` contains the first sample of each run, followed
/// by the total number of samples.
pub(crate) fn segments(starts: &[usize], count: usize) -> Vec<Range<usize>> {
    let of_run = |run: &[usize]| {
        let (start, length) = (run[0], run[1] - run[0]);
        (0..count).map(move |i| start + i * length / count..start + (i + 1) * length / count)
    };
    starts.windows(2).flat_map(of_run).filter(|segment| !segment.is_empty()).collect()
}

/// Assigns the groups of rows to at most `count` folds of about equal size. Returns the rows of each fold. Groups of the
/// same `class` are assigned one after the other, so that every fold contains rows of each class.
pub(super) fn folds(
    groups: &[usize],
    count: usize,
    seed: u64,
    class: impl Fn(usize) -> usize,
) -> Vec<Vec<usize>> {
    let mut of_group: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for (row, group) in groups.iter().enumerate() {
        of_group.entry(*group).or_default().push(row);
    }
    let mut order: Vec<Vec<usize>> = of_group.into_values().collect();
    order.shuffle(&mut StdRng::seed_from_u64(seed.wrapping_add(1)));
    order.sort_by_key(|group| group.first().map(|&row| class(row)));
    let mut folds = vec![Vec::new(); count.max(1)];
    for group in order {
        if let Some(smallest) = folds.iter_mut().min_by_key(|fold| fold.len()) {
            smallest.extend(group);
        }
    }
    folds.retain(|fold| !fold.is_empty());
    folds
}

#[cfg(test)]
mod tests {
    use super::*;

    fn positions() -> Vec<Vector3<f64>> {
        (0..1000)
            .map(|k| Vector3::new(f64::from(k % 10), f64::from(k / 10 % 10), f64::from(k / 100)))
            .collect()
    }

    fn poses() -> Vec<usize> {
        (0..1000).collect()
    }

    #[test]
    fn each_way_makes_parts_of_about_equal_size_and_none_has_half_a_group() {
        for hold_out in [HoldOut::Rows, HoldOut::Blocks, HoldOut::Regions] {
            let groups = groups(hold_out, &poses(), &positions());
            let parts = folds(&groups, 5, 7, |_| 0);
            assert_eq!((parts.len(), parts.iter().map(Vec::len).sum::<usize>()), (5, 1000));
            for part in &parts {
                assert!((180..=220).contains(&part.len()), "{hold_out:?}: {}", part.len());
                let others = || parts.iter().filter(|other| *other != part).flatten();
                assert!(part.iter().all(|row| others().all(|other| groups[*row] != groups[*other])));
            }
        }
    }
}
