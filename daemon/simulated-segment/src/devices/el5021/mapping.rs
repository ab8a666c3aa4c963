//! Process data of the EL5021: encodes inputs, decodes outputs, and maps their bits to objects.

use super::Revision;
use crate::chip::eeprom::PdoEntry;

/// PDO of the outputs, "ENC Control".
pub const RX_PDO: u16 = 0x1600;
/// PDO of the inputs, "ENC Status".
pub const TX_PDO: u16 = 0x1a00;

const LATCH_C: u8 = 0x01;
const SET_COUNTER: u8 = 0x04;

/// Outputs: requests of the master to the terminal.
#[derive(Debug, Clone, Copy, Default)]
pub struct Outputs {
    /// Arms the latch for the next reference mark (C).
    pub enable_latch: bool,
    /// Sets the counter to `set_value`.
    pub set_counter: bool,
    /// Value for the counter.
    pub set_value: u32,
}

impl Outputs {
    /// Decodes six bytes. The first two are a control word. The value for the counter begins at the third byte. Missing
    /// bytes count as zero.
    pub fn decode(bytes: &[u8]) -> Self {
        let control = bytes.first().copied().unwrap_or(0);
        let value = bytes.get(2..).and_then(|rest| rest.first_chunk()).copied().unwrap_or_default();
        Self {
            enable_latch: control & LATCH_C != 0,
            set_counter: control & SET_COUNTER != 0,
            set_value: u32::from_le_bytes(value),
        }
    }
}

/// Inputs: state of the terminal.
#[derive(Debug, Clone, Copy, Default)]
pub struct Inputs {
    /// Whether `latch` contains the count at the reference mark (C).
    pub latch_valid: bool,
    /// Whether the request to set the counter has been served.
    pub set_done: bool,
    /// The input frequency is too high.
    pub frequency_error: bool,
    /// The signals are too weak.
    pub amplitude_error: bool,
    /// Level of input C.
    pub level_c: bool,
    /// Whether a sync event without new outputs has occurred since the last conversion.
    pub sync_error: bool,
    /// Toggle bit. Each conversion inverts it, so that a master recognises new data.
    pub toggle: bool,
    pub counter: u32,
    pub latch: u32,
}

impl Inputs {
    /// Bit "TxPDO state" of the status word: whether the input signal has any error.
    pub fn invalid(&self) -> bool {
        self.frequency_error || self.amplitude_error
    }

    /// The status word. Its bits are in the order of [`tx_entries`].
    pub fn status(&self) -> u16 {
        let bits = [
            (0, self.latch_valid),
            (2, self.set_done),
            (3, self.frequency_error),
            (4, self.amplitude_error),
            (10, self.level_c),
            (13, self.sync_error),
            (14, self.invalid()),
            (15, self.toggle),
        ];
        bits.iter().fold(0, |word, (bit, set)| word | u16::from(*set) << bit)
    }

    /// Encodes status, counter and latch as ten bytes.
    pub fn encode(&self, bytes: &mut [u8]) {
        let Some(bytes) = bytes.first_chunk_mut::<10>() else { return };
        bytes[..2].copy_from_slice(&self.status().to_le_bytes());
        bytes[2..6].copy_from_slice(&self.counter.to_le_bytes());
        bytes[6..].copy_from_slice(&self.latch.to_le_bytes());
    }
}

const fn entry(index: u16, subindex: u8, bits: u8) -> PdoEntry {
    PdoEntry { object: (index, subindex), bits }
}

const fn gap(bits: u8) -> PdoEntry {
    entry(0, 0, bits)
}

/// Entries of the PDO of the outputs.
pub const fn rx_entries() -> [PdoEntry; 5] {
    [entry(0x7000, 0x01, 1), gap(1), entry(0x7000, 0x03, 1), gap(13), entry(0x7000, 0x11, 32)]
}

/// Entries of the PDO of the inputs. Up to revision 18, three status bits are in objects for communication.
pub fn tx_entries(revision: Revision) -> [PdoEntry; 13] {
    let [sync_error, state, toggle] = if revision < Revision::R19 {
        [(0x1c32, 0x20), (0x1800, 0x07), (0x1800, 0x09)]
    } else {
        [(0x6000, 0x0e), (0x6000, 0x0f), (0x6000, 0x10)]
    };
    [
        entry(0x6000, 0x01, 1),
        gap(1),
        entry(0x6000, 0x03, 1),
        entry(0x6001, 0x04, 1),
        entry(0x6001, 0x05, 1),
        gap(5),
        entry(0x6000, 0x0b, 1),
        gap(2),
        entry(sync_error.0, sync_error.1, 1),
        entry(state.0, state.1, 1),
        entry(toggle.0, toggle.1, 1),
        entry(0x6000, 0x11, 32),
        entry(0x6000, 0x12, 32),
    ]
}
