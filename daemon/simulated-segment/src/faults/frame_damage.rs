//! Damage to the bytes of a reply: short working counters, a missing end, or inverted bits outside the data.

use rand::{Rng, rngs::StdRng};

use crate::frame::{self, DATAGRAM_HEADER_LEN, Datagram, WORKING_COUNTER_LEN};

/// First and last of the commands with logical addresses.
const LRD: u8 = 10;
const LRW: u8 = 12;
/// Share of frames damaged on their way back that the network card detects.
const DETECTED_SHARE: f64 = 0.5;
/// Share of the other ones whose end is missing.
const SHORTENED_SHARE: f64 = 0.3;

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
    if random.random_bool(DETECTED_SHARE) {
        return None;
    }
    if random.random_bool(SHORTENED_SHARE) {
        return Some(random.random_range(0..frame.len()));
    }
    let datagrams = frame::datagrams(frame)?;
    // Indices of all bytes outside the data.
    let mut structure: Vec<usize> = (0..datagrams.start).collect();
    let (mut start, mut rest) = (datagrams.start, &mut frame[datagrams]);
    while let Some((datagram, behind)) = Datagram::split_first(rest) {
        let data = start + DATAGRAM_HEADER_LEN;
        let working_counter = data + datagram.data.len();
        let end = working_counter + WORKING_COUNTER_LEN;
        structure.extend((start..data).chain(working_counter..end));
        (start, rest) = (end, behind);
    }
    let flips = random.random_range(1..4);
    for _ in 0..flips {
        let byte = structure[random.random_range(0..structure.len())];
        frame[byte] ^= 1 << random.random_range(0..8);
    }
    Some(frame.len())
}
