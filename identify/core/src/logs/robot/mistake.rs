//! Common mistakes in the joints of a file, which can be undone to test for them.

use std::fmt;

use crate::kinematics::Joints;

/// A mistake that all rows have.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum JointMistake {
    /// A joint counts the other way.
    Reversed(usize),
    /// The columns of two joints are exchanged.
    Exchanged(usize, usize),
    /// All joints are in radians and read as degrees.
    InRadians,
    /// All joints are in degrees and read as radians.
    InDegrees,
}

impl JointMistake {
    /// All mistakes that are possible with the joints of an arm.
    pub fn all(axes: usize) -> Vec<Self> {
        let exchanged =
            (0..axes).flat_map(|one| (one + 1..axes).map(move |other| Self::Exchanged(one, other)));
        (0..axes).map(Self::Reversed).chain(exchanged).chain([Self::InRadians, Self::InDegrees]).collect()
    }

    /// The joints of a row without the mistake.
    #[must_use]
    pub fn undone(self, joints: &Joints) -> Joints {
        let mut undone = *joints;
        match self {
            Self::Reversed(joint) => undone[joint] = -undone[joint],
            Self::Exchanged(one, other) => undone.swap(one, other),
            Self::InRadians => return undone.map(f64::to_degrees),
            Self::InDegrees => return undone.map(f64::to_radians),
        }
        undone
    }
}

impl fmt::Display for JointMistake {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Reversed(joint) => write!(f, "joint {} counts the other way", joint + 1),
            Self::Exchanged(one, other) => write!(f, "joints {} and {} are exchanged", one + 1, other + 1),
            Self::InRadians | Self::InDegrees => f.write_str("the joints are in the other unit"),
        }
    }
}
