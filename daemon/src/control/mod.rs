//! The acquisition service: keeps the bus in operation, starts and stops runs, homes the encoders, answers people.
//!
//! [`machine`] decides and does nothing; [`controller`] does and decides nothing, and makes the [`status`]; [`service`] is the
//! way to it from other threads, [`api`] the one over HTTP. [`live`] is what a page shows ten times a second, [`recordings`] is
//! what becomes of runs.

pub mod api;
pub mod controller;
pub mod live;
pub mod live_tap;
pub mod machine;
pub mod recordings;
pub mod service;
mod settings;
pub mod status;
