//! Properties that every stream of readings must have, for any log.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::borrow::Cow;
use std::f64::consts::TAU;

use identify::logs::Stream;
use proptest::prelude::*;

/// Longest interval that does not count as a gap in these streams \[s\].
const GAP_S: f64 = 0.05;

/// Irregular stamps that start at 0, some of them after a gap \[s\].
fn times() -> impl Strategy<Value = Vec<f64>> {
    let step_s = prop_oneof![9 => 0.002..0.02, 1 => 0.06..1.0];
    proptest::collection::vec(step_s, 30..120).prop_map(|steps| {
        let later = |t_s: &mut f64, step_s: f64| Some(std::mem::replace(t_s, *t_s + step_s));
        steps.into_iter().scan(0.0, later).collect()
    })
}

fn stream<const N: usize>(t_s: Vec<f64>, of: impl Fn(f64) -> [f64; N]) -> Stream<[f64; N]> {
    let rows = t_s.iter().map(|t_s| of(*t_s)).collect();
    Stream::new(1_795_000_000_123_456_789, t_s, rows).with_gap_limit(GAP_S)
}

proptest! {
    #[test]
    fn nothing_is_interpolated_across_a_gap(t_s in times(), part in 0.001..0.999) {
        let stream = stream(t_s, |t_s| [t_s.sin(), -3.0 * t_s]);
        let (spline, parts) = (stream.clone().spline(), stream.parts());
        for row in 0..stream.len() - 1 {
            let (from_s, to_s) = (stream.t_s[row], stream.t_s[row + 1]);
            let t_s = from_s + part * (to_s - from_s);
            let is_bridged = to_s - from_s <= GAP_S;
            prop_assert_eq!(stream.at(t_s).is_some(), is_bridged);
            prop_assert_eq!(stream.at(from_s), Some(stream[row]));
            let within = parts.iter().find(|part| part.contains(&row)).unwrap();
            prop_assert_eq!(within.contains(&(row + 1)), is_bridged);
            let curve = spline.as_ref().and_then(|spline| spline.at(t_s));
            prop_assert_eq!(curve.is_some(), is_bridged && within.len() >= 4);
            if let (Some(line), Some(curve)) = (stream.at(t_s), curve) {
                prop_assert!((line[1] + 3.0 * t_s).abs() < 1e-9 && (curve.value[1] + 3.0 * t_s).abs() < 1e-9);
                prop_assert!((curve.value[0] - t_s.sin()).abs() < 1e-5 && (curve.rate[1] + 3.0).abs() < 1e-7);
            }
        }
        for outside_s in [-1e-3, stream.duration_s() + 1e-3, f64::NAN] {
            prop_assert!(stream.at(outside_s).is_none());
        }
    }

    #[test]
    fn a_wrapped_stream_unwraps_to_the_stream(t_s in times(), rate in -9.0..9.0, phase in -3.0..3.0) {
        let truth = stream(t_s, |t_s| [rate * (t_s + phase) + t_s.sin(), 0.3 * t_s.cos()]);
        let wrapped = truth.map(|[turned, swung]| [turned - (turned / TAU).round() * TAU, *swung]);
        let continuous = wrapped.unwrapped(TAU);
        let jumps = |pair: &[[f64; 2]]| (pair[1][0] - pair[0][0]).abs() > 0.5 * TAU;
        let begins_anew = wrapped.parts().into_iter().any(|part| wrapped[part].windows(2).any(jumps));
        prop_assert_eq!(matches!(continuous, Cow::Owned(_)), begins_anew);
        for part in truth.parts() {
            // The number of turns during a gap is unknown, so whole turns are permitted between segments.
            let turns = (continuous[part.start][0] - truth[part.start][0]) / TAU;
            prop_assert!((turns - turns.round()).abs() < 1e-9);
            for row in part {
                prop_assert!((continuous[row][0] - truth[row][0] - turns * TAU).abs() < 1e-9);
                prop_assert_eq!(continuous[row][1], truth[row][1]);
            }
        }
    }

    #[test]
    fn an_average_keeps_a_straight_line_and_the_stamps(t_s in times(), slope in -5.0..5.0) {
        let width_s = 0.06;
        let line = stream(t_s, |t_s| [700.0 + slope * t_s]);
        let averages = line.averages(width_s);
        prop_assert_eq!(averages.len(), line.len());
        for part in line.parts() {
            for row in part.clone() {
                let ends_s = [line.t_s[part.start], line.t_s[part.end - 1]];
                let inside_s = (line.t_s[row] - ends_s[0]).min(ends_s[1] - line.t_s[row]);
                if (inside_s - width_s).abs() > 1e-6 {
                    prop_assert_eq!(averages[row].is_some(), inside_s > width_s && part.len() >= 4);
                }
                prop_assert!(averages[row].is_none_or(|average| (average[0] - line[row][0]).abs() < 1e-9));
            }
        }
        let kept: Vec<usize> = (0..line.len()).filter(|row| averages[*row].is_some()).collect();
        let averaged = line.averaged(width_s);
        prop_assert_eq!(averaged.len(), kept.len());
        for (place, row) in kept.into_iter().enumerate() {
            prop_assert!((averaged.stamp_ns(place).unwrap() - line.stamp_ns(row).unwrap()).abs() <= 1);
        }
    }

    #[test]
    fn a_slice_keeps_stamps_and_rows(t_s in times(), from in 0_usize..30, to in 30_usize..150) {
        let whole = stream(t_s, |t_s| [t_s]);
        let slice = whole.slice(from..to);
        prop_assert_eq!(slice.t_s[0], 0.0);
        prop_assert_eq!(&slice[..], &whole[from..to.min(whole.len())]);
        prop_assert_eq!(slice.gap_limit_s, whole.gap_limit_s);
        for row in 0..slice.len() {
            prop_assert!((slice.stamp_ns(row).unwrap() - whole.stamp_ns(from + row).unwrap()).abs() <= 1);
        }
        let mut pushed = Stream::default();
        (0..whole.len()).for_each(|row| pushed.push(whole.stamp_ns(row).unwrap(), whole[row]));
        prop_assert_eq!(pushed.first_stamp_ns, whole.first_stamp_ns);
        prop_assert!(pushed.t_s.iter().zip(&whole.t_s).all(|(a, b)| (a - b).abs() < 1e-9));
    }
}
