//! Helpers that tests and benchmarks of the real-time loop share.
#![allow(dead_code, clippy::unwrap_used, reason = "each user takes a part")]

pub mod runs;
pub mod wall;
pub mod world;

use std::collections::HashMap;
use std::process::Command;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use ballbard::bus::BusPlan;
use ballbard::control::status::Status;
use ballbard::segment::simulated::{Conversion, EncoderSource, Signal};
use shared::config::EncoderConfig;
use shared::recording::schema::CycleRecord;

/// Whether the status contains a problem with this code.
pub fn has_problem(status: &Status, code: &str) -> bool {
    status.problems.iter().chain(&status.bad_cables).any(|problem| problem.code() == code)
}

/// Whether the metrics contain a problem with this code, both as a current problem and in the totals.
pub fn is_in_metrics(text: &str, code: &str) -> bool {
    text.contains(&format!("ballbard_problem{{code=\"{code}\""))
        && text.contains(&format!("ballbard_problems_total{{code=\"{code}\"}}"))
}

/// Path of the built `ballbard`.
pub const PROGRAM: &str = env!("CARGO_BIN_EXE_ballbard");

/// A command for the built program that uses no state of the user or the machine, and no service manager.
pub fn ballbard() -> Command {
    isolated(Command::new(PROGRAM))
}

/// Removes or replaces the environment variables through which a command could use state that the test did not create.
pub fn isolated(mut command: Command) -> Command {
    const NOWHERE: &str = "/nonexistent";
    command.env("HOME", NOWHERE).env("STATE_DIRECTORY", NOWHERE);
    for name in ["XDG_STATE_HOME", "NOTIFY_SOCKET", "WATCHDOG_USEC", "JOURNAL_STREAM", "RUST_LOG"] {
        command.env_remove(name);
    }
    command
}

/// Checks that some cycles are valid and that each invalid cycle has a flag. In real time, any number of cycles may be late
/// on a busy machine.
pub fn assert_bad_cycles_have_reasons(cycles: &[CycleRecord]) {
    assert!(cycles.iter().any(CycleRecord::is_valid), "none of {} cycles is valid", cycles.len());
    assert!(cycles.iter().all(|cycle| cycle.is_valid() || cycle.flags != 0), "a bad cycle has no reason");
}

/// A bus of five terminals on distributed clocks. The frame is sent half a period after the sample.
pub fn plan(rate_hz: u64) -> BusPlan {
    let period = Duration::from_nanos(1_000_000_000 / rate_hz);
    BusPlan {
        name: "simulated".into(),
        encoders: (1..=5).map(EncoderConfig::ern_1080).collect(),
        cycle_period: period,
        distributed_clocks: true,
        sync0_shift: period / 2,
        reply_timeout: (period * 4 / 10).min(Duration::from_millis(4)),
    }
}

/// Conversions of the first terminal with their true instants, collected by a [`Watched`] source.
#[derive(Debug, Clone, Default)]
pub struct TrueInstants(Arc<Mutex<Vec<Conversion>>>);

/// An encoder source that returns the signals of `source` and stores the conversions of the first terminal.
pub struct Watched<S> {
    source: S,
    instants: TrueInstants,
}

/// Error of the sample time of a record, and the standard uncertainty that the record states \[ns\].
#[derive(Debug, Clone, Copy)]
pub struct Stamped {
    pub cycle: u64,
    pub error_ns: i64,
    pub sigma_ns: i64,
}

impl TrueInstants {
    /// Wraps a source. Returns the wrapper, and the instants that it will store. Memory for `conversions` entries is
    /// reserved, so that storing an entry allocates nothing.
    pub fn watch<S: EncoderSource>(source: S, conversions: usize) -> (Watched<S>, Self) {
        let instants = Self(Arc::new(Mutex::new(Vec::with_capacity(conversions))));
        (Watched { source, instants: instants.clone() }, instants)
    }

    /// Compares the sample times of valid records with the true instants. The terminals sample on distributed clocks.
    /// `utc_minus_true_ns` is the UTC of the records minus the true time \[ns\].
    pub fn judge(&self, records: &[CycleRecord], utc_minus_true_ns: i64) -> Vec<Stamped> {
        let instants = self.0.lock().unwrap();
        let true_ns: HashMap<i64, i64> =
            instants.iter().filter_map(|at| Some((at.system_time_ns?, at.true_time_ns))).collect();
        let stamped = |record: &CycleRecord| {
            let true_ns = true_ns.get(&record.dc_time.0)?;
            Some(stamped(record, record.sample_time.0 - utc_minus_true_ns - true_ns))
        };
        records.iter().filter(|record| record.is_valid()).filter_map(stamped).collect()
    }

    /// Compares the sample times of valid records with the true instants, without distributed clocks. A frame then returns
    /// the last sample that was taken before the frame was sent.
    pub fn judge_free_running(&self, records: &[CycleRecord], utc_minus_true_ns: i64) -> Vec<Stamped> {
        let instants = self.0.lock().unwrap();
        let judge = |record: &CycleRecord| {
            let later = instants.partition_point(|at| at.true_time_ns < record.send_time.0);
            let sampled = instants.get(later.checked_sub(1)?)?;
            Some(stamped(record, record.sample_time.0 - utc_minus_true_ns - sampled.true_time_ns))
        };
        records.iter().filter(|record| record.is_valid()).filter_map(judge).collect()
    }
}

fn stamped(record: &CycleRecord, error_ns: i64) -> Stamped {
    Stamped { cycle: record.cycle, error_ns, sigma_ns: record.sample_time_uncertainty_ns.into() }
}

impl<S: EncoderSource> EncoderSource for Watched<S> {
    fn signal(&mut self, channel: usize, at: Conversion) -> Signal {
        if channel == 0 {
            let mut instants = self.instants.0.lock().unwrap();
            if instants.len() < instants.capacity() {
                instants.push(at);
            }
        }
        self.source.signal(channel, at)
    }
}
