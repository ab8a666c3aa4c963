//! The piece of EtherCAT that frames are sent into.

pub mod simulated;
