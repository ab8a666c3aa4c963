//! What systemd is told of the service: that it is ready, what it does, and that it lives.

use std::time::Duration;

use sd_notify::NotifyState;
use shared::time::MonoNs;

use crate::control::service::Service;
use crate::control::status::Status;

/// A bus in operation that gave no cycle for as long, also no flagged one, has a thread that hangs.
const CYCLE_AGE_MAX: Duration = Duration::from_secs(10);
/// The watchdog is fed so many times before it would bite.
const FEEDS: u32 = 3;

/// Until the service ends. The watchdog is fed by who answers requests, when the control has just gone round, and while
/// the cycle goes on: one of the three that hangs is enough to be started again. The disk is none of them.
pub async fn tell(service: Service) {
    let feed_every = sd_notify::watchdog_enabled().map(|within| within / FEEDS);
    let (mut statuses, mut fed, mut word) = (service.watch(), None::<MonoNs>, String::new());
    say(&NotifyState::Ready);
    // Each round of the control gives a status.
    while statuses.changed().await.is_ok() {
        let status = statuses.borrow_and_update().clone();
        let headline = status.headline().word;
        if headline != word {
            say(&NotifyState::Status(&headline));
            word = headline;
        }
        let now = service.now();
        let is_over = |every: Duration, at| now.ns_since(at) >= every.as_nanos() as i64;
        let is_due = feed_every.is_some_and(|every| fed.is_none_or(|at| is_over(every, at)));
        if is_due && cycle_lives(&status, now) {
            say(&NotifyState::Watchdog);
            fed = Some(now);
        }
    }
}

/// Also where there is no bus: bringing it up is waited for elsewhere.
fn cycle_lives(status: &Status, now: MonoNs) -> bool {
    status.sampled.0 == 0 || now.ns_since(status.sampled) <= CYCLE_AGE_MAX.as_nanos() as i64
}

/// Nobody listens where no service manager started the program.
fn say(state: &NotifyState<'_>) {
    if let Err(error) = sd_notify::notify(std::slice::from_ref(state)) {
        tracing::warn!("the service manager is not told {state}: {error}");
    }
}

#[cfg(test)]
mod tests {
    use shared::time::NS_PER_S;

    use super::*;

    #[test]
    fn a_bus_in_operation_without_cycles_is_dead_and_one_that_is_not_there_is_not() {
        let sampled = |sampled| Status { sampled, ..Status::default() };
        let now = MonoNs(100 * NS_PER_S);
        assert!(cycle_lives(&sampled(MonoNs(0)), now));
        assert!(cycle_lives(&sampled(now.plus_ns(-9 * NS_PER_S)), now));
        assert!(!cycle_lives(&sampled(now.plus_ns(-11 * NS_PER_S)), now));
    }
}
