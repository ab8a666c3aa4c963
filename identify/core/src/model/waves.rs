//! What comes back a whole number of times with each turn of an angle: errors of a robot's axis, of a bar's encoder, of the bar's
//! length. Its Fourier series is the curve, `e(b) = sum_n a_n sin(n b) + c_n cos(n b)`.
//!
//! - A robot's axis, over the angle of its drive's output: its encoder, the teeth of its last gear and the flexspline of a
//!   harmonic drive. Once and twice per turn are terms of their own ([`super::JointTerm`]). Amplitudes are many and small, so
//!   they are estimated with a prior, never free.
//! - A bar's encoder, over its reading: once per turn is an eccentric grating, twice an elliptic or tilted one.
//! - The bar's length, over the readings of its first two joints, which give it its direction: a bearing that is oval or has
//!   three lobes moves the bar's end out and in. Once per turn is an axis beside its place, which the bar's base and the
//!   encoders' waves already say; more lobes are flattened by the bearing's balls.
//!
//! Phases of the bar's waves count from the recording's own zero of each encoder.

use std::fmt;
use std::ops::RangeInclusive;

use crate::kinematics::Turn;

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

    /// A wave of amplitude one at an angle.
    #[inline]
    pub fn wave(self, order: u8, angle: Turn) -> f64 {
        let Turn { sin, cos } = angle.times(order);
        match self {
            Self::Sine => sin,
            Self::Cosine => cos,
        }
    }
}

impl fmt::Display for Phase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Sine => "sin",
            Self::Cosine => "cos",
        })
    }
}

/// The waves over one angle.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Waves {
    /// Waves per turn, amplitudes of sine and cosine; in ascending order.
    of_orders: Vec<(u8, [f64; 2])>,
}

impl Waves {
    /// Waves per turn of a robot's axis.
    pub const OF_AXIS: RangeInclusive<u8> = 3..=127;
    /// Of a bar's encoder.
    pub const OF_ENCODER: RangeInclusive<u8> = 1..=2;
    /// Of the bar's length.
    pub const OF_LENGTH: RangeInclusive<u8> = 2..=3;

    /// Nobody has asked for any.
    pub(super) fn is_none(&self) -> bool {
        self.of_orders.is_empty()
    }

    /// One amplitude.
    pub fn amplitude_mut(&mut self, order: u8, phase: Phase) -> &mut f64 {
        let place =
            self.of_orders.binary_search_by_key(&order, |(order, _)| *order).unwrap_or_else(|place| {
                self.of_orders.insert(place, (order, [0.0; 2]));
                place
            });
        &mut self.of_orders[place].1[phase as usize]
    }

    /// Their sum at an angle, and its slope.
    #[inline]
    pub fn at(&self, angle: Turn) -> (f64, f64) {
        let mut reached: Option<(u8, Turn)> = None;
        let (mut sum, mut slope) = (0.0, 0.0);
        for &(order, [a, c]) in self.of_orders.iter().filter(|(_, amplitudes)| *amplitudes != [0.0; 2]) {
            let before = reached.filter(|(before, _)| before + 1 == order);
            let wave = before.map_or_else(|| angle.times(order), |(_, before)| before.and(angle));
            reached = Some((order, wave));
            sum += a * wave.sin + c * wave.cos;
            slope += f64::from(order) * (a * wave.cos - c * wave.sin);
        }
        (sum, slope)
    }
}
