//! Finds the joint and the counting direction of each encoder from the angles.
//!
//! Each recorded encoder is compared with each predicted joint, in both directions. If encoder and joint belong together,
//! the difference of their angles is constant; otherwise it varies with the motion. The spread of the difference is computed
//! for each encoder, joint and direction. An *encoder map* assigns a joint and a direction to each encoder. It fits if the
//! spread of every encoder is below a limit. All maps that fit are reported, and one is used for the run.
//!
//! Two properties cannot be determined from the data:
//!
//! - An encoder on joint 2 that counts in the reversed direction cannot be distinguished from the other configuration
//!   of the gimbal. The same holds for joint 4 and the cardan. Both describe the same robot, so the recorded
//!   direction is used there.
//! - If the encoders on joints 1, 3 and 5 all count in the reversed direction, they measure the mirror image of the
//!   robot's motion. If only such a map fits, encoders and robot log contradict each other. The user must then decide
//!   which of them is wrong.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use super::circular::{deviations, spread_of};
use crate::kinematics::BAR_JOINTS;
use crate::prepare::{PrepareError, PrepareOptions};
use crate::statistics::rms;

/// How joints and directions of the encoders are determined.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", expecting = "\"find\", \"recorded\" or a list such as [1, 2, -3, 5, 4]")]
pub enum EncoderMapChoice {
    /// Use the recorded joints and directions if they fit. Otherwise use others that fit, and report this.
    #[default]
    Find,
    /// Use the recorded joints and directions. The run is refused if they do not fit, or if others fit much better.
    Recorded,
    /// Use this list: the bar joint of each encoder in the order of the recording, negative if the encoder is reversed. The
    /// run is refused only if the list does not fit and another map fits much better.
    #[serde(untagged)]
    Stated(Vec<i8>),
}

impl FromStr for EncoderMapChoice {
    type Err = String;

    /// Parses `find`, `recorded`, or a list of joints such as `1,2,-3,4,5`.
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match text.trim() {
            "find" => return Ok(Self::Find),
            "recorded" => return Ok(Self::Recorded),
            _ => {}
        }
        let joints = text.split(',').map(|joint| joint.trim().parse::<i8>());
        joints.collect::<Result<_, _>>().map(Self::Stated).map_err(|_| {
            "give find, recorded, or a joint for each encoder, negative where it counts the other way, such as \
             1,2,-3,4,5"
                .into()
        })
    }
}

/// Joint and direction of one encoder.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct EncoderPlace {
    /// Bar joint of the encoder according to the recording, 1 to 5.
    pub recorded_joint: u8,
    /// Bar joint on which the encoder is mounted, 1 to 5.
    pub joint: u8,
    /// Whether the encoder counts in the direction opposite to the recorded one.
    pub reversed: bool,
    /// Spread of the difference between measured and predicted angles, with nominal geometry (1.48 times
    /// the median deviation) \[mrad\].
    pub spread_mrad: f64,
}

/// Joints and directions of all encoders.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct EncoderMap {
    /// One entry for each encoder, in the order of the recording.
    pub encoders: Vec<EncoderPlace>,
}

impl EncoderMap {
    /// Whether order and directions are those of the recording.
    pub fn is_as_recorded(&self) -> bool {
        self.encoders.iter().all(|place| place.joint == place.recorded_joint && !place.reversed)
    }

    /// Whether every encoder on joints 1, 3 and 5 is reversed. The bar then measures the motion as reflected in a plane
    /// through the gimbal's vertical axis. In the mirror image these joints turn in the opposite direction; joints 2 and
    /// 4 turn as before.
    fn is_mirrored(&self) -> bool {
        let mut odd = self.encoders.iter().filter(|place| place.joint % 2 == 1).peekable();
        odd.peek().is_some() && odd.all(|place| place.reversed)
    }

