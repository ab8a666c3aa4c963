//! What goes wrong between robot, instrument and file before anybody calibrates.

use std::fmt;

use crate::logs::JointMistake;

/// One thing that is wrong with a file of rows, its mapping or the robot's file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mistake {
    /// A mistake of the joints.
    Joints(JointMistake),
    /// Joints are in the row before or after what was measured there.
    RowsShifted,
    /// Two axes of the positions are exchanged, or one has the other sign.
    Mirrored,
    /// From this row on, from 0, the instrument, what it measures or the robot stand elsewhere.
    Moved(usize),
    /// Lengths are this many thousandths of what they are read as.
    LengthUnit(u32),
    /// Lengths and twists of the robot's file are in the row of the next joint: Craig's convention, read as the standard one.
    ModifiedTable,
}

impl Mistake {
    /// All that can be made with the joints of an arm.
    pub fn of_joints(axes: usize) -> Vec<Self> {
        JointMistake::all(axes).into_iter().map(Self::Joints).collect()
    }
}

impl fmt::Display for Mistake {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Joints(mistake) => write!(f, "{mistake}"),
            Self::RowsShifted => {
                write!(f, "each row's joints belong to the measurement of the row before or after it")
            }
            Self::Mirrored => {
                write!(f, "two axes of the positions are exchanged or one has the other sign")
            }
            Self::Moved(row) => write!(f, "tracker, target or robot were moved near row {}", row + 1),
            Self::LengthUnit(thousandths) => write!(
                f,
                "the lengths are {} times as long as read, in another unit than `unit` of the mapping",
                f64::from(*thousandths) / 1e3
            ),
            Self::ModifiedTable => write!(
                f,
                "the robot's table is in the modified convention and read as the standard one (convention = \"modified\")"
            ),
        }
    }
}
