//! From the name of a cost to its residual.

use super::config::{CostName, NoiseConfig};
use crate::cost::{
    Length, Position, PositionAngles, Residual, TORSION, Transform, WhitenedPose, WhitenedPoseOfFour,
};
use crate::kinematics::BAR_JOINTS;
use crate::model::{Geometry, ParameterId};
use crate::prepare::Prepared;

/// Work on runs that is the same for every cost.
pub(super) trait WithResidual {
    /// What it comes to.
    type Output;

    /// Does it; `residual` makes the cost for a run on a geometry.
    fn with<R: Residual>(self, residual: impl Fn(&Prepared, &Geometry) -> R) -> Self::Output;
}

impl CostName {
    /// Every cost, the most telling first.
    pub const ALL: [Self; 5] =
        [Self::Pose, Self::Transform, Self::PositionAngles, Self::Position, Self::Length];

    /// Bar joints whose encoders it needs, from 0.
    pub const fn encoders(self) -> &'static [usize] {
        match self {
            Self::Pose => WhitenedPoseOfFour::ENCODERS,
            Self::Transform => Transform::ENCODERS,
            Self::PositionAngles => PositionAngles::ENCODERS,
            Self::Position => Position::ENCODERS,
            Self::Length => Length::ENCODERS,
        }
    }

    /// The cost that tells as much where noise is not weighed: which parameters poses can identify at all.
    pub(super) fn unweighed(self, measured: &[bool; BAR_JOINTS]) -> Self {
        match self {
            Self::Pose if is_of_four(measured) => Self::PositionAngles,
            Self::Pose => Self::Transform,
            other => other,
        }
    }

    /// [`Residual::tells`] of its residual with the encoders that there are.
    pub fn tells(self, measured: &[bool; BAR_JOINTS], id: ParameterId) -> bool {
        match self {
            Self::Pose if is_of_four(measured) => WhitenedPoseOfFour::tells(id),
            Self::Pose => WhitenedPose::tells(id),
            Self::Transform => Transform::tells(id),
            Self::PositionAngles => PositionAngles::tells(id),
            Self::Position => Position::tells(id),
            Self::Length => Length::tells(id),
        }
    }

    /// Does the work with its residual, which may depend on the encoders that there are.
    pub(super) fn run<W: WithResidual>(
        self,
        measured: &[bool; BAR_JOINTS],
        noise: NoiseConfig,
        work: W,
    ) -> W::Output {
        match self {
            Self::Pose if is_of_four(measured) => work.with(|prepared: &Prepared, geometry: &Geometry| {
                let Prepared { motion, observations, .. } = prepared;
                WhitenedPoseOfFour::new(geometry, motion, observations, noise.into())
            }),
            Self::Pose => work.with(|prepared: &Prepared, geometry: &Geometry| {
                WhitenedPose::new(geometry, &prepared.motion, &prepared.observations, noise.into())
            }),
            Self::Transform => work.with(|_: &Prepared, _: &Geometry| Transform),
            Self::PositionAngles => work.with(|_: &Prepared, _: &Geometry| PositionAngles),
            Self::Position => work.with(|_: &Prepared, _: &Geometry| Position),
            Self::Length => work.with(|_: &Prepared, _: &Geometry| Length),
        }
    }
}

/// Encoder 3 is missing, which the whitened pose can do without.
const fn is_of_four(measured: &[bool; BAR_JOINTS]) -> bool {
    !measured[TORSION]
}
