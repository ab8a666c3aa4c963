//! Sections of one run: its inputs, readings and preparation, and residuals over time.

pub(in crate::report::page) mod inputs;
pub(in crate::report::page) mod preparation;
pub(in crate::report::page) mod readings;
pub(in crate::report::page) mod runs;
pub(in crate::report::page) mod sphere;
