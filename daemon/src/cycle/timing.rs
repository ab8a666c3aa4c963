//! Lateness and durations of the cycle. The cycle measures three times and writes them to a bounded ring, without waiting.
//! In another thread, the reader of the ring counts them in histograms. The cycle therefore neither writes to memory that
//! other threads read, nor spends time on counting.

use hdrhistogram::Histogram;
use rtrb::{Consumer, Producer, RingBuffer};
use shared::recording::{Bin, DiskTiming, Durations, TimingSummary};

/// Longest duration that has a histogram bin of its own, one minute \[ns\].
const LONGEST_NS: u64 = 60_000_000_000;
const SIGNIFICANT_DIGITS: u8 = 3;

/// Timing of one cycle \[ns\].
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct CycleTiming {
    /// Time from the deadline until the thread ran.
    pub late_ns: i64,
    /// Time from passing the frame to the network interface until the reply was received. `None` without a reply.
    pub round_trip_ns: Option<i64>,
    /// Time from waking up until the record was passed to the sink.
    pub duration_ns: i64,
}

/// The reading end of the ring, with the histograms.
pub struct TimingSource {
    ring: Consumer<CycleTiming>,
    timings: Timings,
}

/// Creates a ring for the timing of `capacity` cycles. If the ring is full, timing is lost, but no cycle is lost.
pub fn timing_ring(capacity: usize) -> (Producer<CycleTiming>, TimingSource) {
    let (producer, consumer) = RingBuffer::new(capacity);
    (producer, TimingSource { ring: consumer, timings: Timings::default() })
}

impl TimingSource {
    /// Takes all timing out of the ring, and counts it in the histograms.
    pub fn drain(&mut self) {
        while let Ok(timing) = self.ring.pop() {
            self.timings.count(&timing);
        }
    }

    /// Summary of all cycles that were counted. `None` before the first cycle.
    pub fn summary(&self) -> Option<TimingSummary> {
        self.timings.summary()
    }
}

/// Histograms of the cycle's times.
#[derive(Debug, Clone)]
pub struct Timings {
    lateness: Histogram<u32>,
    round_trip: Histogram<u32>,
    duration: Histogram<u32>,
}

impl Default for Timings {
    fn default() -> Self {
        // These bounds are constants, and the crate accepts them.
        #[allow(clippy::expect_used, reason = "constant arguments")]
        let empty = Histogram::new_with_bounds(1, LONGEST_NS, SIGNIFICANT_DIGITS).expect("valid bounds");
        Self { lateness: empty.clone(), round_trip: empty.clone(), duration: empty }
    }
}

impl Timings {
    /// Adds the timing of one cycle.
    pub fn count(&mut self, timing: &CycleTiming) {
        let positive = |ns: i64| u64::try_from(ns).unwrap_or(0);
        self.lateness.saturating_record(positive(timing.late_ns));
        self.duration.saturating_record(positive(timing.duration_ns));
        if let Some(round_trip_ns) = timing.round_trip_ns {
            self.round_trip.saturating_record(positive(round_trip_ns));
        }
    }

    /// Percentiles and histograms so far. `None` before the first cycle.
    pub fn summary(&self) -> Option<TimingSummary> {
        (!self.lateness.is_empty()).then(|| TimingSummary {
            cycles: self.lateness.len(),
            lateness: durations(&self.lateness),
            round_trip: durations(&self.round_trip),
            duration: durations(&self.duration),
            disk: DiskTiming::default(),
        })
    }
}

fn durations(counted: &Histogram<u32>) -> Durations {
    Durations {
        p50_ns: counted.value_at_quantile(0.5),
        p99_ns: counted.value_at_quantile(0.99),
        p999_ns: counted.value_at_quantile(0.999),
        max_ns: counted.max(),
        histogram: bins(counted),
    }
}

fn bins(counted: &Histogram<u32>) -> Vec<Bin> {
    let mut bins: Vec<Bin> = Vec::new();
    for step in counted.iter_recorded() {
        let up_to_ns = Bin::limit_of(step.value_iterated_to());
        let cycles = step.count_since_last_iteration();
        match bins.last_mut() {
            Some(bin) if bin.up_to_ns == up_to_ns => bin.cycles += cycles,
            _ => bins.push(Bin { up_to_ns, cycles }),
        }
    }
    bins
}

#[cfg(test)]
mod tests {
    use super::*;

    fn timing(late_ns: i64) -> CycleTiming {
        CycleTiming { late_ns, round_trip_ns: Some(2 * late_ns), duration_ns: 3 * late_ns }
    }

    #[test]
    fn percentiles_are_those_of_what_was_pushed_to_a_part_in_a_thousand() {
        let (mut sink, mut source) = timing_ring(2000);
        assert_eq!(source.summary(), None);
        (1..=1000).for_each(|step| sink.push(timing(step * 1000)).unwrap());
        source.drain();
        let summary = source.summary().unwrap();
        assert_eq!(summary.cycles, 1000);
        let all = [(&summary.lateness, 1.0), (&summary.round_trip, 2.0), (&summary.duration, 3.0)];
        for (durations, factor) in all {
            let found = [durations.p50_ns, durations.p99_ns, durations.p999_ns, durations.max_ns];
            for (found, expected) in found.into_iter().zip([500e3, 990e3, 999e3, 1000e3]) {
                assert!((found as f64 / (factor * expected) - 1.0).abs() < 2e-3, "{durations}");
            }
        }
    }

    #[test]
    fn each_cycle_is_in_one_bin_and_in_the_right_one() {
        let mut timings = Timings::default();
        (1..=1000).for_each(|step| timings.count(&timing(step * 1000)));
        let bins = timings.summary().unwrap().lateness.histogram;
        assert_eq!(bins.iter().map(|bin| bin.cycles).sum::<u64>(), 1000);
        let mut below = 0;
        for bin in bins {
            let up_to = (bin.up_to_ns / 1000).min(1000);
            // The resolution of the histogram is one part in a thousand.
            assert!((bin.cycles as i64 - (up_to - below) as i64).abs() <= 1, "{bin:?}");
            below = up_to;
        }
    }

    #[test]
    fn cycles_without_a_reply_early_and_endless_ones_are_counted() {
        let mut timings = Timings::default();
        timings.count(&CycleTiming { round_trip_ns: None, ..timing(-5) });
        timings.count(&timing(i64::MAX / 4));
        let summary = timings.summary().unwrap();
        assert_eq!(summary.cycles, 2);
        assert!(summary.lateness.max_ns >= LONGEST_NS && summary.lateness.p50_ns == 0);
        assert_eq!(summary.round_trip.histogram.iter().map(|bin| bin.cycles).sum::<u64>(), 1);
    }

    #[test]
    fn a_full_ring_loses_times_without_waiting() {
        let (mut sink, mut source) = timing_ring(4);
        (0..10).for_each(|step| _ = sink.push(timing(step)));
        source.drain();
        assert_eq!(source.summary().unwrap().cycles, 4);
    }
}
