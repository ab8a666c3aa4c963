//! Reads EtherCAT frames and datagrams within an Ethernet frame, and changes them in place
//! (ETG.1000.4 sections 5.3 and 5.4).

use std::ops::Range;

/// Length of the Ethernet header: destination, source and type \[bytes\].
const ETHERNET_HEADER_LEN: usize = 14;
/// Position of the type in the Ethernet header.
const ETHERTYPE: Range<usize> = 12..14;
/// Position of the first byte of the source address.
const SOURCE_MAC: usize = 6;
/// Bit of this byte that means "locally administered". The first slave controller sets it.
const LOCALLY_ADMINISTERED: u8 = 0x02;
/// Ethernet type of EtherCAT, big-endian on the wire.
const ETHERCAT: [u8; 2] = [0x88, 0xa4];
/// Length of the EtherCAT header, which contains length and type \[bytes\].
const ETHERCAT_HEADER_LEN: usize = 2;
/// Frame type of EtherCAT commands.
const TYPE_COMMANDS: u16 = 1;
/// Mask of the length in a length field: its lower 11 bits.
const LENGTH_MASK: u16 = 0x07ff;
/// Bit in the length field of a datagram that is set if another datagram follows.
const MORE_FOLLOWS: u16 = 0x8000;
/// Length of a datagram's header: command, index, address, length and interrupt field \[bytes\].
pub const DATAGRAM_HEADER_LEN: usize = 10;
/// Length of the working counter, which follows the data of a datagram \[bytes\].
pub const WORKING_COUNTER_LEN: usize = 2;

/// Range of the datagrams in an Ethernet frame. `None` if the frame is not an EtherCAT frame with commands.
///
/// If the length field exceeds the frame, the range ends with the frame.
pub fn datagrams(frame: &[u8]) -> Option<Range<usize>> {
    if frame.get(ETHERTYPE)? != ETHERCAT {
        return None;
    }
    let start = ETHERNET_HEADER_LEN + ETHERCAT_HEADER_LEN;
    let header = u16_at(frame, ETHERNET_HEADER_LEN)?;
    if header >> 12 != TYPE_COMMANDS {
        return None;
    }
    Some(start..frame.len().min(start + usize::from(header & LENGTH_MASK)))
}

/// Marks a frame as processed by a slave controller. A master drops a frame whose source address is still the master's own.
pub fn mark_processed(frame: &mut [u8]) {
    if let Some(byte) = frame.get_mut(SOURCE_MAC) {
        *byte |= LOCALLY_ADMINISTERED;
    }
}

/// One EtherCAT command with its data, which are changed in place.
pub struct Datagram<'a> {
    header: &'a mut [u8; DATAGRAM_HEADER_LEN],
    /// Data that the command reads or writes.
    pub data: &'a mut [u8],
    working_counter: &'a mut [u8; WORKING_COUNTER_LEN],
}

impl<'a> Datagram<'a> {
    /// Splits `bytes` into the first datagram and the bytes after it. `None` if the datagram is incomplete.
    ///
    /// The bytes after it are empty if this is the last datagram of the frame.
    pub fn split_first(bytes: &'a mut [u8]) -> Option<(Self, &'a mut [u8])> {
        let (header, rest) = bytes.split_first_chunk_mut::<DATAGRAM_HEADER_LEN>()?;
        let length = u16::from_le_bytes([header[6], header[7]]);
        let (data, rest) = rest.split_at_mut_checked(usize::from(length & LENGTH_MASK))?;
        let (working_counter, rest) = rest.split_first_chunk_mut::<WORKING_COUNTER_LEN>()?;
        let rest = if length & MORE_FOLLOWS == 0 { &mut [] } else { rest };
        Some((Self { header, data, working_counter }, rest))
    }

    pub fn command(&self) -> u8 {
        self.header[0]
    }

    /// Address of the device, which is a position or a station address.
    pub fn device_address(&self) -> u16 {
        u16::from_le_bytes([self.header[2], self.header[3]])
    }

    /// Increments the address field. Commands that address devices by position and broadcast commands
    /// do this at every device.
    pub fn increment_device_address(&mut self) {
        let next = self.device_address().wrapping_add(1).to_le_bytes();
        [self.header[2], self.header[3]] = next;
    }

    /// Address in the device's memory.
    pub fn memory_address(&self) -> u16 {
        u16::from_le_bytes([self.header[4], self.header[5]])
    }

    /// Address in the logical process image.
    pub fn logical_address(&self) -> u32 {
        u32::from(self.memory_address()) << 16 | u32::from(self.device_address())
    }

    /// Increments the working counter.
    pub fn count(&mut self, increment: u16) {
        let sum = u16::from_le_bytes(*self.working_counter).wrapping_add(increment);
        *self.working_counter = sum.to_le_bytes();
    }

    /// Reduces the working counter, not below zero.
    pub fn count_less(&mut self, decrement: u16) {
        let rest = u16::from_le_bytes(*self.working_counter).saturating_sub(decrement);
        *self.working_counter = rest.to_le_bytes();
    }
}

/// Little-endian word at `offset`.
fn u16_at(bytes: &[u8], offset: usize) -> Option<u16> {
    Some(u16::from_le_bytes(*bytes.get(offset..)?.first_chunk()?))
}
