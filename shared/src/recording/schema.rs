//! The content of a recording: bus cycles, events, metadata and the end of the run.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::digest::{Flagged, RunMark};
use crate::encoder::EncoderScale;
use crate::time::{DcNs, MonoNs, UtcNs};

/// Most encoders that a bar has: three of the gimbal, two of the cardan.
pub const MAX_ENCODERS: usize = 5;

/// What one encoder's terminal gave in one cycle. The fields are in the order of the message.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct EncoderSample {
    /// Bar joint that the encoder sits on, 1 to 5.
    pub joint: u8,
    /// The count is fresh, in operation and free of terminal errors.
    pub valid: bool,
    /// Status word of the terminal's TxPDO, raw.
    pub status: u16,
    /// 32-bit counter as the terminal gave it, wrapping.
    pub count: u32,
    /// Counter at the last reference mark (C), valid if the status has its bit.
    pub latch: u32,
}

/// Why a cycle, or a part of it, cannot be used. Bits of [`CycleRecord::flags`].
pub mod flags {
    /// No reply came within the time-out.
    pub const NO_REPLY: u32 = 1 << 0;
    /// Working counter differs from what the bus should give.
    pub const WORKING_COUNTER: u32 = 1 << 1;
    /// A device is not in OP.
    pub const NOT_OPERATIONAL: u32 = 1 << 2;
    /// A terminal's toggle did not flip: its input is that of an earlier cycle.
    pub const STALE_INPUT: u32 = 1 << 3;
    /// A terminal reports frequency, amplitude or synchronisation error.
    pub const TERMINAL_ERROR: u32 = 1 << 4;
    /// The cycle's deadline had passed before its frame could be sent.
    pub const DEADLINE_MISSED: u32 = 1 << 5;
    /// The bus is being initialised.
    pub const BUS_DOWN: u32 = 1 << 6;
    /// No distributed clock: the sample's age is only bounded.
    pub const NO_DC: u32 = 1 << 7;
    /// The cycle was lost between bus and file (ring overflow) or in a damaged file; only its number is known.
    pub const LOST: u32 = 1 << 8;
    /// Counters may have a new origin since the cycle before: in tables, and in files whose records had no number of their
    /// origin. A [`CycleRecord`](super::CycleRecord) never has it.
    pub const ORIGIN_CHANGED: u32 = 1 << 9;

    /// Each bit and its name, as reports and exports show it.
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

/// One bus cycle. Fixed size and `Copy`: it crosses the ring from the real-time thread.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct CycleRecord {
    /// Number of the cycle since the run began; without holes.
    pub cycle: u64,
    /// When the encoders were sampled, UTC estimate.
    pub sample_time: UtcNs,
    /// One standard deviation of `sample_time`'s error against the host's UTC \[ns\].
    pub sample_time_uncertainty_ns: u32,
    /// The sampling instant on the bus' clock; 0 without distributed clocks.
    pub dc_time: DcNs,
    /// When the frame was handed to the wire.
    pub send_time: MonoNs,
    /// When its reply was there; equal to `send_time` when none came.
    pub receive_time: MonoNs,
    /// Working counter of the process data datagram.
    pub working_counter: u16,
    /// What it must be for a whole bus.
    pub working_counter_expected: u16,
    /// Reasons, see [`flags`]; 0 for a good cycle.
    pub flags: u32,
    /// Number of the counters' origin in this run: counts of two cycles belong together where it is the same.
    pub origin: u32,
    /// How many of `encoders` are used.
    pub encoder_count: u8,
    /// The encoders, in bus order.
    pub encoders: [EncoderSample; MAX_ENCODERS],
}

impl CycleRecord {
    /// What is known of a cycle whose record was lost: its number, about when it was due, and that it was. Encoders and origin
    /// are those of `near`, a record of the same run.
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

    /// The encoders of this bus, in bus order.
    pub fn encoders(&self) -> &[EncoderSample] {
        &self.encoders[..usize::from(self.encoder_count).min(MAX_ENCODERS)]
    }

    /// Every encoder of the bus gave a fresh, trustworthy count.
    pub fn is_valid(&self) -> bool {
        self.encoder_count > 0 && self.encoders().iter().all(|encoder| encoder.valid)
    }
}

/// What kind of thing happened.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum EventKind {
    /// Set by a person.
    Marker = 1,
    /// Cycles without valid samples.
    Gap = 2,
    /// The state of the bus changed.
    Bus = 3,
    /// A clock was stepped or lost.
    Clock = 4,
    /// The run's file continued in another place.
    Disk = 5,
}

impl EventKind {
    /// From its number in the file.
    pub(super) fn from_u8(number: u8) -> Option<Self> {
        [Self::Marker, Self::Gap, Self::Bus, Self::Clock, Self::Disk]
            .into_iter()
            .find(|kind| *kind as u8 == number)
    }
}

/// Something that happened during a run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Event {
    /// Time of the event, UTC.
    pub time: UtcNs,
    /// Number of the cycle during which it happened.
    pub cycle: u64,
    /// What kind of thing.
    pub kind: EventKind,
    /// Description in words for people.
    pub text: String,
    /// Stable code of what was wrong, as status and log have it; empty for a marker, and in files of older programs.
    pub code: String,
}

/// One encoder of the run: its joint and how its counts become angles.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct EncoderInfo {
    /// Bar joint, 1 to 5.
    pub joint: u8,
    /// Counts to angle; offset and reference mark are 0 where they are not known.
    pub scale: EncoderScale,
}

