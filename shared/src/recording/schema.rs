//! What a recording says of each bus cycle, and the ros2msg text that tells it to other readers.

use crate::time::{DcNs, MonoNs, UtcNs};

/// Most encoders that a bar has: three of the gimbal, two of the cardan.
pub const MAX_ENCODERS: usize = 5;

/// What one encoder's terminal gave in one cycle.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct EncoderSample {
    /// Bar joint that the encoder sits on, 1 to 5.
    pub joint: u8,
    /// 32-bit counter as the terminal gave it, wrapping.
    pub count: u32,
    /// Counter at the last reference mark (C), meaningful when the status says so.
    pub latch: u32,
    /// Status word of the terminal's TxPDO, raw.
    pub status: u16,
    /// The count is fresh, in operation and free of terminal errors.
    pub valid: bool,
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
    /// The cycle was lost between bus and file (ring overflow); only its number is known.
    pub const LOST: u32 = 1 << 8;
    /// Counters may have a new origin since the cycle before.
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
    /// How many of `encoders` are used.
    pub encoder_count: u8,
    /// The encoders, in bus order.
    pub encoders: [EncoderSample; MAX_ENCODERS],
}

impl CycleRecord {
    /// The encoders of this bus, in bus order.
    pub fn encoders(&self) -> &[EncoderSample] {
        &self.encoders[..usize::from(self.encoder_count).min(MAX_ENCODERS)]
    }

    /// Every encoder of the bus gave a fresh, trustworthy count.
    pub fn is_valid(&self) -> bool {
        self.encoder_count > 0 && self.encoders().iter().all(|encoder| encoder.valid)
    }
}
