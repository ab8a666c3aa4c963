//! The daemon and the simulated segment over raw sockets, on a veth pair in a network namespace. Each test creates a
//! namespace and removes it at the end. This needs root and iproute2.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

mod namespace;
mod peers;
mod record;
mod smoke;
