//! Object dictionary of the EL5021 (CoE): reads and writes values by index and subindex.

use super::counter::{BITS, Counter, CounterSettings};
use super::{El5021, PRODUCT, VENDOR, mapping};
use crate::chip::SyncMode;
use crate::chip::coe::{Abort, ObjectDictionary, ObjectList};
use crate::chip::eeprom::PdoEntry;

/// Device type: module profile 511 in a device with CoE profile 5001. The EJ5021, the plug-in version, reports this value.
const DEVICE_TYPE: u32 = 0x01ff_1389;
const NAME: &str = "EL5021";
const HARDWARE: &str = "02";
/// The text "load" as a number. A master writes it to restore the default settings.
const RESTORE: u32 = 0x6461_6f6c;
const SUPPORTED_SYNC_TYPES: u16 = 0xc007;
const MINIMUM_CYCLE_NS: u32 = 100_000;

/// Indices of all objects of the newest revision.
const OBJECTS: [u16; 22] = [
    0x1000, 0x1008, 0x1009, 0x100a, 0x1011, 0x1018, 0x1600, 0x1800, 0x1a00, 0x1a01, 0x1a02, 0x1c00, 0x1c12,
    0x1c13, 0x1c32, 0x1c33, 0x6000, 0x6001, 0x7000, 0x8000, 0x8001, 0xa000,
];
/// Objects that exist only in revisions that measure frequency.
const FREQUENCY_PDOS: [u16; 2] = [0x1a01, 0x1a02];
/// Values for the type of synchronisation in the objects 0x1C32 (outputs) and 0x1C33 (inputs).
const BY_OUTPUTS: u16 = 0x01;
const WITH_OUTPUTS: u16 = 0x22;
const BY_SYNC0: u16 = 0x02;
const BY_SYNC1: u16 = 0x03;

/// Value of an object, by its type.
enum ObjectValue {
    Bit(bool),
    U8(u8),
    U16(u16),
    U32(u32),
    Text(&'static str),
}

impl ObjectValue {
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

/// The object that describes the entries of a PDO. Subindex 0 is the number of entries. Each other subindex describes one
/// entry as one word, which contains the index, subindex and bits of an object.
fn mapped(entries: &[PdoEntry], subindex: u8) -> Option<ObjectValue> {
    let Some(position) = usize::from(subindex).checked_sub(1) else {
        return Some(ObjectValue::U8(entries.len() as u8));
    };
    let PdoEntry { object: (index, subindex), bits } = entries.get(position)?;
    Some(ObjectValue::U32(u32::from(*index) << 16 | u32::from(*subindex) << 8 | u32::from(*bits)))
}

impl El5021 {
    /// The value of an object. `None` if the object or its subindex does not exist.
    fn value(&self, index: u16, subindex: u8) -> Option<ObjectValue> {
        use ObjectValue::{Bit, Text, U8, U16, U32};
        let Self { revision, counter: Counter { settings, .. }, diagnosis, inputs, outputs, .. } = self;
        let on_clock = self.sync_mode == SyncMode::DistributedClock;
        let has_frequency = revision.measures_frequency();
        Some(match (index, subindex) {
            (0x1000, 0) => U32(DEVICE_TYPE),
            (0x1008, 0) => Text(NAME),
            (0x1009, 0) => Text(HARDWARE),
            (0x100a, 0) => Text(revision.firmware()),
            (0x1011, 0) => U8(1),
            (0x1011, 1) => U32(0),
            (0x1018, 0) => U8(4),
            (0x1018, 1) => U32(VENDOR),
            (0x1018, 2) => U32(PRODUCT),
            (0x1018, 3) => U32(revision.number()),
            (0x1018, 4) => U32(0),
            (mapping::RX_PDO, _) => return mapped(&mapping::rx_entries(), subindex),
            (mapping::TX_PDO, _) => return mapped(&mapping::tx_entries(*revision), subindex),
            (0x1a01 | 0x1a02, _) if has_frequency => {
                let object = if index == 0x1a01 { (0x6000, 0x1b) } else { (0x6000, 0x13) };
                return mapped(&[PdoEntry { object, bits: 32 }], subindex);
            }
            // In old revisions, this object contains state and toggle of the inputs.
            (0x1800, 0) => U8(9),
            (0x1800, 0x07) => Bit(inputs.invalid()),
            (0x1800, 0x09) => Bit(inputs.toggle),
            // Use of each sync manager: mailbox out, mailbox in, outputs, inputs. The next objects assign the
            // PDOs of outputs and inputs.
            (0x1c00, 0) => U8(4),
            (0x1c00, 1..=4) => U8(subindex),
            (0x1c12 | 0x1c13, 0) => U8(1),
            (0x1c12, 1) => U16(mapping::RX_PDO),
            (0x1c13, 1) => U16(mapping::TX_PDO),
            (0x1c32 | 0x1c33, 0) => U8(0x20),
            (0x1c32, 0x01) => U16(if on_clock { BY_SYNC1 } else { BY_OUTPUTS }),
            (0x1c33, 0x01) => U16(if on_clock { BY_SYNC0 } else { WITH_OUTPUTS }),
            (0x1c32 | 0x1c33, 0x04) => U16(SUPPORTED_SYNC_TYPES),
            (0x1c32 | 0x1c33, 0x05) => U32(MINIMUM_CYCLE_NS),
            (0x1c32 | 0x1c33, 0x0b) => U16(diagnosis.sync_missed),
            (0x1c32 | 0x1c33, 0x20) => Bit(diagnosis.sync_error),
            (0x1c32 | 0x1c33, 0x02 | 0x03 | 0x06 | 0x09) => U32(0),
            (0x1c32 | 0x1c33, 0x07 | 0x08 | 0x0c | 0x0d) => U16(0),
            (0x6000, 0) => U8(0x12),
            (0x6000, 0x01) => Bit(inputs.latch_valid),
            (0x6000, 0x03) => Bit(inputs.set_done),
            (0x6000, 0x0b) => Bit(inputs.level_c),
            (0x6000, 0x0e) => Bit(inputs.sync_error),
            (0x6000, 0x0f) => Bit(inputs.invalid()),
            (0x6000, 0x10) => Bit(inputs.toggle),
            (0x6000, 0x11) => U32(inputs.counter),
            (0x6000, 0x12) => U32(inputs.latch),
            (0x6001, 0) => U8(5),
            (0x6001, 0x04) => Bit(inputs.frequency_error),
            (0x6001, 0x05) => Bit(inputs.amplitude_error),
            (0x7000, 0) => U8(0x11),
            (0x7000, 0x01) => Bit(outputs.enable_latch),
            (0x7000, 0x03) => Bit(outputs.set_counter),
            (0x7000, 0x11) => U32(outputs.set_value),
            (0x8000, 0) => U8(if has_frequency { 0x1f } else { 0x0e }),
            (0x8000, 0x01) => Bit(settings.reset_on_c),
            (0x8000, 0x0e) => Bit(settings.reversed),
            (0x8000, 0x0f) if has_frequency => Bit(settings.window_in_ms),
            (0x8000, 0x11) if has_frequency => U16(settings.window),
            (0x8000, 0x1d) if has_frequency => U32(settings.numerator),
            (0x8000, 0x1e) if has_frequency => U32(settings.denominator),
            (0x8000, 0x1f) if has_frequency => U16(settings.filter),
            (0x8001, 0) => U8(0x11),
            (0x8001, 0x01) => Bit(settings.frequency_error),
            (0x8001, 0x02) => Bit(settings.amplitude_error),
            (0x8001, 0x11) => U8(settings.bits),
            (0xa000, 0) => U8(0x12),
            (0xa000, 0x11) => U16(diagnosis.frequency_errors),
            (0xa000, 0x12) => U16(diagnosis.amplitude_errors),
            _ => return None,
        })
    }

