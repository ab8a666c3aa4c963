//! The interface of the service for other threads; the API uses it.
//!
//! [`Service`] starts two steppers. The control owns the [`controller`](super::controller). The other stepper computes the
//! content of the page. A request waits in a queue until the control executes it and returns the reply through a channel.
//! Requests that need the disk first run in a task with a time limit, because a disk may hang.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TryRecvError, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use shared::recording::Disk;
use shared::time::MonoNs;
use tokio::sync::{Semaphore, oneshot, watch};

use super::controller::preflight::{self, DiskFindings};
use super::controller::{Command, Controller};
use super::live::{self, Minute, Moment, Watched};
use super::machine::Answer;
use super::recordings::runs;
use super::settings::Connect;
pub use super::settings::Settings;
use super::status::{CheckLine, LastRun, NameReply, NameRequest, Refusal, StartRequest, Status};
use crate::clock::Clock;
use crate::problem::{Fact, Problem};
use crate::run::{self, RunDetails, RunError, Setup, Stop, Storage};
use crate::scheduler::{Pending, Scheduler, Stepper, Threads};

/// Channel that receives the result of the service when it has ended.
type ServiceEnd = Receiver<Result<(), ServiceError>>;

/// Handle of the service. Clones refer to the same service.
#[derive(Clone)]
pub struct Service {
    commands: SyncSender<Command>,
    ending: Stop,
    status: watch::Receiver<Status>,
    live: Watched,
    settings: Arc<Settings>,
    disk: Arc<dyn Disk>,
    outcome: Arc<Mutex<Option<ServiceEnd>>>,
    disk_tasks: Arc<Semaphore>,
    scheduler: Arc<dyn Scheduler>,
}

/// Capacity of the queue of requests to the control. The control empties the queue within milliseconds. If the queue is
/// full, a request is refused.
const COMMANDS_MAX: usize = 64;
/// Number of requests that may wait for the disk at the same time.
const DISK_TASKS_MAX: usize = 4;
/// How long a request may wait for the disk. After this time the service replies without a result from the disk.
const DISK_TIMEOUT: Duration = Duration::from_secs(1);
/// How long the service may take to list the recordings, of which there may be hundreds.
pub(super) const LIST_TIMEOUT: Duration = Duration::from_secs(10);

