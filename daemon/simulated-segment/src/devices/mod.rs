//! The devices: the coupler and the encoder terminal.

mod ek1100;
mod el5021;

pub use ek1100::Ek1100;
pub use el5021::{El5021, Revision};

const VENDOR: u32 = 0x0000_0002;
