//! Tests the fit with clocks whose true relation is known.

use proptest::prelude::*;
use rand::{Rng, SeedableRng, rngs::StdRng};

use super::*;

const FRAME_NS: i64 = 18_000;
const PERIOD_NS: i64 = 10_000_000;

/// A simulated clock of the bus and one of the host. Frames have a delay of 20 us in each direction.
struct Clocks {
    sent: MonoNs,
    dc_ns: f64,
    drift_ppm: f64,
    period_ns: i64,
}

impl Clocks {
    fn new(drift_ppm: f64) -> Self {
        Self { sent: MonoNs(5_000_000_000), dc_ns: 1e12, drift_ppm, period_ns: PERIOD_NS }
    }

    /// Simulates the next cycle, with additional delays in both directions. Returns the pair, and the true time at which the
    /// frame passed the clock of the bus.
    fn next(&mut self, extra_there_ns: i64, extra_back_ns: i64) -> (ClockPair, MonoNs) {
        self.sent = self.sent.plus_ns(self.period_ns);
        self.dc_ns += self.period_ns as f64 * (1.0 + self.drift_ppm * 1e-6);
        let passed = self.sent.plus_ns(20_000 + extra_there_ns);
        let dc = DcNs((self.dc_ns + (20_000 + extra_there_ns) as f64).round() as i64);
        let received = passed.plus_ns(FRAME_NS + 20_000 + extra_back_ns);
        (ClockPair { dc, sent: self.sent, received, frame_ns: FRAME_NS }, passed)
    }
}

fn error_ns(fit: &ClockFit, (pair, passed): (ClockPair, MonoNs)) -> f64 {
    fit.monotonic_from_dc(pair.dc).ns_since(passed) as f64
}

/// Largest error of the fit in the last half of 2000 cycles \[ns\]. `extra` returns the additional delays of a cycle.
fn worst_error_ns(drift_ppm: f64, extra: impl Fn(usize) -> (i64, i64)) -> f64 {
    let (mut fit, mut clocks) = (ClockFit::default(), Clocks::new(drift_ppm));
    let mut worst: f64 = 0.0;
    for step in 0..2000 {
        let (there, back) = extra(step);
        let pair = clocks.next(there, back);
        fit.observe(pair.0);
        if step >= 1000 {
            worst = worst.max(error_ns(&fit, pair).abs());
        }
    }
    worst
}

#[test]
fn a_drifting_clock_is_followed_to_well_below_a_microsecond() {
    for drift_ppm in [-80.0, 0.0, 25.0, 120.0] {
        let worst = worst_error_ns(drift_ppm, |_| (0, 0));
        assert!(worst < 100.0, "{drift_ppm} ppm: {worst} ns");
    }
}

#[test]
fn slow_replies_do_not_pull_the_fit() {
    let worst = worst_error_ns(25.0, |step| (0, if step % 7 == 6 { 400_000 } else { 0 }));
    assert!(worst < 1_000.0, "{worst} ns");
    let worst = worst_error_ns(25.0, |step| (if step % 3 == 2 { 3_000_000 } else { 0 }, 0));
    assert!(worst < 1_000.0, "{worst} ns");
}

#[test]
fn the_time_of_the_frame_on_the_wire_is_no_error() {
    // If the frame duration were treated as a delay, the centre would be wrong by 9 us.
    assert!(worst_error_ns(0.0, |_| (0, 0)) < 100.0);
}

#[test]
fn the_uncertainty_covers_an_unequal_way_there_and_back() {
    let mut fit = ClockFit::default();
    assert_eq!(fit.uncertainty_ns(DcNs(0)), u32::MAX);
    for step in 0..500 {
        let sent = MonoNs(step * PERIOD_NS);
        // The frame passes the clock just after it is sent, so the error is half of the round trip.
        let received = sent.plus_ns(100_000);
        fit.observe(ClockPair { dc: DcNs(sent.0), sent, received, frame_ns: 0 });
    }
    let at = DcNs(4_990_000_000);
    let error_ns = fit.monotonic_from_dc(at).ns_since(MonoNs(at.0)).abs();
    assert!(error_ns > 40_000 && f64::from(fit.uncertainty_ns(at)) * 2.0 > error_ns as f64, "{error_ns}");
}

