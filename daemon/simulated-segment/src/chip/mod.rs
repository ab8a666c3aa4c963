//! An EtherCAT slave controller (ESC), according to ETG.1000.4 and ETG.1000.6: registers, sync managers (access to process
//! memory), FMMUs (fieldbus memory management units: logical to process memory), state machine of the application layer (AL),
//! distributed clock, EEPROM interface (SII) and mailbox (CoE). Frames read and write its memory (`command`); the device behind
//! it has a process image.

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
