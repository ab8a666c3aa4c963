//! Section on the content of recordings and robot logs, with missing information: tables of their inspections.

use std::path::PathBuf;

use maud::{Markup, html};

use crate::inspect::curves::JointTrace;
use crate::inspect::{Inspection, UNSAID};

/// Facts of one file that the page shows; a long run may have thousands of events.
const FACTS_MAX: usize = 24;

/// One log of a run and what is in it.
#[derive(Debug, Clone, PartialEq)]
pub struct InspectedLog {
    /// Such as `recording`.
    pub role: &'static str,
    /// Path of its file.
    pub path: PathBuf,
    /// Its content.
    pub inspection: Inspection,
    /// Its joints over time; empty if the page does not draw them.
    pub curves: Vec<JointTrace>,
}

/// Content of the files, side by side.
pub(in crate::report::page) fn section(sources: &[InspectedLog]) -> Markup {
    html! { @if !sources.is_empty() {
        h2 { "Content of the logs, and missing information" }
        div.columns.sources { @for source in sources { (facts(source)) } }
    } }
}

/// Facts of one file, as rows of a table.
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

/// Content of one file; missing information is emphasised.
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
