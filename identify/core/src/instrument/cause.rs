//! Changes at one instant of an instrument, a robot or their clocks during a measurement.

use crate::kinematics::LinkParameter;
use crate::model::{Axis, Coordinate, ParameterId};

/// What can change during a measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cause {
    /// Offset of the encoder of this bar joint, from 0.
    Encoder(usize),
    /// Zero position of this robot joint, from 0.
    Joint(usize),
    /// Position of the bar's base.
    Base,
    /// Time offset between the two logs.
    Clock,
    /// Pose of the tracker in this station, from 0.
    Tracker(usize),
    /// Position of this target on the flange, from 0.
    Probe(usize),
    /// Position of this anchor of the wire, from 0.
    Anchor(usize),
    /// Offset of the lengths.
    LengthOffset,
    /// Position of the tip on the flange.
    Tip,
}

impl Cause {
    /// Parameters that change with this cause.
    pub(crate) fn ids(self) -> Vec<ParameterId> {
        let parameter = LinkParameter::Theta;
        match self {
            Self::Encoder(link) => vec![ParameterId::Bar { link, parameter }],
            Self::Joint(link) => vec![ParameterId::Robot { link, parameter }],
            Self::Base => Axis::ALL.map(|axis| ParameterId::Base { axis }).to_vec(),
            Self::Clock => vec![ParameterId::ClockShift],
            Self::Tracker(station) => {
                Coordinate::ALL.map(|coordinate| ParameterId::Tracker { station, coordinate }).to_vec()
            }
            Self::Probe(target) => {
                let position = Axis::ALL.map(Coordinate::Position);
                position.map(|coordinate| ParameterId::Probe { target, coordinate }).to_vec()
            }
            Self::Anchor(station) => Axis::ALL.map(|axis| ParameterId::Anchor { station, axis }).to_vec(),
            Self::LengthOffset => vec![ParameterId::LengthOffset],
            Self::Tip => Axis::ALL.map(|axis| ParameterId::Tip { axis }).to_vec(),
        }
    }
}
