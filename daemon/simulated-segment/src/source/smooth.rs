//! The default source of the simulated bus: a built-in motion, in which every joint swings slowly. The angle of each joint
//! is a sum of sines, `angle = sum of A sin(2 pi t / T + phase)`.

use std::f64::consts::TAU;

use rand::{Rng, SeedableRng, rngs::StdRng};

use super::reference_mark::ReferenceMark;
use super::{Conversion, EncoderSource, Periods, Signal};

/// Number of sines of each joint.
const SINES: usize = 3;
/// Largest sum of the amplitudes of a joint: 60 degrees.
const ANGLE_MAX_RAD: f64 = std::f64::consts::FRAC_PI_3;
/// Largest sum of the speed amplitudes of a joint.
const SPEED_MAX_RAD_PER_S: f64 = 0.4;
/// Range of the periods of the sines \[ns\].
const PERIOD_NS: std::ops::Range<i64> = 11_000_000_000..37_000_000_000;
/// Largest number of lines. No encoder has more lines.
const LINES_MAX: u32 = 1 << 20;
/// Largest position at angle zero \[signal periods\]. A terminal counts from its power-up, so this position is arbitrary.
const START_PERIODS_MAX: i64 = 10_000;

#[derive(Debug, Clone, Copy)]
struct Sine {
    amplitude_rad: f64,
    period_ns: i64,
    phase_rad: f64,
}

impl Sine {
    fn rate_rad_per_s(&self) -> f64 {
        TAU / (self.period_ns as f64 * 1e-9)
    }

    /// Argument of the sine \[rad\]. Whole periods are subtracted in integers, so the argument is accurate at any time.
    fn argument_rad(&self, true_time_ns: i64) -> f64 {
        TAU * true_time_ns.rem_euclid(self.period_ns) as f64 / self.period_ns as f64 + self.phase_rad
    }
}

#[derive(Debug, Clone)]
pub(super) struct SmoothJoint {
    sines: [Sine; SINES],
    /// Position of the encoder at angle zero.
    start: Periods,
    mark: ReferenceMark,
    /// Position at the last conversion.
    last: Option<Periods>,
}

/// A motion in which the angle of every joint is a sum of three slow sines, within 60 degrees and 0.4 rad/s. Each
/// encoder has one reference mark.
#[derive(Debug, Clone)]
pub struct SmoothMotion {
    pub(super) lines: u32,
    pub(super) joints: Vec<SmoothJoint>,
}

impl SmoothMotion {
    /// Creates the joints with random sines. `seed` determines the motion. The encoders have
    /// `lines` signal periods per revolution.
    pub fn new(joints: usize, lines: u32, seed: u64) -> Self {
        let mut random = StdRng::seed_from_u64(seed);
        let lines = lines.clamp(1, LINES_MAX);
        let joints = (0..joints).map(|_| SmoothJoint::new(lines, &mut random)).collect();
        Self { lines, joints }
    }

    /// Angle of a joint \[rad\]. The position of its encoder is this angle times `lines / 2 pi`, plus
    /// [`start_periods`](Self::start_periods).
    pub fn angle_rad(&self, joint: usize, true_time_ns: i64) -> f64 {
        self.joints.get(joint).map_or(0.0, |joint| joint.angle_rad(true_time_ns))
    }

    /// Position of a joint's encoder.
    pub fn position(&self, joint: usize, true_time_ns: i64) -> Periods {
        self.joints.get(joint).map_or(Periods(0), |joint| joint.position(self.lines, true_time_ns))
    }

    /// Position of one reference mark on a joint's encoder. The mark repeats every revolution.
    pub fn reference_mark(&self, joint: usize) -> Option<Periods> {
        self.mark(joint).map(|mark| mark.at)
    }

    pub(super) fn mark(&self, joint: usize) -> Option<ReferenceMark> {
        self.joints.get(joint).map(|joint| joint.mark)
    }

    pub(super) fn periods_per_s(&self, joint: usize, true_time_ns: i64) -> f64 {
        self.joints.get(joint).map_or(0.0, |joint| joint.periods_per_s(self.lines, true_time_ns))
    }

    /// Position of a joint's encoder at angle zero.
    pub fn start_periods(&self, joint: usize) -> Periods {
        self.joints.get(joint).map_or(Periods(0), |joint| joint.start)
    }
}

impl SmoothJoint {
    fn new(lines: u32, random: &mut StdRng) -> Self {
        let mut sines = [(); SINES].map(|()| Sine {
            amplitude_rad: random.random_range(0.3..1.0),
            period_ns: random.random_range(PERIOD_NS),
            phase_rad: random.random_range(0.0..TAU),
        });
        let angle: f64 = sines.iter().map(|sine| sine.amplitude_rad).sum();
        let speed: f64 = sines.iter().map(|sine| sine.amplitude_rad * sine.rate_rad_per_s()).sum();
        let scale = (ANGLE_MAX_RAD / angle).min(SPEED_MAX_RAD_PER_S / speed);
        for sine in &mut sines {
            sine.amplitude_rad *= scale;
        }
        let start = Periods(random.random_range(-START_PERIODS_MAX..START_PERIODS_MAX) * Periods::ONE);
        // The mark is within 9 degrees of angle zero, so the motion passes it.
        let mark =
            Periods(start.0 + i64::from(lines) * random.random_range(-Periods::ONE / 40..Periods::ONE / 40));
        Self { sines, start, mark: ReferenceMark::new(mark, lines), last: None }
    }

