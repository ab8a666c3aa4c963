//! Object dictionary of the EL5021 (CoE).

use super::counter::{BITS, Settings};
use super::{El5021, PRODUCT, VENDOR, mapping};
use crate::chip::SyncMode;
use crate::chip::coe::{Abort, ObjectDictionary, ObjectList};
use crate::chip::eeprom::PdoEntry;

/// Module profile 511 in a CoE profile 5001 device, as the plug-in version EJ5021 reports.
const DEVICE_TYPE: u32 = 0x01ff_1389;
const NAME: &str = "EL5021";
const HARDWARE: &str = "02";
/// "load", the signature for restoring defaults.
const RESTORE: u32 = 0x6461_6f6c;
const SUPPORTED_SYNC_TYPES: u16 = 0xc007;
const MINIMUM_CYCLE_NS: u32 = 100_000;

/// Every object; revisions that do not measure frequency lack 0x1A01 and 0x1A02.
const OBJECTS: [u16; 20] = [
    0x1000, 0x1008, 0x1009, 0x100a, 0x1011, 0x1018, 0x1600, 0x1800, 0x1a00, 0x1c00, 0x1c12, 0x1c13, 0x1c32,
    0x1c33, 0x6000, 0x6001, 0x7000, 0x8000, 0x8001, 0xa000,
];
const OBJECTS_WITH_FREQUENCY: [u16; 22] = [
    0x1000, 0x1008, 0x1009, 0x100a, 0x1011, 0x1018, 0x1600, 0x1800, 0x1a00, 0x1a01, 0x1a02, 0x1c00, 0x1c12,
    0x1c13, 0x1c32, 0x1c33, 0x6000, 0x6001, 0x7000, 0x8000, 0x8001, 0xa000,
];

/// The value of an object.
enum Value {
    Bit(bool),
    U8(u8),
    U16(u16),
    U32(u32),
    Text(&'static str),
}

impl Value {
    fn write(&self, target: &mut [u8]) -> Result<usize, Abort> {
        let mut put = |bytes: &[u8]| {
            target.get_mut(..bytes.len()).ok_or(Abort::OutOfMemory)?.copy_from_slice(bytes);
            Ok(bytes.len())
        };
        match self {
            Self::Bit(value) => put(&[u8::from(*value)]),
            Self::U8(value) => put(&[*value]),
            Self::U16(value) => put(&value.to_le_bytes()),
            Self::U32(value) => put(&value.to_le_bytes()),
            Self::Text(value) => put(value.as_bytes()),
        }
    }
}

/// The entries of a PDO in the object dictionary: object, subindex and bits in one word.
fn mapped(entries: &[PdoEntry], subindex: u8) -> Result<Value, Abort> {
    match usize::from(subindex).checked_sub(1) {
        None => Ok(Value::U8(entries.len() as u8)),
        Some(position) => {
            let PdoEntry { object: (index, subindex), bits } =
                entries.get(position).ok_or(Abort::NoSubindex)?;
            Ok(Value::U32(u32::from(*index) << 16 | u32::from(*subindex) << 8 | u32::from(*bits)))
        }
    }
}

/// The PDOs that are assigned to a sync manager.
fn listed(values: &[u16], subindex: u8) -> Result<Value, Abort> {
    match usize::from(subindex).checked_sub(1) {
        None => Ok(Value::U8(values.len() as u8)),
        Some(position) => values.get(position).map(|value| Value::U16(*value)).ok_or(Abort::NoSubindex),
    }
}

impl El5021 {
    fn value(&self, index: u16, subindex: u8) -> Result<Value, Abort> {
        match index {
            0x1000 | 0x1008 | 0x1009 | 0x100a => self.identification(index, subindex),
            0x1018 => self.identity(subindex),
            mapping::RX_PDO => mapped(&mapping::rx_entries(), subindex),
            mapping::TX_PDO => mapped(&mapping::tx_entries(self.revision), subindex),
            0x1a01 | 0x1a02 if self.revision.measures_frequency() => {
                let object = if index == 0x1a01 { (0x6000, 0x1b) } else { (0x6000, 0x13) };
                mapped(&[PdoEntry { object, bits: 32 }], subindex)
            }
            0x1c00 => self.channel_types(subindex),
            0x1c12 => listed(&[mapping::RX_PDO], subindex),
            0x1c13 => listed(&[mapping::TX_PDO], subindex),
            0x1c32 | 0x1c33 => self.synchronisation(index, subindex),
            0x1011 => match subindex {
                0 => Ok(Value::U8(1)),
                1 => Ok(Value::U32(0)),
                _ => Err(Abort::NoSubindex),
            },
            0x1800 => self.pdo_parameter(subindex),
            0x6000 | 0x6001 | 0x7000 => self.process_data(index, subindex),
            0x8000 | 0x8001 => self.setting(index, subindex),
            0xa000 => match subindex {
                0 => Ok(Value::U8(0x12)),
                0x11 => Ok(Value::U16(self.diagnosis.frequency_errors)),
                0x12 => Ok(Value::U16(self.diagnosis.amplitude_errors)),
                _ => Err(Abort::NoSubindex),
            },
            _ => Err(Abort::NoObject),
        }
    }

