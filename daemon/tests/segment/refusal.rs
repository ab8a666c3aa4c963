//! Requests that a terminal must refuse, and the AL status code of each refusal.

use super::frames::*;
use super::operation::Ramp;

const SYNC1_NS: u32 = 25_000;
const SYNC01: u8 = 0x07;

fn preop() -> Wire {
    let mut wire = Wire::new(1, Ramp);
    wire.enter_preop(TERMINAL);
    wire
}

/// A wire with a terminal in SAFE-OP that is synchronised with distributed clocks.
fn safeop_on_clock(sync1_ns: u32) -> Wire {
    let mut wire = preop();
    wire.map(TERMINAL);
    wire.activate_dc(TERMINAL, sync1_ns, SYNC01);
    assert_eq!(wire.request(TERMINAL, SAFEOP), (SAFEOP, 0));
    wire
}

#[test]
fn the_coupler_mirrors_what_it_is_asked_for() {
    let mut wire = Wire::new(1, Ramp);
    assert_eq!(wire.request(STATION, 0x11), (0x11, 0));
    assert_eq!(wire.request(STATION, OP), (OP, 0));
}

#[test]
fn a_wrong_mailbox_keeps_the_terminal_in_init() {
    let mut wire = Wire::new(1, Ramp);
    wire.sync_manager(TERMINAL, 0, 0x1000, 64, 0x26);
    wire.sync_manager(TERMINAL, 1, 0x1080, 128, 0x22);
    assert_eq!(wire.request(TERMINAL, PREOP), (INIT | 0x10, 0x0016));
}

#[test]
fn an_error_is_to_be_acknowledged_before_anything_else() {
    let mut wire = Wire::new(1, Ramp);
    assert_eq!(wire.request(TERMINAL, PREOP), (INIT | 0x10, 0x0016));
    wire.sync_manager(TERMINAL, 0, 0x1000, 128, 0x26);
    wire.sync_manager(TERMINAL, 1, 0x1080, 128, 0x22);
    assert_eq!(wire.request(TERMINAL, PREOP), (INIT | 0x10, 0x0016), "not acknowledged");
    assert_eq!(wire.request(TERMINAL, PREOP | 0x10), (PREOP, 0));
}

#[test]
fn states_that_do_not_follow_or_do_not_exist_are_refused() {
    let mut wire = Wire::new(1, Ramp);
    assert_eq!(wire.request(TERMINAL, SAFEOP), (INIT | 0x10, 0x0011));
    assert_eq!(wire.request(TERMINAL, OP | 0x10), (INIT | 0x10, 0x0011));
    assert_eq!(wire.request(TERMINAL, 7 | 0x10), (INIT | 0x10, 0x0012));
    assert_eq!(wire.request(TERMINAL, 3 | 0x10), (INIT | 0x10, 0x0013));
    assert_eq!(wire.request(TERMINAL, INIT | 0x10), (INIT, 0));
}

#[test]
fn wrong_lengths_of_process_data_are_refused() {
    let mut wire = preop();
    wire.map(TERMINAL);
    wire.sync_manager(TERMINAL, 2, 0x1100, 7, 0x24);
    assert_eq!(wire.request(TERMINAL, SAFEOP), (PREOP | 0x10, 0x001d));
    wire.map(TERMINAL);
    wire.sync_manager(TERMINAL, 3, 0x1180, 12, 0x20);
    assert_eq!(wire.request(TERMINAL, SAFEOP | 0x10), (PREOP | 0x10, 0x001e));
    wire.map(TERMINAL);
    assert_eq!(wire.request(TERMINAL, SAFEOP | 0x10), (SAFEOP, 0));
}

#[test]
fn the_clock_needs_both_sync_signals() {
    let mut wire = preop();
    wire.map(TERMINAL);
    wire.activate_dc(TERMINAL, SYNC1_NS, 0x03);
    assert_eq!(wire.request(TERMINAL, SAFEOP), (PREOP | 0x10, 0x0030));
}

#[test]
fn sync1_of_a_whole_cycle_is_refused() {
    let mut wire = safeop_on_clock(10_000_000);
    wire.process_data(0, 0);
    assert_eq!(wire.request(TERMINAL, OP), (SAFEOP | 0x10, 0x002c));
}

#[test]
fn without_outputs_there_is_no_op() {
    let mut wire = safeop_on_clock(SYNC1_NS);
    assert_eq!(wire.request(TERMINAL, OP), (SAFEOP, 0), "the terminal waits");
    wire.pass_ms(3000);
    assert_eq!(wire.al_status(TERMINAL), (SAFEOP | 0x10, 0x0019));
    wire.process_data(0, 0);
    assert_eq!(wire.request(TERMINAL, OP | 0x10), (OP, 0));
}

#[test]
fn a_start_time_that_has_passed_gives_no_pulses_and_so_no_op() {
    let mut wire = preop();
    wire.map(TERMINAL);
    let past = i64::from_le_bytes(wire.read(TERMINAL, 0x0910)) - 1;
    wire.start_dc(TERMINAL, past, SYNC1_NS, SYNC01);
    assert_eq!(wire.request(TERMINAL, SAFEOP), (SAFEOP, 0));
    wire.process_data(0, 0);
    wire.write(TERMINAL, 0x0120, &[OP, 0]);
    wire.pass_ms(3000);
    assert_eq!(wire.al_status(TERMINAL), (SAFEOP | 0x10, 0x002d));
}

