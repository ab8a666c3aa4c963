//! The simulated segment as a wire, in this process.

use std::io;

use shared::time::MonoNs;

use super::{FRAME_BYTES_MAX, FrameWire};
use crate::clock::Clock;
use simulated_segment::SimulatedSegment;
use simulated_segment::faults::FaultySegment;

/// Up to this duration, the thread waits without sleeping \[ns\]. Falling asleep and waking up takes several times as long
/// as a frame on the wire. This matters because a bring-up sends 14 000 frames one after the other.
const AWAKE_NS: i64 = 50_000;

/// A wire to a simulated segment. A reply arrives after the time that a real wire would take. Even in real time, this
/// includes the duration of the frame itself, because the clock fit subtracts this duration.
pub struct InProcessWire {
    segment: FaultySegment,
    clock: Clock,
}

impl InProcessWire {
    /// Connects a segment without faults. Segment and wire use the same `clock`.
    pub fn new(segment: SimulatedSegment, clock: Clock) -> Self {
        let (segment, _) = FaultySegment::new(segment, 0);
        Self::with_faults(segment, clock)
    }

    /// Connects a segment with faults.
    pub fn with_faults(segment: FaultySegment, clock: Clock) -> Self {
        Self { segment, clock }
    }

    fn wait_until(&self, moment: MonoNs) {
        if !self.clock.is_real() || moment.ns_since(self.clock.now()) > AWAKE_NS {
            return self.clock.sleep_until(moment);
        }
        while self.clock.now() < moment {
            std::hint::spin_loop();
        }
    }
}

impl FrameWire for InProcessWire {
    fn send(&mut self, frame: &[u8]) -> io::Result<()> {
        let now = self.clock.now();
        if !self.segment.has_link(now.0) {
            return Err(io::ErrorKind::NetworkDown.into());
        }
        let round_trip_ns = self.segment.round_trip_ns(frame.len());
        // The coupler receives the start of the frame at once. The round trip ends when the last bit of the frame is back.
        self.segment.exchange(now.0, round_trip_ns, frame);
        Ok(())
    }

    fn receive(&mut self, buffer: &mut [u8; FRAME_BYTES_MAX], until: MonoNs) -> io::Result<Option<usize>> {
        let due = self.segment.next_reply_ns().map(MonoNs).filter(|due| *due <= until);
        self.wait_until(due.unwrap_or(until));
        Ok(self.segment.take_reply(self.clock.now().0, buffer))
    }
}
