//! Damages the bytes of a reply. The damage is a working counter that is too low, a missing end, or
//! inverted bits outside the data.

use rand::{Rng, rngs::StdRng};

use crate::frame::{self, DATAGRAM_HEADER_LEN, Datagram, WORKING_COUNTER_LEN};

/// Range of the commands with logical addresses, from first to last.
const LRD: u8 = 10;
const LRW: u8 = 12;
/// Fraction of the frames damaged on their way back whose damage the network card detects. The card drops these frames.
const DETECTED_SHARE: f64 = 0.5;
/// Fraction of the other damaged frames whose end is missing. The rest of them have inverted bits.
const SHORTENED_SHARE: f64 = 0.3;

/// Simulates that some devices did not process the frame. Its datagrams then have a lower working counter and wrong data.
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

/// Damages a reply. Returns its length, or `None` if the network card drops the frame. The data in the datagrams are
/// never changed. The check sequence protects them, no network card passes on a frame with damaged data, and
/// EtherCAT has no further protection.
pub fn corrupt(frame: &mut [u8], random: &mut StdRng) -> Option<usize> {
    if random.random_bool(DETECTED_SHARE) {
        return None;
    }
    if random.random_bool(SHORTENED_SHARE) {
        return Some(random.random_range(0..frame.len()));
    }
    let datagrams = frame::datagrams(frame)?;
    // Indices of all bytes except the data of datagrams.
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
