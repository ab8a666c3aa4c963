//! Tests of `ballbard` that do not depend on the speed of the machine. All of them are in one program, which is linked only
//! once and runs long tests in parallel.
//!
//! To run the tests of one file: `cargo test -p ballbard --test all time_stamps`. Tests that depend on
//! real time are in `real_time.rs`.

mod support;

mod bus;
mod command_line;
mod day;
mod faults;
mod homing;
mod record;
mod recorder;
mod segment;
mod smoke;
mod table;
mod time_stamps;
mod tuning;
