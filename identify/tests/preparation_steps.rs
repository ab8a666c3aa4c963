//! Single steps of the preparation on generated values, and the effect of its options on whole runs.
#![allow(clippy::unwrap_used, reason = "tests")]

use crate::support::minute::{prepared, run};
use identify::logs::Stream;
use identify::prepare::{Channels, correlate, fit_sphere, select, spread_over_sphere};
use identify::prepare::{Prepared, SampleStatus};
use identify::simulate::Effects;
use nalgebra::Vector3;
use proptest::prelude::*;

/// Pseudo-random value between 0 and 1 for the number `k`.
fn hash(k: i64) -> f64 {
    let x = (k as f64 * 12.9898).sin() * 43_758.545_3;
    x - x.floor()
}

/// A smooth, irregular signal at a fractional index.
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

/// Points on a section of a sphere with radius 0.6 m about (1, 2, 3). Their radius has errors of up to `noise_m` \[m\].
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

#[test]
fn a_moving_average_leaves_parabolas_and_slow_swings_whatever_the_rate() {
    let (width_s, omega) = (0.1_f64, 8.0_f64);
    // The mean of a sine over a width has the same phase. Its amplitude changes by the factor sin(w/2 omega) / (w/2 omega),
    // which is 2.6 % below one.
    let mean = |width_s: f64| (0.5 * width_s * omega).sin() / (0.5 * width_s * omega);
    let gain = (4.0 * mean(width_s) - mean(2.0 * width_s)) / 3.0;
    assert!((gain - 1.0).abs() < 1e-3, "{gain}");
    for rate_hz in [100.0, 250.0, 83.3] {
        let t_s: Vec<f64> = (0..400).map(|k| f64::from(k) / rate_hz + 2e-4 * hash(i64::from(k))).collect();
        let values: Vec<[f64; 2]> =
            t_s.iter().map(|t| [700.0 + (omega * t).sin(), 3.0 - 5.0 * t + 7.0 * t * t]).collect();
        let averages = Stream::new(0, t_s.clone(), values).with_gap_limit(0.05).averages(width_s);
        assert_eq!(averages.len(), t_s.len());
        for (t, average) in t_s.iter().zip(averages) {
            let covered = t - width_s >= t_s[0] && t + width_s <= t_s[399];
            match average {
                Some([swing, parabola]) => {
                    let error = swing - 700.0 - gain * (omega * t).sin();
                    assert!(error.abs() < 1e-5, "{rate_hz} Hz at {t} s: {error}");
                    let error = parabola - (3.0 - 5.0 * t + 7.0 * t * t);
                    assert!(error.abs() < 1e-9, "{rate_hz} Hz at {t} s: {error}");
                }
                None => assert!(!covered, "{rate_hz} Hz at {t} s"),
            }
        }
    }
}

/// Pseudo-random direction on the sphere for the number `k`.
fn anywhere(k: i64) -> Vector3<f64> {
    let (z, azimuth) = (2.0 * hash(k) - 1.0, std::f64::consts::TAU * hash(k + 5000));
    let r = (1.0 - z * z).sqrt();
    Vector3::new(r * azimuth.cos(), r * azimuth.sin(), z)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(20))]
    #[test]
    fn points_are_spread_over_the_sphere_and_not_over_time(points_max in 100usize..1200, often in 2000i64..20_000) {
        // The path crosses a small cap of the sphere repeatedly, and the rest of the sphere only once.
        let pole = Vector3::new(0.3, -0.5, 0.8).normalize();
        let mut directions: Vec<Vector3<f64>> = (0..2000).map(anywhere).collect();
        directions.extend((0..often).map(|k| (pole + 0.05 * anywhere(k + 9000)).normalize()));
        let samples: Vec<usize> = (0..directions.len()).map(|k| 3 * k + 7).collect();
        let kept = spread_over_sphere(&samples, &directions, points_max);
        prop_assert_eq!(kept.len(), points_max.min(samples.len()));
        prop_assert!(kept.windows(2).all(|pair| pair[0] < pair[1]));
        let of = |sample: &usize| directions[(sample - 7) / 3];
        prop_assert!(kept.iter().all(|sample| sample % 3 == 1));
        // In the path, the cap has a thousandth of the area, but most of the samples.
        let in_cap = kept.iter().filter(|sample| of(sample).angle(&pole) < 0.06).count();
        prop_assert!((in_cap as f64) < 0.1 * points_max as f64, "{} of {}", in_cap, points_max);
        // Every octant has samples.
        for octant in 0..8 {
            let inside = |d: &Vector3<f64>| (0..3).all(|axis| (d[axis] > 0.0) == (octant >> axis & 1 == 1));
            let count = kept.iter().filter(|sample| inside(&of(sample))).count();
            prop_assert!(count as f64 > 0.06 * points_max as f64, "octant {}: {}", octant, count);
        }
    }
}

