//! The recorder in virtual time, on disks that are slow, hang, become full, refuse calls or disappear. Data that were
//! reported as safe are never lost. Reports are true. The run either continues or ends as it reports.
#![allow(clippy::unwrap_used, clippy::panic, reason = "tests")]

mod calls;
mod rig;
mod slow;
