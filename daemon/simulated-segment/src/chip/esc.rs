//! The slave controller chip consists of one memory and several units. The registers of each unit are at fixed addresses of
//! the memory. The master reads and writes by device addresses, or by addresses of the logical process image. The device
//! behind the chip takes sync events and mailbox requests from the chip, and returns inputs and answers.

mod register_access;

use super::al::{AlMachine, AlState, Readiness};
use super::dc::{DistributedClock, LocalClock, Pulses};
use super::fmmu::{self, Fmmu, Mapped};
use super::registers as reg;
use super::sii::Sii;
use super::sync_manager::{self, Access, Completion, ExpectedSyncManager, Permit, SyncManager};

/// Numbers of the sync manager channels. They are the same in every device with a mailbox.
const MAILBOX_OUT: usize = 0;
const MAILBOX_IN: usize = 1;
const OUTPUTS: usize = 2;
const INPUTS: usize = 3;
/// Addresses of the registers with the number of FMMUs and of sync managers, set by [`ChipProfile::information`].
const FMMU_COUNT: usize = 0x0004;
const CHANNEL_COUNT: usize = 0x0005;
/// Time after which the processor behind the chip answers a mailbox request \[ns\].
const MAILBOX_ANSWER_NS: i64 = 300_000;

/// Watchdog registers and their values at power-up (ESC data sheet).
const WATCHDOG_DEFAULTS: [(u16, u16); 4] = [
    (reg::WATCHDOG_DIVIDER, 0x09c2),
    (reg::WATCHDOG_TIME_PDI, 0x03e8),
    (reg::WATCHDOG_TIME_PROCESS_DATA, 0x03e8),
    (reg::WATCHDOG_STATUS, 0x0001),
];

/// The chip of a device, and the settings that the device expects from a master.
pub struct ChipProfile {
    /// Content of the registers 0x0000 to 0x0009: type, revision, number of units, features.
    pub information: [u8; 10],
    pub eeprom: Vec<u8>,
    /// Whether the EEPROM interface reads eight bytes at a time.
    pub eight_byte_reads: bool,
    /// Settings of the sync managers: mailbox out, mailbox in, outputs, inputs. `None` for a device without a processor.
    pub sync_managers: Option<[ExpectedSyncManager; 4]>,
    /// Time from the start of a conversion until its result is available \[ns\].
    pub data_ready_ns: i64,
}

/// What starts the conversions of a device.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum SyncMode {
    /// Frames with outputs start conversions.
    #[default]
    SyncManager,
    /// SYNC0 pulses of the chip's clock start conversions.
    DistributedClock,
}

/// An event that starts a conversion of the device. Several events may have occurred since the last conversion was finished.
#[derive(Debug, Clone, Copy)]
pub struct SyncEvent {
    /// Number of events since the previous conversion. Only the last event is converted.
    pub count: u64,
    /// Number of these events that were not preceded by new outputs.
    pub missed: u64,
    /// True time of the last event.
    pub true_ns: i64,
    /// Nominal system time of the last event, if it is a SYNC0 pulse.
    pub system_ns: Option<i64>,
}

/// How the data that a command reads are combined with the content of its datagram.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum ReadMode {
    /// The data replace the content.
    Replace,
    /// The data are combined with the content by a bitwise or, as in broadcast reads.
    Or,
}

/// A slave controller: its memory, its units, and the times at which requests and outputs arrived.
pub struct Esc {
    memory: Box<[u8]>,
    sync_managers: [SyncManager; sync_manager::CHANNELS_MAX],
    fmmus: [Fmmu; fmmu::UNITS_MAX],
    expected: Option<[ExpectedSyncManager; 4]>,
    data_ready_ns: i64,
    al: AlMachine,
    clock: DistributedClock,
    sii: Sii,
    /// Time at which the current mailbox request arrived.
    request_at_ns: Option<i64>,
    /// Time at which outputs arrived whose conversion is not finished. `None` if there are none.
    outputs_at_ns: Option<i64>,
    /// Whether outputs have arrived since the last SYNC0 pulse.
    outputs_since_sync: bool,
    /// Whether outputs have arrived since PRE-OP.
    outputs_received: bool,
    /// Time at which the current frame returns from the devices after this one.
    back_ns: Option<i64>,
}

