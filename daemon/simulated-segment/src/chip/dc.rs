//! The distributed clock of a chip (ETG.1000.4 section 6.8). The chip has a local clock, which drifts. Its copy of the
//! system time is the local time plus an offset. A PI control loop makes this copy follow the reference clock. SYNC0 pulses
//! occur at programmed system times.

use super::al::SyncReadiness;

/// A local clock: a crystal with a rate error of some ppm. The control loop of the chip corrects the rate.
#[derive(Debug, Clone, Default)]
pub struct LocalClock {
    /// Time of the last adjustment, as true time. The next field is the same instant as local time.
    base_true_ns: i64,
    base_local_ns: i64,
    /// Fraction of a nanosecond beyond `base_local_ns`.
    base_fraction_ns: f64,
    /// Relative error of the crystal.
    drift: f64,
    /// Relative correction by the control loop.
    correction: f64,
}

impl LocalClock {
    /// A clock that has the local time `start_ns` at true time `now_ns`. It gains `drift_ppm` on true time.
    pub fn new(now_ns: i64, start_ns: i64, drift_ppm: f64) -> Self {
        Self { base_true_ns: now_ns, base_local_ns: start_ns, drift: drift_ppm * 1e-6, ..Self::default() }
    }

    /// Converts true time to local time.
    pub fn local_ns(&self, true_ns: i64) -> i64 {
        let elapsed = true_ns.wrapping_sub(self.base_true_ns);
        let gained = elapsed as f64 * self.gain() + self.base_fraction_ns;
        self.base_local_ns.wrapping_add(elapsed).wrapping_add(gained.floor() as i64)
    }

    /// Converts local time to true time.
    pub fn true_ns(&self, local_ns: i64) -> i64 {
        let elapsed = local_ns.wrapping_sub(self.base_local_ns);
        let gain = self.gain();
        let excess = (elapsed as f64 * gain + self.base_fraction_ns) / (1.0 + gain);
        self.base_true_ns.wrapping_add(elapsed).wrapping_sub(excess.floor() as i64)
    }

    /// Steps the clock by `step_ns` at true time `now_ns`, and sets the correction of its rate to `correction`.
    fn adjust(&mut self, now_ns: i64, step_ns: f64, correction: f64) {
        let elapsed = now_ns.wrapping_sub(self.base_true_ns);
        let fraction = elapsed as f64 * self.gain() + self.base_fraction_ns + step_ns;
        let whole = fraction.floor();
        self.base_true_ns = now_ns;
        self.base_local_ns = self.base_local_ns.wrapping_add(elapsed).wrapping_add(whole as i64);
        self.base_fraction_ns = fraction - whole;
        self.correction = correction;
    }

    /// The clock after a power cycle of its device at `now_ns`. The crystal, and thus the drift, is the same.
    fn restarted(&self, now_ns: i64) -> Self {
        Self::new(now_ns, 0, self.drift * 1e6)
    }

    /// Relative rate of the clock: local seconds gained per true second.
    fn gain(&self) -> f64 {
        self.drift + self.correction
    }
}

/// Gains of the control loop. Each received time steps the clock by `-PROPORTIONAL * deviation`. It also changes the rate of
/// the clock by `-INTEGRAL * deviation / time since the last received time`. With `INTEGRAL = PROPORTIONAL^2 / 4`, the loop
/// is critically damped. A real chip counts in steps of 9 or 11 ns instead, with the same result after some thousand frames.
const PROPORTIONAL: f64 = 1.0 / 16.0;
const INTEGRAL: f64 = PROPORTIONAL * PROPORTIONAL / 4.0;
/// Largest deviation that one received time corrects. A chip with a larger deviation slews its clock instead of stepping it.
const DEVIATION_LIMIT_NS: f64 = 10_000.0;
/// Largest relative correction of the rate.
const CORRECTION_LIMIT: f64 = 200e-6;

const SYNC_ENABLE: u8 = 0x01;
const SYNC0_ENABLE: u8 = 0x02;
const SYNC1_ENABLE: u8 = 0x04;

