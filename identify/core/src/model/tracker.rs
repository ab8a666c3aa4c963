//! Where a tracker stands and what it follows: two unknown rigid transforms between it and the robot.

use std::fmt;

use nalgebra::{Rotation3, Vector3};

use super::Axis;
use crate::kinematics::Pose;

/// One of the six numbers of a [`Placement`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Coordinate {
    /// Of its origin: `x`, `y`, `z`.
    Position(Axis),
    /// Of its rotation vector: `rx`, `ry`, `rz`.
    Rotation(Axis),
}

impl Coordinate {
    /// All six, the origin's first.
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

/// A rigid transform in six numbers: position and rotation vector, so that no orientation of a real set-up is singular
/// (a rotation vector is regular up to a whole turn, and none longer than half a turn is needed).
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Placement {
    /// Origin \[m\].
    pub position_m: Vector3<f64>,
    /// Axis times angle \[rad\].
    pub rotation_rad: Vector3<f64>,
}

impl Placement {
    /// The six numbers of a transform.
    pub fn of(pose: &Pose) -> Self {
        // Through the quaternion: the matrix' own logarithm loses digits near zero and near half a turn.
        let rotation = nalgebra::UnitQuaternion::from_rotation_matrix(&pose.rotation);
        Self { position_m: pose.translation.vector, rotation_rad: rotation.scaled_axis() }
    }

    /// The transform.
    pub fn pose(&self) -> Pose {
        Pose::from_parts(self.position_m.into(), Rotation3::new(self.rotation_rad))
    }

    /// One of its numbers \[m, rad\].
    pub fn coordinate_mut(&mut self, coordinate: Coordinate) -> &mut f64 {
        match coordinate {
            Coordinate::Position(axis) => &mut self.position_m[axis.index()],
            Coordinate::Rotation(axis) => &mut self.rotation_rad[axis.index()],
        }
    }

    /// The same \[m, rad\].
    pub fn coordinate(mut self, coordinate: Coordinate) -> f64 {
        *self.coordinate_mut(coordinate)
    }

    /// Angular velocity, in the frame that the placement is given in, when one entry of the rotation vector grows at
    /// unit speed: a column of the left Jacobian `1 + (1 - cos t)/t^2 [w] + (t - sin t)/t^3 [w]^2`, `t = |w|`.
    pub fn turning(&self, axis: Axis) -> Vector3<f64> {
        let w = self.rotation_rad;
        let squared = w.norm_squared();
        // Both quotients cancel for small angles; their series there.
        let (once, twice) = if squared < 1e-4 {
            (
                0.5 - squared / 24.0 + squared * squared / 720.0,
                1.0 / 6.0 - squared / 120.0 + squared * squared / 5040.0,
            )
        } else {
            let angle = squared.sqrt();
            ((1.0 - angle.cos()) / squared, (angle - angle.sin()) / (squared * angle))
        };
        let unit = Vector3::ith(axis.index(), 1.0);
        let across = w.cross(&unit);
        unit + across * once + w.cross(&across) * twice
    }
}

/// From where a row was measured, and what was seen.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct SetUp {
    /// Station of the tracker from 0; the anchor of a wire.
    pub station: usize,
    /// Target on the flange from 0; where a wire is attached.
    pub target: usize,
}

impl SetUp {
    /// So many stations and targets have the rows of a file, of one each at least.
    pub fn counts(all: impl Iterator<Item = Self> + Clone) -> [usize; 2] {
        let count = |of: fn(Self) -> usize| all.clone().map(of).max().map_or(1, |last| last + 1);
        [count(|one| one.station), count(|one| one.target)]
    }
}

/// A tracker that follows targets on the flange, from one station or several.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Tracker {
    /// `root_from_tracker` of each station: where the tracker stands.
    pub places: Vec<Placement>,
    /// `flange_from_probe` of each target: how it is mounted.
    pub probes: Vec<Placement>,
}

impl Tracker {
    /// Place and probe of a set-up; none of one that is not there.
    pub fn at(&self, set_up: SetUp) -> Option<(&Placement, &Placement)> {
        Some((self.places.get(set_up.station)?, self.probes.get(set_up.target)?))
    }
}
