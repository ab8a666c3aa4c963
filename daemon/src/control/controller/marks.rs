//! The markers of the current run. The controller numbers the markers, so that all pages and commands use the same sequence.

use shared::recording::RunMark;
use shared::time::MonoNs;

/// Largest number of markers that a status contains. The file contains all markers.
const SHOWN_MAX: usize = 50;

/// Markers of one run.
#[derive(Debug, Default)]
pub(super) struct Marks {
    begun: MonoNs,
    /// Number of markers that got a number instead of a text.
    numbered: u32,
    latest: Vec<RunMark>,
}

impl Marks {
    /// Creates an empty list for a run that begins now.
    pub fn new(begun: MonoNs) -> Self {
        Self { begun, ..Self::default() }
    }

    /// Text of the next marker: `text`, or a number if there is no text.
    pub fn text(&self, text: Option<String>) -> String {
        text.unwrap_or_else(|| format!("mark {}", self.numbered + 1))
    }

    /// Adds a marker that has been written into the run.
    pub fn add(&mut self, at: MonoNs, text: String, is_numbered: bool) {
        self.numbered += u32::from(is_numbered);
        if self.latest.len() == SHOWN_MAX {
            self.latest.remove(0);
        }
        self.latest.push(RunMark { at_s: at.seconds_since(self.begun).max(0.0), text });
    }

    /// The latest markers, in the order in which they were set.
    pub fn latest(&self) -> Vec<RunMark> {
        self.latest.clone()
    }
}
