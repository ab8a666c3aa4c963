//! Errors that can occur while the bus is brought up.

use std::fmt;

use ethercrab::error::Error as EtherCatError;
use shared::recording::schema::DeviceInfo;

use crate::problem::{Fact, Problem};

/// Why the bus cannot be brought up.
#[derive(Debug)]
pub struct BusError {
    fact: Box<Fact>,
    /// Whether the error is that no device processed a frame. A lost reply can cause this error, because the stack then
    /// reads the mailbox a second time and finds it empty.
    pub(super) may_be_a_lost_reply: bool,
}

impl BusError {
    /// The error in the form in which it is reported.
    pub fn fact(&self) -> &Fact {
        &self.fact
    }

    /// Converts an error of the stack. `describe` converts the text of the error to the form in which it is reported.
    pub(super) fn of_stack(error: EtherCatError, describe: impl FnOnce(String) -> Fact) -> Self {
        let may_be_a_lost_reply = matches!(error, EtherCatError::WorkingCounter { .. });
        Self { fact: Box::new(describe(error.to_string())), may_be_a_lost_reply }
    }
}

impl From<Fact> for BusError {
    fn from(fact: Fact) -> Self {
        Self { fact: Box::new(fact), may_be_a_lost_reply: false }
    }
}

impl fmt::Display for BusError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        Problem::from((*self.fact).clone()).fmt(f)
    }
}

impl std::error::Error for BusError {}

/// For `map_err`: describes an error of the stack, with the activity `doing` during which it occurred.
pub(super) fn while_doing(doing: &'static str) -> impl Fn(EtherCatError) -> BusError {
    move |error| BusError::of_stack(error, |error| Fact::BusStackFailed { doing: doing.into(), error })
}

/// The error for devices that differ from the expected ones. `position` is the first position at which they differ.
pub(super) fn wrong_devices(position: usize, expected: Vec<String>, found: Vec<String>) -> Fact {
    if position == found.len() {
        Fact::BusDeviceMissing { position, expected, found }
    } else if position == expected.len() {
        Fact::BusDeviceUnexpected { position, expected, found }
    } else {
        Fact::BusDeviceWrong { position, expected, found }
    }
}

/// The error if the number `answering` of devices that answer on `bus` differs from that of `devices`, which were all in
/// operation before. If fewer devices answer, the last ones are missing. If more answer, devices were added.
pub fn absent(bus: &str, devices: &[DeviceInfo], answering: usize) -> Fact {
    let name = |device: &DeviceInfo| device.name.clone();
    let added = std::iter::repeat_n("another device".into(), answering.saturating_sub(devices.len()));
    if answering == 0 {
        return Fact::BusNoAnswer { bus: bus.to_owned() };
    }
    wrong_devices(
        answering.min(devices.len()),
        devices.iter().map(name).collect(),
        devices.iter().take(answering).map(name).chain(added).collect(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn devices_that_came_or_went_are_named_by_position_and_with_what_to_do() {
        let device = |position| DeviceInfo {
            position,
            name: format!("device{position}"),
            vendor_id: 2,
            product_code: 1,
            revision: 1,
            serial: 0,
        };
        let devices: Vec<_> = (0..3).map(device).collect();
        let text = |answering| Problem::from(absent("eth9", &devices, answering)).to_string();
        assert!(text(0).contains("answers on eth9") && text(0).contains("cabled"), "{}", text(0));
        let all = "expected [device0, device1, device2]";
        let gone = text(1);
        assert!(gone.contains("terminal 1 and all behind it do not answer") && gone.contains(all), "{gone}");
        assert!(gone.contains("found [device0]; check the power of terminal 1 (bus position 1)"), "{gone}");
        let more = text(4);
        assert!(more.contains("terminal 3 is not configured") && more.contains(all), "{more}");
        assert!(
            more.contains("device2, another device]") && more.contains("remove these terminals"),
            "{more}"
        );
    }
}
