//! Accesses to registers that are connected to a unit. A read returns the state of the unit. A write changes the unit.

use super::{Esc, reg};

impl Esc {
    /// Updates the registers in a range from their units, before a master reads them.
    pub(super) fn refresh_registers(&mut self, address: u16, len: usize, now_ns: i64) {
        if address >= reg::PROCESS_MEMORY {
            return;
        }
        let touches = |register, size| reg::touches(address, len, register, size);
        if touches(reg::AL_STATUS, 6) {
            let (status, code) = self.al.registers();
            self.put(reg::AL_STATUS, &[status, 0]);
            self.put(reg::AL_STATUS_CODE, &code.to_le_bytes());
        }
        if touches(reg::SII_ACCESS, 16) {
            self.put(reg::SII_ACCESS, &self.sii.registers(now_ns));
        }
        for channel in 0..self.channel_count() {
            let register = reg::SYNC_MANAGER + channel * reg::SYNC_MANAGER_LEN;
            if touches(register, 8) {
                let status = self.sync_managers[usize::from(channel)].status();
                self.put(register + 5, &status);
            }
        }
        if touches(reg::DC_PORT_TIMES, 0x30) {
            self.refresh_clock(now_ns);
        }
    }

    fn refresh_clock(&mut self, now_ns: i64) {
        for port in 0..4u16 {
            let time = self.clock.port_times[usize::from(port)];
            self.put(reg::DC_PORT_TIMES + 4 * port, &time.to_le_bytes());
        }
        self.put(reg::DC_SYSTEM_TIME, &self.clock.system_ns(now_ns).to_le_bytes());
        self.put(reg::DC_RECEIVE_TIME, &self.clock.receive_time.to_le_bytes());
        self.put(reg::DC_DIFFERENCE, &self.clock.difference().to_le_bytes());
    }

    /// Passes written registers on to their units.
    pub(super) fn apply_registers(&mut self, address: u16, data: &[u8], now_ns: i64) {
        let touches = |register, size| reg::touches(address, data.len(), register, size);
        if touches(reg::AL_CONTROL, 1) {
            self.al.request(self.memory[usize::from(reg::AL_CONTROL)], now_ns);
        }
        if touches(reg::SII_ACCESS, usize::from(reg::SII_END - reg::SII_ACCESS)) {
            self.apply_sii(address, data, now_ns);
        }
        for index in 0..self.fmmu_count() {
            let register = reg::FMMU + index * reg::FMMU_LEN;
            if touches(register, 16) {
                let registers = self.get(register);
                self.fmmus[usize::from(index)].configure(&registers);
            }
        }
        for index in 0..self.channel_count() {
            let register = reg::SYNC_MANAGER + index * reg::SYNC_MANAGER_LEN;
            if touches(register, 8) {
                let registers = self.get(register);
                self.sync_managers[usize::from(index)].configure(&registers);
            }
        }
        if touches(reg::DC_PORT_TIMES, 0x100) {
            self.apply_clock(address, data, now_ns);
        }
    }

    /// Passes a write on to the EEPROM interface. Registers outside the written range keep their values. The control
    /// register is cleared first, so a command is executed only if this write contains one.
    fn apply_sii(&mut self, address: u16, data: &[u8], now_ns: i64) {
        let mut registers = self.sii.registers(now_ns);
        registers[2..4].fill(0);
        for (offset, byte) in data.iter().enumerate() {
            let register = (usize::from(address) + offset).wrapping_sub(usize::from(reg::SII_ACCESS));
            if let Some(target) = registers.get_mut(register) {
                *target = *byte;
            }
        }
        self.sii.write(address, data.len(), &registers, now_ns);
    }

    fn apply_clock(&mut self, address: u16, data: &[u8], now_ns: i64) {
        let touches = |register, size| reg::touches(address, data.len(), register, size);
        if touches(reg::DC_PORT_TIMES, 4) {
            self.clock.latch(now_ns, self.back_ns);
        }
        if address == reg::DC_SYSTEM_TIME {
            self.clock.follow(data, now_ns);
        }
        if touches(reg::DC_OFFSET, 8) {
            self.clock.offset_ns = i64::from_le_bytes(self.get(reg::DC_OFFSET));
        }
        if touches(reg::DC_DELAY, 4) {
            self.clock.delay_ns = u32::from_le_bytes(self.get(reg::DC_DELAY));
        }
        if touches(reg::DC_FILTER_DEPTH, 1) {
            self.clock.set_filter_depth(self.memory[usize::from(reg::DC_FILTER_DEPTH)]);
        }
        if touches(reg::DC_SPEED_START, 2) {
            self.clock.reset_loop(now_ns);
        }
        if touches(reg::DC_START_TIME, 0x18) {
            self.clock.set_cycle(
                i64::from_le_bytes(self.get(reg::DC_START_TIME)),
                u32::from_le_bytes(self.get(reg::DC_SYNC0_CYCLE)),
                u32::from_le_bytes(self.get(reg::DC_SYNC1_CYCLE)),
            );
        }
        if touches(reg::DC_ACTIVATION, 2) {
            self.clock.activate(self.memory[usize::from(reg::DC_ACTIVATION) + 1], now_ns);
        }
    }

    pub(super) fn get<const N: usize>(&self, address: u16) -> [u8; N] {
        self.memory[usize::from(address)..].first_chunk().copied().unwrap_or([0; N])
    }

    pub(super) fn put(&mut self, address: u16, bytes: &[u8]) {
        let start = usize::from(address);
        if let Some(target) = self.memory.get_mut(start..start + bytes.len()) {
            target.copy_from_slice(bytes);
        }
    }
}
