//! Value of the option `--fault`.

use std::ffi::OsStr;
use std::str::FromStr;

use clap::builder::TypedValueParser;
use clap::{Arg, Command, Error};

use crate::segment::faults::{FAULT_INTERVAL, FAULTS, FaultWindow};

/// Parses a fault. For the value `list`, clap prints all faults as it prints a help: to standard output, with exit code 0.
#[derive(Debug, Clone, Copy)]
pub struct FaultParser;

impl TypedValueParser for FaultParser {
    type Value = FaultWindow;

    fn parse_ref(
        &self,
        command: &Command,
        argument: Option<&Arg>,
        value: &OsStr,
    ) -> Result<FaultWindow, Error> {
        if value == "list" {
            let list = format!("{}\n{FAULT_INTERVAL}", FAULTS.join("\n"));
            Command::new("list").override_help(list).try_get_matches_from(["list", "--help"])?;
        }
        FaultWindow::from_str.parse_ref(command, argument, value)
    }
}
