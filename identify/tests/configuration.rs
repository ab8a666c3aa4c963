//! What `config/identify.toml` says of the program.
#![allow(clippy::unwrap_used, reason = "tests")]

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

/// Keys of `all` that `said` does not have.
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
