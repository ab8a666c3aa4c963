//! The bus reports an impossible time immediately after its bring-up.

use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use ballbard::bus::Bus;
use ballbard::clock::Clock;
use ballbard::cycle::Acquisition;
use ballbard::segment::faults::{Fault, FaultySegment};
use ballbard::segment::simulated::{SegmentConfig, SimulatedSegment, SmoothMotion};
use ballbard::segment::{FRAME_BYTES_MAX, FrameWire, InProcessWire};
use shared::time::{MonoNs, UtcNs};

use super::rig::plan;

const FRMW: u8 = 14;
/// Size of the Ethernet and EtherCAT headers.
const HEADERS_BYTES: usize = 16;
const DATAGRAM_HEADER_BYTES: usize = 10;
const HOUR_NS: u64 = 3_600_000_000_000;

/// A wire that returns replies whose bus time is an hour ahead while the flag `misread` is set.
struct HourAhead {
    wire: InProcessWire,
    misread: Arc<AtomicBool>,
}

impl FrameWire for HourAhead {
    fn send(&mut self, frame: &[u8]) -> io::Result<()> {
        self.wire.send(frame)
    }

    fn receive(&mut self, buffer: &mut [u8; FRAME_BYTES_MAX], until: MonoNs) -> io::Result<Option<usize>> {
        let length = self.wire.receive(buffer, until)?;
        if length.is_some() && self.misread.load(Ordering::Relaxed) && buffer[HEADERS_BYTES] == FRMW {
            let time = &mut buffer[HEADERS_BYTES + DATAGRAM_HEADER_BYTES..][..8];
            let ahead = u64::from_le_bytes(time.try_into().unwrap()) + HOUR_NS;
            time.copy_from_slice(&ahead.to_le_bytes());
        }
        Ok(length)
    }
}

#[test]
fn a_bus_that_shows_a_time_it_was_not_set_to_is_brought_up_again_and_no_cycle_is_made_up() {
    const PERIOD_NS: i64 = 10_000_000;
    let motion = SmoothMotion::new(5, 3600, 1);
    let segment = SimulatedSegment::new(&SegmentConfig::default(), Box::new(motion));
    let (segment, faults) = FaultySegment::new(segment, 1);
    let clock = Clock::virtual_from(UtcNs(0));
    let misread = Arc::new(AtomicBool::new(false));
    let wire =
        HourAhead { wire: InProcessWire::with_faults(segment, clock.clone()), misread: misread.clone() };
    let plan = plan(PERIOD_NS, true);
    let bus = Bus::new(Box::new(wire), clock.clone(), plan.reply_timeout);
    let mut acquisition = Acquisition::start(bus, &plan, clock.clone()).unwrap();
    acquisition.begin_run(|_| ());
    let began = clock.now();
    let mut records = Vec::new();
    let mut run_to = |until_s: i64| {
        while clock.now().ns_since(began) < until_s * 1_000_000_000 {
            acquisition.next_cycle(&mut |record| records.push(*record));
        }
        records.clone()
    };
    run_to(1);
    faults.begin(Fault::DevicesGone { from: 0 });
    run_to(4);
    misread.store(true, Ordering::Relaxed);
    faults.end(Fault::DevicesGone { from: 0 });
    let meanwhile = run_to(10);
    misread.store(false, Ordering::Relaxed);
    let records = run_to(14);
    assert!(meanwhile.len() < 1010, "{} cycles in ten seconds", meanwhile.len());
    assert!(records.iter().zip(0..).all(|(record, number)| record.cycle == number));
    assert!(records[records.len() - 100..].iter().all(|record| record.is_valid()));
    assert!(records[400..990].iter().all(|record| !record.is_valid()));
}
