//! Determines the status of each sample after the alignment of the logs: whether the solve uses it, or why not.
//!
//! The residuals of the refined fit show outliers, and whether the fit is poor. Of the usable samples, only those that move
//! are used. From these, a limited number is kept, spread over the sphere.

pub(super) mod angle_errors;
pub(super) mod select;

use nalgebra::Vector3;

use self::angle_errors::{AngleErrors, LocalShift, local_shifts, outliers, spreads_rad};
use self::select::{spaced, spread_over_sphere};
use super::align::find::AlignedRecording;
use super::align::refine::Residuals;
use super::readings::bar_angles::BarReading;
use super::timeline::Sample;
use super::{AlignedLog, Deviations, PoorFit, PrepareError, PrepareOptions, SampleCounts, SampleStatus};
use crate::kinematics::{BAR_JOINTS, wrapped};
use crate::logs::Stream;
use crate::model::Observation;
use crate::statistics::extremes;
use crate::threads::rows;

/// Samples nearer than this to an end or a gap of the robot's log are left out \[s\]. They might leave the log when a
/// solve changes the clocks.
const EDGE_S: f64 = 0.03;
/// Smallest number of samples of a solve.
const KEPT_MIN: usize = 50;
/// Largest number of samples that are checked. In a longer recording, the other samples are thinned without a check. In a
/// recording of a day, four samples per second are still checked. With fewer samples, a clock step would not be found.
const CHECKED_MAX: usize = 400_000;

/// Status of all samples, and the data of those that the solve uses.
pub(super) struct Sorted {
    /// Status of every sample.
    pub statuses: Vec<SampleStatus>,
    /// Joints of every sample, with offsets added; 0 for joints without encoder \[rad\].
    pub joints: Vec<Sample>,
    /// Samples for the solve, in the order of time.
    pub observations: Vec<Observation>,
    /// How the alignment varies along the run.
    pub local_shifts: Vec<LocalShift>,
    /// Robust standard deviation of the residuals of each encoder \[rad\].
    pub spread_rad: [f64; BAR_JOINTS],
    /// The residuals, if the angles fit no geometry; otherwise `None`.
    pub poor_fit: Option<PoorFit>,
}

/// Determines the status of each sample, and converts the kept samples to observations. `t_ref_s` is the time from the first
/// sample to the reference time. `reference` is the index of the reference origin.
///
/// The angle of an observation is the angle of the encoder plus a correction. The correction is the offset of the sample's
/// origin minus the offset of the reference origin. `numbers` contains [`Observation::origin`] for each origin.
///
/// # Errors
/// [`PrepareError::NothingLeft`], [`PrepareError::LittleTravel`].
pub(super) fn sort(
    readings: &Stream<BarReading>,
    found: &AlignedRecording,
    motion: &AlignedLog,
    t_ref_s: f64,
    reference: usize,
    numbers: &[usize],
    options: &PrepareOptions,
) -> Result<Sorted, PrepareError> {
    let encoder_map = &found.encoder_map.used;
    let measured = encoder_map.measured();
    let offsets_of = |origin: usize| found.offset_fit.of_origin(origin).map(|offsets| offsets.offsets_rad);
    let joints: Vec<Sample> = readings
        .iter()
        .zip(&readings.t_s)
        .map(|(reading, t_s)| {
            let angles = encoder_map.applied(&reading.recorded_rad);
            let offsets = offsets_of(reading.origin).unwrap_or_default();
            let bar_rad = std::array::from_fn(|joint| angles[joint] + offsets[joint]);
            Sample { cycle: reading.cycle, t_s: t_s - t_ref_s, bar_rad }
        })
        .collect();
    let (mut statuses, errors) = check_all(readings, &joints, found, motion, options);
    let local_shifts = local_shifts(&errors);
    let spread_rad = spreads_rad(&errors);
    let is_poor = spread_rad.iter().any(|spread_rad| spread_rad * 1e3 > options.fit_max_mrad);
    // The residuals show an error of the run only if the fit has converged.
    let poor_fit = (is_poor && found.fit.converged).then(|| PoorFit {
        spread_rad,
        limit_mrad: options.fit_max_mrad,
        deviations: Deviations::new(&errors, &local_shifts, measured, t_ref_s, found.fit.clock),
    });
    for sample in outliers(&errors, &spread_rad) {
        statuses[sample] = SampleStatus::Outlier;
    }
    select_kept(&joints, &mut statuses, options)?;
    check_travel(&joints, &statuses, &measured, options)?;
    let reference_rad = offsets_of(reference).unwrap_or_default();
    let kept =
        readings.iter().zip(&joints).zip(&statuses).filter(|(_, status)| **status == SampleStatus::Kept);
    let observations = kept.map(|((reading, sample), _)| {
        let bar_rad =
            std::array::from_fn(|j| if measured[j] { sample.bar_rad[j] - reference_rad[j] } else { 0.0 });
        let origin = numbers.get(reading.origin).copied().unwrap_or_default();
        Observation { measured, origin, ..Observation::bar(sample.t_s, bar_rad) }
    });
    Ok(Sorted { observations: observations.collect(), statuses, joints, local_shifts, spread_rad, poor_fit })
}

