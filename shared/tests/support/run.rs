//! A generated run that all tests use.

use shared::encoder::EncoderScale;
use shared::recording::schema::{
    CycleRecord, DeviceInfo, EncoderInfo, EncoderSample, MAX_ENCODERS, RunMetadata, flags,
};
use shared::recording::{Bin, DiskTiming, Durations, TimingSummary};
use shared::time::{DcNs, MonoNs, UtcNs};

/// Start of the generated run (UTC).
pub const START: UtcNs = UtcNs(1_790_000_000_000_000_000);

/// Metadata of a generated run with this name.
pub fn run(name: &str) -> RunMetadata {
    RunMetadata {
        name: name.into(),
        operator: "technician".into(),
        robot: "irb2400_16".into(),
        bar: String::new(),
        payload: String::new(),
        note: "first run, ümlaut".into(),
        started: START,
        software: "test".into(),
        bus: "simulated".into(),
        replay_of: None,
        cycle_period_ns: 10_000_000,
        distributed_clocks: true,
        utc_minus_monotonic_ns: 42,
        encoders: (1..=MAX_ENCODERS as u8)
            .map(|joint| EncoderInfo { joint, scale: EncoderScale::default() })
            .collect(),
        devices: vec![DeviceInfo {
            position: 0,
            name: "EK1100".into(),
            vendor_id: 2,
            product_code: 0x044c_2c52,
            revision: 0x0012_0000,
            serial: 0,
        }],
        daemon_config: String::new(),
        ball_bar_config: String::new(),
    }
}

/// Timing statistics of the generated run.
#[allow(dead_code, reason = "not every user needs it")]
pub fn timing() -> TimingSummary {
    let durations = |ns: u64| Durations {
        p50_ns: ns,
        p99_ns: 2 * ns,
        p999_ns: 3 * ns,
        max_ns: 4 * ns,
        histogram: vec![Bin { up_to_ns: 48_000, cycles: 9 }, Bin { up_to_ns: u64::MAX, cycles: 1 }],
    };
    let (lateness, round_trip, duration) = (durations(40_000), durations(43_000), durations(66_000));
    let disk = DiskTiming { sync_longest_ns: 30_000_000, ..DiskTiming::default() };
    TimingSummary { cycles: 10, lateness, round_trip, duration, disk }
}

/// The generated cycle with this number. All cycles differ.
pub fn cycle(number: u64) -> CycleRecord {
    let encoders = std::array::from_fn(|index| EncoderSample {
        joint: index as u8 + 1,
        count: (number as u32).wrapping_mul(1_000_003).wrapping_add(index as u32),
        latch: 7,
        status: if number.is_multiple_of(2) { 0x8000 } else { 0 },
        valid: number % 17 != 5,
    });
    let time_ns = number as i64 * 10_000_000;
    CycleRecord {
        cycle: number,
        sample_time: START.plus_ns(time_ns),
        sample_time_uncertainty_ns: 1500,
        dc_time: DcNs(1_000 + time_ns),
        send_time: MonoNs(5_000 + time_ns),
        receive_time: MonoNs(65_000 + time_ns),
        working_counter: 15,
        working_counter_expected: 15,
        flags: if number % 17 == 5 { flags::STALE_INPUT } else { 0 },
        origin: 3,
        encoder_count: MAX_ENCODERS as u8,
        encoders,
    }
}
