//! A bus without hardware: one EK1100 coupler and up to 16 EL5021 terminals, which answer the frames of an unmodified
//! EtherCAT MainDevice.
//!
//! Three parts are separate: the chip of every EtherCAT device (`chip`), the wiring (`wiring`), and the behaviour of each
//! device (`devices`). The segment is a function of the frames and of the time given to [`SimulatedSegment::exchange`]: it
//! has no clock and no thread, so it runs on real time as well as on a virtual clock. Events between two frames are
//! computed when the next one arrives.
//!
//! Faults of devices are set here, between two frames; faults of frames are simulated by [`faults`], which wraps
//! `exchange`.
//!
//! The crate does not depend on the acquisition: no decoder can share code with the emulation that tests it.

mod chip;
mod devices;
pub mod faults;
mod frame;
mod node;
mod source;
mod wiring;

use rand::{Rng, SeedableRng, rngs::StdRng};

pub use devices::Revision;
pub use source::{
    Conversion, EncoderSource, Hand, HandTurned, Periods, Replay, ReplayError, ReplayHandle, Signal,
    SmoothMotion,
};

use chip::command;
use chip::dc::LocalClock;
use devices::{Ek1100, El5021};
use frame::Datagram;
use node::{Device, Node};
use wiring::Wiring;

/// Longest Ethernet frame without its checksum.
pub const FRAME_BYTES_MAX: usize = 1518;
/// Number of the bar's encoders.
const TERMINALS: usize = 5;
/// Largest number of terminals: more than the coupler can supply.
pub const TERMINALS_MAX: u8 = 16;
/// Devices were powered up within this time before the first frame. Port times, 32 bits of the local time, wrap 4.3 s after
/// power-up: not while a bus is brought up at once.
const POWERED_UP_NS: i64 = 1_500_000_000;

/// Composition of the simulated bus.
#[derive(Debug, Clone, PartialEq)]
pub struct SegmentConfig {
    /// EL5021 terminals behind the coupler.
    pub terminals: usize,
    /// Seed of the drift and start of each device's clock and of small differences in delay.
    pub seed: u64,
    /// Largest rate error of each device's clock \[ppm\].
    pub drift_ppm: f64,
    /// Revision of the terminals.
    pub revision: Revision,
}

impl Default for SegmentConfig {
    /// Five terminals, crystals within 20 ppm.
    fn default() -> Self {
        Self { terminals: TERMINALS, seed: 1, drift_ppm: 20.0, revision: Revision::default() }
    }
}

/// The simulated bus, a function of frames and time.
pub struct SimulatedSegment {
    wiring: Wiring,
    /// Powered up by the first frame, which provides the time.
    nodes: Vec<Node>,
    unpowered: Vec<Unpowered>,
    /// Number of devices that frames reach.
    reach: usize,
    source: Box<dyn EncoderSource>,
}

/// A device before the first frame.
struct Unpowered {
    device: Box<dyn Device>,
    /// Time since its power-up, which its local clock shows.
    on_for_ns: i64,
    drift_ppm: f64,
}

impl SimulatedSegment {
    /// A bus whose encoders follow `source`.
    pub fn new(config: &SegmentConfig, source: Box<dyn EncoderSource>) -> Self {
        let mut random = StdRng::seed_from_u64(config.seed);
        let terminals = config.terminals.min(usize::from(TERMINALS_MAX));
        let wiring = Wiring::new(1 + terminals, &mut random);
        let drift_ppm = config.drift_ppm.abs().min(100.0);
        let coupler: Box<dyn Device> = Box::new(Ek1100);
        let encoders =
            (0..terminals).map(|channel| Box::new(El5021::new(channel, config.revision)) as Box<dyn Device>);
        let unpowered = std::iter::once(coupler).chain(encoders).map(|device| Unpowered {
            device,
            on_for_ns: random.random_range(0..POWERED_UP_NS),
            drift_ppm: random.random_range(-drift_ppm..=drift_ppm),
        });
        let reach = 1 + terminals;
        Self { wiring, nodes: Vec::with_capacity(reach), unpowered: unpowered.collect(), reach, source }
    }

