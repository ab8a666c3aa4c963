//! Counts of a recording to joint angles with unknown offsets.

use std::f64::consts::TAU;

use shared::encoder::Unwrapper;
use shared::recording::schema::{CycleRecord, EncoderInfo};
use shared::time::UtcNs;

use crate::kinematics::BAR_JOINTS;
use crate::prepare::{PrepareError, SampleStatus};

/// Samples between two changes of the counters' origin: within it the offsets stay the same.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct BarSegment {
    /// Index of each sample's cycle in the recording.
    pub cycles: Vec<usize>,
    /// When the encoders were sampled, strictly increasing.
    pub times: Vec<UtcNs>,
    /// Angles \[rad\], continuous; each joint begins within half a turn of zero. Joints without encoder are 0.
    pub angles_rad: Vec<[f64; BAR_JOINTS]>,
}

/// What the encoders of a recording say.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct BarAngles {
    /// Joints with an encoder.
    pub measured: [bool; BAR_JOINTS],
    /// In the order of time; none is empty.
    pub segments: Vec<BarSegment>,
    /// What became of each cycle so far: invalid, time not increasing, or anything else.
    pub statuses: Vec<SampleStatus>,
}

/// Unwraps the counts of all valid cycles.
///
/// # Errors
/// [`PrepareError::NoValidCycle`], and where cycles and declared encoders disagree.
pub fn bar_angles(cycles: &[CycleRecord], encoders: &[EncoderInfo]) -> Result<BarAngles, PrepareError> {
    let mut angles = BarAngles { measured: measured(encoders)?, ..BarAngles::default() };
    let mut segment = SegmentBuilder::new(encoders);
    let mut origin = cycles.first().map_or(0, |cycle| cycle.origin);
    for (index, cycle) in cycles.iter().enumerate() {
        if std::mem::replace(&mut origin, cycle.origin) != cycle.origin {
            let ended = std::mem::replace(&mut segment, SegmentBuilder::new(encoders));
            angles.segments.extend(ended.finish());
        }
        if !cycle.is_valid() {
            angles.statuses.push(SampleStatus::Invalid);
            continue;
        }
        if segment.samples.times.last().is_some_and(|&before| cycle.sample_time <= before) {
            angles.statuses.push(SampleStatus::TimeNotIncreasing);
            continue;
        }
        segment.push(index, cycle, encoders)?;
        angles.statuses.push(SampleStatus::Thinned);
    }
    angles.segments.extend(segment.finish());
    if angles.segments.is_empty() {
        return Err(PrepareError::NoValidCycle { cycles: cycles.len() });
    }
    Ok(angles)
}

fn measured(encoders: &[EncoderInfo]) -> Result<[bool; BAR_JOINTS], PrepareError> {
    let mut measured = [false; BAR_JOINTS];
    for encoder in encoders {
        match measured.get_mut(usize::from(encoder.joint).wrapping_sub(1)) {
            Some(taken) if !*taken => *taken = true,
            _ => return Err(PrepareError::EncoderJoint { joint: encoder.joint }),
        }
    }
    Ok(measured)
}

struct SegmentBuilder {
    samples: BarSegment,
    /// One for each encoder, in the order of the recording.
    unwrappers: Vec<Unwrapper>,
    /// Whole turns taken off each joint.
    turns_rad: Option<[f64; BAR_JOINTS]>,
}

impl SegmentBuilder {
    fn new(encoders: &[EncoderInfo]) -> Self {
        Self {
            samples: BarSegment::default(),
            unwrappers: encoders.iter().map(|encoder| encoder.scale.unwrapper()).collect(),
            turns_rad: None,
        }
    }

    fn push(
        &mut self,
        cycle_index: usize,
        cycle: &CycleRecord,
        encoders: &[EncoderInfo],
    ) -> Result<(), PrepareError> {
        let mut raw_rad = [0.0; BAR_JOINTS];
        for (place, (encoder, unwrapper)) in encoders.iter().zip(&mut self.unwrappers).enumerate() {
            let sample = cycle.encoders().get(place).copied().unwrap_or_default();
            if sample.joint != encoder.joint {
                return Err(PrepareError::EncoderOrder {
                    cycle: cycle.cycle,
                    declared: encoder.joint,
                    found: sample.joint,
                });
            }
            let joint = usize::from(encoder.joint) - 1;
            raw_rad[joint] = encoder.scale.counts_to_rad(unwrapper.next(sample.count));
        }
        let turns_rad = *self.turns_rad.get_or_insert_with(|| raw_rad.map(|raw| (raw / TAU).round() * TAU));
        self.samples.cycles.push(cycle_index);
        self.samples.times.push(cycle.sample_time);
        self.samples.angles_rad.push(std::array::from_fn(|joint| raw_rad[joint] - turns_rad[joint]));
        Ok(())
    }

    fn finish(self) -> Option<BarSegment> {
        (!self.samples.times.is_empty()).then_some(self.samples)
    }
}
