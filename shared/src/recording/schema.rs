//! The content of a recording as types: bus cycles, events, metadata and the end of the run.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::digest::{Flagged, RunMark};
use crate::encoder::EncoderScale;
use crate::time::{DcNs, MonoNs, UtcNs};

/// Largest number of encoders on a bar: three in the gimbal, two in the cardan.
pub const MAX_ENCODERS: usize = 5;

/// Data of one encoder's terminal in one cycle. The fields have the same order as in the message.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct EncoderSample {
    /// Bar joint of the encoder, 1 to 5.
    pub joint: u8,
    /// Whether the sample can be used: the count is new, and the terminal is in operation and reports no error.
    pub valid: bool,
    /// Status word in the terminal's TxPDO, unchanged.
    pub status: u16,
    /// The terminal's 32-bit counter, which wraps.
    pub count: u32,
    /// Counter at the last reference mark (C). Valid only if the status word reports a latch.
    pub latch: u32,
}

/// Bits of [`CycleRecord::flags`]: why a cycle, or some of its encoders, cannot be used.
pub mod flags {
    /// No reply came within the time-out.
    pub const NO_REPLY: u32 = 1 << 0;
    /// The working counter differs from its expected value.
    pub const WORKING_COUNTER: u32 = 1 << 1;
    /// A device is not in OP.
    pub const NOT_OPERATIONAL: u32 = 1 << 2;
    /// The toggle bit of a terminal did not change, so its input is from an earlier cycle.
    pub const STALE_INPUT: u32 = 1 << 3;
    /// A terminal reports frequency, amplitude or synchronisation error.
    pub const TERMINAL_ERROR: u32 = 1 << 4;
    /// The frame of the cycle was too late. The terminals had already overwritten the sample of the cycle, or
    /// had begun to do so.
    pub const DEADLINE_MISSED: u32 = 1 << 5;
    /// The bus is down, and must be brought up again.
    pub const BUS_DOWN: u32 = 1 << 6;
    /// There is no distributed clock, so only bounds of the sample time are known.
    pub const NO_DC: u32 = 1 << 7;
    /// The cycle was lost, because the ring between bus and file overflowed, or because the file was damaged. Only the
    /// number of the cycle is known.
    pub const LOST: u32 = 1 << 8;
    /// The counters may have another origin than in the previous cycle. This flag is used in exported tables, and
    /// in files of older programs, whose records have no origin number. A decoded
    /// [`CycleRecord`](super::CycleRecord) never has this flag.
    pub const ORIGIN_CHANGED: u32 = 1 << 9;

    /// Each flag with its name in reports and exports.
    pub const NAMES: [(u32, &str); 10] = [
        (NO_REPLY, "no_reply"),
        (WORKING_COUNTER, "working_counter"),
        (NOT_OPERATIONAL, "not_operational"),
        (STALE_INPUT, "stale_input"),
        (TERMINAL_ERROR, "terminal_error"),
        (DEADLINE_MISSED, "deadline_missed"),
        (BUS_DOWN, "bus_down"),
        (NO_DC, "no_dc"),
        (LOST, "lost"),
        (ORIGIN_CHANGED, "origin_changed"),
    ];
}

/// One bus cycle. It has a fixed size and is `Copy`, because it passes through the ring from the real-time thread.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct CycleRecord {
    /// Number of the cycle in the run. Numbers are consecutive.
    pub cycle: u64,
    /// Estimated time at which the encoders were sampled, UTC.
    pub sample_time: UtcNs,
    /// Standard deviation of the error of `sample_time`, against the host's UTC \[ns\].
    pub sample_time_uncertainty_ns: u32,
    /// Sample time on the clock of the bus. 0 without distributed clocks.
    pub dc_time: DcNs,
    /// Time at which the frame was passed to the network interface.
    pub send_time: MonoNs,
    /// Time at which the reply arrived. Equal to `send_time` if no reply arrived.
    pub receive_time: MonoNs,
    /// Working counter of the process data datagram.
    pub working_counter: u16,
    /// Working counter that is expected if every device processes the frame.
    pub working_counter_expected: u16,
    /// Why the cycle, or some of its encoders, cannot be used, see [`flags`]. 0 if all encoders can be used.
    pub flags: u32,
    /// Number of the counters' origin in this run. Counts of two cycles can be subtracted only if their origins are equal.
    pub origin: u32,
    /// Number of elements of `encoders` in use.
    pub encoder_count: u8,
    /// The encoders, in bus order.
    pub encoders: [EncoderSample; MAX_ENCODERS],
}