/// SYNC0 pulses that have occurred since the last call of [`DistributedClock::take_pulses`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pulses {
    pub count: u64,
    /// Nominal system time of the last pulse, as programmed.
    pub system_ns: i64,
    /// True time of the last pulse.
    pub true_ns: i64,
}

/// The distributed clock unit of one chip.
#[derive(Default)]
pub struct DistributedClock {
    clock: LocalClock,
    /// System time minus local time (0x0920).
    pub offset_ns: i64,
    /// Delay of a frame from the reference clock to this chip (0x0928).
    pub delay_ns: u32,
    /// Filter depth of the mean deviation: about `2^filter_depth` deviations are averaged.
    filter_depth: u8,
    /// Mean deviation from the reference clock (register 0x092C). It is positive if this clock is ahead.
    difference_ns: f64,
    /// True time of the last correction.
    last_follow_ns: Option<i64>,
    /// Local time at which the latching frame arrived at each port (register 0x0900).
    pub port_times: [u32; 4],
    /// Local time at which the chip processed the latching frame (register 0x0918).
    pub receive_time: u64,
    activation: u8,
    start_ns: i64,
    sync0_cycle_ns: u32,
    sync1_cycle_ns: u32,
    /// System time of the next SYNC0 pulse.
    next_sync0_ns: Option<i64>,
    /// Whether there has been a SYNC0 pulse since SYNC0 was activated.
    pulsed: bool,
}

impl DistributedClock {
    /// The clock of a chip that was just powered up.
    pub fn new(clock: LocalClock) -> Self {
        Self { clock, filter_depth: 4, ..Self::default() }
    }

    /// The chip's copy of the system time (0x0910).
    pub fn system_ns(&self, now_ns: i64) -> i64 {
        self.clock.local_ns(now_ns).wrapping_add(self.offset_ns)
    }

    /// Steps the clock. This only happens as a simulated fault; a working chip never steps its clock.
    pub fn step(&mut self, now_ns: i64, step_ns: i64) {
        self.clock.adjust(now_ns, step_ns as f64, self.clock.correction);
    }

    /// The local clock after a power cycle of its device.
    pub fn restarted(&self, now_ns: i64) -> LocalClock {
        self.clock.restarted(now_ns)
    }

    /// Latches the local times at which the current frame passes the ports. The frame arrives at port 0 at `now_ns`. At
    /// `back_ns` it returns to port 1 from the devices after this one.
    pub fn latch(&mut self, now_ns: i64, back_ns: Option<i64>) {
        let local = self.clock.local_ns(now_ns);
        self.receive_time = local as u64;
        self.port_times[0] = local as u32;
        if let Some(back_ns) = back_ns {
            self.port_times[1] = self.clock.local_ns(back_ns) as u32;
        }
    }

    /// Value of register 0x092C, the mean deviation: the magnitude, with bit 31 set if this clock is behind.
    pub fn difference(&self) -> u32 {
        let magnitude = self.difference_ns.abs().round().min(f64::from(0x7fff_ffff_u32)) as u32;
        if self.difference_ns < 0.0 { magnitude | 0x8000_0000 } else { magnitude }
    }

    /// Sets the filter depth. Called when a master has written register 0x0934.
    pub fn set_filter_depth(&mut self, depth: u8) {
        self.filter_depth = depth & 0x0f;
    }

    /// Restarts the control loop. Called when a master has written register 0x0930, the start of the speed counter.
    pub fn reset_loop(&mut self, now_ns: i64) {
        self.clock.adjust(now_ns, 0.0, 0.0);
        self.difference_ns = 0.0;
        self.last_follow_ns = None;
    }

