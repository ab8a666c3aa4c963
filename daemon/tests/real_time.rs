//! Tests of `ballbard` as a process that keeps pace with the clock of this machine: apart from the others, which compute.

mod support;

mod disk;
mod kill;
mod no_allocation;
mod service;
mod veth;
