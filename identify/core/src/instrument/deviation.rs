//! The difference between robot and measurement at one sample.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

/// Robot minus measurement at one sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Deviation {
    /// Position difference along the axes of the robot's base, or length difference \[m\].
    pub apart: Apart,
    /// Angle between predicted and measured orientation \[rad\]. `None` without a measured orientation.
    pub rotation_rad: Option<f64>,
}

/// Difference of two positions, or of two lengths.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Apart {
    /// Position of the robot's end minus the measured position \[m\].
    Place(Vector3<f64>),
    /// Length predicted by the robot's pose minus the measured length \[m\].
    Length(f64),
}

impl Deviation {
    /// A difference of two positions \[m\], without orientations.
    pub const fn of_place(offset_m: Vector3<f64>) -> Self {
        Self { apart: Apart::Place(offset_m), rotation_rad: None }
    }

    /// A difference of two lengths \[m\].
    pub const fn of_length(longer_m: f64) -> Self {
        Self { apart: Apart::Length(longer_m), rotation_rad: None }
    }

    /// Signed difference of two lengths, or distance of two positions \[m\].
    pub(crate) fn signed_m(&self) -> f64 {
        match self.apart {
            Apart::Place(offset_m) => offset_m.norm(),
            Apart::Length(longer_m) => longer_m,
        }
    }
}

/// The absolute size of a [`Deviation`], or the root mean square of several sizes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct PoseError {
    /// Distance of the positions, or absolute difference of the lengths \[m\].
    pub position_m: f64,
    /// Angle \[rad\]; `None` without a measured orientation.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rotation_rad: Option<f64>,
}

impl From<Deviation> for PoseError {
    fn from(deviation: Deviation) -> Self {
        Self { position_m: deviation.signed_m().abs(), rotation_rad: deviation.rotation_rad }
    }
}
