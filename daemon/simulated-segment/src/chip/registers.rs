//! Register map of a slave controller (ETG.1000.4 section 6, Beckhoff ESC data sheet section II).

use std::ops::Range;

/// Size of the memory: 4 KiB of registers and 4 KiB of process memory.
pub const MEMORY_SIZE: usize = 0x2000;
/// First address of process memory.
pub const PROCESS_MEMORY: u16 = 0x1000;

pub const INFORMATION: u16 = 0x0000;
pub const STATION_ADDRESS: u16 = 0x0010;
pub const STATION_ALIAS: u16 = 0x0012;
pub const DL_STATUS: u16 = 0x0110;
pub const AL_CONTROL: u16 = 0x0120;
pub const AL_STATUS: u16 = 0x0130;
pub const AL_STATUS_CODE: u16 = 0x0134;
pub const ERROR_COUNTERS: u16 = 0x0300;
pub const LOST_LINKS: u16 = 0x0310;
pub const WATCHDOG_DIVIDER: u16 = 0x0400;
pub const WATCHDOG_TIME_PDI: u16 = 0x0410;
pub const WATCHDOG_TIME_PROCESS_DATA: u16 = 0x0420;
pub const WATCHDOG_STATUS: u16 = 0x0440;
pub const SII_ACCESS: u16 = 0x0500;
pub const SII_CONTROL: u16 = 0x0502;
pub const SII_END: u16 = 0x0510;
pub const FMMU: u16 = 0x0600;
pub const FMMU_LEN: u16 = 16;
pub const SYNC_MANAGER: u16 = 0x0800;
pub const SYNC_MANAGER_LEN: u16 = 8;
pub const DC_PORT_TIMES: u16 = 0x0900;
pub const DC_SYSTEM_TIME: u16 = 0x0910;
pub const DC_RECEIVE_TIME: u16 = 0x0918;
pub const DC_OFFSET: u16 = 0x0920;
pub const DC_DELAY: u16 = 0x0928;
pub const DC_DIFFERENCE: u16 = 0x092c;
pub const DC_SPEED_START: u16 = 0x0930;
pub const DC_FILTER_DEPTH: u16 = 0x0934;
pub const DC_ACTIVATION: u16 = 0x0980;
pub const DC_START_TIME: u16 = 0x0990;
pub const DC_SYNC0_CYCLE: u16 = 0x09a0;
pub const DC_SYNC1_CYCLE: u16 = 0x09a4;

/// Registers that a master may write, in addition to those of FMMUs and sync managers.
const WRITABLE: [Range<u16>; 19] = [
    0x0010..0x0012, // station address
    0x0020..0x0022, // register write enable and protection
    0x0030..0x0032, // ESC write enable and protection
    0x0040..0x0042, // reset
    0x0100..0x0104, // DL control
    0x0120..0x0122, // AL control
    0x0200..0x0202, // event mask
    0x0300..0x0314, // error counters: cleared
    0x0400..0x0402, // watchdog divider
    0x0410..0x0412, // watchdog time of the PDI
    0x0420..0x0422, // watchdog time of process data
    0x0442..0x0444, // watchdog counters: cleared
    0x0500..0x0510, // EEPROM interface
    0x0900..0x0904, // latch of the port times
    0x0910..0x0918, // system time: control loop
    0x0920..0x092c, // offset and delay
    0x0930..0x0936, // control loop parameters
    0x0980..0x0982, // activation of SYNC0 and SYNC1
    0x0990..0x09a8, // start and cycle times
];

/// Whether a master may write the register at `address`. Registers of FMMUs and sync managers are not in this list.
pub fn is_writable(address: u16) -> bool {
    WRITABLE.iter().any(|range| range.contains(&address))
}

/// Whether an access to `len` bytes at `address` includes any of the `size` bytes at `register`.
pub fn touches(address: u16, len: usize, register: u16, size: usize) -> bool {
    let (start, from) = (usize::from(address), usize::from(register));
    start < from + size && from < start + len
}
