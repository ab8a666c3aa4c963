//! A robot that pulls and presses on the bar, which gives way (TFRT-6017 section 5.3).

use std::f64::consts::TAU;

use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

/// How hard the robot pulls, and what that does.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BarLoad {
    /// Largest force along the bar \[N\]; the thesis has some 150. Zero: none, and no force in the log.
    pub force_n: f64,
    /// How much longer the bar becomes for each newton of tension \[um/N\]; the thesis computes 0.055 and measures 0.17.
    pub compliance_um_per_n: f64,
    /// How much longer the bar is under tension and shorter under compression, whatever the force: play of its joints \[um\].
    pub play_um: f64,
    /// White noise of the force in the log, standard deviation \[N\].
    pub noise_n: f64,
}

impl BarLoad {
    /// All sizes with their keys.
    pub(super) fn sizes(&self) -> [(&'static str, f64); 4] {
        [
            ("force_n", self.force_n),
            ("compliance_um_per_n", self.compliance_um_per_n),
            ("play_um", self.play_um),
            ("noise_n", self.noise_n),
        ]
    }
}

/// Part of the force that comes and goes with the posture, as errors of the robot's geometry press; the rest comes and
/// goes with time, as following errors do.
const BY_POSTURE: f64 = 0.6;
/// Period of the rest \[s\].
const PERIOD_S: f64 = 7.3;

/// The force on the bar over a path.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pull {
    load: BarLoad,
    phases: [f64; 3],
}

impl Pull {
    pub(super) fn new(load: BarLoad, random: &mut ChaCha8Rng) -> Option<Self> {
        let phases = std::array::from_fn(|_| random.random_range(0.0..TAU));
        (load.force_n > 0.0).then_some(Self { load, phases })
    }

    /// Along the bar, tension positive, of a bar whose joints stand so \[N\].
    pub fn force_n(&self, t_s: f64, joints_rad: &[f64; 5]) -> f64 {
        let [a, b, c] = self.phases;
        let posture = 0.5 * ((2.0 * joints_rad[0] + a).sin() + (3.0 * joints_rad[1] + b).sin());
        let rest = (TAU * t_s / PERIOD_S + c).sin();
        self.load.force_n * (BY_POSTURE * posture + (1.0 - BY_POSTURE) * rest)
    }

    /// How much longer the bar is \[m\].
    pub fn extension_m(&self, t_s: f64, joints_rad: &[f64; 5]) -> f64 {
        let force_n = self.force_n(t_s, joints_rad);
        1e-6 * (self.load.compliance_um_per_n * force_n + self.load.play_um * force_n.signum())
    }
}