/// Reason why the service cannot start, or has ended without a request.
#[derive(Debug, thiserror::Error)]
pub enum ServiceError {
    /// Another process records into the directory of this service.
    #[error(transparent)]
    Run(#[from] RunError),
    /// The operating system refused to start a thread.
    #[error("cannot start the service's thread: {0}; end other programs, and start it again")]
    Thread(#[from] std::io::Error),
    /// A thread of the service has died.
    #[error("a thread of the service has ended (the log shows why); start the service again")]
    Died,
}

impl Service {
    /// Starts the service. It recovers runs that a crash left unfinished, brings the bus into operation, and keeps it in
    /// operation. If another process uses the directory, the service ends and [`join`](Self::join) returns the error.
    pub fn start(settings: Settings) -> Result<Self, ServiceError> {
        let scheduler = Threads::on(Clock::Real);
        let storage = Storage::new(&settings.daemon, &*scheduler)?;
        Self::start_in(scheduler, storage, settings)
    }

    /// Starts the service like [`start`](Self::start), on another disk or clock.
    pub fn start_in(
        scheduler: Arc<dyn Scheduler>,
        storage: Storage,
        settings: Settings,
    ) -> Result<Self, ServiceError> {
        let Settings { bus, faults, daemon, bar, .. } = settings.clone();
        let setup = Setup { scheduler: Arc::clone(&scheduler), storage: storage.clone(), daemon, bar };
        let connect = move || run::start_opening(&setup, &bus, &faults);
        Self::start_with(scheduler, settings, storage, Arc::new(connect))
    }

    /// Starts the service like [`start`](Self::start), with another function that connects to the bus.
    pub(crate) fn start_with(
        scheduler: Arc<dyn Scheduler>,
        settings: Settings,
        storage: Storage,
        connect: Arc<Connect>,
    ) -> Result<Self, ServiceError> {
        let disk = storage.disk();
        let settings = Arc::new(settings);
        let (commands, commands_rx) = sync_channel(COMMANDS_MAX);
        let ending = Stop::default();
        let (status_tx, status) = watch::channel(Status::default());
        let live = live::watch(Arc::clone(&settings), Arc::clone(&disk), status.clone(), &scheduler)?;
        let mut controller = Controller::new(
            Arc::clone(&settings),
            connect,
            storage,
            status_tx,
            ending.clone(),
            Arc::clone(&scheduler),
        );
        controller.prepare_storage();
        let (ended, outcome) = sync_channel(1);
        let control =
            Control { controller: Some(controller), commands: commands_rx, waiting: Vec::new(), ended };
        scheduler.start("control", Box::new(|| Box::new(control)))?;
        let outcome = Arc::new(Mutex::new(Some(outcome)));
        let disk_tasks = Arc::new(Semaphore::new(DISK_TASKS_MAX));
        Ok(Self { commands, ending, status, live, settings, disk, outcome, disk_tasks, scheduler })
    }

    /// The status after the last step of the control.
    pub fn status(&self) -> Status {
        self.status.borrow().clone()
    }

    /// Channel with the content of the page, updated ten times a second.
    pub fn live(&self) -> watch::Receiver<Arc<Moment>> {
        self.live.latest.clone()
    }

    /// The angles of the last minute, for a new page.
    pub(super) fn minute(&self) -> Minute {
        self.live.minute()
    }

    /// The time on the service's clock.
    pub fn now(&self) -> MonoNs {
        self.scheduler.clock().now()
    }

    /// Channel that receives every change of the status.
    pub fn watch(&self) -> watch::Receiver<Status> {
        self.status.clone()
    }

    /// Configuration of the service.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// Begins a run. Completes when the file of the run has been created, or when the request is refused.
    pub(super) async fn begin(&self, request: StartRequest) -> Result<Answer, Refusal> {
        let named = request.name.is_some();
        let details =
            self.ask_disk(DISK_TIMEOUT, move |settings, disk| details(request, settings, disk)).await;
        let Some(details) = details else {
            return Ok(disk_silent());
        };
        let details = Box::new(details?);
        let begun = self.ask(move |controller| controller.start(details, named)).await?;
        begun.await.map_err(|_| ending())
    }

    /// Ends the run. Also returns a channel that receives the result of the run once it is finished.
    pub(super) async fn stop(&self, cause: String) -> Result<(Answer, oneshot::Receiver<LastRun>), Refusal> {
        self.ask(|controller| controller.stop(cause)).await
    }

    /// Begins a homing. Refuses if the marks could not be saved, so that no joint is turned in vain.
    pub(super) async fn home(&self) -> Result<Answer, Refusal> {
        match self.ask_disk(DISK_TIMEOUT, |settings, disk| settings.marks_file.problem(disk)).await {
            Some(None) => self.ask(Controller::home).await,
            Some(Some(problem)) => Ok(Answer::Refused(problem)),
            None => Ok(disk_silent()),
        }
    }

    /// Sets a marker. Returns the name of the run and the text of the marker; `None` if no run is in progress.
    pub(super) async fn mark(
        &self,
        text: Option<String>,
        ago_ms: u32,
    ) -> Result<Option<(String, String)>, Refusal> {
        let at = self.now().plus_ns(-1_000_000 * i64::from(ago_ms));
        let marked = self.ask(move |controller| controller.mark(text, at)).await?;
        marked.map_err(Refusal::new)
    }

    /// Runs the pre-flight check.
    pub async fn check(&self) -> Result<Vec<CheckLine>, Refusal> {
        let found = self.ask_disk(DISK_TIMEOUT, DiskFindings::now).await;
        self.ask(move |controller| preflight::check(controller, found.as_ref())).await
    }

    /// The name that a run would get; `None` if the disk does not respond in time.
    pub(super) async fn name(&self, request: NameRequest) -> Option<NameReply> {
        let find = move |settings: &Settings, disk: &dyn Disk| {
            name_reply(&request, disk, &settings.daemon.directories())
        };
        self.ask_disk(DISK_TIMEOUT, find).await
    }

    /// The disk of the recordings.
    pub(super) fn disk(&self) -> Arc<dyn Disk> {
        Arc::clone(&self.disk)
    }

    /// Runs `find` on a thread that may wait for the disk. Returns `None` if `find` has not returned after the time `within`.
    pub(super) async fn ask_disk<T: Send + 'static>(
        &self,
        within: Duration,
        find: impl FnOnce(&Settings, &dyn Disk) -> T + Send + 'static,
    ) -> Option<T> {
        let (settings, disk) = (Arc::clone(&self.settings), Arc::clone(&self.disk));
        let found = async {
            let permit = Arc::clone(&self.disk_tasks).acquire_owned().await.ok()?;
            let (result, found) = oneshot::channel();
            let work = move || {
                let _ = result.send(find(&settings, &*disk));
                drop(permit);
            };
            // If no thread can be started, `result` is dropped, so that awaiting `found` returns an error.
            drop(Pending::start(&*self.scheduler, "disk request", work));
            found.await.ok()
        };
        self.within(within, found).await.flatten()
    }

    /// Output of a future; `None` if the future has not completed after this time.
    pub(super) async fn within<T>(&self, time: Duration, future: impl Future<Output = T>) -> Option<T> {
        tokio::select! {
            biased;
            output = future => Some(output),
            () = self.scheduler.sleep(time) => None,
        }
    }

    /// Runs a future to its end, even if the receiver of its output is dropped.
    pub(super) fn spawn<T: Send + 'static>(
        &self,
        future: impl Future<Output = T> + Send + 'static,
    ) -> oneshot::Receiver<T> {
        let (result, output) = oneshot::channel();
        self.scheduler.spawn(Box::pin(async move {
            let _ = result.send(future.await);
        }));
        output
    }

