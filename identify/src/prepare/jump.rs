//! What changes at an instant: the time of one log against the other, or the offset of one encoder.
//!
//! Within some seconds errors of the geometry are nearly straight lines. Beside these, and beside a shift of the whole window, two
//! explanations of a sudden change compete: from the instant on all joints are off by their speed times one time, or one
//! joint is off by one angle. The one that takes more away of the squared errors is what happened.

use super::judge::Judged;
use crate::kinematics::BAR_JOINTS;

/// Samples so near to an instant are looked at \[s\].
const REACH_S: f64 = 5.0;
/// Instants are tried at this distance \[s\].
const STEP_S: f64 = 0.25;
/// Fewest samples to either side.
const SAMPLES_MIN: usize = 20;
/// Joints must have moved by so much more than evenly, root mean square over all \[rad/s\].
const SPEED_RAD_S: f64 = 0.01;
/// Part of the squared errors that a change must take away.
const EXPLAINED: f64 = 0.7;

/// A change of time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Jump {
    /// Bar time since the reference \[s\].
    pub at_s: f64,
    /// How much further the logs are apart from then on \[s\].
    pub by_s: f64,
}

/// The changes of time among samples with the same offsets.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Jumps {
    /// One that explains more than any change of an offset anywhere does.
    pub sure: Option<Jump>,
    /// One that explains more than any change of an offset at the same instant.
    pub likely: Option<Jump>,
}

/// Looks at all instants; jumps are larger than `least_s`.
pub(super) fn jumps(judged: &[Judged], measured: &[bool; BAR_JOINTS], least_s: f64) -> Jumps {
    let [Some(first), Some(last)] = [judged.first(), judged.last()] else { return Jumps::default() };
    let instants = (1..).map(|k| first.t_s + STEP_S * f64::from(k)).take_while(|at_s| *at_s < last.t_s);
    let changes: Vec<(f64, Change)> =
        instants.filter_map(|at_s| Some((at_s, Change::at(judged, at_s, measured)?))).collect();
    let is_jump = |change: &Change| {
        change.by_time > change.by_zero
            && change.by_time > EXPLAINED * change.squared
            && change.by_s.abs() > least_s
    };
    let candidates = changes.iter().filter(|(_, change)| is_jump(change));
    let Some(&(at_s, best)) = candidates.max_by(|a, b| a.1.by_time.total_cmp(&b.1.by_time)) else {
        return Jumps::default();
    };
    let jump = Some(Jump { at_s, by_s: best.by_s });
    let most_by_zero = changes.iter().map(|(_, change)| change.by_zero).fold(0.0, f64::max);
    Jumps { sure: jump.filter(|_| best.by_time > most_by_zero), likely: jump }
}

/// Two explanations of the errors about an instant.
#[derive(Debug, Clone, Copy)]
struct Change {
    /// Sum of squares before either.
    squared: f64,
    /// What a change of time takes away of it, and the change \[s\].
    by_time: f64,
    by_s: f64,
    /// What a change of the offset takes away that takes away most.
    by_zero: f64,
}