    /// Follows the reference clock. A write to register 0x0910 contains the system time of the reference clock. The
    /// deviation is the own time, minus the delay, minus the received time. If only four bytes were written, they are the
    /// low half of the time.
    pub fn follow(&mut self, received: &[u8], now_ns: i64) {
        let own_ns = self.system_ns(now_ns).wrapping_sub(i64::from(self.delay_ns));
        let deviation_ns = match (received.first_chunk::<8>(), received.first_chunk::<4>()) {
            (Some(wide), _) => own_ns.wrapping_sub(i64::from_le_bytes(*wide)) as f64,
            (None, Some(low)) => f64::from((own_ns as u32).wrapping_sub(u32::from_le_bytes(*low)) as i32),
            (None, None) => return,
        };
        self.difference_ns += (deviation_ns - self.difference_ns) / f64::from(1u32 << self.filter_depth);
        let mut correction = self.clock.correction;
        // While the clock is slewing, its deviation also changes because of the slew, so it does not show the rate error.
        if let Some(last_ns) = self.last_follow_ns.filter(|_| deviation_ns.abs() < DEVIATION_LIMIT_NS) {
            let elapsed_ns = now_ns.saturating_sub(last_ns).max(1) as f64;
            correction -= INTEGRAL * deviation_ns / elapsed_ns;
        }
        let deviation_ns = deviation_ns.clamp(-DEVIATION_LIMIT_NS, DEVIATION_LIMIT_NS);
        self.last_follow_ns = Some(now_ns);
        let correction = correction.clamp(-CORRECTION_LIMIT, CORRECTION_LIMIT);
        self.clock.adjust(now_ns, -PROPORTIONAL * deviation_ns, correction);
    }

    /// Sets start time and cycle times. Called when a master has written registers 0x0990 to 0x09A7.
    pub fn set_cycle(&mut self, start_ns: i64, sync0_cycle_ns: u32, sync1_cycle_ns: u32) {
        (self.start_ns, self.sync0_cycle_ns, self.sync1_cycle_ns) =
            (start_ns, sync0_cycle_ns, sync1_cycle_ns);
    }

    /// Activates SYNC0. Called when a master has written register 0x0981. If the start time is in
    /// the past, SYNC0 never pulses.
    pub fn activate(&mut self, activation: u8, now_ns: i64) {
        let started = activation & !self.activation & SYNC_ENABLE != 0;
        self.activation = activation;
        if activation & SYNC_ENABLE == 0 || activation & SYNC0_ENABLE == 0 {
            (self.next_sync0_ns, self.pulsed) = (None, false);
        } else if started {
            self.next_sync0_ns = (self.start_ns > self.system_ns(now_ns)).then_some(self.start_ns);
        }
    }

    /// Whether SYNC0 starts the conversions of the device.
    pub fn is_active(&self) -> bool {
        self.activation & SYNC_ENABLE != 0
    }

    /// State of the sync signals, for a device that needs both SYNC0 and SYNC1.
    pub fn readiness(&self, now_ns: i64) -> SyncReadiness {
        let both = SYNC0_ENABLE | SYNC1_ENABLE;
        if !self.is_active() {
            SyncReadiness::Off
        } else if self.activation & both != both || self.sync0_cycle_ns == 0 {
            SyncReadiness::Invalid
        } else if self.sync1_cycle_ns == 0 || self.sync1_cycle_ns >= self.sync0_cycle_ns {
            SyncReadiness::WrongSync1
        } else if self.pulsed || self.next_sync0_ns.is_some_and(|next| next <= self.system_ns(now_ns)) {
            SyncReadiness::Running
        } else {
            SyncReadiness::Waiting
        }
    }

