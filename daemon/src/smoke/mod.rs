//! Smoke test (`ballbard smoke`): tests a bus before its first use, check by check. The result is a [`Report`], which the
//! user sends to the developers.
//!
//! The simulated segment was written from documents, so this test shows where real devices differ. It brings the bus into
//! operation and runs cycles in the same way as every run. The records from the ring are counted instead of written to a
//! file. If a check depends on an earlier check that did not pass, it is reported as not done.

mod cable;
mod check;
mod config;
mod cycles;
mod host;
mod report;

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use shared::config::{BallBarConfig, DaemonConfig};
use shared::recording::schema::{DeviceInfo, SIMULATED_BUS};
use shared::time::UtcNs;

pub use check::{Check, Outcome, Reason, Subject};
pub use config::{CyclesConfig, SmokeConfig};
pub use cycles::{EncoderFigures, Figures};
pub use report::Report;

use crate::devices::{EK1100, EL5021};
use crate::homing::{self, HomingError};
use crate::problem::Fact;
use crate::run::{self, BusChoice, RunError, RunRequest, Session, Setup, Stop, Storage};
use crate::scheduler::{Scheduler, until};
use cable::Pull;
use host::Host;

/// Period of polling a homing.
const POLL: Duration = Duration::from_millis(50);
/// Capacity of the ring \[s\]. On virtual time, cycles can be ahead of their evaluation by this time, so it must be much
/// shorter than the time limits of checks with a person.
const RING_S: u32 = 5;

/// Input of a smoke test.
pub struct Bench<'a> {
    /// Which checks are done, and their limits.
    pub smoke: &'a SmokeConfig,
    /// Configuration of the cycles. Its `rate_hz`, `reply_timeout_us`, `full_fault_s` and `ring_s` are not used.
    pub daemon: &'a DaemonConfig,
    /// The encoders, whose terminals are expected on the bus.
    pub bar: &'a BallBarConfig,
    /// The bus, its faults, and whether time is virtual.
    pub request: &'a RunRequest,
    /// Whether a person reads what is printed, and can turn joints and pull the cable.
    pub has_person: bool,
    /// Ends the test early.
    pub stop: &'a Stop,
}

/// Does all checks. The result of each check and instructions for a person are passed to `print` immediately.
pub async fn smoke(
    scheduler: &Arc<dyn Scheduler>,
    bench: &Bench<'_>,
    print: &mut dyn FnMut(&str),
) -> Result<Report, RunError> {
    let Bench { smoke, daemon, bar, request, .. } = *bench;
    let interface = match &request.bus {
        BusChoice::Interface(name) => Some(name.as_str()),
        BusChoice::Simulated | BusChoice::Replay(_) => None,
    };
    let report = Report {
        software: shared::version::software("ballbard"),
        started: UtcNs::from_datetime(chrono::Utc::now()).to_string(),
        bus: interface.unwrap_or(SIMULATED_BUS).to_owned(),
        host: Host::read(daemon, interface),
        smoke: smoke.clone(),
        daemon: daemon.clone(),
        encoders: bar.encoders.clone(),
        devices: Vec::new(),
        checks: Vec::new(),
        cycles: Vec::new(),
        pulled_cable: None,
    };
    // A session monitors the disk of its runs, so it needs a storage although no run is recorded.
    let storage = Storage::new(daemon, &**scheduler).map_err(|error| RunError::Thread(error.to_string()))?;
    // The time limit for a reply is left to its default, because it depends on the rate. The limit for invalid samples is
    // disabled, because a test must not end when no encoder delivers samples.
    let daemon =
        DaemonConfig { reply_timeout_us: None, full_fault_s: u32::MAX, ring_s: RING_S, ..(*daemon).clone() };
    let setup = Setup { scheduler: Arc::clone(scheduler), storage, daemon, bar: bar.clone() };
    let mut test = Test { setup, bench, report, blocked: None, not_up: BTreeMap::new(), print };
    for wanted in &smoke.cycles {
        test.check_cycles(*wanted).await;
    }
    test.check_with_person(Subject::Homing, smoke.homing, "homing", Test::home).await;
    test.check_with_person(Subject::PulledCable, smoke.pulled_cable, "pulled_cable", Test::pull_cable).await;
    Ok(test.report)
}

/// A smoke test in progress.
struct Test<'a> {
    setup: Setup,
    bench: &'a Bench<'a>,
    report: Report,
    /// Why no further check can be done; `None` while the test continues.
    blocked: Option<Reason>,
    /// Rates at which the bus could not be brought into operation, with the reason.
    not_up: BTreeMap<u32, Reason>,
    print: &'a mut dyn FnMut(&str),
}

