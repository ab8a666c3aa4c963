//! Periodic functions of an angle `b`. They describe errors of a robot axis, of a bar encoder, or of the bar's length. Each
//! is a Fourier series, `e(b) = sum_n a_n sin(n b) + c_n cos(n b)`.
//!
//! - Errors of a robot axis depend on the output angle of its drive. Causes are the encoder, the teeth of the last gear, or
//!   the flexspline of a harmonic drive. Waves once and twice per turn are not described here, but by separate terms
//!   ([`super::JointTerm`]). The amplitudes are many and small, so they are always estimated with a prior.
//! - Errors of a bar encoder depend on its reading. An eccentric grating causes one wave per turn, an elliptic or
//!   tilted grating causes two.
//! - Errors of the bar's length depend on the readings of its first two joints, which define the bar's direction. An oval or
//!   three-lobed bearing moves the bar's end radially. One wave per turn would be an axis offset, which the bar's base and
//!   the encoder waves already describe. Higher orders are small because the balls of the bearing average them.
//!
//! The angle in waves of the bar is the encoder reading in the recording, without any offset. The phases of these
//! waves therefore depend on the encoder's offset.

use std::fmt;
use std::ops::RangeInclusive;

use crate::kinematics::Turn;

/// Sine or cosine component of a wave.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Phase {
    /// The sine component, `sin`.
    Sine,
    /// The cosine component, `cos`.
    Cosine,
}

impl Phase {
    /// Both components, sine first.
    pub const ALL: [Self; 2] = [Self::Sine, Self::Cosine];

    /// Value of the wave with this order and unit amplitude, at an angle.
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

/// A Fourier series over one angle.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Waves {
    /// Orders (waves per turn) with the amplitudes of sine and cosine, in ascending order.
    of_orders: Vec<(u8, [f64; 2])>,
}

impl Waves {
    /// Orders (waves per turn) of a robot axis.
    pub const OF_AXIS: RangeInclusive<u8> = 3..=127;
    /// Orders (waves per turn) of a bar encoder.
    pub const OF_ENCODER: RangeInclusive<u8> = 1..=2;
    /// Orders (waves per turn) of the bar's length.
    pub const OF_LENGTH: RangeInclusive<u8> = 2..=3;

    /// Whether the series has no orders.
    pub(super) fn is_none(&self) -> bool {
        self.of_orders.is_empty()
    }

    /// Mutable amplitude. A missing order is inserted with the amplitude zero.
    pub fn amplitude_mut(&mut self, order: u8, phase: Phase) -> &mut f64 {
        let found = self.of_orders.binary_search_by_key(&order, |(order, _)| *order);
        let index = found.unwrap_or_else(|index| {
            self.of_orders.insert(index, (order, [0.0; 2]));
            index
        });
        &mut self.of_orders[index].1[phase as usize]
    }

    /// Value of the series at an angle, and its derivative with respect to the angle.
    #[inline]
    pub fn at(&self, angle: Turn) -> (f64, f64) {
        // The multiple of the angle for the previous order. For consecutive orders, the next multiple needs only
        // one addition of angles.
        let mut previous: Option<(u8, Turn)> = None;
        let (mut sum, mut slope) = (0.0, 0.0);
        for &(order, [a, c]) in self.of_orders.iter().filter(|(_, amplitudes)| *amplitudes != [0.0; 2]) {
            let one_less = previous.filter(|(previous_order, _)| previous_order + 1 == order);
            let wave = one_less.map_or_else(|| angle.times(order), |(_, multiple)| multiple.and(angle));
            previous = Some((order, wave));
            sum += a * wave.sin + c * wave.cos;
            slope += f64::from(order) * (a * wave.cos - c * wave.sin);
        }
        (sum, slope)
    }
}
