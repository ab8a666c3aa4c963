//! Causes of a change (a step or a drift) during a measurement: a part of an instrument or of the robot, or a clock.

use shared::config::JointKind;

use crate::kinematics::LinkParameter;
use crate::model::{ParameterId, Unit};

/// What can change during a measurement. The part that owns the parameters names it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cause {
    /// Name of what changes, in messages.
    pub name: String,
    /// Parameters that change with it. Those in the unit of the first one are its size.
    pub ids: Vec<ParameterId>,
}

impl Cause {
    /// A change of these parameters under a name for messages.
    pub fn new(name: impl Into<String>, ids: impl Into<Vec<ParameterId>>) -> Self {
        Self { name: name.into(), ids: ids.into() }
    }

    /// Zero position of a robot joint, from 0, of this kind.
    pub(crate) fn joint(link: usize, joint: JointKind) -> Self {
        let id = ParameterId::Robot { link, parameter: LinkParameter::offset_of(joint) };
        Self::new(format!("the zero of joint {}", link + 1), [id])
    }

    /// Time offset between the two logs.
    pub(super) fn clock() -> Self {
        Self::new("the robot's clock", [ParameterId::ClockShift])
    }

    /// Unit of its size.
    pub(crate) fn unit(&self) -> Unit {
        self.ids.first().map_or(Unit::Ratio, |id| id.unit())
    }
}

/// Number of a part in a message, after its noun; empty for the first.
pub(super) fn numbered(noun: &str, number: usize) -> String {
    if number == 0 { String::new() } else { format!("{noun} {}", number + 1) }
}
