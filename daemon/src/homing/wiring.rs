//! Compares the result of a homing with `ball_bar.toml`: the encoder of each joint, and the direction of its counts. Marks
//! are saved only if both agree with the file.

use std::fmt;

use shared::config::EncoderConfig;
use shared::encoder::Direction;

use super::FoundMark;

/// Error if the encoders that were found differ from the configuration.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub struct Miswired {
    /// For each encoder in bus order: first the configuration in the file, then the configuration that homing found.
    encoders: Vec<(EncoderConfig, EncoderConfig)>,
}

/// Compares the encoders in the configuration with those found. If they agree, returns the counts at the reference marks, in
/// the order of `encoders`. Otherwise returns the required changes of the configuration.
pub fn verify(encoders: &[EncoderConfig], found: &[FoundMark]) -> Result<Vec<u32>, Miswired> {
    let found_on = |encoder: usize| found.iter().find(|found| found.encoder == encoder);
    let compared: Vec<(EncoderConfig, EncoderConfig)> = encoders
        .iter()
        .enumerate()
        .filter_map(|(encoder, config)| Some((config.clone(), as_found(config, found_on(encoder)?))))
        .collect();
    if compared.len() != encoders.len() || compared.iter().any(|(config, found)| config != found) {
        return Err(Miswired { encoders: compared });
    }
    Ok((0..encoders.len()).filter_map(|encoder| Some(found_on(encoder)?.reference_counts)).collect())
}

fn as_found(config: &EncoderConfig, found: &FoundMark) -> EncoderConfig {
    let direction = if found.counts_rise { Direction::Positive } else { Direction::Negative };
    EncoderConfig { joint: found.joint, direction, ..config.clone() }
}

impl fmt::Display for Miswired {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "the encoders differ from ball_bar.toml, so nothing was written:")?;
        for (index, (config, found)) in self.encoders.iter().enumerate() {
            let terminal = index + 1;
            if config.joint != found.joint {
                write!(
                    f,
                    "\n  terminal {terminal} measures joint {}, not joint {}; in ball_bar.toml encoder number \
                     {terminal} must have `joint = {}`",
                    found.joint, config.joint, found.joint
                )?;
            }
            if config.direction != found.direction {
                write!(
                    f,
                    "\n  joint {} counts {}: if it was turned in its positive direction, its encoder must have \
                     `direction = \"{}\"`",
                    found.joint,
                    if found.direction == Direction::Positive { "up" } else { "down" },
                    if found.direction == Direction::Positive { "positive" } else { "negative" },
                )?;
            }
        }
        write!(f, "\nCorrect ball_bar.toml (or the plugs), then home again")
    }
}
