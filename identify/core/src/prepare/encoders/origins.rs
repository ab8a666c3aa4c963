//! Compares the offsets of all origins of the counters. It is used by `steps` after the alignment, and for reports.
//!
//! The *reference* is the origin with the most pairs of measured and predicted angles. If the offset of an encoder in
//! another origin does not differ significantly from that in the reference, both are made equal. Otherwise the difference is
//! reported, and a solve estimates it.

use serde::Serialize;

use crate::kinematics::{BAR_JOINTS, wrapped};
use crate::logs::Stream;
#[cfg(doc)]
use crate::model::Observation;
use crate::prepare::BarReading;
use crate::prepare::align::find::AlignedRecording;

/// A section of the recording with one origin of the counters. The encoder offsets in this section are compared with
/// the encoder offsets of the reference.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct OriginSpan {
    /// First sample, as bar time since the reference time \[s\].
    pub from_s: f64,
    /// Last sample, as bar time since the reference time \[s\].
    pub to_s: f64,
    /// Number of valid samples.
    pub samples: usize,
    /// Whether offsets were found. Otherwise the samples of this origin are not used.
    pub used: bool,
    /// Offsets of this origin minus those of the reference, by joint \[rad\]. They are added to the angles of this origin,
    /// so that all samples have the offsets of the reference.
    pub shift_rad: [f64; BAR_JOINTS],
    /// Standard deviation of each value in `shift_rad` \[rad\]; 0 for the reference.
    pub sigma_rad: f64,
    /// Whether no offset differs significantly from the reference. In this case `shift_rad` is zero.
    pub unchanged: bool,
    /// [`Observation::origin`] of the samples: 0 if they have the offsets of the reference or are not used,
    /// otherwise counted from 1.
    pub number: usize,
}

/// Number of samples that count as one independent sample. Neighbouring samples have similar errors of gears and encoders.
const SAMPLES_ALIKE: f64 = 15.0;
/// Largest difference of offsets that is not significant, in standard deviations.
const SIGMAS: f64 = 4.0;
/// Offsets that differ by less than this always count as unchanged \[rad\]. After a restart, a terminal has a random offset,
/// which almost always differs by more.
const UNCHANGED_RAD: f64 = 200e-6;

/// Describes all origins. An offset that does not differ significantly from the offset of the reference is set equal to it.
/// Also returns the index of the reference.
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
            // Each offset is compared separately, because each terminal may lose its origin alone.
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
