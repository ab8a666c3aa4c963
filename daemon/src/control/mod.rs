//! The acquisition service: keeps the bus in operation, records runs, homes the encoders, and answers clients.
//!
//! The module [`machine`] decides which state follows from an event. [`controller`] executes the decisions and publishes the
//! [`status`]. [`service`] is the interface for other threads of this process, and [`api`] is the interface over HTTP.
//! [`live`] computes the content of the web page ten times a second. [`recordings`] manages the finished runs.

pub mod api;
pub(crate) mod controller;
pub mod live;
pub mod live_tap;
mod machine;
pub mod recordings;
pub mod service;
mod settings;
pub mod status;
