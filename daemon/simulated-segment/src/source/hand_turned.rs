//! Simulates a person who stops the motion of all joints, and turns one joint at a time by hand.

use std::f64::consts::TAU;
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering};

use super::{Conversion, EncoderSource, Periods, Signal, SmoothMotion};

/// Speed of a joint that is turned by hand. With 3600 lines, the signal frequency is then below 750 Hz, the limit of full
/// resolution at 12 bits.
const SPEED_RAD_PER_S: f64 = 1.2;
/// Values of the command in [`Hand`]. With `LET_GO` the motion continues, with `HOLD` all joints are held. Any
/// other value turns a channel.
const LET_GO: i64 = 0;
const HOLD: i64 = i64::MAX;

/// Controls the simulated person, from any thread. The shared number is the command: `LET_GO`, `HOLD`, or the channel to
/// turn, plus one. A negative number turns the channel with decreasing counts.
#[derive(Debug, Clone, Default)]
pub struct Hand(Arc<AtomicI64>);

impl Hand {
    /// Stops the motion. All joints keep their angles.
    pub fn hold(&self) {
        self.0.store(HOLD, Ordering::Release);
    }

    /// Turns the encoder on this channel with increasing counts. The other joints are held.
    pub fn turn(&self, channel: usize) {
        self.0.store(channel as i64 + 1, Ordering::Release);
    }

    /// Turns the encoder on this channel with decreasing counts. The other joints are held.
    pub fn turn_back(&self, channel: usize) {
        self.0.store(-(channel as i64 + 1), Ordering::Release);
    }

    /// Continues the motion from the current joint angles.
    pub fn let_go(&self) {
        self.0.store(LET_GO, Ordering::Release);
    }

    fn command(&self) -> i64 {
        self.0.load(Ordering::Acquire)
    }
}

#[derive(Debug, Clone, Copy, Default)]
struct TurnedJoint {
    /// Total angle by which the joint was turned by hand.
    by_hand: Periods,
    /// True time \[ns\] and position of the last conversion.
    last: Option<(i64, Periods)>,
}

/// A [`SmoothMotion`] that a [`Hand`] can stop, and whose joints the hand can turn. Until the hand is used, the signals are
/// those of the motion.
#[derive(Debug, Clone)]
pub struct HandTurned {
    motion: SmoothMotion,
    hand: Hand,
    joints: Vec<TurnedJoint>,
    /// Total time for which the motion was stopped \[ns\].
    stopped_ns: i64,
    held_since_ns: Option<i64>,
}

impl HandTurned {
    /// Returns the source and the hand that controls it.
    pub fn new(motion: SmoothMotion) -> (Self, Hand) {
        let hand = Hand::default();
        let joints = vec![TurnedJoint::default(); motion.joints.len()];
        (Self { motion, hand: hand.clone(), joints, stopped_ns: 0, held_since_ns: None }, hand)
    }

    /// Time of the motion: the true time, minus the time for which the motion was held. `is_held` states whether
    /// the motion is held now.
    fn motion_ns(&mut self, true_time_ns: i64, is_held: bool) -> i64 {
        if is_held {
            let since_ns = *self.held_since_ns.get_or_insert(true_time_ns);
            return since_ns - self.stopped_ns;
        }
        if let Some(since_ns) = self.held_since_ns.take() {
            self.stopped_ns += true_time_ns - since_ns;
        }
        true_time_ns - self.stopped_ns
    }
}

impl EncoderSource for HandTurned {
    fn signal(&mut self, channel: usize, at: Conversion) -> Signal {
        let command = self.hand.command();
        let motion_ns = self.motion_ns(at.true_time_ns, command != LET_GO);
        let Self { motion, joints, .. } = self;
        let Some((joint, mark)) = joints.get_mut(channel).zip(motion.mark(channel)) else {
            return Signal::NOT_CONNECTED;
        };
        let is_turned = command.unsigned_abs() == channel as u64 + 1;
        let direction = if is_turned { command.signum() as f64 } else { 0.0 };
        let mut periods_per_s = direction * SPEED_RAD_PER_S * f64::from(motion.lines) / TAU;
        let elapsed_ns = joint.last.map_or(0, |(last_ns, _)| at.true_time_ns.saturating_sub(last_ns).max(0));
        let moved = Periods::from_f64(periods_per_s * elapsed_ns as f64 * 1e-9);
        joint.by_hand = Periods(joint.by_hand.0.wrapping_add(moved.0));
        if command == LET_GO {
            periods_per_s = motion.periods_per_s(channel, motion_ns);
        }
        let position = Periods(motion.position(channel, motion_ns).0.wrapping_add(joint.by_hand.0));
        let before = joint.last.replace((at.true_time_ns, position));
        Signal::Turning {
            position,
            periods_per_s,
            amplitude: 1.0,
            reference_mark: before.and_then(|(_, before)| mark.between(before, position)),
            on_reference_mark: mark.is_at(position),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: i64) -> Conversion {
        Conversion { true_time_ns: ms * 1_000_000, system_time_ns: None }
    }

    fn position(source: &mut impl EncoderSource, channel: usize, ms: i64) -> Periods {
        match source.signal(channel, at(ms)) {
            Signal::Turning { position, .. } => position,
            Signal::Recorded { .. } => panic!("a motion is not a recording"),
        }
    }

    #[test]
    fn untouched_it_is_the_motion() {
        let mut motion = SmoothMotion::new(2, 3600, 3);
        let (mut turned, _) = HandTurned::new(motion.clone());
        for step in 0..6000 {
            assert_eq!(turned.signal(1, at(step * 10)), motion.signal(1, at(step * 10)));
        }
    }

    #[test]
    fn one_joint_turns_the_others_are_held_and_the_motion_continues_from_there() {
        let (mut turned, hand) = HandTurned::new(SmoothMotion::new(2, 3600, 3));
        let start = [position(&mut turned, 0, 0), position(&mut turned, 1, 0)];
        hand.turn_back(1);
        let held = [position(&mut turned, 0, 1), position(&mut turned, 1, 1)];
        let after = [position(&mut turned, 0, 1001), position(&mut turned, 1, 1001)];
        assert_eq!(held[0], after[0]);
        let moved = (after[1].0 - held[1].0) as f64 / Periods::ONE as f64;
        assert!((moved + 1.2 * 3600.0 / TAU).abs() < 1e-3, "{moved} periods in a second");
        hand.let_go();
        let continued = position(&mut turned, 0, 2001);
        // The motion was stopped for at least one second. It moves less than 230 periods in a second.
        assert!((continued.0 - start[0].0).abs() < 230 * Periods::ONE, "no jump");
    }
}
