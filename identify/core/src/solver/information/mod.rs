//! Information of samples about parameters: normal equations of folds, identifiability, covariance, and changes during a run.

pub(in crate::solver) mod change_point;
pub(in crate::solver) mod covariance;
pub(in crate::solver) mod identifiability;
pub(in crate::solver) mod influence;
pub(in crate::solver) mod normals;
pub(in crate::solver) mod null_space;
pub(in crate::solver) mod observability;
pub(in crate::solver) mod scaled_cholesky;
