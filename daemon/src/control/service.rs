//! The service from outside: what can be asked of it. What it then does is the business of the
//! [`controller`](super::controller).

use std::path::PathBuf;
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use shared::config::{BallBarConfig, DaemonConfig};
use tokio::sync::{oneshot, watch};

use super::controller::{Command, Controller};
use super::machine::Answer;
use super::status::{CheckLine, Refusal, StartRequest, Status};
use crate::run::{self, BusChoice, RunDetails, RunError, Session};
use crate::segment::faults::FaultWindow;

/// What the service is made of.
#[derive(Debug, Clone)]
pub struct Settings {
    /// Which bus.
    pub bus: BusChoice,
    /// What goes wrong on the simulated bus, on purpose.
    pub faults: Vec<FaultWindow>,
    /// `daemon.toml`.
    pub daemon: DaemonConfig,
    /// `ball_bar.toml`.
    pub bar: BallBarConfig,
    /// `homing.toml`, which need not be there.
    pub homing_file: PathBuf,
}

/// Brings the bus into operation; tried again and again until it is.
pub(super) type Connect = dyn Fn() -> Result<Session, RunError> + Send + Sync;

/// The way to the service's thread. Clones reach the same service.
#[derive(Clone)]
pub struct Service {
    commands: Sender<Command>,
    status: watch::Receiver<Status>,
    settings: Arc<Settings>,
    thread: Arc<Mutex<Option<thread::JoinHandle<()>>>>,
}

impl Service {
    /// Starts the service: left-over runs are finished, the bus is brought up and kept up.
    pub fn start(settings: Settings) -> std::io::Result<Self> {
        let (bus, faults) = (settings.bus.clone(), settings.faults.clone());
        let (daemon, bar) = (settings.daemon.clone(), settings.bar.clone());
        Self::start_on(settings, Arc::new(move || run::open(&bus, &faults, &daemon, &bar)))
    }

    /// [`start`](Self::start) with another way to the bus.
    pub(super) fn start_on(settings: Settings, connect: Arc<Connect>) -> std::io::Result<Self> {
        run::finish_leftovers(&settings.daemon.directory);
        let settings = Arc::new(settings);
        let (commands, commands_rx) = channel();
        let (status_tx, status) = watch::channel(Status::default());
        let mut controller = Controller::new(Arc::clone(&settings), connect, status_tx);
        let thread =
            thread::Builder::new().name("control".into()).spawn(move || controller.run(&commands_rx))?;
        Ok(Self { commands, status, settings, thread: Arc::new(Mutex::new(Some(thread))) })
    }

    /// What it is doing.
    pub fn status(&self) -> Status {
        self.status.borrow().clone()
    }

    /// Told whenever the status changes.
    pub fn watch(&self) -> watch::Receiver<Status> {
        self.status.clone()
    }

    /// What it is made of.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    pub(super) async fn begin(&self, request: StartRequest) -> Result<Answer, Refusal> {
        let named = request.name.is_some();
        let details = Box::new(details(request, &self.settings.daemon)?);
        self.ask(|reply| Command::Start(details, named, reply)).await
    }

    pub(super) async fn stop(&self, cause: String) -> Result<Answer, Refusal> {
        self.ask(|reply| Command::Stop(cause, reply)).await
    }

    pub(super) async fn home(&self) -> Result<Answer, Refusal> {
        self.ask(Command::Home).await
    }

    /// The run that was marked; none if none goes on.
    pub(super) async fn mark(&self, text: String) -> Result<Option<String>, Refusal> {
        self.ask(|reply| Command::Mark(text, reply)).await
    }

    /// The preflight check.
    pub async fn check(&self) -> Result<Vec<CheckLine>, Refusal> {
        self.ask(Command::Check).await
    }

    /// Ends a running run with `cause` and its file finished, then the service. Does not wait.
    pub fn shutdown(&self, cause: &str) {
        // A service that has ended already needs no telling.
        let _ = self.commands.send(Command::Shutdown(cause.to_owned()));
    }

    /// Waits for the end of the service.
    pub fn join(&self) {
        let thread = self.thread.lock().unwrap_or_else(PoisonError::into_inner).take();
        if thread.is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the service's thread panicked");
        }
    }

    async fn ask<T>(&self, command: impl FnOnce(oneshot::Sender<T>) -> Command) -> Result<T, Refusal> {
        let ended = || Refusal { error: "the service is ending".into() };
        let (reply, answer) = oneshot::channel();
        self.commands.send(command(reply)).map_err(|_| ended())?;
        answer.await.map_err(|_| ended())
    }
}

