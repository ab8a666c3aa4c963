//! `homing.toml` contains, for each encoder, the count of its reference mark on its terminal. `ballbard home` writes this
//! file into the state directory.
//!
//! A terminal's counter restarts when the terminal loses power, but the mark on the encoder's disc is fixed. Angles are
//! therefore counted from the mark. Homing determines the count of the mark in the current power cycle. The offset that a
//! calibration estimates thus stays valid until the encoder is removed from its joint.
//!
//! At the mark, the terminal latches its counter. If the latch still contains the count in this file, the terminal has had
//! power ever since homing, so the mark is valid. Otherwise the mark is not used, and angles begin at an arbitrary count.
//! The revolution in which the mark was passed does not matter, because angles then differ only by whole turns.

use serde::{Deserialize, Serialize};

use super::ball_bar::BAR_JOINTS;
use super::{EncoderConfig, Validate, Violation};
use crate::encoder::INTERPOLATION_BITS;
use crate::recording::schema::EncoderInfo;
use crate::time::UtcNs;

/// The reference mark of one encoder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HomedEncoder {
    /// Bar joint that the encoder measures, 1 to 5.
    pub joint: u8,
    /// Signal periods per revolution, as configured at the time of homing.
    pub lines: u32,
    /// Interpolation as configured at the time of homing \[bits per signal period\]. The counts are not
    /// valid with any other interpolation.
    pub interpolation_bits: u8,
    /// Count at the reference mark, latched by the terminal.
    pub reference_counts: u32,
}

/// Reference marks of all encoders, in bus order.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HomingConfig {
    /// Time of homing, UTC in RFC 3339. It is information for people; the programs do not use it.
    pub homed: String,
    /// The encoders in bus order.
    pub encoders: Vec<HomedEncoder>,
}

impl HomingConfig {
    /// Name of the file in the state directory.
    pub const FILE_NAME: &'static str = "homing.toml";

    /// Builds the content of the file for a homing at the time `homed`. `reference_counts` are in the order of `encoders`.
    pub fn new(homed: UtcNs, encoders: &[EncoderConfig], reference_counts: &[u32]) -> Self {
        let homed_encoder = |(encoder, counts): (&EncoderConfig, &u32)| HomedEncoder {
            joint: encoder.joint,
            lines: encoder.lines,
            interpolation_bits: encoder.interpolation_bits,
            reference_counts: *counts,
        };
        Self {
            homed: homed.to_string(),
            encoders: encoders.iter().zip(reference_counts).map(homed_encoder).collect(),
        }
    }

    /// Copies the reference marks that are still valid into the encoders of a run. A mark is valid if joint and settings of
    /// the encoder are unchanged, and the terminal's latch still contains the count of the mark. `latches` are the latched
    /// counts now, in bus order. Returns the joints whose marks are no longer valid.
    pub fn apply(&self, encoders: &mut [EncoderInfo], latches: &[u32]) -> Vec<u8> {
        let mut stale = Vec::new();
        for (index, info) in encoders.iter_mut().enumerate() {
            let homed = self.encoders.get(index).filter(|homed| {
                homed.joint == info.joint
                    && homed.lines == info.scale.lines
                    && homed.interpolation_bits == info.scale.interpolation_bits
                    && latches.get(index) == Some(&homed.reference_counts)
            });
            match homed {
                Some(homed) => info.scale.reference_counts = homed.reference_counts,
                None => stale.push(info.joint),
            }
        }
        stale
    }
}

impl Validate for HomingConfig {
    fn validate(&self) -> Result<(), Violation> {
        let again = "run `ballbard home` again, which writes this file, or remove it";
        for (index, encoder) in self.encoders.iter().enumerate() {
            let key = |name: &str| format!("encoders[{index}].{name}");
            if !(1..=BAR_JOINTS as u8).contains(&encoder.joint) {
                return Err(Violation::new(key("joint"), format!("no joint {}", encoder.joint), again));
            }
            if !INTERPOLATION_BITS.contains(&encoder.interpolation_bits) {
                let problem = format!("{} bits per signal period", encoder.interpolation_bits);
                return Err(Violation::new(key("interpolation_bits"), problem, again));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::encoder::EncoderScale;

    fn encoders() -> Vec<EncoderConfig> {
        (1..=3).map(EncoderConfig::ern_1080).collect()
    }

    fn infos() -> Vec<EncoderInfo> {
        encoders().iter().map(|one| EncoderInfo { joint: one.joint, scale: one.scale() }).collect()
    }

    fn marks(of_run: &[EncoderInfo]) -> Vec<u32> {
        of_run.iter().map(|info| info.scale.reference_counts).collect()
    }

    #[test]
    fn marks_are_used_as_long_as_the_terminals_still_show_them() {
        let homing = HomingConfig::new(UtcNs(0), &encoders(), &[11, 22, 33]);
        let mut of_run = infos();
        assert!(homing.apply(&mut of_run, &[11, 22, 33]).is_empty());
        assert_eq!(marks(&of_run), [11, 22, 33]);
    }

    #[test]
    fn after_a_power_cycle_or_with_other_settings_the_mark_is_not_known() {
        let homing = HomingConfig::new(UtcNs(0), &encoders(), &[11, 22, 33]);
        let mut of_run = infos();
        of_run[2].scale = EncoderScale { interpolation_bits: 13, ..of_run[2].scale };
        assert_eq!(homing.apply(&mut of_run, &[11, 0, 33]), [2, 3]);
        assert_eq!(marks(&of_run), [11, 0, 0]);
        assert_eq!(homing.apply(&mut infos(), &[]), [1, 2, 3]);
    }

    #[test]
    fn what_is_written_is_what_is_read() {
        let homing = HomingConfig::new(UtcNs(1_800_000_000_000_000_000), &encoders(), &[1, u32::MAX, 3]);
        let text = crate::config::to_toml(&homing).unwrap();
        assert_eq!(crate::config::parse::<HomingConfig>(&text, "homing.toml".as_ref()).unwrap(), homing);
        let broken = text.replace("joint = 2", "joint = 9");
        let error = crate::config::parse::<HomingConfig>(&broken, "homing.toml".as_ref()).unwrap_err();
        assert!(error.to_string().contains("encoders[1].joint"), "{error}");
    }
}
