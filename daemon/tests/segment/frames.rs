//! A master that sends single frames whose content the test defines.

use ballbard::segment::simulated::{EncoderSource, Revision, SegmentConfig, SimulatedSegment};

pub const NOP: u8 = 0;
pub const APRD: u8 = 1;
pub const APWR: u8 = 2;
pub const APRW: u8 = 3;
pub const FPRD: u8 = 4;
pub const FPWR: u8 = 5;
pub const FPRW: u8 = 6;
pub const BRD: u8 = 7;
pub const BWR: u8 = 8;
pub const BRW: u8 = 9;
pub const LRD: u8 = 10;
pub const LWR: u8 = 11;
pub const LRW: u8 = 12;
pub const ARMW: u8 = 13;
pub const FRMW: u8 = 14;

pub const INIT: u8 = 1;
pub const PREOP: u8 = 2;
pub const SAFEOP: u8 = 4;
pub const OP: u8 = 8;

/// Station address of the coupler. The terminals have the addresses after it.
pub const STATION: u16 = 0x1000;
pub const TERMINAL: u16 = STATION + 1;

/// A datagram, either as it is sent or as it returns from the devices.
#[derive(Debug, Clone, PartialEq)]
pub struct Datagram {
    pub command: u8,
    pub device: u16,
    pub memory: u16,
    pub data: Vec<u8>,
    pub working_counter: u16,
}

pub fn datagram(command: u8, device: u16, memory: u16, data: &[u8]) -> Datagram {
    Datagram { command, device, memory, data: data.to_vec(), working_counter: 0 }
}

pub fn logical(command: u8, address: u32, data: &[u8]) -> Datagram {
    datagram(command, address as u16, (address >> 16) as u16, data)
}

pub fn encode(datagrams: &[Datagram]) -> Vec<u8> {
    let mut body = Vec::new();
    for (index, datagram) in datagrams.iter().enumerate() {
        let more = if index + 1 < datagrams.len() { 0x8000 } else { 0 };
        body.extend([datagram.command, index as u8]);
        body.extend(datagram.device.to_le_bytes());
        body.extend(datagram.memory.to_le_bytes());
        body.extend((datagram.data.len() as u16 | more).to_le_bytes());
        body.extend([0, 0]);
        body.extend(&datagram.data);
        body.extend(datagram.working_counter.to_le_bytes());
    }
    let mut frame = vec![0xff; 6];
    frame.extend([0x10; 6]);
    frame.extend([0x88, 0xa4]);
    frame.extend((body.len() as u16 | 0x1000).to_le_bytes());
    frame.extend(body);
    frame
}

fn decode(frame: &[u8]) -> Vec<Datagram> {
    let mut rest = &frame[16..];
    let mut datagrams = Vec::new();
    loop {
        let length = u16::from_le_bytes([rest[6], rest[7]]);
        let end = 10 + usize::from(length & 0x7ff);
        datagrams.push(Datagram {
            command: rest[0],
            device: u16::from_le_bytes([rest[2], rest[3]]),
            memory: u16::from_le_bytes([rest[4], rest[5]]),
            data: rest[10..end].to_vec(),
            working_counter: u16::from_le_bytes([rest[end], rest[end + 1]]),
        });
        rest = &rest[end + 2..];
        if length & 0x8000 == 0 {
            return datagrams;
        }
    }
}

pub struct Wire {
    pub segment: SimulatedSegment,
    pub now_ns: i64,
}

impl Wire {
    /// A segment whose devices already have their station addresses.
    pub fn new(terminals: usize, source: impl EncoderSource + 'static) -> Self {
        Self::with_revision(terminals, Revision::default(), source)
    }

    pub fn with_revision(terminals: usize, revision: Revision, source: impl EncoderSource + 'static) -> Self {
        let config = SegmentConfig { terminals, revision, ..SegmentConfig::default() };
        let mut wire =
            Self { segment: SimulatedSegment::new(&config, Box::new(source)), now_ns: 5_000_000_000 };
        for position in 0..=terminals as u16 {
            let address = (STATION + position).to_le_bytes();
            let [reply] = wire.send([datagram(APWR, 0u16.wrapping_sub(position), 0x0010, &address)]);
            assert_eq!(reply.working_counter, 1);
        }
        wire
    }

    pub fn pass_ms(&mut self, ms: i64) {
        self.now_ns += ms * 1_000_000;
    }

    pub fn send<const N: usize>(&mut self, datagrams: [Datagram; N]) -> [Datagram; N] {
        let frame = encode(&datagrams);
        let mut reply = [0; 1518];
        let len = self.segment.exchange(self.now_ns, &frame, &mut reply).expect("an EtherCAT frame");
        assert_eq!(len, frame.len());
        self.now_ns += self.segment.round_trip_ns(len);
        decode(&reply[..len]).try_into().expect("as many datagrams as were sent")
    }

    pub fn read<const N: usize>(&mut self, station: u16, register: u16) -> [u8; N] {
        let [reply] = self.send([datagram(FPRD, station, register, &[0; N])]);
        assert_eq!(reply.working_counter, 1, "{register:#06x}");
        reply.data.try_into().unwrap()
    }

