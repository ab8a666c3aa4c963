//! Logs when a problem of the bus, an encoder or a link begins and ends, and counts how often each problem began. Problems
//! of the disk are logged by the storage, because the storage can also log while this thread waits.

use std::collections::BTreeMap;

use shared::time::MonoNs;

use crate::problem::{Fact, Problem};

/// The current problems, and how often each problem code began.
#[derive(Debug, Default)]
pub(super) struct ProblemLog {
    /// [Keys](Fact::key) of the current problems.
    active: Vec<(&'static str, usize)>,
    /// Start of each current outage, by the name of the bus or the encoder that delivers no samples.
    outages: BTreeMap<String, MonoNs>,
    began: BTreeMap<String, u64>,
}

impl ProblemLog {
    /// Updates the log with all current problems.
    pub fn update<'a>(&mut self, now: MonoNs, problems: impl Iterator<Item = &'a Problem>) {
        // These two problems occur at every start, so they are not counted.
        let is_fault =
            |problem: &&Problem| !matches!(*problem.fact, Fact::BusStarting {} | Fact::DiskRecovering { .. });
        let problems: Vec<&Problem> = problems.filter(is_fault).collect();
        // Count and log the problems that are new.
        for problem in problems.iter().filter(|problem| !self.active.contains(&problem.fact.key())) {
            *self.began.entry(problem.code().to_owned()).or_default() += 1;
            if let Some(subject) = logged_subject(problem) {
                tracing::warn!(code = problem.code(), "{subject}: {problem}");
            }
        }
        self.active = problems.iter().map(|problem| problem.fact.key()).collect();
        // Log the end of outages, and remember the start of new ones.
        let silent: Vec<String> = problems.iter().filter_map(|problem| silent_subject(problem)).collect();
        self.outages.retain(|subject, since| {
            let is_silent = silent.contains(subject);
            if !is_silent {
                let lasted_s = now.seconds_since(*since);
                tracing::info!("{subject}: samples again after {lasted_s:.1} s");
            }
            is_silent
        });
        for subject in silent {
            self.outages.entry(subject).or_insert(now);
        }
    }

    /// How often each problem began, by its code.
    pub fn began(&self) -> &BTreeMap<String, u64> {
        &self.began
    }
}

fn logged_subject(problem: &Problem) -> Option<String> {
    match *problem.fact {
        Fact::LinkErrors { .. } => Some("link".into()),
        _ => silent_subject(problem),
    }
}

/// Name of the bus or encoder whose samples are interrupted by the problem. The end of such a problem is logged, too. Error
/// counts of a link have no end, so the result for them is `None`.
fn silent_subject(problem: &Problem) -> Option<String> {
    match &*problem.fact {
        Fact::EncoderInvalid { joints, .. } => {
            joints.first().map(|joint| format!("encoder of joint {joint}"))
        }
        Fact::CycleStalled { .. } | Fact::InterfaceUnusable { .. } | Fact::ThreadEnded { .. } => {
            Some("bus".into())
        }
        fact => fact.code().starts_with("bus_").then(|| "bus".into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_problem_is_counted_once_until_it_is_over() {
        let (mut log, begun) = (ProblemLog::default(), MonoNs(0));
        let silent = |joint| -> Problem {
            Fact::EncoderInvalid { joints: vec![joint], status: None, valid_share: 0.0 }.into()
        };
        let bus: Problem = Fact::BusNoAnswer { bus: "eth1".into() }.into();
        let moments: [&[Problem]; 5] =
            [&[silent(2)], &[silent(2), silent(3)], std::slice::from_ref(&bus), &[], &[silent(2)]];
        for (second, problems) in (0..).zip(moments) {
            log.update(begun.plus_ns(second * 1_000_000_000), problems.iter());
        }
        let began: Vec<_> = log.began().iter().map(|(code, times)| (code.as_str(), *times)).collect();
        assert_eq!(began, [("bus_no_answer", 1), ("encoder_invalid", 3)]);
        assert_eq!(log.outages.len(), 1);
    }
}
