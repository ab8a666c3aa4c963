//! The bus, or the attempt to bring it into operation.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::{Duration, Instant};

use shared::recording::schema::flags;

use super::machine::Event;
use super::service::Connect;
use crate::clock::Clock;
use crate::run::{RunError, Session};

/// Pauses between attempts to bring the bus up.
const RETRY_FIRST: Duration = Duration::from_secs(1);
const RETRY_LONGEST: Duration = Duration::from_secs(30);
/// A bus that gave no sample for longer is in trouble: what works on it needs less for most faults.
const TROUBLED_AFTER: Duration = Duration::from_secs(2);
/// Reasons that stand for the bus itself, and not for one encoder or this PC.
const BUS_FLAGS: u32 = flags::NO_REPLY | flags::WORKING_COUNTER | flags::NOT_OPERATIONAL | flags::BUS_DOWN;

/// Keeps a bus in operation, and tells what becomes of it.
pub(super) struct BusLink {
    connect: Arc<Connect>,
    state: State,
}

enum State {
    Down {
        retry_at: Instant,
        pause: Duration,
    },
    Connecting {
        attempt: Receiver<Result<Session, RunError>>,
        pause: Duration,
    },
    /// With the trouble that was told, while there is one.
    Up {
        session: Box<Session>,
        well_at: Instant,
        trouble: Option<String>,
    },
}

impl BusLink {
    /// Tries at once.
    pub fn new(connect: Arc<Connect>) -> Self {
        Self { connect, state: State::Down { retry_at: Instant::now(), pause: RETRY_FIRST } }
    }

    /// The bus, while it is there.
    pub fn session(&self) -> Option<&Session> {
        match &self.state {
            State::Up { session, .. } => Some(session),
            State::Down { .. } | State::Connecting { .. } => None,
        }
    }

    /// What has changed since the last look.
    pub fn look(&mut self) -> Option<Event> {
        match &mut self.state {
            State::Down { retry_at, pause } => {
                if Instant::now() < *retry_at {
                    return None;
                }
                let pause = *pause;
                self.try_to_connect(pause)
            }
            State::Connecting { attempt, pause } => {
                let (outcome, pause) = (attempt.try_recv().ok()?, *pause);
                Some(self.connected(outcome, pause))
            }
            State::Up { session, .. } if !session.is_alive() => {
                self.close();
                Some(self.failed("the thread of the cycle has ended; its cause is in the log", RETRY_FIRST))
            }
            State::Up { session, well_at, trouble } => {
                let now = trouble_of(session);
                if now.is_none() {
                    *well_at = Instant::now();
                }
                if now == *trouble || (now.is_some() && well_at.elapsed() <= TROUBLED_AFTER) {
                    return None;
                }
                trouble.clone_from(&now);
                Some(now.map_or(Event::BusUp, Event::BusTroubled))
            }
        }
    }

    /// Ends the cycle.
    pub fn close(&mut self) {
        let down = State::Down { retry_at: Instant::now(), pause: RETRY_FIRST };
        if let State::Up { session, .. } = std::mem::replace(&mut self.state, down)
            && let Err(error) = session.close()
        {
            tracing::error!("{error}");
        }
    }

    fn try_to_connect(&mut self, pause: Duration) -> Option<Event> {
        let connect = Arc::clone(&self.connect);
        let (result, attempt) = channel();
        let body = move || {
            // Nobody waits any more if the service has ended meanwhile.
            let _ = result.send(connect());
        };
        match thread::Builder::new().name("bus".into()).spawn(body) {
            Ok(_) => {
                self.state = State::Connecting { attempt, pause };
                None
            }
            Err(error) => Some(self.failed(&error.to_string(), pause)),
        }
    }

    fn connected(&mut self, outcome: Result<Session, RunError>, pause: Duration) -> Event {
        match outcome {
            Ok(session) => {
                session.log();
                let session = Box::new(session);
                self.state = State::Up { session, well_at: Instant::now(), trouble: None };
                Event::BusUp
            }
            Err(error) => self.failed(&error.to_string(), pause),
        }
    }

    fn failed(&mut self, reason: &str, pause: Duration) -> Event {
        tracing::warn!("bus: {reason}; next attempt in {} s", pause.as_secs());
        self.state = State::Down { retry_at: Instant::now() + pause, pause: (pause * 2).min(RETRY_LONGEST) };
        Event::BusDown(reason.to_owned())
    }
}

/// Why the latest cycle gave no sample of the whole bus, as far as the bus is to blame, and what to do.
fn trouble_of(session: &Session) -> Option<String> {
    let live = session.live();
    let age = Clock::Real.now().ns_since(live.at());
    if age > TROUBLED_AFTER.as_nanos() as i64 {
        return Some(format!(
            "no bus cycle for {:.1} s; its thread hangs or is not let run",
            age as f64 * 1e-9
        ));
    }
    let reasons = live.flags() & BUS_FLAGS;
    (reasons != 0).then(|| {
        let names: Vec<_> =
            flags::NAMES.iter().filter(|(bit, _)| reasons & bit != 0).map(|(_, name)| *name).collect();
        let joints = session.encoders().iter().map(|encoder| encoder.joint);
        let is_valid = live.encoders().map(|encoder| encoder.valid);
        format!(
            "{} ({}); it comes back by itself as soon as cable, power and every terminal are as they should be",
            silent_text(joints.zip(is_valid), session.outage()),
            names.join(", ")
        )
    })
}

/// Which joints, in bus order with whether each gives samples, give none, and why; where that is not known, where to
/// look first.
fn silent_text(joints: impl Iterator<Item = (u8, bool)>, why: Option<String>) -> String {
    let (giving, silent): (Vec<_>, Vec<_>) = joints.partition(|(_, is_valid)| *is_valid);
    let (who, look) = match silent.first() {
        Some((first, _)) if !giving.is_empty() => {
            let names: Vec<_> = silent.iter().map(|(joint, _)| joint.to_string()).collect();
            let look = format!("look first at the terminal of joint {first} and at the contact before it");
            (format!("joint {}", names.join(", ")), look)
        }
        _ => (
            "any encoder".into(),
            "look first at the coupler's cable and power, then along the terminals".into(),
        ),
    };
    format!("no samples from {who}: {}", why.unwrap_or(look))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_terminal_that_is_missing_is_where_to_look() {
        let some = silent_text([(1, true), (3, true), (2, false), (5, false)].into_iter(), None);
        assert!(some.contains("joint 2, 5:") && some.contains("terminal of joint 2 "), "{some}");
        let none = silent_text([(1, false), (2, false)].into_iter(), None);
        assert!(none.contains("coupler"), "{none}");
        let known = silent_text([(1, true), (2, false)].into_iter(), Some("position 2 is away".into()));
        assert_eq!(known, "no samples from joint 2: position 2 is away");
    }
}
