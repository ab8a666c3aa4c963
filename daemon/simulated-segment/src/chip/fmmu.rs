//! Fieldbus memory management units (FMMUs): they map logical addresses to process memory (ETG.1000.4 section 6.6).

use std::ops::Range;

use super::sync_manager::Access;

/// Number of units that a chip can have.
pub const UNITS_MAX: usize = 8;

const READ: u8 = 0x01;
const WRITE: u8 = 0x02;
const ENABLE: u8 = 0x01;

/// Registers of one unit. The unit maps `length` bytes from the logical address `logical`
/// to the device's address `physical`.
#[derive(Clone, Copy, Default)]
pub struct Fmmu {
    logical: u32,
    length: u16,
    start_bit: u8,
    end_bit: u8,
    physical: u16,
    physical_bit: u8,
    /// [`READ`], [`WRITE`], or both.
    kind: u8,
    enable: u8,
}

/// The bytes of a datagram that a unit maps.
pub struct Mapped {
    /// Range of these bytes in the datagram's data.
    pub data: Range<usize>,
    /// Address of the first byte in the device.
    pub physical: u16,
    /// The mapped bits, if the unit maps only some bits of one byte. `None` if it maps whole bytes.
    pub bits: Option<Bits>,
}

/// Mapping of `count` bits within one byte: from bit `physical` in the device to bit `logical` in the datagram.
#[derive(Clone, Copy)]
pub struct Bits {
    logical: u8,
    physical: u8,
    count: u8,
}

impl Bits {
    /// Copies the mapped bits from the device's byte into the datagram's byte.
    pub fn to_logical(self, device: u8, datagram: u8) -> u8 {
        insert(device >> self.physical, datagram, self.logical, self.count)
    }

    /// Copies the mapped bits from the datagram's byte into the device's byte.
    pub fn to_physical(self, datagram: u8, device: u8) -> u8 {
        insert(datagram >> self.logical, device, self.physical, self.count)
    }
}

/// Replaces `count` bits of `target`, beginning at bit `shift`, with the lowest bits of `source`.
fn insert(source: u8, target: u8, shift: u8, count: u8) -> u8 {
    let mask = (((1u16 << count) - 1) << shift) as u8;
    (target & !mask) | ((source << shift) & mask)
}

impl Fmmu {
    /// Applies the registers that a master has written.
    pub fn configure(&mut self, registers: &[u8; 16]) {
        let [l0, l1, l2, l3, n0, n1, start_bit, end_bit, p0, p1, physical_bit, kind, enable, ..] = *registers;
        *self = Self {
            logical: u32::from_le_bytes([l0, l1, l2, l3]),
            length: u16::from_le_bytes([n0, n1]),
            start_bit: start_bit & 7,
            end_bit: end_bit & 7,
            physical: u16::from_le_bytes([p0, p1]),
            physical_bit: physical_bit & 7,
            kind,
            enable,
        };
    }

    /// The bytes that this unit maps for an access to `len` bytes at the address `logical`. `None` if it maps none of them.
    /// The `direction` is that of the master's access.
    pub fn map(&self, logical: u32, len: usize, direction: Access) -> Option<Mapped> {
        let kind = if direction == Access::Read { READ } else { WRITE };
        if self.enable & ENABLE == 0 || self.kind & kind == 0 {
            return None;
        }
        let (from, to) = (u64::from(logical), u64::from(logical) + len as u64);
        let unit_from = u64::from(self.logical);
        let unit_to = unit_from + u64::from(self.length);
        let (start, end) = (from.max(unit_from), to.min(unit_to));
        if start >= end {
            return None;
        }
        let physical = u16::try_from(u64::from(self.physical) + start - unit_from).ok()?;
        Some(Mapped { data: (start - from) as usize..(end - from) as usize, physical, bits: self.bits() })
    }

    /// The mapped bits, if the unit maps bits within one byte, such as status bits. Longer process data of the simulated
    /// devices always consist of whole bytes.
    fn bits(&self) -> Option<Bits> {
        let whole = self.start_bit == 0 && self.end_bit == 7 && self.physical_bit == 0;
        if whole || self.length != 1 || self.end_bit < self.start_bit {
            return None;
        }
        let count = (self.end_bit - self.start_bit + 1).min(8 - self.physical_bit);
        Some(Bits { logical: self.start_bit, physical: self.physical_bit, count })
    }
}
