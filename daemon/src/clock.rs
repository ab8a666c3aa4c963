//! The clock, as a value that is passed to all code that needs the time. The same code runs in real time, or in virtual time
//! in tests and replays. Virtual time advances as fast as the machine allows.

use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};

use nix::errno::Errno;
use nix::sys::time::TimeSpec;
use nix::time::{ClockId, ClockNanosleepFlags, clock_gettime, clock_nanosleep};
use shared::time::{MonoNs, NS_PER_S, UtcNs};

/// A monotonic clock and its offset to UTC.
#[derive(Debug, Clone)]
pub enum Clock {
    /// Real time: `CLOCK_MONOTONIC` and the host's UTC.
    Real,
    /// Virtual time. It advances only when a thread sleeps on this clock or a frame crosses the simulated wire.
    Virtual {
        /// Virtual monotonic time \[ns\].
        now_ns: Arc<AtomicI64>,
        /// `UTC - monotonic` \[ns\]. It is constant except for [`Clock::step_utc`].
        utc_minus_monotonic_ns: Arc<AtomicI64>,
    },
}

impl Clock {
    /// A virtual clock that starts at `utc`.
    pub fn virtual_from(utc: UtcNs) -> Self {
        // The start is not zero, so that a missing time stamp cannot be mistaken for the start.
        let start_ns = NS_PER_S;
        Self::Virtual {
            now_ns: Arc::new(AtomicI64::new(start_ns)),
            utc_minus_monotonic_ns: Arc::new(AtomicI64::new(utc.0 - start_ns)),
        }
    }

    /// Whether the clock runs in real time.
    pub const fn is_real(&self) -> bool {
        matches!(self, Self::Real)
    }

    /// Current monotonic time. Steps of UTC have no effect on it.
    pub fn now(&self) -> MonoNs {
        match self {
            Self::Real => MonoNs(read_ns(ClockId::CLOCK_MONOTONIC)),
            Self::Virtual { now_ns, .. } => MonoNs(now_ns.load(Ordering::Acquire)),
        }
    }

    /// Sleeps until `deadline`. Returns at once if `deadline` has passed. Because the deadline is absolute,
    /// delays do not add up.
    pub fn sleep_until(&self, deadline: MonoNs) {
        match self {
            Self::Real => {
                let wake_up = TimeSpec::new(deadline.0.div_euclid(NS_PER_S), deadline.0.rem_euclid(NS_PER_S));
                let absolute = ClockNanosleepFlags::TIMER_ABSTIME;
                while clock_nanosleep(ClockId::CLOCK_MONOTONIC, absolute, &wake_up) == Err(Errno::EINTR) {}
            }
            Self::Virtual { now_ns, .. } => {
                now_ns.fetch_max(deadline.0, Ordering::AcqRel);
            }
        }
    }

    /// Current difference `UTC - monotonic` \[ns\]. In real time, several readings are made, and the reading that took the
    /// least time is used.
    pub fn utc_minus_monotonic_ns(&self) -> i64 {
        match self {
            Self::Real => {
                (0..9).map(|_| bracketed_pair()).min().map_or(0, |(_, difference_ns)| difference_ns)
            }
            Self::Virtual { utc_minus_monotonic_ns, .. } => utc_minus_monotonic_ns.load(Ordering::Acquire),
        }
    }

    /// Steps the UTC of virtual time, as NTP or a person may step the UTC of a host. No effect in real time.
    pub fn step_utc(&self, by_ns: i64) {
        if let Self::Virtual { utc_minus_monotonic_ns, .. } = self {
            utc_minus_monotonic_ns.fetch_add(by_ns, Ordering::AcqRel);
        }
    }
}

/// Reads UTC between two readings of the monotonic clock. Returns the time between these two readings, and the difference
/// `UTC - monotonic` in the middle of this time \[ns\].
fn bracketed_pair() -> (i64, i64) {
    let before_ns = read_ns(ClockId::CLOCK_MONOTONIC);
    let utc_ns = read_ns(ClockId::CLOCK_REALTIME);
    let after_ns = read_ns(ClockId::CLOCK_MONOTONIC);
    let width_ns = after_ns - before_ns;
    (width_ns, utc_ns - before_ns - width_ns / 2)
}

fn read_ns(clock: ClockId) -> i64 {
    // Every Linux has these two clocks. On a kernel without them, the process could not have started.
    clock_gettime(clock).map_or(0, |time| time.tv_sec() * NS_PER_S + time.tv_nsec())
}
