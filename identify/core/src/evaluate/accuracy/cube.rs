//! Pose accuracy as defined by ISO 9283:1998, 6.8: at five poses in a cube within the workspace.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::workspace::{Expected, random_postures};
use crate::kinematics::{Chain, Joints, Pose, robot_inverse};

/// Edge lengths of the cubes that are tried, largest first \[m\]. The short lengths are for small arms.
const EDGES_M: [f64; 6] = [1.0, 0.63, 0.4, 0.25, 0.16, 0.1];
/// Number of random postures whose positions are tried as the centre of the cube.
const CENTRES: usize = 100;
/// Distance of the outer poses from the centre, as a fraction of half the diagonal. Each outer pose is a tenth of the whole
/// diagonal away from its corner.
const FROM_CENTRE: f64 = 0.8;
/// Maximum distance of each joint from its value at the centre \[rad, m\]. It ensures that all poses have the same
/// configuration of the arm.
const APART_MAX: f64 = 1.5;

/// Distance between commanded and actual position, as statistics over the five poses of the standard.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CubeError {
    /// Edge length of the cube, whose edges are parallel to the base's axes \[m\].
    pub edge_m: f64,
    /// Centre of the cube in the robot's base frame \[m\].
    pub centre_m: [f64; 3],
    /// Position error with the nominal geometry.
    pub before: Expected,
    /// Position error with the calibrated geometry, computed from the covariance of the solution.
    pub after: Expected,
}

/// The cube and the postures of its five poses. The first pose is at the centre.
pub(in crate::evaluate) struct Cube {
    pub(in crate::evaluate) edge_m: f64,
    pub(in crate::evaluate) centre_m: Vector3<f64>,
    pub(in crate::evaluate) postures: Vec<Joints>,
}

impl Cube {
    /// The largest cube whose five poses the robot reaches with one orientation, within its joint limits and in one
    /// configuration. If several cubes have this size, the one with the smallest joint motion is returned. `None`
    /// if the robot reaches none of the tried cubes.
    pub(in crate::evaluate) fn largest(robot: &Chain, joint_limits: &[[f64; 2]]) -> Option<Self> {
        let centres: Vec<Joints> = random_postures(joint_limits).take(CENTRES).collect();
        EDGES_M.into_iter().find_map(|edge_m| {
            let centred_at = |q: &Joints| Self::centred_at(robot, joint_limits, q, edge_m);
            let (cube, _) = centres.iter().filter_map(centred_at).min_by(|(_, a), (_, b)| a.total_cmp(b))?;
            Some(cube)
        })
    }

    /// The cube whose centre is at the position of the posture `q`, and the largest joint motion from the centre to an outer
    /// pose. `None` if the robot does not reach an outer pose.
    fn centred_at(robot: &Chain, joint_limits: &[[f64; 2]], q: &Joints, edge_m: f64) -> Option<(Self, f64)> {
        let centre = robot.forward(q);
        let mut furthest: f64 = 0.0;
        let mut postures = vec![*q];
        for [along, across] in [[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]] {
            // The poses are in the plane through two opposite edges.
            let offset = 0.5 * edge_m * FROM_CENTRE * Vector3::new(along, across, along);
            let target = Pose::from_parts((centre.translation.vector + offset).into(), centre.rotation);
            let corner_q = robot_inverse(robot, &target, q).ok()?;
            let within = |(joint, [low, high]): (&f64, &[f64; 2])| (low..=high).contains(&joint);
            if !corner_q.iter().zip(joint_limits).all(within) {
                return None;
            }
            let motions = corner_q.iter().zip(q.iter()).map(|(corner, centre)| (corner - centre).abs());
            furthest = motions.fold(furthest, f64::max);
            postures.push(corner_q);
        }
        let cube = Self { edge_m, centre_m: centre.translation.vector, postures };
        (furthest <= APART_MAX).then_some((cube, furthest))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kinematics::flange_chain;

    #[test]
    fn the_five_poses_are_those_of_the_standard_and_the_robot_reaches_them() {
        let config = concat!(env!("CARGO_MANIFEST_DIR"), "/../../config/robots/irb2400_16.toml");
        let robot: shared::config::RobotConfig =
            shared::config::load(config.as_ref()).unwrap_or_else(|error| panic!("{error}"));
        let (chain, limits) = (flange_chain(&robot), robot.joint_limits());
        let Some(cube) = Cube::largest(&chain, &limits) else { panic!("no cube") };
        assert!(cube.edge_m >= 0.4, "{}", cube.edge_m);
        let poses: Vec<Pose> = cube.postures.iter().map(|q| chain.forward(q)).collect();
        for (pose, q) in poses.iter().zip(&cube.postures) {
            assert!(pose.rotation.angle_to(&poses[0].rotation) < 1e-6);
            let from_centre = pose.translation.vector - cube.centre_m;
            // Each outer pose is a tenth of the cube's diagonal away from its corner. The standard allows (10 +- 2) %.
            let diagonal = cube.edge_m * 3.0_f64.sqrt();
            let is_centre = from_centre.norm() < 1e-6;
            assert!(is_centre || (from_centre.norm() - 0.4 * diagonal).abs() < 1e-6, "{from_centre}");
            assert!(q.iter().zip(&limits).all(|(joint, [low, high])| (low..=high).contains(&joint)));
        }
        let apart = |i: usize, j: usize| (poses[i].translation.vector - poses[j].translation.vector).norm();
        assert!((apart(1, 4) - 0.8 * cube.edge_m * 3.0_f64.sqrt()).abs() < 1e-6);
    }
}
