//! EL5021, the SinCos terminal with one encoder and a 32-bit counter. At each sync event it samples the source (`counter`)
//! and writes its inputs (`mapping`). The master reads and changes its settings through objects (`objects`).

mod counter;
mod mapping;
mod objects;

use counter::Counter;

use super::VENDOR;
use crate::chip::al::AlState;
use crate::chip::coe::ObjectDictionary;
use crate::chip::eeprom::{General, Image, SiiHeader};
use crate::chip::{ChipProfile, ExpectedSyncManager, SyncMode};
use crate::node::{Device, SignalFault, SyncStep};
use crate::source::{Conversion, EncoderSource, Signal};

const PRODUCT: u32 = 0x139d_3052;
/// Registers 0x0000 to 0x0009: chip type, its revision and build, 3 FMMUs, 4 sync managers, 4 kB, two E-bus ports, features
/// 0x01FC. These features mean a 64-bit distributed clock with SYNC signals.
const INFORMATION: [u8; 10] = [0x11, 0x00, 0x02, 0x00, 3, 4, 4, 0x0a, 0xfc, 0x01];
const CONFIGURATION: [u16; 4] = [0x0c05, 0x0c8c, 0x0000, 0x0000];
/// The terminal supports SDO and SDO information. PDO assignment and PDO configuration are fixed.
const GENERAL: General = General { coe_details: 0x03, e_bus_current_ma: 130, ports: 0x0033 };
const COE_AND_FOE: u16 = 0x000c;
/// Use of the FMMUs: outputs, inputs, mailbox state.
const FMMU_USES: [u8; 3] = [1, 2, 3];

const OUTPUTS_LEN: u16 = 6;
const INPUTS_LEN: u16 = 10;
/// Sync managers for mailbox out, mailbox in, outputs and inputs. Addresses and control bytes were copied from other encoder
/// terminals of the EL5xxx family.
const SYNC_MANAGERS: [ExpectedSyncManager; 4] = [
    ExpectedSyncManager { start: 0x1000, length: 128, control: 0x26 },
    ExpectedSyncManager { start: 0x1080, length: 128, control: 0x22 },
    ExpectedSyncManager { start: 0x1100, length: OUTPUTS_LEN, control: 0x24 },
    ExpectedSyncManager { start: 0x1180, length: INPUTS_LEN, control: 0x20 },
];
/// Time for conversion, calculation and copy into the input buffer \[ns\].
const DATA_READY_NS: i64 = 28_000;

/// Frequency of the signal during the fault "too fast" \[Hz\]. It is higher than the limit of any interpolation.
const TOO_FAST_HZ: f64 = 400e3;

/// Revisions of the terminal, as in the device description file.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum Revision {
    /// 0x00100000: sync error, TxPDO state and toggle are not in object 0x6000.
    R16,
    /// 0x00110000: like revision 16.
    R17,
    /// 0x00120000: like revision 16.
    R18,
    /// 0x00130000: sync error, TxPDO state and toggle are in object 0x6000.
    R19,
    /// 0x00140000: like revision 19.
    #[default]
    R20,
    /// 0x00150000: like revision 19.
    R21,
    /// 0x00160000: also measures frequency.
    R22,
}

impl Revision {
    /// The revision with this short number, 16 to 22.
    pub fn from_number(number: u8) -> Option<Self> {
        let all = [Self::R16, Self::R17, Self::R18, Self::R19, Self::R20, Self::R21, Self::R22];
        all.get(usize::from(number.checked_sub(16)?)).copied()
    }

    /// The revision number that the terminal reports.
    pub fn number(self) -> u32 {
        (16 + self as u32) << 16
    }

    fn measures_frequency(self) -> bool {
        self >= Self::R22
    }

    fn firmware(self) -> &'static str {
        if self.measures_frequency() { "07" } else { "05" }
    }
}

/// Numbers of events, which the terminal reports for diagnosis.
#[derive(Default)]
struct Diagnosis {
    sync_missed: u16,
    sync_error: bool,
    frequency_errors: u16,
    amplitude_errors: u16,
}

/// A SinCos terminal with one encoder.
#[derive(Default)]
pub struct El5021 {
    channel: usize,
    revision: Revision,
    counter: Counter,
    sync_mode: SyncMode,
    diagnosis: Diagnosis,
    signal_fault: Option<SignalFault>,
    inputs: mapping::Inputs,
    outputs: mapping::Outputs,
}

