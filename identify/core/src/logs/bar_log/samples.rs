//! Checks the rows of a table or a bag of the bar as a whole, and converts them to records of bus cycles, as in recordings.
//!
//! [`RawBarLog`] collects the rows in the order of the file. [`RawBarLog::finish`] searches them for excursions,
//! repeated rows, and restarts of counters, unless the file marks restarts itself. Rows that cannot be used remain, but
//! are marked as not valid. After a restart the counts refer to a new origin. An [`EncoderReader`] converts the values
//! of one encoder to counts.

use std::f64::consts::TAU;
use std::path::{Path, PathBuf};

use shared::config::BallBarConfig;
use shared::encoder::{Direction, EncoderScale, Unwrapper, wrap};
use shared::output::named;
use shared::recording::schema::{CycleRecord, EncoderInfo, EncoderSample, MAX_ENCODERS, flags};
use shared::time::UtcNs;

use super::mapping::EncoderUnit;
use super::{MISSING_FACTS, OtherBarLog};
use crate::logs::time_series::excursions::{Excursions, Fastest, remark};
use crate::logs::time_series::frozen::repeated_rows;
use crate::logs::{LogError, LogQuality, ROWS_MIN, Unwrapped, UnwrappedPoint, since_first_s};

/// Largest speed at which a robot moves a joint of the bar \[rad/s\].
const SPEED_RAD_S_MAX: f64 = 4.0 * std::f64::consts::PI;
/// Upper bounds of the motion of a bar's joint. A bar is moved by a robot or by hand. Neither turns back faster
/// than a robot's joints.
const FASTEST: Fastest = Fastest { speed: SPEED_RAD_S_MAX, acceleration: 200.0 };
/// Smallest step at a new origin \[rad\]. Without this limit, ordinary motion could look like a new origin: receive times
/// jitter, so two rows may have almost the same time and a speed above [`SPEED_RAD_S_MAX`].
const JUMP_RAD_MIN: f64 = 0.2;
/// Largest number of restarts of the counters that are listed in a remark. A wrong scale causes thousands of them.
const PLACES_MAX: usize = 5;
/// Scale by which angles are converted to counts; one count is 1.5 nrad. Angles that wrap after each turn can then be
/// followed in the same way as counters.
const ANGLE_SCALE: EncoderScale = EncoderScale {
    lines: 1 << 24,
    interpolation_bits: 8,
    direction: Direction::Positive,
    offset_rad: 0.0,
    reference_counts: 0,
};
/// Largest valid angle \[rad\]. The counter of a terminal wraps at a much smaller angle.
const ANGLE_RAD_MAX: f64 = 1e4;

/// Converts the values of one encoder in a file to counts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct EncoderReader {
    pub info: EncoderInfo,
    unit: EncoderUnit,
    wraps_at: u64,
    last: Option<LastCount>,
}

/// The last count of an encoder.
#[derive(Debug, Clone, Copy, PartialEq)]
struct LastCount {
    /// Count as in the file.
    shown: i64,
    /// The same count after unwrapping.
    unwrapped: i64,
}

impl EncoderReader {
    /// A reader for the encoder of `joint`. `place` is the name of its column or joint in the file.
    ///
    /// # Errors
    /// [`LogError::Content`] if the values are counts, but the bar's configuration has no encoder at this joint.
    pub fn new(
        joint: u8,
        unit: EncoderUnit,
        wraps_at: u64,
        bar: &BallBarConfig,
        (path, place): (&Path, &str),
    ) -> Result<Self, LogError> {
        let (scale, wraps_at) = match unit {
            EncoderUnit::Counts => {
                let configured = bar.encoders.iter().find(|encoder| encoder.joint == joint);
                let scale = configured.map(shared::config::EncoderConfig::scale);
                let scale = scale.ok_or_else(|| {
                    let problem = format!(
                        "`{place}` has counts of joint {joint}, where the bar's configuration has no encoder"
                    );
                    let remedy = "add an [[encoders]] block with its joint, lines and interpolation_bits, or leave the column out";
                    LogError::content(path, problem, remedy)
                })?;
                (scale, wraps_at)
            }
            // An angle does not wrap at the width of a counter, but after a turn. Of the two directions, each step is
            // assumed to be in the shorter one.
            EncoderUnit::Rad | EncoderUnit::Deg => {
                (ANGLE_SCALE, ANGLE_SCALE.counts_per_revolution().unsigned_abs())
            }
        };
        Ok(Self { info: EncoderInfo { joint, scale }, unit, wraps_at, last: None })
    }

