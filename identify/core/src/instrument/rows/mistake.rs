//! Mistakes in the robot's file, the mapping or the rows of an instrument.

use std::fmt;

use crate::logs::JointMistake;

/// One mistake in a file of rows, its mapping or the robot's file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mistake {
    /// A mistake in the joint columns.
    Joints(JointMistake),
    /// Joints are one row before or after the measurement they belong to.
    RowsShifted,
    /// Two axes of the positions are exchanged, or one has the other sign.
    Mirrored,
    /// The instrument, its target or the robot was displaced at this row, from 0.
    Moved(usize),
    /// True length, or distance of positions, over that as read \[1/1000\].
    LengthUnit(u32),
    /// The table of the robot's file uses Craig's modified convention and is read as the standard one.
    ModifiedTable,
}

impl Mistake {
    /// Usual wrong units: m read as mm, cm as mm, inches as mm, and each the other way round.
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

    /// Factor by which lengths, and with them all errors, become shorter without the mistake; 1 if they do not.
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
