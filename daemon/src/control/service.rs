//! The service from outside: what can be asked of it. What it then does is the business of the
//! [`controller`](super::controller).

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use shared::config::{BallBarConfig, DaemonConfig};
use shared::time::MonoNs;
use tokio::sync::{oneshot, watch};

use super::controller::{Command, Controller};
use super::machine::Answer;
use super::status::{CheckLine, Refusal, StartRequest, Status};
use crate::claim::Claim;
use crate::clock::Clock;
use crate::run::{self, BusChoice, RunDetails, RunError, Session, Storage};
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
pub(crate) type Connect = dyn Fn() -> Result<Session, RunError> + Send + Sync;

/// The way to the service's thread. Clones reach the same service.
#[derive(Clone)]
pub struct Service {
    commands: Sender<Command>,
    status: watch::Receiver<Status>,
    settings: Arc<Settings>,
    thread: Arc<Mutex<Option<thread::JoinHandle<bool>>>>,
    _claim: Arc<Option<Claim>>,
}

/// Why the service cannot start.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// Another process records into its directory.
    #[error(transparent)]
    Run(#[from] RunError),
    /// The system refused its thread.
    #[error("cannot start the service's thread: {0}")]
    Thread(#[from] std::io::Error),
}

/// A thread of the service has died.
#[derive(Debug, thiserror::Error)]
#[error("a thread of the service has ended; its cause is in the log")]
pub struct Died;

impl Service {
    /// Starts the service: left-over runs are finished, the bus is brought up and kept up.
    pub fn start(settings: Settings) -> Result<Self, StartError> {
        let (bus, faults) = (settings.bus.clone(), settings.faults.clone());
        let (daemon, bar) = (settings.daemon.clone(), settings.bar.clone());
        let storage = Storage::new(&daemon)?;
        let places = storage.clone();
        Self::start_on(settings, storage, Arc::new(move || run::open(&bus, &faults, &daemon, &bar, &places)))
    }

    /// [`start`](Self::start) with another disk and another way to the bus.
    pub(crate) fn start_on(
        settings: Settings,
        storage: Storage,
        connect: Arc<Connect>,
    ) -> Result<Self, StartError> {
        let claim = Arc::new(run::claim_directory(&settings.daemon.directory)?);
        run::finish_leftovers(&storage);
        let settings = Arc::new(settings);
        let (commands, commands_rx) = channel();
        let (status_tx, status) = watch::channel(Status::default());
        let mut controller = Controller::new(Arc::clone(&settings), connect, storage, status_tx);
        let body = move || {
            let is_well = catch_unwind(AssertUnwindSafe(|| controller.run(&commands_rx))).is_ok();
            if !is_well {
                controller.abandon();
            }
            is_well
        };
        let thread = thread::Builder::new().name("control".into()).spawn(body)?;
        let thread = Arc::new(Mutex::new(Some(thread)));
        Ok(Self { commands, status, settings, thread, _claim: claim })
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

    /// With how many runs were over when it was asked.
    pub(super) async fn stop(&self, cause: String) -> Result<(Answer, u64), Refusal> {
        self.ask(|reply| Command::Stop(cause, reply)).await
    }

    pub(super) async fn home(&self) -> Result<Answer, Refusal> {
        self.ask(Command::Home).await
    }

    /// The run that was marked; none if none goes on.
    pub(super) async fn mark(&self, text: String) -> Result<Option<String>, Refusal> {
        let at: MonoNs = Clock::Real.now();
        let marked = self.ask(|reply| Command::Mark(text, at, reply)).await?;
        marked.map_err(|error| Refusal { error })
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

    /// Waits for the end of the service; its file is finished then, also where its thread died.
    pub fn join(&self) -> Result<(), Died> {
        let thread = self.thread.lock().unwrap_or_else(PoisonError::into_inner).take();
        let is_well = thread.is_none_or(|thread| thread.join().unwrap_or(false));
        if is_well { Ok(()) } else { Err(Died) }
    }

    /// Returns when the service has ended, for whatever reason.
    pub async fn ended(&self) {
        // Never true: it returns when nobody is left who could say anything.
        let _ = self.watch().wait_for(|_| false).await;
    }

    /// Ends the thread of the control.
    #[cfg(test)]
    pub(crate) fn kill_control(&self) {
        let _ = self.commands.send(Command::Panic);
    }

    async fn ask<T>(&self, command: impl FnOnce(oneshot::Sender<T>) -> Command) -> Result<T, Refusal> {
        let ended = || Refusal { error: "the service is ending".into() };
        let (reply, answer) = oneshot::channel();
        self.commands.send(command(reply)).map_err(|_| ended())?;
        answer.await.map_err(|_| ended())
    }
}

/// Longer is a slip of the finger.
const DURATION_MAX: Duration = Duration::from_secs(366 * 86_400);

fn details(request: StartRequest, daemon: &DaemonConfig) -> Result<RunDetails, Refusal> {
    let duration = request
        .duration_s
        .map(|seconds| {
            let possible = daemon.cycle_period()..=DURATION_MAX;
            Duration::try_from_secs_f64(seconds).ok().filter(|duration| possible.contains(duration)).ok_or_else(|| {
                let cycle_s = daemon.cycle_period().as_secs_f64();
                let error = format!(
                    "duration of {seconds:?} s: must be one cycle ({cycle_s} s) to a year; leave it out to record until \
                     stopped"
                );
                Refusal { error }
            })
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
pub(crate) mod tests {
    use std::fs::File;
    use std::io;
    use std::path::Path;
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::time::Instant;

    use shared::config;
    use shared::recording::{Disk, Recording, SystemDisk};
    use shared::time::MonoNs;

    use super::*;
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

    /// A disk whose driver takes the recorder with it when it is told to.
    #[derive(Debug, Default)]
    struct DeadlyDisk(AtomicBool);

    impl Disk for DeadlyDisk {
        fn write_at(&self, file: &File, bytes: &[u8], offset: u64) -> io::Result<usize> {
            let recorder = thread::current().name() == Some("recorder");
            assert!(!(recorder && self.0.load(Ordering::Acquire)), "the test ends this thread");
            SystemDisk.write_at(file, bytes, offset)
        }
    }

    /// A service on the simulated bus in `directory`; what is stored into the flag ends the thread of the cycle.
    pub(crate) fn simulated(directory: &Path) -> (Service, Arc<AtomicBool>) {
        simulated_after(directory, Arc::new(SystemDisk), || {})
    }

    fn simulated_after(
        directory: &Path,
        disk: Arc<dyn Disk>,
        first: impl Fn() + Send + Sync + 'static,
    ) -> (Service, Arc<AtomicBool>) {
        let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config");
        let daemon: DaemonConfig = config::load(&shipped.join("daemon.toml")).unwrap();
        let daemon = DaemonConfig { directory: directory.to_owned(), ..daemon };
        let bar: BallBarConfig = config::load(&shipped.join("ball_bar.toml")).unwrap();
        let deadly = Arc::new(AtomicBool::new(false));
        let storage = Storage::on(disk, &daemon).unwrap();
        let places = storage.clone();
        let (armed, on_daemon, on_bar) = (Arc::clone(&deadly), daemon.clone(), bar.clone());
        let connect = move || {
            first();
            let motion = SmoothMotion::new(on_bar.encoders.len(), 3600, 1);
            let segment = SimulatedSegment::new(&SegmentConfig::default(), Box::new(motion));
            let wire = Deadly(InProcessWire::new(segment, Clock::Real), Arc::clone(&armed));
            run::open_on(Box::new(wire), &on_daemon, &on_bar, &places)
        };
        let settings = Settings {
            bus: BusChoice::Simulated,
            faults: Vec::new(),
            daemon,
            bar,
            homing_file: directory.join("homing.toml"),
        };
        (Service::start_on(settings, storage, Arc::new(connect)).unwrap(), deadly)
    }

    /// Begins a run and waits until it is being written.
    pub(crate) fn record(service: &Service, name: &str) {
        wait_until(service, "the bus", |status| status.state == "waiting");
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let request = StartRequest { name: Some(name.into()), ..StartRequest::default() };
        assert_eq!(runtime.block_on(service.begin(request)).unwrap(), Answer::Beginning);
        wait_until(service, "writing", |status| status.state == "writing");
    }

    #[test]
    fn a_cycle_thread_that_dies_leaves_a_finished_file_with_the_cause_and_is_replaced() {
        let directory = tempfile::tempdir().unwrap();
        let (service, deadly) = simulated(directory.path());
        record(&service, "cut");
        deadly.store(true, Ordering::Release);
        let fault = wait_until(&service, "the fault", |status| status.last.is_some());
        let last = fault.last.unwrap();
        assert!(last.cause.contains("thread of the cycle has ended"), "{}", last.cause);
        let recording = Recording::open(&directory.path().join("cut.mcap")).unwrap();
        assert_eq!((recording.end.cause, recording.cycles.len() as u64), (last.cause, last.cycles));
        assert!(recording.cycles.len() > 50);
        assert_eq!(fault.state, "fault");
        deadly.store(false, Ordering::Release);
        record(&service, "next");
        service.shutdown("test over");
        service.join().unwrap();
        assert!(directory.path().join("next.mcap").exists());
    }

    #[test]
    fn a_control_thread_that_dies_leaves_a_finished_file_with_the_cause_and_ends_the_service() {
        let directory = tempfile::tempdir().unwrap();
        let (service, _) = simulated(directory.path());
        record(&service, "cut");
        service.kill_control();
        assert!(service.join().is_err());
        assert_eq!(service.status().state, "fault");
        let recording = Recording::open(&directory.path().join("cut.mcap")).unwrap();
        assert!(recording.end.cause.contains("thread of the control"), "{}", recording.end.cause);
        assert!(recording.cycles.len() > 50 && !recording.end.recovered);
    }

    #[test]
    fn a_recorder_that_dies_leaves_what_is_on_disk_finished_and_the_service_ready() {
        let directory = tempfile::tempdir().unwrap();
        let disk = Arc::new(DeadlyDisk::default());
        let (service, _) = simulated_after(directory.path(), disk.clone(), || {});
        record(&service, "cut");
        disk.0.store(true, Ordering::Release);
        let last = wait_until(&service, "its end", |status| status.last.is_some()).last.unwrap();
        assert!(last.cause.contains("recorder panicked") && last.error.is_some(), "{last:?}");
        disk.0.store(false, Ordering::Release);
        record(&service, "next");
        assert!(!Recording::open(&directory.path().join("cut.mcap")).unwrap().cycles.is_empty());
        service.shutdown("test over");
        service.join().unwrap();
    }

    #[test]
    fn a_thread_that_dies_bringing_the_bus_up_is_followed_by_another() {
        let directory = tempfile::tempdir().unwrap();
        let died = AtomicBool::new(false);
        let first = move || assert!(died.swap(true, Ordering::AcqRel), "the test ends this thread");
        let (service, _) = simulated_after(directory.path(), Arc::new(SystemDisk), first);
        wait_until(&service, "the fault", |status| {
            status.reason.as_ref().is_some_and(|reason| reason.contains("the thread that brings the bus up"))
        });
        record(&service, "next");
        service.shutdown("test over");
        service.join().unwrap();
    }
}
