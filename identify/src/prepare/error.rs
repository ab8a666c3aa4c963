//! Why recording and robot log cannot be brought together.

use crate::kinematics::InverseError;
use crate::logs::LogError;

/// What is wrong and what to do.
#[derive(Debug, thiserror::Error)]
pub enum PrepareError {
    /// The recording has no usable cycle.
    #[error(
        "none of the recording's {cycles} cycles has valid counts of all encoders; look at its gaps and events, \
         and record again"
    )]
    NoValidCycle {
        /// Cycles in the recording.
        cycles: usize,
    },
    /// A cycle's encoders are not those that the recording declares.
    #[error(
        "cycle {cycle} has an encoder on joint {found} where joint {declared} is declared; the recording is damaged \
         or was put together from different runs"
    )]
    EncoderOrder {
        /// Number of the cycle.
        cycle: u64,
        /// Joint declared for the place.
        declared: u8,
        /// Joint found there.
        found: u8,
    },
    /// The recording declares encoders that a bar cannot have.
    #[error("the recording declares an encoder on joint {joint}; each of the joints 1 to 5 may have one")]
    EncoderJoint {
        /// The joint.
        joint: u8,
    },
    /// Too little data to match.
    #[error(
        "{what} covers {seconds:.1} s, at least {needed:.1} s are needed to match the logs; log a longer motion"
    )]
    TooShort {
        /// Which log.
        what: &'static str,
        /// What it covers \[s\].
        seconds: f64,
        /// What is needed \[s\].
        needed: f64,
    },
    /// Too much to match, or a time stamp far from the others.
    #[error(
        "{what} covers {hours:.1} h, at most {hours_max} h can be matched; cut out the run, or was a clock set \
         during it?"
    )]
    TooLong {
        /// Which log.
        what: &'static str,
        /// What it covers \[h\].
        hours: f64,
        /// What can be matched \[h\].
        hours_max: f64,
    },
    /// Nothing moves.
    #[error(
        "{what} shows no motion (largest joint travel {travel_deg:.2} deg); is it the part with the motion?"
    )]
    NoMotion {
        /// Which log.
        what: &'static str,
        /// Largest travel of a joint \[deg\].
        travel_deg: f64,
    },
    /// The robot did not move on a sphere.
    #[error(
        "only {inliers_percent:.0} % of the robot's positions lie within {tolerance_mm:.0} mm of one sphere; check that \
         the log is of a run with the bar mounted, and that robot, tool_m and plate_m are configured as in the cell"
    )]
    NotASphere {
        /// Part of the positions on the best sphere \[%\].
        inliers_percent: f64,
        /// Distance that still counts \[mm\].
        tolerance_mm: f64,
    },
    /// The robot moved on another sphere than the bar allows.
    #[error(
        "the robot moved on a sphere of {found_mm:.0} mm, the bar is configured with {configured_mm:.0} mm; \
         correct length_m of the bar (or tool_m and plate_m), or take the log of this bar's run"
    )]
    OtherLength {
        /// Radius of the sphere \[mm\].
        found_mm: f64,
        /// Configured length \[mm\].
        configured_mm: f64,
    },
    /// Bar or robot of another structure.
    #[error("the ball-bar's configuration cannot be used: {0}")]
    Bar(#[from] InverseError),
    /// The robot's log cannot be interpolated.
    #[error(transparent)]
    Log(#[from] LogError),
    /// The speeds do not match anywhere.
    #[error(
        "robot log and recording do not match at any clock difference: the best correlation of their joint speeds is \
         {correlation:.2} (over {overlap_s:.0} s), at least {needed} is asked for. They do not overlap in time, are of \
         different runs, or an encoder is assigned to the wrong joint (order of the terminals)"
    )]
    NoMatch {
        /// Best correlation.
        correlation: f64,
        /// Overlap there \[s\].
        overlap_s: f64,
        /// Threshold.
        needed: f64,
    },
    /// The speeds match but the angles do not.
    #[error(
        "measured bar angles do not fit the robot's log in any of the bar's four configurations; nearest is \
         {configuration} with a spread of {spreads} mrad, at most {limit_mrad} is allowed. {hint}"
    )]
    NoConfiguration {
        /// The nearest configuration.
        configuration: String,
        /// Spread by encoder.
        spreads: String,
        /// Threshold \[mrad\].
        limit_mrad: f64,
        /// Likely cause.
        hint: String,
    },
    /// Hardly anything is left.
    #[error(
        "only {kept} samples are left ({outside} outside the robot's log, {singular} near singular poses, \
         {standstill} at standstill); record a motion over more of the sphere"
    )]
    NothingLeft {
        /// Samples kept.
        kept: usize,
        /// Samples that the robot's log does not cover.
        outside: usize,
        /// Samples near singular poses.
        singular: usize,
        /// Samples without motion.
        standstill: usize,
    },
}
