//! Notifications to systemd: readiness, state and watchdog.

use std::time::Duration;

use sd_notify::NotifyState;
use shared::time::MonoNs;

use crate::control::service::Service;
use crate::control::status::Status;

/// Largest age of the last cycle, valid or not. If the last cycle is older although the bus is in
/// operation, the cycle thread hangs.
const CYCLE_AGE_MAX: Duration = Duration::from_secs(10);
/// Number of watchdog notifications within the time limit of the watchdog.
const NOTIFICATIONS: u32 = 3;

/// Notifies systemd until the service ends. A watchdog notification is sent only while three threads are
/// alive: this thread, the control thread and the cycle thread. If one of them hangs, systemd restarts
/// the service. A disk that hangs does not cause a restart.
pub async fn notify(service: Service) {
    let period = sd_notify::watchdog_enabled().map(|within| within / NOTIFICATIONS);
    let (mut statuses, mut notified_at, mut sent_headline) = (service.watch(), None::<MonoNs>, String::new());
    send(&NotifyState::Ready);
    // The control publishes a status in each step, so this loop also checks that the control is alive.
    while statuses.changed().await.is_ok() {
        let status = statuses.borrow_and_update().clone();
        let headline = status.headline().word;
        if headline != sent_headline {
            send(&NotifyState::Status(&headline));
            sent_headline = headline;
        }
        let now = service.now();
        let has_passed = |period: Duration, since| now.ns_since(since) >= period.as_nanos() as i64;
        let is_due = period.is_some_and(|period| notified_at.is_none_or(|since| has_passed(period, since)));
        if is_due && cycle_lives(&status, now) {
            send(&NotifyState::Watchdog);
            notified_at = Some(now);
        }
    }
}

/// Whether the cycle thread is alive. Also true without a bus, because another part of the service
/// supervises the start of the bus.
fn cycle_lives(status: &Status, now: MonoNs) -> bool {
    status.sampled.0 == 0 || now.ns_since(status.sampled) <= CYCLE_AGE_MAX.as_nanos() as i64
}

/// Sends a notification. Has no effect if no service manager started the program.
fn send(state: &NotifyState<'_>) {
    if let Err(error) = sd_notify::notify(std::slice::from_ref(state)) {
        tracing::warn!("cannot notify the service manager of {state}: {error}");
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
