//! `config/daemon.toml`: the cycle of the bus and the directories of recordings.

use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};

use super::{Kind, Validate, Violation};

/// Scheduling of the thread that runs the bus cycle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RealtimeConfig {
    /// CPU core on which the thread runs alone. The core must be isolated on the kernel's command line. If absent, the
    /// thread may run on any core.
    pub core: Option<usize>,
    /// Priority under SCHED_FIFO, 1 to 99.
    pub fifo_priority: i32,
}

/// Configuration of the acquisition daemon.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DaemonConfig {
    /// Cycles per second \[Hz\]. At least 10: at a lower rate a terminal times out before its first SYNC0.
    pub rate_hz: u32,
    /// Whether encoders are sampled on SYNC0 of the distributed clocks. If so, all encoders are sampled at the same instant,
    /// and this instant is known to microseconds.
    pub distributed_clocks: bool,
    /// How long to wait for the reply to a cyclic frame \[us\]. If absent, the time is 4/10 of a cycle, at most 4 ms.
    pub reply_timeout_us: Option<u32>,
    /// Capacity of the ring buffer between bus and disk, as time \[s\]. If the disk blocks for longer, cycles are lost. See
    /// [`DaemonConfig::ring_cycles`].
    pub ring_s: u32,
    /// How often the recording is written and synchronised to disk \[ms\]. If the program is killed, at most the
    /// cycles of one period are lost, plus the cycles of the time for which the disk delays a write. A power cut loses
    /// all cycles that are not synchronised yet. The value is at least 100, because cycles wait up to 20 ms in the
    /// ring before they are written.
    pub sync_period_ms: u32,
    /// Free space that recordings leave on their file system \[MB\]. With less free space, no run starts,
    /// and the current run ends.
    #[serde(default = "default_disk_floor_mb")]
    pub disk_floor_mb: u32,
    /// A run ends if no encoder delivers a valid sample for this time \[s\]. The file of the run is then completed as usual.
    #[serde(default = "default_full_fault_s")]
    pub full_fault_s: u32,
    /// Port of the service on 127.0.0.1.
    #[serde(default = "default_port")]
    pub port: u16,
    /// Directory of the recordings. A relative path is relative to the working directory.
    pub directory: PathBuf,
    /// Directory in which a run continues if its own directory or disk is lost or refuses writes. It
    /// should be on another disk.
    #[serde(default = "default_spare_directory")]
    pub spare_directory: PathBuf,
    /// Scheduling of the thread that runs the bus cycle.
    pub realtime: RealtimeConfig,
}

/// Minimum capacity of the ring \[cycles\]. On a bus with a low rate, `ring_s` seconds could otherwise be too few cycles.
const RING_CYCLES_MIN: usize = 64;

const fn default_disk_floor_mb() -> u32 {
    500
}

const fn default_full_fault_s() -> u32 {
    60
}

const fn default_port() -> u16 {
    7311
}

/// The default of `spare_directory`. Its files survive a restart of the machine, and all users may write there.
fn default_spare_directory() -> PathBuf {
    "/var/tmp/ballbard".into()
}

impl DaemonConfig {
    /// The two directories that may contain recordings: `directory` and `spare_directory`.
    pub fn directories(&self) -> [PathBuf; 2] {
        [&self.directory, &self.spare_directory].map(PathBuf::clone)
    }

    /// Time from one cycle to the next.
    pub fn cycle_period(&self) -> Duration {
        Duration::from_nanos(1_000_000_000 / u64::from(self.rate_hz.max(1)))
    }

    /// How often the recording is written and synchronised to disk.
    pub fn sync_period(&self) -> Duration {
        Duration::from_millis(self.sync_period_ms.into())
    }

    /// How long to wait for the reply to a cyclic frame.
    pub fn reply_timeout(&self) -> Duration {
        let usual = || (self.cycle_period() * 4 / 10).min(Duration::from_millis(4));
        self.reply_timeout_us.map_or_else(usual, |timeout_us| Duration::from_micros(timeout_us.into()))
    }

    /// Capacity of the ring between bus and disk \[cycles\], at this cycle period.
    pub fn ring_cycles(&self, cycle_period: Duration) -> usize {
        let cycles = u128::from(self.ring_s) * 1_000_000_000 / cycle_period.as_nanos().max(1);
        usize::try_from(cycles).unwrap_or(usize::MAX).max(RING_CYCLES_MIN)
    }
}

impl Default for DaemonConfig {
    fn default() -> Self {
        Self {
            rate_hz: 100,
            distributed_clocks: true,
            reply_timeout_us: None,
            ring_s: 60,
            sync_period_ms: 1000,
            disk_floor_mb: default_disk_floor_mb(),
            full_fault_s: default_full_fault_s(),
            port: default_port(),
            directory: "runs".into(),
            spare_directory: default_spare_directory(),
            realtime: RealtimeConfig { core: None, fifo_priority: 80 },
        }
    }
}

impl Validate for DaemonConfig {
    const KIND: Option<Kind> = Some(Kind::Daemon);

    fn validate(&self) -> Result<(), Violation> {
        let period_us = 1_000_000 / self.rate_hz.max(1);
        let reply_us_max = i64::from(period_us) * 9 / 10;
        let ranges = [
            ("rate_hz", i64::from(self.rate_hz), [10, 1000], "100 is usual; an EL5021 on DC does 10 to 1000"),
            (
                "reply_timeout_us",
                self.reply_timeout().as_micros() as i64,
                [50, reply_us_max],
                "a reply that takes longer than a cycle is of no use; stay below 9/10 of the period",
            ),
            ("ring_s", i64::from(self.ring_s), [1, 3600], "60 s survive any ordinary disk"),
            ("sync_period_ms", i64::from(self.sync_period_ms), [100, 10_000], "1000 is usual"),
            ("full_fault_s", i64::from(self.full_fault_s), [1, 86_400], "60 s are enough to plug in a cable"),
            ("realtime.fifo_priority", i64::from(self.realtime.fifo_priority), [1, 99], "80 is usual"),
        ];
        for (key, value, range, remedy) in ranges {
            Violation::unless_within(key, value, range, remedy)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn any_rate_up_to_1_khz_is_valid_by_itself_and_its_ring_holds_a_minute() {
        for rate_hz in [10, 30, 100, 250, 333, 1000] {
            let config = DaemonConfig { rate_hz, ..DaemonConfig::default() };
            assert_eq!(config.validate(), Ok(()), "{rate_hz} Hz");
            assert!(config.reply_timeout() < config.cycle_period() / 2);
            assert!(config.ring_cycles(config.cycle_period()) >= 60 * rate_hz as usize);
        }
        for rate_hz in [0, 3, 9, 1001] {
            assert!(DaemonConfig { rate_hz, ..DaemonConfig::default() }.validate().is_err());
        }
    }

    #[test]
    fn the_shipped_file_has_the_defaults() {
        let file = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/daemon.toml");
        assert_eq!(super::super::load::<DaemonConfig>(&file).unwrap(), DaemonConfig::default());
    }

    #[test]
    fn a_loss_that_the_recorder_cannot_keep_is_not_promised() {
        let config = |sync_period_ms| DaemonConfig { sync_period_ms, ..DaemonConfig::default() };
        assert!(config(99).validate().is_err());
        assert_eq!(config(100).validate(), Ok(()));
    }

    #[test]
    fn a_time_out_that_reaches_into_the_next_cycle_is_refused() {
        let config = DaemonConfig { rate_hz: 1000, reply_timeout_us: Some(4000), ..DaemonConfig::default() };
        assert!(config.validate().is_err());
    }
}
