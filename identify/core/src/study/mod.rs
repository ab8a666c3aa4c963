//! `identify study`: thousands of simulated experiments, and the errors of each estimator.
//!
//! A `file` defines the varied errors and the estimators of each figure. It is one flat, numbered list of [`Trial`]s: each adds errors
//! to a path (`conditions`, `reference`), solves with every estimator of its figure, and is a line of `results`, which are only
//! appended to. So a study that was killed continues where it stopped, machines share it by numbers, and their results are merged by
//! number. `summary` has curves, tables and answers; nothing in it depends on the order.

mod conditions;
mod definition;
mod file;
mod reference;
mod results;
mod summary;
mod table;
mod trial;

pub use conditions::{CONDITIONS, ConditionError, Conditions};
pub use definition::{Definition, LoadError, THESIS};
pub use file::{
    CurveChoice, Estimator, Figure, FigureKind, FigureSeries, Measure, PathChoice, Statement, StudyFile,
    StudyInstrument, UnknownFigure,
};
pub use reference::{Driven, Reference, ReferenceError};
pub use results::{ResultRow, Results, ResultsError, Shard, TrialRows, merge};
pub use summary::{
    CurvePoint, ErrorCurve, ErrorQuantiles, FigureTable, Reach, StatementAnswer, StudySummary, short,
};
pub use table::{write_csv, write_parquet};
pub use trial::{Trial, prepared, run, trials};
