//! Wiring of the bus. The devices are in a line after the coupler. From each device to the next, a frame is delayed.

use rand::{Rng, rngs::StdRng};

/// Time on the wire for each byte at 100 Mbit/s.
const NS_PER_BYTE: i64 = 80;
const FRAME_MIN: usize = 60;
/// Number of additional bytes on the wire: preamble and start delimiter before each frame, check sequence after it.
const FRAME_OVERHEAD: usize = 8 + 4;
/// Smallest delay from one device to the next.
const HOP_DELAY_NS: i64 = 145;
/// Range of the random addition to the delay from one device to the next.
const HOP_SPREAD_NS: i64 = 10;

/// The line of devices. The first device is the coupler.
pub struct Wiring {
    /// Delay from the master's side of the coupler to each device \[ns\].
    delays_ns: Vec<i64>,
}

impl Wiring {
    /// A line of this number of devices.
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

    /// Time from the moment at which a frame passes the device at `position` outwards until the frame returns to this device
    /// \[ns\]. Frames reach the first `reach` devices. `None` if the device is the last of them.
    pub fn loop_ns(&self, position: usize, reach: usize) -> Option<i64> {
        let last = self.delays_ns.get(..reach)?.last()?;
        (position + 1 < reach).then(|| 2 * (last - self.delay_ns(position)))
    }

    /// Value of register DL status (0x0110) of the device at `position`. It shows which ports have a link and which are
    /// closed. Frames reach `reach` devices.
    pub fn dl_status(&self, position: usize, reach: usize) -> u16 {
        let watchdog_ok = if position == 0 { 0 } else { 0x0002 };
        // Bit 0: EEPROM loaded. Bits 4 to 7: link of ports 0 to 3. From bit 8 on, each port has two bits: closed, and in
        // communication. Ports 2 and 3 are always closed; port 1 is closed only on the last device.
        let links = if position + 1 < reach { 0x5a31 } else { 0x5611 };
        links | watchdog_ok
    }

    /// Time from sending the first bit of a frame until its last bit is received \[ns\].
    pub fn round_trip_ns(&self, frame_len: usize) -> i64 {
        let bytes = frame_len.max(FRAME_MIN) + FRAME_OVERHEAD;
        let line_ns = self.loop_ns(0, self.delays_ns.len()).unwrap_or(0);
        bytes as i64 * NS_PER_BYTE + line_ns
    }
}