    /// Ends a current run with `cause` and finishes its file, then ends the service. Does not wait.
    pub fn shutdown(&self, cause: &str) {
        self.ending.stop(cause);
    }

    /// Waits for the end of the service. Also returns if the control thread has died. When this function
    /// returns, the file of the run is finished.
    pub fn join(&self) -> Result<(), ServiceError> {
        let outcome = self.outcome.lock().unwrap_or_else(PoisonError::into_inner).take();
        outcome.map_or(Ok(()), |outcome| outcome.recv().unwrap_or(Err(ServiceError::Died)))
    }

    /// Returns when the service has ended, for any reason.
    pub async fn ended(&self) {
        // The condition is never true: this returns when the sender is dropped.
        let _ = self.watch().wait_for(|_| false).await;
    }

    /// Makes the control thread panic.
    #[cfg(test)]
    pub(crate) fn kill_control(&self) {
        let _ = self.commands.try_send(Box::new(|_| panic!("the test ends this thread")));
    }

    /// Executes a request in the control thread, publishes the status, and returns the reply.
    async fn ask<T: Send + 'static>(
        &self,
        request: impl FnOnce(&mut Controller) -> T + Send + 'static,
    ) -> Result<T, Refusal> {
        let (reply, answer) = oneshot::channel();
        let command = move |controller: &mut Controller| {
            let answer = request(controller);
            controller.publish();
            // If the client has disconnected, its request is executed regardless.
            let _ = reply.send(answer);
        };
        self.commands.try_send(Box::new(command)).map_err(|error| match error {
            TrySendError::Full(_) => Refusal::from(Problem::from(Fact::ServiceBusy {})),
            TrySendError::Disconnected(_) => ending(),
        })?;
        answer.await.map_err(|_| ending())
    }
}

fn ending() -> Refusal {
    Problem::from(Fact::ServiceEnding {}).into()
}

/// The controller with its queue of commands, as a stepper.
struct Control {
    /// `None` once the service has ended.
    controller: Option<Controller>,
    commands: Receiver<Command>,
    /// Commands that the next step executes.
    waiting: Vec<Command>,
    ended: SyncSender<Result<(), ServiceError>>,
}

