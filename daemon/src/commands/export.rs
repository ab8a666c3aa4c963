//! `ballbard export`: a recording as a table for spreadsheets and scripts.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use shared::output::{say, unless_gone};
use shared::recording::Recording;
use shared::recording::schema::{EncoderInfo, flags};

#[derive(Debug, Args)]
pub struct ExportArguments {
    /// The recording
    file: PathBuf,
    /// Comma-separated values: time stamp and counters, then angles and validity
    #[arg(long, required = true)]
    csv: bool,
    /// Where to; `-` for standard output; default: beside the recording, ending in .csv
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

pub fn run(arguments: &ExportArguments) -> anyhow::Result<()> {
    let recording = Recording::open(&arguments.file)?;
    let out = arguments.out.clone().unwrap_or_else(|| arguments.file.with_extension("csv"));
    if out == Path::new("-") {
        let mut table = Vec::new();
        write_csv(&recording, &mut table)?;
        let written = std::io::stdout().lock().write_all(&table);
        return Ok(unless_gone(written)?);
    }
    // Under its final name the table is whole, or it is not there.
    let part = out.with_extension("csv.part");
    let file = File::create(&part).with_context(|| format!("cannot create {}", part.display()))?;
    write_csv(&recording, BufWriter::new(file))
        .and_then(|()| Ok(std::fs::rename(&part, &out)?))
        .with_context(|| format!("cannot write {}; check free space", out.display()))?;
    Ok(say(format_args!("{}: {} rows", out.display(), recording.cycles.len()))?)
}

/// One row per cycle: `time_utc`, a `count` per encoder (the thesis' columns), then `angle` \[rad\] per encoder
/// unwrapped and in the encoder's own zero, `valid` per encoder, cycle number and the reasons of flagged cycles.
/// Counts and angles of encoders that gave nothing are left empty.
pub fn write_csv(recording: &Recording, sink: impl Write) -> anyhow::Result<()> {
    let encoders = &recording.run.encoders;
    let mut table = csv::Writer::from_writer(sink);
    let column = |pattern: &str| {
        let named = |encoder: &EncoderInfo| pattern.replace('#', &encoder.joint.to_string());
        encoders.iter().map(named).collect::<Vec<_>>()
    };
    let mut header = vec!["time_utc".to_owned()];
    header.extend(["count#", "angle#_rad", "valid#"].into_iter().flat_map(column));
    header.extend(["cycle".to_owned(), "flags".to_owned()]);
    table.write_record(&header)?;

    let mut unwrappers: Vec<_> = encoders.iter().map(|encoder| encoder.scale.unwrapper()).collect();
    let mut origin = recording.cycles.first().map_or(0, |record| record.origin);
    for record in &recording.cycles {
        let changed = std::mem::replace(&mut origin, record.origin) != record.origin;
        let seen = record.flags & (flags::LOST | flags::NO_REPLY | flags::DEADLINE_MISSED) == 0;
        let samples = record.encoders();
        let mut row = vec![record.sample_time.to_string()];
        row.extend(samples.iter().map(|sample| if seen { sample.count.to_string() } else { String::new() }));
        row.extend(samples.iter().zip(encoders).zip(&mut unwrappers).map(
            |((sample, encoder), unwrapper)| {
                if sample.valid {
                    format!("{:.9}", encoder.scale.counts_to_rad(unwrapper.next(sample.count)))
                } else {
                    String::new()
                }
            },
        ));
        row.extend(samples.iter().map(|sample| u8::from(sample.valid).to_string()));
        row.extend([
            record.cycle.to_string(),
            flag_names(record.flags | if changed { flags::ORIGIN_CHANGED } else { 0 }),
        ]);
        table.write_record(&row)?;
    }
    table.flush()?;
    Ok(())
}

fn flag_names(bits: u32) -> String {
    let set = flags::NAMES.iter().filter(|(bit, _)| bits & bit != 0);
    set.map(|(_, name)| *name).collect::<Vec<_>>().join(" ")
}
