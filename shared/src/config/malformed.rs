//! Messages about keys that cannot be parsed, and line numbers of keys. The input is a message of serde or of the TOML
//! parser. The output is a message that names the key, a suggestion, and the allowed keys or values.

use toml::de::{DeTable, DeValue};

/// Smallest similarity of a wrong name to a known one at which a typing error is assumed (Jaro-Winkler; 1 for equal names).
const ALIKE: f64 = 0.8;

/// Line number of a position in a text, from 1. `place` is the position \[bytes\].
fn line_at(text: &str, place: usize) -> Option<usize> {
    Some(text.get(..place)?.matches('\n').count() + 1)
}

/// Number of the line at which a text stops being valid TOML, from 1.
pub(super) fn line_of_syntax(text: &str, error: &toml::de::Error) -> Option<usize> {
    line_at(text, error.span()?.start)
}

/// The message about a text that is not valid TOML. `line` is the number of the line with the error, from 1.
pub(super) fn syntax_message(text: &str, line: Option<usize>, error: &toml::de::Error) -> String {
    let value = || Some(text.lines().nth(line?.checked_sub(1)?)?.split_once('=')?.1.trim_start());
    // An unquoted value that starts like a name or path, such as arm or ../run.mcap.
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

/// Number of the line that a message of serde about `key` refers to, from 1. For an unknown key, this is the line of the
/// unknown key; for a missing key, that of its table. `None` if the message refers to the whole file.
pub(super) fn line(text: &str, key: &str, original: &str) -> Option<usize> {
    match names(original)[..] {
        [wrong, ..] if original.starts_with("unknown field") => line_of(text, &in_table(key, wrong)),
        _ => line_of(text, key),
    }
}

/// The names between backquotes in a message of serde: first the wrong or missing name, then the allowed names.
fn names(original: &str) -> Vec<&str> {
    original.split('`').skip(1).step_by(2).collect()
}

/// The dotted path of a name in a message about `key`. `key` is either the table that contains the name,
/// or the name's own path.
fn in_table(key: &str, name: &str) -> String {
    match key.rsplit_once('.') {
        Some((table, last)) if last == name => format!("{table}.{name}"),
        _ if matches!(key, "." | "") || key == name => name.to_owned(),
        _ => format!("{key}.{name}"),
    }
}

/// Line number of a key given by its dotted path, from 1. If the path exists only in part, the line of its last existing
/// key; `None` if not even the first exists.
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

/// The known name that is most similar to a wrong one, if it is similar enough for a typing error.
pub fn nearest<'a>(wrong: &str, known: impl Iterator<Item = &'a str>) -> Option<&'a str> {
    let wrong = wrong.to_lowercase();
    let similarities = known.map(|name| (strsim::jaro_winkler(&wrong, &name.to_lowercase()), name));
    let nearest = similarities.max_by(|(a, _), (b, _)| a.total_cmp(b));
    nearest.filter(|(similarity, _)| *similarity >= ALIKE).map(|(_, name)| name)
}

/// Converts a message of serde or toml into a sentence about `key`, a dotted path. Those
/// messages put names between backquotes.
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