    /// Whether the values in the file are counts.
    pub fn is_counts(&self) -> bool {
        self.unit == EncoderUnit::Counts
    }

    /// Converts an angle in the file's unit to counts of [`ANGLE_SCALE`]; `None` for an invalid angle.
    pub fn count_of_angle(&self, value: f64) -> Option<i64> {
        let turns = match self.unit {
            EncoderUnit::Deg => value / 360.0,
            _ => value / TAU,
        };
        let counts = turns * ANGLE_SCALE.counts_per_revolution() as f64;
        (turns.abs() * TAU <= ANGLE_RAD_MAX).then_some(counts.round() as i64)
    }

    /// Converts the next count of a counter of any width to a counter of 32 bits.
    fn unwrap_to_32_bits(&mut self, shown: i64) -> u32 {
        let last = self.last.unwrap_or(LastCount { shown, unwrapped: shown });
        let unwrapped = last.unwrapped.wrapping_add(self.step(last.shown, shown));
        self.last = Some(LastCount { shown, unwrapped });
        wrap(unwrapped)
    }

    /// Difference of two counts in the file, in the shorter direction.
    fn step(&self, before: i64, shown: i64) -> i64 {
        let width = i128::from(self.wraps_at);
        let half = width / 2;
        ((i128::from(shown) - i128::from(before) + half).rem_euclid(width) - half) as i64
    }
}

/// One row of a file.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct RawBarRow {
    /// Line or number of the message in the file.
    pub place: u64,
    /// Stamp on the clock of the file \[ns\].
    pub stamp_ns: i64,
    /// Counts as in the file, in the order of the readers; `None` for missing values.
    pub counts: [Option<i64>; MAX_ENCODERS],
    /// Whether the file marks each value as valid.
    pub valid: [bool; MAX_ENCODERS],
    /// Flags of the whole row, see [`flags`].
    pub flags: u32,
}

impl RawBarRow {
    /// Whether all values of the first `count` encoders are present and valid.
    fn is_valid(&self, count: usize) -> bool {
        self.counts.iter().zip(&self.valid).take(count).all(|(count, valid)| count.is_some() && *valid)
    }
}

/// The kind of a file, and the information that it contains.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct BarLogKind {
    /// Name of the kind in messages.
    pub name: &'static str,
    /// Name of a row in messages: `line` or `message`.
    pub row: &'static str,
    /// Whether the file marks invalid values.
    pub has_validity: bool,
    /// Whether the file marks restarts of the counters. If so, the values are not searched for restarts,
    /// excursions and repeated rows.
    pub has_origins: bool,
    /// Whether the stamps count from 1970.
    pub is_dated: bool,
}

/// Rows in the order of the file.
pub(super) struct RawBarLog {
    path: PathBuf,
    kind: BarLogKind,
    readings: Vec<EncoderReader>,
    rows: Vec<RawBarRow>,
    quality: LogQuality,
}

impl RawBarLog {
    pub fn new(path: &Path, kind: BarLogKind, readings: Vec<EncoderReader>) -> Self {
        Self { path: path.to_owned(), kind, readings, rows: Vec::new(), quality: LogQuality::default() }
    }

    /// Adds a remark on the quality of the log.
    pub fn remark(&mut self, remark: impl Into<String>) {
        self.quality.remarks.push(remark.into());
    }

