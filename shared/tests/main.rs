//! Tests of the recording's format and of configuration files, in one program.

mod support;

mod configuration;
mod leftovers;
mod recording;
mod recovery;
mod run_file;
