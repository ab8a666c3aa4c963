//! What samples say of parameters: normal equations by fold, which parameters they determine and how well, and what changes.

pub(in crate::solver) mod change_point;
pub(in crate::solver) mod covariance;
pub(in crate::solver) mod identifiability;
pub(in crate::solver) mod influence;
pub(in crate::solver) mod normals;
pub(in crate::solver) mod null_space;
pub(in crate::solver) mod observability;
pub(in crate::solver) mod scaled_cholesky;
