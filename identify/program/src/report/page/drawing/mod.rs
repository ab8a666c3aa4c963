//! Figures of the pages, as SVG text.

pub(in crate::report::page) mod arm;
pub(in crate::report::page) mod correlations;
pub(in crate::report::page) mod figures;
pub(crate) mod plot;
pub(in crate::report::page) mod thin;
pub(in crate::report::page) mod workspace;
