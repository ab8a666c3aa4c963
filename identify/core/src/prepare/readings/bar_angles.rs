//! Converts the counts of a recording to joint angles with unknown offsets.
//!
//! Each cycle either becomes a reading or receives a status that excludes it. Counters are unwrapped to continuous angles.
//! If the counters lost their origin, for example because a terminal restarted, the following readings belong to a new
//! *origin*. Each origin has its own offsets.

use std::f64::consts::TAU;

use shared::encoder::Unwrapper;
use shared::recording::schema::{CycleRecord, EncoderInfo};
use shared::time::UtcNs;

use crate::kinematics::BAR_JOINTS;
use crate::logs::{Row, Stream};
use crate::prepare::{PrepareError, SampleStatus};

/// Readings of the encoders in a valid cycle.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct BarReading {
    /// Index of the cycle in the recording.
    pub cycle: usize,
    /// Number of the counters' origin, from 0 without gaps; readings with the same number have the same encoder offsets.
    pub origin: usize,
    /// Angles by recorded joint, with unknown offsets \[rad\]. Within an origin they are continuous. At the first reading of
    /// an origin, each angle is within half a turn of zero. 0 for joints without encoder.
    pub recorded_rad: [f64; BAR_JOINTS],
}

impl Row for BarReading {
    fn numbers(&self) -> &[f64] {
        &self.recorded_rad
    }

    fn with_numbers(&self, of: impl FnMut(usize) -> f64) -> Self {
        Self { recorded_rad: std::array::from_fn(of), ..*self }
    }

    fn continues(&self, before: &Self) -> bool {
        self.origin == before.origin
    }
}

/// Readings of the encoders of a recording.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct BarAngles {
    /// Joints with an encoder.
    pub measured: [bool; BAR_JOINTS],
    /// Readings of all valid cycles, with times on the recording's clock.
    pub readings: Stream<BarReading>,
    /// Status of each cycle. A cycle without a reading is `Invalid` or `TimeNotIncreasing`. A cycle with a reading is
    /// `Thinned` until a later step of the preparation sets its status.
    pub statuses: Vec<SampleStatus>,
}

impl BarAngles {
    /// Time of the first reading.
    pub fn first_time(&self) -> UtcNs {
        UtcNs(self.readings.first_stamp_ns)
    }

    /// Number of origins of the counters.
    pub fn origins(&self) -> usize {
        self.readings.last().map_or(0, |last| last.origin + 1)
    }

    /// Replaces each reading by its average, and returns the original readings. Readings without an average are left out.
    /// Origins are numbered again, because some origins may have no reading left.
    pub(in crate::prepare) fn average(&mut self, width_s: f64) -> Stream<BarReading> {
        let mut averaged = self.readings.averaged(width_s);
        let by_origin = averaged.chunk_by_mut(|a, b| a.origin == b.origin);
        by_origin.enumerate().for_each(|(origin, rows)| rows.iter_mut().for_each(|row| row.origin = origin));
        // All valid cycles are marked as without an average. The selection of samples later sets the status of the cycles
        // that have an average.
        let valid = self.statuses.iter_mut().filter(|status| **status == SampleStatus::Thinned);
        valid.for_each(|status| *status = SampleStatus::NotAveraged);
        std::mem::replace(&mut self.readings, averaged)
    }
}

/// Unwraps the counts of all valid cycles, and converts them to angles.
///
/// # Errors
/// [`PrepareError::NoValidCycle`], and errors if the encoders in the cycles are not the declared encoders.
pub fn bar_angles(cycles: &[CycleRecord], encoders: &[EncoderInfo]) -> Result<BarAngles, PrepareError> {
    let mut angles = BarAngles { measured: measured(encoders)?, ..BarAngles::default() };
    let mut recorded_origin = cycles.first().map_or(0, |cycle| cycle.origin);
    let mut counters = Counters::new(encoders);
    let mut last_time: Option<UtcNs> = None;
    for (index, cycle) in cycles.iter().enumerate() {
        if std::mem::replace(&mut recorded_origin, cycle.origin) != cycle.origin {
            counters = Counters::new(encoders);
        }
        if !cycle.is_valid() {
            angles.statuses.push(SampleStatus::Invalid);
            continue;
        }
        if last_time.is_some_and(|last| cycle.sample_time <= last) {
            angles.statuses.push(SampleStatus::TimeNotIncreasing);
            continue;
        }
        last_time = Some(cycle.sample_time);
        let last = angles.readings.last();
        let origin = last.map_or(0, |last| last.origin + usize::from(counters.is_new()));
        let recorded_rad = counters.angles_rad(cycle)?;
        angles.readings.push(cycle.sample_time.0, BarReading { cycle: index, origin, recorded_rad });
        angles.statuses.push(SampleStatus::Thinned);
    }
    if angles.readings.is_empty() {
        return Err(PrepareError::NoValidCycle { cycles: cycles.len() });
    }
    Ok(angles)
}

/// Whether each bar joint has an encoder.
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

/// Unwraps the counters in the cycles of one origin.
struct Counters<'a> {
    encoders: &'a [EncoderInfo],
    /// One unwrapper for each encoder, in the order of the recording.
    unwrappers: Vec<Unwrapper>,
    /// Whole turns that are subtracted from each joint, chosen at the first reading of the origin \[rad\];
    /// `None` before this reading.
    turns_rad: Option<[f64; BAR_JOINTS]>,
}

impl<'a> Counters<'a> {
    fn new(encoders: &'a [EncoderInfo]) -> Self {
        let unwrappers = encoders.iter().map(|encoder| encoder.scale.unwrapper()).collect();
        Self { encoders, unwrappers, turns_rad: None }
    }

    /// Whether no reading of this origin was unwrapped yet.
    fn is_new(&self) -> bool {
        self.turns_rad.is_none()
    }

    /// Continuous angles of a cycle, by recorded joint \[rad\].
    fn angles_rad(&mut self, cycle: &CycleRecord) -> Result<[f64; BAR_JOINTS], PrepareError> {
        let mut raw_rad = [0.0; BAR_JOINTS];
        for (place, (encoder, unwrapper)) in self.encoders.iter().zip(&mut self.unwrappers).enumerate() {
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
        Ok(std::array::from_fn(|joint| raw_rad[joint] - turns_rad[joint]))
    }
}
