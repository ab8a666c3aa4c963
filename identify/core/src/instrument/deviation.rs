//! The difference between robot and measurement at a sample.

use nalgebra::Vector3;

/// Robot minus measurement at one sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Deviation {
    /// Difference of two positions along the axes of the robot's base, or of two lengths.
    pub apart: Apart,
    /// Angle between the two orientations \[rad\]; `None` without a measured orientation.
    pub rotation_rad: Option<f64>,
}

/// What was compared.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Apart {
    /// Where the robot's end is minus where it was measured \[m\].
    Place(Vector3<f64>),
    /// A length by the robot minus the measured one \[m\].
    Length(f64),
}

impl Deviation {
    /// Of two positions without orientations.
    pub const fn of_place(offset_m: Vector3<f64>) -> Self {
        Self { apart: Apart::Place(offset_m), rotation_rad: None }
    }

    /// Of two lengths.
    pub const fn of_length(longer_m: f64) -> Self {
        Self { apart: Apart::Length(longer_m), rotation_rad: None }
    }
}

impl Deviation {
    /// A difference of lengths with its sign, the size of one of places \[m\].
    pub(crate) fn signed_m(&self) -> f64 {
        match self.apart {
            Apart::Place(offset_m) => offset_m.norm(),
            Apart::Length(longer_m) => longer_m,
        }
    }
}

/// The size of a [`Deviation`].
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PoseError {
    /// \[m\]
    pub position_m: f64,
    /// Angle \[rad\]; `None` without a measured orientation.
    pub rotation_rad: Option<f64>,
}

impl From<Deviation> for PoseError {
    fn from(deviation: Deviation) -> Self {
        Self { position_m: deviation.signed_m().abs(), rotation_rad: deviation.rotation_rad }
    }
}
