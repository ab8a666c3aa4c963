//! Beckhoff EL5021: process data and objects, according to Beckhoff's ESI (revisions 16 to 22) and documentation.
//!
//! Sources, read in 2026-11:
//! - linuxcnc-ethercat: `scripts/esi.yml`, and its commissioning notes on distributed clocks with three EL5021
//! - the driver of linuxcnc-ethercat, `lcec_el5021.c`, whose process data were read back from hardware
//! - EtherLab: block el5021 (2013)
//! - Beckhoff Infosys: EL5021
//!
//! This project has not checked these sources with a real terminal. The command `ballbard smoke` does so.

use std::time::Duration;

/// Length of the TxPDO "ENC Status" (0x1A00) \[bytes\]. linuxcnc-ethercat and EtherLab describe the same layout.
pub const INPUT_BYTES: usize = 10;
/// Length of the RxPDO "ENC Control" (0x1600) \[bytes\], from the same sources as the TxPDO.
pub const OUTPUT_BYTES: usize = 6;
/// Contribution of one terminal to the working counter of a read-write datagram: 1 for inputs, 2 for outputs (ETG.1000.4).
pub const WORKING_COUNTER: u16 = 3;
/// Object "analog resolution" with the interpolation, 8 to 13 bits per signal period (Infosys, configuration data).
pub const INTERPOLATION_OBJECT: (u16, u8) = (0x8001, 0x11);
/// Delay of SYNC1 after SYNC0: 25 000 ns, the shift of SYNC1 in the ESI. With a delay of one whole cycle, the terminal
/// refused OP with AL status 0x002C (linuxcnc-ethercat).
pub const SYNC1_SHIFT: Duration = Duration::from_micros(25);
/// Time after SYNC0 at which the data are ready for a frame \[ns\]. In the ESI, SYNC0 is 30 600 ns before the frame; this
/// value is rounded up. One terminal needed 65 000 ns (linuxcnc-ethercat). Both are early enough. The frame follows half a
/// period after SYNC0, which is 500 000 ns at 1 kHz.
pub const DATA_READY_NS: i64 = 31_000;

/// Status word of the TxPDO.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct StatusWord(pub u16);

impl StatusWord {
    const LATCH_VALID: u16 = 1 << 0;
    const FREQUENCY_ERROR: u16 = 1 << 3;
    const AMPLITUDE_ERROR: u16 = 1 << 4;
    const SYNC_ERROR: u16 = 1 << 13;
    const TXPDO_STATE: u16 = 1 << 14;
    const TOGGLE: u16 = 1 << 15;

    /// Whether the count is unreliable. The reason is a frequency, amplitude or synchronisation error,
    /// or an invalid TxPDO state.
    pub const fn has_error(self) -> bool {
        self.0 & (Self::FREQUENCY_ERROR | Self::AMPLITUDE_ERROR | Self::SYNC_ERROR | Self::TXPDO_STATE) != 0
    }

    /// Whether the signal is too low, because of a broken wire, a loose plug or a missing supply.
    pub const fn amplitude_error(self) -> bool {
        self.0 & Self::AMPLITUDE_ERROR != 0
    }

    /// Whether the signal changes faster than the terminal can follow.
    pub const fn frequency_error(self) -> bool {
        self.0 & Self::FREQUENCY_ERROR != 0
    }

    /// Whether the cycle of the terminal was not synchronous with SYNC0.
    pub const fn sync_error(self) -> bool {
        self.0 & Self::SYNC_ERROR != 0
    }

    /// Whether the latch contains the count at a reference mark. The mark was passed after the latch was armed.
    pub const fn latch_valid(self) -> bool {
        self.0 & Self::LATCH_VALID != 0
    }

    /// Toggle bit. The terminal inverts it each time it puts new data into the PDO.
    pub const fn toggle(self) -> bool {
        self.0 & Self::TOGGLE != 0
    }
}

/// Outputs of one terminal.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Output {
    /// Latches the counter at the next reference mark. To arm the latch again, this value must first be false and then true.
    pub enable_latch: bool,
}

impl Output {
    /// Encodes the RxPDO "ENC Control". The request to set the counter is never used.
    pub const fn encode(self) -> [u8; OUTPUT_BYTES] {
        [self.enable_latch as u8, 0, 0, 0, 0, 0]
    }
}

/// Inputs of one terminal.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Input {
    pub status: StatusWord,
    pub count: u32,
    /// Count at the last reference mark (C).
    pub latch: u32,
}

impl Input {
    /// Decodes a TxPDO. `None` if the length differs from that of an EL5021.
    pub fn decode(pdo: &[u8]) -> Option<Self> {
        let pdo: &[u8; INPUT_BYTES] = pdo.try_into().ok()?;
        let [s0, s1, c0, c1, c2, c3, l0, l1, l2, l3] = *pdo;
        Some(Self {
            status: StatusWord(u16::from_le_bytes([s0, s1])),
            count: u32::from_le_bytes([c0, c1, c2, c3]),
            latch: u32::from_le_bytes([l0, l1, l2, l3]),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pdo_decodes_as_documented() {
        // Status 0x8400: toggle and level of C; counter 0x00e10000 = one revolution at 12 bits; latch 7.
        let input = Input::decode(&[0x00, 0x84, 0x00, 0x00, 0xe1, 0x00, 0x07, 0, 0, 0]).unwrap();
        assert_eq!((input.count, input.latch), (14_745_600, 7));
        assert!(input.status.toggle() && !input.status.has_error());
        assert_eq!(Input::decode(&[0; 9]), None);
    }

    #[test]
    fn every_error_bit_invalidates_the_count() {
        for bit in [3, 4, 13, 14] {
            assert!(StatusWord(1 << bit).has_error(), "bit {bit}");
        }
        assert!(!StatusWord(0b1000_0100_0000_0101).has_error());
    }
}
