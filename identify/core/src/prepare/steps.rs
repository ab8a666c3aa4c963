//! Runs the steps of the preparation in the order in which [`prepare`](super) numbers them.
//!
//! The input is a recording and a robot log. Both are first made continuous, and checked for motion and duration.
//! Then come the sphere, the prediction of the bar's joints, the alignment, the selection of samples and the forces.
//! The result is [`Prepared`].

use shared::config::{BallBarConfig, RobotConfig};
use shared::recording::schema::{CycleRecord, EncoderInfo};

use super::align::find::{AlignedRecording, AlignmentSearch};
use super::align::reference::ReferenceTime;
use super::encoders::frozen::constant_encoder;
use super::encoders::origins::join;
use super::forces::{ForceContext, put_on};
use super::readings::bar_angles::BarAngles;
use super::readings::both_logs::BothLogs;
use super::samples::{Sorted, sort};
use super::sphere::{sphere_of_log, turned_plate};
use super::timeline::PreparedRun;
use super::{
    AlignedLog, BarForces, EncoderOffset, Predictor, PrepareError, PrepareOptions, Prepared, SampleCounts,
    SampleStatus,
};
use crate::kinematics::{BAR_JOINTS, ball_bar_chain, robot_chain, wrapped};
use crate::logs::{RobotLog, travel};
use crate::model::{DriveTrain, Observation};
use crate::threads;

/// A joint that travels less than this counts as not moving \[deg\].
pub(super) const TRAVEL_DEG_MIN: f64 = 3.0;
/// Longest log \[h\]. If a log is longer, the usual cause is a clock that was set during the run.
pub(super) const HOURS_MAX: f64 = 24.0;

/// Largest number of changes of the counters' origin in one run. This number is reached in an hour if the bus fails once a
/// minute. Each new origin adds five parameters to the fit.
pub(super) const ORIGIN_CHANGES_MAX: usize = 60;

/// Aligns recording and robot log, and selects the samples of the solve.
///
/// `encoders` are the encoders of the recording, in the recording's order. Sections of the recording after a change of the
/// counters' origin are used too. Each of them has its own offsets.
///
/// # Errors
/// [`PrepareError`] of the step that failed, with the values that caused it.
pub fn prepare(
    cycles: &[CycleRecord],
    encoders: &[EncoderInfo],
    log: &RobotLog,
    robot: &RobotConfig,
    bar: &BallBarConfig,
    options: &PrepareOptions,
) -> Result<Prepared, PrepareError> {
    // Step 1: make both logs continuous, and check them.
    let both_logs = BothLogs::new(cycles, encoders, log, options)?;
    let (angles, log) = (&both_logs.angles, &*both_logs.log);
    check(angles, log, options)?;
    // Step 2: find the bar's base from the sphere on which the robot's positions lie. The log is interpolated in parallel.
    let (arm, bar_chain) = (robot_chain(robot, bar), ball_bar_chain(bar));
    let gravity = DriveTrain::from_robot(robot, &arm).gravity;
    let fit_sphere = || sphere_of_log(log, &arm, robot, bar.length_m, options);
    let (interpolated, sphere) = threads::both(|| log.spline(), fit_sphere);
    let (interpolated, sphere) = (interpolated?, sphere?);
    // Step 3: predict the bar's joints, with the bar on this base.
    let predictor = Predictor::new(&interpolated, &arm, &bar_chain, sphere.centre_m)?;
    // Steps 4 to 6: find clock, encoder map and offsets. If no encoder map fits, a turned plate is considered as the cause.
    let recorded_joints: Vec<u8> = encoders.iter().map(|encoder| encoder.joint).collect();
    let search = AlignmentSearch {
        readings: &angles.readings,
        recorded_joints: &recorded_joints,
        origins: angles.origins(),
        log: &interpolated,
        log_duration_s: log.q_rad.duration_s(),
        predictor: &predictor,
        chains: [&arm, &bar_chain],
        options,
    };
    let mut found = search.run().map_err(|error| match error {
        PrepareError::NoEncoderMap { recorded, limit_mrad, .. } => {
            let likely = turned_plate(log, &arm, bar.length_m, options);
            PrepareError::NoEncoderMap { recorded, limit_mrad, likely }
        }
        error => error,
    })?;
    // From here on, times count from the reference time.
    let (end_s, log_s) = (angles.readings.duration_s(), log.q_rad.duration_s());
    let reference_time = ReferenceTime::new(angles.first_time(), end_s, found.fit.clock, log_s);
    let alignment = reference_time.alignment(&found.matched, found.ambiguous, log);
    let ReferenceTime { t_ref_s, t_ref, clock, .. } = reference_time;
    let motion = AlignedLog::new(interpolated.clone(), clock.shift_s);
    // Offsets that did not change between two origins are made equal. Then the samples are classified and selected (step 7).
    let (reference_origin, origins) = join(&angles.readings, &mut found, t_ref_s);
    let numbers: Vec<usize> = origins.iter().map(|span| span.number).collect();
    let mut sorted = sort(&angles.readings, &found, &motion, t_ref_s, reference_origin, &numbers, options)?;
    let offsets = encoder_offsets(&found, reference_origin, &sorted);
    let base_m = found.fit.geometry.base.origin_m;
    let mut statuses = statuses_of_cycles(angles, &sorted.statuses);
    // Step 8: add the force on the bar.
    let context =
        ForceContext { t_ref, alignment: &alignment, motion: &motion, robot: &arm, base_m, gravity };
    let force = with_force(&mut sorted.observations, &mut statuses, log, &context)?;
    let first_valid = cycles.iter().find(|cycle| cycle.is_valid());
    let run = PreparedRun {
        cycles,
        both: &both_logs,
        t_ref,
        clock,
        statuses: &statuses,
        samples: &sorted.joints,
        encoder_map: &found.encoder_map.used,
        configuration: found.offset_fit.configuration,
        predictor: &predictor,
    };
    Ok(Prepared {
        t_ref,
        first_s: first_valid.map_or(0.0, |cycle| cycle.sample_time.seconds_since(t_ref)),
        measured: found.encoder_map.used.measured(),
        base_m,
        alignment,
        offsets,
        sphere,
        counts: SampleCounts::count(&statuses),
        timeline: run.timeline(),
        encoder_map: found.encoder_map,
        origins,
        local_shifts: sorted.local_shifts,
        poor_fit: sorted.poor_fit,
        observations: sorted.observations,
        motion,
        force,
    })
}

