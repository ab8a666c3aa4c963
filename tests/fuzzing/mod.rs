//! Fuzz targets. Each [`Target`] takes arbitrary bytes and panics if a guarantee is violated.
//!
//! `cargo fuzz` (`tests/fuzz`, needs nightly) and the ordinary test `corpus` call the same functions. The test runs them on
//! all saved inputs. `corpus.rs` describes the directories of these inputs, and how new inputs are saved. Each target also
//! formats the error message, because formatting must not fail either.

mod api;
mod bar_log;
mod bring_up;
mod calibration;
mod config;
mod corpus;
mod cycle;
mod force_log;
mod input;
mod joint_states;
mod pose_table;
mod recording;
mod replies;
mod robot_log;
mod segment;

pub use corpus::unpack;
use input::UnusedBytes;

/// A function under test, which takes bytes from an external source. Also its inputs.
pub struct Target {
    /// Name of the fuzz target and of its saved inputs.
    pub name: &'static str,
    /// Takes arbitrary bytes; panics if a guarantee is violated.
    pub run: fn(&[u8]),
    /// Returns the seeds: well-formed inputs with which fuzzing starts.
    pub seeds: fn() -> Vec<Vec<u8>>,
}

/// All fuzz targets, at least one for each type of external input.
pub const TARGETS: &[Target] = &[
    Target { name: "recording", run: recording::any_bytes, seeds: recording::whole_and_cut },
    Target { name: "recording_content", run: recording::any_content, seeds: recording::contents },
    Target { name: "segment_frames", run: segment::any_frames, seeds: segment::frames },
    Target { name: "segment_mailbox", run: segment::any_requests, seeds: segment::requests },
    Target { name: "bus_replies", run: bring_up::any_replies, seeds: bring_up::scripts },
    Target { name: "cycle_replies", run: cycle::any_replies, seeds: cycle::scripts },
    Target { name: "config", run: config::any_text, seeds: config::shipped },
    Target { name: "robot_log_table", run: robot_log::any_table, seeds: robot_log::tables },
    Target { name: "robot_log_mcap", run: robot_log::any_mcap, seeds: robot_log::mcap_bags },
    Target { name: "robot_log_db3", run: robot_log::any_db3, seeds: robot_log::sqlite_bags },
    Target { name: "robot_log_egm", run: robot_log::any_egm, seeds: robot_log::egm_messages },
    Target { name: "robot_log_rsi", run: robot_log::any_rsi, seeds: robot_log::telegrams },
    Target { name: "bar_log_table", run: bar_log::any_file, seeds: bar_log::tables },
    Target { name: "bar_log_bag", run: bar_log::any_file, seeds: bar_log::bags },
    Target { name: "pose_table", run: pose_table::any_table, seeds: pose_table::tables },
    Target { name: "force_log", run: force_log::any_table, seeds: force_log::tables },
    Target { name: "calibration", run: calibration::any_text, seeds: calibration::files },
    Target { name: "api", run: api::any_requests, seeds: api::requests },
];

/// Runs the target with this name on these bytes.
pub fn run(name: &str, bytes: &[u8]) {
    let target = TARGETS.iter().find(|target| target.name == name).expect("a target of that name");
    (target.run)(bytes);
}

/// Checks that the message of an error has a text.
fn explained(error: &dyn std::fmt::Display) {
    assert!(error.to_string().len() > 10, "an error without words");
}
