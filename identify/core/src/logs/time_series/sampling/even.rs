//! Recognises stamps that are already those of a regular clock: all their distances are whole multiples of the median distance.

use super::Stamps;
use crate::statistics::{median, rms};

/// Stamps that scatter by less than this are not corrected \[s\]. In this time the fastest joint of a calibration turns by 5
/// urad, which is less than the resolution of any of its encoders.
pub(super) const EVEN_S: f64 = 5e-6;

/// Stamps whose distances are all whole multiples of the median distance.
pub(super) struct EvenStamps {
    pub(super) stamps: Stamps,
    /// Distance from each row to the next, as a multiple of the median distance.
    pub(super) periods: Vec<f64>,
}

/// Compares the stamps with a regular clock. `None` if a stamp deviates from that clock by more than [`EVEN_S`].
pub(super) fn already_even(t_s: &[f64]) -> Option<EvenStamps> {
    let mut steps_s: Vec<f64> = t_s.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let usual_s = median(&mut steps_s)?;
    let pairs = t_s.windows(2).map(|pair| pair[1] - pair[0]);
    let periods: Vec<f64> = pairs.clone().map(|step_s| (step_s / usual_s).round()).collect();
    // The allocation of `steps_s` is used again, because logs have millions of rows.
    let mut off_s = steps_s;
    off_s.clear();
    off_s.extend(pairs.zip(&periods).map(|(step_s, periods)| (step_s - periods * usual_s).abs()));
    let is_even = periods.iter().all(|periods| *periods >= 1.0) && off_s.iter().all(|off_s| *off_s <= EVEN_S);
    let missing = periods.iter().map(|periods| periods - 1.0).sum::<f64>();
    // If more than half of the periods have no row, the median distance is not the period of a clock.
    (is_even && missing < periods.len() as f64).then(|| {
        let jitter_max_s = off_s.iter().copied().fold(0.0, f64::max);
        let (jitter_s, missing) = (rms(&off_s), missing as usize);
        let stamps = Stamps { period_s: usual_s, jitter_s, jitter_max_s, missing, ..Stamps::default() };
        EvenStamps { stamps, periods }
    })
}
