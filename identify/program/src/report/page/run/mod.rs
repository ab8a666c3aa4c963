//! Sections about runs: input files, readings and preparation, residuals over time, and deviation from the sphere.

pub(in crate::report::page) mod inputs;
pub(in crate::report::page) mod preparation;
pub(in crate::report::page) mod readings;
pub(in crate::report::page) mod runs;
pub(in crate::report::page) mod sphere;
