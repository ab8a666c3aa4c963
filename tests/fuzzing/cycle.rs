//! The cycle of a bus in operation whose replies are damaged as the fuzzer says.

use std::cell::RefCell;

use ballbard::bus::Bus;
use ballbard::clock::Clock;
use ballbard::cycle::{Acquisition, BusNames};
use shared::recording::schema::CycleRecord;
use shared::time::UtcNs;

use super::bring_up::{plan, segment};
use super::replies::{DamagedWire, Script};

/// Cycles at most until the script is over ...
const CYCLES_MAX: usize = 200;
/// ... and then until there is a valid sample again: seconds, in which the bus is brought up anew if need be.
const RECOVERY_CYCLES_MAX: usize = 1000;

/// An acquisition that goes on from one script to the next; only so is one quick.
struct Rig {
    acquisition: Acquisition,
    wire: DamagedWire,
    last: Option<CycleRecord>,
}

impl Rig {
    fn new() -> Self {
        let clock = Clock::virtual_from(UtcNs(1_790_000_000_000_000_000));
        let wire = DamagedWire::new(segment(&clock));
        let plan = plan();
        let bus = Bus::new(Box::new(wire.clone()), clock.clone(), plan.reply_timeout);
        let mut acquisition = Acquisition::start(bus, &plan, clock).expect("a bus without faults");
        acquisition.begin_run(|_| ());
        Self { acquisition, wire, last: None }
    }

    /// One cycle, whose records are as they have to be.
    fn cycle(&mut self) {
        let last = &mut self.last;
        self.acquisition.next_cycle(&mut |record| {
            assert_eq!(record.cycle, last.map_or(0, |last| last.cycle + 1), "a hole");
            assert!(last.is_none_or(|last| record.sample_time > last.sample_time), "time runs backwards");
            assert!(record.is_valid() || record.flags != 0, "a bad cycle without a reason");
            *last = Some(*record);
        });
        while let Some(event) = self.acquisition.take_event() {
            assert!(event.to_event(&BusNames::default()).text.len() > 10, "an event without words");
        }
    }

    fn is_valid(&self) -> bool {
        self.last.is_some_and(|last| last.is_valid())
    }
}

/// Every cycle that is due gives its record, time goes forward, and a bus that is well again gives valid samples again.
pub fn any_replies(bytes: &[u8]) {
    thread_local!(static RIG: RefCell<Rig> = RefCell::new(Rig::new()));
    RIG.with_borrow_mut(|rig| {
        rig.wire.play(Script::of(bytes));
        for _ in 0..CYCLES_MAX {
            rig.cycle();
            if rig.wire.is_over() {
                break;
            }
        }
        rig.wire.play(Script::of(&[]));
        let recovered = (0..RECOVERY_CYCLES_MAX).any(|_| {
            rig.cycle();
            rig.is_valid()
        });
        assert!(recovered, "the bus never came back");
    });
}

/// Nothing wrong; a lost reply; inputs, working counters and bus times that are not so; a cut reply.
pub fn scripts() -> Vec<Vec<u8>> {
    vec![
        vec![],
        vec![0, 3, 0, 0, 0, 0, 0, 0],
        vec![2, 5, 0, 0, 10, 0xff, 0xff, 1, 2, 3, 4, 5, 6, 7, 8],
        vec![2, 5, 0, 16, 2, 0, 0, 2, 0, 0, 16, 2, 1, 0],
        vec![2, 1, 0, 26, 8, 1, 2, 3, 4, 5, 6, 7, 8, 2, 0, 0, 26, 8, 0, 0, 0, 0, 0, 0, 0, 0],
        vec![1, 2, 0, 20],
    ]
}
