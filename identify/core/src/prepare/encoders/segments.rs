//! Finds the offsets of the encoders and the configurations of the bar.
//!
//! The pairs of measured and predicted angles are divided into *segments*. A segment lies between two singular poses and
//! within one origin of the counters. In a segment, neither the configuration nor the offsets change. The longest segment of
//! an origin determines a first estimate of the offsets: in the correct configuration, the differences between measured and
//! predicted angles are constant. For each other segment of this origin, the best of the four configurations is found with
//! these offsets. The final offsets are computed from all segments that fit.

use super::circular::{circular_median, spread_of};
use super::encoder_map::{AnglePair, EncoderMap};
use crate::kinematics::{BAR_JOINTS, Configuration, DhLink, wrapped};
use crate::statistics::median;

/// Offsets of one origin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::prepare) struct Offsets {
    /// Offset of each joint, which is added to the angle of its encoder \[rad\]; 0 for joints without encoder.
    pub offsets_rad: [f64; BAR_JOINTS],
    /// Number of pairs of measured and predicted angles from which the offsets were estimated.
    pub pairs: usize,
}

/// Offsets of all origins.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::prepare) struct OffsetFit {
    /// Offsets of each origin; `None` if its longest segment has too few pairs.
    by_origin: Vec<Option<Offsets>>,
    /// Configuration in the longest segment of all origins. If joint 2 (or 4) has no encoder, the data fit two
    /// configurations equally well. The first of them in [`Configuration::ALL`] is then used.
    pub configuration: Configuration,
    /// Pairs of the segments that fit, in the order of time. Each entry is the index of a sample and the joints of this
    /// sample \[rad\]. Joints without encoder have the predicted value.
    pub fitting: Vec<(usize, [f64; BAR_JOINTS])>,
    /// Robust standard deviation of measured minus predicted angles of each joint, with offsets added
    /// and nominal geometry \[rad\].
    pub spread_rad: [f64; BAR_JOINTS],
}

impl OffsetFit {
    /// Number of the counters' origins.
    pub fn origins(&self) -> usize {
        self.by_origin.len()
    }

    /// Offsets of an origin, if they were found.
    pub fn of_origin(&self, origin: usize) -> Option<Offsets> {
        self.by_origin.get(origin).copied().flatten()
    }

    pub fn of_origin_mut(&mut self, origin: usize) -> Option<&mut Offsets> {
        self.by_origin.get_mut(origin)?.as_mut()
    }

    /// Adds a correction to the offsets of each origin \[rad\].
    pub fn correct(&mut self, by_rad: &[[f64; BAR_JOINTS]]) {
        for (offsets, by_rad) in self.by_origin.iter_mut().zip(by_rad) {
            if let Some(offsets) = offsets {
                offsets.offsets_rad = std::array::from_fn(|j| offsets.offsets_rad[j] + by_rad[j]);
            }
        }
    }
}

/// The offsets of an origin are estimated only if the longest segment of the origin has at least this number of pairs.
const PAIRS_MIN: usize = 10;

