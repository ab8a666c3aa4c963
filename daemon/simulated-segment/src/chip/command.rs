//! Executes EtherCAT commands at a slave controller and increments their working counters (ETG.1000.4 section 5.4).
//!
//! The first letters of a command are its kind of address: by position (AP), by station address (FP), to all devices (B), or
//! logical (L). The last letters are the access: read (RD), write (WR) or both (RW). With ARMW and FRMW, the addressed
//! device is read, and all other devices are written.

use super::esc::{Esc, ReadMode};
use crate::frame::Datagram;

const APRD: u8 = 1;
const APWR: u8 = 2;
const APRW: u8 = 3;
const FPRD: u8 = 4;
const FPWR: u8 = 5;
const FPRW: u8 = 6;
const BRD: u8 = 7;
const BWR: u8 = 8;
const BRW: u8 = 9;
const LRD: u8 = 10;
const LWR: u8 = 11;
const LRW: u8 = 12;
const ARMW: u8 = 13;
const FRMW: u8 = 14;

/// Effect of a command on one device, after its address has been decoded.
enum CommandEffect {
    Nothing,
    Read(ReadMode),
    Write,
    Exchange(ReadMode),
}

/// Executes one datagram at one device. `now_ns` is the true time at which the datagram passes the device.
pub fn execute(esc: &mut Esc, datagram: &mut Datagram<'_>, now_ns: i64) {
    let increment = match datagram.command() {
        LRD => u16::from(esc.read_logical(datagram.logical_address(), datagram.data, now_ns)),
        LWR => u16::from(esc.write_logical(datagram.logical_address(), datagram.data, now_ns)),
        LRW => exchange_logical(esc, datagram, now_ns),
        _ => execute_physical(esc, datagram, now_ns),
    };
    datagram.count(increment);
}

/// Executes a logical read and write. The outputs are copied from the datagram before the inputs replace them.
fn exchange_logical(esc: &mut Esc, datagram: &mut Datagram<'_>, now_ns: i64) -> u16 {
    let address = datagram.logical_address();
    let written = esc.write_logical(address, datagram.data, now_ns);
    let read = esc.read_logical(address, datagram.data, now_ns);
    u16::from(read) + 2 * u16::from(written)
}

fn execute_physical(esc: &mut Esc, datagram: &mut Datagram<'_>, now_ns: i64) -> u16 {
    let address = datagram.memory_address();
    match action(esc, datagram) {
        CommandEffect::Nothing => 0,
        CommandEffect::Read(mode) => u16::from(esc.read(address, datagram.data, mode, now_ns)),
        CommandEffect::Write => u16::from(esc.write(address, datagram.data, now_ns)),
        CommandEffect::Exchange(mode) => {
            // The data in the datagram are copied before the read replaces them. A datagram has at most 2047 bytes of data.
            let mut incoming = [0; 2048];
            let incoming = &mut incoming[..datagram.data.len()];
            incoming.copy_from_slice(datagram.data);
            let read = esc.read(address, datagram.data, mode, now_ns);
            let written = esc.write(address, incoming, now_ns);
            u16::from(read) + 2 * u16::from(written)
        }
    }
}

/// Decodes whether the command addresses this device. Also increments the address field if the command requires it.
fn action(esc: &Esc, datagram: &mut Datagram<'_>) -> CommandEffect {
    let command = datagram.command();
    let is_addressed = match command {
        APRD | APWR | APRW | ARMW => datagram.device_address() == 0,
        FPRD | FPWR | FPRW | FRMW => datagram.device_address() == esc.station_address(),
        _ => true,
    };
    if matches!(command, APRD | APWR | APRW | ARMW | BRD | BWR | BRW) {
        datagram.increment_device_address();
    }
    match command {
        APRD | FPRD | ARMW | FRMW if is_addressed => CommandEffect::Read(ReadMode::Replace),
        APRW | FPRW if is_addressed => CommandEffect::Exchange(ReadMode::Replace),
        APWR | FPWR if is_addressed => CommandEffect::Write,
        BRD => CommandEffect::Read(ReadMode::Or),
        BRW => CommandEffect::Exchange(ReadMode::Or),
        BWR | ARMW | FRMW => CommandEffect::Write,
        _ => CommandEffect::Nothing,
    }
}
