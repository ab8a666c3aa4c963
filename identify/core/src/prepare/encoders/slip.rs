//! Finds an encoder that slipped so far that it fits no joint. The search runs before any fit. Otherwise the encoder map would
//! be reported as the cause. Smaller slips are found later, by comparison with the fitted geometry (`calibrate::change`).

use super::circular::{circular_median, deviations, spread_of};
use crate::kinematics::{BAR_JOINTS, wrapped};
use crate::prepare::{AnglePair, PrepareError, PrepareOptions};

/// Smallest number of pairs on each side of a slip.
const PAIRS_MIN: usize = 30;
/// Largest spread of the angles before a slip, and after it, as a fraction of the limit for a whole segment.
const CLEARLY_WITHIN: f64 = 0.5;

/// How one encoder fits the joints in one segment of the run.
enum EncoderFit {
    /// The encoder fits some joint without a step.
    Whole,
    /// The encoder fits joint `joint` (counted from 0) before and after a step. The step is at pair `at`, where the
    /// readings change by `by_rad`.
    Stepped { joint: usize, at: usize, by_rad: f64 },
    /// The encoder fits no joint.
    Nowhere,
}

/// Returns a slip, if there is a segment in which all encoders fit except one, and this encoder fits both before
/// and after a step.
///
/// `pairs` are in the order of time; `t_s` are the times of all samples \[s\].
pub(in crate::prepare) fn large_slip(
    pairs: &[AnglePair],
    t_s: &[f64],
    recorded_joints: &[u8],
    options: &PrepareOptions,
) -> Option<PrepareError> {
    let limit_rad = options.spread_max_mrad * 1e-3;
    let segments = pairs.chunk_by(|a, b| a.segment == b.segment);
    segments.filter(|segment| segment.len() >= 2 * PAIRS_MIN).find_map(|segment| {
        let mut slip = None;
        for joint in recorded_joints {
            match encoder_fit(segment, usize::from(*joint) - 1, limit_rad) {
                EncoderFit::Whole => {}
                EncoderFit::Stepped { joint, at, by_rad } if slip.is_none() => {
                    slip = Some((joint, at, by_rad));
                }
                _ => return None,
            }
        }
        let (joint, at, by_rad) = slip?;
        let at_s = *t_s.get(segment.get(at)?.sample)?;
        Some(PrepareError::EncoderSlip { joint: joint as u8 + 1, at_s, by_mrad: by_rad * 1e3 })
    })
}

/// Finds how the encoder that was recorded on joint `recorded` (counted from 0) fits. This joint is tried first.
fn encoder_fit(segment: &[AnglePair], recorded: usize, limit_rad: f64) -> EncoderFit {
    let mut stepped = EncoderFit::Nowhere;
    let joints = std::iter::once(recorded).chain((0..BAR_JOINTS).filter(|joint| *joint != recorded));
    for (joint, sign) in joints.flat_map(|joint| [(joint, 1.0), (joint, -1.0)]) {
        let difference = |pair: &AnglePair| pair.predicted_rad[joint] - sign * pair.recorded_rad[recorded];
        let differences: Vec<f64> = segment.iter().map(difference).collect();
        // The differences are predicted minus recorded, so a step of the encoder has the opposite sign.
        let with_step = step(&differences, limit_rad).map(|(at, by_rad)| EncoderFit::Stepped {
            joint,
            at,
            by_rad: -sign * by_rad,
        });
        // If the step is near an end of the segment, the encoder fits as a whole, because most samples fit. The
        // step is still reported.
        if spread_of(deviations(differences)) <= limit_rad {
            return with_step.unwrap_or(EncoderFit::Whole);
        }
        if let (EncoderFit::Nowhere, Some(with_step)) = (&stepped, with_step) {
            stepped = with_step;
        }
    }
    stepped
}

/// Searches for a step in the differences between predicted and recorded angles. Returns the index of the first pair after
/// the step, and the size of the step \[rad\]. `None` if the differences are not constant before and after the step, or if
/// the step is too small or too near to an end.
fn step(differences_rad: &[f64], limit_rad: f64) -> Option<(usize, f64)> {
    let change = |at: usize| wrapped(differences_rad[at] - differences_rad[at - 1]).abs();
    let at = (1..differences_rad.len()).max_by(|a, b| change(*a).total_cmp(&change(*b)))?;
    let (before, after) = differences_rad.split_at(at);
    let is_constant = |part: &[f64]| spread_of(deviations(part.to_vec())) <= CLEARLY_WITHIN * limit_rad;
    let by_rad = wrapped(circular_median(after) - circular_median(before));
    let is_step = before.len().min(after.len()) >= PAIRS_MIN && is_constant(before) && is_constant(after);
    (is_step && by_rad.abs() > limit_rad).then_some((at, by_rad))
}