/// One device on the bus as it identified itself.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DeviceInfo {
    /// Position on the bus, the coupler is 0.
    pub position: u16,
    /// Name from its EEPROM.
    pub name: String,
    /// Number of the EtherCAT vendor.
    pub vendor_id: u32,
    /// Product code of the vendor.
    pub product_code: u32,
    /// Revision number of the device.
    pub revision: u32,
    /// Serial number, 0 where the maker gives none.
    pub serial: u32,
}

impl DeviceInfo {
    /// Revision of Beckhoff's type designation: the upper half of the number.
    pub fn type_revision(&self) -> u16 {
        (self.revision >> 16) as u16
    }
}

/// Names and settings of a run, written into the file before the first cycle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunMetadata {
    /// Name of the run; the file's name without its ending.
    pub name: String,
    /// Person who made the recording.
    pub operator: String,
    /// Name of the measured robot.
    pub robot: String,
    /// Name or serial number of the bar.
    #[serde(default)]
    pub bar: String,
    /// Payload of the robot beside the bar.
    #[serde(default)]
    pub payload: String,
    /// Free text of the operator.
    pub note: String,
    /// Beginning of the run, UTC.
    pub started: UtcNs,
    /// Program and version that wrote it.
    pub software: String,
    /// Network interface, or [`SIMULATED_BUS`].
    pub bus: String,
    /// The recording that a replay played. Files of older programs do not have it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub replay_of: Option<ReplayOrigin>,
    /// Time between two cycles \[ns\].
    pub cycle_period_ns: u64,
    /// Whether the terminals sample on distributed clocks. Without them a sample may be one period old.
    pub distributed_clocks: bool,
    /// `UTC = CLOCK_MONOTONIC + this` for the whole run \[ns\], so that time stamps never run backwards.
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

/// The recording whose counts a replay played on the simulated bus. A replay of a replay has the origin of the first.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct ReplayOrigin {
    /// Name of that run.
    pub name: String,
    /// Beginning of that run.
    pub started: UtcNs,
    /// Network interface that it was recorded from, or [`SIMULATED_BUS`].
    pub bus: String,
}

/// Where the encoder counts of a run come from, for lists and messages.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Provenance {
    /// The encoder counts were simulated.
    #[serde(default)]
    pub simulated: bool,
    /// The recording that a replay played.
    #[serde(default)]
    pub replay_of: Option<ReplayOrigin>,
}

impl Provenance {
    /// Of a run on `bus`. A replay is as its origin.
    pub fn new(bus: &str, replay_of: Option<ReplayOrigin>) -> Self {
        let simulated = replay_of.as_ref().map_or(bus, |origin| &origin.bus) == SIMULATED_BUS;
        Self { simulated, replay_of }
    }

    /// Counts of a real bus, as it gave them.
    pub fn is_measured(&self) -> bool {
        *self == Self::default()
    }
}

/// Such as `SIMULATED, replay of ..`; empty for measured data.
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
    /// Whether the encoder counts were made up by a program. A replay is as its origin; a file of an older program, which
    /// names no origin, is as its bus.
    pub fn is_simulated(&self) -> bool {
        self.provenance().simulated
    }

    /// Where the counts come from.
    pub fn provenance(&self) -> Provenance {
        Provenance::new(&self.bus, self.replay_of.clone())
    }

    /// The origin of a replay of this recording.
    pub fn origin(&self) -> ReplayOrigin {
        let Self { name, started, bus, .. } = self;
        let this = || ReplayOrigin { name: name.clone(), started: *started, bus: bus.clone() };
        self.replay_of.clone().unwrap_or_else(this)
    }
}

/// What a port of a device has counted since the run began.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct PortCounts {
    /// Position of the device on the bus.
    pub position: u8,
    /// Which of its ports: 0 leads to the device before.
    pub port: u8,
    /// Frames with a wrong check sequence.
    pub invalid_frames: u32,
    /// Invalid symbols, inside frames or between them.
    pub receive_errors: u32,
    /// How often the link was lost.
    pub lost_links: u32,
}

impl PortCounts {
    /// Errors of any kind.
    pub fn all(&self) -> u32 {
        self.invalid_frames.saturating_add(self.receive_errors).saturating_add(self.lost_links)
    }
}

/// How a run ended: written after the last cycle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunEnd {
    /// Why it ended, in words.
    pub cause: String,
    /// End of the run, UTC.
    pub ended: UtcNs,
    /// Cycles in the file.
    pub cycles: u64,
    /// Cycles in which every encoder is valid.
    pub cycles_valid: u64,
    /// Cycles that are in the file without their content: [`flags::LOST`].
    pub cycles_lost: u64,
    /// The run was cut short, and this file holds what was whole of it.
    #[serde(default)]
    pub recovered: bool,
    /// How far each encoder turned, in bus order: the widest range of its angle while its counter kept one origin. Empty
    /// where an older program wrote the file \[deg\].
    #[serde(default)]
    pub turned_deg: Vec<f64>,
    /// The first markers. Empty where an older program wrote the file.
    #[serde(default)]
    pub marks: Vec<RunMark>,
    /// The cycles that are not valid, by joint and reason. Empty where an older program wrote the file.
    #[serde(default)]
    pub flagged: Vec<Flagged>,
}

/// The shortest run, and the least travel of each measured joint, that `identify calibrate` uses by default. The recorder
/// grades runs by the same limits.
pub mod required {
    /// Robot log and recording must overlap at least this long \[s\]: a shorter motion matches at more than one place.
    pub const OVERLAP_MIN_S: f64 = 10.0;
    /// A joint with less travel does not separate its encoder's offset from the robot's geometry \[deg\].
    pub const TRAVEL_MIN_DEG: f64 = 3.0;
}
