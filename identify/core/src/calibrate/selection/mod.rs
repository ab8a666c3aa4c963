//! Selection of the free parameters: link parameters that the poses determine, and error terms that improve the
//! prediction of left-out data.

pub(in crate::calibrate) mod candidates;
pub(in crate::calibrate) mod choose;
pub(in crate::calibrate) mod line_spectrum;
pub(crate) mod links;
pub mod structure;
pub mod terms;
