//! What the fitted geometry says of every sample: outliers, a slipped encoder, a clock that jumped.

use serde::Serialize;

use super::circular::{median, spread_of};
use super::jump::{Jump, jumps};
use super::{PrepareError, PrepareOptions};
use crate::kinematics::BAR_JOINTS;

/// One sample away from singular poses against the fitted geometry.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Judged {
    /// Index among all samples.
    pub sample: usize,
    /// Bar time \[s\].
    pub t_s: f64,
    /// Number of the counters' origin.
    pub origin: usize,
    /// Measured less implied joints, weighed by the distance from singular poses \[rad\].
    pub error_rad: [f64; BAR_JOINTS],
    /// That weight: sine of the distance.
    pub trust: f64,
    /// Speed of the joints, weighed in the same way \[rad/s\].
    pub speed_rad_s: [f64; BAR_JOINTS],
}

/// How far the alignment of a short part of the run is from that of the whole: figure 5.5 of the thesis over time.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LocalShift {
    /// Middle of the part, bar time since the reference \[s\].
    pub t_s: f64,
    /// Shift that the part by itself asks for, less that of the whole run \[s\].
    pub shift_s: f64,
}

/// Length of a part \[s\].
const PART_S: f64 = 5.0;
/// Parts in which the joints' speeds vary less than this say nothing about time \[rad/s\].
const SPEED_VARIES_RAD_S: f64 = 0.05;
/// Fewest samples of a part.
const PART_SAMPLES_MIN: usize = 20;

/// Shift of each part of the run. Offsets are free in each, so that slow errors of the geometry do not pass for time.
pub(super) fn local_shifts(judged: &[Judged]) -> Vec<LocalShift> {
    let part = |one: &Judged| (one.origin, (one.t_s / PART_S).floor());
    judged.chunk_by(|a, b| part(a) == part(b)).filter_map(local_shift).collect()
}

/// Least squares of `error = constant + shift * speed` over all joints of a part.
fn local_shift(part: &[Judged]) -> Option<LocalShift> {
    if part.len() < PART_SAMPLES_MIN {
        return None;
    }
    let n = part.len() as f64;
    let (mut products, mut squares) = (0.0, 0.0);
    for joint in 0..BAR_JOINTS {
        let mean = |of: &dyn Fn(&Judged) -> f64| part.iter().map(of).sum::<f64>() / n;
        let error_mean = mean(&|one| one.error_rad[joint]);
        let speed_mean = mean(&|one| one.speed_rad_s[joint]);
        for one in part {
            let speed = one.speed_rad_s[joint] - speed_mean;
            products += speed * (one.error_rad[joint] - error_mean);
            squares += speed * speed;
        }
    }
    (squares > n * SPEED_VARIES_RAD_S.powi(2)).then(|| LocalShift {
        t_s: part.iter().map(|one| one.t_s).sum::<f64>() / n,
        shift_s: products / squares,
    })
}

/// Steps of the clock smaller than this are not looked for \[s\].
const JUMP_S_MIN: f64 = 0.002;
/// Parts to either side of a jump.
const PARTS_BESIDE: usize = 3;
/// A step is one that is so many times larger than usual.
const TIMES_USUAL: f64 = 8.0;

/// `t_ref_s` is the reference time after the first sample.
///
/// # Errors
/// [`PrepareError::ClockJump`] where the alignment before and after some instant differ.
pub(super) fn check_clock(shifts: &[LocalShift], t_ref_s: f64) -> Result<(), PrepareError> {
    let of = |shifts: &[LocalShift]| -> f64 {
        median(&mut shifts.iter().map(|shift| shift.shift_s).collect::<Vec<f64>>())
    };
    let changes = shifts.windows(2).map(|pair| (pair[1].shift_s - pair[0].shift_s).abs());
    let usual_s = spread_of(changes.collect());
    let steps = (PARTS_BESIDE..(shifts.len() + 1).saturating_sub(PARTS_BESIDE)).map(|at| {
        let by_s = of(&shifts[at..at + PARTS_BESIDE]) - of(&shifts[at - PARTS_BESIDE..at]);
        (0.5 * (shifts[at - 1].t_s + shifts[at].t_s), by_s)
    });
    match steps.max_by(|a, b| a.1.abs().total_cmp(&b.1.abs())) {
        Some((at_s, by_s)) if by_s.abs() > JUMP_S_MIN.max(TIMES_USUAL * usual_s) => {
            Err(PrepareError::ClockJump { at_s: at_s + t_ref_s, by_ms: by_s * 1e3 })
        }
        _ => Ok(()),
    }
}

/// Samples just before and after a slip.
const BESIDE: usize = 5;
/// Samples over which it must last, to either side.
const LASTING: usize = 100;
/// Part of the step that must last.
const LASTING_PART: f64 = 0.6;
/// What lasts must be so many times larger than changes between such halves usually are: errors of gears and of the geometry
/// last, too. Less than one in 10 000 runs of an hour has a change of six standard deviations among its halves.
const TIMES_USUAL_LASTING: f64 = 6.0;
/// Samples further apart are compared with more caution \[s\].
const NEIGHBOURS_S: f64 = 0.5;

