//! The acquisition service: keeps the bus in operation, records runs, homes the encoders, answers clients.
//!
//! [`machine`] decides, [`controller`] executes and makes the [`status`]; [`service`] is the interface for other threads,
//! [`api`] the one over HTTP. [`live`] makes the content of a page ten times a second; [`recordings`] manages finished
//! runs.

pub mod api;
pub(crate) mod controller;
pub mod live;
pub mod live_tap;
mod machine;
pub mod recordings;
pub mod service;
mod settings;
pub mod status;
