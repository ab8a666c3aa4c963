//! Checks that the documents agree with the programs in links, commands, fields, flags, parameters and limits.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

use clap::Parser;
use identify::model::ParameterId;
use shared::recording::schema::flags;

pub(crate) fn repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

fn text(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap()
}

fn page(name: &str) -> String {
    text(&repository("docs/src").join(name))
}

/// Files below a folder that have one of these endings. Build output and files of other projects are excluded.
pub(crate) fn files_below(folder: &Path, endings: &[&str]) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let is_foreign = |path: &Path| ["target", "ogl", "uplot"].iter().any(|name| path.ends_with(name));
    let (folders, files): (Vec<_>, Vec<_>) =
        entries.filter(|path| !is_foreign(path)).partition(|path| path.is_dir());
    let has_ending = |path: &PathBuf| {
        path.extension().is_some_and(|ending| endings.iter().any(|wanted| ending == *wanted))
    };
    let below = folders.iter().flat_map(|folder| files_below(folder, endings));
    files.into_iter().filter(has_ending).chain(below).collect()
}

/// Targets of the links in a Markdown text.
fn links(text: &str) -> impl Iterator<Item = &str> {
    text.split("](").skip(1).filter_map(|rest| rest.split_once(')').map(|(link, _)| link))
}

/// Anchors of the headings of a page. If a heading contains `{#name}`, its anchor is `name`. Otherwise mdBook derives the
/// anchor from the text of the heading.
fn anchors(text: &str) -> BTreeSet<String> {
    let mut is_code = false;
    let headings = text.lines().filter(|line| {
        is_code ^= line.starts_with("```");
        !is_code && line.starts_with('#')
    });
    let mut anchors = BTreeSet::new();
    for heading in headings.map(|line| line.trim_start_matches('#').trim()) {
        let named = heading.split_once("{#").and_then(|(_, name)| name.strip_suffix('}'));
        let anchor: String =
            named.map_or_else(|| heading.chars().filter_map(of_anchor).collect(), str::to_owned);
        // If a heading occurs more than once, a number is added to its anchor.
        let again = (1..).map(|number| format!("{anchor}-{number}"));
        let mut names = std::iter::once(anchor.clone()).chain(again);
        anchors.extend(names.find(|name| !anchors.contains(name)));
    }
    anchors
}

/// The character of an anchor that mdBook writes for this character of a heading. `None` if mdBook drops the character.
fn of_anchor(character: char) -> Option<char> {
    match character {
        _ if character.is_whitespace() => Some('-'),
        '_' | '-' => Some(character),
        _ => character.is_alphanumeric().then(|| character.to_ascii_lowercase()),
    }
}

#[test]
fn every_link_between_documents_leads_to_a_place_and_the_summary_has_every_page() {
    let book = repository("docs/src");
    let of_book = files_below(&book, &["md"]);
    let others = ["README.md", "ARCHITECTURE.md", "CHANGELOG.md", "CONTRIBUTING.md"].map(repository);
    for page in others.iter().chain(&of_book) {
        let text = text(page);
        for link in links(&text).filter(|link| !link.contains("://")) {
            let (file, anchor) = link.split_once('#').unwrap_or((link, ""));
            let target = if file.is_empty() { page.clone() } else { page.with_file_name(file) };
            assert!(target.exists(), "{}: {link}", page.display());
            let has_anchor = || anchors(&self::text(&target)).contains(anchor);
            assert!(anchor.is_empty() || has_anchor(), "{}: {link}", page.display());
        }
    }
    let summary = page("SUMMARY.md");
    for page in of_book.iter().filter_map(|page| page.strip_prefix(&book).ok()?.to_str()) {
        assert!(page == "SUMMARY.md" || summary.contains(&format!("]({page})")), "{page}");
    }
}

/// Lines of the shell blocks of a Markdown text. A line that ends in a backslash is joined with the next line.
fn shell_lines(text: &str) -> Vec<String> {
    let blocks = text.split("```sh\n").skip(1).filter_map(|rest| rest.split_once("\n```"));
    blocks
        .flat_map(|(block, _)| block.replace("\\\n", " ").lines().map(str::to_owned).collect::<Vec<_>>())
        .collect()
}

