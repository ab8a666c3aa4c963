//! The course of what was logged: the regular clock behind stamps, turns made continuous, values between stamps.

pub(super) mod interpolation;
pub(super) mod sampling;
pub(super) mod spline;
pub(super) mod unwrapped;