    /// Adds the next row. A row with the same stamp and counts as the row before is counted, but not added.
    ///
    /// # Errors
    /// [`LogError::TimeNotIncreasing`] if the stamp is not later than that of the row before, unless the file marks one of
    /// the two cycles with a flag.
    pub fn push(&mut self, row: RawBarRow) -> Result<(), LogError> {
        if let Some(before) = self.rows.last() {
            if row.stamp_ns == before.stamp_ns && row.counts == before.counts {
                self.quality.duplicates_dropped += 1;
                return Ok(());
            }
            if row.stamp_ns <= before.stamp_ns && row.flags | before.flags == 0 {
                let stamps = [(before.place, before.stamp_ns), (row.place, row.stamp_ns)];
                return Err(LogError::time_not_increasing(&self.path, self.kind.row, stamps[0], stamps[1]));
            }
        }
        self.rows.push(row);
        Ok(())
    }

    /// Checks and converts all rows.
    ///
    /// # Errors
    /// [`LogError::TooFewRows`], and [`LogError::Content`] if there are too many excursions, or if a counter wraps
    /// at another count than configured.
    pub fn finish(mut self, clock: String) -> Result<OtherBarLog, LogError> {
        let usable = self.rows.iter().filter(|row| row.is_valid(self.readings.len())).count();
        LogError::unless_enough(&self.path, usable, ROWS_MIN)?;
        self.quality.incomplete_dropped = if self.kind.has_validity { 0 } else { self.rows.len() - usable };
        if !self.kind.has_origins {
            self.mark_excursions()?;
        }
        for encoder in 0..self.readings.len() {
            self.check_wrap(encoder)?;
        }
        let mut cycles = self.cycles();
        if !self.kind.has_origins {
            self.mark_repeated(&mut cycles);
            self.mark_origins(&mut cycles);
        }
        let stamps_s = since_first_s(&self.rows.iter().map(|row| row.stamp_ns).collect::<Vec<_>>());
        self.remark_counts();
        let (unknown, unwrapped) = (self.unknown(), self.unwrapped(&cycles, &stamps_s));
        let encoders = self.readings.iter().map(|reading| reading.info).collect();
        Ok(OtherBarLog {
            kind: self.kind.name,
            clock,
            is_dated: self.kind.is_dated,
            encoders,
            cycles,
            quality: self.quality,
            unwrapped,
            unknown,
            simulated: false,
        })
    }

    /// The records of all rows, with counts that wrap at 32 bits.
    fn cycles(&mut self) -> Vec<CycleRecord> {
        let mut cycles = Vec::with_capacity(self.rows.len());
        let mut origin = 0;
        for (row, cycle) in self.rows.iter().zip(0..) {
            origin += u32::from(row.flags & flags::ORIGIN_CHANGED != 0);
            let mut encoders = [EncoderSample::default(); MAX_ENCODERS];
            for (encoder, (sample, reading)) in encoders.iter_mut().zip(&mut self.readings).enumerate() {
                let shown = row.counts[encoder];
                sample.joint = reading.info.joint;
                sample.valid = shown.is_some() && row.valid[encoder];
                sample.count =
                    shown.filter(|_| row.valid[encoder]).map_or(0, |shown| reading.unwrap_to_32_bits(shown));
            }
            cycles.push(CycleRecord {
                cycle,
                sample_time: UtcNs(row.stamp_ns),
                flags: row.flags & !flags::ORIGIN_CHANGED,
                origin,
                encoder_count: self.readings.len() as u8,
                encoders,
                ..CycleRecord::default()
            });
        }
        cycles
    }

    /// Change of an encoder from one cycle to another \[rad\].
    fn step_rad(&self, before: &CycleRecord, after: &CycleRecord, encoder: usize) -> f64 {
        let counts = after.encoders[encoder].count.wrapping_sub(before.encoders[encoder].count) as i32;
        f64::from(counts) * self.readings[encoder].info.scale.rad_per_count()
    }

