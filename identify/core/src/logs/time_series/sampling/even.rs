//! Stamps that are those of a regular clock as they are.

use super::Stamps;
use crate::statistics::{median, rms};

/// Stamps that scatter by less than this are taken as they are \[s\]: the fastest joint of a calibration turns by 5 urad in it,
/// less than any encoder of it resolves.
pub(super) const EVEN_S: f64 = 5e-6;

/// Stamps whose distances are all whole multiples of the usual one.
pub(super) struct EvenStamps {
    pub(super) stamps: Stamps,
    /// These multiples, from each row to the next.
    pub(super) periods: Vec<f64>,
}

/// The stamps, if they are those of a regular clock as they are.
pub(super) fn already_even(t_s: &[f64]) -> Option<EvenStamps> {
    let mut steps_s: Vec<f64> = t_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let usual_s = median(&mut steps_s)?;
    let pairs = t_s.windows(2).map(|pair| pair[1] - pair[0]);
    let periods: Vec<f64> = pairs.clone().map(|step_s| (step_s / usual_s).round()).collect();
    // The memory is used again: logs have millions of rows.
    let mut off_s = steps_s;
    off_s.clear();
    off_s.extend(pairs.zip(&periods).map(|(step_s, periods)| (step_s - periods * usual_s).abs()));
    let is_even = periods.iter().all(|periods| *periods >= 1.0) && off_s.iter().all(|off_s| *off_s <= EVEN_S);
    let missing = periods.iter().map(|periods| periods - 1.0).sum::<f64>();
    // If most periods have no row, the usual distance is not the period of a clock.
    (is_even && missing < periods.len() as f64).then(|| {
        let jitter_max_s = off_s.iter().copied().fold(0.0, f64::max);
        let (jitter_s, missing) = (rms(&off_s), missing as usize);
        let stamps = Stamps { period_s: usual_s, jitter_s, jitter_max_s, missing, ..Stamps::default() };
        EvenStamps { stamps, periods }
    })
}