    fn identification(&self, index: u16, subindex: u8) -> Result<Value, Abort> {
        match (index, subindex) {
            (0x1000, 0) => Ok(Value::U32(DEVICE_TYPE)),
            (0x1008, 0) => Ok(Value::Text(NAME)),
            (0x1009, 0) => Ok(Value::Text(HARDWARE)),
            (_, 0) => Ok(Value::Text(self.revision.firmware())),
            _ => Err(Abort::NoSubindex),
        }
    }

    fn identity(&self, subindex: u8) -> Result<Value, Abort> {
        match subindex {
            0 => Ok(Value::U8(4)),
            1 => Ok(Value::U32(VENDOR)),
            2 => Ok(Value::U32(PRODUCT)),
            3 => Ok(Value::U32(self.revision.number())),
            4 => Ok(Value::U32(0)),
            _ => Err(Abort::NoSubindex),
        }
    }

    /// 0x1C00: mailbox out, mailbox in, outputs, inputs.
    fn channel_types(&self, subindex: u8) -> Result<Value, Abort> {
        match subindex {
            0 => Ok(Value::U8(4)),
            1..=4 => Ok(Value::U8(subindex)),
            _ => Err(Abort::NoSubindex),
        }
    }

    /// 0x1C32 (outputs) and 0x1C33 (inputs).
    fn synchronisation(&self, index: u16, subindex: u8) -> Result<Value, Abort> {
        const BY_OUTPUTS: u16 = 0x01;
        const WITH_OUTPUTS: u16 = 0x22;
        const BY_SYNC0: u16 = 0x02;
        const BY_SYNC1: u16 = 0x03;
        let mode = match (self.sync_mode, index) {
            (SyncMode::DistributedClock, 0x1c32) => BY_SYNC1,
            (SyncMode::DistributedClock, _) => BY_SYNC0,
            (SyncMode::SyncManager, 0x1c32) => BY_OUTPUTS,
            (SyncMode::SyncManager, _) => WITH_OUTPUTS,
        };
        match subindex {
            0 => Ok(Value::U8(0x20)),
            0x01 => Ok(Value::U16(mode)),
            0x04 => Ok(Value::U16(SUPPORTED_SYNC_TYPES)),
            0x05 => Ok(Value::U32(MINIMUM_CYCLE_NS)),
            0x0b => Ok(Value::U16(self.diagnosis.sync_missed)),
            0x0c => Ok(Value::U16(0)),
            0x20 => Ok(Value::Bit(self.diagnosis.sync_error)),
            0x02 | 0x03 | 0x06 | 0x09 => Ok(Value::U32(0)),
            0x07 | 0x08 | 0x0d => Ok(Value::U16(0)),
            _ => Err(Abort::NoSubindex),
        }
    }

    /// 0x1800: state and toggle of the inputs in old revisions.
    fn pdo_parameter(&self, subindex: u8) -> Result<Value, Abort> {
        match subindex {
            0 => Ok(Value::U8(9)),
            0x07 => Ok(Value::Bit(self.inputs.invalid())),
            0x09 => Ok(Value::Bit(self.inputs.toggle)),
            _ => Err(Abort::NoSubindex),
        }
    }

    fn process_data(&self, index: u16, subindex: u8) -> Result<Value, Abort> {
        let (inputs, outputs) = (&self.inputs, &self.outputs);
        match (index, subindex) {
            (0x6000, 0) => Ok(Value::U8(0x12)),
            (0x6000, 0x01) => Ok(Value::Bit(inputs.latch_valid)),
            (0x6000, 0x03) => Ok(Value::Bit(inputs.set_done)),
            (0x6000, 0x0b) => Ok(Value::Bit(inputs.level_c)),
            (0x6000, 0x0e) => Ok(Value::Bit(inputs.sync_error)),
            (0x6000, 0x0f) => Ok(Value::Bit(inputs.invalid())),
            (0x6000, 0x10) => Ok(Value::Bit(inputs.toggle)),
            (0x6000, 0x11) => Ok(Value::U32(inputs.counter)),
            (0x6000, 0x12) => Ok(Value::U32(inputs.latch)),
            (0x6001, 0) => Ok(Value::U8(5)),
            (0x6001, 0x04) => Ok(Value::Bit(inputs.frequency_error)),
            (0x6001, 0x05) => Ok(Value::Bit(inputs.amplitude_error)),
            (0x7000, 0) => Ok(Value::U8(0x11)),
            (0x7000, 0x01) => Ok(Value::Bit(outputs.enable_latch)),
            (0x7000, 0x03) => Ok(Value::Bit(outputs.set_counter)),
            (0x7000, 0x11) => Ok(Value::U32(outputs.set_value)),
            _ => Err(Abort::NoSubindex),
        }
    }