impl Control {
    fn step(&mut self, now: MonoNs) -> Option<Duration> {
        let controller = self.controller.as_mut()?;
        loop {
            match self.commands.try_recv() {
                Ok(command) => self.waiting.push(command),
                Err(TryRecvError::Empty) => break,
                Err(TryRecvError::Disconnected) => {
                    controller.dropped();
                    break;
                }
            }
        }
        controller.poll(now, std::mem::take(&mut self.waiting))
    }
}

impl Stepper for Control {
    fn poll(&mut self, now: MonoNs) -> Option<Duration> {
        let outcome = match catch_unwind(AssertUnwindSafe(|| self.step(now))) {
            Ok(Some(pause)) => return Some(pause),
            // Drop the resources of the controller before the end of the service is reported.
            Ok(None) => self.controller.take()?.into_outcome().map_err(ServiceError::Run),
            Err(_) => {
                self.controller.take()?.abandon();
                Err(ServiceError::Died)
            }
        };
        let _ = self.ended.send(outcome);
        None
    }

    fn wait(&mut self, pause: Duration) {
        match self.commands.recv_timeout(pause) {
            Ok(command) => self.waiting.push(command),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => thread::sleep(pause),
        }
    }
}

fn disk_silent() -> Answer {
    Answer::Refused(Fact::DiskSilent { directory: None, silent_s: None }.into())
}

/// Longest duration of a run. A request for a longer run is taken for a typing error.
const DURATION_MAX: Duration = Duration::from_secs(366 * 86_400);

/// Builds the details of the run from a request and from the reference marks on disk.
fn details(request: StartRequest, settings: &Settings, disk: &dyn Disk) -> Result<RunDetails, Refusal> {
    let Settings { daemon, marks_file, .. } = settings;
    let homing = marks_file
        .read(disk)
        .map_err(|error| Refusal::from(Problem::from(Fact::MarksUnreadable { error: error.to_string() })))?;
    let duration =
        request.duration_s.map(|seconds| checked_duration(seconds, daemon.cycle_period())).transpose()?;
    let about = request.about();
    let automatic = || runs::automatic_name(disk, &daemon.directories(), &about.robot, &about.bar);
    let name = request.name.map_or_else(|| Ok(automatic()), |typed| run::typed_name(&typed));
    let name = name.map_err(Refusal::new)?;
    Ok(RunDetails { name, about, duration, homing })
}

fn checked_duration(seconds: f64, cycle_period: Duration) -> Result<Duration, Refusal> {
    let possible = cycle_period..=DURATION_MAX;
    let duration = Duration::try_from_secs_f64(seconds).ok().filter(|duration| possible.contains(duration));
    duration.ok_or_else(|| {
        let cycle_s = cycle_period.as_secs_f64();
        Refusal::new(format!(
            "duration of {seconds:?} s: must be one cycle ({cycle_s} s) to a year; leave it out to record until stopped"
        ))
    })
}

