//! Rules of single datagrams: addressing of devices, exchange of data, and the working counter.

use super::frames::*;
use super::operation::Ramp;

const SCRATCH: u16 = 0x1f00;

#[test]
fn a_broadcast_read_joins_all_answers_and_counts_every_device() {
    let mut wire = Wire::new(5, Ramp);
    for position in 0..6u16 {
        assert_eq!(wire.write(STATION + position, SCRATCH, &[1 << position]), 1);
    }
    let [reply] = wire.send([datagram(BRD, 0, SCRATCH, &[0x80])]);
    assert_eq!((reply.data, reply.working_counter, reply.device), (vec![0xbf], 6, 6));
}

#[test]
fn a_broadcast_write_reaches_every_device() {
    let mut wire = Wire::new(3, Ramp);
    let [write, exchange] =
        wire.send([datagram(BWR, 0, SCRATCH, &[0x05]), datagram(BRW, 0, SCRATCH, &[0x40])]);
    assert_eq!(write.working_counter, 4);
    assert_eq!(exchange.working_counter, 4 * 3);
    assert_eq!(exchange.data, [0x45], "the device reads before the write of the same command");
}

#[test]
fn a_position_is_counted_up_at_every_device_and_zero_is_meant() {
    let mut wire = Wire::new(5, Ramp);
    let links = [0x5a31u16, 0x5a33, 0x5a33, 0x5a33, 0x5a33, 0x5613];
    for (position, expected) in links.into_iter().enumerate() {
        let address = 0u16.wrapping_sub(position as u16);
        let [reply] = wire.send([datagram(APRD, address, 0x0110, &[0, 0])]);
        assert_eq!(reply.data, expected.to_le_bytes());
        assert_eq!((reply.working_counter, reply.device), (1, address.wrapping_add(6)));
    }
    let [beyond] = wire.send([datagram(APRD, 0u16.wrapping_sub(6), 0x0110, &[7, 7])]);
    assert_eq!((beyond.working_counter, beyond.data), (0, vec![7, 7]));
}

#[test]
fn a_foreign_address_leaves_data_and_working_counter_alone() {
    let mut wire = Wire::new(5, Ramp);
    for command in [FPRD, FPWR, FPRW] {
        let sent = datagram(command, 0x2000, 0x0110, &[0xaa, 0x55]);
        let [reply] = wire.send([Datagram { working_counter: 9, ..sent.clone() }]);
        assert_eq!((reply.data, reply.working_counter), (sent.data, 9));
    }
    let nop = datagram(NOP, 0, 0x0110, &[1, 2]);
    assert_eq!(wire.send([nop.clone()]), [nop]);
}

#[test]
fn an_exchange_counts_three_and_swaps_the_data() {
    let mut wire = Wire::new(2, Ramp);
    let [first, second] =
        wire.send([datagram(FPRW, TERMINAL, SCRATCH, &[3, 4]), datagram(APRW, 0xffff, SCRATCH, &[5, 6])]);
    assert_eq!((first.data, first.working_counter), (vec![0, 0], 3));
    assert_eq!((second.data, second.working_counter), (vec![3, 4], 3));
    assert_eq!(wire.read::<2>(TERMINAL, SCRATCH), [5, 6]);
}

#[test]
fn the_reference_clock_is_read_and_all_others_are_written() {
    let mut wire = Wire::new(5, Ramp);
    let [armw, frmw] =
        wire.send([datagram(ARMW, 0, SCRATCH, &[0, 0]), datagram(FRMW, STATION, 0x0910, &[0; 8])]);
    assert_eq!((armw.working_counter, frmw.working_counter), (6, 6));
    assert_ne!(frmw.data, [0; 8]);
    let own: [u8; 8] = wire.read(STATION, 0x0910);
    assert!(u64::from_le_bytes(own) > u64::from_le_bytes(frmw.data.try_into().unwrap()));
}

