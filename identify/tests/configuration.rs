//! Checks that `config/identify.toml` contains the defaults of the program.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::path::Path;

use identify::calibrate::IdentifyConfig;
use shared::config;

use crate::support::repository;

#[test]
fn the_shipped_file_has_the_defaults_and_leaves_none_unsaid() {
    let path = repository("config/identify.toml");
    assert_eq!(config::load::<IdentifyConfig>(&path).unwrap(), IdentifyConfig::default());
    let shipped: toml::Table = std::fs::read_to_string(&path).unwrap().parse().unwrap();
    let unsaid = unsaid(&toml::Table::try_from(IdentifyConfig::default()).unwrap(), &shipped);
    assert!(unsaid.is_empty(), "{unsaid:?}");
}

#[test]
fn limits_of_the_preparation_that_decide_nothing_are_refused_with_their_range() {
    let told = |line: &str| {
        let read: Result<IdentifyConfig, _> =
            config::parse(&format!("[prepare]\n{line}\n"), Path::new("identify.toml"));
        read.map_or_else(|error| error.to_string(), |_| String::new())
    };
    for (line, key, range) in [
        ("points_max = 5", "prepare.points_max", "100 or more, or 0 for all"),
        ("overlap_min_part = 5.0", "prepare.overlap_min_part", "from 0 to 1"),
        ("singular_margin_deg = 100.0", "prepare.singular_margin_deg", "from 0 to 60"),
        ("correlation_min = nan", "prepare.correlation_min", "from 0 to 1"),
        ("moving_average_ms = -1.0", "prepare.moving_average_ms", "from 0 to 10000"),
    ] {
        let text = told(line);
        assert!(text.contains("line 2") && text.contains(key) && text.contains(range), "{line}: {text}");
    }
    for line in ["points_max = 0", "points_max = 300", "joint_travel_min_deg = 0.0", ""] {
        assert_eq!(told(line), "", "{line}");
    }
}

#[test]
fn a_parameter_is_free_or_fixed_and_not_both() {
    let text = "free = [\"rd3\"]\nfix = [\"ra1\", \"rd3\"]\n";
    let error = config::parse::<IdentifyConfig>(text, Path::new("identify.toml")).unwrap_err().to_string();
    assert!(error.contains("`fix[1]`") && error.contains("`rd3` is also in `free`"), "{error}");
    let text = "free = [\"rd3\"]\n[priors]\nrd3 = 0.1\n";
    let error = config::parse::<IdentifyConfig>(text, Path::new("identify.toml")).unwrap_err().to_string();
    assert!(error.contains("`priors.rd3`") && error.contains("`rd3` is also in `free`"), "{error}");
}

#[test]
fn an_unknown_parameter_is_refused_where_the_file_names_it() {
    for (text, key) in [("free = [\"rd33x\"]\n", "free[0]"), ("[priors]\nrd33x = 1.0\n", "priors.rd33x")] {
        let error =
            config::parse::<IdentifyConfig>(text, Path::new("identify.toml")).unwrap_err().to_string();
        assert!(error.contains(key) && error.contains("no parameter is called `rd33x`"), "{error}");
    }
}

/// Keys of `all` that are missing in `said`, with the names of their tables.
fn unsaid(all: &toml::Table, said: &toml::Table) -> Vec<String> {
    let absent = |(key, value): (&String, &toml::Value)| match (value, said.get(key)) {
        (toml::Value::Table(all), Some(toml::Value::Table(said))) => {
            unsaid(all, said).iter().map(|inner| format!("{key}.{inner}")).collect()
        }
        (_, Some(_)) => Vec::new(),
        (_, None) => vec![key.clone()],
    };
    all.iter().flat_map(absent).collect()
}
