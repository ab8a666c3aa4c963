//! Computes the distances between bodies, to avoid collisions. Bodies are the robot's links, the rod and the plate as
//! capsules (cylinders with round ends), boxes in the robot cell, and the floor.
//!
//! The constraints of paths and of moves between poses use the smallest distance, which `parry3d` computes. Links are
//! capsules between the frames of the Denavit-Hartenberg table. All links have the same radius, because data sheets do not
//! specify the radius of each link. Adjacent links always touch and are not compared.

use nalgebra::Vector3;
use parry3d_f64::math::{Pose as Placement, Vector};
use parry3d_f64::query::{self, details::distance_segment_segment};
use parry3d_f64::shape::{Capsule, Cuboid};
use shared::config::JointKind;

use crate::kinematics::{Chain, DhLink, Joints, ROD_LINK};

/// Number of links of the wrist. These links only rotate in place, so they are not bodies of their own; the plate and the
/// end of the rod cover them.
const WRIST_LINKS: usize = 2;
/// Shortest step between two checked postures of a move \[m\]. Between two checked postures, the clearance can be below the
/// least clearance by at most half of this step.
const ADVANCE_M_MIN: f64 = 5e-3;

/// Sizes of the bodies, and their least clearance.
#[derive(Debug, Clone, PartialEq)]
pub struct Bodies {
    /// Radius of the robot's links \[m\].
    pub link_radius_m: f64,
    /// Radius of rod and plate \[m\].
    pub rod_radius_m: f64,
    /// Boxes with edges along the robot's base frame: two opposite corners \[m\].
    pub boxes_m: Vec<[[f64; 3]; 2]>,
    /// Height of the floor in the robot's base frame \[m\]; `None` if the floor is not checked.
    pub floor_m: Option<f64>,
    /// Least distance between two bodies \[m\].
    pub clearance_m_min: f64,
}

/// Centre lines of an arm's links in one posture \[m\].
#[derive(Debug, Clone, PartialEq)]
pub struct Skeleton {
    /// Start, corner and end of each link. The line from start to corner is along the link's joint axis, the line from
    /// corner to end along the common normal.
    pub links: Vec<[Vector3<f64>; 3]>,
    /// End of the plate.
    pub end: Vector3<f64>,
}

impl Skeleton {
    /// Computes the centre lines for a posture of the robot.
    pub fn at_posture(robot: &Chain, robot_rad: &[f64]) -> Self {
        let mut frame = robot.root_from_base;
        let mut links = Vec::with_capacity(robot.links.len());
        for (link, joint) in robot.links.iter().zip(robot_rad) {
            let before = frame.translation.vector;
            let moved_m = if link.joint == JointKind::Prismatic { *joint } else { 0.0 };
            // The corner is the end of the translation along the joint's axis. The translation along the common normal
            // starts at the corner.
            let corner = before + frame.rotation * Vector3::z() * (link.d_m + moved_m);
            frame *= link.transform(*joint);
            links.push([before, corner, frame.translation.vector]);
        }
        Self { links, end: (frame * robot.last_from_end).translation.vector }
    }
}

impl Bodies {
    /// Default sizes for a robot of this reach. The diameter of links is a tenth of the reach, as in the arms of
    /// `config/robots`. Rod and plate have a radius of 20 mm, and the least clearance is 20 mm. Boxes and floor are not set.
    pub fn for_reach(reach_m: f64) -> Self {
        Self {
            link_radius_m: 0.05 * reach_m,
            rod_radius_m: 0.02,
            boxes_m: Vec::new(),
            floor_m: None,
            clearance_m_min: 0.02,
        }
    }

    /// Smallest distance between bodies at a posture of the robot with the bar attached \[m\]. It is zero if two bodies
    /// overlap. These bodies are compared:
    ///
    /// - the rod with the links before the wrist,
    /// - the plate with the links before the forearm (the forearm is the last link before the wrist),
    /// - boxes with the rod, the plate and all links except the first,
    /// - the floor with the plate and all links except the first.
    pub fn clearance_m(&self, robot: &Chain, bar: &Chain, robot_rad: &[f64]) -> f64 {
        let Skeleton { links, end } = Skeleton::at_posture(robot, robot_rad);
        let gimbal = bar.root_from_base.translation.vector;
        let plate = self.rod([links.last().map_or(end, |[_, corner, _]| *corner), end]);
        let rod = self.rod([gimbal, end]);
        // Near the plate, a short segment of the rod is not compared with the links, because the end of the rod is
        // always near the plate.
        let length_m = bar.links.get(ROD_LINK).map_or(0.0, |rod| rod.d_m);
        let near_end = end + (gimbal - end) * (4.0 * self.rod_radius_m / length_m.max(1e-3)).min(0.5);
        let free_rod = self.rod([gimbal, near_end]);

        let mut clearance_m = f64::INFINITY;
        let mut compare = |one: &Capsule, other: &Capsule| {
            clearance_m = clearance_m.min(between_m(one, other));
        };
        let before_wrist = links.len().saturating_sub(WRIST_LINKS);
        for (index, link) in links.iter().enumerate() {
            for piece in self.pieces(link) {
                if index < before_wrist {
                    compare(&free_rod, &piece);
                }
                // The forearm is always near the plate, because it ends at the wrist.
                if index + 1 < before_wrist {
                    compare(&plate, &piece);
                }
            }
        }
        clearance_m.min(self.cell_clearance_m(&links, &[&plate, &rod], Some(&plate))).max(0.0)
    }

