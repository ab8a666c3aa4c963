//! Brings a segment from any state to OP, at the start and after an outage. The steps are:
//! 1. find the devices and check their identity
//! 2. set the interpolation of the terminals
//! 3. synchronise the distributed clocks
//! 4. enter the states PRE-OP, SAFE-OP and OP

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Duration;

use ethercrab::error::{Error as EtherCatError, MailboxError};
use ethercrab::subdevice_group::{DcConfiguration, HasDc, NoDc, Op, PreOp, PreOpPdi};
use ethercrab::{Command, DcSync, EtherCrabWireRead, RegisterAddress, SubDeviceRef, SubDeviceState};
use shared::config::EncoderConfig;
use shared::recording::schema::DeviceInfo;
use shared::time::NS_PER_S;

use super::error::{BusError, while_doing, wrong_devices};
use super::{
    Bus, BusGroup, BusPlan, DeviceClock, Operational, OperationalGroup, STATION_ADDRESS_FIRST, timers,
    working_counter_of,
};
use crate::devices::{DeviceKind, EK1100, EL5021, el5021};
use crate::problem::Fact;

/// Time between configuring SYNC0 and its first pulse. All terminals must be configured before this pulse.
const SYNC_START_DELAY: Duration = Duration::from_millis(100);
/// Number of synchronising frames in a round, one frame per millisecond. After each round the clocks are compared.
const CLOCK_SYNC_FRAMES: u32 = 50;
/// Largest number of rounds. The clocks of the chips need some thousand frames. A frame that is lost corrects
/// nothing and costs a time-out.
const CLOCK_SYNC_ROUNDS_MAX: u32 = 100;
const SYNCHRONISING: &str = "synchronising the clocks";
/// Largest difference between a clock and the bus time at which the clock counts as synchronised \[ns\]. The clocks of three
/// EL5021 differed by 2 to 8 ns from each other (linuxcnc-ethercat's notes, read in 2026-11).
const CLOCK_DIFFERENCE_NS_MAX: i64 = 1_000;
/// Time limit for the transition of the terminals from SAFE-OP to OP, while process data are exchanged \[ns\].
const OPERATIONAL_TIMEOUT_NS: i64 = 5 * NS_PER_S;

impl Bus {
    /// Brings the segment into operation, from any state.
    pub fn bring_up(&mut self, plan: &BusPlan) -> Result<Operational, BusError> {
        // ethercrab 0.7.1 panics in two cases: if a CoE emergency arrives during an SDO access, and if the topology is
        // inconsistent. Such a panic is caught, because a defective terminal must not end the process.
        let mut attempt = || {
            catch_unwind(AssertUnwindSafe(|| self.try_bring_up(plan))).unwrap_or_else(|panic| {
                // The stack's frames are free again, because the panic has dropped their owners.
                let (doing, error) = (
                    "bringing the bus up (an internal error of the EtherCAT stack)".into(),
                    panic_text(panic.as_ref()),
                );
                Err(Fact::BusStackFailed { doing, error }.into())
            })
        };
        // If the reply of a mailbox access is lost, the stack reads the mailbox again, finds it empty, and reports an error.
        // One lost frame must not end the bring-up, so the bring-up is repeated once.
        let outcome = match attempt() {
            Err(error) if error.may_be_a_lost_reply => attempt(),
            outcome => outcome,
        };
        outcome.map_err(
            |error| if self.exchange.is_interrupted() { Fact::BusInterrupted {}.into() } else { error },
        )
    }

    fn try_bring_up(&mut self, plan: &BusPlan) -> Result<Operational, BusError> {
        self.identified.clear();
        let mut group = self.discover(plan)?;
        self.identify(&group);
        self.check_devices(plan)?;
        self.configure_terminals(&mut group, plan)?;
        let doing = while_doing("mapping the process data");
        let group = self.exchange.run(group.into_pre_op_pdi(self.main)).map_err(doing)?;
        let (group, clocks) = if plan.distributed_clocks {
            let clocks = self.synchronise_clocks(&group)?;
            let group = self.start_sync(group, plan)?;
            (OperationalGroup::Dc(self.request_operational(group)?), clocks)
        } else {
            (OperationalGroup::FreeRun(self.request_operational(group)?), Vec::new())
        };
        let operational = Operational {
            group,
            devices: self.identified.clone(),
            clocks,
            working_counter_expected: working_counter_of(plan.encoders.len()),
            encoder_count: plan.encoders.len(),
        };
        self.check_process_data(&operational)?;
        self.wait_operational(&operational, plan)?;
        Ok(operational)
    }

