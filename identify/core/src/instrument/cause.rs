//! Causes of a change (a step or a drift) during a measurement. A part of an instrument, a part of the robot or
//! a clock may change.

use shared::config::JointKind;

use crate::kinematics::LinkParameter;
use crate::model::{ParameterId, Unit};

/// A quantity that can change during a measurement. The instrument or robot that has its parameters defines its name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cause {
    /// Name of the changed part in messages.
    pub name: String,
    /// Parameters that change together. Those with the same unit as the first one define the size of the change.
    pub ids: Vec<ParameterId>,
}

impl Cause {
    /// Creates a cause with these parameters and a name for messages.
    pub fn new(name: impl Into<String>, ids: impl Into<Vec<ParameterId>>) -> Self {
        Self { name: name.into(), ids: ids.into() }
    }

    /// The zero position of a robot joint. `link` is its index from 0, and `joint` is its type.
    pub(crate) fn joint(link: usize, joint: JointKind) -> Self {
        let id = ParameterId::Robot { link, parameter: LinkParameter::offset_of(joint) };
        Self::new(format!("the zero of joint {}", link + 1), [id])
    }

    /// The time offset between the logs of robot and instrument.
    pub(super) fn clock() -> Self {
        Self::new("the robot's clock", [ParameterId::ClockShift])
    }

    /// Unit of the size of the change.
    pub(crate) fn unit(&self) -> Unit {
        self.ids.first().map_or(Unit::Ratio, |id| id.unit())
    }
}

/// Number of a part in a message, with `noun` before it. Empty for the first part.
pub(super) fn numbered(noun: &str, number: usize) -> String {
    if number == 0 { String::new() } else { format!("{noun} {}", number + 1) }
}
