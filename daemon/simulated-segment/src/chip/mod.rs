//! An EtherCAT slave controller (ESC): registers, sync managers, FMMUs, state machine, distributed clock, EEPROM
//! interface and mailbox, according to ETG.1000.4 and ETG.1000.6. Its interface to frames is single reads and writes, and
//! its interface to devices a process image.

pub mod al;
pub mod coe;
pub mod command;
pub mod dc;
pub mod eeprom;
mod esc;
mod fmmu;
mod registers;
pub mod sii;
mod sync_manager;

pub use esc::{ChipProfile, Esc, SyncEvent, SyncMode};
pub use sync_manager::ExpectedSyncManager;