    fn discover(&mut self, plan: &BusPlan) -> Result<BusGroup<PreOp, NoDc>, BusError> {
        let no_answer = || BusError::from(Fact::BusNoAnswer { bus: plan.name.clone() });
        let bus_minus_monotonic_ns = self.bus_minus_monotonic_ns;
        let bus_time_ns = move || timers::now().plus_ns(bus_minus_monotonic_ns).0.max(0) as u64;
        let received_before = self.exchange.counters.received;
        let group = match self.exchange.run(self.main.init_single_group(bus_time_ns)) {
            Ok(group) => group,
            Err(_) if self.exchange.counters.received == received_before => return Err(no_answer()),
            Err(error) => return Err(while_doing("looking for devices")(error)),
        };
        if group.is_empty() { Err(no_answer()) } else { Ok(group) }
    }

    fn identify(&mut self, group: &BusGroup<PreOp, NoDc>) {
        let info = |(position, device): (usize, SubDeviceRef<'_, _>)| {
            let identity = device.identity();
            DeviceInfo {
                position: position as u16,
                name: device.name().to_owned(),
                vendor_id: identity.vendor_id,
                product_code: identity.product_id,
                revision: identity.revision,
                serial: identity.serial,
            }
        };
        self.identified = group.iter(self.main).enumerate().map(info).collect();
    }

    fn check_devices(&self, plan: &BusPlan) -> Result<(), BusError> {
        let devices = &self.identified;
        let expected: Vec<&DeviceKind> =
            std::iter::once(&EK1100).chain(plan.encoders.iter().map(|_| &EL5021)).collect();
        match first_difference(&expected, devices) {
            None => Ok(()),
            Some(position) => {
                let expected = expected.iter().map(|kind| kind.name.to_owned()).collect();
                let found = devices.iter().map(|device| device.name.clone()).collect();
                Err(wrong_devices(position, expected, found).into())
            }
        }
    }

    fn configure_terminals(
        &mut self,
        group: &mut BusGroup<PreOp, NoDc>,
        plan: &BusPlan,
    ) -> Result<(), BusError> {
        let Self { exchange, main, .. } = self;
        for (index, mut terminal) in group.iter_mut(main).skip(1).enumerate() {
            let Some(encoder) = plan.encoders.get(index) else { break };
            // Position 0 is the coupler.
            let position = index + 1;
            let refused = |error| Fact::BusSettingRefused {
                position,
                doing: "setting the interpolation".into(),
                error,
            };
            let found = exchange
                .run(set_interpolation(&terminal, encoder))
                .map_err(|error| BusError::of_stack(error, refused))?;
            if found != u32::from(encoder.interpolation_bits) {
                let wanted = encoder.interpolation_bits;
                return Err(Fact::BusInterpolation { position, wanted, found }.into());
            }
            if plan.distributed_clocks {
                terminal.set_dc_sync(DcSync::Sync01 { sync1_period: el5021::SYNC1_SHIFT });
            }
        }
        Ok(())
    }

    /// Synchronises the clocks of all terminals with the reference clock. Returns the remaining difference of each clock.
    fn synchronise_clocks(&mut self, group: &BusGroup<PreOpPdi, NoDc>) -> Result<Vec<DeviceClock>, BusError> {
        let mut rounds_left = CLOCK_SYNC_ROUNDS_MAX;
        loop {
            self.distribute_time(group)?;
            let clocks = self.read_clocks(group)?;
            rounds_left -= 1;
            match clocks.iter().find(|clock| clock.difference_ns.abs() > CLOCK_DIFFERENCE_NS_MAX) {
                None => return Ok(clocks),
                Some(&DeviceClock { position, difference_ns, .. }) if rounds_left == 0 => {
                    return Err(Fact::BusClockUnsettled { position, difference_ns }.into());
                }
                Some(_) => {}
            }
        }
    }

