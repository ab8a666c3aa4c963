//! Derives messages for other programs from the records of a run:
//! - joint states, for each cycle: the counts converted to joint angles and velocities, for plots
//! - diagnostics, once per second: number of valid cycles, flags, and errors of ports
//!
//! The travel of each joint is also determined here, for the end record.

use std::collections::{BTreeMap, BTreeSet};

use super::messages::{self, DiagnosticStatus, KeyValue, MessageError};
use super::schema::{
    CycleRecord, DeviceInfo, EncoderInfo, EncoderSample, MAX_ENCODERS, PortCounts, RunMetadata, flags,
};
use crate::encoder::Unwrapper;
use crate::time::NS_PER_S;

/// Levels of `diagnostic_msgs/DiagnosticStatus`.
const OK: u8 = 0;
const WARN: u8 = 1;
const ERROR: u8 = 2;

/// State derived from the cycles so far. [`RecordingWriter`](super::RecordingWriter) passes each cycle to it.
pub(super) struct Shown {
    encoders: Vec<EncoderInfo>,
    names: Vec<String>,
    bus: String,
    unwrappers: Vec<Unwrapper>,
    travels: Vec<Travel>,
    last: Option<CycleRecord>,
    cycles_per_second: u64,
    second: Second,
    devices: Vec<DeviceInfo>,
    /// Error counts by position and port. Ports that have counted no error are absent.
    ports: BTreeMap<(u8, u8), PortCounts>,
}

/// Statistics of the cycles since the last diagnostics message.
#[derive(Default)]
struct Second {
    cycles: u64,
    valid: u64,
    flagged: [u64; flags::NAMES.len()],
    encoders_valid: [u64; MAX_ENCODERS],
    uncertainty_ns_max: u32,
    /// Positions of devices whose ports have counted an error in this time.
    counted: BTreeSet<u8>,
}

impl Shown {
    pub fn new(run: &RunMetadata) -> Self {
        Self {
            names: run.encoders.iter().map(|encoder| format!("bar_joint_{}", encoder.joint)).collect(),
            unwrappers: run.encoders.iter().map(|encoder| encoder.scale.unwrapper()).collect(),
            travels: vec![Travel::default(); run.encoders.len()],
            encoders: run.encoders.clone(),
            bus: run.bus.clone(),
            last: None,
            cycles_per_second: (NS_PER_S as u64 / run.cycle_period_ns.max(1)).max(1),
            second: Second::default(),
            devices: run.devices.clone(),
            ports: BTreeMap::new(),
        }
    }

    /// Stores the error counts of a port.
    pub fn set_port_counts(&mut self, counts: PortCounts) {
        self.ports.insert((counts.position, counts.port), counts);
        self.second.counted.insert(counts.position);
    }

    /// The joint states of the next cycle, as CDR.
    pub fn joint_state(&mut self, record: &CycleRecord) -> Result<Vec<u8>, MessageError> {
        let velocity_rad_s = self.velocities_rad_s(record);
        let joints = self.encoders.iter().zip(&mut self.unwrappers).zip(&mut self.travels);
        let position_rad: Vec<f64> = joints
            .zip(record.encoders())
            .map(|(((encoder, unwrapper), travel), sample)| {
                if sample.valid {
                    let angle_rad = encoder.scale.counts_to_rad(unwrapper.next(sample.count));
                    travel.take(record.origin, angle_rad);
                    angle_rad
                } else {
                    f64::NAN
                }
            })
            .collect();
        self.last = Some(*record);
        let names = &self.names[..position_rad.len()];
        messages::encode_joint_state(record.sample_time, names, position_rad, velocity_rad_s)
    }

    /// Velocity of each joint \[rad/s\]: difference of the counts since the last cycle, divided by the time between the two
    /// samples. This time is measured by the clock of the bus, which is accurate to some ns. The velocity is NaN without a
    /// distributed clock, after a missing cycle, and if the origin has changed.
    fn velocities_rad_s(&self, record: &CycleRecord) -> Vec<f64> {
        let before = self.last.as_ref().filter(|last| {
            last.cycle + 1 == record.cycle && last.origin == record.origin && last.dc_time.0 != 0
        });
        let since_s = before.map(|last| record.dc_time.seconds_since(last.dc_time));
        let since_s = since_s.filter(|since_s| record.dc_time.0 != 0 && *since_s > 0.0);
        let velocity_rad_s = |(index, (encoder, sample)): (usize, (&EncoderInfo, &EncoderSample))| {
            let earlier = before.and_then(|last| last.encoders().get(index)).filter(|earlier| earlier.valid);
            let (Some(earlier), Some(since_s), true) = (earlier, since_s, sample.valid) else {
                return f64::NAN;
            };
            let turned = i64::from(sample.count.wrapping_sub(earlier.count) as i32);
            (encoder.scale.direction.sign() * turned) as f64 * encoder.scale.rad_per_count() / since_s
        };
        self.encoders.iter().zip(record.encoders()).enumerate().map(velocity_rad_s).collect()
    }

