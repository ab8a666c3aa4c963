//! Plays recorded counts. A *row* contains one count for each terminal. One row is played per bus cycle. If a row has no
//! valid count of a terminal, its input has no signal in this cycle, so that the terminal reports an amplitude error.

use std::sync::Arc;
use std::sync::atomic::{AtomicI64, AtomicUsize, Ordering};

use super::{Conversion, EncoderSource, Signal};

/// Why a table of counts cannot be replayed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum ReplayError {
    /// The table is empty, has no channels, or its last row is incomplete.
    #[error(
        "a replay needs whole rows of counts: {counts} counts do not make rows of {channels} channels; \
         check that the recording has samples of every encoder"
    )]
    Shape {
        /// Counts in the table.
        counts: usize,
        /// Counts in a row.
        channels: usize,
    },
    /// The period must be positive.
    #[error("a replay needs a positive cycle time, not {0} ns; check the recording's cycle time")]
    Period(i64),
}

/// Value of the start time while the replay is not started.
const NOT_STARTED: i64 = i64::MAX;
/// Value of the start time if the replay must start at the next conversion.
const AT_NEXT: i64 = i64::MIN;

#[derive(Debug)]
struct ReplayState {
    start_ns: AtomicI64,
    /// Number of rows that each channel has played.
    played: Vec<AtomicUsize>,
    rows: usize,
}

/// An encoder source that plays recorded counts.
///
/// The nominal time of the SYNC0 pulse selects the row. Each cycle therefore plays exactly one row, even if the clocks of
/// the devices have different rates. If the clock of the bus is set during the replay, the true time of a pulse changes
/// relative to its nominal time. Counts are then interpolated between two rows. A terminal without SYNC0 plays the row that
/// is nearest in true time.
#[derive(Debug)]
pub struct Replay {
    counts: Vec<Option<u32>>,
    channels: usize,
    period_ns: i64,
    /// Timing of the SYNC0 pulses, for each channel.
    pulses: Vec<PulseTiming>,
    shared: Arc<ReplayState>,
}

/// True time of SYNC0 pulses relative to their nominal time.
#[derive(Debug, Clone, Copy, Default)]
struct PulseTiming {
    /// True minus nominal time of the last pulse \[ns\].
    true_minus_nominal_ns: Option<i64>,
    /// Sum of the large changes of `true_minus_nominal_ns` \[ns\]. A change larger than drift can explain means that the
    /// clock of the bus was set.
    delay_ns: i64,
}

impl PulseTiming {
    /// Largest change that drift can cause between two pulses \[ns\]. After a larger change, the clock of the bus was set.
    const SET_NS: i64 = 20_000;

    /// Updates the timing with the next pulse.
    fn next(&mut self, true_minus_nominal_ns: i64) {
        let change_ns = self.true_minus_nominal_ns.map_or(0, |before_ns| true_minus_nominal_ns - before_ns);
        if change_ns.abs() > Self::SET_NS {
            self.delay_ns += change_ns;
        }
        self.true_minus_nominal_ns = Some(true_minus_nominal_ns);
    }
}

/// Starts a replay and reads its progress, from any thread.
#[derive(Debug, Clone)]
pub struct ReplayHandle(Arc<ReplayState>);

impl Replay {
    /// Plays `counts`, which consist of rows of `channels` counts each. A count is `None` if the recorded one is not valid.
    /// Every `period_ns`, the next row is played. Until the handle starts the replay, the first row is played.
    ///
    /// # Errors
    /// If the counts are not at least one complete row, or the period is not positive.
    pub fn new(
        counts: Vec<Option<u32>>,
        channels: usize,
        period_ns: i64,
    ) -> Result<(Self, ReplayHandle), ReplayError> {
        if counts.is_empty() || channels == 0 || !counts.len().is_multiple_of(channels) {
            return Err(ReplayError::Shape { counts: counts.len(), channels });
        }
        if period_ns <= 0 {
            return Err(ReplayError::Period(period_ns));
        }
        let shared = Arc::new(ReplayState {
            start_ns: AtomicI64::new(NOT_STARTED),
            played: (0..channels).map(|_| AtomicUsize::new(0)).collect(),
            rows: counts.len() / channels,
        });
        let handle = ReplayHandle(Arc::clone(&shared));
        let pulses = vec![PulseTiming::default(); channels];
        Ok((Self { counts, channels, period_ns, pulses, shared }, handle))
    }

