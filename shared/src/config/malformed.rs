//! Writes error messages for configurations that cannot be parsed. The input is a message of serde or of the TOML parser.
//! The output is a sentence that names the key, a similar known name, and the allowed keys or values. This module also finds
//! the line number of a key.

use toml::de::{DeTable, DeValue};

/// Minimum similarity (Jaro-Winkler, 1 for equal names) of a wrong name and a known name. At this similarity or above, the
/// wrong name is treated as a typing error.
const ALIKE: f64 = 0.8;

/// Number of the line, from 1, that contains the byte at the offset `place` of a text.
fn line_at(text: &str, place: usize) -> Option<usize> {
    Some(text.get(..place)?.matches('\n').count() + 1)
}

/// Number of the line, from 1, at which a text stops being valid TOML.
pub(super) fn line_of_syntax(text: &str, error: &toml::de::Error) -> Option<usize> {
    line_at(text, error.span()?.start)
}

/// The message about a text that is not valid TOML. `line` is the number of the line with the error, from 1.
pub(super) fn syntax_message(text: &str, line: Option<usize>, error: &toml::de::Error) -> String {
    let value = || Some(text.lines().nth(line?.checked_sub(1)?)?.split_once('=')?.1.trim_start());
    // Whether the value lacks its quotes: it begins like a name or path, such as arm or ../run.mcap.
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

/// Number of the line, from 1, that a message of serde about `key` refers to. If the key is unknown, it is the line of this
/// key; if a key is missing, the line of its table. `None` if the message refers to the whole file.
pub(super) fn line(text: &str, key: &str, original: &str) -> Option<usize> {
    match names(original)[..] {
        [wrong, ..] if original.starts_with("unknown field") => line_of(text, &in_table(key, wrong)),
        _ => line_of(text, key),
    }
}

/// The names between backquotes in a message of serde. The first is the wrong or missing name, the
/// others are the allowed names.
fn names(original: &str) -> Vec<&str> {
    original.split('`').skip(1).step_by(2).collect()
}

/// The dotted path of `name`, which a message about `key` contains. `key` is either the path of the table that contains the
/// name, or already the path of the name.
fn in_table(key: &str, name: &str) -> String {
    match key.rsplit_once('.') {
        Some((table, last)) if last == name => format!("{table}.{name}"),
        _ if matches!(key, "." | "") || key == name => name.to_owned(),
        _ => format!("{key}.{name}"),
    }
}

/// Number of the line, from 1, of the key with this dotted path. If only the beginning of the path exists, it is the line of
/// the last key that exists. `None` if not even the first key exists.
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

/// The known name that is most similar to a wrong name. `None` if the similarity is too low for a typing error.
pub fn nearest<'a>(wrong: &str, known: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    let wrong = wrong.to_lowercase();
    let similarities = known.map(|name| (strsim::jaro_winkler(&wrong, &name.to_lowercase()), name));
    let nearest = similarities.max_by(|(a, _), (b, _)| a.total_cmp(b));
    nearest.filter(|(similarity, _)| *similarity >= ALIKE).map(|(_, name)| name)
}

/// Converts a message of serde or toml into a sentence about `key`, a dotted path. The original
/// message contains names between backquotes.
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
        // The message of serde contains the name of a type in this program, so it is replaced.
        _ if original.starts_with("data did not match any variant") => format!(
            "key `{key}`: its value has an unknown form; the comment above it in the shipped file (config/) lists the forms"
        ),
        _ if original.starts_with("invalid type: map, expected a sequence") => {
            format!("key `{key}` is a list of tables; write [[{key}]] above each, not [{key}]")
        }
        _ => format!("key `{key}`: {}", original.trim_end()),
    }
}
