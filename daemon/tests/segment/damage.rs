//! Whatever data a frame contains, the segment does not panic and does not change the length of the frame.

use proptest::prelude::*;

use super::frames::*;
use super::operation::Ramp;

/// A wire with one terminal in OP and one in its initial state.
fn operating() -> Wire {
    let mut wire = Wire::new(2, Ramp);
    wire.enter_safeop(TERMINAL);
    wire.process_data(0, 0);
    assert_eq!(wire.request(TERMINAL, OP), (OP, 0));
    wire
}

fn enter(wire: &mut Wire, frame: &[u8]) {
    let mut reply = [0; 1518];
    let returned = wire.segment.exchange(wire.now_ns, frame, &mut reply);
    assert!(returned.is_none_or(|len| len == frame.len()));
}

fn any_datagram() -> impl Strategy<Value = Datagram> {
    let addresses = prop_oneof![Just(0u16), Just(0xffff), Just(STATION), Just(TERMINAL), any::<u16>()];
    let memory = prop_oneof![0u16..0x0a00, 0x0f00u16..0x2100, any::<u16>()];
    let data = prop_oneof![
        prop::collection::vec(any::<u8>(), 0..40),
        prop::collection::vec(any::<u8>(), 128..=128),
    ];
    (0u8..17, addresses, memory, data)
        .prop_map(|(command, device, memory, data)| datagram(command, device, memory, &data))
}

/// Any mailbox request with a valid header, so that the request reaches the object dictionary.
fn any_mailbox_request() -> impl Strategy<Value = Datagram> {
    (prop::collection::vec(any::<u8>(), 128..=128), 0u16..140, any::<bool>()).prop_map(
        |(mut data, length, coe)| {
            data[..2].copy_from_slice(&length.to_le_bytes());
            if coe {
                data[5] = data[5] & 0x70 | 3;
                data[7] = if data[7] & 1 == 0 { 0x20 } else { 0x80 };
            }
            datagram(FPWR, TERMINAL, 0x1000, &data)
        },
    )
}

proptest! {
    #[test]
    fn random_bytes_do_no_harm(bytes in prop::collection::vec(any::<u8>(), 0..1518), ethercat in any::<bool>()) {
        let mut bytes = bytes;
        if ethercat && bytes.len() > 16 {
            bytes[12..14].copy_from_slice(&[0x88, 0xa4]);
            bytes[15] = bytes[15] & 0x07 | 0x10;
        }
        enter(&mut operating(), &bytes);
    }

    #[test]
    fn random_commands_do_no_harm(
        datagrams in prop::collection::vec(prop_oneof![any_datagram(), any_mailbox_request()], 1..8),
        pauses_ns in prop::collection::vec(0i64..1 << 40, 8),
    ) {
        let mut wire = operating();
        for (datagram, pause_ns) in datagrams.iter().zip(pauses_ns) {
            enter(&mut wire, &encode(std::slice::from_ref(datagram)));
            wire.now_ns += pause_ns;
        }
        enter(&mut wire, &encode(&datagrams));
    }

    #[test]
    fn damaged_frames_do_no_harm(
        datagrams in prop::collection::vec(any_datagram(), 1..6),
        flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..6),
        cut in any::<prop::sample::Index>(),
    ) {
        let mut frame = encode(&datagrams);
        for (at, byte) in flips {
            let at = at.index(frame.len());
            frame[at] = byte;
        }
        let mut wire = operating();
        enter(&mut wire, &frame);
        frame.truncate(cut.index(frame.len()));
        enter(&mut wire, &frame);
    }
}
