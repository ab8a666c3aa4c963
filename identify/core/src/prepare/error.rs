//! Errors of the preparation of a recording and a robot log.

use std::fmt;

use super::steps::{HOURS_MAX, ORIGIN_CHANGES_MAX, TRAVEL_DEG_MIN};
use super::{Deviations, ForceError};
use crate::kinematics::InverseError;
use crate::logs::LogError;

/// The log with which the robot's log is aligned.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ComparedLog {
    /// The recording of the ball-bar.
    Recording,
    /// The log of a tracker.
    Tracker,
}

impl ComparedLog {
    /// A possible cause of speeds that do not match, if this cause is specific to this log. The text is a part of the list
    /// of causes in the message.
    const fn own_cause(self) -> &'static str {
        match self {
            Self::Recording => "the bar came off during the run, ",
            Self::Tracker => "",
        }
    }
}

impl fmt::Display for ComparedLog {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Recording => "recording",
            Self::Tracker => "tracker's log",
        })
    }
}

/// Why logs cannot be aligned. Each message contains what to do.
#[derive(Debug, thiserror::Error)]
pub enum PrepareError {
    /// The recording has no cycle with valid counts.
    #[error(
        "none of the recording's {cycles} cycles has valid counts of all encoders; check its gaps and events, \
         and record again"
    )]
    NoValidCycle {
        /// Cycles in the recording.
        cycles: usize,
    },
    /// The recording has more changes of the counters' origin than are allowed.
    #[error(
        "the encoders' counters may have restarted at {origins} places, at most {ORIGIN_CHANGES_MAX} are allowed; repair \
         the plug, cable or supply and record again, or correct lines and interpolation_bits in the bar's configuration"
    )]
    TooManyOrigins {
        /// Number of changes of the counters' origin in the recording.
        origins: usize,
    },
    /// The encoders in a cycle differ from those that the recording declares.
    #[error(
        "cycle {cycle} has an encoder on joint {found} where joint {declared} is declared: the recording is damaged \
         or was assembled from different runs; use the original file"
    )]
    EncoderOrder {
        /// Number of the cycle.
        cycle: u64,
        /// Joint of the encoder that the recording declares at this position.
        declared: u8,
        /// Joint of the encoder in the cycle.
        found: u8,
    },
    /// The recording declares an encoder on a joint that the bar does not have, or two encoders on one joint.
    #[error(
        "the recording declares an encoder on joint {joint}, which the bar does not have, or two encoders on it; use the original file"
    )]
    EncoderJoint {
        /// Joint that is invalid or has two encoders.
        joint: u8,
    },
    /// One of the logs is too short.
    #[error(
        "{what} covers {seconds:.2} s, at least {needed:.1} s are needed to match the logs; log a longer motion, or correct the \
         unit of its time stamps"
    )]
    TooShort {
        /// Name of the log, for the message.
        what: &'static str,
        /// Duration of this log \[s\].
        seconds: f64,
        /// Shortest allowed duration \[s\].
        needed: f64,
    },
    /// One of the logs is too long, or one of its time stamps is far from the others.
    #[error(
        "{what} covers {hours:.1} h, at most {HOURS_MAX} h can be matched; remove the rows outside the run or from before a clock \
         was set, or correct the unit of its time stamps"
    )]
    TooLong {
        /// Name of the log, for the message.
        what: &'static str,
        /// Duration of this log \[h\].
        hours: f64,
    },
    /// No joint moves in one of the logs.
    #[error(
        "{what} shows no motion: no joint travels more than {travel_deg:.2} deg, at least {TRAVEL_DEG_MIN} are needed; give the file \
         of the run, or record it again"
    )]
    NoMotion {
        /// Name of the log, for the message.
        what: &'static str,
        /// Largest travel of a joint \[deg\].
        travel_deg: f64,
    },
    /// The robot did not move on a sphere.
    #[error(
        "only {inliers_percent:.0} % of the robot's positions lie within {tolerance_mm:.0} mm of one sphere; {}",
        .likely.as_deref().unwrap_or(
            "check that the log is of a run with the bar mounted, and that robot, tool_m and plate_m are configured as in \
             the cell"
        )
    )]
    NotASphere {
        /// Percentage of the positions that lie on the best sphere \[%\].
        inliers_percent: f64,
        /// Largest distance from the sphere at which a position counts as lying on it \[mm\].
        tolerance_mm: f64,
        /// The probable mistake in the log's joints, if a single mistake explains the error.
        likely: Option<String>,
    },
    /// The radius of the robot's sphere is not the configured length of the bar.
    #[error(
        "the robot moved on a sphere of {found_mm:.0} mm, the bar is configured with {configured_mm:.0} mm; {}",
        .likely.as_deref().unwrap_or(
            "correct length_m, tool_m or plate_m of the bar, or the signs and the coupling of the log's joints, or take the \
             log of this run"
        )
    )]
    OtherLength {
        /// Radius of the sphere \[mm\].
        found_mm: f64,
        /// Configured length \[mm\].
        configured_mm: f64,
        /// The probable mistake in the log's joints, if a single mistake explains the error.
        likely: Option<String>,
    },
    /// The bar does not have the structure of a ball-bar.
    #[error("the ball-bar's configuration cannot be used: {0}")]
    Bar(#[from] InverseError),
    /// The robot's log cannot be interpolated.
    #[error(transparent)]
    Log(#[from] LogError),
    /// The speeds do not match anywhere.
    #[error(
        "robot log and {other} do not match at any clock difference: the best correlation of their speeds is \
         {correlation:.2} (over {overlap_s:.0} s), at least {needed} is required. They do not overlap or are of \
         different runs, {}or noise or invalid rows hide the motion; give the log of this run, or compare both with \
         `identify inspect`",
        other.own_cause()
    )]
    NoMatch {
        /// The log with which the robot's log was compared.
        other: ComparedLog,
        /// Highest correlation of the speeds.
        correlation: f64,
        /// Overlap of the logs at this correlation \[s\].
        overlap_s: f64,
        /// Smallest correlation of matching logs.
        needed: f64,
    },
    /// The speeds cannot be compared at any clock difference.
    #[error(
        "robot log and {other} cannot be compared: at no clock difference both have speeds for {needed_s:.0} s. Stamps in bunches give \
         impossible speeds, stamps far apart give none; log the time of each sample (`identify inspect` shows their distances)"
    )]
    NoSpeeds {
        /// The log with which the robot's log was compared.
        other: ComparedLog,
        /// Shortest allowed time with speeds in both logs \[s\].
        needed_s: f64,
    },
    /// The logs match, but their overlap is too short.
    #[error(
        "robot log and tracker's log match, but overlap by {overlap_s:.1} s only, at least {needed_s:.1} s are needed; log both over \
         the whole motion"
    )]
    ShortOverlap {
        /// Overlap of the match \[s\].
        overlap_s: f64,
        /// Shortest allowed overlap \[s\].
        needed_s: f64,
    },
    /// The tracker's target does not move.
    #[error(
        "the positions in the tracker's log are within {extent_mm:.1} mm: the target does not move; check the columns and unit of \
         [position] in the mapping, or give the log of a motion"
    )]
    TargetStands {
        /// Diagonal of the box that contains the positions \[mm\].
        extent_mm: f64,
    },
    /// The speeds match, but the angles do not fit with any order and direction of the encoders.
    #[error(
        "the measured bar angles do not fit the robot's log with any order and direction of the encoders; as recorded \
         (encoder -> joint): {recorded}, at most {limit_mrad} mrad is allowed for each; {}",
        .likely.as_deref().unwrap_or(
            "the robot's or the bar's configuration (lengths, lines and interpolation_bits of the encoders, or [base] of a robot \
             that is not mounted as the bar) is not that of this cell, or robot log and recording are of different runs; \
             correct the configuration, or give the log of this run"
        )
    )]
    NoEncoderMap {
        /// The recorded order with its spread, as text.
        recorded: String,
        /// Largest allowed spread \[mrad\].
        limit_mrad: f64,
        /// The probable cause, if a single cause explains the error.
        likely: Option<String>,
    },
    /// Several orders or directions of the encoders fit.
    #[error(
        "the encoders do not fit as recorded, and several other orders or directions fit equally well (encoder -> joint):\
         {fits}\nCheck on the bar which one is right and give that option (or `encoders = [..]` under [prepare] of the \
         configuration), or move more joints"
    )]
    AmbiguousEncoderMap {
        /// For each encoder map that fits, a line with its option.
        fits: String,
    },
    /// The angles of the encoders fit only the mirror image of the robot's motion.
    #[error(
        "the encoders see the mirror image of the motion in the robot's log: either the log has reversed signs of the robot's {}, or all \
         encoders on the bar's joints 1, 3 and 5 count the other way than recorded. Check the direction of the robot's joint 1; \
         correct the signs in the robot log's mapping or, if they are right, type --encoders {stated} \
         (or `encoders = [{stated}]` under [prepare] of the configuration)",
        of_joints(joints.as_deref())
    )]
    Mirrored {
        /// Joints of the robot, counted from 0, whose reversed signs give the mirror image; `None` if no reversal of signs
        /// gives the mirror image.
        joints: Option<Vec<usize>>,
        /// Joints and directions of the encoders in the format of `--encoders`.
        stated: String,
    },
    /// The recorded order and directions of the encoders do not fit, but others do. The options allow only the recorded ones.
    #[error(
        "the encoders do not fit as recorded (encoder -> joint): {recorded}, but as {found}; correct order or \
         direction in the bar's configuration, or let it be found with --encoders find (`encoders = \"find\"` under \
         [prepare])"
    )]
    OtherEncoderMap {
        /// The recorded order with its spread, as text.
        recorded: String,
        /// The order that fits, with its spread, as text.
        found: String,
    },
    /// The order and directions that the user gave do not fit, but others do.
    #[error(
        "the encoders do not fit as stated (encoder -> joint): {stated}, but as {found}; take --encoders {as_stated}, or let the \
         program find it with --encoders find (`encoders` under [prepare])"
    )]
    OtherThanStated {
        /// The order that the user gave, with its spread, as text.
        stated: String,
        /// The order that fits, with its spread, as text.
        found: String,
        /// The order that fits, in the format of `--encoders`.
        as_stated: String,
    },
    /// The order that the user gave is invalid.
    #[error(
        "invalid encoders {stated} (--encoders, or `encoders` under [prepare]); give {encoders} different bar joints, 1 to 5, one \
         for each encoder of the recording; a minus sign reverses the recorded direction of the encoder"
    )]
    StatedEncoderMap {
        /// The list as the user gave it.
        stated: String,
        /// Number of encoders of the recording.
        encoders: usize,
    },
    /// The clock difference changes during the run. Either a clock was set, or samples are missing without a gap in the stamps.
    #[error(
        "a clock jumps during the run: {at_s:.0} s after the first sample, the robot's clock minus the other one changes by \
         {by_ms:+.1} ms; find out what sets the clock and record again, or calibrate both sides with --split-at-changes"
    )]
    ClockJump {
        /// Approximate time of the change after the first sample \[s\].
        at_s: f64,
        /// Change of robot clock minus bar clock \[ms\].
        by_ms: f64,
    },
    /// The readings of an encoder are constant while others change.
    #[error(
        "the encoder of joint {joint} is constant from {from_s:.1} s to {to_s:.1} s after the first sample while others move; check it, its \
         cable and its terminal, and record again, or remove that part"
    )]
    EncoderFrozen {
        /// Bar joint, 1 to 5, as recorded.
        joint: u8,
        /// First constant reading, as time after the first sample \[s\].
        from_s: f64,
        /// Last constant reading, as time after the first sample \[s\].
        to_s: f64,
    },
    /// The angle of an encoder jumps: the encoder lost counts or turned on its shaft.
    #[error(
        "the encoder of joint {joint} slips: {at_s:.2} s after the first sample its angle jumps by {by_mrad:+.2} mrad \
         relative to the robot and stays there; check its coupling and cable, and record again"
    )]
    EncoderSlip {
        /// Bar joint, 1 to 5.
        joint: u8,
        /// Time of the change after the first sample \[s\].
        at_s: f64,
        /// Change of the encoder's angle relative to the robot \[mrad\].
        by_mrad: f64,
    },
    /// From some instant on, a joint of the robot is not at the angle that the log reports.
    #[error(
        "the log of the robot's joint {joint} steps by {by_mrad:+.2} mrad relative to the bar, {at_s:.2} s after the first sample; \
         check for a collision, a restart of the controller or a belt that slipped, and record again"
    )]
    JointStep {
        /// Joint of the robot, from 1.
        joint: u8,
        /// Time of the change after the first sample \[s\].
        at_s: f64,
        /// Change of reported angle minus true angle \[mrad\].
        by_mrad: f64,
    },
    /// The base of the bar moves during the run.
    #[error(
        "the base of the bar moves by {by_mm:.2} mm at {at_s:.2} s after the first sample; fasten it, and record again"
    )]
    BaseMoved {
        /// Time of the change after the first sample \[s\].
        at_s: f64,
        /// Distance by which the base moves \[mm\].
        by_mm: f64,
    },
    /// The angles do not fit, although all parameters of the geometry may change within their tolerances.
    #[error(
        "the logs match, but the angles deviate by {spreads} mrad from any geometry near the nominal one, at most \
         {limit_mrad} is allowed; compare robot, tool, plate and bar in the configuration with the cell, and check the bolts"
    )]
    PoorFit {
        /// Spread of each encoder, as text \[mrad\].
        spreads: String,
        /// Largest allowed spread \[mrad\].
        limit_mrad: f64,
    },
    /// An error, and the residuals that show this error.
    #[error("{error}")]
    WithDeviations {
        /// The error without the residuals.
        error: Box<PrepareError>,
        /// The residuals of the angles at the geometry that fits best.
        deviations: Box<Deviations>,
    },
    /// The force on the bar cannot be used.
    #[error(transparent)]
    Force(#[from] ForceError),
    /// Too few samples remain for a fit.
    #[error(
        "the matched part of the logs is too short or too near to singular poses of the bar to compare angles; record \
         a motion over more of the sphere"
    )]
    NothingToFit,
    /// A joint of the bar hardly moves.
    #[error(
        "joint {joint} of the bar travels only {travel_deg:.1} deg, at least {needed_deg} are needed to separate its offset \
         from the robot's geometry; turn the flange more, about all axes"
    )]
    LittleTravel {
        /// Bar joint, 1 to 5.
        joint: u8,
        /// Travel of this joint over the kept samples \[deg\].
        travel_deg: f64,
        /// Smallest allowed travel \[deg\].
        needed_deg: f64,
    },
    /// The robot's positions determine no sphere, for example because they lie on a circle.
    #[error(
        "insufficient excitation: the robot's positions span no sphere (they lie on a line, a circle or in one place); \
         move the bar over a large part of its sphere, with all joints"
    )]
    LittleMotion,
    /// Too few samples remain for a solve.
    #[error(
        "only {kept} samples remain ({outside} outside the robot's log, {singular} near singular poses, \
         {standstill} at standstill); record a motion over more of the sphere"
    )]
    NothingLeft {
        /// Number of kept samples.
        kept: usize,
        /// Number of samples that the robot's log does not cover.
        outside: usize,
        /// Number of samples near singular poses.
        singular: usize,
        /// Number of samples without motion.
        standstill: usize,
    },
}

/// Formats joints that are counted from 0 as text with joints counted from 1, such as `joints 1, 4 and 6`.
fn of_joints(joints: Option<&[usize]>) -> String {
    let names: Vec<String> = joints.unwrap_or_default().iter().map(|joint| (joint + 1).to_string()).collect();
    match names.split_last() {
        None => "joints".into(),
        Some((only, [])) => format!("joint {only}"),
        Some((last, others)) => format!("joints {} and {last}", others.join(", ")),
    }
}
