//! The daemon and its segment over raw sockets: a veth pair in a network namespace. Needs root and iproute2; each test
//! creates its namespace and removes it.
#![allow(clippy::unwrap_used, clippy::expect_used, reason = "tests")]

mod namespace;
mod peers;
mod record;
mod smoke;