impl Esc {
    /// A chip that was just powered up.
    pub fn new(profile: ChipProfile, clock: LocalClock) -> Self {
        let al = if profile.sync_managers.is_some() { AlMachine::firmware() } else { AlMachine::emulated() };
        let mut esc = Self {
            memory: vec![0; reg::MEMORY_SIZE].into_boxed_slice(),
            sync_managers: Default::default(),
            fmmus: Default::default(),
            expected: profile.sync_managers,
            data_ready_ns: profile.data_ready_ns,
            al,
            clock: DistributedClock::new(clock),
            sii: Sii::new(profile.eeprom, profile.eight_byte_reads),
            request_at_ns: None,
            outputs_at_ns: None,
            outputs_since_sync: false,
            outputs_received: false,
            back_ns: None,
        };
        esc.put(reg::INFORMATION, &profile.information);
        let alias = esc.sii.alias();
        esc.put(reg::STATION_ALIAS, &alias);
        for (register, value) in WATCHDOG_DEFAULTS {
            esc.put(register, &value.to_le_bytes());
        }
        esc.block_process_data();
        esc
    }

    /// The local clock of this chip after a power cycle at `now_ns`.
    pub fn restarted_clock(&self, now_ns: i64) -> LocalClock {
        self.clock.restarted(now_ns)
    }

    /// Steps the local clock.
    pub fn step_clock(&mut self, now_ns: i64, step_ns: i64) {
        self.clock.step(now_ns, step_ns);
    }

    /// Changes the state of the device from OP to SAFE-OP, with this AL status code.
    pub fn fall_to_safe_op(&mut self, code: u16) {
        self.al.fall_to_safe_op(code);
    }

    /// Counts a frame with a wrong check sequence at port 0, as an invalid frame (0x0300) and as a receive error (0x0301).
    pub fn count_invalid_frame(&mut self) {
        self.count(reg::ERROR_COUNTERS);
        self.count(reg::ERROR_COUNTERS + 1);
    }

    /// Counts an invalid symbol that port 0 received between two frames.
    pub fn count_receive_error(&mut self) {
        self.count(reg::ERROR_COUNTERS + 1);
    }

    /// Counts a loss of the link at port 1.
    pub fn count_lost_link(&mut self) {
        self.count(reg::LOST_LINKS + 1);
    }

    fn count(&mut self, register: u16) {
        let [count] = self.get::<1>(register);
        self.put(register, &[count.saturating_add(1)]);
    }

    /// Whether the master has not read the last answer yet.
    pub fn is_answer_waiting(&self) -> bool {
        self.sync_managers[MAILBOX_IN].is_full()
    }

    /// Sets the register with the state of the ports.
    pub fn set_dl_status(&mut self, dl_status: u16) {
        self.put(reg::DL_STATUS, &dl_status.to_le_bytes());
    }

    /// Decides on a requested AL state, if the time for the decision has come. `back_ns` is the time at which the current
    /// frame returns from the devices after this one.
    pub fn advance(&mut self, now_ns: i64, back_ns: Option<i64>) {
        self.back_ns = back_ns;
        if self.al.is_due(now_ns) {
            let readiness = self.readiness(now_ns);
            self.al.decide(now_ns, &readiness);
            self.block_process_data();
            self.outputs_received &= self.al.state() >= AlState::SafeOp;
        }
    }

    /// Station address that the master has assigned.
    pub fn station_address(&self) -> u16 {
        u16::from_le_bytes(self.get(reg::STATION_ADDRESS))
    }

    pub fn state(&self) -> AlState {
        self.al.state()
    }

    pub fn sync_mode(&self) -> SyncMode {
        if self.clock.is_active() { SyncMode::DistributedClock } else { SyncMode::SyncManager }
    }

    /// Takes the sync event whose conversion is finished at `now_ns`. `None` if no conversion is finished.
    pub fn take_sync_event(&mut self, now_ns: i64) -> Option<SyncEvent> {
        match self.sync_mode() {
            SyncMode::DistributedClock => {
                self.outputs_at_ns = None;
                let pulses = self.clock.take_pulses(now_ns, self.data_ready_ns)?;
                Some(self.sync0_event(pulses))
            }
            SyncMode::SyncManager => {
                let true_ns =
                    self.outputs_at_ns.take_if(|at| at.saturating_add(self.data_ready_ns) <= now_ns)?;
                Some(SyncEvent { count: 1, missed: 0, true_ns, system_ns: None })
            }
        }
    }

