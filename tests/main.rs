//! All system tests. They are in one program, which is linked only once and runs long tests in parallel.
//!
//! To run the tests of one file: `cargo test -p system-tests --test all replay`.

mod acquire;
mod acquire_then_identify;
mod arms;
mod corpus;
mod documents;
mod forces;
mod readers;
mod reference;
mod replay;
mod robot_logs;
mod words;
