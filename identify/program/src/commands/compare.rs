//! `identify compare` tests whether calibrations of one robot agree ([`Consistency`]), prints a table and writes a page.

use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use shared::output::{say, show};

use crate::report::Consistency;
use crate::report::result::file::CalibrationFile;
use crate::report::side_by_side;

#[derive(Debug, Args)]
pub struct CompareArguments {
    /// Directories of two or more calibrations, or their calibration.json files
    #[arg(required = true, num_args = 2.., value_name = "CALIBRATIONS")]
    calibrations: Vec<PathBuf>,
    /// File for a page with figures
    #[arg(long, help_heading = "Output", value_name = "FILE.html")]
    out: Option<PathBuf>,
}

pub fn run(arguments: &CompareArguments) -> anyhow::Result<()> {
    let files: Vec<CalibrationFile> =
        arguments.calibrations.iter().map(|path| CalibrationFile::open(path)).collect::<Result<_, _>>()?;
    let mut pairs = (0..files.len()).flat_map(|second| (0..second).map(move |first| (first, second)));
    if let Some((first, second)) = pairs.find(|(first, second)| files[*first] == files[*second]) {
        anyhow::bail!(
            "{} and {} are the same calibration; give those of two measurements",
            arguments.calibrations[first].display(),
            arguments.calibrations[second].display()
        );
    }
    let consistency = Consistency::new(&files)?;
    let name = |(path, file): (&PathBuf, &CalibrationFile)| {
        let simulated = if file.is_simulated() { ", SIMULATED" } else { "" };
        format!("{} ({}, {}{simulated})", path.display(), file.solve.cost, file.created)
    };
    let names: Vec<String> = arguments.calibrations.iter().zip(&files).map(name).collect();
    show(side_by_side::table(&consistency, &names))?;
    if let Some(out) = &arguments.out {
        let robot = files.first().map_or("", |file| file.robot.as_str());
        let text = side_by_side::page(&consistency, robot, &names).into_string();
        std::fs::write(out, text).with_context(|| format!("cannot write {}", out.display()))?;
        say(out.display())?;
    }
    Ok(())
}
