//! Prepares runs of a minute with options as they are written in a configuration file.

use std::path::Path;

use identify::calibrate::IdentifyConfig;
use identify::prepare::{Prepared, prepare};
use identify::simulate::{self, Design, Effects, Experiment, Simulated};
use shared::config;

use super::{bar, irb2400};

pub fn run(effects: Effects) -> Simulated {
    let (robot, bar) = (irb2400(), bar());
    let design = Design { duration_s: 60.0, ..Design::for_robot(&robot) };
    simulate::run(&Experiment { effects, design, ..Experiment::new(&robot, &bar) }).unwrap()
}

/// Prepares the run. `options` is the text below `[prepare]` in the file.
pub fn prepared(run: &Simulated, options: &str) -> Prepared {
    let text = format!("[prepare]\n{options}\n");
    let config: IdentifyConfig = config::parse(&text, Path::new("identify.toml")).unwrap();
    prepare(&run.cycles, &run.encoders, &run.robot_log, &irb2400(), &bar(), &config.prepare).unwrap()
}
