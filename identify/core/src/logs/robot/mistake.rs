//! Common mistakes in the joints of a file. To test whether a file contains one of them, the mistake is undone and
//! the joints are checked again.

use std::fmt;

use shared::config::JointKind;

use crate::kinematics::Joints;

/// A mistake in the joints of all rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum JointMistake {
    /// A joint has the opposite sign.
    Reversed(usize),
    /// The columns of two joints are exchanged.
    Exchanged(usize, usize),
    /// The file has all revolute joints in radians, but they were read as degrees.
    InRadians,
    /// The file has all revolute joints in degrees, but they were read as radians.
    InDegrees,
}

impl JointMistake {
    /// All mistakes that are possible with an arm of this number of axes.
    pub fn all(axes: usize) -> Vec<Self> {
        let exchanged =
            (0..axes).flat_map(|one| (one + 1..axes).map(move |other| Self::Exchanged(one, other)));
        (0..axes).map(Self::Reversed).chain(exchanged).chain([Self::InRadians, Self::InDegrees]).collect()
    }

    /// The joints of a row without the mistake. `kinds` are the kinds of the arm's axes.
    #[must_use]
    pub fn undone(self, joints: &Joints, kinds: impl Iterator<Item = JointKind>) -> Joints {
        let mut undone = *joints;
        match self {
            Self::Reversed(joint) => undone[joint] = -undone[joint],
            Self::Exchanged(one, other) => undone.swap(one, other),
            Self::InRadians | Self::InDegrees => {
                let converted: fn(f64) -> f64 =
                    if self == Self::InRadians { f64::to_degrees } else { f64::to_radians };
                let joints = undone.iter_mut().zip(kinds);
                let revolute = joints.filter(|(_, kind)| *kind == JointKind::Revolute);
                revolute.for_each(|(joint, _)| *joint = converted(*joint));
            }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_unit_of_angles_leaves_prismatic_axes_as_they_are() {
        let kinds = [JointKind::Prismatic, JointKind::Revolute];
        let undone =
            |mistake: JointMistake| mistake.undone(&Joints::from_array([1.5, 1.0]), kinds.iter().copied());
        assert_eq!(undone(JointMistake::InRadians), [1.5, 1f64.to_degrees()]);
        assert_eq!(undone(JointMistake::InDegrees), [1.5, 1f64.to_radians()]);
    }
}
