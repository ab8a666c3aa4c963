//! Parses faults from text. An option of the command line may contain times (`lost:0.01`, `gone:3@10s-15s`,
//! `safe-op:2,0x001a@5s`). A command that switches a fault of a running segment contains none (`on gone:3`, `off gone:3`).

use std::str::FromStr;
use std::time::Duration;

use super::{Fault, MisplacedFault};

/// A fault with its interval. Times are counted from the first frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FaultWindow {
    /// The fault to inject.
    pub fault: Fault,
    /// Begin \[ns\].
    pub from_ns: i64,
    /// End \[ns\]. `None` if the fault is permanent.
    pub until_ns: Option<i64>,
}

impl FaultWindow {
    /// Checks that all faults have an effect on a bus with this number of terminals.
    ///
    /// # Errors
    /// [`MisplacedFault`] if a fault is at a position where it has no effect.
    pub fn ensure_effective(windows: &[Self], terminals: usize) -> Result<(), MisplacedFault> {
        let is_misplaced = windows.iter().any(|window| window.fault.is_misplaced(terminals));
        if is_misplaced { Err(MisplacedFault) } else { Ok(()) }
    }
}

/// A command that begins or ends a fault immediately.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FaultSwitch {
    /// The fault to switch.
    pub fault: Fault,
    /// True if the fault begins, false if it ends.
    pub on: bool,
}

/// The faults, as they are written, for messages.
pub const FAULTS: [&str; 15] = [
    "lost:SHARE",
    "late:SHARE,TIME",
    "duplicated:SHARE",
    "corrupted:SHARE",
    "short:SHARE,BY",
    "noise:POSITION,SHARE",
    "gone:POSITION",
    "safe-op:POSITION,CODE",
    "no-signal:POSITION",
    "too-fast:POSITION",
    "abort:POSITION,CODE",
    "silent:POSITION",
    "emergency:POSITION,CODE",
    "link-down",
    "clock-step:TIME",
];
/// How the interval of a fault is written, for messages.
pub const FAULT_INTERVAL: &str =
    "each may be followed by @FROM or @FROM-UNTIL, times since the first frame, such as gone:3@10s-15s";

/// Error: the text is neither a fault nor a switch. The message quotes the text.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "`{0}` is not a fault; write one of {faults}; {FAULT_INTERVAL}; to switch a fault now, write `on` or `off` \
     before it, and no times",
    faults = FAULTS.join(", ")
)]
pub struct InvalidFault(String);

impl FromStr for FaultWindow {
    type Err = InvalidFault;

    fn from_str(text: &str) -> Result<Self, InvalidFault> {
        parse_window(text).ok_or_else(|| InvalidFault(text.to_owned()))
    }
}

impl FromStr for FaultSwitch {
    type Err = InvalidFault;

    fn from_str(text: &str) -> Result<Self, InvalidFault> {
        parse_switch(text).ok_or_else(|| InvalidFault(text.to_owned()))
    }
}

fn parse_switch(text: &str) -> Option<FaultSwitch> {
    let (on, fault) = match text.trim().split_once(' ')? {
        ("on", fault) => (true, fault),
        ("off", fault) => (false, fault),
        _ => return None,
    };
    Some(FaultSwitch { fault: parse_fault(fault.trim())?, on })
}

fn parse_window(text: &str) -> Option<FaultWindow> {
    let (fault, times) = text.split_once('@').map_or((text, None), |(fault, times)| (fault, Some(times)));
    let (from_ns, until_ns) = match times {
        None => (0, None),
        Some(times) => match times.split_once('-') {
            None => (parse_time_ns(times)?, None),
            Some((from, until)) => (parse_time_ns(from)?, Some(parse_time_ns(until)?)),
        },
    };
    if until_ns.is_some_and(|until_ns| until_ns <= from_ns) {
        return None;
    }
    Some(FaultWindow { fault: parse_fault(fault)?, from_ns, until_ns })
}

