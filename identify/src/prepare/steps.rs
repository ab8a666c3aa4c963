//! The steps of the preparation in their order.

use nalgebra::Vector3;
use shared::config::{BallBarConfig, RobotConfig};
use shared::recording::schema::{CycleRecord, EncoderInfo};

use super::correlate::TIE;
use super::predict::Predictor;
use super::select::apart;
use super::speeds::{STEP_S, measured_speeds, predicted_speeds};
use super::{
    AlignedLog, Alignment, AnglePair, BarSegment, ClockFit, EncoderOffset, InitialValues, Match, Offsets,
    PrepareError, PrepareOptions, Prepared, Relation, SampleCounts, SphereFit, bar_angles, correlate,
    find_offsets, fit_sphere, refine, select,
};
use crate::kinematics::{BAR_JOINTS, Chain, ball_bar_chain, robot_chain};
use crate::logs::{InterpolatedLog, RobotLog, default_gap_limit_s};
use crate::model::Observation;

/// Joints that travel less than this do not move \[deg\].
const TRAVEL_DEG_MIN: f64 = 3.0;
/// Robot positions nearer to the last one say nothing new about the sphere \[m\].
const POSITIONS_APART_M: f64 = 0.005;
/// Travel between samples from which offsets and clocks are found \[rad\].
const PAIRS_APART_RAD: f64 = 0.01;
/// Samples so near to an end or a hole of the robot's log \[s\] might leave it when a solve moves the clocks.
const EDGE_S: f64 = 0.03;
/// Fewest samples that a solve can begin with.
const KEPT_MIN: usize = 50;

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
    let counts = SampleCounts {
        recorded: cycles.len(),
        invalid: angles.invalid,
        time_not_increasing: angles.time_not_increasing,
        other_origin: angles.segments.iter().map(|s| s.times.len()).sum::<usize>() - segment.times.len(),
        ..SampleCounts::default()
    };
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
    let kept = samples.keep(&predictor, clock, margin_rad, options, counts)?;

    let observations = kept
        .indices
        .iter()
        .filter_map(|&index| samples.all.get(index))
        .map(|&(t_s, bar_rad)| Observation { t_s, bar_rad, measured: angles.measured, length_m: None })
        .collect();
    let robot_ref_ns = log.first_stamp_ns.saturating_add((clock.shift_s * 1e9).round() as i64);
    Ok(Prepared {
        t_ref: samples.t_ref(segment),
        observations,
        measured: angles.measured,
        initial: InitialValues {
            clock_shift_s: 0.0,
            clock_skew: clock.skew,
            base_m,
            length_m: sphere.radius_m,
            btheta_rad: offsets.by_joint_rad(),
        },
        configuration: offsets.configuration,
        alignment: Alignment {
            correlation: matched.correlation,
            runner_up: matched.runner_up,
            ambiguous: matched.runner_up > matched.correlation - TIE,
            overlap_s: matched.overlap as f64 * STEP_S,
            clock_difference_ns: robot_ref_ns.saturating_sub(samples.t_ref(segment).0),
            skew: clock.skew,
        },
        offsets: offsets.encoders,
        sphere,
        counts: kept.counts,
        motion: AlignedLog::new(interpolated.clone(), clock.shift_s),
    })
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

/// Bar samples with their times from the reference time.
struct Samples {
    all: Vec<(f64, [f64; BAR_JOINTS])>,
    /// Reference time after the segment's first sample \[s\].
    t_ref_s: f64,
    t_ref_ns: i64,
}

/// Which samples are kept, and what became of the others.
struct Kept {
    indices: Vec<usize>,
    counts: SampleCounts,
}

impl Samples {
    fn new(segment: &BarSegment, matched: &Match, log_duration_s: f64) -> Self {
        let since_first_ns =
            |time: &shared::time::UtcNs| segment.times.first().map_or(0, |first| time.ns_since(*first));
        let shift_s = matched.shift * STEP_S;
        let end_s = segment.times.last().map_or(0.0, |last| since_first_ns(last) as f64 * 1e-9);
        let overlap_s = [(-shift_s).max(0.0), (log_duration_s - shift_s).min(end_s)];
        let t_ref_ns = (0.5e9 * (overlap_s[0] + overlap_s[1])).round() as i64;
        let all = segment
            .times
            .iter()
            .zip(&segment.angles_rad)
            .map(|(time, angles)| ((since_first_ns(time) - t_ref_ns) as f64 * 1e-9, *angles))
            .collect();
        Self { all, t_ref_s: t_ref_ns as f64 * 1e-9, t_ref_ns }
    }

