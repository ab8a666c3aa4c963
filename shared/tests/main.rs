//! Tests of the recording's format, of configuration files and of the drawing, in one program.

mod support;

mod configuration;
mod drawing;
mod leftovers;
mod recording;
mod recovery;
mod run_file;
