//! Tests the detector of changes on generated residuals: its rate of false alarms, and the changes that it detects.
#![allow(clippy::unwrap_used, reason = "tests")]

use identify::solver::{
    Change, Course, LeastSquares, Linearisation, Loss, LossName, Prior, change_point, minimise,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal, StudentT};

const SAMPLES: usize = 1500;
/// Number of parameters: the offset of each channel, the delay relative to a motion that both channels have in
/// common, and two errors of geometry.
const COLUMNS: usize = 5;

/// A least-squares problem with two channels over an irregular motion. The residual is the model minus the measurement `y`.
/// The model is a sum of offset, delay times speed, and two errors of geometry (`bend` and `other`).
struct Channels {
    motion: Vec<[f64; 3]>,
    y: Vec<[f64; 2]>,
}

impl LeastSquares for Channels {
    fn columns(&self) -> usize {
        COLUMNS
    }

    fn samples(&self) -> usize {
        self.y.len()
    }

    fn rows(&self) -> usize {
        2
    }

    fn priors(&self) -> &[Prior] {
        &[]
    }

    fn at<'a>(&'a self, x: &[f64]) -> Linearisation<'a> {
        let x = x.to_vec();
        Box::new(move |sample, r, block| {
            let [speed, bend, other] = self.motion[sample];
            let slopes = [[1.0, 0.0], [0.0, 1.0], [speed, 0.7 * speed * bend], [bend, other], [other, -bend]];
            for channel in 0..2 {
                r[channel] = -self.y[sample][channel];
                for (column, slope) in slopes.iter().enumerate() {
                    r[channel] += x[column] * slope[channel];
                    block.column_mut(column)[channel] = slope[channel];
                }
            }
            true
        })
    }
}

const OFFSETS: [usize; 2] = [0, 1];
const LAG: usize = 2;

/// Groups of columns that may change: each offset, the delay, and both offsets together. The program tests the same groups.
fn alternatives() -> Vec<Vec<usize>> {
    vec![vec![0], vec![1], vec![LAG], OFFSETS.to_vec()]
}

#[derive(Debug, Clone, Copy)]
enum Noise {
    White,
    /// First-order autoregression with this correlation of consecutive samples.
    Lasting(f64),
    /// White noise that is three times as large in the middle third of the run.
    Uneven,
    /// Student's t distribution with three degrees of freedom.
    HeavyTails,
    /// Gear errors that no column describes: a harmonic of an angle with this number of periods per radian, four times as
    /// large as the white noise.
    Gear(f64),
}

impl Noise {
    fn drawn(self, angles_rad: &[f64], random: &mut ChaCha8Rng) -> Vec<f64> {
        let phase = random.random_range(0.0..std::f64::consts::TAU);
        let mut last = 0.0;
        let one = |sample: usize| {
            let along = sample as f64 / SAMPLES as f64;
            let white: f64 = random.sample(StandardNormal);
            match self {
                Self::White => white,
                Self::Lasting(kept) => {
                    last = kept * last + (1.0 - kept * kept).sqrt() * white;
                    last
                }
                Self::Uneven => white * if (along * 3.0) as usize == 1 { 3.0 } else { 1.0 },
                Self::HeavyTails => StudentT::new(3.0).unwrap().sample(random),
                Self::Gear(periods) => white + 4.0 * (periods * angles_rad[sample] + phase).sin(),
            }
        };
        (0..SAMPLES).map(one).collect()
    }
}

fn run(noise: Noise, seed: u64) -> Channels {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let waves: [[f64; 2]; 3] =
        std::array::from_fn(|_| [random.random_range(3.0..40.0), random.random_range(0.0..6.0)]);
    let at = |sample: usize| {
        let along = sample as f64 / SAMPLES as f64;
        waves.map(|[periods, phase]| (std::f64::consts::TAU * periods * along + phase).sin())
    };
    let motion: Vec<[f64; 3]> = (0..SAMPLES).map(at).collect();
    let [one, other] = [1, 2].map(|angle| {
        let angles_rad: Vec<f64> = motion.iter().map(|at| at[angle]).collect();
        noise.drawn(&angles_rad, &mut random)
    });
    Channels { motion, y: one.into_iter().zip(other).map(<[f64; 2]>::from).collect() }
}

fn find_changes(run: &Channels, false_alarms: f64) -> Vec<Change> {
    let loss = Loss { name: LossName::Cauchy, scale: 4.0 };
    let options = identify::solver::Options { loss, ..Default::default() };
    let (x, _) = minimise(run, &[0.0; COLUMNS], &options).unwrap();
    let samples: Vec<usize> = (0..SAMPLES).collect();
    let estimated: Vec<usize> = (0..COLUMNS).collect();
    change_point(run, &x, loss, &samples, &estimated, &alternatives(), false_alarms)
}

#[test]
#[ignore = "takes more than four seconds"]
fn runs_in_which_nothing_changes_show_a_change_no_more_often_than_stated() {
    const RUNS: u64 = 100;
    let kinds = [
        Noise::White,
        Noise::Lasting(0.9),
        Noise::Lasting(0.97),
        Noise::Uneven,
        Noise::HeavyTails,
        Noise::Gear(2.0),
        Noise::Gear(40.0),
    ];
    for noise in kinds {
        let alarms =
            |rate: f64| (0..RUNS).filter(|seed| !find_changes(&run(noise, *seed), rate).is_empty()).count();
        let often = alarms(0.05);
        let seldom = if often == 0 { 0 } else { alarms(1e-4) };
        println!("{noise:?}: {often} and {seldom} of {RUNS}");
        // The limit is the expected number of false alarms, plus five standard deviations of this number.
        assert!(often <= 5 + 11, "{noise:?}: {often}");
        assert_eq!(seldom, 0, "{noise:?}");
    }
}

#[test]
fn a_step_is_found_where_and_as_large_as_it_is() {
    // A step near an end affects only a few blocks of samples. It must be larger to be significant.
    for (at, size) in [(700, 3.0), (250, 6.0), (1300, -8.0)] {
        for seed in 0..10 {
            let mut stepped = run(Noise::Lasting(0.8), 100 + seed);
            stepped.y[at..].iter_mut().for_each(|y| y[1] += size);
            let changes = find_changes(&stepped, 1e-4);
            let change = &changes[0];
            let Course::Step(found) = change.course else { panic!("{change:?}") };
            assert_eq!(change.alternative, OFFSETS[1], "{change:?}");
            assert!(found.abs_diff(at) <= 20, "{found} {at}");
            assert!((change.by[0] - size).abs() < 1.0, "{change:?}");
            // Both offsets together contain the step; the other offset and the delay do not explain it.
            let explains = |change: &Change| alternatives()[change.alternative].contains(&OFFSETS[1]);
            assert!(changes.iter().all(explains), "{changes:?}");
        }
    }
}
