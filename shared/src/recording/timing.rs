//! Timing of the real-time loop during a run, as histograms of durations.

use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Statistics of one duration over all cycles of a run \[ns\].
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Durations {
    /// Median over all cycles.
    pub p50_ns: u64,
    /// 99th percentile of all cycles.
    pub p99_ns: u64,
    /// 99.9th percentile of all cycles.
    pub p999_ns: u64,
    /// Longest duration of all cycles.
    pub max_ns: u64,
    /// Histogram of the duration, shortest first. Bins without a cycle are left out.
    pub histogram: Vec<Bin>,
}

/// One bin of a histogram. Its durations are longer than the limit of the previous bin, up to `up_to_ns`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Bin {
    /// Upper limit of the bin; included \[ns\].
    pub up_to_ns: u64,
    /// Number of cycles in the bin.
    pub cycles: u64,
}

/// These are the longest waits of the recorder for the disk since the run began.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct DiskTiming {
    /// The longest synchronisation lasted this time, from its beginning until the disk reported its end \[ns\]. A power failure
    /// may lose the cycles of this time and of one synchronisation period.
    pub sync_longest_ns: u64,
    /// The longest write lasted this time, from its beginning until the disk reported its end \[ns\]. A crash of the program may
    /// lose the cycles of this time and of one writing period.
    pub write_longest_ns: u64,
    /// When a write began, the cycles that waited to be written had at most this duration \[ns\].
    pub backlog_longest_ns: u64,
}

/// These times were measured in the cycles of a run until now or until its end. A run on virtual time has no timing.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct TimingSummary {
    /// The times were measured in this number of cycles.
    pub cycles: u64,
    /// The lateness of a cycle is the time from its deadline until its thread ran.
    pub lateness: Durations,
    /// The round trip is the time from sending the frame until its reply arrived. Cycles without a reply are not included.
    pub round_trip: Durations,
    /// The duration of a cycle is the time from the wake-up of its thread until its record was passed to the recorder.
    pub duration: Durations,
    /// The recorder waited for the disk for at most these times.
    #[serde(default)]
    pub disk: DiskTiming,
}

impl Bin {
    /// Upper limit of the bin that contains a duration \[ns\]. The limits are 1, 1.5, 2, 3, 4, 6, 8, 12, ... us; there are
    /// two limits for each factor of two.
    pub fn limit_of(duration_ns: u64) -> u64 {
        let octave_ns = |shift: u32| 1000u64.checked_shl(shift).unwrap_or(u64::MAX);
        // A 64-bit number of ns has about 54 factors of two above one microsecond.
        (0..54)
            .flat_map(|shift| [octave_ns(shift), octave_ns(shift) / 2 * 3])
            .find(|limit_ns| duration_ns <= *limit_ns)
            .unwrap_or(u64::MAX)
    }
}

impl fmt::Display for Durations {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let us = |ns: u64| ns as f64 * 1e-3;
        let Self { p50_ns, p99_ns, p999_ns, max_ns, .. } = *self;
        write!(f, "{:10.1} {:10.1} {:10.1} {:10.1}", us(p50_ns), us(p99_ns), us(p999_ns), us(max_ns))
    }
}

impl fmt::Display for DiskTiming {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let s = |ns: u64| ns as f64 * 1e-9;
        let Self { sync_longest_ns, write_longest_ns, backlog_longest_ns } = *self;
        write!(
            f,
            "disk: longest until safe on disk {:.3} s, longest write {:.3} s, at most {:.3} s of cycles waiting",
            s(sync_longest_ns),
            s(write_longest_ns),
            s(backlog_longest_ns)
        )
    }
}

impl fmt::Display for TimingSummary {
    /// Writes a table of percentiles, then the times of the disk, then the three histograms side by side.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { cycles, lateness, round_trip, duration, disk } = self;
        writeln!(f, "{:15} {:>10} {:>10} {:>10} {:>10}", "time [us]", "p50", "p99", "p99.9", "max")?;
        for (name, durations) in
            [("wake-up late", lateness), ("round trip", round_trip), ("cycle duration", duration)]
        {
            writeln!(f, "{name:15} {durations}")?;
        }
        writeln!(f, "{disk}")?;
        write!(
            f,
            "{:15} {:>14} {:>14} {:>14}  of {cycles} cycles",
            "up to [us]", "wake-up late", "round trip", "duration"
        )?;
        for limit_ns in self.limits_ns() {
            let count = |durations: &Durations| {
                durations.histogram.iter().find(|bin| bin.up_to_ns == limit_ns).map_or(0, |bin| bin.cycles)
            };
            let limit_us = limit_ns as f64 * 1e-3;
            write!(
                f,
                "\n{limit_us:>15} {:>14} {:>14} {:>14}",
                count(lateness),
                count(round_trip),
                count(duration)
            )?;
        }
        Ok(())
    }
}

impl TimingSummary {
    /// Upper limits of all bins that at least one of the three histograms uses, in ascending order.
    fn limits_ns(&self) -> Vec<u64> {
        let all = [&self.lateness, &self.round_trip, &self.duration];
        let mut limits: Vec<u64> = all
            .into_iter()
            .flat_map(|durations| durations.histogram.iter().map(|bin| bin.up_to_ns))
            .collect();
        limits.sort_unstable();
        limits.dedup();
        limits
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bins_are_half_octaves_and_every_duration_has_one() {
        let limits = [0, 1000, 1001, 1500, 1501, 2000, 95_000, u64::MAX].map(Bin::limit_of);
        assert_eq!(limits, [1000, 1000, 1500, 1500, 2000, 2000, 96_000, u64::MAX]);
        let mut last = 0;
        for exponent in 0..64 {
            let limit = Bin::limit_of(1 << exponent);
            assert!(limit >= 1 << exponent && limit >= last);
            last = limit;
        }
    }

    #[test]
    fn the_table_has_a_row_for_each_bin_in_use() {
        let of = |up_to_ns, cycles| Durations {
            max_ns: up_to_ns,
            histogram: vec![Bin { up_to_ns, cycles }],
            ..Durations::default()
        };
        let timing = TimingSummary {
            cycles: 7,
            lateness: of(64_000, 7),
            round_trip: of(96_000, 6),
            duration: of(64_000, 7),
            disk: DiskTiming::default(),
        };
        let text = timing.to_string();
        let rows: Vec<Vec<&str>> =
            text.lines().skip(6).map(|line| line.split_whitespace().collect()).collect();
        assert_eq!(rows, [["64", "7", "0", "7"], ["96", "0", "6", "0"]]);
    }
}