/// Determines the status of each sample from its angles, and the errors of the usable samples. Usable samples have the
/// status `Standstill` so far; [`select_kept`] then finds those that move.
fn check_all(
    readings: &Stream<BarReading>,
    joints: &[Sample],
    found: &AlignedRecording,
    motion: &AlignedLog,
    options: &PrepareOptions,
) -> (Vec<SampleStatus>, Vec<AngleErrors>) {
    let mut geometry = found.fit.geometry.clone();
    // Times of `motion` already count from the reference time, so the shift is zero.
    (geometry.clock.shift_s, geometry.clock.skew) = (0.0, found.fit.clock.skew);
    let measured = found.encoder_map.used.measured();
    let residuals = Residuals::new(motion, geometry, measured);
    let margin_min_rad = options.singular_margin_deg.to_radians();
    let stride = readings.len().div_ceil(CHECKED_MAX).max(1);
    let mut statuses = vec![SampleStatus::Thinned; readings.len()];
    let has_offsets = |reading: &BarReading| found.offset_fit.of_origin(reading.origin).is_some();
    let checked = rows(readings.len().div_ceil(stride), |number| {
        let index = number * stride;
        let (reading, sample) = (&readings[index], &joints[index]);
        if !has_offsets(reading) {
            return Err(SampleStatus::OtherOrigin);
        }
        if [-EDGE_S, 0.0, EDGE_S].iter().any(|by_s| !residuals.covers(sample.t_s + by_s)) {
            return Err(SampleStatus::Outside);
        }
        let errors = residuals.of_sample(index, reading.origin, sample.t_s, &sample.bar_rad);
        errors.filter(|errors| errors.margin_rad > margin_min_rad).ok_or(SampleStatus::Singular)
    });
    for (_, status) in readings.iter().zip(&mut statuses).filter(|(reading, _)| !has_offsets(reading)) {
        *status = SampleStatus::OtherOrigin;
    }
    for (errors, status) in checked.iter().zip(statuses.iter_mut().step_by(stride)) {
        *status = errors.as_ref().err().copied().unwrap_or(SampleStatus::Standstill);
    }
    (statuses, checked.into_iter().flatten().collect())
}

/// Checks that every measured joint moves. Otherwise its offset cannot be separated from the robot's geometry.
fn check_travel(
    joints: &[Sample],
    statuses: &[SampleStatus],
    measured: &[bool; BAR_JOINTS],
    options: &PrepareOptions,
) -> Result<(), PrepareError> {
    let is_kept = |(_, status): &(&Sample, &SampleStatus)| **status == SampleStatus::Kept;
    let kept: Vec<&Sample> = joints.iter().zip(statuses).filter(is_kept).map(|(sample, _)| sample).collect();
    for joint in (0..BAR_JOINTS).filter(|joint| measured[*joint]) {
        // Angles in different origins of the counters may be whole turns apart.
        let first_rad = kept.first().map_or(0.0, |sample| sample.bar_rad[joint]);
        let [low, high] = extremes(kept.iter().map(|sample| wrapped(sample.bar_rad[joint] - first_rad)));
        let travel_deg = (high - low).to_degrees();
        if travel_deg < options.joint_travel_min_deg {
            let needed_deg = options.joint_travel_min_deg;
            return Err(PrepareError::LittleTravel { joint: joint as u8 + 1, travel_deg, needed_deg });
        }
    }
    Ok(())
}

/// Classifies the usable samples as standstill, thinned or kept.
fn select_kept(
    joints: &[Sample],
    statuses: &mut [SampleStatus],
    options: &PrepareOptions,
) -> Result<(), PrepareError> {
    let usable: Vec<usize> =
        (0..joints.len()).filter(|index| statuses.get(*index) == Some(&SampleStatus::Standstill)).collect();
    let angles: Vec<[f64; BAR_JOINTS]> = usable.iter().map(|index| joints[*index].bar_rad).collect();
    let moving: Vec<usize> =
        spaced(&angles, options.motion_min_mrad * 1e-3).into_iter().map(|place| usable[place]).collect();
    for index in &moving {
        statuses[*index] = SampleStatus::Thinned;
    }
    let directions: Vec<Vector3<f64>> =
        moving.iter().map(|index| rod_direction(&joints[*index].bar_rad)).collect();
    let points_max = if options.points_max == 0 { usize::MAX } else { options.points_max };
    let kept = spread_over_sphere(&moving, &directions, points_max);
    for index in &kept {
        statuses[*index] = SampleStatus::Kept;
    }
    if kept.len() >= KEPT_MIN {
        return Ok(());
    }
    let counts = SampleCounts::count(statuses);
    Err(PrepareError::NothingLeft {
        kept: kept.len(),
        outside: counts.of(SampleStatus::Outside),
        singular: counts.of(SampleStatus::Singular),
        standstill: counts.of(SampleStatus::Standstill),
    })
}

/// Direction of the rod in the frame of the bar's base, except for the signs of its components.
fn rod_direction(bar_rad: &[f64; BAR_JOINTS]) -> Vector3<f64> {
    let ([sin1, cos1], [sin2, cos2]) =
        ([bar_rad[0].sin(), bar_rad[0].cos()], [bar_rad[1].sin(), bar_rad[1].cos()]);
    Vector3::new(cos1 * sin2, sin1 * sin2, cos2)
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;

    #[test]
    fn a_whole_turn_between_two_origins_is_no_travel() {
        let sample = |cycle: usize| {
            let mut bar_rad = [0.01 * cycle as f64; BAR_JOINTS];
            // Joint 1 stands still.
            bar_rad[0] = if cycle < 50 { 3.1 } else { 3.1 - TAU };
            Sample { cycle, t_s: cycle as f64, bar_rad }
        };
        let joints: Vec<Sample> = (0..100).map(sample).collect();
        let statuses = [SampleStatus::Kept; 100];
        let refused = check_travel(&joints, &statuses, &[true; BAR_JOINTS], &PrepareOptions::default());
        assert!(matches!(refused, Err(PrepareError::LittleTravel { joint: 1, .. })), "{refused:?}");
    }
}
