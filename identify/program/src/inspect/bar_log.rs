//! Inspection of a recording of the bar's encoders that was made by another program.

use super::recording::{encoders, motion, quality};
use super::{Inspection, UNSAID, stamps, unwrapped};
use crate::logs::{OtherBarLog, since_first_s};

/// Reports the content of a table or bag with the bar's encoders.
pub fn bar_log(log: &OtherBarLog) -> Inspection {
    let mut inspection = Inspection::default();
    inspection.fact("the bar", format!("from a {}", log.kind));
    let times = log.cycles.first().zip(log.cycles.last());
    let seconds = times.map_or(0.0, |(first, last)| last.sample_time.seconds_since(first.sample_time));
    inspection.fact("length", format!("{seconds:.1} s, {} rows", log.cycles.len()));
    if let (true, Some((first, _))) = (log.is_dated, times) {
        inspection.fact("begins", first.sample_time.to_string());
    }
    inspection.fact("clock", log.clock.clone());
    encoders(&mut inspection, &log.encoders);
    let stamps_ns: Vec<i64> = log.cycles.iter().map(|cycle| cycle.sample_time.0).collect();
    stamps(&mut inspection, &since_first_s(&stamps_ns), &log.quality);
    for (what, instead) in log.unsaid() {
        inspection.fact(UNSAID, format!("{what}; {instead}"));
    }
    unwrapped(&mut inspection, &log.unwrapped);
    quality(&mut inspection, &log.cycles);
    inspection.suspicious.extend_from_slice(&log.quality.remarks);
    motion(&mut inspection, &log.cycles, &log.encoders);
    inspection
}
