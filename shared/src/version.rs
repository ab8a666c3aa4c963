//! Version of both programs, with the commit from which they were built.

use std::sync::LazyLock;

use chrono::DateTime;

/// Number of digits of the commit's hash in the version. It would be enough for a repository with a
/// thousand times as many commits.
const HASH_DIGITS: usize = 10;
/// Value of `BUILD_STATE`, set by `build.rs`, for a build that is not a release.
const DEBUG_BUILD: &str = "debug build";

/// The version with commit and date, such as `0.1.0 (56eed98a1b 2026-11-26)`. If the program is a debug build, or was built
/// from modified files, the parentheses also contain this.
pub fn version() -> &'static str {
    static VERSION: LazyLock<String> = LazyLock::new(|| {
        described(env!("CARGO_PKG_VERSION"), env!("COMMIT_HASH"), env!("COMMIT_TIME_S"), env!("BUILD_STATE"))
    });
    &VERSION
}

/// Name of a program with its [`version`], as stored in files that it writes.
pub fn software(program: &str) -> String {
    format!("{program} {}", version())
}

fn described(version: &str, hash: &str, time_s: &str, state: &str) -> String {
    let date = time_s.parse().ok().and_then(|seconds| DateTime::from_timestamp(seconds, 0));
    let date = date.map(|date| date.format("%Y-%m-%d").to_string());
    let commit = [hash.get(..HASH_DIGITS).unwrap_or(hash), date.as_deref().unwrap_or("")].join(" ");
    // In a debug build, `build.rs` does not run again after each commit, so the code may be newer than the commit.
    let state = if state == DEBUG_BUILD && !hash.is_empty() { "or later, debug build" } else { state };
    let details: Vec<&str> = [commit.trim(), state].into_iter().filter(|part| !part.is_empty()).collect();
    if details.is_empty() { version.to_owned() } else { format!("{version} ({})", details.join(", ")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HASH: &str = "56eed98a1b2c3d4e5f60718293a4b5c6d7e8f901";

    #[test]
    fn a_version_has_commit_and_date_where_they_are_known() {
        assert_eq!(described("0.1.0", HASH, "1795651200", ""), "0.1.0 (56eed98a1b 2026-11-26)");
        assert_eq!(
            described("0.1.0", HASH, "1795651200", "modified"),
            "0.1.0 (56eed98a1b 2026-11-26, modified)"
        );
        assert_eq!(
            described("0.1.0", HASH, "1795651200", "debug build"),
            "0.1.0 (56eed98a1b 2026-11-26, or later, debug build)"
        );
        assert_eq!(described("0.1.0", "", "", "debug build"), "0.1.0 (debug build)");
        assert_eq!(described("0.1.0", "", "1795651200", ""), "0.1.0 (2026-11-26)");
        assert_eq!(described("0.1.0", "", "yesterday", ""), "0.1.0");
    }
}
