//! Errors of real measurements beyond the geometry. Each effect is one key and one function.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use nalgebra::{DMatrix, RowDVector};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};
use shared::config::RobotConfig;

use super::{SimulateError, is_size};
use crate::kinematics::Joints;

/// Sizes of the effects \[urad\]; zero is none.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Effects {
    /// White noise of each robot joint, standard deviation.
    pub robot_noise_urad: f64,
    /// White noise of each bar encoder, standard deviation.
    pub encoder_noise_urad: f64,
    /// Sine of twice the angle of each robot gear's output, amplitude: an eccentric output gear (thesis 2.3).
    pub gear_sine_urad: f64,
    /// Ripple of each cycloid gear at its number of lobes, amplitude, and a fourth of it at twice that: no pure sine, as
    /// in Yang and Blanche 1990. Robot axes whose number of lobes is not configured have none.
    pub cycloid_urad: f64,
    /// Half of the play between each robot motor and its joint.
    pub backlash_urad: f64,
    /// Sine of the joint angle on each bar encoder, amplitude: an eccentric grating.
    pub encoder_eccentricity_urad: f64,
    /// Sine of twice the joint angle on each bar encoder, amplitude: an elliptic one.
    pub encoder_ellipticity_urad: f64,
    /// Smallest difference of two angles that a bar encoder shows, which gives the middle of each step: the thesis (3.1) cuts off
    /// what is less, but what all angles are off by is the encoder's offset.
    pub encoder_step_urad: f64,
    /// How far the bar's base leans, about x and by 0.6 of it about -y.
    pub base_tilt_urad: f64,
}

/// Turns of the gear error in one turn of the gear's output.
pub(super) const GEAR_PERIODS: f64 = 2.0;
/// Place of a cycloid's first wave among the waves of a gear; a calibration names it by the lobes, not by their number.
const CYCLOID: usize = 1;
/// Second wave of a cycloid's ripple, part of the first.
const CYCLOID_SECOND: f64 = 0.25;

impl Effects {
    /// Without any effects.
    pub const NONE: Self = Self {
        robot_noise_urad: 0.0,
        encoder_noise_urad: 0.0,
        gear_sine_urad: 0.0,
        cycloid_urad: 0.0,
        backlash_urad: 0.0,
        encoder_eccentricity_urad: 0.0,
        encoder_ellipticity_urad: 0.0,
        encoder_step_urad: 0.0,
        base_tilt_urad: 0.0,
    };

    /// As in a laboratory with a robot in good repair: gears by the thesis (2.3), encoders of 18 arc-sec behind couplings,
    /// a base set up by eye.
    pub const LABORATORY: Self = Self {
        robot_noise_urad: 15.0,
        encoder_noise_urad: 5.0,
        gear_sine_urad: 30.0,
        cycloid_urad: 20.0,
        encoder_eccentricity_urad: 40.0,
        encoder_ellipticity_urad: 15.0,
        base_tilt_urad: 5000.0,
        ..Self::NONE
    };

    /// Keys of all sizes.
    pub const KEYS: [&str; 9] = [
        "robot_noise_urad",
        "encoder_noise_urad",
        "gear_sine_urad",
        "cycloid_urad",
        "backlash_urad",
        "encoder_eccentricity_urad",
        "encoder_ellipticity_urad",
        "encoder_step_urad",
        "base_tilt_urad",
    ];

    /// A size by its key.
    pub fn size_mut(&mut self, key: &str) -> Option<&mut f64> {
        Some(match key {
            "robot_noise_urad" => &mut self.robot_noise_urad,
            "encoder_noise_urad" => &mut self.encoder_noise_urad,
            "gear_sine_urad" => &mut self.gear_sine_urad,
            "cycloid_urad" => &mut self.cycloid_urad,
            "backlash_urad" => &mut self.backlash_urad,
            "encoder_eccentricity_urad" => &mut self.encoder_eccentricity_urad,
            "encoder_ellipticity_urad" => &mut self.encoder_ellipticity_urad,
            "encoder_step_urad" => &mut self.encoder_step_urad,
            "base_tilt_urad" => &mut self.base_tilt_urad,
            _ => return None,
        })
    }

