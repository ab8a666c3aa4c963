//! Fuzz targets: the simulated segment gets arbitrary frames and arbitrary mailbox requests.

use super::UnusedBytes;
use frames::*;

#[path = "../../daemon/tests/segment/frames.rs"]
#[allow(dead_code, clippy::unwrap_used, reason = "shared with the daemon's tests, which use all of it")]
mod frames;

use ballbard::segment::simulated::{Conversion, EncoderSource, Periods, Signal};

const MAILBOX_BYTES: usize = 128;

/// An encoder source in which all encoders turn. Their reported speed is 238 periods per second.
struct Turning;

impl EncoderSource for Turning {
    fn signal(&mut self, channel: usize, at: Conversion) -> Signal {
        Signal::Turning {
            position: Periods((at.true_time_ns << 10).wrapping_add(channel as i64)),
            periods_per_s: 238.0,
            amplitude: 1.0,
            reference_mark: None,
            on_reference_mark: false,
        }
    }
}

/// Sends frames of arbitrary bytes to a terminal in OP. A frame may be lost. If a frame returns,
/// its length must be unchanged.
pub fn any_frames(bytes: &[u8]) {
    let mut wire = Wire::new(2, Turning);
    wire.enter_safeop(TERMINAL);
    wire.process_data(0, 0);
    assert_eq!(wire.request(TERMINAL, OP), (OP, 0));
    let mut input = UnusedBytes(bytes);
    let mut reply = [0; 1518];
    while !input.is_empty() {
        wire.now_ns += 1 << (input.byte() % 41);
        let length = usize::from(input.word()).min(reply.len());
        let frame = input.take(length);
        let returned = wire.segment.exchange(wire.now_ns, frame, &mut reply);
        assert!(returned.is_none_or(|length| length == frame.len()));
        if returned.is_some() {
            assert_eq!(headers(frame), headers(&reply[..frame.len()]));
        }
    }
}

/// Command, index and length of each datagram of a frame. Devices must not change these values.
fn headers(frame: &[u8]) -> Vec<(u8, u8, u16)> {
    let mut headers = Vec::new();
    let mut rest = frame.get(16..).unwrap_or_default();
    while let Some(header) = rest.first_chunk::<10>() {
        let length = u16::from_le_bytes([header[6], header[7]]);
        headers.push((header[0], header[1], length));
        rest = rest.get(12 + usize::from(length & 0x7ff)..).unwrap_or_default();
        if length & 0x8000 == 0 {
            break;
        }
    }
    headers
}

/// Sends mailbox requests of arbitrary bytes to a terminal in PRE-OP. Answers must be well-formed, and the
/// terminal must still respond afterwards.
pub fn any_requests(bytes: &[u8]) {
    let mut wire = Wire::new(1, Turning);
    wire.enter_preop(TERMINAL);
    let mut input = UnusedBytes(bytes);
    while !input.is_empty() {
        let length = usize::from(input.byte());
        let mut request = input.take(length.min(MAILBOX_BYTES)).to_vec();
        request.resize(MAILBOX_BYTES, 0);
        if wire.write(TERMINAL, 0x1000, &request) == 1 {
            wire.pass_ms(1);
            fetch(&mut wire, &request);
        }
    }
    // After any SDO request, the value of object 0x1018:01 (vendor) is still 2.
    assert_eq!(wire.sdo(TERMINAL, &[0x40, 0x18, 0x10, 1, 0, 0, 0, 0])[..5], [0x43, 0x18, 0x10, 1, 2]);
}

fn fetch(wire: &mut Wire, request: &[u8]) {
    let [reply] = wire.send([datagram(FPRD, TERMINAL, 0x1080, &[0; MAILBOX_BYTES])]);
    if reply.working_counter != 1 {
        return;
    }
    let length = usize::from(u16::from_le_bytes([reply.data[0], reply.data[1]]));
    assert!((2..=MAILBOX_BYTES - 6).contains(&length), "an answer of {length} bytes");
    let kind = reply.data[5] & 0x0f;
    assert!(kind == 0 || kind == 3, "a protocol that nobody asked for: {kind}");
    assert_eq!(reply.data[5] & 0x70, request[5] & 0x70, "the counter is echoed");
}

/// Seeds: the frames that bring a terminal to OP.
pub fn frames() -> Vec<Vec<u8>> {
    let sequences: [&[Datagram]; 4] = [
        &[datagram(BRD, 0, 0x0130, &[0; 6]), datagram(FPRD, TERMINAL, 0x092c, &[0; 4])],
        &[datagram(FPWR, TERMINAL, 0x0120, &[INIT, 0]), datagram(FPRD, TERMINAL, 0x0130, &[0; 6])],
        &[datagram(FRMW, STATION, 0x0910, &[0; 8]), logical(LRW, 0, &[0; 22])],
        &[
            datagram(FPWR, TERMINAL, 0x0502, &[0, 1, 0x18, 0, 0, 0]),
            datagram(FPRD, TERMINAL, 0x0508, &[0; 4]),
        ],
    ];
    let one = |frame: Vec<u8>| [&[20][..], &(frame.len() as u16).to_le_bytes(), &frame].concat();
    let mut seeds: Vec<Vec<u8>> = sequences.iter().map(|sequence| one(encode(sequence))).collect();
    seeds.push(seeds.concat());
    seeds
}

/// Seeds: SDO upload, download (expedited and normal), the list of objects, and an unsupported protocol.
pub fn requests() -> Vec<Vec<u8>> {
    let sdo = |content: &[u8]| mailbox(3, &[&[0, 0x20], content].concat());
    let requests = [
        sdo(&[0x40, 0x01, 0x80, 0x11, 0, 0, 0, 0]),
        sdo(&[0x2f, 0x01, 0x80, 0x11, 12, 0, 0, 0]),
        sdo(&[0x21, 0x01, 0x80, 0x11, 1, 0, 0, 0, 12]),
        sdo(&[0x40, 0x08, 0x10, 0, 0, 0, 0, 0]),
        mailbox(3, &[0, 0x80, 1, 0, 0, 0, 1, 0]),
        mailbox(3, &[0, 0x80, 3, 0, 0, 0, 0x01, 0x80]),
        mailbox(4, &[2, 0, 0, 0]),
    ];
    let mut seeds = requests.to_vec();
    seeds.push(requests.concat());
    seeds
}

fn mailbox(kind: u8, content: &[u8]) -> Vec<u8> {
    let length = content.len() as u8;
    [&[length + 6, length, 0, 0, 0, 0, kind | 0x10], content].concat()
}