impl CycleRecord {
    /// The record for a lost cycle. Only the number and the approximate time of the cycle are known. Joints and origin are
    /// copied from `near`, another record of the same run.
    pub fn lost(cycle: u64, sample_time: UtcNs, near: &Self) -> Self {
        let mut record = Self {
            cycle,
            sample_time,
            sample_time_uncertainty_ns: u32::MAX,
            working_counter_expected: near.working_counter_expected,
            flags: flags::LOST,
            origin: near.origin,
            encoder_count: near.encoder_count,
            ..Self::default()
        };
        for (encoder, known) in record.encoders.iter_mut().zip(near.encoders()) {
            encoder.joint = known.joint;
        }
        record
    }

    /// The encoders in use, in bus order.
    pub fn encoders(&self) -> &[EncoderSample] {
        &self.encoders[..usize::from(self.encoder_count).min(MAX_ENCODERS)]
    }

    /// Whether every encoder of the bus has a valid sample.
    pub fn is_valid(&self) -> bool {
        self.encoder_count > 0 && self.encoders().iter().all(|encoder| encoder.valid)
    }
}

/// Kind of an event.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum EventKind {
    /// A marker set by a person.
    Marker = 1,
    /// Cycles without valid samples.
    Gap = 2,
    /// The state of the bus changed.
    Bus = 3,
    /// A clock was stepped or lost.
    Clock = 4,
    /// The run's file was continued in another directory.
    Disk = 5,
}

impl EventKind {
    /// Converts the number in the file; `None` if it is unknown.
    pub(super) fn from_u8(number: u8) -> Option<Self> {
        [Self::Marker, Self::Gap, Self::Bus, Self::Clock, Self::Disk]
            .into_iter()
            .find(|kind| *kind as u8 == number)
    }

    /// Word before the text of an event. Because of this word, no spreadsheet reads the text as a formula.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Marker => "mark",
            Self::Gap => "gap",
            Self::Bus => "bus",
            Self::Clock => "clock",
            Self::Disk => "disk",
        }
    }
}

/// Something that happened during a run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Event {
    /// Time of the event, UTC.
    pub time: UtcNs,
    /// Number of the cycle during which it happened.
    pub cycle: u64,
    /// Kind of the event.
    pub kind: EventKind,
    /// Description in words for people.
    pub text: String,
    /// Stable code of the problem. Status and log use the same code. Empty for a marker, and in files of older programs.
    pub code: String,
}

/// One encoder of the run: its joint and how its counts become angles.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct EncoderInfo {
    /// Bar joint, 1 to 5.
    pub joint: u8,
    /// Conversion of counts to an angle. Offset and reference mark are 0 if they are unknown.
    pub scale: EncoderScale,
}

/// Identification of one device on the bus, as read from the device.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DeviceInfo {
    /// Position on the bus, the coupler is 0.
    pub position: u16,
    /// Name in the device's EEPROM.
    pub name: String,
    /// Number of the EtherCAT vendor.
    pub vendor_id: u32,
    /// Product code of the vendor.
    pub product_code: u32,
    /// Revision number of the device.
    pub revision: u32,
    /// Serial number. 0 if the manufacturer assigns none.
    pub serial: u32,
}

impl DeviceInfo {
    /// Revision in Beckhoff's type designation: the upper 16 bits of the revision number.
    pub fn type_revision(&self) -> u16 {
        (self.revision >> 16) as u16
    }
}

/// Names and settings of a run, written into the file before the first cycle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunMetadata {
    /// Name of the run, which is the name of its file without the ending.
    pub name: String,
    /// Person who made the recording.
    pub operator: String,
    /// Name of the measured robot.
    pub robot: String,
    /// Name or serial number of the bar.
    #[serde(default)]
    pub bar: String,
    /// Payload of the robot in addition to the bar.
    #[serde(default)]
    pub payload: String,
    /// Free text of the operator.
    pub note: String,
    /// Beginning of the run, UTC.
    pub started: UtcNs,
    /// Name and version of the program that wrote the recording.
    pub software: String,
    /// Network interface, or [`SIMULATED_BUS`].
    pub bus: String,
    /// The recording that was replayed, if the run is a replay. Absent in files of older programs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub replay_of: Option<ReplayOrigin>,
    /// Time between two cycles \[ns\].
    pub cycle_period_ns: u64,
    /// Whether the terminals sample on distributed clocks. If they do not, a sample may be up to one period old.
    pub distributed_clocks: bool,
    /// Difference `UTC - CLOCK_MONOTONIC` \[ns\]. It is constant during the run, so that time stamps never decrease.
    pub utc_minus_monotonic_ns: i64,
    /// Encoders in bus order.
    pub encoders: Vec<EncoderInfo>,
    /// Devices in bus order.
    pub devices: Vec<DeviceInfo>,
    /// The daemon's configuration, TOML.
    pub daemon_config: String,
    /// The bar's configuration, TOML.
    pub ball_bar_config: String,
}

/// Name of the bus with simulated encoder signals.
pub const SIMULATED_BUS: &str = "simulated";