#[test]
fn read_only_registers_and_addresses_beyond_memory_are_not_written() {
    let mut wire = Wire::new(1, Ramp);
    assert_eq!(wire.write(TERMINAL, 0x0000, &[0xff; 4]), 0);
    assert_eq!(wire.read::<1>(TERMINAL, 0x0000), [0x11]);
    assert_eq!(wire.write(TERMINAL, 0x0130, &[8, 0]), 0);
    assert_eq!(wire.al_status(TERMINAL), (INIT, 0));
    assert_eq!(wire.write(TERMINAL, 0x2000, &[1]), 0);
    assert_eq!(wire.write(TERMINAL, 0xffff, &[1, 2, 3]), 0);
    // The terminal has no sync manager 4 and no FMMU 3.
    assert_eq!(wire.write(TERMINAL, 0x0820, &[0; 8]), 0);
    assert_eq!(wire.write(TERMINAL, 0x0630, &[0; 16]), 0);
}

#[test]
fn logical_commands_count_inputs_and_outputs_once_they_are_open() {
    let mut wire = Wire::new(1, Ramp);
    let data = [0x55; 22];
    let count = |wire: &mut Wire| {
        [LRD, LWR, LRW].map(|command| wire.send([logical(command, 0, &data)])[0].working_counter)
    };
    assert_eq!(count(&mut wire), [0, 0, 0], "not mapped");
    wire.enter_preop(TERMINAL);
    wire.map(TERMINAL);
    assert_eq!(count(&mut wire), [0, 0, 0], "the device opens process data in SAFE-OP");
    assert_eq!(wire.request(TERMINAL, SAFEOP), (SAFEOP, 0));
    assert_eq!(count(&mut wire), [1, 1, 3]);
    let [reply] = wire.send([logical(LRW, 0, &data)]);
    assert_eq!(reply.data[10..], data[10..], "outputs pass on as they came");
    assert_ne!(reply.data[..10], data[..10], "inputs are put in");
    // An FMMU without its sync manager transfers no data.
    wire.sync_manager(TERMINAL, 3, 0x1180, 0, 0x20);
    assert_eq!(count(&mut wire), [0, 1, 2]);
}

#[test]
fn an_fmmu_answers_for_its_part_of_a_datagram_only() {
    let mut wire = Wire::new(1, Ramp);
    wire.enter_safeop(TERMINAL);
    let [before, part, behind] =
        wire.send([logical(LRD, 0xffff_fff0, &[7; 16]), logical(LRD, 8, &[7; 4]), logical(LRD, 10, &[7; 4])]);
    assert_eq!((before.working_counter, before.data), (0, vec![7; 16]));
    assert_eq!(part.working_counter, 1);
    assert_eq!(part.data[2..], [7, 7]);
    assert_eq!((behind.working_counter, behind.data), (0, vec![7; 4]));
}

#[test]
fn the_mailbox_state_can_be_mapped_as_a_single_bit() {
    let mut wire = Wire::new(1, Ramp);
    wire.enter_preop(TERMINAL);
    let mut registers = [0; 16];
    registers[..4].copy_from_slice(&100u32.to_le_bytes());
    registers[4] = 1; // one byte, and only its bit 2
    (registers[6], registers[7]) = (2, 2);
    registers[8..10].copy_from_slice(&0x080du16.to_le_bytes());
    (registers[10], registers[11], registers[12]) = (3, 1, 1);
    assert_eq!(wire.write(TERMINAL, 0x0620, &registers), 1);
    let state = |wire: &mut Wire| wire.send([logical(LRD, 100, &[0x80])])[0].clone();
    assert_eq!((state(&mut wire).data, state(&mut wire).working_counter), (vec![0x80], 1));
    assert_eq!(wire.write(TERMINAL, 0x1000, &[0; 128]), 1);
    wire.pass_ms(1);
    assert_eq!(state(&mut wire).data, [0x84]);
}

