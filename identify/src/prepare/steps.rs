//! The steps of the preparation in their order.

use nalgebra::Vector3;
use shared::config::{BallBarConfig, RobotConfig};
use shared::recording::schema::{CycleRecord, EncoderInfo};
use shared::time::UtcNs;

use super::correlate::TIE;
use super::samples::{Samples, relate};
use super::speeds::{STEP_S, measured_speeds, predicted_speeds};
use super::timeline::Run;
use super::{
    AlignedLog, Alignment, BarAngles, BarSegment, ClockFit, Fate, InitialValues, Match, Predictor,
    PrepareError, PrepareOptions, Prepared, Relation, SampleCounts, SphereFit, bar_angles, correlate,
    fit_sphere,
};
use crate::kinematics::{BAR_JOINTS, Chain, ball_bar_chain, robot_chain};
use crate::logs::{InterpolatedLog, RobotLog, default_gap_limit_s};

/// Joints that travel less than this do not move \[deg\].
const TRAVEL_DEG_MIN: f64 = 3.0;
/// Robot positions nearer to the last one say nothing new about the sphere \[m\].
const POSITIONS_APART_M: f64 = 0.005;
/// Longest log \[s\]. Memory for the correlation grows with it, and a longer one mostly is a clock that was set.
const DURATION_S_MAX: f64 = 3.0 * 3600.0;

/// Brings recording and robot log together.
///
/// `encoders` are those of the recording, in its order. Only the longest run between two changes of the counters' origin
/// is used: another one has other zeros.
///
/// # Errors
/// [`PrepareError`] says which step failed, with its figures.
pub fn prepare(
    cycles: &[CycleRecord],
    encoders: &[EncoderInfo],
    log: &RobotLog,
    robot: &RobotConfig,
    bar: &BallBarConfig,
    options: &PrepareOptions,
) -> Result<Prepared, PrepareError> {
    let angles = bar_angles(cycles, encoders)?;
    let segment = angles
        .segments
        .iter()
        .max_by_key(|segment| segment.times.len())
        .ok_or(PrepareError::NoValidCycle { cycles: cycles.len() })?;
    check_motion(segment, log)?;
    let interpolated = InterpolatedLog::new(log, default_gap_limit_s(log))?;
    let (robot, bar_chain) = (robot_chain(robot, bar), ball_bar_chain(bar));
    let sphere = sphere(log, &robot, bar.length_m, options)?;
    let predictor = Predictor::new(&interpolated, &robot, &bar_chain, sphere.centre_m)?;
    let matched = match_speeds(&predictor, segment, log.duration_s(), &angles.measured, options)?;

    let samples = Samples::new(segment, &matched, log.duration_s());
    let margin_rad = options.singular_margin_deg.to_radians();
    let coarse = ClockFit { shift_s: samples.t_ref_s + matched.shift * STEP_S, skew: 0.0 };
    let relation = relate(&predictor, &samples, &angles.measured, coarse, margin_rad, options)?;
    let Relation { clock, base_m, offsets } = relation;
    let predictor = predictor.with_base(base_m);
    let kept = samples.keep(&predictor, clock, margin_rad, options)?;
    let fates = fates_of_all(&angles, segment, &kept.fates);

    let t_ref = samples.t_ref(segment);
    let timeline = Run {
        fates: &fates,
        cycle_s: &|cycle| cycles.get(cycle).map_or(0.0, |cycle| cycle.sample_time.seconds_since(t_ref)),
        samples: &samples.drawn(segment, &offsets.by_joint_rad()),
        measured: &angles.measured,
        configuration: offsets.configuration,
        predictor: &predictor,
        clock,
    }
    .timeline();
    let robot_ref_ns = log.first_stamp_ns.saturating_add((clock.shift_s * 1e9).round() as i64);
    Ok(Prepared {
        t_ref,
        observations: samples.observations(&kept, &angles.measured),
        measured: angles.measured,
        initial: InitialValues {
            clock_shift_s: 0.0,
            clock_skew: clock.skew,
            base_m,
            length_m: sphere.radius_m,
            btheta_rad: offsets.by_joint_rad(),
        },
        configuration: offsets.configuration,
        alignment: alignment(&matched, clock, robot_ref_ns, t_ref),
        offsets: offsets.encoders,
        sphere,
        counts: SampleCounts::of(&fates),
        timeline,
        motion: AlignedLog::new(interpolated.clone(), clock.shift_s),
    })
}

/// What became of every cycle of the recording, from what became of those of the segment that is used.
fn fates_of_all(angles: &BarAngles, used: &BarSegment, of_used: &[Fate]) -> Vec<Fate> {
    let mut fates = angles.fates.clone();
    for cycle in angles.segments.iter().flat_map(|segment| &segment.cycles) {
        if let Some(fate) = fates.get_mut(*cycle) {
            *fate = Fate::OtherOrigin;
        }
    }
    for (cycle, of_sample) in used.cycles.iter().zip(of_used) {
        if let Some(fate) = fates.get_mut(*cycle) {
            *fate = *of_sample;
        }
    }
    fates
}