#[test]
fn the_uncertainty_grows_while_no_reply_comes() {
    let (mut fit, mut clocks) = (ClockFit::default(), Clocks::new(25.0));
    let mut last = DcNs(0);
    for _ in 0..500 {
        let (pair, _) = clocks.next(0, 0);
        fit.observe(pair);
        last = pair.dc;
    }
    let after_s = |seconds: i64| fit.uncertainty_ns(last.plus_ns(seconds * 1_000_000_000));
    assert!(after_s(0) < after_s(10) && after_s(10) < after_s(1000));
    // After 10 s without readings, the estimated drift still predicts the time.
    clocks.sent = clocks.sent.plus_ns(10_000_000_000);
    clocks.dc_ns += 1e10 * (1.0 + 25e-6);
    let pair = clocks.next(0, 0);
    let error_ns = error_ns(&fit, pair).abs();
    assert!(error_ns < 3.0 * f64::from(fit.uncertainty_ns(pair.0.dc)), "{error_ns}");
}

#[test]
fn a_rate_found_from_random_delays_is_as_uncertain_as_stated() {
    let mut beyond_two_sigmas = 0;
    for seed in 0..100 {
        let mut random = StdRng::seed_from_u64(seed);
        let (mut fit, mut clocks) =
            (ClockFit::default(), Clocks { period_ns: 1_000_000, ..Clocks::new(25.0) });
        // Delays of 5 us in each direction, and up to 20 us more in one of the directions.
        for _ in 0..600 {
            fit.observe(clocks.next(-15_000, random.random_range(-15_000..5_000)).0);
        }
        // After 10 s without readings, an error of the rate is visible.
        clocks.sent = clocks.sent.plus_ns(10_000_000_000);
        clocks.dc_ns += 1e10 * (1.0 + 25e-6);
        let pair = clocks.next(-15_000, -15_000);
        let sigma_ns = f64::from(fit.uncertainty_ns(pair.0.dc));
        beyond_two_sigmas += usize::from(error_ns(&fit, pair).abs() > 2.0 * sigma_ns);
    }
    assert!(beyond_two_sigmas <= 5, "{beyond_two_sigmas} of 100");
}

#[test]
fn one_wrong_bus_time_is_left_out() {
    let (mut fit, mut clocks) = (ClockFit::default(), Clocks::new(25.0));
    for step in 0..2000 {
        let pair = clocks.next(0, 0);
        if step % 100 == 99 {
            let broken = ClockPair { dc: DcNs(pair.0.dc.0 ^ (1 << (step % 40 + 17))), ..pair.0 };
            assert!(matches!(fit.observe(broken), PairStatus::Gated(_)), "{step}");
        } else {
            assert_eq!(fit.observe(pair.0), PairStatus::Followed, "{step}");
        }
        assert!(step < 100 || error_ns(&fit, pair).abs() < 200.0, "{step}");
    }
}

/// Passes pairs to the fit until the fit classifies the deviation. Returns the number of pairs.
fn resolve(
    fit: &mut ClockFit,
    clocks: &mut Clocks,
    delay: impl Fn(usize) -> (i64, i64),
) -> (PairStatus, usize) {
    for step in 0..200 {
        let (there, back) = delay(step);
        let seen = fit.observe(clocks.next(there, back).0);
        if !matches!(seen, PairStatus::Gated(_)) {
            return (seen, step + 1);
        }
    }
    panic!("never resolved");
}

#[test]
fn a_step_either_way_is_reported_within_five_readings_and_never_followed() {
    let hour_ns = 3_600_000_000_000;
    for size_ns in [12_000, 50_000, 90_000, 100_000, 3_000_000, 370_000_000, hour_ns] {
        for step_ns in [size_ns, -size_ns] {
            let (mut fit, mut clocks) = (ClockFit::default(), Clocks::new(-15.0));
            (0..500).for_each(|_| {
                fit.observe(clocks.next(0, 0).0);
            });
            clocks.dc_ns += step_ns as f64;
            let (seen, readings) = resolve(&mut fit, &mut clocks, |_| (0, 0));
            let PairStatus::Stepped(found_ns) = seen else { panic!("{step_ns}: {seen:?}") };
            assert!((found_ns - step_ns).abs() < 2_000, "{found_ns} instead of {step_ns}");
            assert!(readings <= 5, "{step_ns}: {readings} readings");
            // The fit is unchanged. A restarted fit is correct after its first reading.
            let pair = clocks.next(0, 0);
            assert!((error_ns(&fit, pair) - step_ns as f64).abs() < 2_000.0 + 1e-4 * size_ns as f64);
            let mut fit = fit.restarted();
            assert_eq!(fit.observe(pair.0), PairStatus::Followed);
            (0..10).for_each(|_| {
                fit.observe(clocks.next(0, 0).0);
            });
            assert!(error_ns(&fit, clocks.next(0, 0)).abs() < 1_000.0);
        }
    }
}