    fn sync0_event(&mut self, pulses: Pulses) -> SyncEvent {
        let fresh = std::mem::take(&mut self.outputs_since_sync);
        let missed = if fresh { pulses.count - 1 } else { pulses.count };
        SyncEvent { count: pulses.count, missed, true_ns: pulses.true_ns, system_ns: Some(pulses.system_ns) }
    }

    /// The outputs, for the device to read.
    pub fn outputs(&self) -> &[u8] {
        self.expected.and_then(|all| self.memory.get(span(&all[OUTPUTS]))).unwrap_or_default()
    }

    /// The inputs, for the device to write.
    pub fn inputs_mut(&mut self) -> &mut [u8] {
        let Some(all) = self.expected else { return &mut [] };
        self.memory.get_mut(span(&all[INPUTS])).unwrap_or_default()
    }

    /// Takes a mailbox request for the device and returns its length. `None` if its answer is not due yet, or if the master
    /// has not read the last answer.
    pub fn take_request(&mut self, now_ns: i64, request: &mut [u8]) -> Option<usize> {
        let expected = self.expected?;
        if !self.sync_managers[MAILBOX_OUT].is_full() {
            self.request_at_ns = None; // the master switched the mailbox off
        }
        let due = self.request_at_ns?.saturating_add(MAILBOX_ANSWER_NS) <= now_ns;
        if !due || self.state() < AlState::PreOp || self.sync_managers[MAILBOX_IN].is_full() {
            return None;
        }
        self.request_at_ns = None;
        self.sync_managers[MAILBOX_OUT].set_full(false);
        let mailbox = self.memory.get(span(&expected[MAILBOX_OUT]))?;
        request.get_mut(..mailbox.len())?.copy_from_slice(mailbox);
        Some(mailbox.len())
    }

    /// Puts an answer of the device into the mailbox.
    pub fn put_answer(&mut self, answer: &[u8]) {
        let Some(expected) = self.expected else { return };
        let Some(mailbox) = self.memory.get_mut(span(&expected[MAILBOX_IN])) else { return };
        mailbox.fill(0);
        for (target, byte) in mailbox.iter_mut().zip(answer) {
            *target = *byte;
        }
        self.sync_managers[MAILBOX_IN].set_full(true);
    }

    /// Handles a read by the master. Returns whether the access was permitted.
    pub fn read(&mut self, address: u16, data: &mut [u8], mode: ReadMode, now_ns: i64) -> bool {
        let permit = sync_manager::permit(&self.sync_managers, address, data.len(), Access::Read);
        if matches!(permit, Permit::Denied) || data.is_empty() {
            return false;
        }
        self.refresh_registers(address, data.len(), now_ns);
        let start = usize::from(address);
        let Some(memory) = self.memory.get(start..start + data.len()) else { return false };
        match mode {
            ReadMode::Replace => data.copy_from_slice(memory),
            ReadMode::Or => data.iter_mut().zip(memory).for_each(|(byte, own)| *byte |= own),
        }
        if let Permit::Through(index) = permit {
            sync_manager::finish_access(&mut self.sync_managers, index, address, data.len());
        }
        true
    }

    /// Handles a write by the master. Returns whether the access was permitted.
    pub fn write(&mut self, address: u16, data: &[u8], now_ns: i64) -> bool {
        let permit = sync_manager::permit(&self.sync_managers, address, data.len(), Access::Write);
        let end = usize::from(address) + data.len();
        if matches!(permit, Permit::Denied) || data.is_empty() || end > self.memory.len() {
            return false;
        }
        let mut written = false;
        for (offset, byte) in data.iter().enumerate() {
            let target = address + offset as u16;
            if self.is_writable(target) {
                self.memory[usize::from(target)] = *byte;
                written = true;
            }
        }
        if address < reg::PROCESS_MEMORY {
            self.apply_registers(address, data, now_ns);
        }
        if let Permit::Through(index) = permit {
            let completion = sync_manager::finish_access(&mut self.sync_managers, index, address, data.len());
            self.complete(completion, now_ns);
        }
        written
    }

    /// Handles a read of the logical process image. Returns whether an FMMU maps any of the bytes.
    pub fn read_logical(&mut self, logical: u32, data: &mut [u8], now_ns: i64) -> bool {
        let mut matched = false;
        for index in 0..self.fmmus.len() {
            let mapped = self.fmmus[index].map(logical, data.len(), Access::Read);
            let Some(mapped) = mapped else { continue };
            matched |= self.read_mapped(&mapped, &mut data[mapped.data.clone()], now_ns);
        }
        matched
    }

