//! Tests of the format of recordings, of configuration files, and of the drawing of the bar. They form one program.

mod support;

mod configuration;
mod drawing;
mod leftovers;
mod recording;
mod recovery;
mod run_file;
