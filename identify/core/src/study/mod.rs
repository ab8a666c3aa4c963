//! `identify study`: thousands of simulated experiments, and the errors of each estimator.
//!
//! Stages:
//!
//! 1. The study's file (`file`) defines figures. Each figure has varied conditions, such as noise, and a list of estimators.
//! 2. `definition` loads this file with the robot, the bar and the path. The study is then a flat, numbered
//!    list of experiments ([`Trial`]).
//! 3. Each experiment adds errors (`conditions`) to a path (`reference`), and every estimator of the figure calibrates the
//!    robot from the simulated readings.
//! 4. The result of each experiment is appended as one line to a file (`results`). A study that was killed therefore
//!    continues where it stopped. Several machines can share a study: each runs some of the experiments, and the results
//!    are merged by number.
//! 5. `summary` computes curves, tables and answers from the results, and `table` exports them. Neither depends on the
//!    order of the lines.

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