#[test]
fn the_way_back_is_always_open_and_closes_the_process_data() {
    let mut wire = safeop_on_clock(SYNC1_NS);
    wire.pass_ms(30);
    wire.process_data(0, 0);
    assert_eq!(wire.request(TERMINAL, OP), (OP, 0));
    assert_eq!(wire.process_data(0, 0).0, 3);
    for state in [SAFEOP, PREOP, INIT] {
        assert_eq!(wire.request(TERMINAL, state), (state, 0));
        assert_eq!(wire.process_data(0, 0).0, if state == SAFEOP { 3 } else { 0 });
    }
}

pub fn abort_code(answer: &[u8]) -> u32 {
    assert_eq!(answer[0], 0x80, "an abort: {answer:02x?}");
    u32::from_le_bytes(answer[4..8].try_into().unwrap())
}

pub fn download(index: u16, subindex: u8, value: &[u8]) -> Vec<u8> {
    let [i0, i1] = index.to_le_bytes();
    let mut request = vec![0x23 | (4 - value.len() as u8) << 2, i0, i1, subindex, 0, 0, 0, 0];
    request[4..4 + value.len()].copy_from_slice(value);
    request
}

pub fn upload(index: u16, subindex: u8) -> [u8; 8] {
    let [i0, i1] = index.to_le_bytes();
    [0x40, i0, i1, subindex, 0, 0, 0, 0]
}

#[test]
fn interpolation_is_one_byte_from_8_to_13() {
    let mut wire = preop();
    for bits in 8..=13u8 {
        assert_eq!(wire.sdo(TERMINAL, &download(0x8001, 0x11, &[bits]))[0], 0x60);
        assert_eq!(wire.sdo(TERMINAL, &upload(0x8001, 0x11))[..5], [0x4f, 0x01, 0x80, 0x11, bits]);
    }
    for bits in [0, 7, 14, 255u8] {
        assert_eq!(abort_code(&wire.sdo(TERMINAL, &download(0x8001, 0x11, &[bits]))), 0x0609_0030);
    }
    assert_eq!(abort_code(&wire.sdo(TERMINAL, &download(0x8001, 0x11, &[12, 0]))), 0x0607_0010);
    assert_eq!(wire.sdo(TERMINAL, &upload(0x8001, 0x11))[4], 13, "refused values change nothing");
}

#[test]
fn what_does_not_exist_or_is_fixed_is_aborted_with_its_code() {
    let mut wire = preop();
    let mut code = |content: &[u8]| abort_code(&wire.sdo(TERMINAL, content));
    assert_eq!(code(&upload(0x5555, 0)), 0x0602_0000);
    assert_eq!(code(&upload(0x8001, 0x12)), 0x0609_0011);
    assert_eq!(code(&upload(0x1a01, 0)), 0x0602_0000, "revision 20 has no frequency");
    assert_eq!(code(&download(0x1c12, 0, &[0])), 0x0601_0002);
    assert_eq!(code(&download(0x6000, 0x11, &[0; 4])), 0x0601_0002);
    assert_eq!(code(&download(0x8000, 0x01, &[2])), 0x0609_0030);
    assert_eq!(code(&[0xe0, 0, 0, 0, 0, 0, 0, 0]), 0x0504_0001, "no such command");
    assert_eq!(code(&[0x50, 0x01, 0x80, 1, 0, 0, 0, 0]), 0x0601_0000, "no complete access");
}

#[test]
fn long_values_come_in_a_normal_transfer() {
    let mut wire = preop();
    let answer = wire.sdo(TERMINAL, &upload(0x1008, 0));
    assert_eq!(answer[..8], [0x41, 0x08, 0x10, 0, 6, 0, 0, 0]);
    assert_eq!(&answer[8..], b"EL5021");
    let restore = [&[0x21, 0x11, 0x10, 1, 4, 0, 0, 0][..], b"load"].concat();
    wire.sdo(TERMINAL, &download(0x8001, 0x11, &[12]));
    assert_eq!(wire.sdo(TERMINAL, &restore)[0], 0x60);
    assert_eq!(wire.sdo(TERMINAL, &upload(0x8001, 0x11))[4], 10, "defaults are back");
}

#[test]
fn the_list_of_objects_can_be_read_and_every_object_in_it_too() {
    let mut wire = preop();
    let answer = wire.mailbox(TERMINAL, 3, &[0, 0x80, 1, 0, 0, 0, 1, 0]);
    assert_eq!(answer[7..14], [0x80, 2, 0, 0, 0, 1, 0]);
    let indices: Vec<u16> =
        answer[14..].chunks(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]])).collect();
    assert!(indices.is_sorted() && indices.contains(&0x8001));
    for index in indices {
        let answer = wire.sdo(TERMINAL, &upload(index, 0));
        assert_eq!(answer[0] >> 5, 2, "{index:#06x} can be uploaded");
    }
}

#[test]
fn other_mailbox_protocols_get_an_error_reply() {
    let mut wire = preop();
    let answer = wire.mailbox(TERMINAL, 4, &[1, 0, 0, 0, 0, 0]);
    assert_eq!(answer[5] & 0x0f, 0);
    assert_eq!(answer[6..10], [1, 0, 2, 0], "unsupported protocol");
}
