//! Sizes of campaigns. `.ci/run` evaluates a fraction of each campaign. `.ci/campaigns`
//! evaluates all cases (`CAMPAIGNS=full`).

/// Number of cases to evaluate. At full size it is `full`, otherwise `part`, which must be at least a fifth of `full`.
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

/// Number of events that occur at least, if each of `all` independent events has this probability. In one
/// campaign of 280, fewer occur by chance.
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
