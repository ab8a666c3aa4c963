//! The simulated segment, as a master observes it. ethercrab brings it into operation. Single frames check that it follows
//! the rules of EtherCAT.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

mod damage;
mod datagrams;
mod executor;
mod frames;
mod operation;
mod refusal;
mod replay;
mod terminal;
