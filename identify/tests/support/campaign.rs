//! Sizes of campaigns. `.ci/run` evaluates a fraction of each campaign,
//! `.ci/campaigns` evaluates all cases (`CAMPAIGNS=full`).

/// Number of cases to evaluate: `part`, which must be at least a fifth of `full`, or all `full` cases.
pub fn size(part: u64, full: u64) -> u64 {
    assert!(5 * part >= full, "{part} of {full} cases is less than a fifth");
    if is_full() { full } else { part }
}

/// Distance between the cases to evaluate: 5, or 1 for all cases.
pub fn step() -> usize {
    if is_full() { 1 } else { 5 }
}

/// True if campaigns are evaluated at their full size.
pub fn is_full() -> bool {
    std::env::var_os("CAMPAIGNS").is_some_and(|size| size == "full")
}

/// Of `all` independent events with this probability, at least this number occurs, except in one campaign of 280.
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
