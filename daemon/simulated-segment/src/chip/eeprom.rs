//! Builds the content of a device's EEPROM, the slave information (SII, ETG.2010). The content consists of a header and of
//! categories. A category is a list of bytes with a type. From the EEPROM, the master reads identity, mailbox, sync managers
//! and process data objects (PDOs).

use super::sync_manager::ExpectedSyncManager;

/// Size of the EEPROM \[bytes\]: 16 kbit, as in real terminals.
const SIZE: usize = 2048;
/// Byte offset of the first category.
const CATEGORIES: usize = 0x80;
const CATEGORY_STRINGS: u16 = 10;
const CATEGORY_GENERAL: u16 = 30;
const CATEGORY_FMMU: u16 = 40;
const CATEGORY_SYNC_MANAGER: u16 = 41;
const CATEGORY_TX_PDO: u16 = 50;
const CATEGORY_RX_PDO: u16 = 51;
const CATEGORY_END: u16 = 0xffff;
const VERSION: u16 = 1;

/// The header: the first words of the EEPROM.
pub struct SiiHeader {
    /// PDI control and configuration words that the chip loads at power-up (words 0 to 3).
    pub configuration: [u16; 4],
    pub vendor: u32,
    pub product: u32,
    pub revision: u32,
    /// Words 0x18 to 0x1C: offset and size of mailbox out, offset and size of mailbox in, protocols.
    pub mailbox: [u16; 5],
}

/// Content of the category "general".
pub struct General {
    pub coe_details: u8,
    /// Current that the device takes from the E-bus \[mA\]. Negative for a device that supplies the E-bus.
    pub e_bus_current_ma: i16,
    /// Types of the four physical ports, four bits each: 1 is MII, 3 is E-bus.
    pub ports: u16,
}

/// One entry of a PDO: an object of the device, or a gap.
pub struct PdoEntry {
    /// Index and subindex of the object. Zero for a gap.
    pub object: (u16, u8),
    /// Length \[bits\].
    pub bits: u8,
}

/// EEPROM content under construction.
pub struct Image {
    bytes: Vec<u8>,
}

impl Image {
    /// Begins an EEPROM with a header and names. The names are: order code (string 1), long name
    /// (string 2), group (string 3).
    pub fn new(header: &SiiHeader, names: [&'static str; 3], general: &General) -> Self {
        let mut image = Self { bytes: vec![0; CATEGORIES] };
        image.header(header);
        image.category(CATEGORY_STRINGS, &strings(&names));
        image.category(CATEGORY_GENERAL, &general_bytes(general));
        image
    }

    fn header(&mut self, header: &SiiHeader) {
        for (index, word) in header.configuration.iter().enumerate() {
            self.put(index * 2, &word.to_le_bytes());
        }
        let checksum = checksum(&self.bytes[..14]);
        self.put(14, &[checksum, 0]);
        for (index, value) in [header.vendor, header.product, header.revision].iter().enumerate() {
            self.put(0x10 + 4 * index, &value.to_le_bytes());
        }
        for (index, word) in header.mailbox.iter().enumerate() {
            self.put(0x30 + 2 * index, &word.to_le_bytes());
        }
        let kilobits = (SIZE / 128 - 1) as u16;
        self.put(0x7c, &kilobits.to_le_bytes());
        self.put(0x7e, &VERSION.to_le_bytes());
    }

    /// Adds the use of each FMMU: 1 is outputs, 2 is inputs, 3 is the state of the mailbox.
    pub fn fmmus(mut self, uses: &[u8]) -> Self {
        self.category(CATEGORY_FMMU, uses);
        self
    }

    /// Adds the sync managers. Each has the fields start, length, control, status (0), enable (1) and type. The types are
    /// mailbox out (1), mailbox in (2), outputs (3) and inputs (4).
    pub fn sync_managers(mut self, channels: &[ExpectedSyncManager; 4]) -> Self {
        let mut content = Vec::new();
        for (channel, kind) in channels.iter().zip(1..) {
            content.extend(channel.start.to_le_bytes());
            content.extend(channel.length.to_le_bytes());
            content.extend([channel.control, 0, 1, kind]);
        }
        self.category(CATEGORY_SYNC_MANAGER, &content);
        self
    }

    /// Adds the PDO of the inputs and assigns it to a sync manager.
    pub fn tx_pdo(self, index: u16, sync_manager: u8, entries: &[PdoEntry]) -> Self {
        self.pdo(CATEGORY_TX_PDO, index, sync_manager, entries)
    }

    /// Adds the PDO of the outputs and assigns it to a sync manager.
    pub fn rx_pdo(self, index: u16, sync_manager: u8, entries: &[PdoEntry]) -> Self {
        self.pdo(CATEGORY_RX_PDO, index, sync_manager, entries)
    }

    fn pdo(mut self, category: u16, index: u16, sync_manager: u8, entries: &[PdoEntry]) -> Self {
        let mut content = index.to_le_bytes().to_vec();
        // Fields: number of entries, sync manager, distributed clock (none), name (none), flags (fixed content, mandatory).
        content.extend([entries.len() as u8, sync_manager, 0, 0, 0x11, 0]);
        for entry in entries {
            content.extend(entry.object.0.to_le_bytes());
            content.extend([entry.object.1, 0, data_type(entry.bits), entry.bits, 0, 0]);
        }
        self.category(category, &content);
        self
    }

    /// Ends the list of categories. The remaining bits are ones, as in an erased memory.
    pub fn finish(mut self) -> Vec<u8> {
        self.bytes.extend(CATEGORY_END.to_le_bytes());
        self.bytes.resize(SIZE, 0xff);
        self.bytes
    }

    fn put(&mut self, offset: usize, bytes: &[u8]) {
        self.bytes[offset..offset + bytes.len()].copy_from_slice(bytes);
    }

    fn category(&mut self, kind: u16, content: &[u8]) {
        let words = content.len().div_ceil(2) as u16;
        self.bytes.extend(kind.to_le_bytes());
        self.bytes.extend(words.to_le_bytes());
        self.bytes.extend(content);
        if content.len() % 2 == 1 {
            self.bytes.push(0);
        }
    }
}

fn strings(strings: &[&str]) -> Vec<u8> {
    let mut content = vec![strings.len() as u8];
    for string in strings {
        content.push(string.len() as u8);
        content.extend(string.as_bytes());
    }
    content
}

fn general_bytes(general: &General) -> [u8; 32] {
    let mut content = [0; 32];
    // Numbers of the strings that [`Image::new`] adds. The category has two fields for the group.
    let (group, order, name) = (3, 1, 2);
    [content[0], content[2], content[3], content[5]] = [group, order, name, general.coe_details];
    content[12..14].copy_from_slice(&general.e_bus_current_ma.to_le_bytes());
    content[14] = group;
    content[16..18].copy_from_slice(&general.ports.to_le_bytes());
    content
}

/// Code of the data type with this length (ETG.1020): bit, u16 or u32. The PDOs of the simulated
/// devices contain only these types.
fn data_type(bits: u8) -> u8 {
    match bits {
        1 => 0x01,
        16 => 0x06,
        32 => 0x07,
        _ => 0,
    }
}

/// CRC-8 over `bytes`, the first seven words of the EEPROM. Polynomial x^8 + x^2 + x + 1, initial value all ones.
fn checksum(bytes: &[u8]) -> u8 {
    bytes.iter().fold(0xff, |crc, byte| {
        (0..8).fold(crc ^ byte, |crc: u8, _| if crc & 0x80 == 0 { crc << 1 } else { crc << 1 ^ 0x07 })
    })
}
