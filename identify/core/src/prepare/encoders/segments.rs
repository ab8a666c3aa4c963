//! Offsets of the encoders and configurations of the bar, segment by segment.
//!
//! Between two passes of a singular pose the bar stays in one configuration, between two changes of the counters' origin
//! the offsets stay the same. The offsets of an origin are found in its longest segment, in the configuration in which measured
//! and predicted angles differ by constants; its other segments then need only one of four configurations each.

use super::circular::{circular_median, spread_of};
use super::encoder_map::{AnglePair, EncoderMap};
use crate::kinematics::{BAR_JOINTS, Configuration, DhLink, wrapped};
use crate::statistics::median;

/// Offsets of one origin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::prepare) struct Offsets {
    /// Added to the encoders' angles \[rad\]; 0 for joints without encoder.
    pub offsets_rad: [f64; BAR_JOINTS],
    /// Number of pairs of measured and predicted angles from which the offsets were estimated.
    pub pairs: usize,
}

/// Offsets of all origins.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::prepare) struct OffsetFit {
    /// By origin; `None` if it has too few pairs.
    by_origin: Vec<Option<Offsets>>,
    /// Configuration in the longest segment of all. Without encoder on joint 2 (or 4) both signs fit, and the positive
    /// one is named.
    pub configuration: Configuration,
    /// The pairs that fit, in the order of time: sample, and joints \[rad\]; those without encoder as predicted.
    pub fitting: Vec<(usize, [f64; BAR_JOINTS])>,
    /// Scatter of each joint about its offset, on nominal geometry \[rad\].
    pub spread_rad: [f64; BAR_JOINTS],
}

impl OffsetFit {
    /// Number of the counters' origins.
    pub fn origins(&self) -> usize {
        self.by_origin.len()
    }

    /// Offsets of an origin, where they were found.
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

/// Smallest number of pairs that determine the offsets of an origin.
const PAIRS_MIN: usize = 10;

/// Finds offsets and configurations of the bar with these links. Segments in which the median angle is off by more than
/// `limit_rad` are left out.
pub(in crate::prepare) fn fit_offsets(
    bar_links: &[DhLink],
    pairs: &[AnglePair],
    encoder_map: &EncoderMap,
    origins: usize,
    limit_rad: f64,
) -> OffsetFit {
    let measured = &encoder_map.measured();
    // From here on `recorded_rad` is by the joints on which the encoders are.
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
        let Some(longest) = segments.first().filter(|segment| segment.len() >= PAIRS_MIN) else { continue };
        let (configuration, offsets_rad) = configuration_and_offsets(bar_links, longest, measured);
        if longest.len() > longest_of_all {
            (longest_of_all, fit.configuration) = (longest.len(), configuration);
        }
        // Segments in the configuration that fits these offsets.
        let mut fitting: Vec<(&[AnglePair], Configuration)> = Vec::new();
        for segment in &segments {
            let misfit_in = |configuration: &Configuration| {
                misfit_rad(bar_links, segment, *configuration, &offsets_rad, measured)
            };
            let best = Configuration::ALL.into_iter().min_by(|a, b| misfit_in(a).total_cmp(&misfit_in(b)));
            fitting.extend(best.filter(|best| misfit_in(best) <= limit_rad).map(|best| (*segment, best)));
        }
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

/// The configuration in which the differences scatter least, and their medians in it.
fn configuration_and_offsets(
    bar_links: &[DhLink],
    segment: &[AnglePair],
    measured: &[bool; BAR_JOINTS],
) -> (Configuration, [f64; BAR_JOINTS]) {
    let mut best: Option<(f64, Configuration, [f64; BAR_JOINTS])> = None;
    for configuration in Configuration::ALL {
        let offsets_rad = offsets_in(bar_links, &[(segment, configuration)], measured);
        let misfit_rad = misfit_rad(bar_links, segment, configuration, &offsets_rad, measured);
        // Clearly less: without some encoders two configurations fit alike, and rounding must not decide.
        if best.is_none_or(|(least, _, _)| misfit_rad < 0.99 * least) {
            best = Some((misfit_rad, configuration, offsets_rad));
        }
    }
    best.map_or((Configuration::ALL[0], [0.0; BAR_JOINTS]), |(_, configuration, offsets)| {
        (configuration, offsets)
    })
}

/// Circular median of predicted minus measured, by joint.
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

/// Median over the pairs of the largest error among the measured joints \[rad\].
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
