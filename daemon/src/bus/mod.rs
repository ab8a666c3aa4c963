//! The EtherCAT MainDevice. A [`Bus`] sends frames over a wire to the devices of a segment. [`Bus::bring_up`] brings the
//! segment into operation and returns it as [`Operational`]. After that, each call of [`Bus::exchange`] sends one frame with
//! the outputs. The call returns the inputs, the working counter, the states of the devices and the time of the bus. After a
//! fault, `recovery` restores a terminal, or determines which devices still answer.

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

/// Largest number of devices. A ball-bar has fewer devices, but ethercrab needs a power of two.
pub const DEVICES_MAX: usize = 16;
/// Station address that ethercrab assigns to the first device. The next devices get the next addresses.
const STATION_ADDRESS_FIRST: u16 = 0x1000;
/// Space for the process data of all terminals \[bytes\].
const PDI_BYTES_MAX: usize = 256;
/// Time to wait for a reply during the bring-up. It may be long, because no cycle is due then, and the machine may be busy.
const BRING_UP_REPLY_TIMEOUT: Duration = Duration::from_millis(20);
const BRING_UP_RETRIES: usize = 5;
/// Time on the wire for each byte at 100 Mbit/s.
const WIRE_NS_PER_BYTE: i64 = 80;
/// Length to which shorter frames are padded.
const FRAME_BYTES_MIN: usize = 60;
/// Number of additional bytes on the wire: preamble and start delimiter before each frame, check sequence after it.
const FRAME_BYTES_AROUND: usize = 8 + 4;

type BusGroup<State, Dc> = SubDeviceGroup<DEVICES_MAX, PDI_BYTES_MAX, ethercrab::DefaultLock, State, Dc>;

type BusDevice<'a> = SubDeviceRef<'static, SubDevicePdi<'a, PDI_BYTES_MAX, ethercrab::DefaultLock>>;

/// The expected devices and the timing of the bus.
#[derive(Debug, Clone)]
pub struct BusPlan {
    /// Network interface, or `simulated`. Used in messages.
    pub name: String,
    /// Encoders in bus order. Each encoder has its own EL5021, and these terminals follow the EK1100.
    pub encoders: Vec<EncoderConfig>,
    /// Time between two cycles.
    pub cycle_period: Duration,
    /// Whether encoders are sampled on SYNC0 of the distributed clocks.
    pub distributed_clocks: bool,
    /// Time from SYNC0 to the frame of the cycle. Half a period leaves equal margins for frames that are early and late.
    pub sync0_shift: Duration,
    /// How long to wait for the reply to a cyclic frame.
    pub reply_timeout: Duration,
}

/// The EtherCAT MainDevice on one wire.
pub struct Bus {
    exchange: Exchange,
    main: &'static MainDevice<'static>,
    pdu_timeout: Duration,
    clock: Clock,
    reply_timeout_ns: i64,
    /// Bus time minus the host's monotonic time \[ns\], to which the clock of the bus is set when the bus is brought up.
    bus_minus_monotonic_ns: i64,
    /// Devices that have identified themselves during the last bring-up, see [`Self::identified`].
    identified: Vec<DeviceInfo>,
}

/// A segment in operation.
pub struct Operational {
    group: OperationalGroup,
    /// Devices of the segment, as they identified themselves, in bus order.
    pub devices: Vec<DeviceInfo>,
    /// Clocks of all devices except the first device, whose clock is the reference. Empty without distributed clocks.
    pub clocks: Vec<DeviceClock>,
    /// Working counter of the process data that is expected if all devices process the frame.
    pub working_counter_expected: u16,
    encoder_count: usize,
}

/// Clock of a device just after the bus was brought up.
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

/// Content of the reply to a cyclic frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CyclicReply {
    /// Working counter of the process data.
    pub working_counter: u16,
    /// Whether every device is in OP.
    pub all_operational: bool,
    /// Bit `n` is set if the device at position `n` is not in OP.
    pub not_operational: u32,
    /// Bit `n` is set if the device at position `n` has not reported a state, because no device has its address any more.
    pub silent: u32,
    /// Time of the bus at which the frame passed the reference clock. `None` without distributed clocks.
    pub dc_time: Option<DcNs>,
    /// Inputs of the terminals in bus order. Elements beyond the number of encoders are not used.
    pub inputs: [Input; MAX_ENCODERS],
}

