//! Errors of the bar's encoders that repeat with each turn.

use std::fmt;

use crate::kinematics::BAR_JOINTS;

/// One wave of an encoder's error over its reading `b`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
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

    /// The wave at a reading \[rad\].
    #[inline]
    pub fn wave(self, reading_rad: f64) -> f64 {
        match self {
            Self::Sine1 => reading_rad.sin(),
            Self::Cosine1 => reading_rad.cos(),
            Self::Sine2 => (2.0 * reading_rad).sin(),
            Self::Cosine2 => (2.0 * reading_rad).cos(),
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

    /// Readings without their harmonics, `b - sum a wave(b)` \[rad\].
    pub fn corrected(&self, readings_rad: &[f64; BAR_JOINTS]) -> [f64; BAR_JOINTS] {
        let mut corrected = *readings_rad;
        for (angle, amplitudes) in corrected.iter_mut().zip(&self.amplitudes_rad) {
            let reading = *angle;
            for (amplitude, harmonic) in amplitudes.iter().zip(Harmonic::ALL) {
                if *amplitude != 0.0 {
                    *angle -= amplitude * harmonic.wave(reading);
                }
            }
        }
        corrected
    }
}
