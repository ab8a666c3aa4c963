//! Samples a motion: computes the rows of the robot's log and the cycles of the bar's recording, each on its own clock, with
//! the effects of the experiment.

use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use shared::encoder::{EncoderScale, wrap};
use shared::recording::schema::{CycleRecord, EncoderInfo, EncoderSample, MAX_ENCODERS};
use shared::time::{DcNs, MonoNs};

use super::truth::EncoderTruth;
use super::{Experiment, Motion, RandomStream, SimulateError, random};
use crate::logs::{self, ForceClock, ForceKind, ForceLog, RobotLog, ValueOrigin};

/// Time between two bus cycles, 100 Hz \[ns\].
pub(super) const CYCLE_NS: i64 = 10_000_000;
/// Time between two stamps of the robot's log on the robot's clock, 250 Hz \[ns\].
const ROBOT_PERIOD_NS: i64 = 4_000_000;
/// Time by which the robot's log begins before the bar's recording and ends after it \[s\].
const LOG_LEAD_S: f64 = 1.5;
/// Origin of distributed clocks (ETG.1000.4), 2000-01-01 in UTC \[ns\].
const DC_EPOCH_NS: i64 = 946_684_800_000_000_000;
/// Uptime of the measurement PC at the first cycle \[ns\].
const MONOTONIC_START_NS: i64 = 86_400_000_000_000;
/// Round-trip time of a frame \[ns\].
const ROUND_TRIP_NS: i64 = 60_000;
/// Uncertainty of the UTC estimate, one standard deviation \[ns\].
const UTC_UNCERTAINTY_NS: u32 = 1_000;
/// Contribution of one EL5021 to the working counter, for one logical read and write.
const WORKING_COUNTER_PER_ENCODER: u16 = 3;

/// The robot's log of the motion. `force_random` generates the noise of the force.
pub(super) fn robot_log(
    experiment: &Experiment<'_>,
    motion: &Motion,
    mut force_random: ChaCha8Rng,
) -> Result<RobotLog, SimulateError> {
    let rate = 1.0 + experiment.clocks.skew;
    let lead_ns = ((LOG_LEAD_S * rate) * 1e9) as i64;
    let length_s = motion.path.duration_s + 2.0 * LOG_LEAD_S;
    let rows = (length_s * rate * 1e9 / ROBOT_PERIOD_NS as f64) as i64;
    let mut reading = experiment.robot_reading();
    let mut near_rad = motion.start_rad;
    let first_stamp_ns = experiment.clocks.robot_at_bar_start_ns.saturating_sub(lead_ns);
    let (mut stamps_s, mut q_rad, mut forces) = (Vec::new(), Vec::new(), Vec::new());
    for row in 0..rows {
        let since_bar_start_ns = row * ROBOT_PERIOD_NS - lead_ns;
        let t_s = since_bar_start_ns as f64 * 1e-9 / rate;
        near_rad =
            motion.robot_joints(t_s, &near_rad).map_err(|source| SimulateError::Follow { t_s, source })?;
        stamps_s.push((row * ROBOT_PERIOD_NS) as f64 * 1e-9);
        q_rad.push(reading.read(&near_rad));
        let noise: f64 = force_random.sample(StandardNormal);
        let force_n = motion.force_n(t_s) + experiment.load.noise_n * noise;
        forces.push([force_n].into());
    }
    let force_log = |_| {
        let forces = logs::Stream::new(first_stamp_ns, stamps_s.clone(), forces);
        ForceLog::new(ForceClock::Robot, ForceKind::Along, forces)
    };
    Ok(RobotLog {
        robot: Some(experiment.robot.name.clone()),
        clock: "robot controller".into(),
        origin: ValueOrigin::Measured,
        force: motion.pull.map(force_log),
        q_rad: logs::Stream::new(first_stamp_ns, stamps_s, q_rad).into(),
        ..RobotLog::default()
    })
}

