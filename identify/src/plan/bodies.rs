//! What must not touch: the robot's links, the rod and the plate as capsules, boxes of the cell, the floor.
//!
//! Distances are those of `parry3d`. Links are capsules between the frames of the Denavit-Hartenberg table, all of one
//! radius: no data sheet has more in numbers. The links next to what they carry always touch it and are not compared.

use nalgebra::Vector3;
use parry3d_f64::math::{Pose as Placement, Vector};
use parry3d_f64::query;
use parry3d_f64::shape::{Capsule, Cuboid, Shape};
use shared::config::JointKind;

use crate::kinematics::{Chain, ROD_LINK};

/// The last links turn where they stand: the plate and the rod's end are theirs.
const WRIST_LINKS: usize = 2;

/// Sizes of what must not touch.
#[derive(Debug, Clone, PartialEq)]
pub struct Bodies {
    /// Of the robot's links \[m\].
    pub link_radius_m: f64,
    /// Of rod and plate \[m\].
    pub rod_radius_m: f64,
    /// Boxes with edges along the robot's base frame: two opposite corners \[m\].
    pub boxes_m: Vec<[[f64; 3]; 2]>,
    /// Height of the floor in the robot's base frame \[m\]; none where nothing can reach it.
    pub floor_m: Option<f64>,
    /// Least distance between any two \[m\].
    pub clearance_m_min: f64,
}

/// Where the middles of arm and bar are in one pose \[m\].
#[derive(Debug, Clone, PartialEq)]
pub struct Skeleton {
    /// Each link: where it begins, along its joint's axis, where it ends.
    pub links: Vec<[Vector3<f64>; 3]>,
    /// Where the plate begins.
    pub plate_from: Vector3<f64>,
    /// Where plate and rod end.
    pub end: Vector3<f64>,
    /// Where the rod begins.
    pub gimbal: Vector3<f64>,
}

impl Skeleton {
    /// Of a posture of the robot.
    pub fn of(robot: &Chain, bar: &Chain, robot_rad: &[f64]) -> Self {
        let mut at = robot.root_from_base;
        let mut links = Vec::with_capacity(robot.links.len());
        for (link, joint) in robot.links.iter().zip(robot_rad) {
            let before = at.translation.vector;
            let moved_m = if link.joint == JointKind::Prismatic { *joint } else { 0.0 };
            // Along the joint's axis first, then along the link.
            let elbow = before + at.rotation * Vector3::z() * (link.d_m + moved_m);
            at *= link.transform(*joint);
            links.push([before, elbow, at.translation.vector]);
        }
        let end = (at * robot.last_from_end).translation.vector;
        let plate_from = links.last().map_or(end, |[_, elbow, _]| *elbow);
        Self { links, plate_from, end, gimbal: bar.root_from_base.translation.vector }
    }
}

impl Bodies {
    /// For a robot of this reach: links a tenth of it thick, as those of the arms in `config/robots` are; rod and plate of
    /// 20 mm radius, 20 mm apart from everything.
    pub fn for_reach(reach_m: f64) -> Self {
        Self {
            link_radius_m: 0.05 * reach_m,
            rod_radius_m: 0.02,
            boxes_m: Vec::new(),
            floor_m: None,
            clearance_m_min: 0.02,
        }
    }

    /// Smallest distance between rod or plate and everything else, and between the forearm with what it carries and the
    /// cell \[m\]; zero where two overlap.
    pub fn clearance_m(&self, robot: &Chain, bar: &Chain, robot_rad: &[f64]) -> f64 {
        let Skeleton { links, plate_from, end, gimbal } = Skeleton::of(robot, bar, robot_rad);
        let plate = self.rod([plate_from, end]);
        let rod = self.rod([gimbal, end]);
        // The last piece of the rod is at the plate, whatever the pose.
        let length_m = bar.links.get(ROD_LINK).map_or(0.0, |rod| rod.d_m);
        let near_end = end + (gimbal - end) * (4.0 * self.rod_radius_m / length_m.max(1e-3)).min(0.5);
        let free_rod = self.rod([gimbal, near_end]);

        let mut clearance_m = f64::INFINITY;
        let mut compare = |one: &dyn Shape, other: &dyn Shape, place: &Placement| {
            if let Ok(found) = query::distance(&Placement::IDENTITY, one, place, other) {
                clearance_m = clearance_m.min(found.distance);
            }
        };
        let here = Placement::IDENTITY;
        let carrying = links.len().saturating_sub(WRIST_LINKS);
        for (index, [before, elbow, after]) in links.iter().enumerate() {
            for piece in [[*before, *elbow], [*elbow, *after]] {
                if (piece[1] - piece[0]).norm() < 1e-6 {
                    continue;
                }
                let link = self.capsule(piece, self.link_radius_m);
                if index < carrying {
                    compare(&free_rod, &link, &here);
                }
                // The forearm ends where the wrist begins.
                if index + 1 < carrying {
                    compare(&plate, &link, &here);
                }
            }
        }
        for [one, other] in &self.boxes_m {
            let half = |axis: usize| 0.5 * (one[axis] - other[axis]).abs();
            let middle = |axis: usize| 0.5 * (one[axis] + other[axis]);
            let block = Cuboid::new(Vector::new(half(0), half(1), half(2)));
            let place = Placement::translation(middle(0), middle(1), middle(2));
            compare(&rod, &block, &place);
            compare(&plate, &block, &place);
            for [before, elbow, after] in links.iter().skip(1) {
                compare(&self.capsule([*before, *elbow], self.link_radius_m), &block, &place);
                compare(&self.capsule([*elbow, *after], self.link_radius_m), &block, &place);
            }
        }
        if let Some(floor_m) = self.floor_m {
            let ends = links.iter().skip(1).map(|[_, _, after]| after.z - self.link_radius_m);
            let rod_end = [end.z - self.rod_radius_m, plate_from.z - self.rod_radius_m];
            clearance_m = ends.chain(rod_end).map(|z| z - floor_m).fold(clearance_m, f64::min);
        }
        clearance_m.max(0.0)
    }

    fn rod(&self, ends: [Vector3<f64>; 2]) -> Capsule {
        self.capsule(ends, self.rod_radius_m)
    }

    fn capsule(&self, [a, b]: [Vector3<f64>; 2], radius_m: f64) -> Capsule {
        Capsule::new(Vector::new(a.x, a.y, a.z), Vector::new(b.x, b.y, b.z), radius_m)
    }
}
