//! Tests of the recording's format, in one program.

mod support;

mod leftovers;
mod recording;
mod recovery;
mod run_file;
