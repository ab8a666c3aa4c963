//! Brings the bus of the service into operation and reports each change of its state as an event for the machine. A failed
//! attempt is repeated after a pause until it succeeds. While the bus operates, the fraction of valid samples of each encoder
//! in the last second is measured.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::mpsc::Receiver;
use std::time::Duration;

use shared::recording::schema::MAX_ENCODERS;
use shared::time::{MonoNs, NS_PER_S};

use crate::control::machine::MachineEvent;
use crate::control::settings::Connect;
use crate::problem::{Fact, Problem};
use crate::run::{BUS_FLAGS, Opening, RunError, Session};
use crate::scheduler::{Died, Pending, Scheduler, received};

/// Pause after the first failed attempt to bring the bus into operation. The pause doubles with each failure.
const RETRY_FIRST: Duration = Duration::from_secs(1);
/// Longest pause between two attempts.
const RETRY_LONGEST: Duration = Duration::from_secs(30);
/// Largest age of the last cycle. If the last cycle is older, the cycle thread or this PC has a problem.
const CYCLE_AGE_MAX: Duration = Duration::from_secs(2);
/// A bus or an encoder is reported as silent after this number of cycles without samples. If one frame in a hundred is lost,
/// three losses in a row occur once in a million cycles.
const SILENT_CYCLES: u32 = 3;
/// Minimum time without samples before a bus or an encoder is reported as silent. At high cycle rates, three cycles are
/// shorter than this time. Outages that are shorter are not reported to people.
const SILENT_MIN: Duration = Duration::from_millis(50);

/// Keeps a bus in operation, and reports changes of its state.
pub(super) struct BusLink {
    connect: Arc<Connect>,
    scheduler: Arc<dyn Scheduler>,
    state: LinkState,
    /// Pause after the next failed attempt.
    pause: Duration,
    /// Receives a message when the cycle thread of a bus that is being closed has ended.
    closing: Option<Receiver<()>>,
}

enum LinkState {
    Down {
        retry_at: MonoNs,
    },
    Connecting(Pending<Result<Session, RunError>>),
    Up {
        session: Box<Session>,
        /// The problem that was last reported; `None` if the bus has no problem.
        trouble: Option<Problem>,
        recent: RecentCounts,
    },
}

/// The counts of cycles at each poll during the last [`WINDOW_NS`].
#[derive(Default)]
struct RecentCounts(VecDeque<Counts>);

/// Numbers of cycles since the bus came into operation, at one poll.
struct Counts {
    at: MonoNs,
    cycles: u64,
    /// Number of valid cycles of each encoder.
    valid: [u64; MAX_ENCODERS],
}

/// Time over which the fraction of valid samples is measured, because one sample is not representative \[ns\].
const WINDOW_NS: i64 = NS_PER_S;

impl RecentCounts {
    fn add(&mut self, at: MonoNs, (cycles, valid): (u64, [u64; MAX_ENCODERS])) {
        self.0.push_back(Counts { at, cycles, valid });
        // The latest poll before the window is kept, as the beginning of the window.
        while self.0.get(1).is_some_and(|second| at.ns_since(second.at) >= WINDOW_NS) {
            self.0.pop_front();
        }
    }

    /// Fraction of valid cycles of each encoder; `None` before the first cycle.
    fn valid_shares(&self) -> Option<[f64; MAX_ENCODERS]> {
        let (first, last) = (self.0.front()?, self.0.back()?);
        let cycles = last.cycles.checked_sub(first.cycles).filter(|cycles| *cycles > 0)?;
        let share =
            |index: usize| last.valid[index].saturating_sub(first.valid[index]) as f64 / cycles as f64;
        Some(std::array::from_fn(share))
    }
}

impl BusLink {
    /// Creates a link without a bus. The first poll starts the first attempt.
    pub fn new(connect: Arc<Connect>, scheduler: Arc<dyn Scheduler>) -> Self {
        let state = LinkState::Down { retry_at: scheduler.clock().now() };
        Self { connect, scheduler, state, pause: RETRY_FIRST, closing: None }
    }

