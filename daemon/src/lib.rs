//! Acquisition daemon for a sensed double ball-bar on EtherCAT.

pub mod segment;
