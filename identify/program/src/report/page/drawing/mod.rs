//! Figures of the page as SVG text, by concept.

pub(in crate::report::page) mod arm;
pub(in crate::report::page) mod correlations;
pub(in crate::report::page) mod figures;
pub(crate) mod plot;
pub(in crate::report::page) mod thin;
pub(in crate::report::page) mod workspace;
