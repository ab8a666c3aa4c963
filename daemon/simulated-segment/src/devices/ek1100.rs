//! EK1100, the coupler. It has no process data, no mailbox and no processor. The contents of its registers and of its EEPROM
//! were read from a real device.

use super::VENDOR;
use crate::chip::ChipProfile;
use crate::chip::eeprom::{General, Image, SiiHeader};
use crate::node::Device;

const PRODUCT: u32 = 0x044c_2c52;
const REVISION: u32 = 0x0012_0000;
/// Registers 0x0000 to 0x0009: chip type, its revision and build, 8 FMMUs, 8 sync managers, 8 kB, four ports, features
/// 0x00FC. These features mean a 64-bit distributed clock that can be the reference clock, and no SYNC signals.
const INFORMATION: [u8; 10] = [0x11, 0x00, 0x02, 0x00, 8, 8, 8, 0x0f, 0xfc, 0x00];
/// Configuration words. The chip has no processor, so device emulation is switched on, and so is the distributed clock. Both
/// are in the second byte of the first word.
const CONFIGURATION: [u16; 4] = [0x0d00, 0x0000, 0x0000, 0x0000];
const GENERAL: General = General { coe_details: 0, e_bus_current_ma: -2000, ports: 0x0131 };

pub struct Ek1100;

impl Device for Ek1100 {
    fn chip(&self) -> ChipProfile {
        let header = SiiHeader {
            configuration: CONFIGURATION,
            vendor: VENDOR,
            product: PRODUCT,
            revision: REVISION,
            mailbox: [0; 5],
        };
        let names = ["EK1100", "EK1100 EtherCAT-Koppler (2A E-Bus)", "SystemBk"];
        ChipProfile {
            information: INFORMATION,
            eeprom: Image::new(&header, names, &GENERAL).finish(),
            eight_byte_reads: false,
            sync_managers: None,
            data_ready_ns: 0,
        }
    }
}
