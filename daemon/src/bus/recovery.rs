//! What can be done for a bus that was in operation: lift a single terminal back into OP, or find out who is still
//! there and who has been without power before everything is brought up again.

use ethercrab::error::Error as EtherCatError;
use ethercrab::{Command, RegisterAddress};
use shared::time::MonoNs;

use super::{Bus, STATION_ADDRESS_FIRST};

/// AL status and AL control: lower bits hold the state, this one the error and its acknowledgement (ETG.1000.6).
const AL_ERROR: u16 = 0x10;
const AL_STATE: u16 = 0x0f;
const SAFE_OP: u16 = 0x04;
const OP: u16 = 0x08;

/// How far a terminal was lifted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Lift {
    /// It stood in SAFE-OP with this AL status code (0 when it was acknowledged before) and was asked for OP.
    Requested(u16),
    /// It is in OP.
    Operational,
    /// It has lost its configuration, or does not answer: only bringing up the bus helps.
    Beyond,
    /// No answer before the deadline.
    Unknown,
}

impl Bus {
    /// Acknowledges what made a terminal leave OP and asks for OP again. Gives up at `deadline`.
    pub fn lift(&mut self, position: usize, deadline: MonoNs) -> Lift {
        let Self { exchange, main, .. } = self;
        let address = STATION_ADDRESS_FIRST + position as u16;
        let lift = async {
            let status: u16 = Command::fprd(address, RegisterAddress::AlStatus.into()).receive(main).await?;
            match status & AL_STATE {
                OP => return Ok(Lift::Operational),
                SAFE_OP => {}
                _ => return Ok(Lift::Beyond),
            }
            let control = Command::fpwr(address, RegisterAddress::AlControl.into());
            let mut code = 0;
            if status & AL_ERROR != 0 {
                code = Command::fprd(address, RegisterAddress::AlStatusCode.into()).receive(main).await?;
                control.send(main, SAFE_OP | AL_ERROR).await?;
            }
            // A firmware that is still busy with the acknowledgement ignores this; the next lift repeats it.
            control.send(main, OP).await?;
            Ok(Lift::Requested(code))
        };
        match exchange.run_until(lift, deadline) {
            Some(Ok(lift)) => lift,
            Some(Err(EtherCatError::WorkingCounter { .. })) => Lift::Beyond,
            Some(Err(_)) | None => Lift::Unknown,
        }
    }

    /// How many devices answer, where there should be `devices`; 0 if nobody does before `deadline`.
    pub fn answering(&mut self, devices: usize, deadline: MonoNs) -> usize {
        let Self { exchange, main, .. } = self;
        let count = Command::brd(RegisterAddress::Type.into()).with_wkc(devices as u16);
        match exchange.run_until(count.receive::<u8>(main), deadline) {
            Some(Ok(_)) => devices,
            Some(Err(EtherCatError::WorkingCounter { received, .. })) => received.into(),
            Some(Err(_)) | None => 0,
        }
    }

    /// Whether any device has lost the address that it was given: it was without power since, and with the address
    /// its count is gone. None when somebody does not answer.
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

    /// When the bus comes up next, its clock is set to the host's monotonic time plus this: so that a bus that comes
    /// up again goes on with the time that it had.
    pub fn set_bus_minus_monotonic(&mut self, difference_ns: i64) {
        self.bus_minus_monotonic_ns = difference_ns;
    }
}