    /// Marks excursions, such as rows of zeros, as not valid. Otherwise each excursion would look like two
    /// restarts of the counters.
    fn mark_excursions(&mut self) -> Result<(), LogError> {
        let width = self.readings.len();
        // Indices of the rows that are searched. `shown` and `step` below count among these rows.
        let valid: Vec<usize> = (0..self.rows.len()).filter(|row| self.rows[*row].is_valid(width)).collect();
        let t_s = since_first_s(&valid.iter().map(|row| self.rows[*row].stamp_ns).collect::<Vec<_>>());
        let shown = |row: usize, encoder: usize| self.rows[valid[row]].counts[encoder].unwrap_or_default();
        let step = |from: usize, to: usize, encoder: usize| {
            let reading = &self.readings[encoder];
            let counts = reading.step(shown(from, encoder), shown(to, encoder));
            counts as f64 * reading.info.scale.rad_per_count()
        };
        let excursions = Excursions { t_s: &t_s, columns: width, fastest: FASTEST, step }.find();
        let places: Vec<u64> = excursions.iter().map(|row| self.rows[valid[*row]].place).collect();
        let remark =
            remark(&places, valid.len(), (&self.path, self.kind.row), "they are marked and not used")?;
        self.quality.remarks.extend(remark);
        self.quality.excursions_dropped = excursions.len();
        excursions.into_iter().for_each(|row| self.rows[valid[row]].valid = [false; MAX_ENCODERS]);
        Ok(())
    }

    /// Marks rows as not valid that have the same counts as the row before, but a new stamp, in the middle of a motion.
    fn mark_repeated(&mut self, cycles: &mut [CycleRecord]) {
        let valid = valid_cycles(cycles);
        let step_rad = |from: usize, to: usize, encoder: usize| {
            self.step_rad(&cycles[valid[from]], &cycles[valid[to]], encoder)
        };
        let repeated = repeated_rows(valid.len(), self.readings.len(), usize::MAX, step_rad);
        self.quality.repeated_dropped += repeated.len();
        for index in repeated {
            let cycle = &mut cycles[valid[index]];
            cycle.flags |= flags::STALE_INPUT;
            cycle.encoders.iter_mut().for_each(|sample| sample.valid = false);
        }
    }

    /// Begins a new origin where two or more encoders jump. If a terminal loses power, its counter restarts at an
    /// arbitrary count, and so do the counters of its neighbours. If only one encoder jumps, it has slipped, which a
    /// later step of the preparation reports.
    fn mark_origins(&mut self, cycles: &mut [CycleRecord]) {
        let (mut places, mut begins_origin) = (Vec::new(), vec![false; cycles.len()]);
        for pair in valid_cycles(cycles).windows(2) {
            let (before, after) = (&cycles[pair[0]], &cycles[pair[1]]);
            let apart_s = after.sample_time.seconds_since(before.sample_time);
            let step_rad_max = JUMP_RAD_MIN.max(SPEED_RAD_S_MAX * apart_s);
            let jumps = (0..self.readings.len())
                .filter(|encoder| self.step_rad(before, after, *encoder).abs() > step_rad_max)
                .count();
            if jumps >= 2 {
                places.push(self.rows[pair[1]].place);
                begins_origin[pair[1]] = true;
            }
        }
        let mut origin = 0;
        for (cycle, begins_origin) in cycles.iter_mut().zip(begins_origin) {
            origin += u32::from(begins_origin);
            cycle.origin = origin;
        }
        self.remark_origins(&places);
    }

    fn remark_origins(&mut self, places: &[u64]) {
        let remedy = match places.len() {
            0 => return,
            1..=PLACES_MAX => "",
            _ => "; if none restarted, correct lines and interpolation_bits in the bar's configuration",
        };
        let (row, named) = (self.kind.row, named(places, PLACES_MAX));
        self.remark(format!(
            "at {row} {named} two or more encoders jump at once: taken as a restart of the counters{remedy}"
        ));
    }

