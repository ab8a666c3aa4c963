//! Recovery of a bus that was in operation. A single terminal is restored to OP. Before the whole bus is brought up again,
//! this module determines which devices answer, and whether any device has lost power.

use ethercrab::error::Error as EtherCatError;
use ethercrab::{Command, RegisterAddress};
use shared::time::MonoNs;

use super::{Bus, STATION_ADDRESS_FIRST};

/// Bit of the registers AL status and AL control (ETG.1000.6). In AL status it reports an error, in AL control it
/// acknowledges the error. The lower four bits are the state.
const AL_ERROR: u16 = 0x10;
const AL_STATE: u16 = 0x0f;
const SAFE_OP: u16 = 0x04;
const OP: u16 = 0x08;

/// Result of the attempt to restore a terminal to OP.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RestoreToOp {
    /// The terminal was in SAFE-OP, and OP was requested. The value is its AL status code, or 0 if
    /// the error was acknowledged before.
    Requested(u16),
    /// The terminal is in OP.
    Operational,
    /// The terminal has lost its configuration or does not answer. Only a bring-up of the whole bus can restore it.
    Beyond,
    /// No reply arrived before the deadline.
    Unknown,
}

impl Bus {
    /// Acknowledges the error of a terminal and requests OP. Gives up at `deadline`.
    pub fn restore_to_op(&mut self, position: usize, deadline: MonoNs) -> RestoreToOp {
        let Self { exchange, main, .. } = self;
        let address = STATION_ADDRESS_FIRST + position as u16;
        let restore = async {
            let status: u16 = Command::fprd(address, RegisterAddress::AlStatus.into()).receive(main).await?;
            match status & AL_STATE {
                OP => return Ok(RestoreToOp::Operational),
                SAFE_OP => {}
                _ => return Ok(RestoreToOp::Beyond),
            }
            let control = Command::fpwr(address, RegisterAddress::AlControl.into());
            let mut code = 0;
            if status & AL_ERROR != 0 {
                code = Command::fprd(address, RegisterAddress::AlStatusCode.into()).receive(main).await?;
                control.send(main, SAFE_OP | AL_ERROR).await?;
            }
            // A firmware that is still handling the acknowledgement ignores this request. In that case
            // the next attempt repeats it.
            control.send(main, OP).await?;
            Ok(RestoreToOp::Requested(code))
        };
        match exchange.run_until(restore, deadline) {
            Some(Ok(result)) => result,
            Some(Err(EtherCatError::WorkingCounter { .. })) => RestoreToOp::Beyond,
            Some(Err(_)) | None => RestoreToOp::Unknown,
        }
    }

    /// Number of devices that answer. `devices` is the expected number. 0 if no reply arrives before `deadline`.
    pub fn answering(&mut self, devices: usize, deadline: MonoNs) -> usize {
        let Self { exchange, main, .. } = self;
        let count = Command::brd(RegisterAddress::Type.into()).with_wkc(devices as u16);
        match exchange.run_until(count.receive::<u8>(main), deadline) {
            Some(Ok(_)) => devices,
            Some(Err(EtherCatError::WorkingCounter { received, .. })) => received.into(),
            Some(Err(_)) | None => 0,
        }
    }

    /// Whether any device has lost its station address. Such a device was without power, so its count is also lost. `None`
    /// if a device does not answer.
    pub fn was_powered_off(&mut self, devices: usize) -> Option<bool> {
        let Self { exchange, main, .. } = self;
        let mut any = false;
        for position in 0..devices as u16 {
            let read = Command::aprd(position, RegisterAddress::ConfiguredStationAddress.into());
            let address: u16 = exchange.run(read.receive(main)).ok()?;
            any |= address != STATION_ADDRESS_FIRST + position;
        }
        Some(any)
    }

    /// Sets the difference between bus time and the host's monotonic time for the next bring-up. The bring-up sets the clock
    /// of the bus accordingly, so that the bus time continues after an outage.
    pub fn set_bus_minus_monotonic(&mut self, difference_ns: i64) {
        self.bus_minus_monotonic_ns = difference_ns;
    }
}