    /// Whether an arm without the bar keeps the least clearance between its own links, to the boxes, and to the floor.
    pub fn is_clear(&self, arm: &Chain, robot_rad: &[f64]) -> bool {
        self.arm_clearance_m(arm, robot_rad) >= self.clearance_m_min
    }

    fn arm_clearance_m(&self, arm: &Chain, robot_rad: &[f64]) -> f64 {
        let Skeleton { links, .. } = Skeleton::at_posture(arm, robot_rad);
        self.cell_clearance_m(&links, &[], None).min(self.own_clearance_m(&links))
    }

    /// Whether [`Self::is_clear`] is true on the straight line in joint space between two postures. Between checked
    /// postures, the clearance may be below the least clearance by up to half of [`ADVANCE_M_MIN`].
    ///
    /// Let `way_m` be the longest way of any point of the arm on this line. If the clearance of a posture exceeds the least
    /// clearance, the arm can move by the difference without a further check (conservative advancement, Mirtich 1996).
    pub fn is_way_clear(&self, arm: &Chain, from: &Joints, to: &Joints) -> bool {
        let extended_m = |((link, from), to): ((&DhLink, &f64), &f64)| match link.joint {
            JointKind::Revolute => 0.0,
            JointKind::Prismatic => from.abs().max(to.abs()),
        };
        let reach_m = arm.reach_m() + arm.links.iter().zip(from).zip(to).map(extended_m).sum::<f64>();
        let moved_m = |((link, from), to): ((&DhLink, &f64), &f64)| match link.joint {
            JointKind::Revolute => reach_m * (to - from).abs(),
            JointKind::Prismatic => (to - from).abs(),
        };
        let way_m: f64 = arm.links.iter().zip(from).zip(to).map(moved_m).sum();
        let mut part = 0.0;
        loop {
            let posture = Joints::from_fn(from.len(), |axis| from[axis] + part * (to[axis] - from[axis]));
            let clearance_m = self.arm_clearance_m(arm, &posture);
            if clearance_m < self.clearance_m_min {
                return false;
            }
            if part >= 1.0 {
                return true;
            }
            let advance_m = (clearance_m - self.clearance_m_min).max(ADVANCE_M_MIN);
            part = if way_m > 0.0 { (part + advance_m / way_m).min(1.0) } else { 1.0 };
        }
    }

    /// Smallest distance between two links \[m\]. Two links are compared only if the part of the chain between them is
    /// longer than their diameter plus the least clearance. Otherwise they would always be too close to each other.
    fn own_clearance_m(&self, links: &[[Vector3<f64>; 3]]) -> f64 {
        let length_m =
            |[before, corner, after]: &[Vector3<f64>; 3]| (corner - before).norm() + (after - corner).norm();
        let apart_m = 2.0 * self.link_radius_m + self.clearance_m_min;
        let mut clearance_m = f64::INFINITY;
        for (index, link) in links.iter().enumerate() {
            // Length of the chain from the end of `link` to the start of `later`. The adjacent link is skipped.
            let mut between_links_m = 0.0;
            for (before_later, later) in links.iter().zip(links.iter().skip(1)).skip(index + 1) {
                between_links_m += length_m(before_later);
                if between_links_m <= apart_m || length_m(later) < 1e-6 {
                    continue;
                }
                for piece in self.pieces(link) {
                    let nearest_m = self.pieces(later).map(|later_piece| between_m(&piece, &later_piece));
                    clearance_m = nearest_m.fold(clearance_m, f64::min);
                }
            }
        }
        clearance_m
    }