    /// Joints with an encoder.
    pub fn measured(&self) -> [bool; BAR_JOINTS] {
        let mut measured = [false; BAR_JOINTS];
        for place in &self.encoders {
            measured[usize::from(place.joint) - 1] = true;
        }
        measured
    }

    /// Converts angles by recorded joint to angles by true joint \[rad\].
    pub fn applied(&self, recorded_rad: &[f64; BAR_JOINTS]) -> [f64; BAR_JOINTS] {
        let mut angles_rad = [0.0; BAR_JOINTS];
        for place in &self.encoders {
            let sign = if place.reversed { -1.0 } else { 1.0 };
            angles_rad[usize::from(place.joint) - 1] =
                sign * recorded_rad[usize::from(place.recorded_joint) - 1];
        }
        angles_rad
    }

    /// This encoder map in the format of `--encoders` and `prepare.encoders`, such as `1,2,-3,4,5`.
    pub fn stated(&self) -> String {
        let joints = self.encoders.iter().map(|place| {
            let sign = if place.reversed { "-" } else { "" };
            format!("{sign}{}", place.joint)
        });
        joints.collect::<Vec<String>>().join(",")
    }

    /// Root mean square of the spreads \[mrad\].
    pub fn spread_mrad(&self) -> f64 {
        rms(self.encoders.iter().map(|place| place.spread_mrad))
    }
}

impl fmt::Display for EncoderMap {
    /// Formats the map as `1 -> 1, 2 -> 4 reversed (largest spread 3.1 mrad)`. The limit applies to each encoder.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, place) in self.encoders.iter().enumerate() {
            let separator = if index == 0 { "" } else { ", " };
            let reversed = if place.reversed { " reversed" } else { "" };
            write!(f, "{separator}{} -> {}{reversed}", place.recorded_joint, place.joint)?;
        }
        let largest_mrad = self.encoders.iter().map(|place| place.spread_mrad).fold(0.0, f64::max);
        write!(f, " (largest spread {largest_mrad:.1} mrad)")
    }
}

/// The encoder map that is used, and the others that fit.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct EncoderMapReport {
    /// The encoder map that is used.
    pub used: EncoderMap,
    /// Other encoder maps in which every encoder fits within the limit, the best first.
    pub others: Vec<EncoderMap>,
}

/// Measured and predicted angles at one instant.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct AnglePair {
    /// Index of the sample in the recording's readings.
    pub sample: usize,
    /// Number of the counters' origin.
    pub origin: usize,
    /// Number of the segment. In a segment, the configuration of the bar and the offsets of the encoders do not change.
    pub segment: usize,
    /// Encoder angles by recorded joint, with unknown offsets \[rad\].
    pub recorded_rad: [f64; BAR_JOINTS],
    /// Angles predicted from the robot's log, in the first configuration \[rad\].
    pub predicted_rad: [f64; BAR_JOINTS],
}

/// Encoder maps whose spread is within this factor of the smallest spread count as equally good.
const CLEARLY_WORSE: f64 = 3.0;
/// Smallest number of pairs of a segment that is used, because shorter segments hardly distinguish joints. If all segments
/// are shorter, only the longest one is used.
const PAIRS_MIN: usize = 30;
/// Largest number of other encoder maps that are reported.
const REPORTED_MAX: usize = 8;