    /// Takes all SYNC0 pulses that are at least `age_ns` old. The computing time does not depend on the number of pulses.
    pub fn take_pulses(&mut self, now_ns: i64, age_ns: i64) -> Option<Pulses> {
        let first_ns = self.next_sync0_ns?;
        let passed_ns = self.system_ns(now_ns).saturating_sub(age_ns).saturating_sub(first_ns);
        if passed_ns < 0 {
            return None;
        }
        let cycle_ns = i64::from(self.sync0_cycle_ns);
        let after_first = passed_ns.checked_div(cycle_ns).unwrap_or(0);
        let system_ns = first_ns.saturating_add(after_first.saturating_mul(cycle_ns));
        self.next_sync0_ns = if cycle_ns == 0 { None } else { system_ns.checked_add(cycle_ns) };
        self.pulsed = true;
        let true_ns = self.clock.true_ns(system_ns.wrapping_sub(self.offset_ns));
        Some(Pulses { count: after_first as u64 + 1, system_ns, true_ns })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn running(start_ns: i64) -> DistributedClock {
        let mut clock = DistributedClock::new(LocalClock::new(0, 0, 20.0));
        clock.set_cycle(start_ns, 10 * MS as u32, 25_000);
        clock.activate(0x07, 0);
        clock
    }

    #[test]
    fn a_local_clock_can_be_read_backwards_over_years() {
        let clock = LocalClock::new(1_700_000_000_000_000_000, 123_456, -17.3);
        for elapsed_ns in [0, 1, 999, 1_000_000_007, 86_400_000_000_000, 63_000_000_000_000_000] {
            let true_ns = 1_700_000_000_000_000_000 + elapsed_ns;
            let back_ns = clock.true_ns(clock.local_ns(true_ns));
            // The tolerance is the rounding error of floating point: one part in 2^53 of the clock's gain over two
            // years is a few ns.
            assert!((back_ns - true_ns).abs() <= 1 + elapsed_ns / 10_i64.pow(16), "{elapsed_ns}");
        }
    }

    #[test]
    fn followers_with_different_drift_converge_to_the_reference_within_thousands_of_frames() {
        let reference = LocalClock::new(0, 1_000_000, 18.0);
        for drift_ppm in [-50.0, -3.0, 0.0, 40.0] {
            let mut follower = DistributedClock::new(LocalClock::new(0, 77, drift_ppm));
            follower.set_filter_depth(0);
            follower.delay_ns = 300;
            follower.offset_ns = 1_000_300 - 77 + 2_000;
            for frame in 1..3000 {
                let now_ns = frame * 20_000;
                follower.follow(&reference.local_ns(now_ns).to_le_bytes(), now_ns + 300);
            }
            assert!(follower.difference() & 0x7fff_ffff <= 3, "{drift_ppm} ppm: {}", follower.difference());
        }
    }

    #[test]
    fn a_clock_that_is_behind_shows_it_in_the_sign_bit() {
        let mut clock = DistributedClock::new(LocalClock::new(0, 0, 0.0));
        clock.set_filter_depth(0);
        clock.follow(&(1000i64 + 64).to_le_bytes(), 1000);
        assert_eq!(clock.difference(), 0x8000_0040);
        clock.reset_loop(2000);
        let own_ns = clock.system_ns(2000);
        clock.follow(&(own_ns as u32 - 64).to_le_bytes(), 2000);
        assert_eq!(clock.difference(), 64, "four bytes are enough");
    }

    #[test]
    fn pulses_come_at_their_nominal_times_and_only_when_they_are_old_enough() {
        let mut clock = running(20 * MS);
        assert_eq!(clock.take_pulses(19 * MS, 0), None);
        assert_eq!(clock.take_pulses(20 * MS + 20_000, 28_000), None);
        let first = clock.take_pulses(20 * MS + 29_000, 28_000).unwrap();
        assert_eq!((first.count, first.system_ns), (1, 20 * MS));
        // The local clock gains 20 ppm. It therefore reaches 20 ms already 400 ns early.
        assert!((first.true_ns - (20 * MS - 400)).abs() <= 1);
        assert_eq!(clock.take_pulses(29 * MS, 28_000), None);
    }

    #[test]
    fn a_long_pause_is_one_step() {
        let mut clock = running(20 * MS);
        let year_ns = 365 * 86_400 * 1_000_000_000;
        let pulses = clock.take_pulses(year_ns, 0).unwrap();
        assert_eq!(pulses.count as i64, (pulses.system_ns - 20 * MS) / (10 * MS) + 1);
        assert!(year_ns - pulses.true_ns <= 10 * MS);
        assert_eq!(clock.take_pulses(year_ns + MS / 10, 0), None);
    }

    #[test]
    fn a_start_in_the_past_gives_no_pulses() {
        let mut clock = running(-1);
        assert_eq!(clock.take_pulses(1000 * MS, 0), None);
        assert_eq!(clock.readiness(1000 * MS), SyncReadiness::Waiting);
    }
}
