//! `ballbard export`: a recording as a table for spreadsheets and scripts.

use std::fs::File;
use std::io::{BufReader, BufWriter, Read, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;
use shared::output::{say, unless_gone};
use shared::recording::schema::{CycleRecord, EncoderInfo, Event, EventKind, RunMetadata, flags};
use shared::recording::{Disk, ReadError, Recording, SystemDisk};

use super::client::ServiceArguments;
use crate::control::note;

#[derive(Debug, Args)]
pub struct ExportArguments {
    /// The recording: a file, or the name of a run
    recording: PathBuf,
    /// Comma-separated values: time stamp and counters, then angles and validity, events and marks
    #[arg(long, required = true)]
    csv: bool,
    /// Where to; `-` for standard output; default: beside the file, or here for a name, ending in .csv
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Replace a table that is there
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    layout: Layout,
    #[command(flatten)]
    service: ServiceArguments,
}

/// How a table is written.
#[derive(Debug, Clone, Copy, Default, Args)]
pub struct Layout {
    /// Seconds since the first cycle (`t_s`) instead of `time_utc`
    #[arg(long)]
    relative: bool,
    /// For spreadsheets of continental Europe: semicolons between columns, commas in numbers
    #[arg(long)]
    excel: bool,
}

pub fn run(arguments: &ExportArguments) -> anyhow::Result<()> {
    let (recording, beside) = find(&arguments.recording, &arguments.service)?;
    let out = arguments.out.clone().unwrap_or_else(|| beside.with_extension("csv"));
    if out == Path::new("-") {
        if arguments.service.format.json {
            bail!(
                "--json says what was written to a file, and standard output has the table; leave out one of the two"
            );
        }
        let mut table = Vec::new();
        write_csv(&recording, arguments.layout, &mut table)?;
        let written = std::io::stdout().lock().write_all(&table);
        return Ok(unless_gone(written)?);
    }
    if out.exists() && !arguments.force {
        bail!("{} is there already; --force replaces it, --out writes another", out.display());
    }
    // Under its final name the table is whole, or it is not there.
    let part = out.with_extension("csv.part");
    let sink = File::create(&part).with_context(|| format!("cannot create {}", part.display()))?;
    write_csv(&recording, arguments.layout, BufWriter::new(sink))
        .and_then(|()| Ok(std::fs::rename(&part, &out)?))
        .with_context(|| format!("cannot write {}; check free space", out.display()))?;
    let (file, rows) = (out.display().to_string(), recording.cycles.len());
    if arguments.service.format.prints(&serde_json::json!({ "file": file, "rows": rows }))? {
        return Ok(());
    }
    Ok(say(format_args!("{file}: {rows} rows"))?)
}

/// A recording as tables show it, with the note that it has by now.
pub fn open(disk: &dyn Disk, file: &Path) -> Result<Recording, ReadError> {
    let mut recording = Recording::open_on(disk, file)?;
    note::apply(disk, file, &mut recording.run);
    Ok(recording)
}

/// The recording that is meant, and what its table is called after.
fn find(recording: &Path, service: &ServiceArguments) -> anyhow::Result<(Recording, PathBuf)> {
    let is_name = recording.components().count() == 1 && recording.extension().is_none();
    // Files of this machine are none of another's service.
    if (recording.exists() || !is_name) && !service.is_elsewhere() {
        return Ok((open(&SystemDisk, recording)?, recording.to_owned()));
    }
    let name = recording.to_string_lossy();
    let Some(line) = service.runs()?.into_iter().find(|line| line.name == name && line.verdict.is_some())
    else {
        bail!("no file and no finished run is called `{name}`; `ballbard runs` lists them")
    };
    let beside = PathBuf::from(format!("{name}.mcap"));
    if !service.is_elsewhere() {
        return Ok((open(&SystemDisk, &line.file)?, beside));
    }
    let read = |file: &mut dyn Read| Recording::read(BufReader::new(file)).map_err(anyhow::Error::from);
    let mut fetched = service
        .fetch(&format!("runs/{name}/mcap"), read)
        .with_context(|| format!("cannot fetch run `{name}`; try again"))?;
    fetched.run.note = line.note;
    Ok((fetched, beside))
}

/// One row per cycle: `time_utc` (or `t_s`), a `count` per encoder (the thesis' columns), then `angle` \[rad\] per encoder
/// unwrapped and in the encoder's own zero, `valid` per encoder, cycle number, the reasons of flagged cycles, and what
/// happened in it: marks, events, in the first row what was said of the run. Counts and angles of encoders that gave
/// nothing are left empty.
pub fn write_csv(recording: &Recording, layout: Layout, sink: impl Write) -> anyhow::Result<()> {
    let encoders = &recording.run.encoders;
    let mut sink = sink;
    if layout.excel {
        // Without it a spreadsheet takes the text for that of the code page of its country.
        sink.write_all("\u{feff}".as_bytes())?;
    }
    let delimiter = if layout.excel { b';' } else { b',' };
    let mut table = csv::WriterBuilder::new().delimiter(delimiter).from_writer(sink);
    let column = |pattern: &str| {
        let named = |encoder: &EncoderInfo| pattern.replace('#', &encoder.joint.to_string());
        encoders.iter().map(named).collect::<Vec<_>>()
    };
    let mut header = vec![if layout.relative { "t_s" } else { "time_utc" }.to_owned()];
    header.extend(["count#", "angle#_rad", "valid#"].into_iter().flat_map(column));
    header.extend(["cycle", "flags", "event"].map(str::to_owned));
    table.write_record(&header)?;

    let mut unwrappers: Vec<_> = encoders.iter().map(|encoder| encoder.scale.unwrapper()).collect();
    let mut origin = recording.cycles.first().map_or(0, |record| record.origin);
    let mut events = recording.events.iter().peekable();
    for (index, record) in recording.cycles.iter().enumerate() {
        let changed = std::mem::replace(&mut origin, record.origin) != record.origin;
        let seen = record.flags & (flags::LOST | flags::NO_REPLY | flags::DEADLINE_MISSED) == 0;
        let samples = record.encoders();
        let mut row = vec![layout.time(record, &recording.cycles[0])];
        row.extend(samples.iter().map(|sample| if seen { sample.count.to_string() } else { String::new() }));
        row.extend(samples.iter().zip(encoders).zip(&mut unwrappers).map(
            |((sample, encoder), unwrapper)| {
                if sample.valid {
                    layout.number(format!("{:.9}", encoder.scale.counts_to_rad(unwrapper.next(sample.count))))
                } else {
                    String::new()
                }
            },
        ));
        row.extend(samples.iter().map(|sample| u8::from(sample.valid).to_string()));
        let is_last = index + 1 == recording.cycles.len();
        let mut said = if index == 0 { about(&recording.run) } else { Vec::new() };
        while let Some(Event { kind, text, .. }) =
            events.next_if(|event| event.cycle <= record.cycle || is_last)
        {
            said.push(format!("{}: {text}", kind_name(*kind)));
        }
        row.extend([
            record.cycle.to_string(),
            flag_names(record.flags | if changed { flags::ORIGIN_CHANGED } else { 0 }),
            said.join("; "),
        ]);
        table.write_record(&row)?;
    }
    table.flush()?;
    Ok(())
}

impl Layout {
    fn time(self, record: &CycleRecord, first: &CycleRecord) -> String {
        if self.relative {
            return self.number(format!("{:.6}", record.sample_time.seconds_since(first.sample_time)));
        }
        if self.excel {
            return self.number(record.sample_time.to_datetime().format("%Y-%m-%d %H:%M:%S%.3f").to_string());
        }
        record.sample_time.to_string()
    }

    fn number(self, text: String) -> String {
        if self.excel { text.replace('.', ",") } else { text }
    }
}

/// What people said of a run.
fn about(run: &RunMetadata) -> Vec<String> {
    let RunMetadata { operator, robot, bar, payload, note, .. } = run;
    let said = [("robot", robot), ("bar", bar), ("payload", payload), ("operator", operator), ("note", note)];
    said.iter().filter(|(_, text)| !text.is_empty()).map(|(what, text)| format!("{what}: {text}")).collect()
}

/// Before each text, so that no spreadsheet takes one for a formula.
fn kind_name(kind: EventKind) -> &'static str {
    match kind {
        EventKind::Marker => "mark",
        EventKind::Gap => "gap",
        EventKind::Bus => "bus",
        EventKind::Clock => "clock",
        EventKind::Disk => "disk",
    }
}

fn flag_names(bits: u32) -> String {
    let set = flags::NAMES.iter().filter(|(bit, _)| bits & bit != 0);
    set.map(|(_, name)| *name).collect::<Vec<_>>().join(" ")
}
