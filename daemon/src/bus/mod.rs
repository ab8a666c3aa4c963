//! The EtherCAT MainDevice: brings a segment into operation and exchanges process data once per call.

mod bring_up;
mod error;
mod exchange;
mod ports;
mod recovery;
mod stack;
mod timers;

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use ethercrab::error::Error as EtherCatError;
use ethercrab::subdevice_group::{HasDc, NoDc, Op};
use ethercrab::{MainDevice, SubDeviceGroup, SubDevicePdi, SubDeviceRef, SubDeviceState};
use serde::Serialize;
use shared::config::EncoderConfig;
use shared::recording::schema::{DeviceInfo, MAX_ENCODERS};
use shared::time::{DcNs, MonoNs};

pub use error::{BusError, absent};
pub use exchange::{Exchange, WireCounters};
pub use ports::{PORTS, PortCounters};
pub use recovery::RestoreToOp;
pub use timers::use_clock;

use crate::clock::Clock;
use crate::devices::el5021::{self, Input, Output};
use crate::segment::FrameWire;
use stack::Stack;

/// More devices than a ball-bar has; ethercrab needs a power of two.
pub const DEVICES_MAX: usize = 16;
/// ethercrab assigns this station address to the first device and the following ones to those behind it.
const STATION_ADDRESS_FIRST: u16 = 0x1000;
/// Room for the process data of all terminals.
const PDI_BYTES_MAX: usize = 256;
/// While the bus comes up nothing is cyclic, and this PC may be busy: a long time-out costs nothing.
const BRING_UP_REPLY_TIMEOUT: Duration = Duration::from_millis(20);
const BRING_UP_RETRIES: usize = 5;
/// 100 Mbit/s.
const WIRE_NS_PER_BYTE: i64 = 80;
/// Shorter frames are padded.
const FRAME_BYTES_MIN: usize = 60;
/// Preamble and start delimiter precede each frame, a check sequence follows.
const FRAME_BYTES_AROUND: usize = 8 + 4;

type BusGroup<State, Dc> = SubDeviceGroup<DEVICES_MAX, PDI_BYTES_MAX, ethercrab::DefaultLock, State, Dc>;

type BusDevice<'a> = SubDeviceRef<'static, SubDevicePdi<'a, PDI_BYTES_MAX, ethercrab::DefaultLock>>;

/// Expected devices of the bus, and its timing.
#[derive(Debug, Clone)]
pub struct BusPlan {
    /// Interface, or `simulated`; for messages.
    pub name: String,
    /// One EL5021 for each, in bus order behind the EK1100.
    pub encoders: Vec<EncoderConfig>,
    /// Time between two cycles.
    pub cycle_period: Duration,
    /// Sample on SYNC0 of the distributed clocks.
    pub distributed_clocks: bool,
    /// The frame follows SYNC0 by this time. Half a period gives most margin in both directions.
    pub sync0_shift: Duration,
    /// How long a cyclic frame waits for its reply.
    pub reply_timeout: Duration,
}

/// The EtherCAT MainDevice on one wire.
pub struct Bus {
    exchange: Exchange,
    main: &'static MainDevice<'static>,
    pdu_timeout: Duration,
    clock: Clock,
    reply_timeout_ns: i64,
    /// When the bus comes up its clock is set to the host's monotonic time plus this \[ns\].
    bus_minus_monotonic_ns: i64,
    /// See [`Self::identified`].
    identified: Vec<DeviceInfo>,
}

/// A segment in operation.
pub struct Operational {
    group: OperationalGroup,
    /// Devices as they identified themselves, in bus order.
    pub devices: Vec<DeviceInfo>,
    /// Clocks of the devices behind the first, the reference; empty without distributed clocks.
    pub clocks: Vec<DeviceClock>,
    /// Working counter if all devices process the frame.
    pub working_counter_expected: u16,
    encoder_count: usize,
}

/// Clock of a device when the bus came up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct DeviceClock {
    /// Position on the bus.
    pub position: usize,
    /// Delay from the reference clock to the device \[ns\].
    pub propagation_delay_ns: u32,
    /// Difference from the time of the reference clock \[ns\].
    pub difference_ns: i64,
}

enum OperationalGroup {
    Dc(BusGroup<Op, HasDc>),
    FreeRun(BusGroup<Op, NoDc>),
}

impl OperationalGroup {
    fn device<'a>(
        &'a self,
        main: &'static MainDevice<'static>,
        position: usize,
    ) -> Result<BusDevice<'a>, EtherCatError> {
        match self {
            Self::Dc(group) => group.subdevice(main, position),
            Self::FreeRun(group) => group.subdevice(main, position),
        }
    }
}

/// Result of one cyclic frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CyclicReply {
    /// Working counter of the process data.
    pub working_counter: u16,
    /// Every device is in OP.
    pub all_operational: bool,
    /// Positions in another state, one bit each.
    pub not_operational: u32,
    /// Positions without a state: no device has that address any more. One bit each.
    pub silent: u32,
    /// System time at which the frame passed the reference clock.
    pub dc_time: Option<DcNs>,
    /// Inputs in bus order; as many as there are encoders.
    pub inputs: [Input; MAX_ENCODERS],
}

