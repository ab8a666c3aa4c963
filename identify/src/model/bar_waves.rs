//! How the bar's length follows its direction: the shape of its first two bearings.
//!
//! A bearing that is oval or has three lobes moves the bar's end out and in two or three times per turn. Once per turn is
//! an axis beside its place, which the bar's base and the encoders' harmonics already say; more lobes are flattened by
//! the bearing's balls. The length is `L + sum_n a_n sin(n b) + c_n cos(n b)` over the readings `b` of both joints.

use super::Phase;
use crate::kinematics::{BAR_JOINTS, Turn};

const ORDERS: usize = (BarWaves::LAST - BarWaves::FIRST + 1) as usize;

/// Amplitudes \[m\]. Phases count from the recording's own zero of each encoder.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct BarWaves {
    /// Of each joint, sine and cosine by order.
    amplitudes_m: [[[f64; 2]; ORDERS]; BarWaves::JOINTS],
}

impl BarWaves {
    /// The joints before the rod: those that give it its direction.
    pub const JOINTS: usize = 2;
    /// Least waves per turn.
    pub const FIRST: u8 = 2;
    /// Most.
    pub const LAST: u8 = 3;

    /// One amplitude; none for a joint or an order that is not there.
    pub fn amplitude_mut(&mut self, joint: usize, order: u8, phase: Phase) -> Option<&mut f64> {
        let index = usize::from(order.checked_sub(Self::FIRST)?);
        self.amplitudes_m.get_mut(joint)?.get_mut(index)?.get_mut(phase as usize)
    }

    /// A wave of amplitude one at a reading.
    #[inline]
    pub fn wave(order: u8, phase: Phase, reading: Turn) -> f64 {
        let turned = reading.times(order);
        match phase {
            Phase::Sine => turned.sin,
            Phase::Cosine => turned.cos,
        }
    }

    /// How much longer the bar is at these readings \[m\].
    #[inline]
    pub fn extension_m(&self, readings: &[Turn; BAR_JOINTS]) -> f64 {
        let of_joint = |(orders, reading): (&[[f64; 2]; ORDERS], &Turn)| {
            let waves = (Self::FIRST..=Self::LAST).zip(orders);
            waves
                .map(|(order, [a, c])| {
                    a * Self::wave(order, Phase::Sine, *reading)
                        + c * Self::wave(order, Phase::Cosine, *reading)
                })
                .sum::<f64>()
        };
        self.amplitudes_m.iter().zip(readings).map(of_joint).sum()
    }
}