fn details(request: StartRequest, daemon: &DaemonConfig) -> Result<RunDetails, Refusal> {
    let duration = request
        .duration_s
        .map(|seconds| {
            Duration::try_from_secs_f64(seconds).ok().filter(|duration| *duration >= daemon.cycle_period()).ok_or(
                Refusal { error: format!("duration of {seconds} s: must be at least one cycle; leave it out to record until stopped") },
            )
        })
        .transpose()?;
    Ok(RunDetails {
        name: request.name.unwrap_or_default(),
        operator: request.operator,
        robot: request.robot,
        note: request.note,
        duration,
        homing: None,
    })
}

#[cfg(test)]
mod tests {
    use std::io;
    use std::path::Path;
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::time::Instant;

    use shared::config;
    use shared::recording::Recording;
    use shared::time::MonoNs;

    use super::*;
    use crate::clock::Clock;
    use crate::segment::simulated::{SegmentConfig, SimulatedSegment, SmoothMotion};
    use crate::segment::{FRAME_BYTES_MAX, InProcessWire, Wire};

    /// A wire whose driver takes its thread with it when it is told to.
    struct Deadly(InProcessWire, Arc<AtomicBool>);

    impl Wire for Deadly {
        fn send(&mut self, frame: &[u8]) -> io::Result<()> {
            assert!(!self.1.load(Ordering::Acquire), "the test ends this thread");
            self.0.send(frame)
        }

        fn receive(
            &mut self,
            buffer: &mut [u8; FRAME_BYTES_MAX],
            until: MonoNs,
        ) -> io::Result<Option<usize>> {
            self.0.receive(buffer, until)
        }
    }

    fn wait_until(service: &Service, what: &str, is_it: impl Fn(&Status) -> bool) -> Status {
        let begun = Instant::now();
        loop {
            let status = service.status();
            if is_it(&status) {
                return status;
            }
            assert!(begun.elapsed() < Duration::from_secs(30), "{what} never came: {status:?}");
            thread::sleep(Duration::from_millis(20));
        }
    }

    #[test]
    fn a_cycle_thread_that_dies_leaves_a_finished_file_with_the_cause_and_is_replaced() {
        let directory = tempfile::tempdir().unwrap();
        let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config");
        let daemon: DaemonConfig = config::load(&shipped.join("daemon.toml")).unwrap();
        let daemon = DaemonConfig { directory: directory.path().to_owned(), ..daemon };
        let bar: BallBarConfig = config::load(&shipped.join("ball_bar.toml")).unwrap();
        let deadly = Arc::new(AtomicBool::new(false));
        let (armed, on_daemon, on_bar) = (Arc::clone(&deadly), daemon.clone(), bar.clone());
        let connect = move || {
            let motion = SmoothMotion::new(on_bar.encoders.len(), 3600, 1);
            let segment = SimulatedSegment::new(&SegmentConfig::default(), Box::new(motion));
            let wire = Deadly(InProcessWire::new(segment, Clock::Real), Arc::clone(&armed));
            run::open_on(Box::new(wire), &on_daemon, &on_bar)
        };
        let settings = Settings {
            bus: BusChoice::Simulated,
            faults: Vec::new(),
            daemon,
            bar,
            homing_file: directory.path().join("homing.toml"),
        };
        let service = Service::start_on(settings, Arc::new(connect)).unwrap();
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let start = |name: &str| {
            let request = StartRequest { name: Some(name.into()), ..StartRequest::default() };
            assert_eq!(runtime.block_on(service.begin(request)).unwrap(), Answer::Beginning);
        };
        wait_until(&service, "the bus", |status| status.state == "waiting");
        start("cut");
        wait_until(&service, "writing", |status| status.state == "writing");
        deadly.store(true, Ordering::Release);
        let fault = wait_until(&service, "the fault", |status| status.last.is_some());
        let last = fault.last.unwrap();
        assert!(last.cause.contains("thread of the cycle has ended"), "{}", last.cause);
        let recording = Recording::open(&directory.path().join("cut.mcap")).unwrap();
        assert_eq!((recording.end.cause, recording.cycles.len() as u64), (last.cause, last.cycles));
        assert!(recording.cycles.len() > 50);
        assert_eq!(fault.state, "fault");
        deadly.store(false, Ordering::Release);
        wait_until(&service, "the bus again", |status| status.state == "waiting");
        start("next");
        wait_until(&service, "writing again", |status| status.state == "writing");
        service.shutdown("test over");
        service.join();
        assert!(directory.path().join("next.mcap").exists());
    }
}
