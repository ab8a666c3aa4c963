//! Compares the stamps of a log with the regular clock by which its rows were sampled, and reports the differences as remarks.

/// Differences between the stamps of a log and the regular clock by which its rows were sampled.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Stamps {
    /// Whether the times of the rows are those of the clock instead of the stamps.
    pub evened: bool,
    /// Period of the clock \[s\].
    pub period_s: f64,
    /// Root mean square difference between the stamps and the clock \[s\].
    pub jitter_s: f64,
    /// Largest difference between a stamp and the clock \[s\].
    pub jitter_max_s: f64,
    /// Grid to which the stamps are rounded \[s\]. `None` without a grid, or if the stamps deviate from the clock by less
    /// than a tenth of the grid.
    pub rounded_to_s: Option<f64>,
    /// Number of rows with the same stamp as the row before.
    pub equal: usize,
    /// Number of periods of the clock without a row.
    pub missing: usize,
    /// Steps of the stamps that the motion shows to be steps of their clock.
    pub steps: Vec<StampStep>,
}

/// A step of the stamps during which the joints continue to move at constant speed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StampStep {
    /// Stamp of the first row after the step, relative to the first stamp of the log \[s\].
    pub at_s: f64,
    /// Size of the step \[s\]; positive if later rows have stamps that are too late.
    pub by_s: f64,
}

/// Smallest scatter that is reported \[s\]. In this time the fastest joint of a calibration turns by 50 urad.
const SCATTER_S: f64 = 5e-5;

impl Stamps {
    /// Remarks, as sentences, on how the stamps differ from the clock. Empty if the times of the rows are their stamps.
    pub(in crate::logs) fn remarks(&self) -> Vec<String> {
        let Self { evened, jitter_s, rounded_to_s, equal, missing, steps, .. } = self;
        if !evened {
            return Vec::new();
        }
        let mut how = Vec::new();
        match rounded_to_s {
            Some(step_s) => how.push(format!("the stamps are rounded to {:.1} ms", step_s * 1e3)),
            None if *jitter_s > SCATTER_S => {
                how.push(format!("the stamps scatter by {:.2} ms", jitter_s * 1e3))
            }
            None => {}
        }
        for (count, what) in [(equal, "rows have the stamp of the one before"), (missing, "rows are missing")]
        {
            if *count > 0 {
                how.push(format!("{count} {what}"));
            }
        }
        let rows = (!how.is_empty()).then(|| {
            let how = how.join(", ");
            format!("{how}: the times of the regular clock behind the stamps are used instead; log the sampling time itself if possible")
        });
        let steps = steps.iter().map(|StampStep { at_s, by_s }| {
            format!(
                "the stamps step by {:+.2} ms at {at_s:.2} s although the motion continues evenly: later rows have times \
                 without it; find out what sets the clock",
                by_s * 1e3
            )
        });
        rows.into_iter().chain(steps).collect()
    }
}
