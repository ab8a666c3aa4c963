//! Encoder offsets and configuration of the bar, by comparing measured with predicted angles.

use std::f64::consts::TAU;

use super::{PredictedBar, PrepareError};
use crate::kinematics::{BAR_JOINTS, Configuration};

/// Measured and predicted angles of one instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AnglePair {
    /// Encoder angles, zeros unknown \[rad\].
    pub measured_rad: [f64; BAR_JOINTS],
    /// From the robot's log.
    pub predicted: PredictedBar,
}

/// What is added to an encoder's angle to get the joint's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EncoderOffset {
    /// Bar joint, 1 to 5.
    pub joint: u8,
    /// Offset in (-pi, pi] \[rad\].
    pub offset_rad: f64,
    /// 1.48 times the median deviation from it \[rad\]: a standard deviation that outliers do not touch.
    pub spread_rad: f64,
}

/// Offsets of all encoders in one configuration.
#[derive(Debug, Clone, PartialEq)]
pub struct Offsets {
    /// The configuration that fits best. Without encoder on joint 2 (or 4) both signs of it fit; the positive is named.
    pub configuration: Configuration,
    /// By joint.
    pub encoders: Vec<EncoderOffset>,
}

impl Offsets {
    fn spread_rad(&self) -> f64 {
        self.encoders.iter().map(|encoder| encoder.spread_rad).sum()
    }

    /// Offset by joint, 0 for joints without encoder.
    pub fn by_joint_rad(&self) -> [f64; BAR_JOINTS] {
        let mut offsets = [0.0; BAR_JOINTS];
        for encoder in &self.encoders {
            offsets[usize::from(encoder.joint) - 1] = encoder.offset_rad;
        }
        offsets
    }
}

/// Circular median of the differences per encoder, in the configuration where they scatter least.
///
/// # Errors
/// [`PrepareError::NoConfiguration`] where an encoder scatters by more than `spread_max_mrad` in the best one.
pub fn find_offsets(
    pairs: &[AnglePair],
    measured: &[bool; BAR_JOINTS],
    spread_max_mrad: f64,
) -> Result<Offsets, PrepareError> {
    let mut best = offsets_in(Configuration::ALL[0], pairs, measured);
    for configuration in Configuration::ALL {
        let offsets = offsets_in(configuration, pairs, measured);
        if offsets.spread_rad() < 0.99 * best.spread_rad() {
            best = offsets;
        }
    }
    if best.encoders.iter().all(|encoder| encoder.spread_rad * 1e3 <= spread_max_mrad) {
        return Ok(best);
    }
    let spreads: Vec<String> = best
        .encoders
        .iter()
        .map(|encoder| format!("{:.0} (joint {})", encoder.spread_rad * 1e3, encoder.joint))
        .collect();
    Err(PrepareError::NoConfiguration {
        configuration: best.configuration.to_string(),
        spreads: spreads.join(", "),
        limit_mrad: spread_max_mrad,
        hint: likely_cause(&best, pairs, spread_max_mrad),
    })
}

fn offsets_in(configuration: Configuration, pairs: &[AnglePair], measured: &[bool; BAR_JOINTS]) -> Offsets {
    let encoders = (0..BAR_JOINTS)
        .filter(|&joint| measured[joint])
        .map(|joint| {
            let differences = pairs.iter().map(|pair| {
                configuration.carry(&pair.predicted.joints_rad)[joint] - pair.measured_rad[joint]
            });
            let (offset_rad, spread_rad) = circular_median(differences.collect());
            EncoderOffset { joint: joint as u8 + 1, offset_rad, spread_rad }
        })
        .collect();
    Offsets { configuration, encoders }
}

/// Median on the circle, about the mean direction, and 1.48 times the median deviation from it.
fn circular_median(angles_rad: Vec<f64>) -> (f64, f64) {
    let (sin, cos) = angles_rad.iter().fold((0.0, 0.0), |(s, c), angle| (s + angle.sin(), c + angle.cos()));
    let mean = sin.atan2(cos);
    let mut deviations: Vec<f64> = angles_rad.iter().map(|angle| wrapped(angle - mean)).collect();
    let middle = median(&mut deviations);
    for deviation in &mut deviations {
        *deviation = (*deviation - middle).abs();
    }
    (wrapped(mean + middle), 1.4826 * median(&mut deviations))
}

fn median(values: &mut [f64]) -> f64 {
    let middle = values.len() / 2;
    if values.is_empty() {
        return f64::INFINITY;
    }
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

pub(super) fn wrapped(angle_rad: f64) -> f64 {
    angle_rad - (angle_rad / TAU).round() * TAU
}

/// Tries the usual mistakes on the encoders that do not fit.
fn likely_cause(best: &Offsets, pairs: &[AnglePair], spread_max_mrad: f64) -> String {
    let fits = |differences: Vec<f64>| circular_median(differences).1 * 1e3 <= spread_max_mrad;
    let predicted =
        |pair: &AnglePair, joint: usize| best.configuration.carry(&pair.predicted.joints_rad)[joint];
    let mut hints = Vec::new();
    for encoder in best.encoders.iter().filter(|encoder| encoder.spread_rad * 1e3 > spread_max_mrad) {
        let joint = usize::from(encoder.joint) - 1;
        if fits(pairs.iter().map(|pair| predicted(pair, joint) + pair.measured_rad[joint]).collect()) {
            hints.push(format!(
                "The encoder of joint {} counts the other way: change its direction in the bar's configuration.",
                encoder.joint
            ));
            continue;
        }
        for other in (0..BAR_JOINTS).filter(|&other| other != joint) {
            if fits(pairs.iter().map(|pair| predicted(pair, other) - pair.measured_rad[joint]).collect()) {
                hints.push(format!(
                    "The encoder assigned to joint {} moves like joint {}: check the order of the terminals.",
                    encoder.joint,
                    other + 1
                ));
            }
        }
    }
    if hints.is_empty() {
        "The robot's or the bar's configuration is not that of this cell, or robot log and recording are of \
         different runs."
            .into()
    } else {
        hints.join(" ")
    }
}
