//! Causes of a change during a measurement. A change is a step or a drift of a part of an instrument, of
//! a part of the robot or of a clock.

use shared::config::JointKind;

use crate::kinematics::LinkParameter;
use crate::model::{ParameterId, Unit};

/// A quantity that can change during a measurement. Its name is defined by the instrument or robot that has its parameters.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cause {
    /// Name of the changed part in messages.
    pub name: String,
    /// Parameters that change together. The size of the change is computed from the parameters that
    /// have the same unit as the first one.
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

/// Number of a part, with `noun` before it, for a message. Empty for the first part.
pub(super) fn numbered(noun: &str, number: usize) -> String {
    if number == 0 { String::new() } else { format!("{noun} {}", number + 1) }
}
