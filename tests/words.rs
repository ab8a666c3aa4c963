//! Checks that no page of the book, help text or comment contains a word of `docs/words.toml`.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "tests")]

use std::path::Path;

use serde::Deserialize;

use crate::documents::{files_below, repository};

/// The content of `docs/words.toml`.
#[derive(Deserialize)]
struct List {
    word: Vec<Word>,
}

#[derive(Deserialize)]
struct Word {
    /// Words or phrases that are forbidden, in lower case.
    not: Vec<String>,
    write: String,
    /// Phrases in which a forbidden word is permitted.
    #[serde(default)]
    allow: Vec<String>,
}

impl Word {
    /// The first forbidden word in the text. The text consists of lower-case words, each between two spaces.
    fn in_text(&self, text: &str) -> Option<&str> {
        let right =
            self.allow.iter().fold(text.to_owned(), |text, right| text.replace(&format!(" {right} "), "  "));
        self.not.iter().find(|not| right.contains(&format!(" {not} "))).map(String::as_str)
    }
}

/// The text of a line that readers see. In a document, this is the whole line. In code, it is a comment, if the comment has
/// a line of its own.
fn prose<'l>(file: &Path, line: &'l str) -> &'l str {
    let mark = match file.extension().and_then(|ending| ending.to_str()) {
        Some("rs") => "//",
        Some("toml") => "#",
        _ => return line,
    };
    line.trim_start().strip_prefix(mark).unwrap_or_default()
}

/// The words of a text in lower case, each between two spaces. Code between backticks is left out.
fn words(text: &str) -> String {
    let outside: Vec<&str> = text.split('`').step_by(2).collect();
    let lower = outside.join(" ` ").to_lowercase();
    let words: Vec<&str> = lower.split(|letter: char| !letter.is_alphanumeric() && letter != '`').collect();
    format!(" {} ", words.join(" ").split_whitespace().collect::<Vec<_>>().join(" "))
}

#[test]
fn no_document_help_text_or_comment_has_a_word_of_the_list() {
    let list: List =
        toml::from_str(&std::fs::read_to_string(repository("docs/words.toml")).unwrap()).unwrap();
    let mut found = Vec::new();
    let folders = ["config", "daemon", "docs", "identify", "shared", "tests"].map(repository);
    let pages = ["README.md", "ARCHITECTURE.md", "CHANGELOG.md", "CONTRIBUTING.md"].map(repository);
    for file in folders.iter().flat_map(|folder| files_below(folder, &["md", "rs", "toml"])).chain(pages) {
        if file.ends_with("docs/words.toml") {
            continue;
        }
        let text = std::fs::read_to_string(&file).unwrap();
        for (number, line) in (1..).zip(text.lines()) {
            let text = words(prose(&file, line));
            let hits = list.word.iter().filter_map(|word| Some((word.in_text(&text)?, &word.write)));
            found.extend(
                hits.map(|(not, write)| format!("{}:{number}: not `{not}` but {write}", file.display())),
            );
        }
    }
    assert!(found.is_empty(), "{} words of docs/words.toml:\n{}", found.len(), found.join("\n"));
}
