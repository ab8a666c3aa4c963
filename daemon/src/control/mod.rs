//! The acquisition service: keeps the bus in operation, starts and stops runs, answers people.
//!
//! [`machine`] decides and does nothing; [`service`] does and decides nothing; [`api`] carries requests over HTTP.

pub mod api;
pub mod machine;
pub mod preflight;
pub mod runs;
pub mod service;
pub mod status;
