//! The cycle allocates no memory. It waits for only two things: its deadline, and the reply to its frame.
#![allow(unsafe_code, clippy::unwrap_used, reason = "tests; an allocator that counts")]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::process::Command;

use crate::support::plan;
use ballbard::bus::Bus;
use ballbard::clock::Clock;
use ballbard::cycle::Acquisition;
use ballbard::record;
use ballbard::run::LatestSamples;
use ballbard::segment::simulated::{SegmentConfig, SimulatedSegment, SmoothMotion};
use ballbard::segment::{EthernetWire, FrameWire, InProcessWire};
use nix::sched::{CloneFlags, unshare};
use shared::time::UtcNs;

/// An allocator that counts the allocations of each thread separately. Other test threads therefore do not change the count.
struct Counting;

thread_local! {
    static CALLS: Cell<u64> = const { Cell::new(0) };
    /// Number of bytes that this thread has allocated and not freed. The next variable is the maximum so far.
    static HELD: Cell<i64> = const { Cell::new(0) };
    static HELD_MOST: Cell<i64> = const { Cell::new(0) };
}

fn note(freed_bytes: usize, allocated_bytes: usize) {
    CALLS.set(CALLS.get() + 1);
    HELD.set(HELD.get() + allocated_bytes as i64 - freed_bytes as i64);
    HELD_MOST.set(HELD_MOST.get().max(HELD.get()));
}

/// Largest number of bytes that `work` has allocated at one time.
pub fn peak_bytes(work: impl FnOnce()) -> i64 {
    let before = HELD.get();
    HELD_MOST.set(before);
    work();
    HELD_MOST.get() - before
}

// SAFETY: all calls are passed to the system allocator unchanged.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        note(0, layout.size());
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        note(layout.size(), 0);
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        note(layout.size(), size);
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Number of times that the calling thread had to wait and therefore released the processor.
fn voluntary_switches() -> u64 {
    let status = std::fs::read_to_string("/proc/thread-self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("voluntary_ctxt_switches:"));
    line.unwrap().trim().parse().unwrap()
}

fn acquisition(clock: &Clock, rate_hz: u64) -> Acquisition {
    let plan = plan(rate_hz);
    let start = || {
        let motion = Box::new(SmoothMotion::new(5, 3600, 1));
        let wire =
            InProcessWire::new(SimulatedSegment::new(&SegmentConfig::default(), motion), clock.clone());
        let bus = Bus::new(Box::new(wire), clock.clone(), plan.reply_timeout);
        Acquisition::start(bus, &plan, clock.clone()).ok()
    };
    // If other tests keep the machine busy, the bring-up may exceed a time-out. It is then attempted again.
    let mut acquisition = (0..10).find_map(|_| start()).unwrap();
    acquisition.begin_run(|_| ());
    acquisition
}

/// Number of allocations and number of waits in `cycles` cycles. They include passing records and times to the recorder.
fn cost(clock: &Clock, rate_hz: u64, cycles: u64) -> (u64, u64) {
    let mut acquisition = acquisition(clock, rate_hz);
    // The rings are of the same type as in real time. They must hold all records, because the test never empties them.
    let (mut sink, _source) = record::ring(cycles as usize + 1000, record::FullRing::Drops);
    acquisition.next_cycle(&mut |record| sink.push(record));
    let live = LatestSamples::default();
    let waits_before = voluntary_switches();
    let calls_before = CALLS.get();
    for _ in 0..cycles {
        acquisition.next_cycle(&mut |record| {
            sink.push(record);
            live.publish(record);
        });
        live.publish_bus(&acquisition.bus_state(), "simulated");
        live.publish_links(acquisition.links());
        sink.push_timing(acquisition.last_timing().unwrap_or_default());
    }
    let calls = CALLS.get() - calls_before;
    (calls, voluntary_switches() - waits_before)
}

#[test]
fn on_virtual_time_a_cycle_allocates_nothing_and_waits_for_nothing() {
    // In virtual time, no thread sleeps. Any wait would therefore be a wait for a lock or a file.
    let (calls, waits) = cost(&Clock::virtual_from(UtcNs(0)), 100, 20_000);
    assert_eq!((calls, waits), (0, 0));
}

#[test]
fn on_real_time_a_cycle_allocates_nothing_and_waits_for_its_deadline_and_its_reply_only() {
    let cycles = 500;
    let (calls, waits) = cost(&Clock::Real, 500, cycles);
    assert_eq!(calls, 0);
    // Each cycle waits at most twice. In addition, the port counters of six devices are read once a second.
    assert!(waits <= 2 * cycles + 2 * 6, "{waits} waits in {cycles} cycles");
}

#[test]
#[ignore = "needs root and iproute2 for a network namespace"]
fn while_its_interface_is_gone_the_wire_allocates_nothing() {
    let ip = |arguments: &[&str]| assert!(Command::new("ip").args(arguments).status().unwrap().success());
    let calls = std::thread::spawn(move || {
        // Only this thread enters the new network namespace.
        unshare(CloneFlags::CLONE_NEWNET).unwrap();
        ip(&["link", "add", "near", "up", "type", "veth", "peer", "far"]);
        ip(&["link", "set", "far", "up"]);
        let mut wire = EthernetWire::open("near").unwrap();
        wire.send(&[0; 60]).unwrap();
        ip(&["link", "delete", "near"]);
        let clock = Clock::Real;
        let calls_before = CALLS.get();
        // The wire checks its interface every tenth of a second.
        for _ in 0..10 {
            assert!(wire.send(&[0; 60]).is_err());
            clock.sleep_until(clock.now().plus_ns(50_000_000));
        }
        CALLS.get() - calls_before
    });
    assert_eq!(calls.join().unwrap(), 0);
}
