//! Time-outs of the EtherCAT stack, measured on the clock of this program.
//!
//! Without `std`, ethercrab uses the timers of embassy-time, which read the time from one driver for the whole program. This
//! driver returns the time on the clock of the calling thread, and stores the earliest wake-up. The thread that polls a
//! future also waits for its timers. Therefore no timer thread, no lock and no allocation is needed.

use std::cell::{Cell, RefCell};
use std::task::Waker;

use embassy_time_driver::{Driver, TICK_HZ};
use shared::time::{MonoNs, NS_PER_S};

use crate::clock::Clock;

const NS_PER_TICK: i64 = NS_PER_S / TICK_HZ as i64;

thread_local! {
    static CLOCK: RefCell<Clock> = const { RefCell::new(Clock::Real) };
    static EARLIEST_WAKE: Cell<Option<u64>> = const { Cell::new(None) };
}

struct ThreadClock;

impl Driver for ThreadClock {
    fn now(&self) -> u64 {
        CLOCK.with_borrow(|clock| (clock.now().0 / NS_PER_TICK).max(0) as u64)
    }

    fn schedule_wake(&self, at: u64, _waker: &Waker) {
        EARLIEST_WAKE.set(Some(EARLIEST_WAKE.get().map_or(at, |earliest| earliest.min(at))));
    }
}

embassy_time_driver::time_driver_impl!(static DRIVER: ThreadClock = ThreadClock);

/// Sets the clock for the time-outs of the EtherCAT futures that this thread polls. Called by [`Exchange`](super::Exchange).
pub fn use_clock(clock: &Clock) {
    CLOCK.with_borrow_mut(|current| current.clone_from(clock));
}

/// Current time on the clock of the calling thread.
pub(super) fn now() -> MonoNs {
    CLOCK.with_borrow(Clock::now)
}

/// Returns the earliest wake-up of all timers that were polled since the last call.
pub(super) fn take_earliest_wake() -> Option<MonoNs> {
    // The time is rounded up, because a timer that is polled a fraction of a tick too early is not ready.
    EARLIEST_WAKE.take().map(|at| MonoNs((at as i64).saturating_add(1).saturating_mul(NS_PER_TICK)))
}
