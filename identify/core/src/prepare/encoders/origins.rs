//! Offsets of the encoders after a change of the counters' origin: those that did not change significantly are made equal to
//! those of the reference, the origin with the most pairs. Used by `steps` after the alignment, and for reports.

use serde::Serialize;

use crate::kinematics::{BAR_JOINTS, wrapped};
use crate::logs::Stream;
#[cfg(doc)]
use crate::model::Observation;
use crate::prepare::BarReading;
use crate::prepare::align::find::AlignedRecording;

/// A part of the recording with its own offsets, brought to those of the longest part.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct OriginSpan {
    /// First sample, bar time since the reference \[s\].
    pub from_s: f64,
    /// Last sample \[s\].
    pub to_s: f64,
    /// Number of valid samples.
    pub samples: usize,
    /// Whether offsets were found: otherwise the samples are not used.
    pub used: bool,
    /// Added to the angles of this part so that they have the offsets of the longest one \[rad\].
    pub shift_rad: [f64; BAR_JOINTS],
    /// One standard deviation of each of `shift_rad`; 0 for the longest part \[rad\].
    pub sigma_rad: f64,
    /// The counters continued from their last counts: `shift_rad` is exactly zero.
    pub unchanged: bool,
    /// [`Observation::origin`] of its samples: 0 with the offsets of the longest part, otherwise counted from 1.
    pub number: usize,
}

/// Neighbouring samples share the errors of gears and encoders: this number of samples counts as one.
const SAMPLES_ALIKE: f64 = 15.0;
/// Differences within this number of standard deviations are not significant.
const SIGMAS: f64 = 4.0;
/// A terminal that restarts has a random offset: smaller differences are not a new origin \[rad\].
const UNCHANGED_RAD: f64 = 200e-6;

/// Describes all origins and makes offsets that did not change the same. Also returns the index of the reference origin, to whose
/// offsets the others are brought.
pub(in crate::prepare) fn join(
    readings: &Stream<BarReading>,
    found: &mut AlignedRecording,
    t_ref_s: f64,
) -> (usize, Vec<OriginSpan>) {
    let pairs_of = |found: &AlignedRecording, origin: usize| {
        found.offset_fit.of_origin(origin).map_or(0, |offsets| offsets.pairs)
    };
    let origins = found.offset_fit.origins();
    let reference = (0..origins).max_by_key(|origin| pairs_of(found, *origin)).unwrap_or(0);
    let offset_sigma_rad = |found: &AlignedRecording, origin: usize| {
        found.fit.sigma_rad * (SAMPLES_ALIKE / pairs_of(found, origin).max(1) as f64).sqrt()
    };
    let of_reference = found.offset_fit.of_origin(reference);
    let mut spans = Vec::new();
    let mut numbers = 1..;
    for origin in 0..origins {
        let begins = readings.partition_point(|reading| reading.origin < origin);
        let ends = readings.partition_point(|reading| reading.origin <= origin);
        let sigma_rad = if origin == reference {
            0.0
        } else {
            offset_sigma_rad(found, origin).hypot(offset_sigma_rad(found, reference))
        };
        let limit_rad = UNCHANGED_RAD.max(SIGMAS * sigma_rad);
        let mut shift_rad = [0.0; BAR_JOINTS];
        let mut offsets = found.offset_fit.of_origin_mut(origin);
        if let (Some(offsets), Some(reference)) = (&mut offsets, of_reference) {
            // Terminals lose their origin one by one.
            for (joint, shift) in shift_rad.iter_mut().enumerate() {
                let by_rad = wrapped(offsets.offsets_rad[joint] - reference.offsets_rad[joint]);
                if by_rad.abs() > limit_rad {
                    *shift = by_rad;
                } else {
                    offsets.offsets_rad[joint] = reference.offsets_rad[joint];
                }
            }
        }
        let unchanged = offsets.is_some() && shift_rad == [0.0; BAR_JOINTS];
        let number = if unchanged || offsets.is_none() { 0 } else { numbers.next().unwrap_or_default() };
        let time_s = |sample: usize| readings.t_s.get(sample).map_or(0.0, |t_s| t_s - t_ref_s);
        spans.push(OriginSpan {
            from_s: time_s(begins),
            to_s: time_s(ends.saturating_sub(1)),
            samples: ends - begins,
            used: offsets.is_some(),
            shift_rad,
            sigma_rad,
            unchanged,
            number,
        });
    }
    (reference, spans)
}