/// The sharpest steps of one joint's error.
struct Steps {
    /// Change of the error at each sample of an origin, and by how much it exceeds what is usual.
    steps: Vec<(f64, f64)>,
    errors: Vec<f64>,
    /// How much the error usually changes from [`LASTING`] samples to as many after them, standard deviation \[rad\].
    usual_lasting_rad: f64,
}

impl Steps {
    fn new(of_origin: &[Judged], joint: usize, options: &PrepareOptions) -> Self {
        let errors: Vec<f64> = of_origin.iter().map(|one| one.error_rad[joint]).collect();
        let steps: Vec<f64> = (0..errors.len()).map(|at| step(&errors, at, BESIDE)).collect();
        let usual_rad = spread_of(steps.iter().map(|step| step.abs()).collect());
        let spread_rad = spread_of(errors.iter().map(|error| error.abs()).collect());
        let times_usual = |(at, by_rad): (usize, &f64)| {
            let apart_s = at.checked_sub(1).map_or(0.0, |before| of_origin[at].t_s - of_origin[before].t_s);
            let caution_rad = if apart_s > NEIGHBOURS_S { spread_rad } else { usual_rad };
            let limit_rad = (options.slip_min_mrad * 1e-3).max(1.5 * TIMES_USUAL * caution_rad);
            (*by_rad, by_rad.abs() / limit_rad)
        };
        let lasting = (0..errors.len()).step_by(BESIDE).map(|at| step(&errors, at, LASTING).abs());
        Self {
            usual_lasting_rad: spread_of(lasting.collect()),
            steps: steps.iter().enumerate().map(times_usual).collect(),
            errors,
        }
    }

    /// The step at `at` is there long before and after.
    fn lasts(&self, at: usize, by_rad: f64) -> bool {
        let lasting_rad = step(&self.errors, at, LASTING) * by_rad.signum();
        lasting_rad > (LASTING_PART * by_rad.abs()).max(TIMES_USUAL_LASTING * self.usual_lasting_rad)
    }
}

/// `t_ref_s` is the reference time after the first sample.
///
/// # Errors
/// [`PrepareError::EncoderSlip`] where the offset of one encoder changes from one sample to the next without a flag,
/// [`PrepareError::ClockJump`] where all joints change by their speeds.
pub(super) fn check_steps(
    judged: &[Judged],
    measured: &[bool; BAR_JOINTS],
    t_ref_s: f64,
    options: &PrepareOptions,
) -> Result<(), PrepareError> {
    for of_origin in judged.chunk_by(|a, b| a.origin == b.origin) {
        let joints: Vec<(usize, Steps)> = (0..BAR_JOINTS)
            .filter(|joint| measured[*joint])
            .map(|joint| (joint, Steps::new(of_origin, joint, options)))
            .collect();
        let jumps = jumps(of_origin, measured, JUMP_S_MIN);
        let jumped = |jump: Option<Jump>| {
            let told =
                |Jump { at_s, by_s }| PrepareError::ClockJump { at_s: at_s + t_ref_s, by_ms: by_s * 1e3 };
            jump.map_or(Ok(()), |jump| Err(told(jump)))
        };
        jumped(jumps.sure)?;
        let mut slip: Option<(usize, usize, f64, f64)> = None;
        for (joint, steps) in &joints {
            for (at, (by_rad, ratio)) in steps.steps.iter().enumerate() {
                if *ratio > slip.map_or(1.0, |(.., most)| most) && steps.lasts(at, *by_rad) {
                    slip = Some((*joint, at, *by_rad, *ratio));
                }
            }
        }
        if let Some((joint, at, by_rad, _)) = slip {
            let at = &of_origin[at];
            let (at_s, by_mrad) = (at.t_s + t_ref_s, by_rad * 1e3 / at.trust);
            return Err(PrepareError::EncoderSlip { joint: joint as u8 + 1, at_s, by_mrad });
        }
        jumped(jumps.likely)?;
    }
    Ok(())
}

/// Median of `beside` values from `at` on, less that of as many before it.
fn step(values: &[f64], at: usize, beside: usize) -> f64 {
    let before = values.get(at.saturating_sub(beside)..at).unwrap_or_default();
    let after = values.get(at..(at + beside).min(values.len())).unwrap_or_default();
    if before.len() < BESIDE || after.len() < BESIDE {
        return 0.0;
    }
    median(&mut after.to_vec()) - median(&mut before.to_vec())
}

/// Standard deviation of each joint's error, from the median \[rad\].
pub(super) fn spreads_rad(judged: &[Judged]) -> [f64; BAR_JOINTS] {
    std::array::from_fn(|joint| spread_of(judged.iter().map(|one| one.error_rad[joint].abs()).collect()))
}

/// Errors are never expected smaller than this \[rad\]: so little is no fault.
const OUTLIER_RAD_MIN: f64 = 100e-6;

/// Samples of which some joint's error is far beyond the usual.
pub(super) fn outliers(judged: &[Judged], spreads_rad: &[f64; BAR_JOINTS]) -> Vec<usize> {
    let beyond = |one: &&Judged| {
        let mut errors = one.error_rad.iter().zip(spreads_rad);
        errors.any(|(error, spread)| error.abs() > OUTLIER_RAD_MIN.max(TIMES_USUAL * spread))
    };
    judged.iter().filter(beyond).map(|one| one.sample).collect()
}