    /// The value of an object, or the abort code if it does not exist.
    fn value_or_abort(&self, index: u16, subindex: u8) -> Result<ObjectValue, Abort> {
        let is_object = || self.list(ObjectList::All).contains(&index);
        let missing = || if is_object() { Abort::NoSubindex } else { Abort::NoObject };
        self.value(index, subindex).ok_or_else(missing)
    }

    fn change_setting(&mut self, index: u16, subindex: u8, value: u32) -> Result<(), Abort> {
        let settings = &mut self.counter.settings;
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
        self.counter.settings = CounterSettings::default();
        Ok(())
    }
}

impl ObjectDictionary for El5021 {
    fn upload(&self, index: u16, subindex: u8, target: &mut [u8]) -> Result<usize, Abort> {
        self.value_or_abort(index, subindex)?.write(target)
    }

    fn download(&mut self, index: u16, subindex: u8, bytes: &[u8]) -> Result<(), Abort> {
        // The length of the new value must equal the length of the present value.
        let present = self.value_or_abort(index, subindex)?;
        let mut value = [0; 4];
        if !matches!((index, subindex), (0x1011, 1) | (0x8000 | 0x8001, 1..)) {
            return Err(Abort::ReadOnly);
        }
        if present.write(&mut value)? != bytes.len() {
            return Err(Abort::WrongLength);
        }
        value[..bytes.len()].copy_from_slice(bytes);
        let value = u32::from_le_bytes(value);
        if matches!(present, ObjectValue::Bit(_)) && value > 1 {
            return Err(Abort::ValueRange);
        }
        if index == 0x1011 { self.restore(value) } else { self.change_setting(index, subindex, value) }
    }

    fn list(&self, list: ObjectList) -> Vec<u16> {
        let has_frequency = self.revision.measures_frequency();
        let is_present = |index: &u16| has_frequency || !FREQUENCY_PDOS.contains(index);
        match list {
            ObjectList::All => OBJECTS.into_iter().filter(is_present).collect(),
            ObjectList::RxMappable => vec![0x7000],
            ObjectList::TxMappable => vec![0x6000, 0x6001],
            ObjectList::Stored | ObjectList::Startup => vec![0x8000, 0x8001],
        }
    }
}
