//! Plays recorded counts back, one row a bus cycle.

use std::sync::Arc;
use std::sync::atomic::{AtomicI64, AtomicUsize, Ordering};

use super::{Conversion, EncoderSource, Signal};

/// Why a table of counts cannot be replayed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum ReplayError {
    /// No channel, no row, or a torn last row.
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
    /// Rows must be apart.
    #[error("a replay needs a positive cycle time, not {0} ns; check the recording's cycle time")]
    Period(i64),
}

/// Start time while there is none.
const NOT_STARTED: i64 = i64::MAX;

#[derive(Debug)]
struct Shared {
    start_ns: AtomicI64,
    /// Per channel, how many rows lie behind: the last row that was played, plus one.
    played: Vec<AtomicUsize>,
    rows: usize,
}

/// Recorded counts as an encoder source.
///
/// The row is chosen by the nominal SYNC0 time, so each cycle plays exactly one row whatever the clocks of the
/// devices do. Terminals that follow frames choose by true time instead.
#[derive(Debug)]
pub struct Replay {
    counts: Vec<u32>,
    channels: usize,
    period_ns: i64,
    shared: Arc<Shared>,
}

/// Starts a replay and asks how far it is, from wherever the bus is run.
#[derive(Debug, Clone)]
pub struct ReplayHandle(Arc<Shared>);

impl Replay {
    /// Plays `counts`, rows of `channels` counts each, one row every `period_ns`. Shows the first row until it is
    /// started through the handle.
    ///
    /// # Errors
    /// If the counts do not make at least one row and whole rows, or the period is not positive.
    pub fn new(
        counts: Vec<u32>,
        channels: usize,
        period_ns: i64,
    ) -> Result<(Self, ReplayHandle), ReplayError> {
        if counts.is_empty() || channels == 0 || !counts.len().is_multiple_of(channels) {
            return Err(ReplayError::Shape { counts: counts.len(), channels });
        }
        if period_ns <= 0 {
            return Err(ReplayError::Period(period_ns));
        }
        let shared = Arc::new(Shared {
            start_ns: AtomicI64::new(NOT_STARTED),
            played: (0..channels).map(|_| AtomicUsize::new(0)).collect(),
            rows: counts.len() / channels,
        });
        let handle = ReplayHandle(Arc::clone(&shared));
        Ok((Self { counts, channels, period_ns, shared }, handle))
    }

    /// Row at a moment, and whether the replay is under way.
    fn row(&self, at: Conversion) -> (usize, bool) {
        let start_ns = self.shared.start_ns.load(Ordering::Acquire);
        let now_ns = at.system_time_ns.unwrap_or(at.true_time_ns);
        let since_ns = now_ns.saturating_sub(start_ns).saturating_add(self.period_ns / 2);
        if start_ns == NOT_STARTED || since_ns < 0 {
            return (0, false);
        }
        let row = usize::try_from(since_ns / self.period_ns).unwrap_or(usize::MAX);
        (row.min(self.shared.rows - 1), true)
    }
}

impl EncoderSource for Replay {
    fn signal(&mut self, channel: usize, at: Conversion) -> Signal {
        let (row, under_way) = self.row(at);
        if let (true, Some(played)) = (under_way, self.shared.played.get(channel)) {
            played.fetch_max(row + 1, Ordering::AcqRel);
        }
        // A terminal beyond the recorded ones shows nothing.
        let recorded = (channel < self.channels).then(|| self.counts.get(row * self.channels + channel));
        Signal::Recorded { count: recorded.flatten().copied().unwrap_or(0) }
    }
}

impl ReplayHandle {
    /// The conversion nearest to this moment plays the first row. On a bus with distributed clocks the time is
    /// the system time of the bus, best that of a SYNC0 pulse to come; without, it is the simulation's time.
    pub fn start_at(&self, time_ns: i64) {
        for played in &self.0.played {
            played.store(0, Ordering::Release);
        }
        self.0.start_ns.store(time_ns, Ordering::Release);
    }

    /// Rows in the recording.
    pub fn rows(&self) -> usize {
        self.0.rows
    }

    /// Rows that every terminal has behind it.
    pub fn rows_played(&self) -> usize {
        self.0.played.iter().map(|played| played.load(Ordering::Acquire)).min().unwrap_or(0)
    }

    /// Whether every terminal has shown the last row.
    pub fn has_ended(&self) -> bool {
        self.rows_played() == self.0.rows
    }
}