    fn t_ref(&self, segment: &BarSegment) -> shared::time::UtcNs {
        segment.times.first().copied().unwrap_or_default().plus_ns(self.t_ref_ns)
    }

    fn angles(&self) -> Vec<[f64; BAR_JOINTS]> {
        self.all.iter().map(|(_, angles)| *angles).collect()
    }

    /// Samples spread over the motion, with what the robot's log predicts there.
    fn pairs(&self, predictor: &Predictor<'_>, clock: ClockFit, margin_rad: f64) -> Vec<(usize, AnglePair)> {
        apart(&self.angles(), PAIRS_APART_RAD)
            .into_iter()
            .filter_map(|index| {
                let (t_s, measured_rad) = *self.all.get(index)?;
                let predicted = predictor.at(clock.tau_s(t_s)).filter(|bar| bar.margin_rad > margin_rad)?;
                Some((index, AnglePair { measured_rad, predicted }))
            })
            .collect()
    }

    fn keep(
        &self,
        predictor: &Predictor<'_>,
        clock: ClockFit,
        margin_rad: f64,
        options: &PrepareOptions,
        mut counts: SampleCounts,
    ) -> Result<Kept, PrepareError> {
        let mut usable = Vec::new();
        for (index, (t_s, _)) in self.all.iter().enumerate() {
            let tau_s = clock.tau_s(*t_s);
            let around = [tau_s - EDGE_S, tau_s + EDGE_S].map(|tau_s| predictor.at(tau_s).is_some());
            match predictor.at(tau_s).filter(|_| around == [true, true]) {
                None => counts.outside_robot_log += 1,
                Some(bar) if bar.margin_rad <= margin_rad => counts.singular += 1,
                Some(_) => usable.push(index),
            }
        }
        let angles: Vec<[f64; BAR_JOINTS]> =
            usable.iter().filter_map(|&index| self.all.get(index)).map(|(_, angles)| *angles).collect();
        let motion_min_rad = options.motion_min_mrad * 1e-3;
        let moving = apart(&angles, motion_min_rad).len();
        let indices: Vec<usize> = select(&angles, motion_min_rad, options.points_max)
            .into_iter()
            .filter_map(|index| usable.get(index).copied())
            .collect();
        counts.standstill = usable.len() - moving;
        counts.surplus = moving.saturating_sub(indices.len());
        counts.kept = indices.len();
        if indices.len() < KEPT_MIN {
            return Err(PrepareError::NothingLeft {
                kept: indices.len(),
                outside: counts.outside_robot_log,
                singular: counts.singular,
                standstill: counts.standstill,
            });
        }
        Ok(Kept { indices, counts })
    }
}

/// Offsets at the coarse alignment, then everything refined, then judged.
fn relate(
    predictor: &Predictor<'_>,
    samples: &Samples,
    measured: &[bool; BAR_JOINTS],
    coarse: ClockFit,
    margin_rad: f64,
    options: &PrepareOptions,
) -> Result<Relation, PrepareError> {
    let angles =
        |pairs: &[(usize, AnglePair)]| -> Vec<AnglePair> { pairs.iter().map(|(_, pair)| *pair).collect() };
    let pairs = samples.pairs(predictor, coarse, margin_rad);
    // A skewed clock spreads the angles of a long run: judged only after the clock is refined.
    let rough = find_offsets(&angles(&pairs), measured, f64::INFINITY)?;
    let moving: Vec<(f64, [f64; BAR_JOINTS])> =
        pairs.iter().filter_map(|(index, _)| samples.all.get(*index).copied()).collect();
    let start = Relation { clock: coarse, base_m: predictor.base_m(), offsets: rough };
    let refined = refine(predictor, &moving, &start);
    let predictor = predictor.clone().with_base(refined.base_m);
    let pairs = samples.pairs(&predictor, refined.clock, margin_rad);
    let judged = find_offsets(&angles(&pairs), measured, options.spread_max_mrad)?;
    let encoders = judged
        .encoders
        .iter()
        .zip(&refined.offsets.encoders)
        .map(|(judged, refined)| EncoderOffset { offset_rad: refined.offset_rad, ..*judged })
        .collect();
    let offsets = Offsets { configuration: refined.offsets.configuration, encoders };
    Ok(Relation { offsets, ..refined })
}