    pub fn write(&mut self, station: u16, register: u16, data: &[u8]) -> u16 {
        self.send([datagram(FPWR, station, register, data)])[0].working_counter
    }

    /// Requests a state and waits 5 ms. Returns AL status and AL status code.
    pub fn request(&mut self, station: u16, control: u8) -> (u8, u16) {
        self.write(station, 0x0120, &[control, 0]);
        self.pass_ms(5);
        self.al_status(station)
    }

    pub fn al_status(&mut self, station: u16) -> (u8, u16) {
        let [status, _, _, _, c0, c1] = self.read(station, 0x0130);
        (status, u16::from_le_bytes([c0, c1]))
    }

    pub fn sync_manager(&mut self, station: u16, index: u16, start: u16, length: u16, control: u8) {
        let mut registers = [0; 8];
        registers[..2].copy_from_slice(&start.to_le_bytes());
        registers[2..4].copy_from_slice(&length.to_le_bytes());
        registers[4] = control;
        registers[6] = u8::from(length > 0);
        assert_eq!(self.write(station, 0x0800 + 8 * index, &registers), 1);
    }

    pub fn fmmu(&mut self, station: u16, index: u16, logical: u32, length: u16, physical: u16, kind: u8) {
        let mut registers = [0; 16];
        registers[..4].copy_from_slice(&logical.to_le_bytes());
        registers[4..6].copy_from_slice(&length.to_le_bytes());
        registers[7] = 7;
        registers[8..10].copy_from_slice(&physical.to_le_bytes());
        registers[11] = kind;
        registers[12] = 1;
        assert_eq!(self.write(station, 0x0600 + 16 * index, &registers), 1);
    }

    pub fn enter_preop(&mut self, station: u16) {
        self.sync_manager(station, 0, 0x1000, 128, 0x26);
        self.sync_manager(station, 1, 0x1080, 128, 0x22);
        assert_eq!(self.request(station, PREOP), (PREOP, 0));
    }

    /// Sets the sync managers and FMMUs of the process data. Inputs are at logical address 0, outputs at 16.
    pub fn map(&mut self, station: u16) {
        self.sync_manager(station, 2, 0x1100, 6, 0x24);
        self.sync_manager(station, 3, 0x1180, 10, 0x20);
        self.fmmu(station, 0, 16, 6, 0x1100, 2);
        self.fmmu(station, 1, 0, 10, 0x1180, 1);
    }

    pub fn enter_safeop(&mut self, station: u16) {
        self.enter_preop(station);
        self.map(station);
        assert_eq!(self.request(station, SAFEOP), (SAFEOP, 0));
    }

    /// Activates SYNC0 with a period of 10 ms. The first pulse is due 20 ms from now.
    pub fn activate_dc(&mut self, station: u16, sync1_ns: u32, activation: u8) {
        let now = i64::from_le_bytes(self.read(station, 0x0910));
        self.start_dc(station, now + 20_000_000, sync1_ns, activation);
    }

    pub fn start_dc(&mut self, station: u16, start_ns: i64, sync1_ns: u32, activation: u8) {
        assert_eq!(self.write(station, 0x0981, &[0]), 1);
        assert_eq!(self.write(station, 0x0990, &start_ns.to_le_bytes()), 1);
        assert_eq!(self.write(station, 0x09a0, &10_000_000u32.to_le_bytes()), 1);
        assert_eq!(self.write(station, 0x09a4, &sync1_ns.to_le_bytes()), 1);
        assert_eq!(self.write(station, 0x0981, &[activation]), 1);
    }

    /// Exchanges process data with the mapped terminal. Sends the control byte and the set value.
    /// Returns working counter and inputs.
    pub fn process_data(&mut self, control: u8, value: u32) -> (u16, [u8; 10]) {
        let mut data = [0; 22];
        data[16] = control;
        data[18..].copy_from_slice(&value.to_le_bytes());
        let [reply] = self.send([logical(LRW, 0, &data)]);
        (reply.working_counter, reply.data[..10].try_into().unwrap())
    }

    /// Sends an SDO request through the mailbox and returns the answer. Both are without the header of CoE.
    pub fn sdo(&mut self, station: u16, content: &[u8]) -> Vec<u8> {
        let answer = self.mailbox(station, 3, &[&[0, 0x20], content].concat());
        answer[8..].to_vec()
    }

    pub fn mailbox(&mut self, station: u16, kind: u8, content: &[u8]) -> Vec<u8> {
        let mut request = vec![0; 128];
        request[..2].copy_from_slice(&(content.len() as u16).to_le_bytes());
        request[5] = kind | 0x30;
        request[6..6 + content.len()].copy_from_slice(content);
        assert_eq!(self.write(station, 0x1000, &request), 1);
        self.pass_ms(1);
        let answer: [u8; 128] = self.read(station, 0x1080);
        assert_eq!(answer[5] & 0x70, 0x30, "the counter is echoed");
        answer[..6 + usize::from(u16::from_le_bytes([answer[0], answer[1]]))].to_vec()
    }
}
