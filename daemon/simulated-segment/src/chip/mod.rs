//! An EtherCAT slave controller (ESC), according to ETG.1000.4 and ETG.1000.6. Its units:
//! - registers
//! - sync managers, which control the access to process memory
//! - FMMUs (fieldbus memory management units), which map logical addresses to process memory
//! - the state machine of the application layer (AL)
//! - the distributed clock
//! - the EEPROM interface, with the slave information (SII)
//! - the mailbox, with CANopen over EtherCAT (CoE)
//!
//! Frames read and write the memory of the chip (`command`). The device behind the chip also uses this memory: it reads
//! outputs and writes inputs there.

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
