//! Runs work in steps. Any work that waits for time or for a disk is a [`Stepper`]. A stepper is called with the current
//! time, and returns how long to wait until the next call. A [`Scheduler`] calls the steppers. In real time, each stepper
//! has its own thread. In virtual time, one loop calls all of them.

use std::fmt;
use std::future::Future;
use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, TryRecvError, sync_channel};
use std::thread;
use std::time::Duration;

use shared::time::MonoNs;

use crate::clock::Clock;

/// Size of the stack of each thread \[bytes\]. If memory is locked, the whole stack is allocated.
/// Threads use several times less.
pub(crate) const STACK_BYTES: usize = 1 << 20;

/// A task whose work is done in steps.
pub trait Stepper {
    /// Does the work that is due now. The call may wait for a disk if this is the stepper's purpose, but for nothing else.
    /// Returns the time until the next step, or `None` after the last step.
    fn poll(&mut self, now: MonoNs) -> Option<Duration>;

    /// Waits until the next step, in the stepper's own thread. May return earlier if there is work to do.
    fn wait(&mut self, pause: Duration) {
        thread::sleep(pause);
    }
}

/// A function that is called for each step.
impl<F: FnMut(MonoNs) -> Option<Duration>> Stepper for F {
    fn poll(&mut self, now: MonoNs) -> Option<Duration> {
        self(now)
    }
}

/// Function that creates a stepper. It is called in the thread in which the stepper will work.
pub type Begin = Box<dyn FnOnce() -> Box<dyn Stepper> + Send>;
/// A future that returns no result.
pub type Task = Pin<Box<dyn Future<Output = ()> + Send>>;

/// Runs steppers and futures.
pub trait Scheduler: fmt::Debug + Send + Sync {
    /// The clock on which the steppers run.
    fn clock(&self) -> &Clock;

    /// Creates a stepper and calls it until its last step. `name` is the name of its thread.
    fn start(&self, name: &str, begin: Begin) -> io::Result<()>;

    /// Runs a future until it is ready.
    fn spawn(&self, task: Task);

    /// A future that is ready after this time.
    fn sleep(&self, time: Duration) -> Task;
}

/// Runs each stepper in a thread of its own, and futures on tokio's runtime.
#[derive(Debug)]
pub struct Threads(Clock);

impl Threads {
    /// A scheduler on this clock. If the clock is virtual, the thread of the cycle advances it as fast as it can.
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

/// Calls `poll` once per period until it returns a value. Returns that value.
pub async fn until<T>(scheduler: &dyn Scheduler, period: Duration, mut poll: impl FnMut() -> Option<T>) -> T {
    loop {
        if let Some(value) = poll() {
            return value;
        }
        scheduler.sleep(period).await;
    }
}

/// The next message of a queue. `None` if no message is waiting. [`Died`] if the other end was dropped.
pub fn received<T>(queue: &Receiver<T>) -> Option<Result<T, Died>> {
    match queue.try_recv() {
        Ok(message) => Some(Ok(message)),
        Err(TryRecvError::Empty) => None,
        Err(TryRecvError::Disconnected) => Some(Err(Died)),
    }
}

/// The result of work that may wait for a disk. The thread that started the work polls for the result.
#[derive(Debug)]
pub struct Pending<T> {
    result: Receiver<T>,
    since: MonoNs,
}

/// The work ended without a result. The log contains the cause.
#[derive(Debug)]
pub struct Died;

impl<T: Send + 'static> Pending<T> {
    /// Starts work that consists of one step.
    pub fn start(scheduler: &dyn Scheduler, name: &str, work: impl FnOnce() -> T + Send + 'static) -> Self {
        let mut work = Some(work);
        Self::until(scheduler, name, move || work.take().map(|work| work()))
    }

    /// Starts work that consists of several steps. The work ends when a step returns a result.
    pub fn until(
        scheduler: &dyn Scheduler,
        name: &str,
        mut step: impl FnMut() -> Option<T> + Send + 'static,
    ) -> Self {
        let (sender, result) = sync_channel(1);
        let work = move |_: MonoNs| {
            let Some(result) = step() else { return Some(WORK_PERIOD) };
            // The receiver of the result may no longer exist.
            let _ = sender.send(result);
            None
        };
        let begin = Box::new(move || Box::new(work) as Box<dyn Stepper>);
        if let Err(error) = scheduler.start(name, begin) {
            tracing::error!("cannot start the thread {name}: {error}");
        }
        Self { result, since: scheduler.clock().now() }
    }

    /// The result of the work. It is returned only once. `None` while the work continues.
    pub fn poll(&self) -> Option<Result<T, Died>> {
        received(&self.result)
    }

    /// Time at which the work was started.
    pub fn since(&self) -> MonoNs {
        self.since
    }
}

/// Pause between the steps of work that is [`Pending`].
const WORK_PERIOD: Duration = Duration::from_millis(5);