#[test]
fn while_a_step_is_in_doubt_the_uncertainty_covers_it() {
    let (mut fit, mut clocks) = (ClockFit::default(), Clocks::new(5.0));
    (0..500).for_each(|_| {
        fit.observe(clocks.next(0, 0).0);
    });
    clocks.dc_ns += 50_000.0;
    let (pair, _) = clocks.next(0, 0);
    assert!(matches!(fit.observe(pair), PairStatus::Gated(49_000..51_000)));
    assert!(fit.uncertainty_ns(pair.dc) > 50_000);
}

#[test]
fn a_rate_changed_by_500_ppm_is_followed_and_is_no_step() {
    // NTP changes the rate of the host's monotonic clock by such amounts.
    for change_ppm in [-500.0, -100.0, -10.0, -1.0, 1.0, 10.0, 100.0, 500.0] {
        let (mut fit, mut clocks) = (ClockFit::default(), Clocks::new(20.0));
        (0..1000).for_each(|_| {
            fit.observe(clocks.next(0, 0).0);
        });
        clocks.drift_ppm += change_ppm;
        for step in 0..500 {
            let pair = clocks.next(0, 0);
            let seen = fit.observe(pair.0);
            assert!(!matches!(seen, PairStatus::Stepped(_)), "{change_ppm} ppm, {step}");
            let error_ns = error_ns(&fit, pair).abs();
            let sigma_ns = f64::from(fit.uncertainty_ns(pair.0.dc));
            assert!(error_ns < 3.0 * sigma_ns, "{change_ppm} ppm, {step}: {error_ns} of {sigma_ns} ns");
            assert!(step < 50 || error_ns < 2_000.0, "{change_ppm} ppm, {step}: {error_ns} ns");
        }
    }
}

#[test]
fn a_bus_time_that_makes_no_sense_at_all_is_a_stepped_clock_in_the_end() {
    let (mut fit, mut clocks) = (ClockFit::default(), Clocks::new(5.0));
    (0..500).for_each(|_| {
        fit.observe(clocks.next(0, 0).0);
    });
    let mut random = StdRng::seed_from_u64(1);
    let erratic = (0..200).any(|_| {
        let pair = ClockPair { dc: DcNs(random.random()), ..clocks.next(0, 0).0 };
        matches!(fit.observe(pair), PairStatus::Stepped(_))
    });
    assert!(erratic);
}

/// Delays of a host under load \[ns\]: exponential in each direction, with rare stalls of a millisecond.
fn loaded(random: &mut StdRng) -> (i64, i64) {
    let mut way = |mean_ns: f64| {
        let stall_ns = if random.random_ratio(1, 200) { 1_000_000 } else { 0 };
        (-mean_ns * (1.0 - random.random::<f64>()).ln()) as i64 + stall_ns
    };
    (way(10_000.0), way(40_000.0))
}

#[test]
fn an_hour_under_load_has_no_false_step_and_a_step_of_100_us_is_found() {
    let mut random = StdRng::seed_from_u64(7);
    let (mut fit, mut clocks) = (ClockFit::default(), Clocks::new(-12.0));
    let (mut within, mut gated) = (0, 0);
    for step in 0..360_000 {
        let (there, back) = loaded(&mut random);
        let pair = clocks.next(there, back);
        let seen = fit.observe(pair.0);
        assert!(!matches!(seen, PairStatus::Stepped(_)), "{step}");
        gated += usize::from(matches!(seen, PairStatus::Gated(_)));
        let error_ns = error_ns(&fit, pair).abs();
        within += usize::from(error_ns < 2.0 * f64::from(fit.uncertainty_ns(pair.0.dc)));
        assert!(step < 1000 || error_ns < 40_000.0, "{step}: {error_ns} ns");
    }
    assert!(within > 359_900, "{within} within two sigmas");
    assert!(gated < 360, "{gated} gated");
    for step_ns in [100_000.0, -100_000.0] {
        clocks.dc_ns += step_ns;
        let mut found = None;
        for _ in 0..300 {
            let (there, back) = loaded(&mut random);
            if let PairStatus::Stepped(by_ns) = fit.observe(clocks.next(there, back).0) {
                found = Some(by_ns);
                fit = fit.restarted();
                break;
            }
        }
        let off_ns = found.expect("a step of 100 us") as f64 - step_ns;
        assert!(off_ns.abs() < 60_000.0, "{off_ns} ns off");
        (0..200).for_each(|_| {
            let (there, back) = loaded(&mut random);
            fit.observe(clocks.next(there, back).0);
        });
    }
}

