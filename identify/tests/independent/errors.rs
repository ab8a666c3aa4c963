//! Deviations of a healthy robot and a healthy bar from their parameters.

use std::f64::consts::TAU;

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::Sizes;
use super::robots::{Gear, Robot};

/// A sum of sines, as a function of one angle.
#[derive(Debug, Clone, Default)]
pub struct Waves(Vec<Wave>);

#[derive(Debug, Clone, Copy)]
struct Wave {
    per_turn: f64,
    amplitude: f64,
    phase_rad: f64,
}

impl Waves {
    fn add(&mut self, per_turn: f64, amplitude_millionths: f64, random: &mut ChaCha8Rng) {
        let phase_rad = random.random_range(0.0..TAU);
        self.0.push(Wave { per_turn, amplitude: amplitude_millionths * 1e-6, phase_rad });
    }

    /// Value of the sum at an angle \[rad\].
    pub fn at(&self, angle_rad: f64) -> f64 {
        self.0.iter().map(|w| w.amplitude * (w.per_turn * angle_rad + w.phase_rad).sin()).sum()
    }

    /// Errors of an encoder whose disc has an eccentricity \[rad\].
    pub fn of_encoder(sizes: &Sizes, random: &mut ChaCha8Rng) -> Self {
        let mut waves = Self::default();
        waves.add(1.0, sizes.encoder_once_urad, random);
        waves.add(2.0, sizes.encoder_twice_urad, random);
        waves
    }

    /// Deviation of the bar length \[m\] as a function of one of its joints, caused by an oval bearing.
    pub fn of_bar(sizes: &Sizes, random: &mut ChaCha8Rng) -> Self {
        let mut waves = Self::default();
        waves.add(2.0, sizes.bar_runout_um, random);
        waves
    }

    /// Errors of a robot axis: orders one and two per turn, and the orders of its gear \[rad\].
    pub fn of_axis(robot: &Robot, axis: usize, sizes: &Sizes, random: &mut ChaCha8Rng) -> Self {
        let repeats = match robot.gears[axis] {
            Gear::Cycloid => f64::from(random.random_range(sizes.lobes.0..=sizes.lobes.1)),
            Gear::StrainWave => 2.0 * robot.gear_ratio[axis],
            Gear::Wheels => robot.gear_ratio[axis],
        };
        let (least, most) = sizes.gear_urad;
        let mut waves = Self::default();
        for per_turn in [1.0, 2.0, repeats] {
            let amplitude_urad = random.random_range(least..=most);
            waves.add(per_turn, amplitude_urad, random);
        }
        waves
    }
}

/// Play of a gear. After a reversal, the joint follows its motor only after the motor has passed the whole play.
#[derive(Debug, Clone, Copy)]
pub struct Play {
    half_rad: f64,
    /// Position of the joint within the play, from -1 to 1.
    place: f64,
    last_rad: Option<f64>,
}

impl Play {
    pub fn new(width_urad: f64) -> Self {
        Self { half_rad: width_urad * 0.5e-6, place: 0.0, last_rad: None }
    }

    /// Moves the joint to `joint_rad` \[rad\]. Returns the angle by which the motor is then ahead of the joint \[rad\].
    pub fn ahead_rad(&mut self, joint_rad: f64) -> f64 {
        if self.half_rad > 0.0 {
            let moved = joint_rad - self.last_rad.unwrap_or(joint_rad);
            self.place = (self.place + moved / self.half_rad).clamp(-1.0, 1.0);
            self.last_rad = Some(joint_rad);
        }
        self.half_rad * self.place
    }
}