impl Change {
    /// None where the samples are few, or joints hardly move.
    fn at(judged: &[Judged], at_s: f64, measured: &[bool; BAR_JOINTS]) -> Option<Self> {
        let from = judged.partition_point(|one| one.t_s < at_s - REACH_S);
        let to = judged.partition_point(|one| one.t_s < at_s + REACH_S);
        let window = &without_outliers(judged.get(from..to)?);
        let before = window.partition_point(|one| one.t_s < at_s);
        if before < SAMPLES_MIN || window.len() - before < SAMPLES_MIN {
            return None;
        }
        let joints: Vec<Joint> = (0..BAR_JOINTS)
            .filter(|joint| measured[*joint])
            .map(|joint| Joint::new(window, before, joint))
            .collect();
        let sum = |of: &dyn Fn(&Joint) -> f64| joints.iter().map(of).sum::<f64>();
        // A shift of the whole window is taken out of everything else.
        let whole = sum(&|one| dot(&one.speed, &one.speed));
        let shift_s = sum(&|one| dot(&one.speed, &one.error)) / whole;
        let squared = sum(&|one| dot(&one.error, &one.error)) - shift_s * shift_s * whole;
        let left = |one: &Joint, by: &[f64]| dot(by, &one.error) - shift_s * dot(by, &one.speed);
        let (late_speed, late_late) =
            (sum(&|one| dot(&one.late_speed, &one.speed)), sum(&|one| dot(&one.late_speed, &one.late_speed)));
        let (pull, stiffness) =
            (sum(&|one| left(one, &one.late_speed)), late_late - late_speed * late_speed / whole);
        let entries = (window.len() * joints.len()) as f64;
        if stiffness.is_nan() || stiffness < entries * SPEED_RAD_S.powi(2) {
            return None;
        }
        let by_zero = joints.iter().map(|one| {
            let along = dot(&one.late, &one.speed);
            let stiffness = dot(&one.late, &one.late) - along * along / whole;
            if stiffness > 0.0 { left(one, &one.late).powi(2) / stiffness } else { 0.0 }
        });
        Some(Self {
            squared,
            by_time: pull * pull / stiffness,
            by_s: pull / stiffness,
            by_zero: by_zero.fold(0.0, f64::max),
        })
    }
}

/// Samples whose errors are not beyond all measure: a few at the seam of a log would outweigh everything else.
fn without_outliers(window: &[Judged]) -> Vec<Judged> {
    /// Times the square that a fifth exceeds: that many may lie behind a change near the window's end.
    const BEYOND: f64 = 100.0;
    const SHARE: f64 = 0.8;
    let squared = |one: &Judged| one.error_rad.iter().map(|error| error * error).sum::<f64>();
    let mut squares: Vec<f64> = window.iter().map(squared).collect();
    let at = ((squares.len() as f64 * SHARE) as usize).min(squares.len().saturating_sub(1));
    if squares.is_empty() {
        return Vec::new();
    }
    let usual = *squares.select_nth_unstable_by(at, f64::total_cmp).1;
    window.iter().filter(|one| squared(one) <= BEYOND * usual).copied().collect()
}

/// One joint over a window, straight lines taken out of everything.
struct Joint {
    error: Vec<f64>,
    speed: Vec<f64>,
    /// The speed from the instant on, zero before.
    late_speed: Vec<f64>,
    /// An angle from the instant on.
    late: Vec<f64>,
}

impl Joint {
    fn new(window: &[Judged], before: usize, joint: usize) -> Self {
        let times_s: Vec<f64> = window.iter().map(|one| one.t_s).collect();
        let of = |value: &dyn Fn(&Judged) -> f64, from: usize| {
            let values = window.iter().enumerate();
            bent(&times_s, values.map(|(at, one)| if at < from { 0.0 } else { value(one) }).collect())
        };
        let speed = |one: &Judged| one.speed_rad_s[joint];
        Self {
            error: of(&|one| one.error_rad[joint], 0),
            speed: of(&speed, 0),
            late_speed: of(&speed, before),
            late: of(&|one| one.trust, before),
        }
    }
}

/// Values without the straight line that fits them best.
fn bent(times_s: &[f64], mut values: Vec<f64>) -> Vec<f64> {
    let n = values.len().max(1) as f64;
    let (middle_s, mean) = (times_s.iter().sum::<f64>() / n, values.iter().sum::<f64>() / n);
    let (mut along, mut squares) = (0.0, 0.0);
    for (t_s, value) in times_s.iter().zip(&values) {
        along += (t_s - middle_s) * (value - mean);
        squares += (t_s - middle_s).powi(2);
    }
    let slope = if squares > 0.0 { along / squares } else { 0.0 };
    for (t_s, value) in times_s.iter().zip(&mut values) {
        *value -= mean + slope * (t_s - middle_s);
    }
    values
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}