    /// One Ethernet frame enters at true time `now_ns`, which never runs backwards. The returning frame is written to `reply`
    /// and its length returned: the same length, data exchanged, working counters incremented and bit 0x02 set in the first
    /// byte of the source address. `None` if the frame is not an EtherCAT frame, or longer than `reply`.
    ///
    /// Also `None` while not even the coupler is reached.
    ///
    /// Allocates nothing after the first frame.
    pub fn exchange(&mut self, now_ns: i64, frame: &[u8], reply: &mut [u8]) -> Option<usize> {
        let datagrams = frame::datagrams(frame)?;
        let reply = reply.get_mut(..frame.len())?;
        reply.copy_from_slice(frame);
        frame::mark_processed(reply);
        self.power_up(now_ns);
        self.advance(now_ns);
        if self.reach == 0 {
            return None;
        }
        let mut rest = reply.get_mut(datagrams)?;
        while let Some((mut datagram, behind)) = Datagram::split_first(rest) {
            for (position, node) in self.nodes.iter_mut().take(self.reach).enumerate() {
                let arrival_ns = now_ns.saturating_add(self.wiring.delay_ns(position));
                command::execute(&mut node.esc, &mut datagram, arrival_ns);
            }
            rest = behind;
        }
        Some(frame.len())
    }

    /// From sending a frame's first bit until receiving its last, for a virtual clock.
    pub fn round_trip_ns(&self, frame_len: usize) -> i64 {
        self.wiring.round_trip_ns(frame_len)
    }

    /// The devices from `position` on lose power or their cable; 0 includes the coupler.
    pub(crate) fn cut_from(&mut self, position: usize) {
        if let Some(before) = position.checked_sub(1).filter(|_| position < self.reach) {
            self.change(before, |node| node.esc.count_lost_link());
        }
        self.reach = self.reach.min(position);
        self.show_links();
    }

    /// Powers up the devices that were cut off at `now_ns`: in INIT, without address, counters without origin.
    pub(crate) fn restore(&mut self, now_ns: i64) {
        for node in self.nodes.iter_mut().skip(self.reach) {
            node.power_cycle(now_ns);
        }
        self.reach = self.nodes.len() + self.unpowered.len();
        self.show_links();
    }

    /// Changes a device, if there is one at this position.
    pub(crate) fn change(&mut self, position: usize, change: impl FnOnce(&mut Node)) {
        if let Some(node) = self.nodes.get_mut(position) {
            change(node);
        }
    }

    /// Steps the reference clock at `now_ns`.
    pub fn step_reference_clock(&mut self, now_ns: i64, step_ns: i64) {
        self.change(0, |node| node.esc.step_clock(now_ns, step_ns));
    }

    fn show_links(&mut self) {
        for (position, node) in self.nodes.iter_mut().take(self.reach).enumerate() {
            node.esc.set_dl_status(self.wiring.dl_status(position, self.reach));
        }
    }

    /// Computes all events before the frame arrives at each device.
    fn advance(&mut self, now_ns: i64) {
        for (position, node) in self.nodes.iter_mut().take(self.reach).enumerate() {
            let arrival_ns = now_ns.saturating_add(self.wiring.delay_ns(position));
            let back_ns =
                self.wiring.loop_ns(position, self.reach).map(|loop_ns| arrival_ns.saturating_add(loop_ns));
            node.advance(arrival_ns, back_ns, self.source.as_mut());
        }
    }

    /// Powers up devices that are off, which the first frame does, too.
    pub fn power_up(&mut self, now_ns: i64) {
        for (position, off) in self.unpowered.drain(..).enumerate() {
            let clock = LocalClock::new(now_ns, off.on_for_ns, off.drift_ppm);
            self.nodes.push(Node::new(off.device, clock, self.wiring.dl_status(position, self.reach)));
        }
    }
}