    fn read_mapped(&mut self, mapped: &Mapped, data: &mut [u8], now_ns: i64) -> bool {
        if !self.is_mappable(mapped.physical, data.len(), Access::Read) {
            return false;
        }
        let (Some(bits), Some(byte)) = (mapped.bits, data.first_mut()) else {
            return self.read(mapped.physical, data, ReadMode::Replace, now_ns);
        };
        let mut in_device = [0];
        let read = self.read(mapped.physical, &mut in_device, ReadMode::Replace, now_ns);
        *byte = if read { bits.to_logical(in_device[0], *byte) } else { *byte };
        read
    }

    /// Handles a write of the logical process image. Returns whether an FMMU maps any of the bytes.
    pub fn write_logical(&mut self, logical: u32, data: &[u8], now_ns: i64) -> bool {
        let mut matched = false;
        for index in 0..self.fmmus.len() {
            let mapped = self.fmmus[index].map(logical, data.len(), Access::Write);
            let Some(mapped) = mapped else { continue };
            matched |= self.write_mapped(&mapped, &data[mapped.data.clone()], now_ns);
        }
        matched
    }

    fn write_mapped(&mut self, mapped: &Mapped, data: &[u8], now_ns: i64) -> bool {
        if !self.is_mappable(mapped.physical, data.len(), Access::Write) {
            return false;
        }
        let (Some(bits), Some(byte)) = (mapped.bits, data.first()) else {
            return self.write(mapped.physical, data, now_ns);
        };
        let in_device = self.memory.get(usize::from(mapped.physical)).copied().unwrap_or(0);
        self.write(mapped.physical, &[bits.to_physical(*byte, in_device)], now_ns)
    }

    /// Whether an FMMU may access these bytes. Bytes of process memory need an active sync manager.
    /// Registers may only be read.
    fn is_mappable(&self, physical: u16, len: usize, direction: Access) -> bool {
        let permit = sync_manager::permit(&self.sync_managers, physical, len, direction);
        let register = direction == Access::Read && physical < reg::PROCESS_MEMORY;
        register || matches!(permit, Permit::Through(_))
    }

    fn is_writable(&self, address: u16) -> bool {
        let fmmus = reg::FMMU..reg::FMMU + self.fmmu_count() * reg::FMMU_LEN;
        let channels = reg::SYNC_MANAGER..reg::SYNC_MANAGER + self.channel_count() * reg::SYNC_MANAGER_LEN;
        address >= reg::PROCESS_MEMORY
            || fmmus.contains(&address)
            // Status and device-side control of a sync manager cannot be written.
            || (channels.contains(&address) && !matches!(address % reg::SYNC_MANAGER_LEN, 5 | 7))
            || reg::is_writable(address)
    }

    fn fmmu_count(&self) -> u16 {
        u16::from(self.memory[FMMU_COUNT]).min(fmmu::UNITS_MAX as u16)
    }

    fn channel_count(&self) -> u16 {
        u16::from(self.memory[CHANNEL_COUNT]).min(sync_manager::CHANNELS_MAX as u16)
    }

    fn complete(&mut self, completion: Completion, now_ns: i64) {
        match completion {
            Completion::Nothing => {}
            Completion::Request => self.request_at_ns = Some(now_ns),
            Completion::Outputs => {
                // Events that arrive during a conversion are lost.
                self.outputs_at_ns.get_or_insert(now_ns);
                self.outputs_since_sync = true;
                self.outputs_received = true;
            }
        }
    }

    fn readiness(&self, now_ns: i64) -> Readiness {
        let fits = |channel: usize| {
            self.expected.is_none_or(|all| self.sync_managers[channel].matches(&all[channel]))
        };
        Readiness {
            mailbox: fits(MAILBOX_OUT) && fits(MAILBOX_IN),
            outputs: fits(OUTPUTS),
            inputs: fits(INPUTS),
            sync: self.clock.readiness(now_ns),
            outputs_received: self.outputs_received,
        }
    }

    /// Blocks the sync managers of the process data in the states below SAFE-OP, and unblocks them in SAFE-OP and OP.
    fn block_process_data(&mut self) {
        let blocked = self.expected.is_some() && self.state() < AlState::SafeOp;
        for channel in [OUTPUTS, INPUTS] {
            self.sync_managers[channel].blocked = blocked;
        }
    }
}

fn span(channel: &ExpectedSyncManager) -> std::ops::Range<usize> {
    let start = usize::from(channel.start);
    start..start + usize::from(channel.length)
}
