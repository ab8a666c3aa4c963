//! The recorder on disks that are slow, hang, fill, refuse or vanish, on virtual time: what is reported as safe
//! is never lost, reports are true, and the run continues or ends as stated.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

mod calls;
mod rig;
mod slow;