/// Finds or checks the encoder map of the encoders on `recorded_joints` (1 to 5).
///
/// # Errors
/// - [`PrepareError::NoEncoderMap`] if no map fits.
/// - [`PrepareError::AmbiguousEncoderMap`] if several maps fit and the recorded one is not among them.
/// - [`PrepareError::Mirrored`] if only the mirror image of the robot's motion fits.
/// - [`PrepareError::OtherEncoderMap`] if another map fits, but only the recorded one is allowed.
/// - [`PrepareError::OtherThanStated`] if the map that the user stated does not fit, but another map does.
/// - [`PrepareError::StatedEncoderMap`] if the stated map is invalid.
pub fn find_encoder_map(
    pairs: &[AnglePair],
    recorded_joints: &[u8],
    options: &PrepareOptions,
) -> Result<EncoderMapReport, PrepareError> {
    let table = SpreadTable::new(pairs, recorded_joints);
    let recorded = table.recorded();
    let mut fitting = table.fitting(options.spread_max_mrad);
    if let EncoderMapChoice::Stated(joints) = &options.encoders {
        let used = table.stated(joints)?;
        // If no map fits, the stated map is used unchecked. The cause is then probably not the map, but singular poses of
        // the bar or its configuration.
        if let Some(best) = fitting.first().filter(|best| {
            used.spread_mrad() > options.spread_max_mrad.max(CLEARLY_WORSE * best.spread_mrad())
        }) {
            let (stated, found, as_stated) = (used.to_string(), best.to_string(), best.stated());
            return Err(PrepareError::OtherThanStated { stated, found, as_stated });
        }
        return Ok(EncoderMapReport { used, others: Vec::new() });
    }
    let Some(best) = fitting.first().cloned() else {
        return Err(PrepareError::NoEncoderMap {
            recorded: recorded.to_string(),
            limit_mrad: options.spread_max_mrad,
            likely: None,
        });
    };
    let as_good = |encoder_map: &EncoderMap| encoder_map.spread_mrad() <= CLEARLY_WORSE * best.spread_mrad();
    let recorded_fits = fitting.contains(&recorded) && as_good(&recorded);
    let used = match (recorded_fits, &options.encoders) {
        (true, _) => recorded,
        (false, EncoderMapChoice::Recorded) => {
            return Err(PrepareError::OtherEncoderMap {
                recorded: recorded.to_string(),
                found: best.to_string(),
            });
        }
        (false, _) => {
            let option = |encoder_map: &EncoderMap| {
                format!("\n  --encoders {} for {encoder_map}", encoder_map.stated())
            };
            let options: Vec<String> =
                fitting.iter().filter(|encoder_map| as_good(encoder_map)).map(option).collect();
            if options.len() > 1 {
                return Err(PrepareError::AmbiguousEncoderMap { fits: options.concat() });
            }
            if best.is_mirrored() {
                return Err(PrepareError::Mirrored { joints: None, stated: best.stated() });
            }
            best
        }
    };
    fitting.retain(|encoder_map| *encoder_map != used);
    fitting.truncate(REPORTED_MAX);
    Ok(EncoderMapReport { used, others: fitting })
}

/// Spread of the difference between each recorded encoder and each predicted joint, for both directions.
struct SpreadTable<'a> {
    recorded_joints: &'a [u8],
    /// Spread by encoder, joint (counted from 0) and direction (as recorded, reversed) \[mrad\].
    spread_mrad: Vec<[[f64; 2]; BAR_JOINTS]>,
}

impl<'a> SpreadTable<'a> {
    fn new(pairs: &[AnglePair], recorded_joints: &'a [u8]) -> Self {
        let mut segments: Vec<&[AnglePair]> = pairs.chunk_by(|a, b| a.segment == b.segment).collect();
        segments.sort_by_key(|segment| std::cmp::Reverse(segment.len()));
        let long = segments.iter().take_while(|segment| segment.len() >= PAIRS_MIN).count();
        segments.truncate(long.max(1));
        let scatter = |segment: &[AnglePair], recorded: usize, joint: usize, sign: f64| {
            let differences =
                segment.iter().map(|pair| pair.predicted_rad[joint] - sign * pair.recorded_rad[recorded]);
            deviations(differences.collect())
        };
        // Spread over all segments. The deviations in each segment are taken about its own median.
        let spread_mrad = |of_segment: &dyn Fn(&[AnglePair]) -> Vec<f64>| {
            1e3 * spread_of(segments.iter().flat_map(|segment| of_segment(segment)).collect())
        };
        let row = |recorded_joint: &u8| {
            let recorded = usize::from(*recorded_joint) - 1;
            std::array::from_fn(|joint| {
                let signs = [1.0, -1.0];
                if joint == 1 || joint == 3 {
                    // On joints 2 and 4 the direction depends on the configuration, which may change between segments.
                    // The better direction of each segment is used. The table then has only one spread for this joint,
                    // in the place of the recorded direction.
                    let better = |segment: &[AnglePair]| {
                        let [forward, reversed] = signs.map(|sign| scatter(segment, recorded, joint, sign));
                        let forward_fits = spread_of(forward.clone()) <= spread_of(reversed.clone());
                        if forward_fits { forward } else { reversed }
                    };
                    return [spread_mrad(&better), f64::INFINITY];
                }
                signs.map(|sign| spread_mrad(&|segment| scatter(segment, recorded, joint, sign)))
            })
        };
        Self { recorded_joints, spread_mrad: recorded_joints.iter().map(row).collect() }
    }

