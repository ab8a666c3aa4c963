//! Tests of `ballbard` as a process in real time. They are separate from the tests that only compute.

mod support;

mod disk;
mod kill;
mod no_allocation;
mod service;
mod veth;