impl Test<'_> {
    fn add(&mut self, subject: Subject, rate_hz: Option<u32>, outcome: Outcome) {
        let check = Check { subject, rate_hz, outcome };
        (self.print)(&check.to_string());
        self.report.checks.push(check);
    }

    /// Brings the bus into operation. If that fails, adds a failed check and returns the reason why the
    /// checks that depend on the bus are not done.
    async fn connect(&mut self, rate_hz: u32) -> Result<Session, Reason> {
        if let Some(reason) = self.blocked.as_ref().or_else(|| self.not_up.get(&rate_hz)) {
            return Err(reason.clone());
        }
        self.setup.daemon.rate_hz = rate_hz;
        match run::open_with_retry(&self.setup, self.bench.request, self.bench.stop).await {
            Ok(session) => {
                self.identify(session.devices(), Outcome::passed(self.devices_expected()));
                Ok(session)
            }
            Err(error) => Err(self.not_connected(rate_hz, &error)),
        }
    }

    /// Adds the check that failed when the bus was brought into operation. Returns the reason why the
    /// checks that depend on the bus are not done.
    fn not_connected(&mut self, rate_hz: u32, error: &RunError) -> Reason {
        let stop = self.bench.stop;
        if stop.is_stopped() {
            return self.block(Reason::Stopped(stop.cause()));
        }
        let identified = match error {
            RunError::Bus { identified, .. } => identified.as_slice(),
            _ => &[],
        };
        let problem = error.problem();
        // Derive the check that failed from the problem.
        let (subject, expected) = match *problem.fact {
            Fact::InterfaceUnusable { .. } => (Subject::Interface, "an interface that can be opened".into()),
            Fact::BusNoAnswer { .. }
            | Fact::BusDeviceMissing { .. }
            | Fact::BusDeviceUnexpected { .. }
            | Fact::BusDeviceWrong { .. } => (Subject::Devices, self.devices_expected()),
            Fact::BusClockStopped { .. } | Fact::BusClockUnsettled { .. } => {
                (Subject::DistributedClocks, "clocks that follow the coupler within 1000 ns".into())
            }
            _ => (Subject::BringUp, "every device in OP".into()),
        };
        // Add the failed check, and with it the checks of devices that identified themselves.
        let outcome = Outcome::failed(expected, &problem, None);
        match subject {
            Subject::Interface if !self.is_done(Subject::Devices, None) => self.add(subject, None, outcome),
            Subject::Devices if !self.is_done(Subject::Devices, None) => self.identify(identified, outcome),
            // The interface and the devices passed at an earlier rate, so the failure is one of bringing
            // up the bus at this rate.
            Subject::Interface | Subject::Devices => self.add(Subject::BringUp, Some(rate_hz), outcome),
            _ => {
                if !identified.is_empty() {
                    self.identify(identified, Outcome::passed(self.devices_expected()));
                }
                self.add(subject, Some(rate_hz), outcome);
                // Only this rate is blocked, because the bus may work at another rate.
                return self.not_up.entry(rate_hz).or_insert(Reason::After(subject)).clone();
            }
        }
        self.block(Reason::After(subject))
    }

    /// Stops all further checks.
    fn block(&mut self, because: Reason) -> Reason {
        self.blocked.insert(because).clone()
    }

    fn is_done(&self, subject: Subject, rate_hz: Option<u32>) -> bool {
        self.report.checks.iter().any(|check| (check.subject, check.rate_hz) == (subject, rate_hz))
    }

    fn devices_expected(&self) -> String {
        format!("{}, then {} {}", EK1100.name, self.bench.bar.encoders.len(), EL5021.name)
    }

    /// Adds the checks of the interface, the devices and their revisions, unless they were added before.
    fn identify(&mut self, devices: &[DeviceInfo], outcome: Outcome) {
        if self.is_done(Subject::Devices, None) {
            return;
        }
        self.report.devices = devices.to_vec();
        let interface = Outcome::passed(format!("{} is open", self.report.bus));
        self.add(Subject::Interface, None, interface);
        self.add(Subject::Devices, None, outcome);
        if !devices.is_empty() {
            let revisions = self.revisions_outcome(devices);
            self.add(Subject::Revisions, None, revisions);
        }
    }

    fn revisions_outcome(&self, devices: &[DeviceInfo]) -> Outcome {
        let SmokeConfig { coupler_revisions, terminal_revisions, .. } = self.bench.smoke;
        let is_known = |device: &&DeviceInfo| {
            let known = if device.position == 0 { coupler_revisions } else { terminal_revisions };
            known.contains(&device.type_revision())
        };
        let name = |device: &DeviceInfo| format!("{} r{}", device.name, device.type_revision());
        let unknown: Vec<_> = devices.iter().filter(|device| !is_known(device)).map(name).collect();
        if unknown.is_empty() {
            return Outcome::passed(devices.iter().map(name).collect::<Vec<_>>().join(", "));
        }
        Outcome::Failed {
            expected: format!("coupler r{coupler_revisions:?}, terminals r{terminal_revisions:?}"),
            found: unknown.join(", "),
            remedy: "send the report: process data of other revisions may differ".into(),
            code: None,
        }
    }

    /// Adds the checks of bring-up and cycles at one rate.
    async fn check_cycles(&mut self, wanted: CyclesConfig) {
        let rate_hz = Some(wanted.rate_hz);
        let outcomes = match self.connect(wanted.rate_hz).await {
            Ok(session) => {
                let off_ns = session.clocks().iter().map(|clock| clock.difference_ns.abs()).max();
                let clocks = off_ns.map_or(String::new(), |off_ns| format!(", clocks within {off_ns} ns"));
                let found = format!("every device in OP{clocks}");
                self.add(Subject::BringUp, rate_hz, Outcome::passed(found));
                self.cycle_outcomes(session, wanted).await
            }
            Err(because) => Err(because),
        };
        match outcomes {
            Ok(outcomes) => {
                outcomes.into_iter().for_each(|(subject, outcome)| self.add(subject, rate_hz, outcome))
            }
            Err(because) => self.add_not_done(wanted.rate_hz, &because),
        }
    }

    /// Counts cycles on a bus in operation and returns the checks that follow from the counts.
    async fn cycle_outcomes(
        &mut self,
        session: Session,
        wanted: CyclesConfig,
    ) -> Result<[(Subject, Outcome); 5], Reason> {
        let Bench { smoke, daemon, stop, .. } = *self.bench;
        let mut figures = Figures::new(&session, wanted.rate_hz);
        figures.count(&session, Some(wanted.duration()), stop, |_| true).await;
        let outcomes = figures.checks(smoke, wanted, daemon.distributed_clocks);
        self.report.cycles.push(figures);
        close(session).await;
        match stop.is_stopped() {
            true => Err(self.block(Reason::Stopped(stop.cause()))),
            false => Ok(outcomes),
        }
    }

    /// Adds all checks of the bus and of this rate that have no result yet, with the outcome `NotDone`.
    fn add_not_done(&mut self, rate_hz: u32, because: &Reason) {
        use Subject::{
            BringUp, Cables, Cycles, Devices, DistributedClocks, Revisions, Signals, WorkingCounter,
        };
        let of_rate = [BringUp, Cycles, WorkingCounter, DistributedClocks, Signals, Cables];
        let of_bus = [Subject::Interface, Devices, Revisions].map(|subject| (subject, None));
        let checks = of_bus.into_iter().chain(of_rate.map(|subject| (subject, Some(rate_hz))));
        for (subject, rate_hz) in checks {
            if !self.is_done(subject, rate_hz) {
                self.add(subject, rate_hz, Outcome::NotDone { because: because.clone() });
            }
        }
    }

    /// Lowest configured rate. Homing and the check of the cable use this rate.
    fn lowest_rate_hz(&self) -> u32 {
        self.bench.smoke.cycles.iter().map(|wanted| wanted.rate_hz).min().unwrap_or(self.bench.daemon.rate_hz)
    }

    /// Adds a check that needs a person. `key` is the key of the configuration that enables the check.
    async fn check_with_person(
        &mut self,
        subject: Subject,
        is_enabled: bool,
        key: &'static str,
        check: impl AsyncFnOnce(&mut Self, &Session) -> Outcome,
    ) {
        // On the simulated bus no person is needed, because the program turns the joints and pulls the cable.
        let is_possible = self.bench.has_person || self.bench.request.bus == BusChoice::Simulated;
        let session = match (is_enabled, is_possible) {
            (false, _) => Err(Reason::NotAsked(key)),
            (true, false) => Err(Reason::NoPerson),
            (true, true) => self.connect(self.lowest_rate_hz()).await,
        };
        let outcome = match session {
            Ok(session) => {
                let outcome = check(self, &session).await;
                close(session).await;
                outcome
            }
            Err(because) => Outcome::NotDone { because },
        };
        self.add(subject, None, outcome);
    }

    async fn home(&mut self, session: &Session) -> Outcome {
        let Bench { stop, bar, .. } = *self.bench;
        let mut active = session.begin_homing();
        let found = until(&*self.setup.scheduler, POLL, || {
            while let Some(step) = active.take_step() {
                if let Some(line) = step.line() {
                    (self.print)(&line);
                }
            }
            if stop.is_stopped() {
                active.stop.stop(&stop.cause());
            }
            active.outcome()
        })
        .await;
        let verified = found.and_then(|found| Ok(homing::verify(&bar.encoders, &found)?));
        match verified {
            Ok(marks) => {
                let marks: Vec<_> = marks.iter().map(u32::to_string).collect();
                Outcome::passed(format!("marks at counts {}", marks.join(", ")))
            }
            Err(HomingError::Stopped(cause)) => Outcome::NotDone { because: Reason::Stopped(cause) },
            Err(error) => Outcome::Failed {
                expected: "each encoder on its joint, with its mark".into(),
                found: error.to_string(),
                remedy: String::new(),
                code: None,
            },
        }
    }

    async fn pull_cable(&mut self, session: &Session) -> Outcome {
        let stop = self.bench.stop;
        let mut figures = Figures::new(session, self.lowest_rate_hz());
        let mut pull = Pull::new(session, self.lowest_rate_hz().into());
        pull.ask(self.print);
        figures.count(session, None, stop, |record| pull.take(record, self.print)).await;
        self.report.pulled_cable = Some(figures);
        if stop.is_stopped() {
            return Outcome::NotDone { because: Reason::Stopped(stop.cause()) };
        }
        pull.outcome(session)
    }
}

async fn close(session: Session) {
    if let Err(error) = session.close().await {
        tracing::error!("{error}");
    }
}