fn name_reply(
    NameRequest { name, robot, bar }: &NameRequest,
    disk: &dyn Disk,
    directories: &[PathBuf],
) -> NameReply {
    if name.trim().is_empty() {
        return NameReply { name: runs::automatic_name(disk, directories, robot, bar), problem: None };
    }
    match run::typed_name(name) {
        Ok(name) => {
            let taken = || format!("run {name} exists and is never overwritten; choose another name");
            let problem = runs::is_taken(disk, directories, &name).then(taken);
            NameReply { name, problem }
        }
        Err(problem) => NameReply { name: String::new(), problem: Some(problem) },
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use std::fs::File;
    use std::io;
    use std::path::Path;
    use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
    use std::time::Instant;

    use shared::config::{self, DaemonConfig};
    use shared::recording::{Recording, SystemDisk};
    use shared::time::MonoNs;

    use super::*;
    use crate::control::status::ServiceState;
    use crate::homing::MarksFile;
    use crate::run::BusChoice;
    use crate::segment::simulated::{SegmentConfig, SimulatedSegment, SmoothMotion};
    use crate::segment::{FRAME_BYTES_MAX, FrameWire, InProcessWire};

    /// A wire that panics when the flag is set.
    struct Deadly(InProcessWire, Arc<AtomicBool>);

    impl FrameWire for Deadly {
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

    /// A disk that panics in the recorder's thread when the flag is set.
    #[derive(Debug, Default)]
    struct DeadlyDisk(AtomicBool);

    impl Disk for DeadlyDisk {
        fn write_at(&self, file: &File, bytes: &[u8], offset: u64) -> io::Result<usize> {
            let recorder = thread::current().name() == Some("recorder");
            assert!(!(recorder && self.0.load(Ordering::Acquire)), "the test ends this thread");
            SystemDisk.write_at(file, bytes, offset)
        }
    }

    /// A disk that refuses this number of the recorder's writes with "no space left".
    #[derive(Debug, Default)]
    struct FullDisk(AtomicU32);

    impl Disk for FullDisk {
        fn write_at(&self, file: &File, bytes: &[u8], offset: u64) -> io::Result<usize> {
            let one_less = |writes: u32| writes.checked_sub(1);
            let refuses = thread::current().name() == Some("recorder")
                && self.0.fetch_update(Ordering::AcqRel, Ordering::Acquire, one_less).is_ok();
            if refuses {
                return Err(io::Error::from_raw_os_error(libc::ENOSPC));
            }
            SystemDisk.write_at(file, bytes, offset)
        }
    }

    #[test]
    fn a_run_that_no_disk_takes_any_more_says_why_and_how_much_of_it_is_saved() {
        let directory = tempfile::tempdir().unwrap();
        let disk = Arc::new(FullDisk::default());
        let (service, _) = simulated_with(directory.path(), disk.clone(), || {});
        record(&service, "full");
        // The first refused write is in the directory of the run, the second in the spare directory.
        disk.0.store(2, Ordering::Release);
        let last = wait_until(&service, "its end", |status| status.last.is_some()).last.unwrap();
        let error = last.error.unwrap();
        assert!(error.contains("No space left") && error.contains("check free space"), "{error}");
        let file = last.file.unwrap();
        let recording = Recording::open(Path::new(&file)).unwrap();
        assert!(last.cycles > 0 && recording.cycles.len() as u64 == last.cycles, "{} cycles", last.cycles);
        assert!(error.contains(&format!("{} cycles are saved in {file}", last.cycles)), "{error}");
        service.shutdown("test over");
        service.join().unwrap();
    }

    fn runtime() -> tokio::runtime::Runtime {
        tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap()
    }

    /// The default configuration, with all output in `directory`.
    pub(crate) fn settings(directory: &Path) -> Settings {
        let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config");
        let daemon: DaemonConfig = config::load(&shipped.join("daemon.toml")).unwrap();
        let (home, spare_directory) = (directory.to_owned(), directory.join("spare"));
        Settings {
            bus: BusChoice::Simulated,
            faults: Vec::new(),
            daemon: DaemonConfig { directory: home, spare_directory, ..daemon },
            bar: config::load(&shipped.join("ball_bar.toml")).unwrap(),
            marks_file: MarksFile::new(directory.to_owned(), None),
            live_tap: None,
        }
    }

    /// Starts a service on the simulated bus in `directory`. Setting the returned flag ends the cycle thread.
    pub(crate) fn simulated(directory: &Path) -> (Service, Arc<AtomicBool>) {
        simulated_with(directory, Arc::new(SystemDisk), || {})
    }

    /// Starts a service like [`simulated`], on this disk. `on_connect` is called whenever the bus is brought into operation.
    fn simulated_with(
        directory: &Path,
        disk: Arc<dyn Disk>,
        on_connect: impl Fn() + Send + Sync + 'static,
    ) -> (Service, Arc<AtomicBool>) {
        let settings = settings(directory);
        let deadly = Arc::new(AtomicBool::new(false));
        let scheduler = Threads::on(Clock::Real);
        let storage = Storage::on(disk, &settings.daemon, &*scheduler).unwrap();
        let (armed, daemon, bar) = (Arc::clone(&deadly), settings.daemon.clone(), settings.bar.clone());
        let setup = Setup { scheduler: Arc::clone(&scheduler), storage: storage.clone(), daemon, bar };
        let connect = move || {
            on_connect();
            let motion = SmoothMotion::new(setup.bar.encoders.len(), 3600, 1);
            let segment = SimulatedSegment::new(&SegmentConfig::default(), Box::new(motion));
            let wire = Deadly(InProcessWire::new(segment, Clock::Real), Arc::clone(&armed));
            run::open_on_wire(Box::new(wire), &setup)
        };
        (Service::start_with(scheduler, settings, storage, Arc::new(connect)).unwrap(), deadly)
    }

    /// Begins a run and waits until its cycles reach the file.
    pub(crate) fn record(service: &Service, name: &str) {
        wait_until(service, "the bus", |status| status.state == ServiceState::Waiting);
        let request = StartRequest { name: Some(name.into()), ..StartRequest::default() };
        assert_eq!(runtime().block_on(service.begin(request)).unwrap(), Answer::Beginning);
        let has_enough = |status: &Status| status.run.as_ref().is_some_and(|run| run.cycles_taken > 50);
        wait_until(service, "writing", |status| status.state == ServiceState::Writing && has_enough(status));
    }

    #[test]
    fn a_cycle_thread_that_dies_leaves_a_finished_file_with_the_cause_and_is_replaced() {
        let directory = tempfile::tempdir().unwrap();
        let (service, deadly) = simulated(directory.path());
        record(&service, "cut");
        deadly.store(true, Ordering::Release);
        let fault = wait_until(&service, "the fault", |status| status.last.is_some());
        let last = fault.last.unwrap();
        assert!(last.cause.contains("cycle thread has ended"), "{}", last.cause);
        let recording = Recording::open(&directory.path().join("cut.mcap")).unwrap();
        assert_eq!((recording.end.cause, recording.cycles.len() as u64), (last.cause, last.cycles));
        assert!(recording.cycles.len() > 50);
        assert_eq!(fault.state, ServiceState::Fault);
        deadly.store(false, Ordering::Release);
        record(&service, "next");
        service.shutdown("test over");
        service.join().unwrap();
        assert!(directory.path().join("next.mcap").exists());
    }

    #[test]
    fn a_homing_whose_cycle_thread_dies_says_so() {
        let directory = tempfile::tempdir().unwrap();
        let (service, deadly) = simulated(directory.path());
        wait_until(&service, "the bus", |status| status.state == ServiceState::Waiting);
        assert_eq!(runtime().block_on(service.home()).unwrap(), Answer::Beginning);
        deadly.store(true, Ordering::Release);
        let is_over = |status: &Status| status.homing.as_ref().is_some_and(|homing| homing.is_over);
        let error = wait_until(&service, "its end", is_over).homing.unwrap().error.unwrap();
        assert!(error.contains("cycle thread has ended") && error.contains("log"), "{error}");
        service.shutdown("test over");
        service.join().unwrap();
    }

    #[test]
    fn a_control_thread_that_dies_leaves_a_finished_file_with_the_cause_and_ends_the_service() {
        let directory = tempfile::tempdir().unwrap();
        let (service, _) = simulated(directory.path());
        record(&service, "cut");
        service.kill_control();
        assert!(service.join().is_err());
        assert_eq!(service.status().state, ServiceState::Fault);
        let recording = Recording::open(&directory.path().join("cut.mcap")).unwrap();
        assert!(recording.end.cause.contains("control thread"), "{}", recording.end.cause);
        assert!(recording.cycles.len() > 50 && !recording.end.recovered);
    }

    #[test]
    fn a_recorder_that_dies_leaves_what_is_on_disk_finished_and_the_service_ready() {
        let directory = tempfile::tempdir().unwrap();
        let disk = Arc::new(DeadlyDisk::default());
        let (service, _) = simulated_with(directory.path(), disk.clone(), || {});
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
        let die_once = move || assert!(died.swap(true, Ordering::AcqRel), "the test ends this thread");
        let (service, _) = simulated_with(directory.path(), Arc::new(SystemDisk), die_once);
        wait_until(&service, "the fault", |status| {
            status.reason.as_ref().is_some_and(|reason| reason.contains("the bring-up thread has ended"))
        });
        record(&service, "next");
        service.shutdown("test over");
        service.join().unwrap();
    }
}
