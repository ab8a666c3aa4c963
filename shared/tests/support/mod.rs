//! Shared by the tests: a run, and a disk that fails.

pub mod disk;
pub mod run;