#[test]
fn a_full_mailbox_takes_nothing_and_an_empty_one_gives_nothing() {
    let mut wire = Wire::new(1, Ramp);
    wire.enter_preop(TERMINAL);
    let mut upload = [0; 128];
    upload[..13].copy_from_slice(&[10, 0, 0, 0, 0, 0x13, 0, 0x20, 0x40, 0x00, 0x10, 0, 0]);
    let [empty] = wire.send([datagram(FPRD, TERMINAL, 0x1080, &[0; 128])]);
    assert_eq!(empty.working_counter, 0);
    assert_eq!(wire.write(TERMINAL, 0x1000, &upload), 1);
    assert_eq!(wire.read::<1>(TERMINAL, 0x0805), [0x09], "full");
    assert_eq!(wire.write(TERMINAL, 0x1000, &upload), 0);
    wire.pass_ms(1);
    assert_eq!(wire.read::<1>(TERMINAL, 0x0805), [0x00], "taken by the device");
    assert_eq!(wire.read::<1>(TERMINAL, 0x080d)[0] & 0x08, 0x08, "an answer is available");
    let answer: [u8; 128] = wire.read(TERMINAL, 0x1080);
    assert_eq!(wire.read::<1>(TERMINAL, 0x080d)[0] & 0x08, 0);
    // The master requests the same reply again by toggling the repeat bit.
    assert_eq!(wire.write(TERMINAL, 0x080e, &[0x03]), 1);
    assert_eq!(wire.read::<128>(TERMINAL, 0x1080), answer);
    assert_eq!(wire.read::<1>(TERMINAL, 0x080f), [0x02], "acknowledged");
}

#[test]
fn a_mailbox_is_not_read_or_written_from_its_middle() {
    let mut wire = Wire::new(1, Ramp);
    wire.enter_preop(TERMINAL);
    assert_eq!(wire.write(TERMINAL, 0x1004, &[0; 124]), 0);
    assert_eq!(wire.write(TERMINAL, 0x0ff0, &[0; 32]), 0, "across the border");
    assert_eq!(wire.write(TERMINAL, 0x1080, &[0; 128]), 0, "wrong direction");
    assert_eq!(wire.write(TERMINAL, 0x1000, &[0; 64]), 1);
    assert_eq!(wire.read::<1>(TERMINAL, 0x0805), [0x00], "not full before its last byte");
}

#[test]
fn the_eeprom_is_busy_for_a_while_and_belongs_to_one_side() {
    let mut wire = Wire::new(1, Ramp);
    let read_product = [0x00, 0x01, 0x0a, 0, 0, 0];
    for (station, product) in [(STATION, 0x044c_2c52u32), (TERMINAL, 0x139d_3052)] {
        assert_eq!(wire.write(station, 0x0502, &read_product), 1);
        assert_eq!(wire.read::<2>(station, 0x0502)[1] & 0x80, 0x80, "busy");
        wire.pass_ms(1);
        assert_eq!(wire.read::<2>(station, 0x0502)[1] & 0x80, 0);
        assert_eq!(u32::from_le_bytes(wire.read(station, 0x0508)), product);
    }
    assert_eq!(wire.write(TERMINAL, 0x0500, &[1]), 1);
    wire.write(TERMINAL, 0x0502, &read_product);
    assert_eq!(wire.read::<2>(TERMINAL, 0x0502)[1] & 0x20, 0x20, "the device owns the EEPROM");
    wire.write(TERMINAL, 0x0500, &[2]);
    wire.write(TERMINAL, 0x0500, &[0]);
    wire.write(TERMINAL, 0x0502, &read_product);
    assert_eq!(wire.read::<2>(TERMINAL, 0x0502)[1] & 0x20, 0);
}

#[test]
fn the_coupler_has_the_checksum_of_a_real_one() {
    let mut wire = Wire::new(1, Ramp);
    wire.write(STATION, 0x0502, &[0x00, 0x01, 0x07, 0, 0, 0]);
    wire.pass_ms(1);
    assert_eq!(wire.read::<2>(STATION, 0x0508), [0x46, 0]);
}

#[test]
fn a_returned_frame_is_marked_and_other_frames_do_not_return() {
    let mut wire = Wire::new(0, Ramp);
    let frame = encode(&[datagram(BRD, 0, 0, &[0])]);
    let mut reply = [0; 1518];
    assert_eq!(wire.segment.exchange(wire.now_ns, &frame, &mut reply), Some(frame.len()));
    assert_eq!(reply[6..12], [0x12, 0x10, 0x10, 0x10, 0x10, 0x10]);
    assert_eq!(wire.segment.exchange(wire.now_ns, &frame, &mut reply[..20]), None);
    let mut internet = frame.clone();
    internet[12..14].copy_from_slice(&[0x08, 0x00]);
    assert_eq!(wire.segment.exchange(wire.now_ns, &internet, &mut reply), None);
}