    /// Index of the row at a conversion. `None` before the replay starts.
    fn row(&self, at: Conversion) -> Option<usize> {
        let now_ns = at.system_time_ns.unwrap_or(at.true_time_ns);
        let mut start_ns = self.shared.start_ns.load(Ordering::Acquire);
        if start_ns == AT_NEXT {
            start_ns = now_ns;
            self.shared.start_ns.store(now_ns, Ordering::Release);
        }
        let since_ns = now_ns.saturating_sub(start_ns).saturating_add(self.period_ns / 2);
        if start_ns == NOT_STARTED || since_ns < 0 {
            return None;
        }
        let row = usize::try_from(since_ns / self.period_ns).unwrap_or(usize::MAX);
        Some(row.min(self.shared.rows - 1))
    }

    /// Count of a channel at the time `after_ns` after the time of a row, by linear interpolation. `None` without a valid
    /// count, and for a terminal that is not in the recording.
    fn count(&self, channel: usize, row: usize, after_ns: i64) -> Option<u32> {
        let last = self.shared.rows - 1;
        let recorded = |row: usize| {
            let counts_of_row = self.counts.get(row * self.channels..)?.get(..self.channels)?;
            counts_of_row.get(channel).copied().flatten()
        };
        let rows_later =
            usize::try_from(after_ns.div_euclid(self.period_ns).unsigned_abs()).unwrap_or(usize::MAX);
        let row = if after_ns < 0 { row.saturating_sub(rows_later) } else { row.saturating_add(rows_later) };
        let row = row.min(last);
        let before = recorded(row)?;
        let part_ns = after_ns.rem_euclid(self.period_ns);
        if part_ns == 0 || row == last {
            return Some(before);
        }
        // Counters wrap, so the difference is taken as a signed number.
        let step = f64::from(recorded(row + 1)?.wrapping_sub(before) as i32);
        let part = part_ns as f64 / self.period_ns as f64;
        Some(before.wrapping_add((step * part).round() as i64 as u32))
    }
}

impl EncoderSource for Replay {
    fn signal(&mut self, channel: usize, at: Conversion) -> Signal {
        let row_now = self.row(at);
        if let (Some(row), Some(played)) = (row_now, self.shared.played.get(channel)) {
            played.fetch_max(row + 1, Ordering::AcqRel);
        }
        let pulses = self.pulses.get_mut(channel).filter(|_| row_now.is_some());
        let delay_ns = match (pulses, at.system_time_ns) {
            (Some(pulses), Some(nominal_ns)) => {
                pulses.next(at.true_time_ns.saturating_sub(nominal_ns));
                pulses.delay_ns
            }
            _ => 0,
        };
        self.count(channel, row_now.unwrap_or_default(), delay_ns)
            .map_or(Signal::NOT_CONNECTED, |count| Signal::Recorded { count })
    }
}

impl ReplayHandle {
    /// Sets the start of the replay: the conversion nearest to `time_ns` plays the first row. On a bus with distributed
    /// clocks, `time_ns` is a system time of the bus, preferably that of a future SYNC0 pulse. On other buses it is a true
    /// time of the simulation.
    pub fn start_at(&self, time_ns: i64) {
        for played in &self.0.played {
            played.store(0, Ordering::Release);
        }
        self.0.start_ns.store(time_ns, Ordering::Release);
    }

    /// Starts the replay at the next conversion, which plays the first row.
    pub fn start_at_next(&self) {
        self.start_at(AT_NEXT);
    }

    /// Number of rows in the recording.
    pub fn rows(&self) -> usize {
        self.0.rows
    }

    /// Number of rows that all terminals have played.
    pub fn rows_played(&self) -> usize {
        self.0.played.iter().map(|played| played.load(Ordering::Acquire)).min().unwrap_or(0)
    }

    /// Whether all terminals have played the last row.
    pub fn has_ended(&self) -> bool {
        self.rows_played() == self.0.rows
    }
}