    fn setting(&self, index: u16, subindex: u8) -> Result<Value, Abort> {
        let settings = &self.settings;
        match (index, subindex) {
            (0x8000, 0) => Ok(Value::U8(if self.revision.measures_frequency() { 0x1f } else { 0x0e })),
            (0x8000, 0x01) => Ok(Value::Bit(settings.reset_on_c)),
            (0x8000, 0x0e) => Ok(Value::Bit(settings.reversed)),
            (0x8000, 0x0f..) if !self.revision.measures_frequency() => Err(Abort::NoSubindex),
            (0x8000, 0x0f) => Ok(Value::Bit(settings.window_in_ms)),
            (0x8000, 0x11) => Ok(Value::U16(settings.window)),
            (0x8000, 0x1d) => Ok(Value::U32(settings.numerator)),
            (0x8000, 0x1e) => Ok(Value::U32(settings.denominator)),
            (0x8000, 0x1f) => Ok(Value::U16(settings.filter)),
            (0x8001, 0) => Ok(Value::U8(0x11)),
            (0x8001, 0x01) => Ok(Value::Bit(settings.frequency_error)),
            (0x8001, 0x02) => Ok(Value::Bit(settings.amplitude_error)),
            (0x8001, 0x11) => Ok(Value::U8(settings.bits)),
            _ => Err(Abort::NoSubindex),
        }
    }

    fn change_setting(&mut self, index: u16, subindex: u8, value: u32) -> Result<(), Abort> {
        let settings = &mut self.settings;
        match (index, subindex) {
            (0x8000, 0x01) => settings.reset_on_c = value == 1,
            (0x8000, 0x0e) => settings.reversed = value == 1,
            (0x8000, 0x0f) => settings.window_in_ms = value == 1,
            (0x8000, 0x11) => settings.window = value as u16,
            (0x8000, 0x1d) => settings.numerator = value,
            (0x8000, 0x1e) if value == 0 => return Err(Abort::ValueRange),
            (0x8000, 0x1e) => settings.denominator = value,
            (0x8000, 0x1f) if value > 8 => return Err(Abort::ValueRange),
            (0x8000, 0x1f) => settings.filter = value as u16,
            (0x8001, 0x01) => settings.frequency_error = value == 1,
            (0x8001, 0x02) => settings.amplitude_error = value == 1,
            (0x8001, 0x11) => match u8::try_from(value) {
                Ok(bits) if BITS.contains(&bits) => settings.bits = bits,
                _ => return Err(Abort::ValueRange),
            },
            _ => return Err(Abort::ReadOnly),
        }
        Ok(())
    }

    fn restore(&mut self, signature: u32) -> Result<(), Abort> {
        if signature != RESTORE {
            return Err(Abort::ValueRange);
        }
        self.settings = Settings::default();
        Ok(())
    }
}

impl ObjectDictionary for El5021 {
    fn upload(&self, index: u16, subindex: u8, target: &mut [u8]) -> Result<usize, Abort> {
        self.value(index, subindex)?.write(target)
    }

    fn download(&mut self, index: u16, subindex: u8, bytes: &[u8]) -> Result<(), Abort> {
        // A readable object has a known length.
        let present = self.value(index, subindex)?;
        let mut value = [0; 4];
        if !matches!((index, subindex), (0x1011, 1) | (0x8000 | 0x8001, 1..)) {
            return Err(Abort::ReadOnly);
        }
        if present.write(&mut value)? != bytes.len() {
            return Err(Abort::WrongLength);
        }
        value[..bytes.len()].copy_from_slice(bytes);
        let value = u32::from_le_bytes(value);
        if matches!(present, Value::Bit(_)) && value > 1 {
            return Err(Abort::ValueRange);
        }
        if index == 0x1011 { self.restore(value) } else { self.change_setting(index, subindex, value) }
    }

    fn list(&self, list: ObjectList) -> &'static [u16] {
        match list {
            ObjectList::All if self.revision.measures_frequency() => &OBJECTS_WITH_FREQUENCY,
            ObjectList::All => &OBJECTS,
            ObjectList::RxMappable => &[0x7000],
            ObjectList::TxMappable => &[0x6000, 0x6001],
            ObjectList::Stored | ObjectList::Startup => &[0x8000, 0x8001],
        }
    }
}
