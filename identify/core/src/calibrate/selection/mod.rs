//! What is free: links that poses determine, and terms that predict what they were not fitted to.

pub(in crate::calibrate) mod line_spectrum;
pub(crate) mod links;
pub mod structure;
pub mod terms;
