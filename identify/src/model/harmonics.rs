//! Errors of the bar's encoders that repeat with each turn.

use std::fmt;

use crate::kinematics::{BAR_JOINTS, Turn};

/// One wave of an encoder's error over its reading `b`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Harmonic {
    /// `sin b`: with `cos b` an eccentric grating.
    Sine1,
    /// `cos b`
    Cosine1,
    /// `sin 2b`: with `cos 2b` an elliptic or tilted one.
    Sine2,
    /// `cos 2b`
    Cosine2,
}

impl Harmonic {
    /// All four.
    pub const ALL: [Self; 4] = [Self::Sine1, Self::Cosine1, Self::Sine2, Self::Cosine2];

    /// The wave at a reading.
    #[inline]
    pub fn wave(self, reading: Turn) -> f64 {
        let Turn { sin, cos } = reading;
        match self {
            Self::Sine1 => sin,
            Self::Cosine1 => cos,
            Self::Sine2 => 2.0 * sin * cos,
            Self::Cosine2 => cos * cos - sin * sin,
        }
    }
}

impl fmt::Display for Harmonic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Sine1 => "sin1",
            Self::Cosine1 => "cos1",
            Self::Sine2 => "sin2",
            Self::Cosine2 => "cos2",
        })
    }
}

/// Amplitudes of all encoders \[rad\]. Phases count from the recording's own zero of each encoder.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Harmonics {
    amplitudes_rad: [[f64; Harmonic::ALL.len()]; BAR_JOINTS],
}

impl Harmonics {
    /// One amplitude; none for a joint that is not there.
    pub fn amplitude_mut(&mut self, joint: usize, harmonic: Harmonic) -> Option<&mut f64> {
        self.amplitudes_rad.get_mut(joint)?.get_mut(harmonic as usize)
    }

    /// What all encoders show too much at these readings, `sum a wave(b)` \[rad\].
    pub fn errors_rad(&self, readings: &[Turn; BAR_JOINTS]) -> [f64; BAR_JOINTS] {
        std::array::from_fn(|joint| {
            let waves = self.amplitudes_rad[joint].iter().zip(Harmonic::ALL);
            waves.map(|(amplitude, harmonic)| amplitude * harmonic.wave(readings[joint])).sum()
        })
    }
}