    pub(super) fn check(&self) -> Result<(), SimulateError> {
        let mut sizes = *self;
        for name in Self::KEYS {
            let size = sizes.size_mut(name).map_or(0.0, |size| *size);
            if !is_size(size) {
                return Err(SimulateError::Effect { name, value_urad: size });
            }
        }
        Ok(())
    }

    /// Rotation of the base about x and y \[rad\].
    pub(super) fn base_tilt_rad(&self) -> [f64; 2] {
        [self.base_tilt_urad * 1e-6, -0.6 * self.base_tilt_urad * 1e-6]
    }
}

/// `amplitude sin(periods angle + phase)`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Wave {
    pub amplitude_rad: f64,
    pub periods: f64,
    pub phase_rad: f64,
}

impl Wave {
    pub fn at(&self, angle_rad: f64) -> f64 {
        self.amplitude_rad * (self.periods * angle_rad + self.phase_rad).sin()
    }

    /// The terms by which a calibration takes the error out of a drive's reading (from 0), named after `order` \[rad\].
    pub fn terms(&self, order: &str, drive: usize) -> [(String, f64); 2] {
        let (sin, cos) = self.phase_rad.sin_cos();
        [("sin", cos), ("cos", sin)]
            .map(|(phase, part)| (format!("r{phase}{order}_{}", drive + 1), -self.amplitude_rad * part))
    }
}

/// Waves of one kind on each joint, with phases of their own.
fn waves(amplitude_urad: f64, periods: &[f64], random: &mut ChaCha8Rng) -> Vec<Wave> {
    let wave = |&periods: &f64| Wave {
        amplitude_rad: if periods > 0.0 { amplitude_urad * 1e-6 } else { 0.0 },
        periods,
        phase_rad: random.random_range(0.0..TAU),
    };
    periods.iter().map(wave).collect()
}

/// One kind of angle reading with its own phases and noise.
struct Noisy {
    /// Kinds of waves, each with one for every angle.
    waves: Vec<Vec<Wave>>,
    noise_rad: f64,
    random: ChaCha8Rng,
}

impl Noisy {
    /// Errors and noise of the angles.
    fn off_rad(&mut self, angles_rad: &[f64]) -> Vec<(f64, f64)> {
        let error = |(i, rad): (usize, &f64)| self.waves.iter().map(|wave| wave[i].at(*rad)).sum::<f64>();
        let errors: Vec<f64> = angles_rad.iter().enumerate().map(error).collect();
        let noise = |error| {
            let noise: f64 = StandardNormal.sample(&mut self.random);
            (error, self.noise_rad * noise)
        };
        errors.into_iter().map(noise).collect()
    }
}

/// Readings of the bar's encoders.
pub(super) struct BarReading {
    noisy: Noisy,
    step_rad: f64,
}

impl BarReading {
    /// `random` makes what the encoders are like and, unless another generator does, their noise.
    pub fn new(effects: &Effects, mut random: ChaCha8Rng, noise: Option<ChaCha8Rng>) -> Self {
        let waves = vec![
            waves(effects.encoder_eccentricity_urad, &[1.0; 5], &mut random),
            waves(effects.encoder_ellipticity_urad, &[2.0; 5], &mut random),
        ];
        let random = noise.unwrap_or(random);
        let noisy = Noisy { waves, noise_rad: effects.encoder_noise_urad * 1e-6, random };
        Self { noisy, step_rad: effects.encoder_step_urad * 1e-6 }
    }

    /// Where the joints are at `true_rad`.
    pub fn of(&mut self, true_rad: &[f64; 5]) -> [f64; 5] {
        let off = self.noisy.off_rad(true_rad);
        let step = |rad: f64| {
            if self.step_rad > 0.0 { ((rad / self.step_rad).floor() + 0.5) * self.step_rad } else { rad }
        };
        std::array::from_fn(|i| step(true_rad[i] + off[i].0 + off[i].1))
    }
}

