//! Why the bus cannot be brought into operation.

use std::fmt;

use ethercrab::error::Error as EtherCatError;
use ethercrab::{AlStatusCode, SubDeviceState};
use shared::recording::schema::DeviceInfo;

use crate::problem::{Fact, Problem};

/// Why the bus cannot be brought into operation.
#[derive(Debug)]
pub enum BusError {
    /// Nobody answers.
    NoAnswer {
        /// Interface, or `simulated`.
        bus: String,
    },
    /// Other devices, or another order, than configured.
    WrongDevices {
        /// First position that differs; the coupler is 0.
        position: usize,
        /// What the configuration asks for.
        expected: Vec<String>,
        /// What identified itself.
        found: Vec<String>,
    },
    /// A terminal does not take the interpolation.
    Interpolation {
        /// Position on the bus.
        position: usize,
        /// Bits asked for.
        wanted: u8,
        /// Bits read back.
        found: u32,
    },
    /// A terminal's process data have another length.
    ProcessData {
        /// Position on the bus.
        position: usize,
        /// Bytes of inputs.
        inputs: usize,
        /// Bytes of outputs.
        outputs: usize,
    },
    /// The reference clock gives no time.
    ClockStandsStill {
        /// Time read twice \[ns\].
        time_ns: u64,
    },
    /// A terminal's clock does not follow the reference.
    ClockNotSettled {
        /// Position on the bus.
        position: usize,
        /// Register 0x092C \[ns\].
        difference_ns: i64,
    },
    /// A device refuses a state.
    StateRefused {
        /// Position on the bus.
        position: usize,
        /// State that it is in.
        state: SubDeviceState,
        /// State that was asked for.
        wanted: &'static str,
        /// Why, as the device says.
        code: AlStatusCode,
    },
    /// A terminal does not take a setting.
    Terminal {
        /// Position on the bus.
        position: usize,
        /// What was being done.
        doing: &'static str,
        /// What the stack says.
        error: EtherCatError,
    },
    /// Anything else.
    Stack {
        /// What was being done.
        doing: &'static str,
        /// What the stack says.
        error: EtherCatError,
    },
    /// By whoever ends the run or the program.
    Interrupted,
    /// The stack gave up in a way that it should not.
    Panicked(String),
}

impl BusError {
    /// As it is reported.
    pub fn fact(&self) -> Fact {
        match self {
            Self::NoAnswer { bus } => Fact::BusNoAnswer { bus: bus.clone() },
            Self::WrongDevices { position, expected, found } => {
                let (position, expected, found) = (*position, expected.clone(), found.clone());
                if position == found.len() {
                    Fact::BusDeviceMissing { position, expected, found }
                } else if position == expected.len() {
                    Fact::BusDeviceUnexpected { position, expected, found }
                } else {
                    Fact::BusDeviceWrong { position, expected, found }
                }
            }
            Self::Interpolation { position, wanted, found } => {
                Fact::BusInterpolation { position: *position, wanted: *wanted, found: *found }
            }
            Self::ProcessData { position, inputs, outputs } => {
                Fact::BusProcessData { position: *position, inputs_bytes: *inputs, outputs_bytes: *outputs }
            }
            Self::ClockStandsStill { time_ns } => Fact::BusClockStopped { time_ns: *time_ns },
            Self::ClockNotSettled { position, difference_ns } => {
                Fact::BusClockUnsettled { position: *position, difference_ns: *difference_ns }
            }
            Self::StateRefused { position, state, wanted, code } => Fact::BusStateRefused {
                position: *position,
                state: state.to_string(),
                wanted: (*wanted).into(),
                al_status: code.to_string(),
            },
            Self::Terminal { position, doing, error } => Fact::BusSettingRefused {
                position: *position,
                doing: (*doing).into(),
                error: error.to_string(),
            },
            Self::Stack { doing, error } => {
                Fact::BusStackFailed { doing: (*doing).into(), error: error.to_string() }
            }
            Self::Interrupted => Fact::BusInterrupted {},
            Self::Panicked(error) => {
                Fact::BusStackFailed { doing: "it failed unexpectedly".into(), error: error.clone() }
            }
        }
    }

    /// Somebody had nothing more to say to a frame: what he said before was lost.
    pub(super) fn may_be_a_lost_reply(&self) -> bool {
        let (Self::Stack { error, .. } | Self::Terminal { error, .. }) = self else { return false };
        matches!(error, EtherCatError::WorkingCounter { .. })
    }

    /// Only the first `answering` of `devices`, which were all in operation before, answer on `bus`; more than all
    /// where further ones were added meanwhile.
    pub fn absent(bus: &str, devices: &[DeviceInfo], answering: usize) -> Self {
        let name = |device: &DeviceInfo| device.name.clone();
        let added = std::iter::repeat_n("another device".into(), answering.saturating_sub(devices.len()));
        match answering {
            0 => Self::NoAnswer { bus: bus.to_owned() },
            _ => Self::WrongDevices {
                position: answering.min(devices.len()),
                expected: devices.iter().map(name).collect(),
                found: devices.iter().take(answering).map(name).chain(added).collect(),
            },
        }
    }
}

impl fmt::Display for BusError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        Problem::from(self.fact()).fmt(f)
    }
}

impl std::error::Error for BusError {}

/// For `map_err`: what was being done when the stack failed.
pub(super) fn while_doing(doing: &'static str) -> impl Fn(EtherCatError) -> BusError {
    move |error| BusError::Stack { doing, error }
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
        let text = |answering| BusError::absent("eth9", &devices, answering).to_string();
        assert!(text(0).contains("answers on eth9") && text(0).contains("cabled"), "{}", text(0));
        let all = "expected [device0, device1, device2]";
        let gone = text(1);
        assert!(gone.contains("terminal 1 and all behind it do not answer") && gone.contains(all), "{gone}");
        assert!(gone.contains("found [device0]; check terminal 1 (bus position 1)"), "{gone}");
        let more = text(4);
        assert!(more.contains("terminal 3 is not configured") && more.contains(all), "{more}");
        assert!(
            more.contains("device2, another device]") && more.contains("take these devices away"),
            "{more}"
        );
    }
}
