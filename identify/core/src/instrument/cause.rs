//! What an instrument, a robot and their clocks can change by while they measure.

use crate::kinematics::LinkParameter;
use crate::model::{Axis, Coordinate, ParameterId};

/// What can change while it is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cause {
    /// The offset of the encoder of this joint of the bar, from 0.
    Encoder(usize),
    /// The zero of this joint of the robot, from 0.
    Joint(usize),
    /// Where the bar stands.
    Base,
    /// The time of one log against the other.
    Clock,
    /// Where the tracker stands in this station, from 0.
    Tracker(usize),
    /// Where this target is on the flange, from 0.
    Probe(usize),
    /// Where the wire is anchored in this place, from 0.
    Anchor(usize),
    /// What its lengths begin with.
    LengthOffset,
    /// Where the tip is on the flange.
    Tip,
}

impl Cause {
    /// The parameters that change with it.
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
