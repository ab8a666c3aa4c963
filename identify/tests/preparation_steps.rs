//! Single steps of the preparation on made-up values.
#![allow(clippy::unwrap_used, reason = "tests")]

use identify::prepare::{Channels, correlate, fit_sphere, select};
use nalgebra::Vector3;
use proptest::prelude::*;

/// Values between 0 and 1 that look random.
fn hash(k: i64) -> f64 {
    let x = (k as f64 * 12.9898).sin() * 43_758.545_3;
    x - x.floor()
}

/// A smooth irregular signal, at a fractional place.
fn wave(at: f64) -> f64 {
    (0..12).map(|k| hash(k) * (at * (0.01 + 0.03 * hash(k + 50)) + 6.0 * hash(k + 99)).sin()).sum()
}

fn channels(from: f64, count: usize) -> Channels {
    Channels {
        known: vec![true; count],
        values: vec![
            (0..count).map(|k| wave(from + k as f64)).collect(),
            (0..count).map(|k| 3.0 + 100.0 * wave(5000.0 + from + k as f64)).collect(),
        ],
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(30))]
    #[test]
    fn a_shift_is_found_within_half_a_step(shift in -400.0f64..1500.0) {
        let found = correlate(&channels(0.0, 2000), &channels(shift, 1000), 300).unwrap();
        prop_assert!((found.shift - shift).abs() < 0.5, "{} {}", found.shift, shift);
        prop_assert!(found.correlation > 0.99);
    }

    #[test]
    fn selected_samples_are_few_in_order_and_apart(count in 2usize..400, points_max in 1usize..200, step in 0.001f64..0.2) {
        let angles: Vec<[f64; 5]> =
            (0..count).map(|k| std::array::from_fn(|j| wave(k as f64 * 3.0 + 100.0 * j as f64))).collect();
        let kept = select(&angles, step, points_max);
        prop_assert!(!kept.is_empty() && kept.len() <= points_max);
        for pair in kept.windows(2) {
            prop_assert!(pair[0] < pair[1]);
            let moved = (0..5).map(|j| (angles[pair[0]][j] - angles[pair[1]][j]).abs()).fold(0.0, f64::max);
            prop_assert!(moved >= step);
        }
    }
}

#[test]
fn unknown_samples_do_not_disturb_the_correlation() {
    let mut first = channels(0.0, 2000);
    for k in (300..500).chain(900..950) {
        first.known[k] = false;
        first.values[0][k] = f64::from(k as u32) * 1e6;
    }
    let found = correlate(&first, &channels(222.4, 1000), 300).unwrap();
    assert!((found.shift - 222.4).abs() < 0.5 && found.correlation > 0.99, "{found:?}");
}

#[test]
fn a_repeated_motion_is_matched_where_the_overlap_is_longest() {
    let periodic = |from: usize, count: usize| Channels {
        known: vec![true; count],
        values: vec![(from..from + count).map(|k| wave((k % 700) as f64)).collect()],
    };
    let found = correlate(&periodic(0, 2100), &periodic(0, 2100), 300).unwrap();
    assert!(found.shift.abs() < 0.1 && found.runner_up > 0.999, "{found:?}");
}

#[test]
fn signals_that_stand_still_match_nothing() {
    let still = Channels { known: vec![true; 500], values: vec![vec![1.0; 500]] };
    assert!(correlate(&still, &channels(0.0, 500), 100).is_none());
    let nothing = Channels { known: vec![], values: vec![vec![], vec![]] };
    assert!(correlate(&nothing, &channels(0.0, 500), 100).is_none());
    assert!(correlate(&channels(0.0, 90), &channels(0.0, 500), 100).is_none());
}

/// Points on a part of a sphere, 0.6 m about (1, 2, 3), off by up to `noise_m`.
fn cap(count: i64, noise_m: f64) -> Vec<Vector3<f64>> {
    (0..count)
        .map(|k| {
            let (azimuth, polar) = (3.0 * hash(k), 0.3 + hash(k + 1000));
            let radius = 0.6 + noise_m * (2.0 * hash(k + 2000) - 1.0);
            let out = Vector3::new(polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos());
            Vector3::new(1.0, 2.0, 3.0) + out * radius
        })
        .collect()
}

#[test]
fn a_sphere_is_found_among_points_that_are_not_on_it() {
    let mut points = cap(300, 0.001);
    points.extend((0..150).map(|k| Vector3::new(3.0 * hash(k), 3.0 * hash(k + 7), 4.0 * hash(k + 13))));
    let sphere = fit_sphere(&points, 0.01).unwrap();
    assert!((sphere.centre_m - Vector3::new(1.0, 2.0, 3.0)).norm() < 2e-3, "{sphere:?}");
    assert!((sphere.radius_m - 0.6).abs() < 2e-3);
    assert!((0.6..0.75).contains(&sphere.inliers));
    assert!(sphere.rms_m < 2e-3);
}

#[test]
fn exact_points_give_the_exact_sphere() {
    let sphere = fit_sphere(&cap(50, 0.0), 0.01).unwrap();
    assert!((sphere.centre_m - Vector3::new(1.0, 2.0, 3.0)).norm() < 1e-12 && sphere.rms_m < 1e-12);
}

#[test]
fn points_of_a_circle_a_line_or_too_few_are_no_sphere() {
    let circle: Vec<Vector3<f64>> =
        (0..100).map(|k| Vector3::new(hash(k).cos(), hash(k).sin(), 0.5)).collect();
    assert!(fit_sphere(&circle, 0.01).is_none());
    let line: Vec<Vector3<f64>> = (0..100).map(|k| Vector3::new(hash(k), 1.0, 2.0)).collect();
    assert!(fit_sphere(&line, 0.01).is_none());
    assert!(fit_sphere(&cap(3, 0.0), 0.01).is_none());
    assert!(fit_sphere(&[], 0.01).is_none());
    assert!(fit_sphere(&[Vector3::repeat(f64::NAN); 20], 0.01).is_none());
}