    /// Entry for encoder `index` on `joint` (counted from 0).
    fn place(&self, index: usize, joint: usize, reversed: bool) -> EncoderPlace {
        let spread_mrad =
            self.spread_mrad.get(index).map_or(f64::INFINITY, |row| row[joint][usize::from(reversed)]);
        let recorded_joint = self.recorded_joints.get(index).copied().unwrap_or_default();
        EncoderPlace { recorded_joint, joint: joint as u8 + 1, reversed, spread_mrad }
    }

    /// The encoder map of the recording.
    fn recorded(&self) -> EncoderMap {
        let place = |(index, joint): (usize, &u8)| self.place(index, usize::from(*joint) - 1, false);
        EncoderMap { encoders: self.recorded_joints.iter().enumerate().map(place).collect() }
    }

    /// The encoder map that the user stated, if it is valid.
    fn stated(&self, joints: &[i8]) -> Result<EncoderMap, PrepareError> {
        let mut taken = [false; BAR_JOINTS];
        let mut free = |joint: u8| {
            let taken = taken.get_mut(usize::from(joint).wrapping_sub(1));
            taken.is_some_and(|taken| !std::mem::replace(taken, true))
        };
        if joints.len() != self.recorded_joints.len()
            || !joints.iter().all(|joint| free(joint.unsigned_abs()))
        {
            return Err(PrepareError::StatedEncoderMap {
                stated: format!("{joints:?}"),
                encoders: self.recorded_joints.len(),
            });
        }
        let places = joints.iter().enumerate().map(|(index, joint)| {
            let reversed = *joint < 0;
            let joint = usize::from(joint.unsigned_abs()) - 1;
            // On joints 2 and 4 (1 and 3 counted from 0) the table has a spread only for the recorded direction.
            EncoderPlace { reversed, ..self.place(index, joint, reversed && joint % 2 == 0) }
        });
        Ok(EncoderMap { encoders: places.collect() })
    }

    /// All encoder maps in which every encoder fits, the best first.
    fn fitting(&self, limit_mrad: f64) -> Vec<EncoderMap> {
        let mut found = Vec::new();
        self.extend(&mut Vec::new(), limit_mrad, &mut found);
        found.sort_by(|a, b| a.spread_mrad().total_cmp(&b.spread_mrad()));
        found
    }

    /// Adds to `found` every fitting map that begins with `places`, encoder by encoder (recursively).
    fn extend(&self, places: &mut Vec<EncoderPlace>, limit_mrad: f64, found: &mut Vec<EncoderMap>) {
        if places.len() == self.recorded_joints.len() {
            found.push(EncoderMap { encoders: places.clone() });
            return;
        }
        for joint in 0..BAR_JOINTS {
            if places.iter().any(|place| usize::from(place.joint) == joint + 1) {
                continue;
            }
            for reversed in [false, true] {
                let place = self.place(places.len(), joint, reversed);
                if place.spread_mrad <= limit_mrad {
                    places.push(place);
                    self.extend(places, limit_mrad, found);
                    places.pop();
                }
            }
        }
    }
}
