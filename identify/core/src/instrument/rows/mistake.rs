//! Mistakes in the robot's file, in the mapping, or in the rows of an instrument.

use std::fmt;

use crate::logs::JointMistake;

/// A mistake in a file of rows, in its mapping, or in the robot's file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mistake {
    /// A mistake in the joint columns.
    Joints(JointMistake),
    /// The joints of each measurement are in the row before or after it.
    RowsShifted,
    /// Two axes of the positions are exchanged, or one axis has the opposite sign.
    Mirrored,
    /// The instrument, its target or the robot was displaced just before the row with this index, from 0.
    Moved(usize),
    /// The unit of lengths is wrong. True length divided by the length as read, times 1000. Distances
    /// between positions are lengths, too.
    LengthUnit(u32),
    /// The table in the robot's file uses Craig's modified convention, but it was read as
    /// a table of the standard convention.
    ModifiedTable,
}

impl Mistake {
    /// Typical wrong units: metres, centimetres or inches read as millimetres, and the reverse of each.
    pub const LENGTH_UNITS: [Self; 6] = [
        Self::LengthUnit(1_000_000),
        Self::LengthUnit(10_000),
        Self::LengthUnit(25_400),
        Self::LengthUnit(100),
        Self::LengthUnit(39),
        Self::LengthUnit(1),
    ];

    /// All mistakes of the joint columns of an arm with `axes` axes.
    pub fn of_joints(axes: usize) -> Vec<Self> {
        JointMistake::all(axes).into_iter().map(Self::Joints).collect()
    }

    /// Factor by which lengths become shorter when the mistake is corrected. Errors become smaller by the same factor.
    /// 1 if lengths do not become shorter.
    pub fn shortening(self) -> f64 {
        match self {
            Self::LengthUnit(thousandths) => (f64::from(thousandths) / 1e3).min(1.0),
            _ => 1.0,
        }
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
                "the true lengths are {} times the lengths as read, since `unit` in the mapping is wrong",
                f64::from(*thousandths) / 1e3
            ),
            Self::ModifiedTable => write!(
                f,
                "the robot's table is in the modified convention and read as the standard one (convention = \"modified\")"
            ),
        }
    }
}