    /// Sends one round of frames, which distribute the time of the reference clock to all other clocks.
    /// Checks that this time advances.
    fn distribute_time(&mut self, group: &BusGroup<PreOpPdi, NoDc>) -> Result<(), BusError> {
        let mut times_ns = Vec::with_capacity(CLOCK_SYNC_FRAMES as usize);
        for _ in 0..CLOCK_SYNC_FRAMES {
            let response = self.exchange.run(group.tx_rx_sync_system_time(self.main));
            times_ns.push(response.map_err(while_doing(SYNCHRONISING))?.extra.unwrap_or(0));
            self.clock.sleep_until(self.clock.now().plus_ns(NS_PER_S / 1000));
        }
        match (times_ns.first(), times_ns.last()) {
            (Some(first), Some(last)) if last <= first => {
                Err(Fact::BusClockStopped { time_ns: *last }.into())
            }
            _ => Ok(()),
        }
    }

    fn read_clocks(&mut self, group: &BusGroup<PreOpPdi, NoDc>) -> Result<Vec<DeviceClock>, BusError> {
        let read = |(position, device): (usize, SubDeviceRef<'_, _>)| {
            let register = device.register_read::<u32>(RegisterAddress::DcSystemTimeDifference);
            let register = self.exchange.run(register).map_err(while_doing(SYNCHRONISING))?;
            let propagation_delay_ns = device.propagation_delay();
            Ok(DeviceClock { position, propagation_delay_ns, difference_ns: sign_magnitude(register) })
        };
        group.iter(self.main).enumerate().skip(1).map(read).collect()
    }

    fn start_sync(
        &mut self,
        group: BusGroup<PreOpPdi, NoDc>,
        plan: &BusPlan,
    ) -> Result<BusGroup<PreOpPdi, HasDc>, BusError> {
        let configuration = DcConfiguration {
            start_delay: SYNC_START_DELAY,
            sync0_period: plan.cycle_period,
            sync0_shift: plan.sync0_shift,
        };
        self.exchange
            .run(group.configure_dc_sync(self.main, configuration))
            .map_err(while_doing("starting SYNC0 and SYNC1"))
    }

    fn request_operational<Dc>(
        &mut self,
        group: BusGroup<PreOpPdi, Dc>,
    ) -> Result<BusGroup<Op, Dc>, BusError> {
        let devices = group.len();
        let safe_op = self.exchange.run(group.into_safe_op(self.main));
        let safe_op = safe_op.map_err(|error| self.explain_refusal(devices, "SAFE-OP", error))?;
        let op = self.exchange.run(safe_op.request_into_op(self.main));
        op.map_err(|error| self.explain_refusal(devices, "OP", error))
    }

    fn check_process_data(&self, operational: &Operational) -> Result<(), BusError> {
        for position in 1..=operational.encoder_count {
            let terminal = operational.group.device(self.main, position);
            let terminal = terminal.map_err(while_doing("looking at the process data"))?;
            let (inputs_bytes, outputs_bytes) = (terminal.inputs_raw().len(), terminal.outputs_raw().len());
            if (inputs_bytes, outputs_bytes) != (el5021::INPUT_BYTES, el5021::OUTPUT_BYTES) {
                return Err(Fact::BusProcessData { position, inputs_bytes, outputs_bytes }.into());
            }
        }
        Ok(())
    }

