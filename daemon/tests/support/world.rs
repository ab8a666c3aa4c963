//! Virtual time for time-outs and disk calls, in one thread. Steppers are polled one after the other, and the clock
//! advances to the time at which the next stepper is due. If a call hangs, its stepper is busy until the call
//! returns. The other steppers continue.

use std::cell::{Cell, RefCell};
use std::future::Future;
use std::io;
use std::pin::Pin;
use std::rc::Rc;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use ballbard::clock::Clock;
use ballbard::scheduler::{Begin, Scheduler, Stepper, Task};
use shared::time::{MonoNs, UtcNs};
use tokio::sync::oneshot;

/// Interval at which a pending future is polled.
const POLL_PERIOD: Duration = Duration::from_millis(1);

/// A stepper, and the instant at which it is polled next. `None` if it has ended.
struct Due {
    at: Cell<Option<MonoNs>>,
    stepper: RefCell<Box<dyn Stepper>>,
}

/// The virtual clock with all its steppers. Clones share the same clock and steppers.
#[derive(Clone)]
pub struct World {
    pub clock: Clock,
    steppers: Rc<RefCell<Vec<Rc<Due>>>>,
    handle: Arc<Handle>,
}

thread_local! {
    static HERE: RefCell<Option<World>> = const { RefCell::new(None) };
}

impl World {
    /// Starts virtual time in this thread. Its first time is zero.
    pub fn begin() -> Self {
        let clock = Clock::virtual_from(UtcNs(0));
        let handle = Arc::new(Handle { clock: clock.clone(), begun: Mutex::default() });
        let world = Self { clock, steppers: Rc::default(), handle };
        HERE.set(Some(world.clone()));
        world
    }

    /// The world of this thread. `None` if the thread runs in real time.
    pub fn here() -> Option<Self> {
        HERE.with_borrow(Option::clone)
    }

    /// Ends virtual time in this thread, which then runs in real time.
    pub fn end(self) {
        HERE.set(None);
        self.steppers.borrow_mut().clear();
    }

    /// Runs the actions of a client in a new world, in virtual time. Returns the result of the actions.
    pub fn live<T: 'static>(person: impl Future<Output = T> + 'static) -> T {
        let world = Self::begin();
        let result = Rc::<Cell<Option<T>>>::default();
        let given = Rc::clone(&result);
        world.spawn(async move { given.set(Some(person.await)) });
        let result = loop {
            assert!(world.step(MonoNs(i64::MAX)), "no stepper is due");
            if let Some(result) = result.take() {
                break result;
            }
        };
        world.end();
        result
    }

    /// A scheduler that runs the steppers of a service in this world.
    pub fn scheduler(&self) -> Arc<dyn Scheduler> {
        self.handle.clone()
    }

    /// Adds a stepper that is due immediately.
    pub fn add(&self, stepper: impl Stepper + 'static) {
        let due = Due { at: Cell::new(Some(self.clock.now())), stepper: RefCell::new(Box::new(stepper)) };
        self.steppers.borrow_mut().push(Rc::new(due));
    }

    /// Adds a client whose actions run concurrently with the other steppers.
    pub fn spawn(&self, person: impl Future<Output = ()> + 'static) {
        self.add(Person(Box::pin(person)));
    }

    /// Polls the next stepper that is due and not busy. Returns false if no such stepper is due by `until`.
    pub fn step(&self, until: MonoNs) -> bool {
        for begun in std::mem::take(&mut *self.handle.begun.lock().unwrap()) {
            self.add(Beginning::Begin(Some(begun)));
        }
        let idle =
            |due: &&Rc<Due>| due.stepper.try_borrow().is_ok() && due.at.get().is_some_and(|at| at <= until);
        // If several steppers are due at the same time, the first of them is polled.
        let next = self.steppers.borrow().iter().filter(idle).min_by_key(|due| due.at.get()).cloned();
        let Some(due) = next else { return false };
        self.clock.sleep_until(due.at.get().unwrap_or(until));
        let pause = due.stepper.borrow_mut().poll(self.clock.now());
        due.at.set(pause.map(|pause| self.clock.now().plus_ns(pause.as_nanos() as i64)));
        if pause.is_none() {
            self.steppers.borrow_mut().retain(|other| !Rc::ptr_eq(other, &due));
        }
        true
    }

    /// Lets time pass for the calling stepper. The stepper is busy during this time, and other steppers continue.
    pub fn pass(&self, time: Duration) {
        let until = self.clock.now().plus_ns(time.as_nanos() as i64);
        while self.step(until) {}
        self.clock.sleep_until(until);
    }
}

/// Lets time pass: virtual time if this thread has a world, otherwise real time.
pub fn pass(time: Duration) {
    match World::here() {
        Some(world) => world.pass(time),
        None => std::thread::sleep(time),
    }
}

/// Current time of this thread's world.
pub fn now() -> MonoNs {
    World::here().unwrap().clock.now()
}

pub fn since(begun: MonoNs) -> Duration {
    Duration::from_nanos(now().ns_since(begun).unsigned_abs())
}

/// A future that is ready after this time. Other steppers continue until then.
pub async fn sleep(time: Duration) {
    World::here().unwrap().handle.sleep(time).await;
}

/// The scheduler of a world. Services use it to start steppers. It collects new steppers until [`World::step`] adds them.
struct Handle {
    clock: Clock,
    begun: Mutex<Vec<Begin>>,
}

impl std::fmt::Debug for Handle {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("World")
    }
}

impl Scheduler for Handle {
    fn clock(&self) -> &Clock {
        &self.clock
    }

    fn start(&self, _: &str, begin: Begin) -> io::Result<()> {
        self.begun.lock().unwrap().push(begin);
        Ok(())
    }

    fn spawn(&self, task: Task) {
        self.begun.lock().unwrap().push(Box::new(|| Box::new(Person(task))));
    }

    fn sleep(&self, time: Duration) -> Task {
        let (wake, woken) = oneshot::channel();
        self.begun
            .lock()
            .unwrap()
            .push(Box::new(move || Box::new(Alarm { time: Some(time), wake: Some(wake) })));
        Box::pin(async {
            let _ = woken.await;
        })
    }
}

/// A stepper that is created in its first step. Its creation may hang, and the hang must not block the other steppers.
enum Beginning {
    Begin(Option<Begin>),
    Begun(Box<dyn Stepper>),
}

impl Stepper for Beginning {
    fn poll(&mut self, now: MonoNs) -> Option<Duration> {
        if let Self::Begin(begin) = self {
            *self = Self::Begun(begin.take()?());
        }
        let Self::Begun(stepper) = self else { return None };
        stepper.poll(now)
    }
}

/// A client as a stepper: a future that performs actions in order.
struct Person<F: ?Sized>(Pin<Box<F>>);

impl<F: Future<Output = ()> + ?Sized> Stepper for Person<F> {
    fn poll(&mut self, _: MonoNs) -> Option<Duration> {
        match self.0.as_mut().poll(&mut Context::from_waker(Waker::noop())) {
            Poll::Ready(()) => None,
            Poll::Pending => Some(POLL_PERIOD),
        }
    }
}

/// A stepper that wakes a future after a time.
struct Alarm {
    time: Option<Duration>,
    wake: Option<oneshot::Sender<()>>,
}

impl Stepper for Alarm {
    fn poll(&mut self, _: MonoNs) -> Option<Duration> {
        let time = self.time.take();
        if time.is_none() {
            let _ = self.wake.take()?.send(());
        }
        time
    }
}
