//! Wiring of the devices: a line behind the coupler, and the delays of a frame between them.

use rand::{Rng, rngs::StdRng};

/// 100 Mbit/s.
const NS_PER_BYTE: i64 = 80;
const FRAME_MIN: usize = 60;
/// Preamble and start delimiter precede each frame, a check sequence follows.
const FRAME_OVERHEAD: usize = 8 + 4;
/// Delay from one device to the next, at least.
const HOP_DELAY_NS: i64 = 145;
/// Largest difference of the delay between terminals.
const HOP_SPREAD_NS: i64 = 10;

/// Line of devices; the first one is the coupler.
pub struct Wiring {
    /// Delay from the master's side of the coupler to each device.
    delays_ns: Vec<i64>,
}

impl Wiring {
    /// A line of `devices`.
    pub fn new(devices: usize, random: &mut StdRng) -> Self {
        let mut delay_ns = 0;
        let mut delays_ns = Vec::with_capacity(devices);
        for _ in 0..devices {
            delays_ns.push(delay_ns);
            delay_ns += HOP_DELAY_NS + random.random_range(0..=HOP_SPREAD_NS);
        }
        Self { delays_ns }
    }

    /// Delay from the coupler to the device at `position`.
    pub fn delay_ns(&self, position: usize) -> i64 {
        self.delays_ns.get(position).copied().unwrap_or(0)
    }

    /// From passing the device at `position` outwards until the frame returns from the last of `reach` devices; `None` for
    /// the last one.
    pub fn loop_ns(&self, position: usize, reach: usize) -> Option<i64> {
        let last = self.delays_ns.get(..reach)?.last()?;
        (position + 1 < reach).then(|| 2 * (last - self.delay_ns(position)))
    }

    /// DL status (0x0110) when frames reach `reach` devices: the ports with a link, and the closed ones.
    pub fn dl_status(&self, position: usize, reach: usize) -> u16 {
        let watchdog_ok = if position == 0 { 0 } else { 0x0002 };
        // Bit 0: EEPROM loaded; 4 to 7: link of ports 0 to 3; from 8 on for each port: closed, in communication. Ports 2 and 3
        // are always closed, port 1 behind the last device.
        let links = if position + 1 < reach { 0x5a31 } else { 0x5611 };
        links | watchdog_ok
    }

    /// From sending a frame's first bit until receiving its last.
    pub fn round_trip_ns(&self, frame_len: usize) -> i64 {
        let bytes = frame_len.max(FRAME_MIN) + FRAME_OVERHEAD;
        let line_ns = self.loop_ns(0, self.delays_ns.len()).unwrap_or(0);
        bytes as i64 * NS_PER_BYTE + line_ns
    }
}
