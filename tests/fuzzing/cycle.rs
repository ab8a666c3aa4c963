//! Fuzz target: runs the cycle of a bus in operation. The fuzzer damages the replies of the bus.

use std::cell::RefCell;

use ballbard::bus::Bus;
use ballbard::clock::Clock;
use ballbard::cycle::{Acquisition, BusNames};
use shared::recording::schema::CycleRecord;
use shared::time::UtcNs;

use super::bring_up::{plan, segment};
use super::replies::{DamagedWire, Script};

/// Largest number of cycles for which a script is played.
const CYCLES_MAX: usize = 200;
/// Largest number of cycles from the end of the script to the next valid sample. The bus may have to be brought
/// up again, which takes seconds.
const RECOVERY_CYCLES_MAX: usize = 1000;

/// An acquisition that continues from one script to the next, because a bring-up for each script would be slow.
struct CycleRig {
    acquisition: Acquisition,
    wire: DamagedWire,
    last: Option<CycleRecord>,
}

impl CycleRig {
    fn new() -> Self {
        let clock = Clock::virtual_from(UtcNs(1_790_000_000_000_000_000));
        let wire = DamagedWire::new(segment(&clock));
        let plan = plan();
        let bus = Bus::new(Box::new(wire.clone()), clock.clone(), plan.reply_timeout);
        let mut acquisition = Acquisition::start(bus, &plan, clock).expect("a bus without faults");
        acquisition.begin_run(|_| ());
        Self { acquisition, wire, last: None }
    }

    /// Runs one cycle. Records must be numbered without gaps, their times must increase, and each invalid
    /// record must have a flag.
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

/// Plays a script of damaged replies. Every cycle that is due must have a record, and the times of the records must
/// increase. After the script, the samples must become valid again.
pub fn any_replies(bytes: &[u8]) {
    thread_local!(static RIG: RefCell<CycleRig> = RefCell::new(CycleRig::new()));
    RIG.with_borrow_mut(|rig| {
        rig.wire.play(Script::for_robot(bytes));
        for _ in 0..CYCLES_MAX {
            rig.cycle();
            if rig.wire.is_over() {
                break;
            }
        }
        rig.wire.play(Script::for_robot(&[]));
        let recovered = (0..RECOVERY_CYCLES_MAX).any(|_| {
            rig.cycle();
            rig.is_valid()
        });
        assert!(recovered, "the bus never came back");
    });
}

/// Seeds: scripts without damage, with a lost reply, with a truncated reply, and with wrong inputs,
/// working counters and bus times.
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
