//! Converts true angles to the readings of the robot's log and the bar's encoders. Adds errors of real measurements that
//! are not errors of the geometry: harmonics of gears and gratings, backlash, resolution and noise. Each of these
//! effects has a key.

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

/// Access to the size of an effect.
type Size = fn(&mut Effects) -> &mut f64;

/// Sizes of the effects \[urad\]; zero disables an effect.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Effects {
    /// Standard deviation of the white noise of each robot joint.
    pub robot_noise_urad: f64,
    /// Standard deviation of the white noise of each bar encoder.
    pub encoder_noise_urad: f64,
    /// Amplitude of the error with two periods per turn of each robot gear's output, as of an eccentric
    /// output gear (thesis 2.3).
    pub gear_sine_urad: f64,
    /// Amplitude of the error of each cycloid gear at its number of lobes. A second harmonic has a quarter of this
    /// amplitude, as in Yang and Blanche 1990. Robot axes without a configured number of lobes have no such error.
    pub cycloid_urad: f64,
    /// Half of the backlash between each robot motor and its joint.
    pub backlash_urad: f64,
    /// Amplitude of the error with one period per turn of each bar encoder, as of an eccentric grating.
    pub encoder_eccentricity_urad: f64,
    /// Amplitude of the error with two periods per turn of each bar encoder, as of an elliptic grating.
    pub encoder_ellipticity_urad: f64,
    /// Resolution of a bar encoder. A reading is the middle of the step that contains the angle. The thesis (3.1) truncates
    /// instead, but this shifts all angles equally, so the difference is part of the encoder's offset.
    pub encoder_step_urad: f64,
    /// Tilt of the bar's base about x. The tilt about y is -0.6 times this value.
    pub base_tilt_urad: f64,
}

/// Number of periods of the gear error per turn of the gear's output.
pub(super) const GEAR_PERIODS: f64 = 2.0;
/// Index of the first harmonic of a cycloid gear in [`ReadingErrors::harmonics`]. In a calibration, the name of this term
/// contains `c`; the names of other terms contain their number of periods.
const CYCLOID: usize = 1;
/// Amplitude of the second harmonic of a cycloid gear, relative to the first.
const CYCLOID_SECOND: f64 = 0.25;

impl Effects {
    /// All effects disabled.
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

    /// A laboratory with a robot in good condition. It has gears as in the thesis (2.3), encoders of 18 arc-sec behind
    /// couplings, and a base aligned by eye.
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

    /// Key and size of each effect.
    const SIZES: [(&str, Size); 9] = [
        ("robot_noise_urad", |effects| &mut effects.robot_noise_urad),
        ("encoder_noise_urad", |effects| &mut effects.encoder_noise_urad),
        ("gear_sine_urad", |effects| &mut effects.gear_sine_urad),
        ("cycloid_urad", |effects| &mut effects.cycloid_urad),
        ("backlash_urad", |effects| &mut effects.backlash_urad),
        ("encoder_eccentricity_urad", |effects| &mut effects.encoder_eccentricity_urad),
        ("encoder_ellipticity_urad", |effects| &mut effects.encoder_ellipticity_urad),
        ("encoder_step_urad", |effects| &mut effects.encoder_step_urad),
        ("base_tilt_urad", |effects| &mut effects.base_tilt_urad),
    ];

    /// Keys of all effects.
    pub fn keys() -> [&'static str; Self::SIZES.len()] {
        Self::SIZES.map(|(key, _)| key)
    }

    /// Mutable access to the size of an effect by its key; `None` for an unknown key.
    pub fn size_mut(&mut self, key: &str) -> Option<&mut f64> {
        let (_, size) = Self::SIZES.into_iter().find(|(name, _)| *name == key)?;
        Some(size(self))
    }

    pub(super) fn check(&self) -> Result<(), SimulateError> {
        let mut effects = *self;
        for (name, size) in Self::SIZES {
            let value_urad = *size(&mut effects);
            if !is_size(value_urad) {
                return Err(SimulateError::Effect { name, value_urad });
            }
        }
        Ok(())
    }

