//! What damage does to a frame's bytes.

use rand::{Rng, rngs::StdRng};

/// Ethernet header and EtherCAT header.
const HEADERS_LEN: usize = 14 + 2;
const DATAGRAM_HEADER_LEN: usize = 10;
const WORKING_COUNTER_LEN: usize = 2;
const LENGTH_MASK: u16 = 0x07ff;
const MORE_FOLLOWS: u16 = 0x8000;
const LRD: u8 = 10;
const LRW: u8 = 12;
/// Of the frames damaged on their way back, the network card notices this share.
const CARD_NOTICES: f64 = 0.5;

/// Where a datagram lies in a frame.
struct Place {
    start: usize,
    data: usize,
    working_counter: usize,
}

fn datagrams(frame: &[u8]) -> impl Iterator<Item = Place> + '_ {
    let mut next = Some(HEADERS_LEN);
    std::iter::from_fn(move || {
        let start = next.take()?;
        let length = frame.get(start + 6..)?.first_chunk::<2>().map(|bytes| u16::from_le_bytes(*bytes))?;
        let data = start + DATAGRAM_HEADER_LEN;
        let working_counter = data + usize::from(length & LENGTH_MASK);
        let end = working_counter + WORKING_COUNTER_LEN;
        next = (length & MORE_FOLLOWS != 0).then_some(end);
        (end <= frame.len()).then_some(Place { start, data, working_counter })
    })
}

/// As if devices had not taken part in the process data: fewer counted, and bytes that are not theirs.
pub fn shorten_working_counters(frame: &mut [u8], by: u16) {
    let places: Vec<Place> = datagrams(frame).collect();
    for place in places {
        if !(LRD..=LRW).contains(&frame[place.start]) {
            continue;
        }
        let counter = &mut frame[place.working_counter..][..WORKING_COUNTER_LEN];
        let short = u16::from_le_bytes([counter[0], counter[1]]).saturating_sub(by);
        counter.copy_from_slice(&short.to_le_bytes());
        frame[place.data..place.working_counter].iter_mut().for_each(|byte| *byte ^= 0x5a);
    }
}

/// Damages a reply; its length then, or none where the network card drops it. Data stay as they are: a card that lets
/// through flipped data would be one without a check sequence, and EtherCAT has no other protection for them.
pub fn corrupt(frame: &mut [u8], random: &mut StdRng) -> Option<usize> {
    if random.random_bool(CARD_NOTICES) {
        return None;
    }
    if random.random_bool(0.3) {
        return Some(random.random_range(0..frame.len()));
    }
    let places: Vec<Place> = datagrams(frame).collect();
    let structure: Vec<usize> = (0..HEADERS_LEN)
        .chain(places.iter().flat_map(|place| {
            (place.start..place.data).chain(place.working_counter..place.working_counter + 2)
        }))
        .collect();
    let flips = random.random_range(1..4);
    for _ in 0..flips {
        let byte = structure[random.random_range(0..structure.len())];
        frame[byte] ^= 1 << random.random_range(0..8);
    }
    Some(frame.len())
}