/// One cyclic exchange with its times.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CyclicExchange {
    /// When the frame was handed to the wire.
    pub sent: MonoNs,
    /// When the reply was received; equal to `sent` without one.
    pub received: MonoNs,
    /// `None` when no reply arrived in time.
    pub reply: Option<CyclicReply>,
}

impl Bus {
    /// A MainDevice on a wire.
    pub fn new(wire: Box<dyn FrameWire>, clock: Clock, reply_timeout: Duration) -> Self {
        let Stack { tx, rx, main, pdu_timeout } = Stack::take(reply_timeout);
        Self {
            exchange: Exchange::new(tx, rx, wire, clock.clone()),
            main,
            pdu_timeout,
            clock,
            reply_timeout_ns: reply_timeout.as_nanos() as i64,
            bus_minus_monotonic_ns: 0,
            identified: Vec::new(),
        }
    }

    /// From now on bringing the bus up ends once this is set, with [`Fact::BusInterrupted`](crate::problem::Fact::BusInterrupted).
    pub fn interrupt_by(&mut self, interrupt: Arc<AtomicBool>) {
        self.exchange.interrupt_by(interrupt);
    }

    /// Devices that identified themselves when the bus was last brought up, also if that failed.
    pub fn identified(&self) -> &[DeviceInfo] {
        &self.identified
    }

    /// Counters of the wire so far.
    pub fn wire_counters(&self) -> WireCounters {
        self.exchange.counters()
    }

    /// Duration of the last frame on the wire, from its first to its last bit \[ns\].
    pub fn frame_ns(&self) -> i64 {
        let bytes = self.exchange.sent_bytes_last().max(FRAME_BYTES_MIN) + FRAME_BYTES_AROUND;
        bytes as i64 * WIRE_NS_PER_BYTE
    }

    /// Sends one cyclic frame and waits for its reply or the time-out. Allocates nothing.
    pub fn exchange(&mut self, operational: &Operational) -> CyclicExchange {
        let deadline = self.clock.now().plus_ns(self.reply_timeout_ns);
        let Self { exchange, main, .. } = self;
        let response = match &operational.group {
            OperationalGroup::Dc(group) => {
                exchange.run_until(group.tx_rx_dc(main), deadline).and_then(Result::ok).map(|response| {
                    let time = DcNs(response.extra.dc_system_time as i64);
                    (response.working_counter, States::of(&response.subdevice_states), Some(time))
                })
            }
            OperationalGroup::FreeRun(group) => exchange
                .run_until(group.tx_rx(main), deadline)
                .and_then(Result::ok)
                .map(|response| (response.working_counter, States::of(&response.subdevice_states), None)),
        };
        let sent = exchange.sent_last();
        let Some((working_counter, states, dc_time)) = response else {
            return CyclicExchange { sent, received: sent, reply: None };
        };
        let inputs = self.inputs(operational);
        let States { not_operational, silent } = states;
        let all_operational = not_operational == 0;
        let reply =
            CyclicReply { working_counter, all_operational, not_operational, silent, dc_time, inputs };
        CyclicExchange { sent, received: self.exchange.received_last(), reply: Some(reply) }
    }

    /// Sets the outputs of one terminal, by encoder in bus order from 0, from the next exchange on.
    pub fn set_output(&self, operational: &Operational, encoder: usize, output: Output) {
        // The coupler precedes the terminals. Lengths were checked when the bus came up.
        let position = encoder + 1;
        if let Ok(terminal) = operational.group.device(self.main, position) {
            let mut pdo = terminal.outputs_raw_mut();
            pdo.iter_mut().zip(output.encode()).for_each(|(byte, value)| *byte = value);
        }
    }

    fn inputs(&self, operational: &Operational) -> [Input; MAX_ENCODERS] {
        let mut inputs = [Input::default(); MAX_ENCODERS];
        for (index, input) in inputs.iter_mut().enumerate().take(operational.encoder_count) {
            // The coupler precedes the terminals. Lengths were checked when the bus came up.
            let terminal = operational.group.device(self.main, index + 1).ok();
            *input = terminal.and_then(|terminal| Input::decode(&terminal.inputs_raw())).unwrap_or_default();
        }
        inputs
    }
}

impl Drop for Bus {
    fn drop(&mut self) {
        if let Some((tx, rx)) = self.exchange.release() {
            Stack { tx, rx, main: self.main, pdu_timeout: self.pdu_timeout }.leave();
        }
    }
}

/// Devices that are not in OP, and those among them without any state. One bit for each position.
struct States {
    not_operational: u32,
    silent: u32,
}

impl States {
    fn of(states: &[SubDeviceState]) -> Self {
        let positions = |is_wanted: fn(&SubDeviceState) -> bool| {
            states
                .iter()
                .enumerate()
                .filter(|(_, state)| is_wanted(state))
                .fold(0, |bits, (position, _)| bits | 1 << position)
        };
        Self {
            not_operational: positions(|state| *state != SubDeviceState::Op),
            silent: positions(|state| *state == SubDeviceState::None),
        }
    }
}

/// Working counter of `terminals` EL5021.
const fn working_counter_of(terminals: usize) -> u16 {
    terminals as u16 * el5021::WORKING_COUNTER
}