    /// The session of the bus while it is in operation, otherwise `None`.
    pub fn session(&self) -> Option<&Session> {
        let LinkState::Up { session, .. } = &self.state else { return None };
        Some(session)
    }

    /// Fraction of valid cycles of each encoder in the last second, in bus order; `None` before the first cycle.
    pub fn valid_shares(&self) -> Option<[f64; MAX_ENCODERS]> {
        let LinkState::Up { recent, .. } = &self.state else { return None };
        recent.valid_shares()
    }

    /// Checks the bus. Returns an event if the state of the bus has changed since the last poll.
    pub fn poll(&mut self, now: MonoNs) -> Option<MachineEvent> {
        match &mut self.state {
            LinkState::Down { retry_at } => {
                if now >= *retry_at {
                    self.state = LinkState::Connecting(self.attempt());
                }
                None
            }
            LinkState::Connecting(attempt) => {
                let outcome = attempt.poll()?;
                Some(match outcome {
                    Ok(outcome) => self.connected(outcome, now),
                    Err(Died) => self.failed(Fact::ThreadEnded { thread: "bring-up".into() }.into(), now),
                })
            }
            LinkState::Up { session, .. } if !session.is_alive() => {
                Some(self.failed(Fact::ThreadEnded { thread: "cycle".into() }.into(), now))
            }
            LinkState::Up { session, trouble, recent } => {
                recent.add(now, session.live.counted());
                let current = trouble_of(session, now);
                let current_text = current.as_ref().map(|problem| &problem.text);
                if current_text == trouble.as_ref().map(|reported| &reported.text) {
                    return None;
                }
                if current.is_none() {
                    // Start the window again, so that cycles that the bus lost are not counted against the encoders.
                    *recent = RecentCounts::default();
                }
                trouble.clone_from(&current);
                Some(current.map_or(MachineEvent::BusUp, MachineEvent::BusTroubled))
            }
        }
    }

    /// Requests the end of the cycle thread. [`is_closed`](Self::is_closed) returns true once the thread has ended.
    pub fn close(&mut self) {
        let down = LinkState::Down { retry_at: MonoNs(i64::MAX) };
        if let LinkState::Up { session, .. } = std::mem::replace(&mut self.state, down) {
            self.closing = Some(session.begin_close());
        }
    }

    /// Whether the cycle thread of a closed bus has ended.
    pub fn is_closed(&self) -> bool {
        self.closing.as_ref().is_none_or(|closing| received(closing).is_some())
    }

    /// Starts a task that brings the bus into operation.
    fn attempt(&self) -> Pending<Result<Session, RunError>> {
        let (connect, mut opening) = (Arc::clone(&self.connect), None::<Opening>);
        Pending::until(&*self.scheduler, "bus", move || match &mut opening {
            Some(opening) => opening.poll(),
            None => match connect() {
                Ok(begun) => {
                    opening = Some(begun);
                    None
                }
                Err(error) => Some(Err(error)),
            },
        })
    }

    fn connected(&mut self, outcome: Result<Session, RunError>, now: MonoNs) -> MachineEvent {
        match outcome {
            Ok(session) => {
                session.log();
                self.pause = RETRY_FIRST;
                let session = Box::new(session);
                self.state = LinkState::Up { session, trouble: None, recent: RecentCounts::default() };
                MachineEvent::BusUp
            }
            Err(error) => self.failed(error.problem(), now),
        }
    }

    fn failed(&mut self, problem: Problem, now: MonoNs) -> MachineEvent {
        self.state = LinkState::Down { retry_at: now.plus_ns(self.pause.as_nanos() as i64) };
        self.pause = (self.pause * 2).min(RETRY_LONGEST);
        MachineEvent::BusDown(problem)
    }
}

