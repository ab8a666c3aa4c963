//! `identify study`: simulated experiments by the thousand, and what each estimator makes of them.
//!
//! A `file` says which errors are varied in which figure and who estimates. It is one flat, numbered list of [`Trial`]s: each
//! spoils a path in one way (`conditions`, `reference`), asks every estimator of its figure, and is a line of `results`, which
//! only grows. So a study that was killed goes on where it was, machines share it by numbers, and what they find is put
//! together by writing it one after the other. `summary` is what is seen in all of it; nothing in it depends on the order.

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
    Choice, Estimator, Figure, Kind, Measure, PathChoice, Series, Statement, StudyFile, StudyInstrument,
    UnknownFigure,
};
pub use reference::{Driven, Reference, ReferenceError};
pub use results::{Results, ResultsError, Row, Share, TrialRows, merge};
pub use summary::{Curve, CurvePoint, FigureTable, Finding, Reach, Spread, Summary, short};
pub use table::{write_csv, write_parquet};
pub use trial::{Trial, prepared, run, trials};