    /// Smallest distance of the arm from the boxes and the floor \[m\]. All links except the first, and the bodies
    /// `carried`, are compared with the boxes. The same links and `plate` are compared with the floor.
    fn cell_clearance_m(
        &self,
        links: &[[Vector3<f64>; 3]],
        carried: &[&Capsule],
        plate: Option<&Capsule>,
    ) -> f64 {
        let mut clearance_m = f64::INFINITY;
        let mut compare = |body: &Capsule, block: &Cuboid, place: &Placement| {
            if let Ok(found) = query::distance(&Placement::IDENTITY, &body.segment, place, block) {
                clearance_m = clearance_m.min((found.distance - body.radius).max(0.0));
            }
        };
        for [one, other] in &self.boxes_m {
            let half = |axis: usize| 0.5 * (one[axis] - other[axis]).abs();
            let middle = |axis: usize| 0.5 * (one[axis] + other[axis]);
            let block = Cuboid::new(Vector::new(half(0), half(1), half(2)));
            let place = Placement::translation(middle(0), middle(1), middle(2));
            carried.iter().for_each(|body| compare(body, &block, &place));
            for link in links.iter().skip(1) {
                self.pieces(link).for_each(|piece| compare(&piece, &block, &place));
            }
        }
        if let Some(floor_m) = self.floor_m {
            let ends = links.iter().skip(1).map(|[_, _, after]| after.z - self.link_radius_m);
            let plate = plate
                .into_iter()
                .flat_map(|plate| [plate.segment.a.z - plate.radius, plate.segment.b.z - plate.radius]);
            clearance_m = ends.chain(plate).map(|z| z - floor_m).fold(clearance_m, f64::min);
        }
        clearance_m
    }

    /// The capsules of a link: the first along its joint axis, the second along its common normal. Capsules
    /// without length are omitted.
    fn pieces(&self, [before, corner, after]: &[Vector3<f64>; 3]) -> impl Iterator<Item = Capsule> {
        let radius_m = self.link_radius_m;
        [[*before, *corner], [*corner, *after]]
            .into_iter()
            .filter(|[a, b]| (b - a).norm() >= 1e-6)
            .map(move |ends| capsule(ends, radius_m))
    }

    /// A capsule with the radius of rod and plate.
    fn rod(&self, ends: [Vector3<f64>; 2]) -> Capsule {
        capsule(ends, self.rod_radius_m)
    }
}

fn capsule([a, b]: [Vector3<f64>; 2], radius_m: f64) -> Capsule {
    Capsule::new(Vector::new(a.x, a.y, a.z), Vector::new(b.x, b.y, b.z), radius_m)
}

/// Distance between two capsules \[m\]; zero if they overlap. It is the distance of their centre lines minus the radii,
/// which takes a tenth of the time that the distance of two round bodies takes.
fn between_m(one: &Capsule, other: &Capsule) -> f64 {
    let apart_m = distance_segment_segment(&Placement::IDENTITY, &one.segment, &other.segment);
    (apart_m - one.radius - other.radius).max(0.0)
}

#[cfg(test)]
mod tests {
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    fn at(point: Vector) -> Vector3<f64> {
        Vector3::new(point.x, point.y, point.z)
    }

    /// Distance between a capsule and a convex body, from the distance `off_m` between a point and that body. The distance is
    /// a convex function of the point on the centre line, so a ternary search finds its minimum.
    fn searched_m(capsule: &Capsule, off_m: impl Fn(Vector3<f64>) -> f64) -> f64 {
        let [a, b] = [at(capsule.segment.a), at(capsule.segment.b)];
        let off_m = |part: f64| off_m(a.lerp(&b, part));
        let (mut low, mut high) = (0.0, 1.0);
        for _ in 0..80 {
            let third = (high - low) / 3.0;
            if off_m(low + third) < off_m(high - third) { high -= third } else { low += third }
        }
        (off_m(0.5 * (low + high)) - capsule.radius).max(0.0)
    }

    #[test]
    fn distances_are_those_that_a_search_along_the_centre_line_finds() {
        let mut random = ChaCha8Rng::seed_from_u64(1);
        let half_m = Vector3::new(0.1, 0.2, 0.15);
        let boxes_m = vec![[(-half_m).into(), half_m.into()]];
        let bodies = Bodies { boxes_m, ..Bodies::for_reach(1.0) };
        let mut drawn = || {
            let mut point = || Vector3::from_fn(|_, _| random.random_range(-0.5..0.5));
            capsule([point(), point()], random.random_range(0.01..0.1))
        };
        for _ in 0..300 {
            let [one, other] = [drawn(), drawn()];
            let [a, b] = [at(other.segment.a), at(other.segment.b)];
            let from_other_m = |point: Vector3<f64>| {
                let part = (point - a).dot(&(b - a)) / (b - a).norm_squared();
                (point - a.lerp(&b, part.clamp(0.0, 1.0))).norm() - other.radius
            };
            let from_box_m = |point: Vector3<f64>| (point.abs() - half_m).sup(&Vector3::zeros()).norm();
            for (found_m, expected_m) in [
                (between_m(&one, &other), searched_m(&one, from_other_m)),
                (bodies.cell_clearance_m(&[], &[&one], None), searched_m(&one, from_box_m)),
            ] {
                assert!((found_m - expected_m).abs() < 1e-6, "{found_m} {expected_m}: {one:?} {other:?}");
            }
        }
    }
}