/// Splits a shell line into commands, and each command into words. Quotes join words, a comment ends the line, and the loop
/// variable `$k` becomes 1.
pub(crate) fn commands(line: &str) -> Vec<Vec<String>> {
    let mut commands = vec![Vec::new()];
    let (mut word, mut quote) = (None::<String>, None);
    for character in line.chars().chain([' ']) {
        match character {
            '"' | '\'' if quote.is_none() => {
                (quote, word) = (Some(character), Some(word.unwrap_or_default()))
            }
            _ if quote == Some(character) => quote = None,
            '#' if quote.is_none() && word.is_none() => break,
            ' ' | '&' | '|' | ';' | '>' if quote.is_none() => {
                commands.last_mut().unwrap().extend(word.take().map(|word| word.replace("$k", "1")));
                if character != ' ' {
                    commands.push(Vec::new());
                }
            }
            _ => word.get_or_insert_default().push(character),
        }
    }
    commands
}

#[test]
fn every_command_in_a_shell_block_of_a_document_is_one_that_the_programs_accept() {
    let mut count = 0;
    let readme = repository("README.md");
    for page in files_below(&repository("docs/src"), &["md"]).iter().chain([&readme]) {
        for line in shell_lines(&text(page)) {
            for words in commands(&line) {
                let program = words.first().and_then(|word| word.rsplit('/').next()).unwrap_or_default();
                let accepted = match program {
                    "identify" => {
                        identify::commands::IdentifyArguments::from_words(words.iter().map(OsString::from))
                            .map(drop)
                    }
                    "ballbard" => ballbard::commands::Arguments::try_parse_from(&words).map(drop),
                    _ => continue,
                };
                // The parser returns help and version as errors, but these go to standard output.
                if let Err(error) = accepted {
                    assert!(!error.use_stderr(), "{}: {line}\n{error}", page.display());
                }
                count += 1;
            }
        }
    }
    assert!(count > 50, "{count} commands");
}

#[test]
fn the_page_on_recordings_names_every_field_and_flag_of_a_cycle() {
    let page = page("reference/recording.md");
    for (bit, name) in flags::NAMES {
        assert!(page.contains(&format!("| `{name}` | {} |", bit.trailing_zeros())), "{name}");
    }
    let schema = text(&repository("shared/src/recording/messages/bus_cycle.ros2msg"));
    let own = schema.split("====").next().unwrap_or_default();
    for line in own.lines().map(|line| line.split('#').next().unwrap_or_default().trim()) {
        // Lines with `=` are constants, which are the flags. They are checked above.
        let Some((_, field)) = line.split_once(' ').filter(|(_, field)| !field.contains('=')) else {
            continue;
        };
        assert!(page.contains(&format!("`{field}")), "{field}");
    }
}

#[test]
fn the_page_on_the_method_names_every_kind_of_parameter() {
    let page = page("explanation/method.md");
    for name in ParameterId::all().map(|id| id.to_string()) {
        let kind = name.split(|character: char| character.is_ascii_digit()).next().unwrap_or_default();
        // The page uses the name of a vector's first coordinate for the whole vector.
        let first =
            kind.strip_suffix(['y', 'z']).map_or_else(|| kind.to_owned(), |vector| format!("{vector}x"));
        assert!(page.contains(kind) || page.contains(&first), "{name}");
    }
}

#[test]
fn the_page_on_judgements_has_the_numbers_of_the_program_and_every_key_of_the_configuration() {
    let page = page("reference/judgements.md");
    let constants = page.lines().filter_map(|line| {
        let mut cells = line.split('|').map(|cell| cell.trim().trim_matches('`'));
        let (_, name, value, file) = (cells.next()?, cells.next()?, cells.next()?, cells.next()?);
        file.ends_with(".rs").then_some((name, value, file))
    });
    let mut count = 0;
    for (name, value, file) in constants {
        let of_program = text(&repository(file));
        let begin = format!("const {name}: ");
        let mut definitions = of_program.lines().filter_map(|line| line.find(&begin).map(|at| &line[at..]));
        let defined = definitions.any(|line| line.ends_with(&format!(" = {value};")));
        assert!(defined, "{file}: const {name} = {value}");
        count += 1;
    }
    assert!(count > 0);
    let shipped: toml::Table = toml::from_str(&text(&repository("config/identify.toml"))).unwrap();
    let limits =
        |key: &String| ["_min", "_max", "_tolerance", "_margin"].iter().any(|part| key.contains(part));
    for key in shipped["prepare"].as_table().unwrap().keys().filter(|key| limits(key) && *key != "points_max")
    {
        assert!(page.contains(&format!("`{key}`")), "{key}");
    }
}