    /// Tilt of the bar's base about x and y \[rad\].
    pub(super) fn base_tilt_rad(&self) -> [f64; 2] {
        [self.base_tilt_urad * 1e-6, -0.6 * self.base_tilt_urad * 1e-6]
    }
}

/// A harmonic of an angle: `amplitude sin(periods angle + phase)`.
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

    /// Names and values of calibration parameters that cancel this error in the reading of a drive. The values are the
    /// coefficients of `sin(periods q)` and `cos(periods q)` in `-amplitude sin(periods q + phase)` \[rad\]. The names
    /// contain `order` and the number of the drive, counted from 1; the argument `drive` counts from 0.
    pub fn terms(&self, order: &str, drive: usize) -> [(String, f64); 2] {
        let (sin, cos) = self.phase_rad.sin_cos();
        [("sin", cos), ("cos", sin)]
            .map(|(phase, part)| (format!("r{phase}{order}_{}", drive + 1), -self.amplitude_rad * part))
    }
}

/// One harmonic for each angle, with a random phase. `periods` contains the number of periods per turn for each angle; if it
/// is zero, the amplitude of this angle is zero.
fn harmonics(amplitude_urad: f64, periods: &[f64], random: &mut ChaCha8Rng) -> Vec<Wave> {
    let wave = |&periods: &f64| Wave {
        amplitude_rad: if periods > 0.0 { amplitude_urad * 1e-6 } else { 0.0 },
        periods,
        phase_rad: random.random_range(0.0..TAU),
    };
    periods.iter().map(wave).collect()
}

/// Errors of the readings of several angles: harmonics and white noise.
struct ReadingErrors {
    /// Lists of harmonics, each list with one harmonic for every angle.
    harmonics: Vec<Vec<Wave>>,
    noise_rad: f64,
    random: ChaCha8Rng,
}

impl ReadingErrors {
    /// The sum of the harmonics and the noise, separately, for each angle \[rad\].
    fn errors_and_noise_rad(&mut self, angles_rad: &[f64]) -> Vec<(f64, f64)> {
        let error =
            |(i, rad): (usize, &f64)| self.harmonics.iter().map(|order| order[i].at(*rad)).sum::<f64>();
        let errors: Vec<f64> = angles_rad.iter().enumerate().map(error).collect();
        let noise = |error| {
            let noise: f64 = StandardNormal.sample(&mut self.random);
            (error, self.noise_rad * noise)
        };
        errors.into_iter().map(noise).collect()
    }
}

/// Readings of the bar's encoders.
pub(super) struct BarEncoders {
    angle_errors: ReadingErrors,
    step_rad: f64,
}

impl BarEncoders {
    /// `random` generates the phases of the encoders' harmonics. `noise` generates the noise; if it
    /// is `None`, `random` does.
    pub fn new(effects: &Effects, mut random: ChaCha8Rng, noise: Option<ChaCha8Rng>) -> Self {
        let harmonics = vec![
            harmonics(effects.encoder_eccentricity_urad, &[1.0; 5], &mut random),
            harmonics(effects.encoder_ellipticity_urad, &[2.0; 5], &mut random),
        ];
        let random = noise.unwrap_or(random);
        let angle_errors = ReadingErrors { harmonics, noise_rad: effects.encoder_noise_urad * 1e-6, random };
        Self { angle_errors, step_rad: effects.encoder_step_urad * 1e-6 }
    }

    /// Readings of the encoders at the true joints `true_rad` \[rad\].
    pub fn read(&mut self, true_rad: &[f64; 5]) -> [f64; 5] {
        let errors = self.angle_errors.errors_and_noise_rad(true_rad);
        let quantised = |rad: f64| {
            if self.step_rad > 0.0 { ((rad / self.step_rad).floor() + 0.5) * self.step_rad } else { rad }
        };
        std::array::from_fn(|i| {
            let (error, noise) = errors[i];
            quantised(true_rad[i] + error + noise)
        })
    }
}

/// Readings of the robot's log. Errors of a gear depend on the angle of the gear's output. In coupled arms, rods and bevel
/// gears transmit the error of one gear to several joints.
pub(super) struct RobotReading {
    angle_errors: ReadingErrors,
    /// Conversion from gear angles to joint angles; angles are row vectors: `joints = gears * joints_from_gears`.
    joints_from_gears: DMatrix<f64>,
    gears_from_joints: DMatrix<f64>,
    /// Half of the backlash \[rad\].
    play_rad: f64,
    /// Angle of each motor, divided by its gear ratio \[rad\]; `None` before the first reading.
    motors_rad: Option<Vec<f64>>,
}

