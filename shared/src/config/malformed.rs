//! Messages on keys that cannot be read, and the lines of keys.

use toml::de::{DeTable, DeValue};

/// Similarity from which an unknown name is taken as a typing error (Jaro and Winkler; 1 is the same).
const ALIKE: f64 = 0.8;

/// The line of a place in a text, from 1.
fn line_at(text: &str, place: usize) -> Option<usize> {
    Some(text.get(..place)?.matches('\n').count() + 1)
}

/// The line where a text stops being TOML, from 1.
pub(super) fn line_of_syntax(text: &str, error: &toml::de::Error) -> Option<usize> {
    line_at(text, error.span()?.start)
}

/// The message on a text that is not TOML at `line`, from 1.
pub(super) fn syntax_message(text: &str, line: Option<usize>, error: &toml::de::Error) -> String {
    let value = || Some(text.lines().nth(line?.checked_sub(1)?)?.split_once('=')?.1.trim_start());
    // Names and paths, such as arm or ../run.mcap.
    let is_unquoted =
        value().is_some_and(|value| value.starts_with(|c: char| c.is_alphabetic() || "./~".contains(c)));
    let hint = if text.trim_start().starts_with('<') {
        "; if it is a URDF, `identify robot import` makes a robot's file from it"
    } else if is_unquoted {
        "; text needs quotes, such as \"arm\""
    } else {
        ""
    };
    format!("this is not TOML: {}{hint}", error.message().trim_end())
}

/// The line that a message of serde on `key` is about, from 1: of an unknown key its own, of a missing key that of its table;
/// `None` if it concerns the whole file.
pub(super) fn line(text: &str, key: &str, original: &str) -> Option<usize> {
    match names(original)[..] {
        [wrong, ..] if original.starts_with("unknown field") => line_of(text, &in_table(key, wrong)),
        _ => line_of(text, key),
    }
}

/// The names between backquotes in a message of serde.
fn names(original: &str) -> Vec<&str> {
    original.split('`').skip(1).step_by(2).collect()
}

/// The dotted path of a name in a message on `key`, which is the table of the name or the name itself.
fn in_table(key: &str, name: &str) -> String {
    match key.rsplit_once('.') {
        Some((table, last)) if last == name => format!("{table}.{name}"),
        _ if matches!(key, "." | "") || key == name => name.to_owned(),
        _ => format!("{key}.{name}"),
    }
}

/// The line of a key by its dotted path, from 1, or of the part of the path that is there; `None` if no part is.
pub(super) fn line_of(text: &str, key: &str) -> Option<usize> {
    let root = DeValue::Table(DeTable::parse(text).ok()?.into_inner());
    let (mut value, mut place) = (&root, None);
    for part in key.split(['.', '[', ']']).filter(|part| !part.is_empty()) {
        let found = match value {
            DeValue::Table(table) => {
                let mut entries = table.iter();
                entries.find(|(name, _)| name.get_ref() == part).map(|(name, value)| (name.span(), value))
            }
            DeValue::Array(array) => {
                let index = part.parse().ok();
                index.and_then(|index: usize| array.get(index)).map(|value| (value.span(), value))
            }
            _ => None,
        };
        let Some((span, next)) = found else { break };
        (place, value) = (Some(span.start), next.get_ref());
    }
    line_at(text, place?)
}

/// The known name that was probably meant by a wrong one.
pub fn nearest<'a>(wrong: &str, known: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    let wrong = wrong.to_lowercase();
    let similarities = known.map(|name| (strsim::jaro_winkler(&wrong, &name.to_lowercase()), name));
    let nearest = similarities.max_by(|(a, _), (b, _)| a.total_cmp(b));
    nearest.filter(|(similarity, _)| *similarity >= ALIKE).map(|(_, name)| name)
}

/// The sentence about `key`, its dotted path, from a message of serde or toml, which puts names between backquotes.
pub(super) fn message(key: &str, original: &str) -> String {
    let meant = |wrong: &str, known: &[&str]| super::did_you_mean(wrong, known.iter().copied());
    match names(original).as_slice() {
        [wrong, known @ ..] if original.starts_with("unknown field") => {
            let (key, meant) = (in_table(key, wrong), meant(wrong, known));
            format!("unknown key `{key}`{meant} Keys here: {}", known.join(", "))
        }
        [wrong, known @ ..] if original.starts_with("unknown variant") => {
            let meant = meant(wrong, known);
            format!("key `{key}` cannot be `{wrong}`{meant} It is one of: {}", known.join(", "))
        }
        [missing] if original.starts_with("missing field") => {
            format!("key `{}` is missing; add it", in_table(key, missing))
        }
        // The text of serde has a name of the program.
        _ if original.starts_with("data did not match any variant") => format!(
            "key `{key}`: its value has an unknown form; the comment above it in the shipped file (config/) lists the forms"
        ),
        _ if original.starts_with("invalid type: map, expected a sequence") => {
            format!("key `{key}` is a list of tables; write [[{key}]] above each, not [{key}]")
        }
        _ => format!("key `{key}`: {}", original.trim_end()),
    }
}
