//! Section on the content of recordings and robot logs: one table for each file, from its inspection.
//! Missing information is emphasised.

use std::path::PathBuf;

use maud::{Markup, html};

use crate::inspect::curves::JointTrace;
use crate::inspect::{Inspection, UNSAID};

/// Largest number of facts of one file on the page. A long run may have thousands of events.
const FACTS_MAX: usize = 24;

/// One log of a run, and the result of its inspection.
#[derive(Debug, Clone, PartialEq)]
pub struct InspectedLog {
    /// Role of the file, such as `recording`.
    pub role: &'static str,
    /// Path of the file.
    pub path: PathBuf,
    /// Result of the inspection.
    pub inspection: Inspection,
    /// Joint positions over time. Empty if the page does not draw them.
    pub curves: Vec<JointTrace>,
}

/// Tables with the content of the files, side by side.
pub(in crate::report::page) fn section(sources: &[InspectedLog]) -> Markup {
    html! { @if !sources.is_empty() {
        h2 { "Content of the logs, and missing information" }
        div.columns.sources { @for source in sources { (facts(source)) } }
    } }
}

/// Facts of one file as rows of a table, at most [`FACTS_MAX`] of them.
pub(in crate::report::page) fn rows(facts: &[(String, String)]) -> Markup {
    html! {
        @for (what, value) in facts.iter().take(FACTS_MAX) {
            tr.unsaid[what == UNSAID] { td { (what) } td.text { (value) } }
        }
        @if facts.len() > FACTS_MAX {
            tr { td { "…" } td.text { (facts.len() - FACTS_MAX) " more: " code { "identify inspect" } } }
        }
    }
}

/// Table with the content of one file. Missing information is emphasised.
fn facts(source: &InspectedLog) -> Markup {
    let Inspection { facts, suspicious, .. } = &source.inspection;
    html! {
        table {
            caption { (source.role) ": " (source.path.display()) }
            tbody {
                (rows(facts))
                @for sentence in suspicious { tr.unsaid { td { "suspicious" } td.text { (sentence) } } }
            }
        }
    }
}
