//! Generates `configuration.md` from the files in `config/`. Their comments describe the keys.

use std::collections::HashSet;
use std::fmt::Write;
use std::mem::take;

use generate::page::cell;
use toml::{Table, Value};

use super::check;
use crate::documents::repository;

/// Units that can be at the end of a key.
const UNITS: &str = "hz s ms us mb m mm um deg rad mrad urad ppm per";
/// Longest value that the page shows in full \[characters\].
const VALUE_CHARS_MAX: usize = 60;

/// Type of a value, with the unit at the end of its key. Example: `mm, mrad` for the key `tolerance_mm_mrad`.
fn kind(key: &str, value: &Value) -> String {
    let kind = match value {
        Value::String(_) | Value::Datetime(_) => "text",
        Value::Integer(_) | Value::Float(_) => "number",
        Value::Boolean(_) => "true or false",
        Value::Array(_) => "list",
        Value::Table(_) => "table",
    };
    let units = key.rsplit('_').take_while(|part| UNITS.split(' ').any(|unit| unit == *part));
    let mut parts: Vec<&str> = units.chain([kind]).collect();
    parts.reverse();
    parts.join(", ").replace(", per, ", "/").replace(", hz", ", Hz").replace(", mb", ", MB")
}

/// A section of a configuration file. Blocks with the same title are combined in one section.
#[derive(Default)]
struct FileSection {
    title: String,
    about: String,
    rows: String,
    keys: HashSet<String>,
}

impl FileSection {
    /// Adds a comment that does not describe a key. Indented lines of the comment are an example.
    fn add_paragraph(&mut self, lines: &[String]) {
        let is_code = |line: &String| line.starts_with("    ");
        for part in lines.chunk_by(|one, next| is_code(one) == is_code(next)) {
            let text = part.join("\n");
            let text = if is_code(&part[0]) { format!("```text\n{text}\n```") } else { cell(&text) };
            let _ = writeln!(self.about, "\n{text}");
        }
    }

    fn add_key(&mut self, KeyEntry { key, value, text, is_set }: &KeyEntry, comment: &[String]) {
        if !self.keys.insert(key.clone()) {
            return;
        }
        let is_long = text.contains('\n') || text.chars().count() > VALUE_CHARS_MAX;
        let shown = if is_long { "...".to_owned() } else { format!("`{}`", text.replace('|', "\\|")) };
        let absent = if *is_set { "" } else { "absent, such as " };
        let meaning = cell(&comment.join(" "));
        let meaning = if meaning.is_empty() { "see above" } else { &meaning };
        let _ = writeln!(self.rows, "| `{key}` | {} | {absent}{shown} | {meaning} |", kind(key, value));
    }

    fn markdown(&self) -> String {
        let Self { title, about, rows, .. } = self;
        let title = if title.is_empty() { String::new() } else { format!("\n**`{title}`**\n") };
        let head = "\n| key | type, unit | in the file | meaning |\n|---|---|---|---|\n";
        if rows.is_empty() { format!("{title}{about}") } else { format!("{title}{about}{head}{rows}") }
    }
}

/// A key with its value. If the key is not set, it appears in a comment of the file.
struct KeyEntry {
    key: String,
    value: Value,
    text: String,
    is_set: bool,
}

impl KeyEntry {
    /// Parses the key of a line. `further` contains the following lines, because the value may continue there.
    fn parse<'t>(line: &'t str, is_set: bool, further: &mut impl Iterator<Item = &'t str>) -> Option<Self> {
        let (key, _) = line.split_once(" = ").filter(|(key, _)| !key.contains(char::is_whitespace))?;
        let mut text = line.to_owned();
        loop {
            if let Ok(table) = text.parse::<Table>() {
                let (key, value, text) =
                    (key.to_owned(), table.get(key)?.clone(), text[key.len() + 3..].to_owned());
                return Some(Self { key, value, text, is_set });
            }
            text = format!("{text}\n{}", if is_set { further.next()? } else { return None });
        }
    }
}

fn page(file: &str) -> String {
    let text = std::fs::read_to_string(repository("config").join(file)).unwrap();
    let (mut sections, mut at, mut comment) = (vec![FileSection::default()], 0, Vec::new());
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        let remark = line.strip_prefix('#').map(|remark| remark.strip_prefix(' ').unwrap_or(remark));
        let content = remark.unwrap_or(line);
        if content.starts_with('[') && content.ends_with(']') {
            let known = sections.iter().position(|section| section.title == content);
            at = known.unwrap_or(sections.len());
            if known.is_none() {
                sections.push(FileSection { title: content.to_owned(), ..FileSection::default() });
                sections[at].add_paragraph(&comment);
            }
            comment.clear();
        } else if let Some(entry) = KeyEntry::parse(content, remark.is_none(), &mut lines) {
            sections[at].add_key(&entry, &take(&mut comment));
        } else if let Some(remark) = remark {
            comment.push(remark.to_owned());
        } else {
            sections[at].add_paragraph(&take(&mut comment));
        }
    }
    format!("\n## config/{file}\n") + &sections.iter().map(FileSection::markdown).collect::<String>()
}

#[test]
fn the_page_on_configuration_has_every_key_and_comment_of_the_shipped_files() {
    let about = "\
Both programs refuse unknown keys, and suggest the most similar known key. The unit of a value is the ending of its key. The
column *in the file* shows the default; in mappings, tables and experiments it shows an example. If a key can be absent, the
column *meaning* states its default.
";
    let entries = std::fs::read_dir(repository("config")).unwrap();
    let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let mut files: Vec<String> = names.filter(|name| name.ends_with(".toml")).collect();
    files.sort();
    files.extend(["robots/irb2400_16.toml".to_owned(), "studies/thesis.toml".to_owned()]);
    let pages: String = files.iter().map(|file| page(file)).collect();
    let content = about.to_owned() + &pages;
    check("configuration.md", "Configuration files", "the comments of the files in `config/`", &content);
}
