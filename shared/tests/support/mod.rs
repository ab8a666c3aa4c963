//! Helpers of the tests: a generated run, and a disk that fails.

pub mod disk;
pub mod run;
