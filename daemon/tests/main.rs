//! Tests of `ballbard` that do not depend on how fast this machine is, in one program: one link, and long tests side by side.
//!
//! One file of them: `cargo test -p ballbard --test all time_stamps`. Those in real time are in `real_time.rs`.

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
mod time_stamps;
mod tuning;
