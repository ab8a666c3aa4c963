//! Sizes of campaigns. `.ci/run` runs a part of each, `.ci/campaigns` all of it (`CAMPAIGNS=full`).

/// Cases to run: `part`, which is at least a fifth, or all `full` of them.
pub fn size(part: u64, full: u64) -> u64 {
    assert!(5 * part >= full, "{part} of {full} cases is less than a fifth");
    if is_full() { full } else { part }
}

/// Every fifth of a campaign's cases, or all of them.
pub fn step() -> usize {
    if is_full() { 1 } else { 5 }
}

/// Whether campaigns run at their full size.
pub fn is_full() -> bool {
    std::env::var_os("CAMPAIGNS").is_some_and(|size| size == "full")
}

/// Number of `all` independent events of this probability that occur at least, except in one campaign of 280.
pub fn fewest(all: u64, probability: f64) -> u64 {
    let mut of_count = (1.0 - probability).powi(i32::try_from(all).unwrap());
    let (mut count, mut below) = (0, 0.0);
    while below + of_count < 1.0 / 280.0 {
        below += of_count;
        of_count *= (all - count) as f64 / (count + 1) as f64 * probability / (1.0 - probability);
        count += 1;
    }
    count
}
