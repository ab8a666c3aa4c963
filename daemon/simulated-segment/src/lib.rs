//! A bus without hardware: one EK1100 coupler and up to 16 EL5021 terminals. They answer the frames
//! of an unmodified EtherCAT MainDevice.
//!
//! Each part of a real bus is a separate module: the chip in every EtherCAT device (`chip`), the wiring (`wiring`), and the
//! behaviour of each device (`devices`). The segment depends only on the frames and times that
//! [`SimulatedSegment::exchange`] receives. It has no clock and no thread, so it runs in real time as well as in virtual
//! time. Events between two frames are computed when the second frame arrives. A *true* time is the time of the simulation
//! itself. It has no error, unlike the clocks of the devices.
//!
//! Faults of devices are set in the devices, between two frames. Faults of frames are simulated
//! by [`faults`], which wraps `exchange`.
//!
//! This crate does not depend on the acquisition, so the emulation cannot share code with the decoder that it tests.

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
/// Number of encoders on the bar.
const TERMINALS: usize = 5;
/// Largest number of terminals. A real coupler cannot supply this many.
pub const TERMINALS_MAX: u8 = 16;
/// Longest time from the power-up of a device to the first frame \[ns\]. Port times are the low 32 bits of the local time,
/// and wrap 4.3 s after power-up. With this limit, they do not wrap during a bring-up that begins at once.
const POWERED_UP_NS: i64 = 1_500_000_000;

/// Composition of the simulated bus.
#[derive(Debug, Clone, PartialEq)]
pub struct SegmentConfig {
    /// Number of EL5021 terminals after the coupler.
    pub terminals: usize,
    /// Seed of all random properties: the drift and the start of each device's clock, and small differences in delay.
    pub seed: u64,
    /// Largest rate error of each device's clock \[ppm\].
    pub drift_ppm: f64,
    /// Revision of the terminals.
    pub revision: Revision,
}

impl Default for SegmentConfig {
    /// Five terminals. The clocks of the devices have rate errors up to 20 ppm.
    fn default() -> Self {
        Self { terminals: TERMINALS, seed: 1, drift_ppm: 20.0, revision: Revision::default() }
    }
}

/// The simulated bus. Its state depends only on the frames and times that it receives.
pub struct SimulatedSegment {
    wiring: Wiring,
    /// Devices with power. The first frame powers them up, because it provides the time.
    nodes: Vec<Node>,
    /// Devices that the first frame will power up. Empty after that frame.
    unpowered: Vec<Unpowered>,
    /// Number of devices that frames reach, beginning with the coupler.
    reach: usize,
    source: Box<dyn EncoderSource>,
}

/// A device that has no power, because the first frame has not arrived yet.
struct Unpowered {
    device: Box<dyn Device>,
    /// Time since the power-up of the device \[ns\]. The local clock of the device starts at this value.
    on_for_ns: i64,
    drift_ppm: f64,
}

impl SimulatedSegment {
    /// A bus whose encoders have the signals of `source`.
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

    /// Passes an Ethernet frame through all devices. The frame enters at true time `now_ns`, which must not
    /// decrease from call to call.
    ///
    /// Writes the returning frame into `reply` and returns its length, which is that of `frame`. In the returning
    /// frame, data are exchanged, working counters are incremented, and bit 0x02 is set in the first byte of the
    /// source address. Returns `None` if the frame is not an EtherCAT frame, if it is longer than `reply`, or if it
    /// does not even reach the coupler.
    ///
    /// Allocates no memory after the first frame.
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

    /// Time from sending the first bit of a frame until its last bit is received \[ns\], for a virtual clock.
    pub fn round_trip_ns(&self, frame_len: usize) -> i64 {
        self.wiring.round_trip_ns(frame_len)
    }

    /// Cuts off the devices from `position` on, because they lose their power or their cable. Position 0 is the coupler.
    pub(crate) fn cut_from(&mut self, position: usize) {
        if let Some(before) = position.checked_sub(1).filter(|_| position < self.reach) {
            self.change(before, |node| node.esc.count_lost_link());
        }
        self.reach = self.reach.min(position);
        self.show_links();
    }

    /// Powers up the devices that were cut off, at `now_ns`. They are in INIT and have no station
    /// address. Their counters start anew.
    pub(crate) fn restore(&mut self, now_ns: i64) {
        for node in self.nodes.iter_mut().skip(self.reach) {
            node.power_cycle(now_ns);
        }
        self.reach = self.nodes.len() + self.unpowered.len();
        self.show_links();
    }

    /// Applies `change` to the device at a position, if there is one.
    pub(crate) fn change(&mut self, position: usize, change: impl FnOnce(&mut Node)) {
        if let Some(node) = self.nodes.get_mut(position) {
            change(node);
        }
    }

    /// Steps the clock of the coupler, which is the reference clock, at `now_ns`.
    pub fn step_reference_clock(&mut self, now_ns: i64, step_ns: i64) {
        self.change(0, |node| node.esc.step_clock(now_ns, step_ns));
    }

    fn show_links(&mut self) {
        for (position, node) in self.nodes.iter_mut().take(self.reach).enumerate() {
            node.esc.set_dl_status(self.wiring.dl_status(position, self.reach));
        }
    }

    /// Advances each device to the time at which the frame arrives there. This computes all events before that time.
    fn advance(&mut self, now_ns: i64) {
        for (position, node) in self.nodes.iter_mut().take(self.reach).enumerate() {
            let arrival_ns = now_ns.saturating_add(self.wiring.delay_ns(position));
            let back_ns =
                self.wiring.loop_ns(position, self.reach).map(|loop_ns| arrival_ns.saturating_add(loop_ns));
            node.advance(arrival_ns, back_ns, self.source.as_mut());
        }
    }

    /// Powers up all devices that have no power yet. The first frame does the same.
    pub fn power_up(&mut self, now_ns: i64) {
        for (position, off) in self.unpowered.drain(..).enumerate() {
            let clock = LocalClock::new(now_ns, off.on_for_ns, off.drift_ppm);
            self.nodes.push(Node::new(off.device, clock, self.wiring.dl_status(position, self.reach)));
        }
    }
}