    /// Travel of each joint \[deg\], as defined in `RunEnd`.
    pub fn turned_deg(&self) -> Vec<f64> {
        self.travels.iter().map(|travel| travel.widest_rad.to_degrees()).collect()
    }

    /// After the last cycle of each second, the diagnostics of that second as CDR; otherwise `None`. They contain the number
    /// of valid cycles and samples, and the number of cycles with each flag.
    pub fn diagnostics(&mut self, record: &CycleRecord) -> Option<Result<Vec<u8>, MessageError>> {
        self.second.take(record);
        if self.second.cycles < self.cycles_per_second {
            return None;
        }
        let second = std::mem::take(&mut self.second);
        let mut status = vec![self.cycles_status(&second)];
        status.extend(record.encoders().iter().zip(second.encoders_valid).map(|(sample, valid)| {
            let values = [("count", sample.count.to_string()), ("status", format!("{:#06x}", sample.status))];
            let name = format!("ballbard: encoder of joint {}", sample.joint);
            self.status(name, valid, second.cycles, values.into_iter())
        }));
        let positions = self.ports.keys().map(|(position, _)| *position).collect::<BTreeSet<_>>();
        status.extend(positions.into_iter().map(|position| self.ports_status(position, &second)));
        Some(messages::encode_diagnostics(record.sample_time, status))
    }

    fn cycles_status(&self, second: &Second) -> DiagnosticStatus {
        let flagged = flags::NAMES.iter().zip(second.flagged).filter(|(_, count)| *count > 0);
        let values = flagged
            .map(|((_, name), count)| (*name, count.to_string()))
            .chain([("time_uncertainty_ns_max", second.uncertainty_ns_max.to_string())]);
        self.status("ballbard: cycles".into(), second.valid, second.cycles, values)
    }

    /// Status of a device whose ports have counted errors.
    fn ports_status(&self, position: u8, second: &Second) -> DiagnosticStatus {
        let device = self.devices.iter().find(|device| device.position == u16::from(position));
        let name = device.map_or("device", |device| &device.name);
        let ports = self.ports.range((position, 0)..=(position, u8::MAX)).map(|(_, counts)| counts);
        let values = ports.flat_map(|counts| {
            let value = |what: &str, count: u32| KeyValue {
                key: format!("port{}_{what}", counts.port),
                value: count.to_string(),
            };
            [
                value("receive_errors", counts.receive_errors),
                value("invalid_frames", counts.invalid_frames),
                value("lost_links", counts.lost_links),
            ]
        });
        let is_counting = second.counted.contains(&position);
        DiagnosticStatus {
            level: if is_counting { WARN } else { OK },
            name: format!("ballbard: ports of {name} at position {position}"),
            message: if is_counting { "errors in the last second" } else { "errors before" }.into(),
            hardware_id: self.bus.clone(),
            values: values.collect(),
        }
    }

    fn status<'a>(
        &self,
        name: String,
        valid: u64,
        cycles: u64,
        values: impl Iterator<Item = (&'a str, String)>,
    ) -> DiagnosticStatus {
        DiagnosticStatus {
            level: match valid {
                0 => ERROR,
                valid if valid < cycles => WARN,
                _ => OK,
            },
            name,
            message: format!("{valid} of {cycles} cycles valid"),
            hardware_id: self.bus.clone(),
            values: values.map(|(key, value)| KeyValue { key: key.into(), value }).collect(),
        }
    }
}

/// Range of a joint's angle: that since the present origin began, and the widest range of all origins so far.
#[derive(Debug, Clone, Default)]
struct Travel {
    /// Number of the present origin, with the lowest and highest angle since it began \[rad\].
    range: Option<(u32, f64, f64)>,
    widest_rad: f64,
}

impl Travel {
    fn take(&mut self, origin: u32, angle_rad: f64) {
        let (low, high) = match self.range {
            Some((same, low, high)) if same == origin => (low.min(angle_rad), high.max(angle_rad)),
            _ => (angle_rad, angle_rad),
        };
        self.range = Some((origin, low, high));
        self.widest_rad = self.widest_rad.max(high - low);
    }
}

impl Second {
    fn take(&mut self, record: &CycleRecord) {
        self.cycles += 1;
        self.valid += u64::from(record.is_valid());
        for ((flag, _), count) in flags::NAMES.iter().zip(&mut self.flagged) {
            *count += u64::from(record.flags & flag != 0);
        }
        for (sample, valid) in record.encoders().iter().zip(&mut self.encoders_valid) {
            *valid += u64::from(sample.valid);
        }
        if record.is_valid() {
            self.uncertainty_ns_max = self.uncertainty_ns_max.max(record.sample_time_uncertainty_ns);
        }
    }
}
