//! Readings of both logs, made continuous.

pub(super) mod averaged;
pub(super) mod bar_angles;
pub(super) mod both_logs;
pub(super) mod standstill;
pub(super) mod unwrap;
