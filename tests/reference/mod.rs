//! Generates pages and pictures of the book from programs, configuration files and tables. The tests fail if the committed
//! files differ from the generated text.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

mod commands;
mod configuration;
mod http_api;
mod parameters;

use crate::documents::repository;

/// Environment variable. If it is set, the tests write the pages instead of comparing them.
const WRITE: &str = "WRITE_REFERENCE";
/// The command that writes all generated pages.
const RENEW: &str = "WRITE_REFERENCE=1 cargo test -p system-tests --test all reference";

/// Longest line of prose \[characters\].
const WIDTH: usize = 120;

/// Wraps lines of prose. Tables, headings and code are not changed.
fn wrapped(text: &str) -> String {
    let options = textwrap::Options::new(WIDTH).word_splitter(textwrap::WordSplitter::NoHyphenation);
    let mut is_code = false;
    let lines = text.lines().map(|line| {
        is_code ^= line.starts_with("```");
        let is_prose = !is_code && !line.starts_with(['|', '#']);
        if is_prose { textwrap::fill(line, &options) } else { line.to_owned() }
    });
    lines.map(|line| line + "\n").collect()
}

/// Compares a page with its generated content, or writes the page if [`WRITE`] is set.
fn check(name: &str, title: &str, source: &str, content: &str) {
    let head = format!(
        "# {title}\n\nGenerated from {source}; do not edit. To write it again:\n\n```sh\n{RENEW}\n```\n"
    );
    check_file(&format!("reference/{name}"), &wrapped(&format!("{head}\n{}", content.trim())));
}

/// Compares a file of the book with its generated text, or writes the file if [`WRITE`] is set.
fn check_file(name: &str, text: &str) {
    let path = repository("docs/src").join(name);
    if std::env::var_os(WRITE).is_some() {
        std::fs::write(&path, text).expect("a writable file");
    }
    let committed = std::fs::read_to_string(&path).unwrap_or_default();
    let mut lines = committed.lines().zip(text.lines());
    let difference = lines.find(|(committed, generated)| committed != generated);
    assert!(
        committed == text,
        "{name} is out of date; renew it with {RENEW}\nfirst difference: {difference:?}"
    );
}

#[test]
fn the_picture_of_the_bar_shows_that_of_the_configuration() {
    let bar = shared::config::load(&repository("config/ball_bar.toml")).unwrap();
    check_file("pictures/ball_bar.svg", &shared::drawing::ball_bar_file(&bar));
}
