//! Finds the joints of an arm whose signs must be reversed to obtain the mirror image of the arm. If the robot's log agrees
//! with the bar's recording only after mirroring, the alignment reports these joints, because their signs may be wrong.

use nalgebra::{Matrix3, Vector3};

use super::{Chain, Joints, Pose};

/// Number of poses at which arm and mirror image are compared.
const POSES: usize = 12;
/// Largest difference at which arm and mirror image count as equal. It applies to positions relative to the reach, and
/// to differences of unit vectors along the axes.
const DIFFERENCE_MAX: f64 = 0.02;

/// The joints (from 0) whose signs must be reversed to mirror the arm in the plane of the base's x and z axes. `None` if the
/// arm is not symmetric about this plane. Deviations from symmetry up to 2 % of the reach are tolerated.
///
/// Mirror images in other planes through the base's z axis need no test, because they differ only in the offset
/// of the first joint.
pub fn mirroring_joints(arm: &Chain) -> Option<Vec<usize>> {
    let mirror = Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, 1.0));
    let count = arm.links.len();
    // Arbitrary poses, with different values for all joints.
    let poses: Vec<Joints> = (0..POSES)
        .map(|pose| Joints::from_fn(count, |joint| (1.3 * pose as f64 + 0.7 * joint as f64 + 0.4).sin()))
        .collect();
    let ends: Vec<_> = poses.iter().map(|joints| arm.forward(joints)).collect();
    let reach_m = ends.iter().map(|end| end.translation.vector.norm()).fold(0.0, f64::max);
    // A set of joints is a bit mask: bit `joint` is 1 if the sign of this joint is reversed.
    let is_reversed = |reversed: usize, joint: usize| reversed >> joint & 1 == 1;
    // Largest difference between arm and mirror image over all poses, if the joints `reversed` are reversed.
    let largest_difference = |reversed: usize| {
        let difference = |(joints, end): (&Joints, &Pose)| {
            let image_joints = Joints::from_fn(count, |joint| {
                if is_reversed(reversed, joint) { -joints[joint] } else { joints[joint] }
            });
            let image = arm.forward(&image_joints);
            let position = (image.translation.vector - mirror * end.translation.vector).norm() / reach_m;
            // An axis of the end frame may keep or reverse its direction in the mirror image, depending on the
            // convention of the frame.
            let directions = (0..3).map(|axis| {
                let [image_axis, arm_axis] =
                    [&image, end].map(|pose| pose.rotation * Vector3::ith(axis, 1.0));
                (image_axis - mirror * arm_axis).norm().min((image_axis + mirror * arm_axis).norm())
            });
            directions.fold(position, f64::max)
        };
        poses.iter().zip(&ends).map(difference).fold(0.0, f64::max)
    };
    let all_sets = 1..1_usize << count;
    let best = all_sets.min_by(|a, b| largest_difference(*a).total_cmp(&largest_difference(*b)))?;
    (largest_difference(best) < DIFFERENCE_MAX)
        .then(|| (0..count).filter(|joint| is_reversed(best, *joint)).collect())
}
