//! What spoils real measurements and is in no estimator's geometry. Each effect is one key and one function.

use std::f64::consts::TAU;

use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use super::SimulateError;

/// Sizes of the effects \[urad\]; zero is none.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Effects {
    /// White noise of each robot joint, standard deviation.
    pub robot_noise_urad: f64,
    /// White noise of each bar encoder, standard deviation.
    pub encoder_noise_urad: f64,
    /// Sine of twice the joint angle on each robot joint, amplitude: an eccentric output gear (thesis 2.3).
    pub gear_sine_urad: f64,
    /// Sine of the joint angle on each bar encoder, amplitude: an eccentric grating.
    pub encoder_eccentricity_urad: f64,
    /// How far the bar's base leans, about x and by 0.6 of it about -y.
    pub base_tilt_urad: f64,
}

/// Turns of the gear error in one turn of the joint.
const GEAR_PERIODS: f64 = 2.0;

impl Effects {
    /// All sizes with their keys.
    fn sizes(&self) -> [(&'static str, f64); 5] {
        [
            ("robot_noise_urad", self.robot_noise_urad),
            ("encoder_noise_urad", self.encoder_noise_urad),
            ("gear_sine_urad", self.gear_sine_urad),
            ("encoder_eccentricity_urad", self.encoder_eccentricity_urad),
            ("base_tilt_urad", self.base_tilt_urad),
        ]
    }

    pub(super) fn check(&self) -> Result<(), SimulateError> {
        match self.sizes().into_iter().find(|(_, size)| !(size.is_finite() && *size >= 0.0)) {
            Some((name, value_urad)) => Err(SimulateError::Effect { name, value_urad }),
            None => Ok(()),
        }
    }

    /// Rotation of the base about x and y \[rad\].
    pub(super) fn base_tilt_rad(&self) -> [f64; 2] {
        [self.base_tilt_urad * 1e-6, -0.6 * self.base_tilt_urad * 1e-6]
    }
}

/// One kind of angle reading with its own phases and noise.
pub(super) struct Reading<const N: usize> {
    sine_rad: f64,
    periods: f64,
    phases_rad: [f64; N],
    noise_rad: f64,
    random: ChaCha8Rng,
}

impl Reading<6> {
    pub fn of_robot(effects: &Effects, random: ChaCha8Rng) -> Self {
        Self::new(effects.gear_sine_urad, GEAR_PERIODS, effects.robot_noise_urad, random)
    }
}

impl Reading<5> {
    pub fn of_bar(effects: &Effects, random: ChaCha8Rng) -> Self {
        Self::new(effects.encoder_eccentricity_urad, 1.0, effects.encoder_noise_urad, random)
    }
}

impl<const N: usize> Reading<N> {
    fn new(sine_urad: f64, periods: f64, noise_urad: f64, mut random: ChaCha8Rng) -> Self {
        let phases_rad = std::array::from_fn(|_| random.random_range(0.0..TAU));
        Self { sine_rad: sine_urad * 1e-6, periods, phases_rad, noise_rad: noise_urad * 1e-6, random }
    }

    /// What is read where the joints are at `true_rad`.
    pub fn of(&mut self, true_rad: &[f64; N]) -> [f64; N] {
        std::array::from_fn(|i| {
            let sine = (self.periods * true_rad[i] + self.phases_rad[i]).sin();
            let noise: f64 = StandardNormal.sample(&mut self.random);
            true_rad[i] + self.sine_rad * sine + self.noise_rad * noise
        })
    }
}
