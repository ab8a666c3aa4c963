//! Errors of the robot's axes with any whole number of waves per turn of the drive's output, which is the joint where
//! nothing couples drives.
//!
//! A joint's own encoder, the teeth of its last gear and the flexspline of a harmonic drive err by a curve that comes back
//! with each turn. Its Fourier series is the curve: `e(g) = sum_n a_n sin(n g) + b_n cos(n g)`. Once and twice per turn
//! are terms of their own ([`super::JointTerm`]); this is the rest. Amplitudes are many and small, so they are estimated
//! with a prior, never free.

use std::fmt;

use super::{DriveState, DriveTrain, JointState};
use crate::kinematics::{AXES_MAX, Turn};

/// Which part of a wave.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Phase {
    /// Of the sine.
    Sine,
    /// Of the cosine.
    Cosine,
}

impl Phase {
    /// Both.
    pub const ALL: [Self; 2] = [Self::Sine, Self::Cosine];
}

impl fmt::Display for Phase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Sine => "sin",
            Self::Cosine => "cos",
        })
    }
}

/// Amplitudes of all axes \[rad\].
#[derive(Debug, Clone, Default, PartialEq)]
pub struct JointWaves {
    /// Of each axis, sine and cosine by order from [`Self::FIRST`] up to the highest that was asked for.
    amplitudes_rad: [Vec<[f64; 2]>; AXES_MAX],
}

impl JointWaves {
    /// Least waves per turn that are told here.
    pub const FIRST: u8 = 3;
    /// Most.
    pub const LAST: u8 = 127;

    /// One amplitude; none for an axis or an order that is not there.
    pub fn amplitude_mut(&mut self, axis: usize, order: u8, phase: Phase) -> Option<&mut f64> {
        if !(Self::FIRST..=Self::LAST).contains(&order) {
            return None;
        }
        let of_axis = self.amplitudes_rad.get_mut(axis)?;
        let index = usize::from(order - Self::FIRST);
        if of_axis.len() <= index {
            of_axis.resize(index + 1, [0.0; 2]);
        }
        of_axis.get_mut(index)?.get_mut(phase as usize)
    }

    /// A wave of amplitude one at an angle.
    #[inline]
    pub fn wave(order: u8, phase: Phase, angle: Turn) -> f64 {
        let Turn { sin, cos } = angle.times(order);
        match phase {
            Phase::Sine => sin,
            Phase::Cosine => cos,
        }
    }

    /// The error of an axis at an angle and its slope.
    fn error(amplitudes_rad: &[[f64; 2]], angle: Turn) -> (f64, f64) {
        let mut reached: Option<(u8, Turn)> = None;
        let (mut error, mut slope) = (0.0, 0.0);
        for (order, [a, b]) in (Self::FIRST..).zip(amplitudes_rad).filter(|(_, wave)| **wave != [0.0; 2]) {
            let before = reached.filter(|(before, _)| before + 1 == order);
            let wave = before.map_or_else(|| angle.times(order), |(_, before)| before.and(angle));
            reached = Some((order, wave));
            error += a * wave.sin + b * wave.cos;
            slope += f64::from(order) * (a * wave.cos - b * wave.sin);
        }
        (error, slope)
    }

    /// Adds the waves, functions of what was reported, to joints and rates.
    pub(super) fn add_to(&self, corrected: &mut JointState, state: &DriveState, drives: &DriveTrain) {
        for (axis, amplitudes_rad) in self.amplitudes_rad.iter().enumerate() {
            if amplitudes_rad.is_empty() {
                continue;
            }
            let (error, slope) = Self::error(amplitudes_rad, state.turn[axis]);
            let error_rate = slope * state.rate[axis];
            for (joint, part) in drives.joint_from_drive[axis].iter().enumerate() {
                corrected.q[joint] += part * error;
                corrected.qd[joint] += part * error_rate;
            }
        }
    }
}
