//! What goes wrong with the joints of a file before anybody calibrates, as it can be undone and tried.

use std::fmt;

use crate::kinematics::Joints;

/// One thing that is wrong with all rows alike.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum JointMistake {
    /// A joint counts the other way.
    Reversed(usize),
    /// The columns of two joints.
    Exchanged(usize, usize),
    /// All joints are in radians and read as degrees, or the other way round.
    InOtherUnit,
}

impl JointMistake {
    /// All that can be made with the joints of an arm.
    pub fn all(axes: usize) -> Vec<Self> {
        let exchanged =
            (0..axes).flat_map(|one| (one + 1..axes).map(move |other| Self::Exchanged(one, other)));
        (0..axes).map(Self::Reversed).chain(exchanged).chain([Self::InOtherUnit]).collect()
    }

    /// The joints of a row without the mistake, in each of its directions.
    pub fn undone(self, joints: &Joints) -> Vec<Joints> {
        let mut undone = *joints;
        match self {
            Self::Reversed(joint) => undone[joint] = -undone[joint],
            Self::Exchanged(one, other) => undone.swap(one, other),
            Self::InOtherUnit => return vec![undone.map(f64::to_degrees), undone.map(f64::to_radians)],
        }
        vec![undone]
    }

    /// How many directions it has.
    pub const fn directions(self) -> usize {
        if matches!(self, Self::InOtherUnit) { 2 } else { 1 }
    }
}

impl fmt::Display for JointMistake {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Reversed(joint) => write!(f, "joint {} counts the other way", joint + 1),
            Self::Exchanged(one, other) => write!(f, "joints {} and {} are exchanged", one + 1, other + 1),
            Self::InOtherUnit => f.write_str("the joints are in the other unit"),
        }
    }
}
