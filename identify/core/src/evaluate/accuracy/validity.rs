//! The region of joint space in which a calibration is valid: near the joint values that were measured.

use std::fmt;

use serde::{Deserialize, Serialize};
use shared::config::JointKind;

use crate::kinematics::{Chain, Joints};

/// Maximum distance from measured joint values \[rad, m\]. Errors of a link vary with one or two waves per turn, so over
/// this distance they change by less than half of their amplitude.
const BESIDE: f64 = 0.2;

/// Intervals in which each joint was measured. A calibration is valid for a pose if each joint is within or near one of its
/// intervals. Combinations of joint values are not checked.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Validity {
    /// Intervals of each joint, base to flange, in ascending order \[rad, m\].
    pub joints: Vec<Vec<[f64; 2]>>,
    /// Indices (from 0) of the prismatic joints, whose intervals are in metres.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub prismatic: Vec<usize>,
}

impl Validity {
    /// Computes the intervals from the measured poses. Without poses there are no intervals.
    pub fn from_poses(poses: impl Iterator<Item = Joints>, robot: &Chain) -> Self {
        let is_prismatic = |joint: &usize| robot.links[*joint].joint == JointKind::Prismatic;
        let poses: Vec<Joints> = poses.collect();
        let axes = poses.first().map_or(0, |q| q.len());
        let of_joint = |joint: usize| {
            let mut values: Vec<f64> = poses.iter().map(|q| q[joint]).collect();
            values.sort_by(f64::total_cmp);
            // Every value in a gap of this width is near one end of the gap, so such a gap belongs to the interval.
            let intervals = values.chunk_by(|low, high| high - low <= 2.0 * BESIDE);
            intervals.filter_map(|values| Some([*values.first()?, *values.last()?])).collect()
        };
        let prismatic = (0..robot.links.len()).filter(is_prismatic).collect();
        Self { joints: (0..axes).map(of_joint).collect(), prismatic }
    }

    /// Indices (from 0) of the joints of a pose that are too far from all their intervals.
    pub fn outside(&self, q: &Joints) -> Vec<usize> {
        let is_beside = |value: f64, [low, high]: &[f64; 2]| (low - BESIDE..=high + BESIDE).contains(&value);
        let is_outside =
            |&joint: &usize| !self.joints[joint].iter().any(|interval| is_beside(q[joint], interval));
        (0..self.joints.len().min(q.len())).filter(is_outside).collect()
    }
}

impl fmt::Display for Validity {
    /// For example `joint 1 -170..170, joint 2 -95..-20 and 10..40, joint 3 -60..80 in 7 parts`. Values are in degrees,
    /// those of prismatic joints in mm.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        /// Maximum number of intervals that are listed one by one.
        const LISTED_MAX: usize = 3;
        for (joint, intervals) in self.joints.iter().enumerate() {
            let (factor, unit) =
                if self.prismatic.contains(&joint) { (1e3, " mm") } else { (1f64.to_degrees(), "") };
            let number = |value: f64| format!("{:.0}", value * factor);
            let between = |low: f64, high: f64| match [low, high].map(number) {
                [low, high] if low == high => low + unit,
                [low, high] => format!("{low}..{high}{unit}"),
            };
            let text = match &intervals[..] {
                [[low, _], .., [_, high]] if intervals.len() > LISTED_MAX => {
                    format!("{} in {} parts", between(*low, *high), intervals.len())
                }
                few => few.iter().map(|[low, high]| between(*low, *high)).collect::<Vec<_>>().join(" and "),
            };
            let separator = if joint == 0 { "" } else { ", " };
            write!(f, "{separator}joint {} {}", joint + 1, text)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kinematics::{DhLink, Pose};

    #[test]
    fn a_joint_is_supported_where_it_was_measured_and_beside_not_in_a_wide_gap() {
        let pose = |k: u32| {
            Joints::from_fn(2, |joint| if joint == 0 { 0.1 * f64::from(k) } else { f64::from(k % 2) })
        };
        let kinds = [JointKind::Revolute, JointKind::Prismatic];
        let links = kinds.map(|joint| DhLink { joint, ..DhLink::default() }).to_vec();
        let arm = Chain::new(Pose::identity(), links);
        let validity = Validity::from_poses((0..20).map(pose), &arm);
        assert_eq!(validity.to_string(), "joint 1 0..109, joint 2 0 mm and 1000 mm");
        assert_eq!(validity.joints, [vec![[0.0, 0.1 * 19.0]], vec![[0.0, 0.0], [1.0, 1.0]]]);
        let outside =
            |one: f64, other: f64| validity.outside(&Joints::from_fn(2, |joint| [one, other][joint]));
        assert_eq!(outside(1.05, 0.9), [0_usize; 0]);
        assert_eq!(outside(2.05, 0.5), [1]);
        assert_eq!(outside(-0.25, 3.0), [0, 1]);
    }

    #[test]
    fn of_many_parts_the_ends_and_the_number_are_told() {
        let part = |k: u32| [f64::from(k), f64::from(k)].map(|at| (30.0 * at).to_radians());
        let joints = vec![(0..5).map(part).collect()];
        assert_eq!(Validity { joints, prismatic: Vec::new() }.to_string(), "joint 1 0..120 in 5 parts");
    }
}