/// Adds the measured force along the bar to each sample. Samples without a force are removed from `observations`. `None` if
/// the run has no force log.
fn with_force(
    observations: &mut Vec<Observation>,
    statuses: &mut [SampleStatus],
    log: &RobotLog,
    context: &ForceContext<'_>,
) -> Result<Option<BarForces>, PrepareError> {
    let Some(force) = &log.force else { return Ok(None) };
    let (forces, has_force) = put_on(observations, force, context)?;
    // `observations` and the statuses are in the same order, so the n-th kept status belongs to the n-th sample.
    let kept = statuses.iter_mut().filter(|status| **status == SampleStatus::Kept);
    kept.zip(has_force)
        .filter(|(_, has_force)| !has_force)
        .for_each(|(status, _)| *status = SampleStatus::NoForce);
    Ok(Some(forces))
}

/// Offsets of the reference origin, with the spread of each encoder's residuals.
fn encoder_offsets(found: &AlignedRecording, reference: usize, sorted: &Sorted) -> Vec<EncoderOffset> {
    let offsets = found.offset_fit.of_origin(reference);
    let measured = found.encoder_map.used.measured();
    let offset = |joint: usize| EncoderOffset {
        joint: joint as u8 + 1,
        offset_rad: wrapped(offsets.map_or(0.0, |offsets| offsets.offsets_rad[joint])),
        spread_rad: sorted.spread_rad[joint],
    };
    (0..BAR_JOINTS).filter(|joint| measured[*joint]).map(offset).collect()
}

/// Status of every cycle of the recording. `of_samples` has the status of each reading; other cycles keep
/// their status from [`BarAngles`].
fn statuses_of_cycles(angles: &BarAngles, of_samples: &[SampleStatus]) -> Vec<SampleStatus> {
    let mut statuses = angles.statuses.clone();
    for (reading, status) in angles.readings.iter().zip(of_samples) {
        if let Some(slot) = statuses.get_mut(reading.cycle) {
            *slot = *status;
        }
    }
    statuses
}

/// Checks that both logs contain motion, that their durations are allowed, and that no encoder is constant while others move.
fn check(angles: &BarAngles, log: &RobotLog, options: &PrepareOptions) -> Result<(), PrepareError> {
    let readings = &angles.readings;
    if readings.is_empty() {
        return Err(PrepareError::NoValidCycle { cycles: angles.statuses.len() });
    }
    let origin_changes = angles.origins().saturating_sub(1);
    if origin_changes > ORIGIN_CHANGES_MAX {
        return Err(PrepareError::TooManyOrigins { origins: origin_changes });
    }
    if let Some(error) = constant_encoder(readings, &angles.measured) {
        return Err(error);
    }
    let bar_travel_rad = readings.chunk_by(|a, b| a.origin == b.origin).map(travel).fold(0.0, f64::max);
    require_motion("the recording", bar_travel_rad)?;
    require_motion("the robot log", travel(&log.q_rad))?;
    check_length(("the recording", readings.duration_s()), log.q_rad.duration_s(), options)
}

/// Checks `travel_rad`, the largest travel of any joint in the log `what`, against the smallest allowed travel.
pub(super) fn require_motion(what: &'static str, travel_rad: f64) -> Result<(), PrepareError> {
    let travel_deg = travel_rad.to_degrees();
    if travel_deg < TRAVEL_DEG_MIN { Err(PrepareError::NoMotion { what, travel_deg }) } else { Ok(()) }
}

/// Checks the durations of two logs \[s\]: `other` is the name and duration of the log of bar or tracker, `log_s` the
/// duration of the robot's log.
pub(super) fn check_length(
    other: (&'static str, f64),
    log_s: f64,
    options: &PrepareOptions,
) -> Result<(), PrepareError> {
    let robot = ("the robot log", log_s);
    let is_too_long = |(_, seconds): &(&str, f64)| *seconds > HOURS_MAX * 3600.0;
    if let Some((what, seconds)) = [other, robot].into_iter().find(is_too_long) {
        return Err(PrepareError::TooLong { what, hours: seconds / 3600.0 });
    }
    let (what, seconds) = if other.1 < log_s { other } else { robot };
    if seconds < options.overlap_min_s {
        return Err(PrepareError::TooShort { what, seconds, needed: options.overlap_min_s });
    }
    Ok(())
}
