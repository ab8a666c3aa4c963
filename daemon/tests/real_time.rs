//! Tests of `ballbard` as a process in real time. Tests in virtual time are in the separate program `main.rs`.

mod support;

mod disk;
mod kill;
mod no_allocation;
mod service;
mod veth;
