//! `residuals.csv`: difference between robot and measurement for each sample and row of a calibration, used or rejected.

use serde::Serialize;

use super::corrections::csv;
use super::file::FileError;
use crate::calibrate::Calibration;
use crate::instrument::{Apart, Deviation, Rejection};

/// One row of the file. A position difference is the position of the robot's end minus the measured position, along the
/// axes of the robot's base.
#[derive(Debug, Default, Serialize)]
struct ResidualRow {
    /// Number of the data set as in `calibration.toml`, from 1.
    data_set: usize,
    instrument: &'static str,
    /// Number of the sample in its data set, from 1.
    sample: usize,
    /// Line number in a file of rows.
    line: Option<u64>,
    /// Time since the reference time, on the instrument's clock \[s\]. Empty if the robot was at rest.
    t_s: Option<String>,
    used: bool,
    /// Reason why the sample was not used.
    left_out: Option<&'static str>,
    x_mm: Option<String>,
    y_mm: Option<String>,
    z_mm: Option<String>,
    /// Length from the robot's pose minus measured length, for an instrument that measures a length instead of a position.
    length_mm: Option<String>,
    rotation_mrad: Option<String>,
}

impl ResidualRow {
    fn measured(self, Deviation { apart, rotation_rad }: Deviation) -> Self {
        // Numbers have six decimals of mm and mrad. NaN becomes an empty cell.
        let thousandths = |value: f64| value.is_finite().then(|| format!("{:.6}", value * 1e3));
        let rotation_mrad = rotation_rad.and_then(thousandths);
        match apart {
            Apart::Place(offset_m) => {
                let [x_mm, y_mm, z_mm] = <[f64; 3]>::from(offset_m).map(thousandths);
                Self { x_mm, y_mm, z_mm, rotation_mrad, ..self }
            }
            Apart::Length(longer_m) => Self { length_mm: thousandths(longer_m), rotation_mrad, ..self },
        }
    }
}

const fn reason(why: Rejection) -> &'static str {
    match why {
        Rejection::FlangeContradicts { .. } => "flange contradicts joints",
        Rejection::GrossResidual { .. } => "far from all others",
        Rejection::FaultyRun { .. } => "deviates together with the rows around it",
    }
}

/// Text of `residuals.csv`. `lines` are the line numbers of each file of rows. A recording has one row for each sample of the
/// solve. The report page shows why the other cycles were not used.
///
/// # Errors
/// [`FileError::Csv`].
pub fn residuals_csv(calibration: &Calibration, lines: &[&[u64]]) -> Result<String, FileError> {
    let bar_runs = calibration.runs.len() - calibration.rows.len();
    let mut all = Vec::new();
    for (number, run) in calibration.runs.iter().enumerate() {
        // Runs with a bar come first, then files of rows.
        let row_file = number.checked_sub(bar_runs);
        let deviations = match row_file.and_then(|index| calibration.rows.get(index)) {
            Some(set) => set.deviations(run),
            None => {
                let of_bar = run.instrument.deviations(&run.model.geometry(&[]));
                of_bar.into_iter().map(|deviation| (deviation, None)).collect()
            }
        };
        let lines = row_file.and_then(|index| lines.get(index)).copied().unwrap_or_default();
        for (sample, (deviation, left_out)) in deviations.into_iter().enumerate() {
            let row = ResidualRow {
                data_set: number + 1,
                instrument: run.instrument.name(),
                sample: sample + 1,
                line: lines.get(sample).copied(),
                t_s: run.instrument.time_s(sample).map(|t_s| format!("{t_s:.6}")),
                used: left_out.is_none(),
                left_out: left_out.map(reason),
                ..ResidualRow::default()
            };
            all.push(row.measured(deviation));
        }
    }
    Ok(csv(&all)?)
}
