//! Virtual time for a recorder and those around it, in one thread: the clock moves from one due actor to the next. A call that
//! hangs is an event, too: its actor is busy until then, and the others continue.

use std::cell::{Cell, RefCell};
use std::rc::Rc;
use std::time::Duration;

use ballbard::clock::Clock;
use shared::time::{MonoNs, UtcNs};

/// Somebody who does something each period.
pub trait Actor {
    /// Does it; when next, or never again.
    fn act(&mut self, now: MonoNs) -> Option<MonoNs>;
}

/// An actor and when it is due.
struct Due {
    at: Cell<Option<MonoNs>>,
    actor: RefCell<Box<dyn Actor>>,
}

/// The actors and their clock. Clones are the same.
#[derive(Clone)]
pub struct World {
    pub clock: Clock,
    actors: Rc<RefCell<Vec<Rc<Due>>>>,
}

thread_local! {
    static HERE: RefCell<Option<World>> = const { RefCell::new(None) };
}

impl World {
    /// Starts virtual time in this thread.
    pub fn begin() -> Self {
        let world = Self { clock: Clock::virtual_from(UtcNs(0)), actors: Rc::default() };
        HERE.set(Some(world.clone()));
        world
    }

    /// The world of this thread; `None` on real time.
    pub fn here() -> Option<Self> {
        HERE.with_borrow(Option::clone)
    }

    /// Returns this thread to real time.
    pub fn end(self) {
        HERE.set(None);
        self.actors.borrow_mut().clear();
    }

    /// Adds an actor who is due at once.
    pub fn add(&self, actor: impl Actor + 'static) {
        let due = Due { at: Cell::new(Some(self.clock.now())), actor: RefCell::new(Box::new(actor)) };
        self.actors.borrow_mut().push(Rc::new(due));
    }

    /// Lets the next actor act who is due until `until` and not busy; false if there is none.
    pub fn step(&self, until: MonoNs) -> bool {
        let idle =
            |due: &&Rc<Due>| due.actor.try_borrow().is_ok() && due.at.get().is_some_and(|at| at <= until);
        // The first of those who are due at the same time.
        let next = self.actors.borrow().iter().filter(idle).min_by_key(|due| due.at.get()).cloned();
        let Some(due) = next else { return false };
        self.clock.sleep_until(due.at.get().unwrap_or(until));
        let next = due.actor.borrow_mut().act(self.clock.now());
        due.at.set(next);
        true
    }

    /// Time passes; whoever lets it pass is busy.
    pub fn pass(&self, time: Duration) {
        let until = self.clock.now().plus_ns(time.as_nanos() as i64);
        while self.step(until) {}
        self.clock.sleep_until(until);
    }
}

/// Sleeps on the time of this thread.
pub fn pass(time: Duration) {
    match World::here() {
        Some(world) => world.pass(time),
        None => std::thread::sleep(time),
    }
}
