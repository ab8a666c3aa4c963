//! Writes a recording as a table (CSV) for spreadsheets and scripts, with one row per cycle. `ballbard export`, the page
//! and the API use it.

use std::io::{self, BufReader, Write};
use std::iter::Peekable;
use std::path::Path;
use std::slice;

use shared::encoder::Unwrapper;
use shared::recording::schema::{CycleRecord, EncoderInfo, Event, RunMetadata, flags};
use shared::recording::{Disk, OpenFile, Outline, ReadError, ReadErrorKind};
use shared::time::UtcNs;

use super::note;
use crate::problem::flag_names;

/// Format of a table.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Layout {
    /// Seconds since the first cycle (`t_s`) instead of `time_utc`.
    pub relative: bool,
    /// For spreadsheets of continental Europe: semicolons between columns, decimal commas in numbers.
    pub excel: bool,
}

/// Writes one row per cycle and returns the number of rows. The columns are:
/// - `time_utc` (or `t_s`),
/// - a `count` per encoder, empty if the cycle has no sample,
/// - an unwrapped `angle` per encoder \[rad\], from its reference mark or else from count 0, empty if the sample is invalid,
/// - `valid` per encoder,
/// - the cycle number, the reasons why the cycle is flagged, and the events of the cycle. The first row also contains the
///   texts that describe the run.
///
/// Memory does not grow with the number of cycles. The file is read twice, because an event may follow many later cycles, for
/// example a marker whose text took a while to type. The first pass collects the events and verifies the whole recording. The
/// second pass writes the rows.
pub fn write_csv(disk: &dyn Disk, path: &Path, layout: Layout, sink: impl Write) -> anyhow::Result<u64> {
    let error = |kind| ReadError { path: path.to_owned(), kind };
    let file = disk.open(path).map_err(|source| error(source.into()))?;
    let source = || BufReader::new(OpenFile::new(disk, &file));
    let mut outline = Outline::read(source(), &mut |_| Ok::<_, ReadErrorKind>(())).map_err(error)?;
    note::apply(disk, path, &mut outline.run);
    // In the file, an event may follow events of later cycles. `Table::add` needs them in the order of their cycles.
    outline.events.sort_by_key(|event| event.cycle);
    let mut table = Table::begin(&outline, layout, sink)?;
    Outline::read(source(), &mut |cycle| Ok::<_, anyhow::Error>(table.add(&cycle)?))?;
    table.rows.flush()?;
    Ok(outline.end.cycles)
}

/// A table that is written row by row.
struct Table<'a, W: Write> {
    layout: Layout,
    rows: csv::Writer<W>,
    encoders: &'a [EncoderInfo],
    unwrappers: Vec<Unwrapper>,
    /// Events that have not been written to a row yet.
    events: Peekable<slice::Iter<'a, Event>>,
    /// Texts that describe the run, for the event column of the first row.
    about: Vec<String>,
    first_sample: Option<UtcNs>,
    /// Origin number of the counters in the previous row.
    origin: Option<u32>,
    /// Number of cycles of the recording.
    cycles: u64,
}

impl<'a, W: Write> Table<'a, W> {
    /// Writes the header. The layout for spreadsheets begins with a byte order mark.
    fn begin(outline: &'a Outline, layout: Layout, mut sink: W) -> io::Result<Self> {
        if layout.excel {
            // Without a byte order mark a spreadsheet assumes the code page of its country.
            sink.write_all("\u{feff}".as_bytes())?;
        }
        let encoders = &outline.run.encoders;
        let column = |pattern: &str| {
            let named = |encoder: &EncoderInfo| pattern.replace('#', &encoder.joint.to_string());
            encoders.iter().map(named).collect::<Vec<_>>()
        };
        let mut header = vec![if layout.relative { "t_s" } else { "time_utc" }.to_owned()];
        header.extend(["count#", "angle#_rad", "valid#"].into_iter().flat_map(column));
        header.extend(["cycle", "flags", "event"].map(str::to_owned));
        let delimiter = if layout.excel { b';' } else { b',' };
        let mut rows = csv::WriterBuilder::new().delimiter(delimiter).from_writer(sink);
        rows.write_record(&header).map_err(sink_error)?;
        Ok(Self {
            layout,
            rows,
            encoders,
            unwrappers: encoders.iter().map(|encoder| encoder.scale.unwrapper()).collect(),
            events: outline.events.iter().peekable(),
            about: run_texts(&outline.run),
            first_sample: None,
            origin: None,
            cycles: outline.end.cycles,
        })
    }