    /// Runs cycles until every device is in OP. Devices reach OP only while they receive process data. SYNC0 pulses occur
    /// when the bus time is a multiple of the period. Each frame is sent `sync0_shift` after a pulse.
    fn wait_operational(&mut self, operational: &Operational, plan: &BusPlan) -> Result<(), BusError> {
        let period_ns = plan.cycle_period.as_nanos() as i64;
        let deadline = self.clock.now().plus_ns(OPERATIONAL_TIMEOUT_NS);
        while self.clock.now() < deadline && !self.exchange.is_interrupted() {
            let cycle = self.exchange(operational);
            if cycle.reply.is_some_and(|reply| reply.all_operational) {
                return Ok(());
            }
            let phase_ns =
                cycle.reply.and_then(|reply| reply.dc_time).map_or(0, |time| time.0.rem_euclid(period_ns));
            let next = cycle.sent.plus_ns(period_ns - phase_ns + plan.sync0_shift.as_nanos() as i64);
            self.clock.sleep_until(next);
        }
        let timeout = while_doing("waiting for OP")(EtherCatError::StateTransition);
        Err(self.refused_device(operational.devices.len(), "OP").unwrap_or(timeout))
    }

    fn explain_refusal(&mut self, devices: usize, wanted: &'static str, error: EtherCatError) -> BusError {
        self.refused_device(devices, wanted).unwrap_or_else(|| while_doing("changing state")(error))
    }

    /// Returns an error for the first device that has an AL status code. ethercrab itself reports only a time-out when a
    /// device refuses a state.
    fn refused_device(&mut self, devices: usize, wanted: &'static str) -> Option<BusError> {
        (0..devices).find_map(|position| {
            let (state, code) = self.al_status(position).ok()?;
            let refused = u16::from(code) != 0;
            let (state, wanted, al_status) = (state.to_string(), wanted.into(), code.to_string());
            refused.then(|| Fact::BusStateRefused { position, state, wanted, al_status }.into())
        })
    }

    pub(super) fn al_status(
        &mut self,
        position: usize,
    ) -> Result<(SubDeviceState, ethercrab::AlStatusCode), EtherCatError> {
        let address = STATION_ADDRESS_FIRST + position as u16;
        let Self { exchange, main, .. } = self;
        let status: u16 =
            exchange.run(Command::fprd(address, RegisterAddress::AlStatus.into()).receive(main))?;
        let code: u16 =
            exchange.run(Command::fprd(address, RegisterAddress::AlStatusCode.into()).receive(main))?;
        let state = SubDeviceState::unpack_from_slice(&[(status & 0x0f) as u8])?;
        Ok((state, ethercrab::AlStatusCode::unpack_from_slice(&code.to_le_bytes())?))
    }
}

/// Writes the interpolation and reads it back. Object 0x8001:11 has one byte in all known revisions of the terminal. If a
/// terminal refuses one byte, two bytes are written.
async fn set_interpolation<T: std::ops::Deref<Target = ethercrab::SubDevice>>(
    terminal: &SubDeviceRef<'_, T>,
    encoder: &EncoderConfig,
) -> Result<u32, EtherCatError> {
    let (index, sub_index) = el5021::INTERPOLATION_OBJECT;
    let bits = encoder.interpolation_bits;
    match terminal.sdo_write(index, sub_index, bits).await {
        Err(EtherCatError::Mailbox(MailboxError::Aborted { .. })) => {
            terminal.sdo_write(index, sub_index, u16::from(bits)).await?;
            terminal.sdo_read::<u16>(index, sub_index).await.map(u32::from)
        }
        Err(error) => Err(error),
        Ok(()) => terminal.sdo_read::<u8>(index, sub_index).await.map(u32::from),
    }
}

/// First position at which the devices differ from the expected ones: another device, a missing one, or an additional one.
fn first_difference(expected: &[&DeviceKind], found: &[DeviceInfo]) -> Option<usize> {
    let same =
        |(kind, device): (&&DeviceKind, &DeviceInfo)| kind.matches(device.vendor_id, device.product_code);
    let common = expected.iter().zip(found).take_while(|&pair| same(pair)).count();
    (common < expected.len().max(found.len())).then_some(common)
}

/// Converts a register that consists of a sign bit and a magnitude, such as 0x092C. Such a register is
/// not a two's complement number.
fn sign_magnitude(register: u32) -> i64 {
    let magnitude = i64::from(register & 0x7fff_ffff);
    if register >> 31 == 1 { -magnitude } else { magnitude }
}

fn panic_text(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_else(|| "unknown".into())
}
