//! The stamps of a log against the regular clock behind them, and the remarks on them.

/// The stamps of a log against the regular clock behind them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Stamps {
    /// Rows have the times of the clock, not their stamps.
    pub evened: bool,
    /// Period of the clock \[s\].
    pub period_s: f64,
    /// Root mean square of the differences of stamps and clock \[s\].
    pub jitter_s: f64,
    /// Largest of these differences \[s\].
    pub jitter_max_s: f64,
    /// Stamps are whole multiples of this \[s\], which is larger than their scatter; `None` if they are not rounded.
    pub rounded_to_s: Option<f64>,
    /// Number of rows with the stamp of the row before.
    pub equal: usize,
    /// Number of periods of the clock without a row.
    pub missing: usize,
    /// Steps of the stamps during an even motion.
    pub steps: Vec<StampStep>,
}

/// A step of the stamps that the motion does not share.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StampStep {
    /// Stamp of the first row after it, since the first of the log \[s\].
    pub at_s: f64,
    /// Delay of the stamps of later rows \[s\].
    pub by_s: f64,
}

/// Smallest scatter that is reported \[s\]: the fastest joint of a calibration turns by 50 urad in it.
const SCATTER_S: f64 = 5e-5;

impl Stamps {
    /// Remarks on rows that have the times of the clock, in sentences.
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
            format!("{how}: the times of the regular clock behind the stamps are used instead; log the controller's sampling time if possible")
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
