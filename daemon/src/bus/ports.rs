//! Error counters of the ports. Errors at a port reveal a bad cable or plug before a frame is lost.

use ethercrab::Command;
use shared::time::MonoNs;

use super::{Bus, STATION_ADDRESS_FIRST};

/// Number of ports of a slave controller.
pub const PORTS: usize = 4;
/// First of the registers with the error counters of a slave controller (ETG.1000.4; Beckhoff ESC data sheet, section II).
/// They contain, for each port, invalid frames and receive errors. From 0x0308 on, they contain errors that an earlier
/// device has already counted; from 0x0310 on, lost links.
const ERROR_COUNTERS: u16 = 0x0300;
const ERROR_COUNTERS_BYTES: usize = 0x14;
const LOST_LINKS_FROM: usize = 0x10;
/// If a counter of a device reaches this value, the device's counters are cleared. A counter does not count beyond 255.
const CLEARED_FROM: u8 = 0x80;

/// Error counts of one port since its device was powered up or its counters were cleared.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct PortCounters {
    /// Frames with a wrong check sequence.
    pub invalid_frames: u8,
    /// Invalid symbols, inside frames or between them.
    pub receive_errors: u8,
    /// How often the link was lost.
    pub lost_links: u8,
}

impl PortCounters {
    /// Whether a counter is so high that the counters must be cleared.
    pub fn are_high(&self) -> bool {
        [self.invalid_frames, self.receive_errors, self.lost_links].iter().any(|count| *count >= CLEARED_FROM)
    }
}

impl Bus {
    /// Reads the counters of all ports of a device. `None` if the device does not answer
    /// before `deadline`. Allocates no memory.
    pub fn port_counters(&mut self, position: usize, deadline: MonoNs) -> Option<[PortCounters; PORTS]> {
        let Self { exchange, main, .. } = self;
        let read = Command::fprd(STATION_ADDRESS_FIRST + position as u16, ERROR_COUNTERS);
        let bytes: [u8; ERROR_COUNTERS_BYTES] = exchange.run_until(read.receive(main), deadline)?.ok()?;
        Some(std::array::from_fn(|port| PortCounters {
            invalid_frames: bytes[2 * port],
            receive_errors: bytes[2 * port + 1],
            lost_links: bytes[LOST_LINKS_FROM + port],
        }))
    }

    /// Clears the counters of a device. Returns false if the device does not answer before `deadline`.
    pub fn clear_port_counters(&mut self, position: usize, deadline: MonoNs) -> bool {
        let Self { exchange, main, .. } = self;
        let write = Command::fpwr(STATION_ADDRESS_FIRST + position as u16, ERROR_COUNTERS);
        let cleared = write.send_receive::<[u8; ERROR_COUNTERS_BYTES]>(main, [0; ERROR_COUNTERS_BYTES]);
        exchange.run_until(cleared, deadline).is_some_and(|outcome| outcome.is_ok())
    }
}
