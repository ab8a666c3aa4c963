//! Poses of a tracker and of its targets. Both are unknown rigid transforms, which relate the tracker's
//! measurements to the robot.

use std::fmt;

use nalgebra::{Rotation3, Vector3};

use super::Axis;
use crate::kinematics::Pose;

/// One of the six coordinates of a [`Placement`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Coordinate {
    /// Coordinate of the origin: `x`, `y`, `z`.
    Position(Axis),
    /// Component of the rotation vector: `rx`, `ry`, `rz`.
    Rotation(Axis),
}

impl Coordinate {
    /// All six coordinates, the origin first.
    pub const ALL: [Self; 6] = {
        let [x, y, z] = Axis::ALL;
        [
            Self::Position(x),
            Self::Position(y),
            Self::Position(z),
            Self::Rotation(x),
            Self::Rotation(y),
            Self::Rotation(z),
        ]
    };
}

impl fmt::Display for Coordinate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Position(axis) => write!(f, "{}", axis.letter()),
            Self::Rotation(axis) => write!(f, "r{}", axis.letter()),
        }
    }
}

/// A rigid transform, as position and rotation vector. A rotation vector has no singularity below a full turn, and real
/// set-ups need half a turn at most.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Placement {
    /// Origin \[m\].
    pub position_m: Vector3<f64>,
    /// Rotation vector: axis times angle \[rad\].
    pub rotation_rad: Vector3<f64>,
}

impl Placement {
    /// Position and rotation vector of a transform.
    pub fn from_pose(pose: &Pose) -> Self {
        // The conversion uses a quaternion, because the logarithm of the matrix loses digits near zero and near half a turn.
        let rotation = nalgebra::UnitQuaternion::from_rotation_matrix(&pose.rotation);
        Self { position_m: pose.translation.vector, rotation_rad: rotation.scaled_axis() }
    }

    /// The transform as position and rotation matrix.
    pub fn pose(&self) -> Pose {
        Pose::from_parts(self.position_m.into(), Rotation3::new(self.rotation_rad))
    }

    /// Mutable access to a coordinate \[m, rad\].
    pub fn coordinate_mut(&mut self, coordinate: Coordinate) -> &mut f64 {
        match coordinate {
            Coordinate::Position(axis) => &mut self.position_m[axis.index()],
            Coordinate::Rotation(axis) => &mut self.rotation_rad[axis.index()],
        }
    }

    /// Value of a coordinate \[m, rad\].
    pub fn coordinate(mut self, coordinate: Coordinate) -> f64 {
        *self.coordinate_mut(coordinate)
    }

    /// Angular velocity per unit rate of one component of the rotation vector, in the parent frame of the placement.
    /// It is a column of the left Jacobian `1 + (1 - cos t)/t^2 [w] + (t - sin t)/t^3 [w]^2`, with the rotation
    /// vector `w` and `t = |w|`.
    pub fn turning(&self, axis: Axis) -> Vector3<f64> {
        let w = self.rotation_rad;
        let squared = w.norm_squared();
        // For small angles both quotients suffer from cancellation, so series are used.
        let (first, second) = if squared < 1e-4 {
            (
                0.5 - squared / 24.0 + squared * squared / 720.0,
                1.0 / 6.0 - squared / 120.0 + squared * squared / 5040.0,
            )
        } else {
            let angle = squared.sqrt();
            ((1.0 - angle.cos()) / squared, (angle - angle.sin()) / (squared * angle))
        };
        let unit = axis.unit();
        let across = w.cross(&unit);
        unit + across * first + w.cross(&across) * second
    }
}

/// Station and target of a measured row.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct SetUp {
    /// Index of the tracker's station or the wire's anchor, from 0.
    pub station: usize,
    /// Index of the target on the flange or the wire's attachment, from 0.
    pub target: usize,
}

impl SetUp {
    /// Number of stations and of targets in the rows of a file. Each is at least one.
    pub fn counts(set_ups: impl Iterator<Item = Self> + Clone) -> [usize; 2] {
        let count = |index: fn(Self) -> usize| set_ups.clone().map(index).max().map_or(1, |last| last + 1);
        [count(|set_up| set_up.station), count(|set_up| set_up.target)]
    }
}

/// A tracker that follows targets on the flange from one or more stations.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TrackerGeometry {
    /// `root_from_tracker` of each station: the tracker's pose.
    pub places: Vec<Placement>,
    /// `flange_from_probe` of each target: its mounting pose.
    pub probes: Vec<Placement>,
}

impl TrackerGeometry {
    /// Tracker pose and probe pose of a set-up. `None` if the set-up does not exist.
    pub fn at(&self, set_up: SetUp) -> Option<(&Placement, &Placement)> {
        Some((self.places.get(set_up.station)?, self.probes.get(set_up.target)?))
    }
}
