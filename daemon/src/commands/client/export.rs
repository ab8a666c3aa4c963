//! `ballbard export`: writes a recording as a table for spreadsheets and scripts.

use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;
use shared::output::{say, unless_gone};
use shared::recording::{FINISHED_ENDING, SystemDisk};

use super::ServiceArguments;
use crate::control::recordings::runs::RunLine;
use crate::control::recordings::table::{Layout, write_csv};

#[derive(Debug, Args)]
pub struct ExportArguments {
    /// Recording to export: a file, or the name of a run
    recording: PathBuf,
    /// Write comma-separated values (the only format): time stamp, counters, angles, validity, events and marks
    #[arg(long, help_heading = "Output")]
    csv: bool,
    /// Output file, or `-` for standard output; default: the path of the recording with the ending .csv, or NAME.csv in the
    /// current directory if RECORDING is the name of a run
    #[arg(long, help_heading = "Output", value_name = "FILE")]
    out: Option<PathBuf>,
    /// Replace an existing table
    #[arg(long, help_heading = "Output")]
    force: bool,
    /// Write seconds since the first cycle (`t_s`) instead of `time_utc`
    #[arg(long, help_heading = "Output")]
    relative: bool,
    /// Write a table for spreadsheets in continental Europe: semicolons between columns, decimal commas in numbers
    #[arg(long, help_heading = "Output")]
    excel: bool,
    #[command(flatten)]
    service: ServiceArguments,
}

pub fn run(arguments: &ExportArguments) -> anyhow::Result<()> {
    let ExportArguments { relative, excel, service, .. } = arguments;
    let layout = Layout { relative: *relative, excel: *excel };
    let (source, recording_path) = find(&arguments.recording, service)?;
    let out = arguments.out.clone().unwrap_or_else(|| recording_path.with_extension("csv"));
    if out == Path::new("-") {
        if service.format.json {
            bail!(
                "--json describes a table in a file, but the table goes to standard output; omit --json or --out -"
            );
        }
        let written = source.write_csv(layout, service, BufWriter::new(io::stdout().lock()));
        return match written.map_err(anyhow::Error::downcast::<io::Error>) {
            Ok(_) => Ok(()),
            // It is no error if the reader closes the standard output early, as `head` does.
            Err(Ok(io_error)) => Ok(unless_gone(Err(io_error))?),
            Err(Err(other)) => Err(other),
        };
    }
    if out.exists() && !arguments.force {
        bail!("{} exists; --force replaces it, --out writes another", out.display());
    }
    if let Some(directory) = out.parent().filter(|path| !path.as_os_str().is_empty() && !path.is_dir()) {
        bail!("--out: the directory {} does not exist; create it, or name another", directory.display());
    }
    // Write to a temporary name and rename the file at the end, so that a table with its final name is complete.
    let part = out.with_extension("csv.part");
    let sink = File::create(&part).with_context(|| format!("cannot create {}", part.display()))?;
    let written = source
        .write_csv(layout, service, BufWriter::new(sink))
        .and_then(|rows| Ok(std::fs::rename(&part, &out).map(|()| rows)?));
    if written.is_err() {
        // Ignore an error of the removal, because the first error is reported.
        let _ = std::fs::remove_file(&part);
    }
    let rows = written.with_context(|| format!("cannot export to {}", out.display()))?;
    let file = out.display().to_string();
    if service.format.prints(&serde_json::json!({ "file": file, "rows": rows }))? {
        return Ok(());
    }
    Ok(say(format_args!("{file}: {rows} rows"))?)
}

/// Location of the recording.
enum RecordingLocation {
    File(PathBuf),
    /// A recording of a service on another machine. That service writes the table.
    Elsewhere(Box<RunLine>),
}

impl RecordingLocation {
    /// Writes the table to `sink`. Returns the number of rows.
    fn write_csv(
        &self,
        layout: Layout,
        service: &ServiceArguments,
        mut sink: impl Write,
    ) -> anyhow::Result<u64> {
        match self {
            Self::File(file) => write_csv(&SystemDisk, file, layout, sink),
            Self::Elsewhere(line) => {
                let RunLine { name, cycles, .. } = &**line;
                let path = format!("runs/{name}/csv{}", layout.query());
                service
                    .fetch(&path, |table| Ok(io::copy(table, &mut sink).and_then(|_| sink.flush())?))
                    .map(|()| *cycles)
            }
        }
    }
}

/// Finds the recording. Also returns the path from which the name of the table is derived, by replacing the extension.
fn find(recording: &Path, service: &ServiceArguments) -> anyhow::Result<(RecordingLocation, PathBuf)> {
    // The name of a run may contain dots, but it does not have the extension of a recording.
    let is_name = recording.components().count() == 1
        && recording.extension().is_none_or(|ending| ending != FINISHED_ENDING);
    // With a service on another machine, local files are not considered. A directory with the name of a run is not
    // considered either: it contains the results that `identify calibrate` has computed from the run.
    if (recording.is_file() || !is_name) && !service.is_elsewhere() {
        return Ok((RecordingLocation::File(recording.to_owned()), recording.to_owned()));
    }
    let name = recording.to_string_lossy();
    let Some(line) = service.runs()?.into_iter().find(|line| line.name == name && line.verdict.is_some())
    else {
        bail!("no file and no finished run is called `{name}`; `ballbard runs` lists them")
    };
    let path_here = PathBuf::from(format!("{name}.mcap"));
    let source = if service.is_elsewhere() {
        RecordingLocation::Elsewhere(Box::new(line))
    } else {
        RecordingLocation::File(line.file)
    };
    Ok((source, path_here))
}