/// A fit that has converged under load, at some cycle rate.
fn converged_under_load(random: &mut StdRng, period_ns: i64) -> (ClockFit, Clocks) {
    let (mut fit, mut clocks) = (ClockFit::default(), Clocks { period_ns, ..Clocks::new(20.0) });
    for _ in 0..1000 {
        let (there, back) = loaded(random);
        fit.observe(clocks.next(there, back).0);
    }
    (fit, clocks)
}

#[test]
fn under_load_a_rate_changed_by_some_ppm_is_no_step_at_any_rate_of_cycles() {
    for (seed, period_ns) in (0..10).flat_map(|seed| [(seed, PERIOD_NS), (seed, 1_000_000)]) {
        for change_ppm in [-3.0, 3.0] {
            let mut random = StdRng::seed_from_u64(seed);
            let (mut fit, mut clocks) = converged_under_load(&mut random, period_ns);
            clocks.drift_ppm += change_ppm;
            for step in 0..2000 {
                let (there, back) = loaded(&mut random);
                let pair = clocks.next(there, back);
                let seen = fit.observe(pair.0);
                assert!(!matches!(seen, PairStatus::Stepped(_)), "{seed} {period_ns} {change_ppm} {step}");
                assert!(error_ns(&fit, pair).abs() < 20_000.0, "{seed} {period_ns} {change_ppm} {step}");
            }
        }
    }
}

#[test]
fn under_load_a_step_of_80_us_is_found_at_any_rate_of_cycles() {
    for (seed, period_ns) in (0..10).flat_map(|seed| [(seed, PERIOD_NS), (seed, 1_000_000)]) {
        let mut random = StdRng::seed_from_u64(seed);
        let (mut fit, mut clocks) = converged_under_load(&mut random, period_ns);
        clocks.dc_ns += 80_000.0;
        let found = (0..400).any(|_| {
            let (there, back) = loaded(&mut random);
            matches!(fit.observe(clocks.next(there, back).0), PairStatus::Stepped(50_000..110_000))
        });
        assert!(found, "{seed} {period_ns}");
    }
}

proptest! {
    #[test]
    fn errors_stay_within_four_sigmas_whatever_the_delays(
        drift_ppm in -100.0..100.0,
        delays in prop::collection::vec((0i64..60_000, 0i64..300_000), 300..600),
    ) {
        let (mut fit, mut clocks) = (ClockFit::default(), Clocks::new(drift_ppm));
        for (step, (there, back)) in delays.into_iter().enumerate() {
            let pair = clocks.next(there, back);
            let seen = fit.observe(pair.0);
            let sigma_ns = f64::from(fit.uncertainty_ns(pair.0.dc));
            let error_ns = error_ns(&fit, pair).abs();
            // The fit and the true time are both within the bound of the reading. They can therefore differ by
            // the width of the bound.
            let width_ns = pair.0.received.ns_since(pair.0.sent) - FRAME_NS;
            prop_assert!(seen != PairStatus::Followed || error_ns < width_ns as f64 + 2_000.0, "{step}: {error_ns}");
            prop_assert!(step < 100 || error_ns < 4.0 * sigma_ns, "{step}: {error_ns} of {sigma_ns}");
        }
    }

    #[test]
    fn no_pair_can_break_the_fit(
        pairs in prop::collection::vec((any::<i64>(), any::<i64>(), any::<i64>(), 0i64..200_000), 1..50)
    ) {
        let mut fit = ClockFit::default();
        for (dc, sent, received, frame_ns) in pairs {
            fit.observe(ClockPair { dc: DcNs(dc), sent: MonoNs(sent), received: MonoNs(received), frame_ns });
            fit.uncertainty_ns(DcNs(dc));
            fit.monotonic_from_dc(DcNs(dc));
        }
    }
}
