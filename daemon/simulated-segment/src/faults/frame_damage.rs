//! Damage to the bytes of a frame.

use rand::{Rng, rngs::StdRng};

use crate::frame::{self, DATAGRAM_HEADER_LEN, Datagram, WORKING_COUNTER_LEN};

const LRD: u8 = 10;
const LRW: u8 = 12;
/// Share of frames damaged on their way back that the network card detects.
const CARD_NOTICES: f64 = 0.5;

/// Simulates devices that did not process the frame: a lower working counter, and wrong data.
pub fn shorten_working_counters(frame: &mut [u8], by: u16) {
    let Some(mut rest) = frame::datagrams(frame).and_then(|range| frame.get_mut(range)) else { return };
    while let Some((mut datagram, behind)) = Datagram::split_first(rest) {
        if (LRD..=LRW).contains(&datagram.command()) {
            datagram.count_less(by);
            datagram.data.iter_mut().for_each(|byte| *byte ^= 0x5a);
        }
        rest = behind;
    }
}

/// Damages a reply; returns its length, or `None` if the network card drops it. Data stay unchanged: with a check
/// sequence no card passes damaged data, and EtherCAT has no other protection for them.
pub fn corrupt(frame: &mut [u8], random: &mut StdRng) -> Option<usize> {
    if random.random_bool(CARD_NOTICES) {
        return None;
    }
    if random.random_bool(0.3) {
        return Some(random.random_range(0..frame.len()));
    }
    let datagrams = frame::datagrams(frame)?;
    let mut structure: Vec<usize> = (0..datagrams.start).collect();
    let (mut start, mut rest) = (datagrams.start, &mut frame[datagrams]);
    while let Some((datagram, behind)) = Datagram::split_first(rest) {
        let data = start + DATAGRAM_HEADER_LEN;
        let working_counter = data + datagram.data.len();
        structure.extend((start..data).chain(working_counter..working_counter + WORKING_COUNTER_LEN));
        (start, rest) = (working_counter + WORKING_COUNTER_LEN, behind);
    }
    let flips = random.random_range(1..4);
    for _ in 0..flips {
        let byte = structure[random.random_range(0..structure.len())];
        frame[byte] ^= 1 << random.random_range(0..8);
    }
    Some(frame.len())
}