    fn angle_rad(&self, true_time_ns: i64) -> f64 {
        self.sines.iter().map(|sine| sine.amplitude_rad * sine.argument_rad(true_time_ns).sin()).sum()
    }

    fn speed_rad_per_s(&self, true_time_ns: i64) -> f64 {
        let speed =
            |sine: &Sine| sine.amplitude_rad * sine.rate_rad_per_s() * sine.argument_rad(true_time_ns).cos();
        self.sines.iter().map(speed).sum()
    }

    fn position(&self, lines: u32, true_time_ns: i64) -> Periods {
        let angle = Periods::from_f64(self.angle_rad(true_time_ns) * f64::from(lines) / TAU);
        Periods(self.start.0.wrapping_add(angle.0))
    }

    fn periods_per_s(&self, lines: u32, true_time_ns: i64) -> f64 {
        self.speed_rad_per_s(true_time_ns) * f64::from(lines) / TAU
    }

    fn signal(&mut self, lines: u32, true_time_ns: i64) -> Signal {
        let position = self.position(lines, true_time_ns);
        let before = self.last.replace(position);
        Signal::Turning {
            position,
            periods_per_s: self.periods_per_s(lines, true_time_ns),
            amplitude: 1.0,
            reference_mark: before.and_then(|before| self.mark.between(before, position)),
            on_reference_mark: self.mark.is_at(position),
        }
    }
}

impl EncoderSource for SmoothMotion {
    fn signal(&mut self, channel: usize, at: Conversion) -> Signal {
        let lines = self.lines;
        match self.joints.get_mut(channel) {
            Some(joint) => joint.signal(lines, at.true_time_ns),
            None => Signal::NOT_CONNECTED,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP_NS: i64 = 10_000_000;

    fn positions(
        motion: &mut SmoothMotion,
        joint: usize,
        steps: i64,
    ) -> Vec<(Periods, f64, Option<Periods>)> {
        (0..steps)
            .map(|step| {
                let at = Conversion { true_time_ns: step * STEP_NS, system_time_ns: None };
                match motion.signal(joint, at) {
                    Signal::Turning { position, periods_per_s, reference_mark, .. } => {
                        (position, periods_per_s, reference_mark)
                    }
                    Signal::Recorded { .. } => panic!("a motion is not a recording"),
                }
            })
            .collect()
    }

    #[test]
    fn every_joint_stays_within_its_limits_and_moves() {
        for seed in 0..20 {
            let motion = SmoothMotion::new(5, 3600, seed);
            for joint in 0..5 {
                let angles: Vec<f64> =
                    (0..6000).map(|step| motion.angle_rad(joint, step * STEP_NS)).collect();
                assert!(angles.iter().all(|angle| angle.abs() <= ANGLE_MAX_RAD));
                let fastest = angles.windows(2).map(|pair| (pair[1] - pair[0]).abs()).fold(0.0, f64::max);
                assert!((0.02..=SPEED_MAX_RAD_PER_S).contains(&(fastest * 100.0)), "{fastest}");
            }
        }
    }

    #[test]
    fn speed_is_the_change_of_position() {
        let mut motion = SmoothMotion::new(1, 3600, 4);
        for pair in positions(&mut motion, 0, 2000).windows(2) {
            let change = (pair[1].0.0 - pair[0].0.0) as f64 / Periods::ONE as f64 * 100.0;
            let mean = (pair[0].1 + pair[1].1) / 2.0;
            assert!((change - mean).abs() < 0.01, "{change} against {mean} periods/s");
        }
    }

    #[test]
    fn the_reference_mark_is_reported_when_it_is_passed_and_always_at_the_same_place() {
        let mut motion = SmoothMotion::new(5, 3600, 11);
        let mut places = Vec::new();
        for pair in positions(&mut motion, 2, 12_000).windows(2) {
            let (from, to) = (pair[0].0.min(pair[1].0), pair[0].0.max(pair[1].0));
            if let Some(mark) = pair[1].2 {
                assert!(from <= mark && mark <= to);
                places.push(mark);
            }
        }
        assert!(places.len() > 1 && places.iter().all(|place| *place == places[0]), "{places:?}");
    }

    #[test]
    fn the_same_seed_gives_the_same_motion() {
        let at = 1_800_000_000_123_456_789;
        let angle = |seed| SmoothMotion::new(5, 3600, seed).angle_rad(3, at);
        assert_eq!(angle(9), angle(9));
        assert_ne!(angle(9), angle(10));
    }
}