    /// Rejects a counter with fewer bits than configured. The counts of such a counter span at least three quarters of a
    /// smaller width, and jump by more than half of that width when the counter wraps.
    fn check_wrap(&self, encoder: usize) -> Result<(), LogError> {
        let Some(reading) = self.readings.get(encoder).filter(|reading| reading.is_counts()) else {
            return Ok(());
        };
        let valid = self.rows.iter().filter(|row| row.is_valid(self.readings.len()));
        let shown: Vec<(u64, i128)> =
            valid.filter_map(|row| Some((row.place, i128::from(row.counts[encoder]?)))).collect();
        let low = shown.iter().map(|(_, count)| *count).min().unwrap_or_default();
        let high = shown.iter().map(|(_, count)| *count).max().unwrap_or_default();
        for width in [1 << 16, i128::from(reading.info.scale.counts_per_revolution()), 1 << 24] {
            let within = low >= 0 && high < width || low >= -width / 2 && high < width / 2;
            if width >= i128::from(reading.wraps_at) || !within || 4 * (high - low) < 3 * width {
                continue;
            }
            let jump = shown.windows(2).find(|pair| (pair[1].1 - pair[0].1).abs() > width / 2);
            if let Some([_, (line, _)]) = jump {
                let problem = format!(
                    "the counts of joint {} stay within a range of {width} and jump by more than half of it at {} \
                     {line}: the counter wraps at {width}",
                    reading.info.joint, self.kind.row
                );
                let remedy = format!("write wraps_at = {width} into the mapping file (--recording-mapping)");
                return Err(LogError::content(&self.path, problem, remedy));
            }
        }
        Ok(())
    }

    /// The encoders that wrapped, with their values in the file and after unwrapping.
    fn unwrapped(&self, cycles: &[CycleRecord], stamps_s: &[f64]) -> Vec<Unwrapped> {
        // After a restart the count of a counter is arbitrary, so each part with one origin is examined separately.
        let is_continued = |cycle: &CycleRecord, next: &CycleRecord| cycle.origin == next.origin;
        let of_encoder = |encoder: usize| {
            let parts = cycles.chunk_by(is_continued);
            Unwrapped::of_parts(parts.map(|part| self.unwrapped_part(encoder, part, stamps_s)))
        };
        (0..self.readings.len()).filter_map(of_encoder).collect()
    }

    /// The values of one encoder in cycles with one origin; `None` if it did not wrap in them.
    fn unwrapped_part(&self, encoder: usize, cycles: &[CycleRecord], stamps_s: &[f64]) -> Option<Unwrapped> {
        let reading = self.readings.get(encoder)?;
        let scale = &reading.info.scale;
        let period_rad =
            if reading.is_counts() { reading.wraps_at as f64 * scale.rad_per_count() } else { TAU };
        let (mut unwrapper, mut first) = (Unwrapper::default(), None);
        let points = cycles.iter().filter(|cycle| cycle.is_valid()).filter_map(|cycle| {
            let number = usize::try_from(cycle.cycle).ok()?;
            let row = self.rows.get(number)?;
            let counts = unwrapper.next(cycle.encoders[encoder].count);
            let from_first = counts - *first.get_or_insert(counts);
            Some(UnwrappedPoint {
                t_s: *stamps_s.get(number)?,
                shown_rad: row.counts[encoder]? as f64 * scale.rad_per_count(),
                continuous_rad: (scale.direction.sign() * from_first) as f64 * scale.rad_per_count(),
            })
        });
        let points: Vec<UnwrappedPoint> = points.collect();
        Unwrapped::find(format!("b{}", reading.info.joint), period_rad, points.len(), |at| points[at])
    }

    fn remark_counts(&mut self) {
        if self.quality.duplicates_dropped > 0 {
            let (count, row) = (self.quality.duplicates_dropped, self.kind.row);
            self.remark(format!(
                "{count} {row}s repeat the one before them, stamp and counts; they are dropped"
            ));
        }
        let done = "they are marked and not used";
        self.quality.remark_counts(self.kind.row, "the counts", done, "lack a value of an encoder");
    }

    /// The information that the file does not contain, by its names in `MISSING_FACTS`.
    fn unknown(&self) -> Vec<&'static str> {
        let BarLogKind { has_validity, has_origins, is_dated, .. } = self.kind;
        let [certainty, other_clock, validity, origins, date] = MISSING_FACTS.map(|(what, _)| what);
        let mut unknown = vec![certainty, other_clock];
        for (known, what) in [(has_validity, validity), (has_origins, origins), (is_dated, date)] {
            if !known {
                unknown.push(what);
            }
        }
        unknown
    }
}

/// Indices of the valid cycles.
fn valid_cycles(cycles: &[CycleRecord]) -> Vec<usize> {
    (0..cycles.len()).filter(|index| cycles[*index].is_valid()).collect()
}