impl El5021 {
    /// A terminal that was just powered up. Terminals have the channels 0, 1, ... in order after the coupler.
    pub fn new(channel: usize, revision: Revision) -> Self {
        Self { channel, revision, ..Self::default() }
    }

    fn diagnose(&mut self, step: &SyncStep<'_>) {
        let supervised = self.sync_mode == SyncMode::DistributedClock && step.state == AlState::Op;
        self.diagnosis.sync_error = supervised && step.event.missed > 0;
        if supervised {
            let missed = u16::try_from(step.event.missed).unwrap_or(u16::MAX);
            self.diagnosis.sync_missed = self.diagnosis.sync_missed.saturating_add(missed);
        }
    }

    fn count_errors(&mut self, before: mapping::Inputs) {
        let count = |counter: &mut u16, was: bool, is: bool| {
            *counter = counter.saturating_add(u16::from(is && !was));
        };
        let now = self.inputs;
        count(&mut self.diagnosis.frequency_errors, before.frequency_error, now.frequency_error);
        count(&mut self.diagnosis.amplitude_errors, before.amplitude_error, now.amplitude_error);
    }
}

impl Device for El5021 {
    fn chip(&self) -> ChipProfile {
        let [mailbox_out, mailbox_in, ..] = SYNC_MANAGERS;
        let header = SiiHeader {
            configuration: CONFIGURATION,
            vendor: VENDOR,
            product: PRODUCT,
            revision: self.revision.number(),
            mailbox: [
                mailbox_out.start,
                mailbox_out.length,
                mailbox_in.start,
                mailbox_in.length,
                COE_AND_FOE,
            ],
        };
        let names = ["EL5021", "EL5021 1K. SinCos Encoder Interface 1Vpp", "MeasuringModules"];
        let (outputs_channel, inputs_channel) = (2, 3);
        let image = Image::new(&header, names, &GENERAL)
            .fmmus(&FMMU_USES)
            .sync_managers(&SYNC_MANAGERS)
            .tx_pdo(mapping::TX_PDO, inputs_channel, &mapping::tx_entries(self.revision))
            .rx_pdo(mapping::RX_PDO, outputs_channel, &mapping::rx_entries());
        ChipProfile {
            information: INFORMATION,
            eeprom: image.finish(),
            eight_byte_reads: true,
            sync_managers: Some(SYNC_MANAGERS),
            data_ready_ns: DATA_READY_NS,
        }
    }

    fn step(&mut self, step: SyncStep<'_>, source: &mut dyn EncoderSource) {
        self.diagnose(&step);
        // In SAFE-OP, safe outputs replace the received ones. Safe outputs contain no requests.
        self.outputs = match step.state {
            AlState::Op => mapping::Outputs::decode(step.outputs),
            _ => mapping::Outputs::default(),
        };
        let at = Conversion { true_time_ns: step.event.true_ns, system_time_ns: step.event.system_ns };
        let signal = disturbed(source.signal(self.channel, at), self.signal_fault);
        let before = self.inputs;
        self.counter.convert(signal, &self.outputs, &mut self.inputs);
        self.count_errors(before);
        self.inputs.sync_error = self.diagnosis.sync_error;
        // Every event inverts the toggle bit, even if the master never read its data.
        self.inputs.toggle ^= step.event.count % 2 == 1;
        self.inputs.encode(step.inputs);
    }

    fn set_signal_fault(&mut self, fault: Option<SignalFault>) {
        self.signal_fault = fault;
    }

    fn synchronise(&mut self, mode: SyncMode) {
        self.sync_mode = mode;
    }

    fn power_cycle(&mut self) {
        let counter = Counter::after_power_cycle();
        // A fault of the cable remains when the device is powered off and on.
        *self = Self { counter, signal_fault: self.signal_fault, ..Self::new(self.channel, self.revision) };
    }

    fn objects(&mut self) -> Option<&mut dyn ObjectDictionary> {
        Some(self)
    }
}

fn disturbed(mut signal: Signal, fault: Option<SignalFault>) -> Signal {
    if let Signal::Turning { amplitude, periods_per_s, .. } = &mut signal {
        match fault {
            Some(SignalFault::Lost) => *amplitude = 0.0,
            Some(SignalFault::TooFast) => *periods_per_s = TOO_FAST_HZ,
            None => {}
        }
    }
    signal
}
