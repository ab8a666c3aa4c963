//! Time-outs of the EtherCAT stack, on our clock.
//!
//! ethercrab without `std` takes its timers from embassy-time, which reads the time from one driver per program.
//! This driver returns the clock of the calling thread and keeps the earliest wake-up: the thread that polls is
//! the one that waits. It needs neither a timer thread nor a lock or allocation.

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

/// From now on the time-outs of EtherCAT futures that this thread polls run on `clock`. [`Exchange`](super::Exchange)
/// calls this.
pub fn use_clock(clock: &Clock) {
    CLOCK.with_borrow_mut(|current| current.clone_from(clock));
}

/// The time on the calling thread's clock.
pub(super) fn now() -> MonoNs {
    CLOCK.with_borrow(Clock::now)
}

/// The earliest wake-up of the timers polled since the last call.
pub(super) fn take_earliest_wake() -> Option<MonoNs> {
    // Rounded up: a timer polled a fraction of a tick early would not be ready.
    EARLIEST_WAKE.take().map(|at| MonoNs((at as i64).saturating_add(1).saturating_mul(NS_PER_TICK)))
}
