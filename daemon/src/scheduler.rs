//! Work in steps. Whatever waits for time or a disk is a [`Stepper`] that gets the time and returns when to call it again; a
//! [`Scheduler`] calls it: a thread for each on real time, one loop for all on virtual time.

use std::fmt;
use std::future::Future;
use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};
use std::thread;
use std::time::Duration;

use shared::time::MonoNs;

use crate::clock::Clock;

/// Stack of each thread: locked memory is fully allocated; this is several times the actual use.
pub(crate) const STACK_BYTES: usize = 1 << 20;

/// A task that works in steps.
pub trait Stepper {
    /// Does the work that is due. Waits for nothing but a disk, and only if that is its purpose. Returns the time until the
    /// next step; the last step returns `None`.
    fn poll(&mut self, now: MonoNs) -> Option<Duration>;

    /// Waits in a thread of its own; returns earlier if there is work.
    fn wait(&mut self, pause: Duration) {
        thread::sleep(pause);
    }
}

/// Creates a stepper in the thread in which it works.
pub type Begin = Box<dyn FnOnce() -> Box<dyn Stepper> + Send>;
/// A future without a result.
pub type Task = Pin<Box<dyn Future<Output = ()> + Send>>;

/// Runs steppers and futures.
pub trait Scheduler: fmt::Debug + Send + Sync {
    /// The clock of the steppers.
    fn clock(&self) -> &Clock;

    /// Calls a stepper until its last step.
    fn start(&self, name: &str, begin: Begin) -> io::Result<()>;

    /// Polls a future to its end.
    fn spawn(&self, task: Task);

    /// A future that completes after this time.
    fn sleep(&self, time: Duration) -> Task;
}

/// A thread for each stepper; futures run on tokio's runtime.
#[derive(Debug)]
pub struct Threads(Clock);

impl Threads {
    /// On this clock; the cycle advances a virtual one as fast as it can.
    pub fn on(clock: Clock) -> Arc<dyn Scheduler> {
        Arc::new(Self(clock))
    }
}

impl Scheduler for Threads {
    fn clock(&self) -> &Clock {
        &self.0
    }

    fn start(&self, name: &str, begin: Begin) -> io::Result<()> {
        let clock = self.0.clone();
        let body = move || {
            let mut stepper = begin();
            while let Some(pause) = stepper.poll(clock.now()) {
                stepper.wait(pause);
            }
        };
        thread::Builder::new().name(name.into()).stack_size(STACK_BYTES).spawn(body).map(drop)
    }

    fn spawn(&self, task: Task) {
        tokio::spawn(task);
    }

    fn sleep(&self, time: Duration) -> Task {
        Box::pin(tokio::time::sleep(time))
    }
}

/// Calls `poll` once per period until it returns a value.
pub async fn until<T>(scheduler: &dyn Scheduler, period: Duration, mut poll: impl FnMut() -> Option<T>) -> T {
    loop {
        if let Some(value) = poll() {
            return value;
        }
        scheduler.sleep(period).await;
    }
}

/// The next message of a queue whose other end may have died; `None` while there is none.
pub fn received<T>(queue: &Receiver<T>) -> Option<Result<T, Died>> {
    match queue.try_recv() {
        Ok(message) => Some(Ok(message)),
        Err(TryRecvError::Empty) => None,
        Err(TryRecvError::Disconnected) => Some(Err(Died)),
    }
}

/// The result of work that may wait for a disk.
#[derive(Debug)]
pub struct Pending<T> {
    result: Receiver<T>,
    since: MonoNs,
}

/// The work has ended without a message; its cause is in the log.
#[derive(Debug)]
pub struct Died;

impl<T: Send + 'static> Pending<T> {
    /// Starts work that takes one step.
    pub fn start(scheduler: &dyn Scheduler, name: &str, work: impl FnOnce() -> T + Send + 'static) -> Self {
        let mut work = Some(work);
        Self::until(scheduler, name, move || work.take().map(|work| work()))
    }

    /// Starts work of several steps, until one returns a result.
    pub fn until(
        scheduler: &dyn Scheduler,
        name: &str,
        step: impl FnMut() -> Option<T> + Send + 'static,
    ) -> Self {
        let (sender, result) = sync_channel(1);
        let work = PendingWork { step, result: sender };
        let begin = Box::new(move || Box::new(work) as Box<dyn Stepper>);
        if let Err(error) = scheduler.start(name, begin) {
            tracing::error!("cannot start the thread {name}: {error}");
        }
        Self { result, since: scheduler.clock().now() }
    }

    /// The result, returned once; `None` while the work continues.
    pub fn poll(&self) -> Option<Result<T, Died>> {
        received(&self.result)
    }

    /// When the work was started.
    pub fn since(&self) -> MonoNs {
        self.since
    }
}

/// Pause between the steps of [`Pending`] work.
const WORK_PERIOD: Duration = Duration::from_millis(5);

/// The stepper of [`Pending`] work.
struct PendingWork<W, T> {
    step: W,
    result: SyncSender<T>,
}

impl<W: FnMut() -> Option<T>, T> Stepper for PendingWork<W, T> {
    fn poll(&mut self, _: MonoNs) -> Option<Duration> {
        let Some(result) = (self.step)() else { return Some(WORK_PERIOD) };
        // The receiver of the result may have ended.
        let _ = self.result.send(result);
        None
    }
}
