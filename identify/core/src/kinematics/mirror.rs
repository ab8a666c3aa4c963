//! The mirror image of an arm: its joints with some signs reversed.

use nalgebra::{Matrix3, Vector3};

use super::{Chain, Joints, Pose};

/// Number of poses at which arm and mirror image are compared.
const POSES: usize = 12;
/// Largest distance between arm and mirror image, relative to the arm's reach.
const APART_MAX: f64 = 0.02;

/// Joints, from 0, with reversed signs in the mirror image of the arm in the plane of the base's x and z axes; `None`
/// if the arm is not symmetric. Links out of that plane by less than 2 % of the reach count as in it.
///
/// Images in planes rotated about the base's z axis differ in the first joint's offset only.
pub fn mirroring_joints(arm: &Chain) -> Option<Vec<usize>> {
    let mirror = Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, 1.0));
    let count = arm.links.len();
    let poses: Vec<Joints> = (0..POSES)
        .map(|pose| Joints::from_fn(count, |joint| (1.3 * pose as f64 + 0.7 * joint as f64 + 0.4).sin()))
        .collect();
    let ends: Vec<_> = poses.iter().map(|joints| arm.forward(joints)).collect();
    let reach_m = ends.iter().map(|end| end.translation.vector.norm()).fold(0.0, f64::max);
    // Two axes of the end's frame keep or reverse their direction, depending on its convention.
    let apart = |reversed: usize| {
        let of_pose = |(joints, end): (&Joints, &Pose)| {
            let image = Joints::from_fn(count, |joint| {
                if reversed >> joint & 1 == 1 { -joints[joint] } else { joints[joint] }
            });
            let image = arm.forward(&image);
            let position = (image.translation.vector - mirror * end.translation.vector).norm() / reach_m;
            let axes = (0..3).map(|axis| {
                let [of_image, of_arm] = [&image, end].map(|pose| pose.rotation * Vector3::ith(axis, 1.0));
                (of_image - mirror * of_arm).norm().min((of_image + mirror * of_arm).norm())
            });
            axes.fold(position, f64::max)
        };
        poses.iter().zip(&ends).map(of_pose).fold(0.0, f64::max)
    };
    let best = (1..1_usize << count).min_by(|one, other| apart(*one).total_cmp(&apart(*other)))?;
    (apart(best) < APART_MAX).then(|| (0..count).filter(|joint| best >> joint & 1 == 1).collect())
}