/// Finds offsets and configurations for a bar with the links `bar_links`. A segment is left out if the median of its errors
/// exceeds `limit_rad`. `pairs` are in the order of time, and `origins` is the number of origins.
pub(in crate::prepare) fn fit_offsets(
    bar_links: &[DhLink],
    pairs: &[AnglePair],
    encoder_map: &EncoderMap,
    origins: usize,
    limit_rad: f64,
) -> OffsetFit {
    let measured = &encoder_map.measured();
    // From here on, `recorded_rad` is ordered by the true joints of the encoders, not by the recorded ones.
    let by_joint =
        |pair: &AnglePair| AnglePair { recorded_rad: encoder_map.applied(&pair.recorded_rad), ..*pair };
    let pairs: Vec<AnglePair> = pairs.iter().map(by_joint).collect();
    let mut fit = OffsetFit {
        by_origin: vec![None; origins],
        configuration: Configuration::ALL[0],
        fitting: Vec::new(),
        spread_rad: [0.0; BAR_JOINTS],
    };
    let mut longest_of_all = 0;
    let mut errors: [Vec<f64>; BAR_JOINTS] = Default::default();
    for of_origin in pairs.chunk_by(|a, b| a.origin == b.origin) {
        let mut segments: Vec<&[AnglePair]> = of_origin.chunk_by(|a, b| a.segment == b.segment).collect();
        segments.sort_by_key(|segment| std::cmp::Reverse(segment.len()));
        // The longest segment of this origin gives the first offsets.
        let Some(longest) = segments.first().filter(|segment| segment.len() >= PAIRS_MIN) else { continue };
        let (configuration, offsets_rad) = configuration_and_offsets(bar_links, longest, measured);
        if longest.len() > longest_of_all {
            (longest_of_all, fit.configuration) = (longest.len(), configuration);
        }
        // The segments that fit these offsets in some configuration, each with its best configuration.
        let mut fitting: Vec<(&[AnglePair], Configuration)> = Vec::new();
        for segment in &segments {
            let misfit_in = |configuration: &Configuration| {
                misfit_rad(bar_links, segment, *configuration, &offsets_rad, measured)
            };
            let best = Configuration::ALL.into_iter().min_by(|a, b| misfit_in(a).total_cmp(&misfit_in(b)));
            fitting.extend(best.filter(|best| misfit_in(best) <= limit_rad).map(|best| (*segment, best)));
        }
        // The final offsets are computed from all segments that fit.
        let offsets_rad = offsets_in(bar_links, &fitting, measured);
        let used = fitting.iter().map(|(segment, _)| segment.len()).sum();
        if let Some(offsets) = fit.by_origin.get_mut(longest[0].origin) {
            *offsets = Some(Offsets { offsets_rad, pairs: used });
        }
        let pairs_with_configuration = fitting
            .iter()
            .flat_map(|(segment, configuration)| segment.iter().map(|pair| (pair, *configuration)));
        for (pair, configuration) in pairs_with_configuration {
            let predicted = configuration.carry(bar_links, &pair.predicted_rad);
            let joints: [f64; BAR_JOINTS] = std::array::from_fn(|joint| {
                if measured[joint] { pair.recorded_rad[joint] + offsets_rad[joint] } else { predicted[joint] }
            });
            fit.fitting.push((pair.sample, joints));
            for joint in 0..BAR_JOINTS {
                errors[joint].push(wrapped(predicted[joint] - joints[joint]).abs());
            }
        }
    }
    fit.fitting.sort_by_key(|(sample, _)| *sample);
    for ((spread, errors), measured) in fit.spread_rad.iter_mut().zip(errors).zip(measured) {
        *spread = if *measured { spread_of(errors) } else { 0.0 };
    }
    fit
}

/// The configuration in which the differences of a segment scatter least, and the offsets in this configuration \[rad\].
fn configuration_and_offsets(
    bar_links: &[DhLink],
    segment: &[AnglePair],
    measured: &[bool; BAR_JOINTS],
) -> (Configuration, [f64; BAR_JOINTS]) {
    let mut best: Option<(f64, Configuration, [f64; BAR_JOINTS])> = None;
    for configuration in Configuration::ALL {
        let offsets_rad = offsets_in(bar_links, &[(segment, configuration)], measured);
        let misfit_rad = misfit_rad(bar_links, segment, configuration, &offsets_rad, measured);
        // A later configuration must have a clearly smaller error. If some joints have no encoder, two configurations fit
        // equally well, and rounding errors must not decide.
        if best.is_none_or(|(least, _, _)| misfit_rad < 0.99 * least) {
            best = Some((misfit_rad, configuration, offsets_rad));
        }
    }
    best.map_or((Configuration::ALL[0], [0.0; BAR_JOINTS]), |(_, configuration, offsets)| {
        (configuration, offsets)
    })
}

/// Offsets of segments in given configurations: circular median of predicted minus measured angles, by joint \[rad\].
fn offsets_in(
    bar_links: &[DhLink],
    segments: &[(&[AnglePair], Configuration)],
    measured: &[bool; BAR_JOINTS],
) -> [f64; BAR_JOINTS] {
    let mut differences: [Vec<f64>; BAR_JOINTS] = Default::default();
    for (segment, configuration) in segments {
        for pair in *segment {
            let predicted = configuration.carry(bar_links, &pair.predicted_rad);
            for joint in (0..BAR_JOINTS).filter(|joint| measured[*joint]) {
                differences[joint].push(predicted[joint] - pair.recorded_rad[joint]);
            }
        }
    }
    differences.map(|differences| circular_median(&differences))
}

/// Error of a segment in a given configuration: the median over its pairs of the largest error of a measured joint \[rad\].
fn misfit_rad(
    bar_links: &[DhLink],
    segment: &[AnglePair],
    configuration: Configuration,
    offsets_rad: &[f64; BAR_JOINTS],
    measured: &[bool; BAR_JOINTS],
) -> f64 {
    let mut largest: Vec<f64> = segment
        .iter()
        .map(|pair| {
            let predicted = configuration.carry(bar_links, &pair.predicted_rad);
            let joints = (0..BAR_JOINTS).filter(|joint| measured[*joint]);
            let errors = joints
                .map(|joint| wrapped(predicted[joint] - pair.recorded_rad[joint] - offsets_rad[joint]).abs());
            errors.fold(0.0, f64::max)
        })
        .collect();
    median(&mut largest).unwrap_or(f64::INFINITY)
}