fn alignment(matched: &Match, clock: ClockFit, robot_ref_ns: i64, t_ref: UtcNs) -> Alignment {
    Alignment {
        correlation: matched.correlation,
        runner_up: matched.runner_up,
        ambiguous: matched.runner_up > matched.correlation - TIE,
        overlap_s: matched.overlap as f64 * STEP_S,
        clock_difference_ns: robot_ref_ns.saturating_sub(t_ref.0),
        skew: clock.skew,
    }
}

/// Largest travel of any joint \[deg\].
fn travel_deg<const N: usize>(rows: &[[f64; N]]) -> f64 {
    let mut range = [(f64::INFINITY, f64::NEG_INFINITY); N];
    for row in rows {
        for ((low, high), value) in range.iter_mut().zip(row) {
            (*low, *high) = (low.min(*value), high.max(*value));
        }
    }
    range.iter().fold(0.0_f64, |most, (low, high)| most.max(high - low)).to_degrees()
}

fn check_motion(segment: &BarSegment, log: &RobotLog) -> Result<(), PrepareError> {
    let moves =
        [("the recording", travel_deg(&segment.angles_rad)), ("the robot log", travel_deg(&log.q_rad))];
    match moves.into_iter().find(|(_, travel_deg)| *travel_deg < TRAVEL_DEG_MIN) {
        Some((what, travel_deg)) => Err(PrepareError::NoMotion { what, travel_deg }),
        None => Ok(()),
    }
}

fn sphere(
    log: &RobotLog,
    robot: &Chain,
    length_m: f64,
    options: &PrepareOptions,
) -> Result<SphereFit, PrepareError> {
    let mut positions: Vec<Vector3<f64>> = Vec::new();
    for q in &log.q_rad {
        let position = robot.forward(q).translation.vector;
        if positions.last().is_none_or(|last| (last - position).norm() > POSITIONS_APART_M) {
            positions.push(position);
        }
    }
    let tolerance_mm = options.sphere_tolerance_mm;
    let not_a_sphere =
        |inliers: f64| PrepareError::NotASphere { inliers_percent: 100.0 * inliers, tolerance_mm };
    let sphere = fit_sphere(&positions, tolerance_mm * 1e-3).ok_or_else(|| not_a_sphere(0.0))?;
    if sphere.inliers < 0.5 {
        return Err(not_a_sphere(sphere.inliers));
    }
    if (sphere.radius_m - length_m).abs() * 1e3 > options.length_tolerance_mm {
        return Err(PrepareError::OtherLength {
            found_mm: sphere.radius_m * 1e3,
            configured_mm: length_m * 1e3,
        });
    }
    Ok(sphere.drawn_to_length(&positions, tolerance_mm * 1e-3, length_m))
}

fn match_speeds(
    predictor: &Predictor<'_>,
    segment: &BarSegment,
    log_duration_s: f64,
    measured: &[bool; BAR_JOINTS],
    options: &PrepareOptions,
) -> Result<Match, PrepareError> {
    let bar_duration_s = match (segment.times.first(), segment.times.last()) {
        (Some(first), Some(last)) => last.seconds_since(*first),
        _ => 0.0,
    };
    for (what, seconds) in [("the recording", bar_duration_s), ("the robot log", log_duration_s)] {
        if seconds > DURATION_S_MAX {
            return Err(PrepareError::TooLong {
                what,
                hours: seconds / 3600.0,
                hours_max: DURATION_S_MAX / 3600.0,
            });
        }
    }
    let shorter_s = bar_duration_s.min(log_duration_s);
    let needed_s = options.overlap_min_s.max(options.overlap_min_part * shorter_s);
    let (what, seconds) = if bar_duration_s < log_duration_s {
        ("the recording", bar_duration_s)
    } else {
        ("the robot log", log_duration_s)
    };
    let too_short = |seconds| PrepareError::TooShort { what, seconds, needed: needed_s };
    if seconds < needed_s {
        return Err(too_short(seconds));
    }
    let from_bar = measured_speeds(segment, measured).ok_or_else(|| too_short(0.0))?;
    let margin_rad = options.singular_margin_deg.to_radians();
    let from_robot = predicted_speeds(predictor, log_duration_s, measured, margin_rad);
    let overlap_min = (needed_s / STEP_S) as usize;
    let no_match = |correlation, overlap: usize| PrepareError::NoMatch {
        correlation,
        overlap_s: overlap as f64 * STEP_S,
        needed: options.correlation_min,
    };
    let matched = correlate(&from_robot, &from_bar, overlap_min).ok_or_else(|| no_match(0.0, 0))?;
    if matched.correlation < options.correlation_min {
        return Err(no_match(matched.correlation, matched.overlap));
    }
    Ok(matched)
}
