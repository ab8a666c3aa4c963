//! The EEPROM interface of a chip. Through its registers, a master reads the slave information (SII), four or eight bytes at
//! a time (ETG.1000.4 section 6.4).

use super::registers::{SII_ACCESS, SII_CONTROL};

const OWNED_BY_DEVICE: u8 = 0x01;
const FORCE_RELEASE: u8 = 0x02;
const WRITE_ENABLE: u16 = 0x0001;
const EIGHT_BYTE_READS: u16 = 0x0040;
const COMMAND_MASK: u16 = 0x0700;
const COMMAND_READ: u16 = 0x0100;
const COMMAND_WRITE: u16 = 0x0200;
const COMMAND_RELOAD: u16 = 0x0400;
const COMMAND_ERROR: u16 = 0x2000;
const WRITE_ENABLE_ERROR: u16 = 0x4000;
const BUSY: u16 = 0x8000;
/// Time for which the interface is busy after a command. It is about the time for an address and four bytes
/// on I2C at 400 kHz.
const BUSY_NS: i64 = 120_000;

/// The interface, including the EEPROM.
pub struct Sii {
    image: Vec<u8>,
    access: u8,
    capabilities: u16,
    errors: u16,
    /// Address in the EEPROM, in words of two bytes.
    address: u32,
    data: [u8; 8],
    busy_until_ns: i64,
}

impl Sii {
    /// An interface to the EEPROM content `image`. It reads eight bytes at a time if
    /// `eight_byte_reads` is set, otherwise four.
    pub fn new(image: Vec<u8>, eight_byte_reads: bool) -> Self {
        let capabilities = if eight_byte_reads { EIGHT_BYTE_READS } else { 0 };
        Self { image, access: 0, capabilities, errors: 0, address: 0, data: [0; 8], busy_until_ns: i64::MIN }
    }

    /// Station alias that is stored in the EEPROM.
    pub fn alias(&self) -> [u8; 2] {
        [self.byte(8), self.byte(9)]
    }

    /// Content of the registers 0x0500 to 0x050F.
    pub fn registers(&self, now_ns: i64) -> [u8; 16] {
        let busy = if now_ns < self.busy_until_ns { BUSY } else { 0 };
        let control = (self.capabilities | self.errors | busy).to_le_bytes();
        let mut registers = [0; 16];
        registers[0] = self.access;
        registers[2..4].copy_from_slice(&control);
        registers[4..8].copy_from_slice(&self.address.to_le_bytes());
        registers[8..].copy_from_slice(&self.data);
        registers
    }

    /// Handles a write of a master to `len` bytes at `address`. `registers` contains all registers after the write.
    pub fn write(&mut self, address: u16, len: usize, registers: &[u8; 16], now_ns: i64) {
        let touched = |register: u16| (address..address.saturating_add(len as u16)).contains(&register);
        if touched(SII_ACCESS) {
            let force = registers[0] & FORCE_RELEASE != 0;
            self.access = if force { 0 } else { registers[0] & OWNED_BY_DEVICE };
        }
        if now_ns < self.busy_until_ns {
            return;
        }
        let [.., a0, a1, a2, a3, _, _, _, _, _, _, _, _] = *registers;
        self.address = u32::from_le_bytes([a0, a1, a2, a3]);
        self.data.copy_from_slice(&registers[8..]);
        if touched(SII_CONTROL) || touched(SII_CONTROL + 1) {
            self.command(u16::from_le_bytes([registers[2], registers[3]]), now_ns);
        }
    }

    fn command(&mut self, control: u16, now_ns: i64) {
        self.errors = 0;
        let command = control & COMMAND_MASK;
        if command != 0 && self.access & OWNED_BY_DEVICE != 0 {
            self.errors = COMMAND_ERROR;
            return;
        }
        match command {
            0 => return,
            COMMAND_READ => self.fetch(),
            COMMAND_WRITE if control & WRITE_ENABLE == 0 => self.errors = WRITE_ENABLE_ERROR,
            COMMAND_WRITE => self.store(),
            COMMAND_RELOAD => {}
            _ => self.errors = COMMAND_ERROR,
        }
        self.busy_until_ns = now_ns.saturating_add(BUSY_NS);
    }

    fn fetch(&mut self) {
        let count = if self.capabilities & EIGHT_BYTE_READS == 0 { 4 } else { 8 };
        let start = (self.address as usize).saturating_mul(2);
        for offset in 0..count {
            self.data[offset] = self.byte(start.saturating_add(offset));
        }
    }

    fn store(&mut self) {
        let start = (self.address as usize).saturating_mul(2);
        let word = [self.data[0], self.data[1]];
        if let Some(target) = self.image.get_mut(start..start.saturating_add(2)) {
            target.copy_from_slice(&word);
        }
    }

    /// A byte of the EEPROM. Bytes outside the image are ones, as in an erased EEPROM.
    fn byte(&self, offset: usize) -> u8 {
        self.image.get(offset).copied().unwrap_or(0xff)
    }
}