fn parse_fault(text: &str) -> Option<Fault> {
    let (name, values) = text.split_once(':').unwrap_or((text, ""));
    let values: Vec<&str> = values.split(',').filter(|value| !value.is_empty()).collect();
    let fault = match (name, &values[..]) {
        ("lost", [share]) => Fault::FrameLost { share: parse_share(share)? },
        ("late", [share, by]) => Fault::FrameLate { share: parse_share(share)?, by_ns: parse_time_ns(by)? },
        ("duplicated", [share]) => Fault::FrameDuplicated { share: parse_share(share)? },
        ("corrupted", [share]) => Fault::FrameCorrupted { share: parse_share(share)? },
        ("short", [share, by]) => {
            Fault::WorkingCounterShort { share: parse_share(share)?, by: by.parse().ok()? }
        }
        ("noise", [position, share]) => {
            Fault::NoisyCable { position: position.parse().ok()?, share: parse_share(share)? }
        }
        ("gone", [from]) => Fault::DevicesGone { from: from.parse().ok()? },
        ("safe-op", [position, code]) => {
            Fault::FallToSafeOp { position: position.parse().ok()?, code: parse_code(code)?.try_into().ok()? }
        }
        ("no-signal", [position]) => Fault::SignalLost { position: position.parse().ok()? },
        ("too-fast", [position]) => Fault::SignalTooFast { position: position.parse().ok()? },
        ("abort", [position, code]) => {
            Fault::MailboxAbort { position: position.parse().ok()?, code: parse_code(code)? }
        }
        ("silent", [position]) => Fault::MailboxSilent { position: position.parse().ok()? },
        ("emergency", [position, code]) => Fault::MailboxEmergency {
            position: position.parse().ok()?,
            code: parse_code(code)?.try_into().ok()?,
        },
        ("link-down", []) => Fault::LinkDown,
        ("clock-step", [by]) => match by.strip_prefix('-') {
            Some(back) => Fault::ClockStep { by_ns: -parse_time_ns(back)? },
            None => Fault::ClockStep { by_ns: parse_time_ns(by)? },
        },
        _ => return None,
    };
    Some(fault)
}

fn parse_share(text: &str) -> Option<f64> {
    text.parse().ok().filter(|share| (0.0..=1.0).contains(share))
}

fn parse_code(text: &str) -> Option<u32> {
    match text.strip_prefix("0x") {
        Some(hexadecimal) => u32::from_str_radix(hexadecimal, 16).ok(),
        None => text.parse().ok(),
    }
}

fn parse_time_ns(text: &str) -> Option<i64> {
    let time: Duration = humantime::parse_duration(text).ok()?;
    i64::try_from(time.as_nanos()).ok()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn faults_parse_from_their_text() {
        let always = |fault| Ok(FaultWindow { fault, from_ns: 0, until_ns: None });
        assert_eq!("lost:0.25".parse(), always(Fault::FrameLost { share: 0.25 }));
        assert_eq!("late:1,15ms".parse(), always(Fault::FrameLate { share: 1.0, by_ns: 15_000_000 }));
        assert_eq!("clock-step:-3ms".parse(), always(Fault::ClockStep { by_ns: -3_000_000 }));
        assert_eq!(
            "safe-op:2,0x001a@5s".parse(),
            Ok(FaultWindow {
                fault: Fault::FallToSafeOp { position: 2, code: 0x1a },
                from_ns: 5_000_000_000,
                until_ns: None
            })
        );
        assert_eq!(
            "gone:3@10s-15s".parse(),
            Ok(FaultWindow {
                fault: Fault::DevicesGone { from: 3 },
                from_ns: 10_000_000_000,
                until_ns: Some(15_000_000_000)
            })
        );
    }

    #[test]
    fn an_invalid_fault_is_refused_with_the_list_of_valid_ones() {
        for text in
            ["", "lost", "lost:2", "lost:NaN", "gone:-1", "gone:1@5s-5s", "link-down:1", "safe-op:1,0x10000"]
        {
            let refused = text.parse::<FaultWindow>().unwrap_err().to_string();
            assert!(refused.starts_with(&format!("`{text}`")) && refused.contains("clock-step:TIME"));
        }
    }

    #[test]
    fn a_fault_at_a_position_without_effect_is_detected() {
        let is_misplaced = |text: &str| text.parse::<FaultWindow>().unwrap().fault.is_misplaced(5);
        for text in ["gone:6", "noise:6,0.1", "no-signal:6", "no-signal:0", "too-fast:0", "safe-op:0,0x1a"] {
            assert!(is_misplaced(text), "{text}");
        }
        for text in ["abort:0,0x08000022", "silent:0", "emergency:0,0xff00"] {
            assert!(is_misplaced(text), "{text}");
        }
        for text in ["gone:5", "gone:0", "noise:0,0.1", "no-signal:1", "emergency:5,0xff00", "lost:1"] {
            assert!(!is_misplaced(text), "{text}");
        }
    }

    #[test]
    fn a_line_switches_a_fault_on_and_off() {
        let fault = Fault::DevicesGone { from: 3 };
        assert_eq!("on gone:3".parse(), Ok(FaultSwitch { fault, on: true }));
        assert_eq!("  off  gone:3 ".parse(), Ok(FaultSwitch { fault, on: false }));
        for text in ["gone:3", "on", "on gone", "maybe gone:3", "on gone:3@1s-2s", "on gone:3@0s"] {
            assert!(text.parse::<FaultSwitch>().is_err(), "{text}");
        }
    }

    proptest! {
        #[test]
        fn any_text_is_a_fault_or_refused(text in "[a-z-]{0,10}:?[0-9a-fx.,@s-]{0,20}") {
            let _ = text.parse::<FaultWindow>();
        }
    }
}
