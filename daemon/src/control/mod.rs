//! The acquisition service: keeps the bus in operation, starts and stops runs, homes the encoders, answers people.
//!
//! [`machine`] decides and does nothing; `controller` does and decides nothing, with `bus_link`, `homing` and
//! `tending`, which waits for the disk in its stead; `view` says
//! what people see of it; [`service`] is the way to it from other threads, [`api`] the one over HTTP,
//! whose `connections` are bounded in number and time.

pub mod api;
mod bus_link;
mod connections;
mod controller;
pub mod homing;
pub mod machine;
pub mod preflight;
pub mod runs;
pub mod service;
pub mod status;
mod tending;
mod view;