/// One cyclic exchange: its times, and its reply.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CyclicExchange {
    /// Time at which the frame was passed to the network interface.
    pub sent: MonoNs,
    /// Time at which the reply was received. Equal to `sent` without a reply.
    pub received: MonoNs,
    /// `None` if no reply arrived in time.
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

    /// Sets a flag that ends a bring-up when another thread sets it to true. The bring-up then returns
    /// [`Fact::BusInterrupted`](crate::problem::Fact::BusInterrupted).
    pub fn interrupt_by(&mut self, interrupt: Arc<AtomicBool>) {
        self.exchange.interrupt_by(interrupt);
    }

    /// Devices that identified themselves during the last bring-up, even if the bring-up failed.
    pub fn identified(&self) -> &[DeviceInfo] {
        &self.identified
    }

    /// Counters of the wire so far.
    pub fn wire_counters(&self) -> WireCounters {
        self.exchange.counters
    }

    /// Duration of the last frame on the wire, from its first to its last bit \[ns\].
    pub fn frame_ns(&self) -> i64 {
        let bytes = self.exchange.sent_bytes_last.max(FRAME_BYTES_MIN) + FRAME_BYTES_AROUND;
        bytes as i64 * WIRE_NS_PER_BYTE
    }

    /// Sends one cyclic frame, and waits for its reply until the time-out. Allocates no memory.
    pub fn exchange(&mut self, operational: &Operational) -> CyclicExchange {
        let deadline = self.clock.now().plus_ns(self.reply_timeout_ns);
        let Self { exchange, main, .. } = self;
        let response = match &operational.group {
            OperationalGroup::Dc(group) => {
                exchange.run_until(group.tx_rx_dc(main), deadline).and_then(Result::ok).map(|response| {
                    let time = DcNs(response.extra.dc_system_time as i64);
                    (response.working_counter, States::from_devices(&response.subdevice_states), Some(time))
                })
            }
            OperationalGroup::FreeRun(group) => {
                exchange.run_until(group.tx_rx(main), deadline).and_then(Result::ok).map(|response| {
                    (response.working_counter, States::from_devices(&response.subdevice_states), None)
                })
            }
        };
        let sent = exchange.sent_last;
        let Some((working_counter, states, dc_time)) = response else {
            return CyclicExchange { sent, received: sent, reply: None };
        };
        let inputs = self.inputs(operational);
        let States { not_operational, silent } = states;
        let all_operational = not_operational == 0;
        let reply =
            CyclicReply { working_counter, all_operational, not_operational, silent, dc_time, inputs };
        CyclicExchange { sent, received: self.exchange.received_last, reply: Some(reply) }
    }

    /// Sets the outputs of one terminal from the next exchange on. `encoder` is the number of its encoder
    /// in bus order, from 0.
    pub fn set_output(&self, operational: &Operational, encoder: usize, output: Output) {
        // Position 0 is the coupler. The bring-up has checked the lengths of the process data.
        let position = encoder + 1;
        if let Ok(terminal) = operational.group.device(self.main, position) {
            let mut pdo = terminal.outputs_raw_mut();
            pdo.iter_mut().zip(output.encode()).for_each(|(byte, value)| *byte = value);
        }
    }

    fn inputs(&self, operational: &Operational) -> [Input; MAX_ENCODERS] {
        let mut inputs = [Input::default(); MAX_ENCODERS];
        for (index, input) in inputs.iter_mut().enumerate().take(operational.encoder_count) {
            // Position 0 is the coupler. The bring-up has checked the lengths of the process data.
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

/// Positions of devices that are not in OP, and positions of devices that have reported no state. One bit for each position.
struct States {
    not_operational: u32,
    silent: u32,
}

impl States {
    fn from_devices(states: &[SubDeviceState]) -> Self {
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

/// Working counter of the process data of this number of EL5021 terminals.
const fn working_counter_of(terminals: usize) -> u16 {
    terminals as u16 * el5021::WORKING_COUNTER
}