/// Readings of the robot's log. Gears err at the angle of their output, which rods and bevel gears pass on to joints.
pub(super) struct RobotReading {
    noisy: Noisy,
    joints_from_gears: DMatrix<f64>,
    gears_from_joints: DMatrix<f64>,
    play_rad: f64,
    /// Where each motor is, as an angle of its gear's output; none before the first reading.
    motors_rad: Option<Vec<f64>>,
}

impl RobotReading {
    /// `random` makes what the gears are like and, unless another generator does, the noise.
    pub fn new(
        robot: &RobotConfig,
        effects: &Effects,
        mut random: ChaCha8Rng,
        noise: Option<ChaCha8Rng>,
    ) -> Self {
        let (table, axes) = (&robot.log.raw_to_joint, robot.axes());
        // A gear's output turns with its own entry of the table; the rest of the row is what it takes along.
        let joints_from_gears = DMatrix::from_fn(axes, axes, |i, j| table[i][j] / table[i][i]);
        let inverse = joints_from_gears.clone().try_inverse();
        let usable = inverse.filter(|inverse| inverse.iter().all(|x| x.is_finite()));
        let identity = || (DMatrix::identity(axes, axes), DMatrix::identity(axes, axes));
        let (joints_from_gears, gears_from_joints) =
            usable.map_or_else(identity, |inverse| (joints_from_gears, inverse));
        let lobes = |waves: f64| -> Vec<f64> {
            let lobes = (0..axes).map(|axis| robot.drives.cycloid_lobes.get(axis).copied().unwrap_or(0.0));
            lobes.map(|lobes| waves * lobes).collect()
        };
        let waves = vec![
            waves(effects.gear_sine_urad, &vec![GEAR_PERIODS; axes], &mut random),
            waves(effects.cycloid_urad, &lobes(1.0), &mut random),
            waves(CYCLOID_SECOND * effects.cycloid_urad, &lobes(2.0), &mut random),
        ];
        let random = noise.unwrap_or(random);
        let noisy = Noisy { waves, noise_rad: effects.robot_noise_urad * 1e-6, random };
        let play_rad = effects.backlash_urad * 1e-6;
        Self { noisy, joints_from_gears, gears_from_joints, play_rad, motors_rad: None }
    }

    /// Errors of the gears as the terms of a calibration by their names \[rad\].
    pub fn terms(&self) -> BTreeMap<String, f64> {
        let mut terms = BTreeMap::new();
        for (kind, waves) in self.noisy.waves.iter().enumerate() {
            for (drive, wave) in waves.iter().enumerate().filter(|(_, wave)| wave.amplitude_rad > 0.0) {
                let order = if kind == CYCLOID { "c".to_owned() } else { wave.periods.to_string() };
                terms.extend(wave.terms(&order, drive));
            }
        }
        terms
    }

    /// Where the joints are at `true_rad`, after they were where it was asked before.
    pub fn of(&mut self, true_rad: &Joints) -> Joints {
        let gears = RowDVector::from_row_slice(true_rad) * &self.gears_from_joints;
        let gears = gears.as_slice();
        let play = |(before, gear): (&f64, &f64)| before.clamp(gear - self.play_rad, gear + self.play_rad);
        let before = self.motors_rad.as_deref().unwrap_or(gears);
        let motors: Vec<f64> = before.iter().zip(gears).map(play).collect();
        let of_gears = self.noisy.off_rad(gears);
        let off = RowDVector::from_fn(gears.len(), |_, i| motors[i] - gears[i] + of_gears[i].0);
        let off = off * &self.joints_from_gears;
        self.motors_rad = Some(motors);
        Joints::from_fn(true_rad.len(), |i| true_rad[i] + off[i] + of_gears[i].1)
    }
}
