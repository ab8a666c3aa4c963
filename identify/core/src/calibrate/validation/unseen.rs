//! Predicts the rows at each part of an instrument, such as a socket, with a fit to all other rows. This validates the
//! calibration at places without any fitted row. It requires that the position of the part follows from the other parts and
//! their known geometry, as for the sockets of a plate.

use crate::calibrate::Calibration;
use crate::calibrate::pipeline::{Solved, problem};
use crate::calibrate::rows::PoseFigures;
use crate::instrument::{Run, Section, without};
use crate::model::Model;
use crate::solver::{LeastSquares, Normals, Options};

/// Result for the rows at one part of an instrument. A fit to all other data predicts these rows.
#[derive(Debug, Clone, PartialEq)]
pub struct UnseenPart {
    /// Index of the data set, from 0.
    pub data_set: usize,
    /// Name of the part.
    pub name: String,
    /// Errors of the prediction from all other data.
    pub predicted: PoseFigures,
    /// Errors of the calibration, whose fit includes these rows.
    pub fitted: PoseFigures,
}

/// The rows in use at one part of an instrument. They are left out together.
struct LeftOutRows {
    data_set: usize,
    name: String,
    /// Numbers of the rows in their file.
    rows: Vec<usize>,
    /// Indices of the same rows among the samples of all data sets.
    samples: Vec<usize>,
}

/// Rows at each part of one data set. `first` is the index of the data set's first sample
/// among the samples of all data sets.
fn parts((data_set, run): (usize, &Run), first: usize) -> Vec<LeftOutRows> {
    let sections = run.instrument.sections();
    let mut all: Vec<usize> = sections.iter().flat_map(|section| section.samples.iter().copied()).collect();
    all.sort_unstable();
    let used = without(&all, run.instrument.rejected());
    let part = |section: Section| {
        let places =
            section.samples.iter().filter_map(|row| Some((*row, first + used.binary_search(row).ok()?)));
        let (rows, samples) = places.unzip();
        LeftOutRows { data_set, name: section.name, rows, samples }
    };
    sections.into_iter().map(part).collect()
}

/// Predicts the rows at each part of each instrument. The prediction is one step from the calibration, on the normal
/// equations of all other data. Parts that the other data do not determine are omitted.
pub fn unseen_parts(calibration: &Calibration) -> Vec<UnseenPart> {
    let Calibration { runs, solved: Solved { columns, solution, sigmas, .. }, .. } = calibration;
    if runs.iter().all(|run| run.instrument.sections().is_empty()) {
        return Vec::new();
    }
    let Ok(problem) = problem(runs, columns, sigmas) else { return Vec::new() };
    // The samples of each part are a fold.
    let parts: Vec<LeftOutRows> =
        runs.iter().enumerate().zip(problem.starts()).flat_map(|(run, first)| parts(run, *first)).collect();
    let mut folds: Vec<Vec<usize>> = parts.iter().map(|part| part.samples.clone()).collect();
    // Samples that belong to no part are in an additional fold, which is included in each prediction.
    let mut is_rest: Vec<bool> = (0..problem.samples()).map(|sample| !problem.is_known(sample)).collect();
    folds.iter().flatten().for_each(|sample| is_rest[*sample] = false);
    folds.push((0..is_rest.len()).filter(|sample| is_rest[*sample]).collect());
    let options = Options { loss: solution.loss, ..Options::default() };
    let Ok(normals) = Normals::new(&problem, &solution.x, &options, &folds) else { return Vec::new() };
    // Compare the errors of the rows at a part between the model without these rows and the calibration.
    let predicted = |(part, x): (LeftOutRows, Option<Vec<f64>>)| {
        let Run { instrument, model } = &runs[part.data_set];
        let mut without_part = model.clone();
        without_part.adopt(&columns.values(part.data_set, &x?));
        let figures = |model: &Model| {
            let errors = instrument.errors(&model.geometry(&[]));
            PoseFigures::from_errors(part.rows.iter().filter_map(|row| errors.get(*row).copied()))
        };
        Some(UnseenPart {
            data_set: part.data_set,
            predicted: figures(&without_part),
            fitted: figures(model),
            name: part.name,
        })
    };
    parts.into_iter().zip(normals.without_each()).filter_map(predicted).collect()
}