/// The problem of the bus if the latest cycles contain no samples of the whole bus. `None` if the bus is not the cause.
fn trouble_of(session: &Session, now: MonoNs) -> Option<Problem> {
    let live = &session.live;
    let age = now.ns_since(live.at());
    if age > CYCLE_AGE_MAX.as_nanos() as i64 {
        return Some(Fact::CycleStalled { age_s: age / 1_000_000_000 }.into());
    }
    // Compare with the latest cycle instead of the present time, so that a delay of the cycle is not reported as a bus fault.
    if live.at().ns_since(live.whole_at()) <= silent_ns(session) {
        return None;
    }
    let reasons = live.flags() & BUS_FLAGS;
    if reasons == 0 {
        return None;
    }
    let readings = session.encoders.iter().zip(live.encoders());
    let silent: Vec<u8> =
        readings.filter(|(_, encoder)| !encoder.valid).map(|(info, _)| info.joint).collect();
    let all_silent = silent.is_empty() || silent.len() == session.encoders.len();
    // The coupler is at position 0, so the terminal of the first encoder is at position 1.
    let first_silent = live.encoders().iter().position(|encoder| !encoder.valid).map(|index| index + 1);
    let position = first_silent.filter(|_| !all_silent);
    let of_flags = || Fact::of_flags(reasons, &session.bus, silent.clone(), position);
    let fact = session.outage().unwrap_or_else(of_flags);
    Some(Problem::from(fact).with_joints(silent, all_silent))
}

/// Time without valid samples after which a bus or an encoder is silent \[ns\].
fn silent_ns(session: &Session) -> i64 {
    (session.period * SILENT_CYCLES).max(SILENT_MIN).as_nanos() as i64
}

/// For each encoder, in bus order: whether it has had no valid sample for [`SILENT_CYCLES`] and [`SILENT_MIN`].
pub(super) fn are_silent(session: &Session) -> [bool; MAX_ENCODERS] {
    let live = &session.live;
    let (latest, silent_ns) = (live.at(), silent_ns(session));
    live.valid_at().map(|valid_at| latest.ns_since(valid_at) > silent_ns)
}

/// A problem for each encoder that has no valid samples although the bus works.
pub(super) fn silent_encoders(session: &Session) -> Vec<Problem> {
    let readings = session.encoders.iter().zip(session.live.encoders()).zip(are_silent(session));
    let silent = readings.filter(|(_, is_silent)| *is_silent);
    silent
        .map(|((info, encoder), _)| {
            let (joints, status) = (vec![info.joint], Some(encoder.status));
            Fact::EncoderInvalid { joints, status, valid_share: 0.0 }.into()
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_of_valid_cycles_are_those_of_the_last_second() {
        let mut recent = RecentCounts::default();
        assert_eq!(recent.valid_shares(), None);
        let mut at = |tenth: u32, cycles: u64, valid: u64| {
            recent.add(MonoNs(i64::from(tenth) * NS_PER_S / 10), (cycles, [valid; MAX_ENCODERS]));
            recent.valid_shares().map(|shares| shares[MAX_ENCODERS - 1])
        };
        assert_eq!(at(0, 5, 5), None);
        for tenth in 1..20 {
            assert_eq!(at(tenth, 5 + 10 * u64::from(tenth), 5 + 10 * u64::from(tenth)), Some(1.0));
        }
        // The encoder is silent for half a second and then valid for half a second. The fraction changes
        // gradually in both directions.
        let shares: Vec<f64> = (20..41)
            .map(|tenth| {
                let silent = u64::from(tenth.min(25) - 20);
                at(tenth, 5 + 10 * u64::from(tenth), 5 + 10 * (u64::from(tenth) - silent)).unwrap()
            })
            .collect();
        assert_eq!([shares[0], shares[1], shares[5], shares[10], shares[14]], [1.0, 0.9, 0.5, 0.5, 0.9]);
        assert_eq!(shares[16..], [1.0; 5]);
    }
}