    /// Writes the row of the next cycle.
    fn add(&mut self, record: &CycleRecord) -> io::Result<()> {
        let layout = self.layout;
        let is_new_origin = self.origin.replace(record.origin).is_some_and(|before| before != record.origin);
        let has_counts =
            record.flags & (flags::LOST | flags::NO_REPLY | flags::DEADLINE_MISSED | flags::BUS_DOWN) == 0;
        let samples = record.encoders();
        let first_sample = *self.first_sample.get_or_insert(record.sample_time);
        // Columns of the samples: time, counts, angles, validity.
        let mut row = vec![layout.time(record.sample_time, first_sample)];
        for sample in samples {
            row.push(if has_counts { sample.count.to_string() } else { String::new() });
        }
        for ((sample, encoder), unwrapper) in samples.iter().zip(self.encoders).zip(&mut self.unwrappers) {
            row.push(if sample.valid {
                let angle_rad = encoder.scale.counts_to_rad(unwrapper.next(sample.count));
                layout.number(format!("{angle_rad:.9}"))
            } else {
                String::new()
            });
        }
        for sample in samples {
            row.push(u8::from(sample.valid).to_string());
        }
        // Columns of the cycle: number, flags, events.
        let is_last = record.cycle + 1 == self.cycles;
        let mut texts = std::mem::take(&mut self.about);
        // The last row also contains the events after the last cycle.
        while let Some(Event { kind, text, .. }) =
            self.events.next_if(|event| event.cycle <= record.cycle || is_last)
        {
            texts.push(format!("{}: {text}", kind.name()));
        }
        let shown_flags = record.flags | if is_new_origin { flags::ORIGIN_CHANGED } else { 0 };
        row.extend([
            record.cycle.to_string(),
            flag_names(shown_flags).join(" "),
            // Replace line ends in texts, because some readers split rows at every line end.
            texts.join("; ").replace(char::is_control, " "),
        ]);
        self.rows.write_record(&row).map_err(sink_error)
    }
}

/// Extracts the error of the sink, so that its kind shows whether the reader has closed the sink.
fn sink_error(error: csv::Error) -> io::Error {
    match error.into_kind() {
        csv::ErrorKind::Io(error) => error,
        other => io::Error::other(format!("{other:?}")),
    }
}

impl Layout {
    /// Parses the query of a URL, such as `excel&relative`.
    pub fn from_query(query: &str) -> Result<Self, String> {
        let mut layout = Self::default();
        for name in query.split('&').filter(|name| !name.is_empty()) {
            match name.strip_suffix("=true").unwrap_or(name) {
                "relative" => layout.relative = true,
                "excel" => layout.excel = true,
                _ => {
                    return Err(format!("unknown option `{name}`; tables have `relative` and `excel`"));
                }
            }
        }
        Ok(layout)
    }

    /// The query that [`Self::from_query`] parses, with its `?`. Empty for the default layout.
    pub fn query(self) -> String {
        let names = [(self.relative, "relative=true"), (self.excel, "excel=true")];
        let names: Vec<_> = names.into_iter().filter_map(|(is_set, name)| is_set.then_some(name)).collect();
        if names.is_empty() { String::new() } else { format!("?{}", names.join("&")) }
    }

    fn time(self, at: UtcNs, first: UtcNs) -> String {
        if self.relative {
            return self.number(format!("{:.6}", at.seconds_since(first)));
        }
        if self.excel {
            return self.number(at.to_datetime().format("%Y-%m-%d %H:%M:%S%.3f").to_string());
        }
        at.to_string()
    }

    fn number(self, text: String) -> String {
        if self.excel { text.replace('.', ",") } else { text }
    }
}

/// Texts about the provenance of the data, about the position from which angles are counted, and about the run.
fn run_texts(run: &RunMetadata) -> Vec<String> {
    let RunMetadata { operator, robot, bar, payload, note, .. } = run;
    let texts =
        [("robot", robot), ("bar", bar), ("payload", payload), ("operator", operator), ("note", note)];
    let texts =
        texts.iter().filter(|(_, text)| !text.is_empty()).map(|(what, text)| format!("{what}: {text}"));
    let provenance = Some(run.provenance().to_string()).filter(|text| !text.is_empty());
    provenance.into_iter().chain([angle_zeros(&run.encoders)]).chain(texts).collect()
}

/// Text that describes from where angles are counted: from the reference mark for homed joints, from
/// count 0 for the other joints.
fn angle_zeros(encoders: &[EncoderInfo]) -> String {
    let (homed, others): (Vec<&EncoderInfo>, Vec<_>) =
        encoders.iter().partition(|encoder| encoder.scale.reference_counts != 0);
    let zero = |what: &str, with_it: &[&EncoderInfo]| match with_it.len() {
        0 => None,
        count if count == encoders.len() => Some(what.to_owned()),
        _ => {
            let joints: Vec<_> = with_it.iter().map(|encoder| encoder.joint.to_string()).collect();
            Some(format!("{what} (joint {})", joints.join(" ")))
        }
    };
    let zeros = [zero("reference mark", &homed), zero("counter at 0", &others)];
    format!("angles from: {}", zeros.into_iter().flatten().collect::<Vec<_>>().join(" and "))
}
