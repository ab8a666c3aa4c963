//! The acquisition service: keeps the bus in operation, starts and stops runs, homes the encoders, answers people.
//!
//! [`machine`] decides and does nothing; `controller` does and decides nothing, with `bus_link`, `homing` and
//! `tending`, which waits for the disk in its stead; `view` says
//! what people see of it; [`service`] is the way to it from other threads, [`api`] the one over HTTP,
//! whose `connections` are bounded in number and time. [`live`] is what a page shows ten times a second, [`verdict`] grades
//! runs, [`bin`] keeps deleted recordings.

pub mod api;
pub mod bin;
mod bus_link;
mod controller;
pub mod homing;
pub mod live;
pub mod live_tap;
pub mod machine;
mod marks;
pub(crate) mod note;
pub mod preflight;
mod problem_log;
pub mod runs;
pub mod service;
mod settings;
pub mod status;
pub mod table;
mod tending;
pub mod verdict;
mod view;
