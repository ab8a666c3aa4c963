//! Fuzz target: the daemon brings up a bus whose replies are damaged by the fuzzer.

use std::cell::RefCell;
use std::time::Duration;

use ballbard::bus::{Bus, BusPlan};
use ballbard::clock::Clock;
use ballbard::cycle::Acquisition;
use ballbard::segment::InProcessWire;
use ballbard::segment::simulated::{SegmentConfig, SimulatedSegment, SmoothMotion};
use shared::time::{NS_PER_S, UtcNs};

use super::explained;
use super::replies::{DamagedWire, Script};

/// Number of cyclic frames after the bring-up.
const CYCLES: usize = 5;
/// Longest permitted bring-up for any replies, measured on the virtual clock of the bus \[ns\].
const BRING_UP_NS_MAX: i64 = 600 * NS_PER_S;

struct BringUpRig {
    clock: Clock,
    wire: DamagedWire,
}

/// A simulated segment of a coupler and one terminal.
pub(super) fn segment(clock: &Clock) -> InProcessWire {
    let config = SegmentConfig { terminals: 1, ..SegmentConfig::default() };
    InProcessWire::new(SimulatedSegment::new(&config, Box::new(SmoothMotion::new(1, 3600, 1))), clock.clone())
}

impl BringUpRig {
    fn new() -> Self {
        let clock = Clock::virtual_from(UtcNs(1_790_000_000_000_000_000));
        let wire = DamagedWire::new(segment(&clock));
        Self { clock, wire }
    }
}

/// Brings up a bus with damaged replies. If the bring-up succeeds, the bus runs some cycles. If the bring-up is refused, the
/// error must contain a reason. Both must end in bounded time.
pub fn any_replies(bytes: &[u8]) {
    thread_local!(static RIG: RefCell<BringUpRig> = RefCell::new(BringUpRig::new()));
    RIG.with_borrow_mut(|rig| {
        rig.wire.exchange_segment(segment(&rig.clock));
        rig.wire.play(Script::for_robot(bytes));
        let begun = rig.clock.now();
        let plan = plan();
        // The EtherCAT stack of the previous bus is used again.
        let bus = Bus::new(Box::new(rig.wire.clone()), rig.clock.clone(), plan.reply_timeout);
        match Acquisition::start(bus, &plan, rig.clock.clone()) {
            Ok(mut acquisition) => (0..CYCLES).for_each(|_| acquisition.idle()),
            Err(error) => explained(&error),
        }
        assert!(rig.clock.now() < begun.plus_ns(BRING_UP_NS_MAX), "bringing the bus up took for ever");
    });
}

/// A configuration that matches the bus of [`segment`].
pub(super) fn plan() -> BusPlan {
    let bar = crate::ball_bar();
    BusPlan {
        name: "simulated".into(),
        encoders: bar.encoders.into_iter().take(1).collect(),
        cycle_period: Duration::from_millis(10),
        distributed_clocks: true,
        sync0_shift: Duration::from_millis(5),
        reply_timeout: Duration::from_millis(4),
    }
}

/// Seeds: scripts without damage, with a lost reply, with a wrong length, and with an emergency and an abort in
/// place of the first answers.
pub fn scripts() -> Vec<Vec<u8>> {
    vec![
        vec![],
        vec![0, 40, 0, 0],
        vec![6, 0, 0, 0, 16, 10, 0, 0, 0, 0, 0x13, 0, 0x10, 0, 0x10, 1, 0, 0, 0, 0, 0],
        vec![6, 1, 0, 0, 16, 10, 0, 0, 0, 0, 0x23, 0, 0x20, 0x80, 0x01, 0x80, 0x11, 0, 0, 2, 6],
        vec![6, 2, 0, 0, 2, 0xff, 0xff],
        vec![2, 10, 0, 0, 2, 0xff, 0xff, 1, 20, 0, 30],
    ]
}