impl RobotReading {
    /// `random` generates the phases of the gears' harmonics. `noise` generates the noise; if it is `None`, `random` does.
    pub fn new(
        robot: &RobotConfig,
        effects: &Effects,
        mut random: ChaCha8Rng,
        noise: Option<ChaCha8Rng>,
    ) -> Self {
        let (table, axes) = (&robot.log.raw_to_joint, robot.axes());
        // The table `raw_to_joint` converts motor angles to joints. If each row is divided by its diagonal entry, the table
        // converts gear angles to joints. The diagonal entries are then one, because each gear turns its own joint by the
        // gear's angle. The other entries are coupled joints.
        let joints_from_gears = DMatrix::from_fn(axes, axes, |i, j| table[i][j] / table[i][i]);
        let inverse = joints_from_gears.clone().try_inverse();
        let usable = inverse.filter(|inverse| inverse.iter().all(|x| x.is_finite()));
        let identity = || (DMatrix::identity(axes, axes), DMatrix::identity(axes, axes));
        let (joints_from_gears, gears_from_joints) =
            usable.map_or_else(identity, |inverse| (joints_from_gears, inverse));
        let cycloid_orders = |harmonic: f64| -> Vec<f64> {
            let lobes = (0..axes).map(|axis| robot.drives.cycloid_lobes.get(axis).copied().unwrap_or(0.0));
            lobes.map(|lobes| harmonic * lobes).collect()
        };
        let harmonics = vec![
            harmonics(effects.gear_sine_urad, &vec![GEAR_PERIODS; axes], &mut random),
            harmonics(effects.cycloid_urad, &cycloid_orders(1.0), &mut random),
            harmonics(CYCLOID_SECOND * effects.cycloid_urad, &cycloid_orders(2.0), &mut random),
        ];
        let random = noise.unwrap_or(random);
        let angle_errors = ReadingErrors { harmonics, noise_rad: effects.robot_noise_urad * 1e-6, random };
        let play_rad = effects.backlash_urad * 1e-6;
        Self { angle_errors, joints_from_gears, gears_from_joints, play_rad, motors_rad: None }
    }

    /// Names and values of calibration parameters that cancel the errors of the gears \[rad\].
    pub fn terms(&self) -> BTreeMap<String, f64> {
        let mut terms = BTreeMap::new();
        for (kind, harmonics) in self.angle_errors.harmonics.iter().enumerate() {
            for (drive, wave) in harmonics.iter().enumerate().filter(|(_, wave)| wave.amplitude_rad > 0.0) {
                let order = if kind == CYCLOID { "c".to_owned() } else { wave.periods.to_string() };
                terms.extend(wave.terms(&order, drive));
            }
        }
        terms
    }

    /// Readings of the joints at the true joints `true_rad` \[rad\]. Because of backlash, the readings also depend
    /// on the previous call.
    pub fn read(&mut self, true_rad: &Joints) -> Joints {
        let gears = RowDVector::from_row_slice(true_rad) * &self.gears_from_joints;
        let gears = gears.as_slice();
        // A motor moves only when the gear reaches an end of the backlash.
        let moved = |(before, gear): (&f64, &f64)| before.clamp(gear - self.play_rad, gear + self.play_rad);
        let before = self.motors_rad.as_deref().unwrap_or(gears);
        let motors: Vec<f64> = before.iter().zip(gears).map(moved).collect();
        let errors = self.angle_errors.errors_and_noise_rad(gears);
        let gear_errors = RowDVector::from_fn(gears.len(), |_, i| motors[i] - gears[i] + errors[i].0);
        let joint_errors = gear_errors * &self.joints_from_gears;
        self.motors_rad = Some(motors);
        Joints::from_fn(true_rad.len(), |i| {
            let (_, noise) = errors[i];
            true_rad[i] + joint_errors[i] + noise
        })
    }
}