/// The original recording whose counts a replay repeats on the simulated bus. If a replay is replayed, this
/// is still the original recording.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct ReplayOrigin {
    /// Name of the original run.
    pub name: String,
    /// Beginning of the original run.
    pub started: UtcNs,
    /// Network interface from which the original run was recorded, or `simulated`.
    pub bus: String,
}

/// Where the encoder counts of a run come from, for lists and messages.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Provenance {
    /// The encoder counts were simulated.
    #[serde(default)]
    pub simulated: bool,
    /// The original recording, if this run is a replay.
    #[serde(default)]
    pub replay_of: Option<ReplayOrigin>,
}

impl Provenance {
    /// Provenance of a run on `bus`. For a replay, `replay_of` is the recording that is played.
    pub fn new(bus: &str, replay_of: Option<ReplayOrigin>) -> Self {
        let simulated = replay_of.as_ref().map_or(bus, |origin| &origin.bus) == SIMULATED_BUS;
        Self { simulated, replay_of }
    }

    /// Whether the counts were measured on a real bus, and not by a replay.
    pub fn is_measured(&self) -> bool {
        *self == Self::default()
    }
}

/// A text such as `SIMULATED, replay of ..`. Empty for measured data.
impl fmt::Display for Provenance {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let simulated = self.simulated.then(|| "SIMULATED".to_owned());
        let replay = self.replay_of.as_ref().map(|ReplayOrigin { name, started, bus }| {
            let began = started.to_datetime().format("%Y-%m-%d %H:%M:%S UTC");
            format!("replay of `{name}`, recorded {began} on {bus}")
        });
        f.write_str(&simulated.into_iter().chain(replay).collect::<Vec<_>>().join(", "))
    }
}

impl RunMetadata {
    /// Whether the encoder counts were simulated. For a replay, the bus of the original recording decides. Replays by older
    /// programs do not contain the original recording. For them, their own bus decides.
    pub fn is_simulated(&self) -> bool {
        self.provenance().simulated
    }

    /// Whether the counts were measured, simulated or replayed.
    pub fn provenance(&self) -> Provenance {
        Provenance::new(&self.bus, self.replay_of.clone())
    }

    /// Identifies this recording as the origin of a replay. If this recording is itself a replay,
    /// the original recording is returned.
    pub fn origin(&self) -> ReplayOrigin {
        let Self { name, started, bus, .. } = self;
        let this = || ReplayOrigin { name: name.clone(), started: *started, bus: bus.clone() };
        self.replay_of.clone().unwrap_or_else(this)
    }
}

/// Error counts of one port of a device since the run began.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct PortCounts {
    /// Position of the device on the bus.
    pub position: u8,
    /// Number of the port on its device. Port 0 leads to the device before.
    pub port: u8,
    /// Frames with a wrong check sequence.
    pub invalid_frames: u32,
    /// Invalid symbols, inside frames or between them.
    pub receive_errors: u32,
    /// How often the link was lost.
    pub lost_links: u32,
}

impl PortCounts {
    /// Sum of the three error counts.
    pub fn all(&self) -> u32 {
        self.invalid_frames.saturating_add(self.receive_errors).saturating_add(self.lost_links)
    }
}

/// How a run ended. This record is written into the file after the last cycle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunEnd {
    /// Why the run ended, in words.
    pub cause: String,
    /// End of the run, UTC.
    pub ended: UtcNs,
    /// Cycles in the file.
    pub cycles: u64,
    /// Cycles in which every encoder is valid.
    pub cycles_valid: u64,
    /// Number of lost cycles ([`flags::LOST`]). Of a lost cycle, only its number in the run is known.
    pub cycles_lost: u64,
    /// Whether the recording was recovered. If so, the run was cut short or its file was damaged, and
    /// the undamaged cycles were kept.
    #[serde(default)]
    pub recovered: bool,
    /// Travel of each encoder, in bus order \[deg\]: the largest range of its angle during which the counter had the same
    /// origin. Empty in files of older programs.
    #[serde(default)]
    pub turned_deg: Vec<f64>,
    /// The first markers of the run. Empty in files of older programs.
    #[serde(default)]
    pub marks: Vec<RunMark>,
    /// The cycles that are not valid, grouped by joint and reason. Empty in files of older programs.
    #[serde(default)]
    pub flagged: Vec<Flagged>,
}

/// Minimum duration of a run, and minimum travel of each measured joint, for `identify calibrate` with default settings. The
/// daemon grades runs by the same limits.
pub mod required {
    /// Minimum overlap of robot log and recording \[s\]. If the motion is shorter, it can match the
    /// log at several time offsets.
    pub const OVERLAP_MIN_S: f64 = 10.0;
    /// Minimum travel of a joint \[deg\]. With less travel, the encoder's offset cannot be
    /// separated from the robot's geometry.
    pub const TRAVEL_MIN_DEG: f64 = 3.0;
}