/// The bar's recording of the motion, the encoders, and their true offsets.
pub(super) fn recording(
    experiment: &Experiment<'_>,
    motion: &Motion,
) -> (Vec<CycleRecord>, Vec<EncoderInfo>, Vec<EncoderTruth>) {
    let encoders: Vec<EncoderInfo> = experiment
        .bar
        .encoders
        .iter()
        .map(|encoder| EncoderInfo { joint: encoder.joint, scale: encoder.scale() })
        .collect();
    let mut reading = experiment.bar_reading();
    let cycles = (motion.path.duration_s * 1e9 / CYCLE_NS as f64).round() as i64 + 1;
    let angles: Vec<[f64; 5]> =
        (0..cycles).map(|k| reading.read(&motion.path.at((k * CYCLE_NS) as f64 * 1e-9))).collect();
    let mut first_counts = random(experiment.seed, RandomStream::EncoderOffsets);
    let truth: Vec<EncoderTruth> = encoders
        .iter()
        .map(|encoder| {
            let first = angles.first().map_or(0.0, |angles| angles[usize::from(encoder.joint) - 1]);
            encoder_truth(encoder, first, first_counts.random())
        })
        .collect();
    let records = angles
        .iter()
        .enumerate()
        .map(|(cycle, angles)| record(experiment, cycle as u64, angles, &encoders, &truth))
        .collect();
    (records, encoders, truth)
}

/// True offset of an encoder whose counter reads `first_count` at the first sample. `first_count` can be any of the 2^32
/// counts. It is a signed number, as in [`EncoderScale::unwrapper`].
fn encoder_truth(encoder: &EncoderInfo, first_rad: f64, first_count: i32) -> EncoderTruth {
    let zero_counts = i64::from(first_count) - encoder.scale.rad_to_counts(first_rad);
    let EncoderScale { direction, .. } = encoder.scale;
    // Whole turns are removed in integer arithmetic, so that no rounding errors are added to the angle.
    let turns = (direction.sign() * zero_counts).rem_euclid(encoder.scale.counts_per_revolution());
    let offset_rad = -(turns as f64) * encoder.scale.rad_per_count();
    let offset_rad =
        if offset_rad > -std::f64::consts::PI { offset_rad } else { offset_rad + std::f64::consts::TAU };
    EncoderTruth { joint: encoder.joint, zero_counts, offset_rad }
}

fn record(
    experiment: &Experiment<'_>,
    cycle: u64,
    angles_rad: &[f64; 5],
    encoders: &[EncoderInfo],
    truth: &[EncoderTruth],
) -> CycleRecord {
    let since_start_ns = cycle as i64 * CYCLE_NS;
    let sample_time = experiment.clocks.bar_start.plus_ns(since_start_ns);
    let send_time = MonoNs(MONOTONIC_START_NS + since_start_ns);
    let mut samples = [EncoderSample::default(); MAX_ENCODERS];
    for ((sample, encoder), truth) in samples.iter_mut().zip(encoders).zip(truth) {
        let angle_rad = angles_rad[usize::from(encoder.joint) - 1];
        *sample = EncoderSample {
            joint: encoder.joint,
            count: wrap(encoder.scale.rad_to_counts(angle_rad) + truth.zero_counts),
            valid: true,
            ..EncoderSample::default()
        };
    }
    let working_counter = WORKING_COUNTER_PER_ENCODER * encoders.len() as u16;
    CycleRecord {
        cycle,
        sample_time,
        sample_time_uncertainty_ns: UTC_UNCERTAINTY_NS,
        dc_time: DcNs(sample_time.0.saturating_sub(DC_EPOCH_NS)),
        send_time,
        receive_time: send_time.plus_ns(ROUND_TRIP_NS),
        working_counter,
        working_counter_expected: working_counter,
        encoder_count: encoders.len() as u8,
        encoders: samples,
        ..CycleRecord::default()
    }
}
