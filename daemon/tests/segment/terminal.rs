//! Functions of an EL5021 other than counting, tested over the wire: reset at C, setting the counter, errors and their
//! counters, counting direction, and revisions with and without the newer objects.

use ballbard::segment::simulated::{Conversion, EncoderSource, Periods, Revision, Signal};

use super::frames::*;
use super::refusal::{abort_code, download, upload};

/// An encoder source with the constant position 5.5 periods. If `mark` is set, the encoder is on its
/// reference mark, at 5.25 periods.
struct Still {
    periods_per_s: f64,
    amplitude: f64,
    mark: bool,
}

impl Default for Still {
    fn default() -> Self {
        Self { periods_per_s: 0.0, amplitude: 1.0, mark: false }
    }
}

impl EncoderSource for Still {
    fn signal(&mut self, _channel: usize, _at: Conversion) -> Signal {
        Signal::Turning {
            position: Periods::from_f64(5.5),
            periods_per_s: self.periods_per_s,
            amplitude: self.amplitude,
            reference_mark: self.mark.then(|| Periods::from_f64(5.25)),
            on_reference_mark: self.mark,
        }
    }
}

const LATCH: u8 = 0x01;
const SET: u8 = 0x04;

/// Writes these objects (index, subindex, value) to a terminal. Then brings it into OP, synchronised with frames.
fn operating(source: Still, settings: &[(u16, u8, &[u8])]) -> Wire {
    let mut wire = Wire::new(1, source);
    wire.enter_preop(TERMINAL);
    for (index, subindex, value) in settings {
        assert_eq!(wire.sdo(TERMINAL, &download(*index, *subindex, value))[0], 0x60);
    }
    wire.map(TERMINAL);
    assert_eq!(wire.request(TERMINAL, SAFEOP), (SAFEOP, 0));
    wire.process_data(0, 0);
    assert_eq!(wire.request(TERMINAL, OP), (OP, 0));
    wire
}

/// Status, counter and latch after this control word and set value were sent. Each frame starts a conversion, and the next
/// frame returns the result. The frame is therefore sent several times.
fn inputs(wire: &mut Wire, control: u8, value: u32) -> (u16, u32, u32) {
    for _ in 0..2 {
        wire.process_data(control, value);
        wire.pass_ms(1);
    }
    let (_, bytes) = wire.process_data(control, value);
    let word = |from: usize| u32::from_le_bytes(bytes[from..from + 4].try_into().unwrap());
    (u16::from_le_bytes([bytes[0], bytes[1]]) & 0x7fff, word(2), word(6))
}

fn read_u16(wire: &mut Wire, index: u16, subindex: u8) -> u16 {
    let answer = wire.sdo(TERMINAL, &upload(index, subindex));
    u16::from_le_bytes([answer[4], answer[5]])
}

#[test]
fn the_counter_is_set_once_for_each_request_and_says_so() {
    let mut wire = operating(Still::default(), &[]);
    assert_eq!(inputs(&mut wire, 0, 0), (0, 5 * 1024 + 512, 0));
    assert_eq!(inputs(&mut wire, SET, 70_000), (SET.into(), 70_000, 0));
    assert_eq!(inputs(&mut wire, SET, 1), (SET.into(), 70_000, 0), "on the rising request only");
    assert_eq!(inputs(&mut wire, 0, 0), (0, 70_000, 0));
}

#[test]
fn c_resets_the_counter_only_where_it_is_set_to_and_the_latch_shows_where_c_was() {
    let mark = || Still { mark: true, ..Still::default() };
    let mut wire = operating(mark(), &[]);
    // The expected status consists of two bits: the level of C, and the valid latch.
    assert_eq!(inputs(&mut wire, LATCH, 0), (1 << 10 | 1, 5 * 1024 + 512, 5 * 1024 + 256));
    let mut wire = operating(mark(), &[(0x8000, 0x01, &[1])]);
    assert_eq!(inputs(&mut wire, 0, 0), (1 << 10, 256, 0));
}

#[test]
fn direction_is_reversed_by_its_object() {
    let mut wire = operating(Still::default(), &[(0x8000, 0x0e, &[1])]);
    assert_eq!(inputs(&mut wire, 0, 0).1, 0u32.wrapping_sub(5 * 1024 + 512));
}

#[test]
fn frequency_and_amplitude_errors_are_shown_counted_and_can_be_switched_off() {
    let fast = || Still { periods_per_s: 300e3, ..Still::default() };
    let mut wire = operating(fast(), &[]);
    assert_eq!(inputs(&mut wire, 0, 0).0, 1 << 3 | 1 << 14);
    assert_eq!((read_u16(&mut wire, 0xa000, 0x11), read_u16(&mut wire, 0xa000, 0x12)), (1, 0));
    let mut wire = operating(Still { amplitude: 0.1, ..Still::default() }, &[]);
    assert_eq!(inputs(&mut wire, 0, 0).0, 1 << 4 | 1 << 14);
    assert_eq!((read_u16(&mut wire, 0xa000, 0x11), read_u16(&mut wire, 0xa000, 0x12)), (0, 1));
    let mut wire = operating(fast(), &[(0x8001, 0x01, &[0])]);
    assert_eq!(inputs(&mut wire, 0, 0).0, 0);
}

#[test]
fn old_firmware_lacks_the_newer_objects_and_keeps_status_bits_elsewhere() {
    let preop = |revision| {
        let mut wire = Wire::with_revision(1, revision, Still::default());
        wire.enter_preop(TERMINAL);
        wire
    };
    let entry = |wire: &mut Wire| wire.sdo(TERMINAL, &upload(0x1a00, 9))[4..8].to_vec();
    let mut old = preop(Revision::R16);
    assert_eq!(entry(&mut old), 0x1c32_2001u32.to_le_bytes(), "sync error in the sync parameters");
    assert_eq!(old.sdo(TERMINAL, &upload(0x8000, 0))[4], 0x0e);
    assert_eq!(abort_code(&old.sdo(TERMINAL, &upload(0x8000, 0x11))), 0x0609_0011);
    assert_eq!(abort_code(&old.sdo(TERMINAL, &upload(0x1a02, 0))), 0x0602_0000);
    let mut new = preop(Revision::R22);
    assert_eq!(entry(&mut new), 0x6000_0e01u32.to_le_bytes());
    assert_eq!(new.sdo(TERMINAL, &upload(0x8000, 0))[4], 0x1f);
    assert_eq!(read_u16(&mut new, 0x8000, 0x11), 10_000, "frequency window");
    assert_eq!(new.sdo(TERMINAL, &upload(0x1a01, 0))[4], 1);
}
