//! Why the bus cannot be brought into operation, in words for the person beside it.

use std::fmt;

use ethercrab::error::Error as EtherCatError;
use ethercrab::{AlStatusCode, SubDeviceState};

/// A device as it should be or as it was found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeviceName(pub String);

impl fmt::Display for DeviceName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

fn list(devices: &[DeviceName]) -> String {
    if devices.is_empty() {
        return "nothing".into();
    }
    let names: Vec<_> = devices.iter().map(|device| device.0.as_str()).collect();
    names.join(", ")
}

/// Why the bus cannot be brought into operation.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// Nobody answers.
    #[error(
        "no EtherCAT device answers on {bus}; check that the coupler has power, that its upper (IN) socket is \
         cabled to this interface, and that the interface is up"
    )]
    NoAnswer {
        /// Interface, or `simulated`.
        bus: String,
    },
    /// Other devices, or another order, than configured.
    #[error(
        "bus position {position} differs from the configuration: expected [{}], found [{}]; \
         correct the order of the terminals or the list of encoders in ball_bar.toml",
        list(expected),
        list(found)
    )]
    WrongDevices {
        /// First position that differs; the coupler is 0.
        position: usize,
        /// What the configuration asks for.
        expected: Vec<DeviceName>,
        /// What identified itself.
        found: Vec<DeviceName>,
    },
    /// A terminal does not take the interpolation.
    #[error(
        "terminal at position {position} interpolates {found} bits after {wanted} were written; \
         power the terminals off and on, or use a number of bits that its firmware offers"
    )]
    Interpolation {
        /// Position on the bus.
        position: usize,
        /// Bits asked for.
        wanted: u8,
        /// Bits read back.
        found: u32,
    },
    /// A terminal's process data have another length.
    #[error(
        "terminal at position {position} has {inputs} bytes of inputs and {outputs} of outputs instead of 10 and 6; \
         restore its default PDO assignment"
    )]
    ProcessData {
        /// Position on the bus.
        position: usize,
        /// Bytes of inputs.
        inputs: usize,
        /// Bytes of outputs.
        outputs: usize,
    },
    /// The reference clock gives no time.
    #[error(
        "the distributed clock stands still (time {time_ns} ns); the first device after this PC must be an EK1100 \
         with distributed clocks, or set `distributed_clocks = false` in daemon.toml and accept samples up to one cycle old"
    )]
    ClockStandsStill {
        /// Time read twice \[ns\].
        time_ns: u64,
    },
    /// A terminal's clock does not follow the reference.
    #[error(
        "the clock of the terminal at position {position} is {difference_ns} ns off the bus time and does not settle"
    )]
    ClockNotSettled {
        /// Position on the bus.
        position: usize,
        /// Register 0x092C \[ns\].
        difference_ns: i64,
    },
    /// A device refuses a state.
    #[error("device at position {position} stays in {state} instead of {wanted}: AL status {code}")]
    StateRefused {
        /// Position on the bus.
        position: usize,
        /// State that it is in.
        state: SubDeviceState,
        /// State that was asked for.
        wanted: &'static str,
        /// Why, as the device says.
        code: AlStatusCode,
    },
    /// Anything else.
    #[error("EtherCAT, while {doing}: {error}")]
    Stack {
        /// What was being done.
        doing: &'static str,
        /// What the stack says.
        error: EtherCatError,
    },
    /// The stack gave up in a way that it should not.
    #[error("the EtherCAT stack failed unexpectedly: {0}")]
    Panicked(String),
}

/// For `map_err`: what was being done when the stack failed.
pub(super) fn while_doing(doing: &'static str) -> impl Fn(EtherCatError) -> BusError {
    move |error| BusError::Stack { doing, error }
}