/// Mean standard deviation of the encoders about the fit \[urad\].
fn spread_urad(found: &Prepared) -> f64 {
    found.offsets.iter().map(|offset| offset.spread_rad * 1e6).sum::<f64>() / found.offsets.len() as f64
}

#[test]
fn a_moving_average_of_100_ms_from_the_configuration_takes_noise_from_both_logs() {
    const AVERAGED: &str = "moving_average_ms = 100.0";
    let noisy = run(Effects { robot_noise_urad: 300.0, encoder_noise_urad: 300.0, ..Effects::NONE });
    let [as_logged, averaged] = ["", AVERAGED].map(|options| prepared(&noisy, options));
    let spreads = [&as_logged, &averaged].map(spread_urad);
    println!("{spreads:?} urad");
    // The average combines ten samples of the bar and 25 of the robot. Its noise is 1.2 times the noise of their mean.
    assert!(spreads[1] < 0.45 * spreads[0], "{spreads:?}");
    let shift_ms = |found: &Prepared| {
        let passed_s = found.t_ref.seconds_since(noisy.truth.clock.bar_start);
        let difference_ns = noisy.truth.clock.robot_at_bar_start_ns - noisy.truth.clock.bar_start.0;
        let drift_ns = passed_s * 1e9 * noisy.truth.clock.skew;
        ((found.alignment.clock_difference_ns - difference_ns) as f64 - drift_ns) * 1e-6
    };
    // The average is centred on its sample, so it shifts neither log in time.
    assert!(shift_ms(&averaged).abs() < 0.2, "{} ms", shift_ms(&averaged));
}

#[test]
fn no_good_sample_looks_bad_for_being_averaged() {
    // Without noise, only the average can cause residuals. A plain mean would attenuate the fast parts of a path, and
    // hundreds of samples would be classified as outliers.
    let clean = run(Effects::NONE);
    let [as_logged, averaged] = ["", "moving_average_ms = 100.0"].map(|options| prepared(&clean, options));
    let spreads = [&as_logged, &averaged].map(spread_urad);
    println!("{spreads:?} urad");
    assert_eq!([&as_logged, &averaged].map(|found| found.counts.of(SampleStatus::Outlier)), [0, 0]);
    assert!(spreads[1] < spreads[0] + 2.0, "{spreads:?}");
}

#[test]
fn few_points_of_a_whole_run_still_cover_the_sphere_that_it_covers() {
    let run = run(Effects::NONE);
    let found = prepared(&run, "points_max = 300");
    assert_eq!((found.observations.len(), found.counts.of(SampleStatus::Kept)), (300, 300));
    assert!(found.counts.of(SampleStatus::Thinned) > 1000, "{:?}", found.counts);
    let since_start_s = found.t_ref.seconds_since(run.truth.clock.bar_start);
    let rod = |t_s: f64| {
        let joints = run.motion.path.at(t_s);
        let (azimuth, polar) = (joints[0], joints[1]);
        Vector3::new(azimuth.cos() * polar.sin(), azimuth.sin() * polar.sin(), polar.cos())
    };
    let kept: Vec<Vector3<f64>> =
        found.observations.iter().map(|observation| rod(since_start_s + observation.t_s)).collect();
    // For every direction of the rod during the motion, at least one of the remaining samples must
    // have nearly the same direction.
    let mut farthest_deg = 0.0_f64;
    for k in 0..600 {
        let (before, here) = (rod(0.1 * f64::from(k) - 0.05), rod(0.1 * f64::from(k)));
        if before.angle(&here) > 0.005 {
            let nearest = kept.iter().map(|kept| kept.angle(&here)).fold(f64::INFINITY, f64::min);
            farthest_deg = farthest_deg.max(nearest.to_degrees());
        }
    }
    println!("{farthest_deg:.1} deg");
    assert!(farthest_deg < 8.0, "{farthest_deg}");
}
