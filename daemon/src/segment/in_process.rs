//! The simulated segment as a wire in this process.

use std::io;

use shared::time::MonoNs;

use super::simulated::SimulatedSegment;
use super::{FRAME_BYTES_MAX, Wire};
use crate::clock::Clock;

/// Frames sent are answered by a simulated segment at once (real time) or one round trip later (virtual time).
pub struct InProcessWire {
    segment: SimulatedSegment,
    clock: Clock,
    reply: Box<[u8; FRAME_BYTES_MAX]>,
    reply_len: Option<usize>,
}

impl InProcessWire {
    /// Connects a segment; both live on `clock`.
    pub fn new(segment: SimulatedSegment, clock: Clock) -> Self {
        Self { segment, clock, reply: Box::new([0; FRAME_BYTES_MAX]), reply_len: None }
    }
}

impl Wire for InProcessWire {
    fn send(&mut self, frame: &[u8]) -> io::Result<()> {
        let now = self.clock.now();
        let round_trip_ns = if self.clock.is_real() { 0 } else { self.segment.round_trip_ns(frame.len()) };
        // The coupler sees the frame half way of the round trip.
        self.reply_len = self.segment.exchange(now.0 + round_trip_ns / 2, frame, &mut self.reply[..]);
        if !self.clock.is_real() {
            self.clock.sleep_until(now.plus_ns(round_trip_ns));
        }
        Ok(())
    }

    fn receive(&mut self, buffer: &mut [u8; FRAME_BYTES_MAX], until: MonoNs) -> io::Result<Option<usize>> {
        match self.reply_len.take() {
            Some(length) => {
                buffer[..length].copy_from_slice(&self.reply[..length]);
                Ok(Some(length))
            }
            None => {
                self.clock.sleep_until(until);
                Ok(None)
            }
        }
    }
}
