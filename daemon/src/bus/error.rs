//! Why the bus cannot be brought into operation, in words for the person beside it.

use std::fmt;

use ethercrab::error::Error as EtherCatError;
use ethercrab::{AlStatusCode, SubDeviceState};
use shared::recording::schema::DeviceInfo;

/// A device as it should be or as it was found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeviceName(pub String);

impl fmt::Display for DeviceName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// What to do about devices that are not those of the configuration.
fn remedy(position: usize, expected: &[DeviceName], found: &[DeviceName]) -> String {
    if position == found.len() {
        format!(
            "check the device at position {position}: its power, and that it and those behind it sit firmly on the one \
             before; if it was taken away, correct the list of encoders in ball_bar.toml"
        )
    } else if position == expected.len() {
        "add the encoders of the devices behind to ball_bar.toml, or take these devices away".into()
    } else {
        "correct the order of the terminals or the list of encoders in ball_bar.toml".into()
    }
}

fn list(devices: &[DeviceName]) -> String {
    if devices.is_empty() {
        return "nothing".into();
    }
    let names: Vec<_> = devices.iter().map(|device| device.0.as_str()).collect();
    names.join(", ")
}

/// Why the bus cannot be brought into operation.
#[derive(Debug, thiserror::Error)]
pub enum BusError {
    /// Nobody answers.
    #[error(
        "no EtherCAT device answers on {bus}; check that the coupler has power, that its upper (IN) socket is \
         cabled to this interface, and that the interface is up"
    )]
    NoAnswer {
        /// Interface, or `simulated`.
        bus: String,
    },
    /// Other devices, or another order, than configured.
    #[error(
        "bus position {position} differs from the configuration: expected [{}], found [{}]; \
         {}",
        list(expected),
        list(found),
        remedy(*position, expected, found)
    )]
    WrongDevices {
        /// First position that differs; the coupler is 0.
        position: usize,
        /// What the configuration asks for.
        expected: Vec<DeviceName>,
        /// What identified itself.
        found: Vec<DeviceName>,
    },
    /// A terminal does not take the interpolation.
    #[error(
        "terminal at position {position} interpolates {found} bits after {wanted} were written; \
         power the terminals off and on, or use a number of bits that its firmware offers"
    )]
    Interpolation {
        /// Position on the bus.
        position: usize,
        /// Bits asked for.
        wanted: u8,
        /// Bits read back.
        found: u32,
    },
    /// A terminal's process data have another length.
    #[error(
        "terminal at position {position} has {inputs} bytes of inputs and {outputs} of outputs instead of 10 and 6; \
         restore its default PDO assignment"
    )]
    ProcessData {
        /// Position on the bus.
        position: usize,
        /// Bytes of inputs.
        inputs: usize,
        /// Bytes of outputs.
        outputs: usize,
    },
    /// The reference clock gives no time.
    #[error(
        "the distributed clock stands still (time {time_ns} ns); the first device after this PC must be an EK1100 \
         with distributed clocks, or set `distributed_clocks = false` in daemon.toml and accept samples up to one cycle old"
    )]
    ClockStandsStill {
        /// Time read twice \[ns\].
        time_ns: u64,
    },
    /// A terminal's clock does not follow the reference.
    #[error(
        "the clock of the terminal at position {position} is {difference_ns} ns off the bus time and does not settle \
         within 1000 ns; power the terminals off and on, and replace that one if it stays so"
    )]
    ClockNotSettled {
        /// Position on the bus.
        position: usize,
        /// Register 0x092C \[ns\].
        difference_ns: i64,
    },
    /// A device refuses a state.
    #[error(
        "device at position {position} stays in {state} instead of {wanted}: AL status {code}; power the terminals off \
         and on, and replace that one if it stays so"
    )]
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
    #[error(
        "terminal at position {position}, while {doing}: {error}; power the terminals off and on, and replace that one \
         if it stays so"
    )]
    Terminal {
        /// Position on the bus.
        position: usize,
        /// What was being done.
        doing: &'static str,
        /// What the stack says.
        error: EtherCatError,
    },
    /// Anything else.
    #[error("EtherCAT, while {doing}: {error}; check cables, contacts and the terminals' power")]
    Stack {
        /// What was being done.
        doing: &'static str,
        /// What the stack says.
        error: EtherCatError,
    },
    /// By whoever ends the run or the program.
    #[error("stopped while the bus was brought up")]
    Interrupted,
    /// The stack gave up in a way that it should not.
    #[error("the EtherCAT stack failed unexpectedly: {0}")]
    Panicked(String),
}

impl BusError {
    /// Somebody had nothing more to say to a frame: what he said before was lost.
    pub(super) fn may_be_a_lost_reply(&self) -> bool {
        let (Self::Stack { error, .. } | Self::Terminal { error, .. }) = self else { return false };
        matches!(error, EtherCatError::WorkingCounter { .. })
    }

    /// Only the first `answering` of `devices`, which were all in operation before, answer on `bus`; more than all
    /// where further ones were added meanwhile.
    pub fn absent(bus: &str, devices: &[DeviceInfo], answering: usize) -> Self {
        let name = |device: &DeviceInfo| DeviceName(device.name.clone());
        let added =
            std::iter::repeat_n(DeviceName("another device".into()), answering.saturating_sub(devices.len()));
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
        assert!(gone.contains("bus position 1") && gone.contains(all), "{gone}");
        assert!(gone.contains("found [device0]; check the device at position 1"), "{gone}");
        let more = text(4);
        assert!(more.contains("bus position 3") && more.contains(all), "{more}");
        assert!(
            more.contains("device2, another device]") && more.contains("take these devices away"),
            "{more}"
        );
    }
}
