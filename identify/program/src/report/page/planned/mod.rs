//! Pages of what was planned: a path, or poses, with arm and bar in three dimensions.

pub(in crate::report::page) mod path;
pub(in crate::report::page) mod path_view;
pub(in crate::report::page) mod poses;
