//! Why recording and robot log cannot be brought together.

use super::{Deviations, ForceError};
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
    /// More parts with offsets of their own than are solved for.
    #[error(
        "the encoders' counters started anew, or may have, at {origins} places, at most {most} are followed; mend the plug, cable or \
         supply that fails so often and record again, or, if none did, compare lines and interpolation_bits in the bar's \
         configuration with the encoders"
    )]
    TooManyOrigins {
        /// Places where they did.
        origins: usize,
        /// Threshold.
        most: usize,
    },
    /// A cycle's encoders are not those that the recording declares.
    #[error(
        "cycle {cycle} has an encoder on joint {found} where joint {declared} is declared; the recording is damaged \
         or was put together from different runs; take it as it was recorded"
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
        "only {inliers_percent:.0} % of the robot's positions lie within {tolerance_mm:.0} mm of one sphere; {}",
        .likely.as_deref().unwrap_or(
            "check that the log is of a run with the bar mounted, and that robot, tool_m and plate_m are configured as in \
             the cell"
        )
    )]
    NotASphere {
        /// Part of the positions on the best sphere \[%\].
        inliers_percent: f64,
        /// Distance that still counts \[mm\].
        tolerance_mm: f64,
        /// What is wrong with the log's joints, where one mistake explains it.
        likely: Option<String>,
    },
    /// The robot moved on another sphere than the bar allows.
    #[error(
        "the robot moved on a sphere of {found_mm:.0} mm, the bar is configured with {configured_mm:.0} mm; {}",
        .likely.as_deref().unwrap_or(
            "correct length_m of the bar (or tool_m and plate_m), or take the log of this bar's run"
        )
    )]
    OtherLength {
        /// Radius of the sphere \[mm\].
        found_mm: f64,
        /// Configured length \[mm\].
        configured_mm: f64,
        /// What is wrong with the log's joints, where one mistake explains it.
        likely: Option<String>,
    },
    /// Bar or robot of another structure.
    #[error("the ball-bar's configuration cannot be used: {0}")]
    Bar(#[from] InverseError),
    /// The robot's log cannot be interpolated.
    #[error(transparent)]
    Log(#[from] LogError),
    /// The speeds do not match anywhere.
    #[error(
        "robot log and {other} do not match at any clock difference: the best correlation of their speeds is \
         {correlation:.2} (over {overlap_s:.0} s), at least {needed} is asked for. They do not overlap in time or are \
         of different runs, or something hides the motion in one of them, such as noise or rows that are no measurements; give the \
         log of this run, or look for that with `identify inspect`, which shows both"
    )]
    NoMatch {
        /// What it was compared with.
        other: &'static str,
        /// Best correlation.
        correlation: f64,
        /// Overlap there \[s\].
        overlap_s: f64,
        /// Threshold.
        needed: f64,
    },
    /// Speeds cannot be compared anywhere.
    #[error(
        "robot log and {other} cannot be compared: at no clock difference do both say for {needed_s:.0} s how fast the robot moves. \
         Stamps that come in bunches, or too far apart, give speeds that no robot has, or none; log the time at which each sample \
         was taken (`identify inspect` shows how far apart stamps are)"
    )]
    NoSpeeds {
        /// What the robot's log was compared with.
        other: &'static str,
        /// For how long both would have to \[s\].
        needed_s: f64,
    },
    /// They match where they hardly overlap.
    #[error(
        "robot log and tracker's log match, but overlap by {overlap_s:.1} s only, at least {needed_s:.1} s are needed: one of them \
         ended before the other began in earnest; log both over the whole motion"
    )]
    ShortOverlap {
        /// Overlap of the match \[s\].
        overlap_s: f64,
        /// Threshold \[s\].
        needed_s: f64,
    },
    /// What the tracker follows does not move.
    #[error(
        "the positions in the tracker's log are within {extent_mm:.1} mm: the target does not move; check the columns and unit of \
         [position] in the mapping, or give the log of a motion"
    )]
    TargetStands {
        /// Diagonal of the box that holds them \[mm\].
        extent_mm: f64,
    },
    /// The speeds match but the angles do not.
    #[error(
        "measured bar angles do not fit the robot's log, in whatever order and direction the encoders are taken; as \
         recorded (encoder -> joint): {recorded}, at most {limit_mrad} mrad is allowed for each; {}",
        .likely.as_deref().unwrap_or(
            "the robot's or the bar's configuration (lengths, or lines and interpolation_bits of the encoders) is not that of \
             this cell, or robot log and recording are of different runs; correct the configuration, or give the log of this run"
        )
    )]
    NoEncoderMap {
        /// How the recorded order fits.
        recorded: String,
        /// Threshold \[mrad\].
        limit_mrad: f64,
        /// What is wrong, where one thing explains it.
        likely: Option<String>,
    },
    /// Several orders or directions of the encoders fit.
    #[error(
        "the encoders do not fit as recorded, and several other orders or directions fit alike (encoder -> joint):\
         {fits}\nLook at the bar which is right and type that option (or put `encoders = [..]` under [prepare] of the \
         configuration), or move more joints"
    )]
    AmbiguousEncoderMap {
        /// Those that fit.
        fits: String,
    },
    /// The encoders see the mirror image of the robot in the log.
    #[error(
        "the encoders see the mirror image of the motion in the robot's log: either the log has the signs of the robot's {} \
         reversed, or all encoders on the bar's joints 1, 3 and 5 count the other way than recorded; the angles do not say which, and \
         the wrong choice calibrates a mirrored robot. Turn joint 1 of the robot towards plus and look which way it turns; correct \
         the signs in the robot log's mapping, or, if they are right, type --encoders {stated} (or put `encoders = [{stated}]` \
         under [prepare] of the configuration)",
        of_joints(joints.as_deref())
    )]
    Mirrored {
        /// The robot's joints that mirror it, from 0, if signs alone do.
        joints: Option<Vec<usize>>,
        /// The encoders' places as `--encoders` takes them.
        stated: String,
    },
    /// Another order or direction fits than the recording states, and it is not to be taken.
    #[error(
        "the encoders do not fit as recorded (encoder -> joint): {recorded}, but as {found}; correct order or \
         direction in the bar's configuration, or let it be found with --encoders find (`encoders = \"find\"` under \
         [prepare])"
    )]
    OtherEncoderMap {
        /// How the recorded order fits.
        recorded: String,
        /// The one that fits.
        found: String,
    },
    /// Another order or direction fits than was stated.
    #[error(
        "the encoders do not fit as stated (encoder -> joint): {stated}, but as {found}; take --encoders {as_stated}, or leave it \
         to the program with --encoders find (`encoders` under [prepare])"
    )]
    OtherThanStated {
        /// How the stated order fits.
        stated: String,
        /// The one that fits.
        found: String,
        /// As `--encoders` takes it.
        as_stated: String,
    },
    /// The order stated in the configuration makes no sense.
    #[error(
        "the stated encoders (--encoders, or `encoders` under [prepare]) are {stated}; give one bar joint for each of the {encoders} encoders of the recording, \
         1 to 5, none twice, negative where an encoder counts the other way than recorded"
    )]
    StatedEncoderMap {
        /// As given.
        stated: String,
        /// Encoders of the recording.
        encoders: usize,
    },
    /// A clock was set, or samples are missing without a hole in the stamps.
    #[error(
        "a clock jumps during the run: {at_s:.0} s after the first sample the logs are {by_ms:+.1} ms further apart than before; \
         calibrate from one side of the jump, and find out what sets the clock"
    )]
    ClockJump {
        /// When, about \[s\].
        at_s: f64,
        /// By how much the robot's clock comes later \[ms\].
        by_ms: f64,
    },
    /// An encoder says the same while the others move.
    #[error(
        "the encoder of joint {joint} says the same from {from_s:.1} s to {to_s:.1} s after the first sample while others move: it, its \
         cable or its terminal was dead; check them, and record again, or take that part out"
    )]
    EncoderFrozen {
        /// Bar joint, 1 to 5, as recorded.
        joint: u8,
        /// From when \[s\].
        from_s: f64,
        /// Until when \[s\].
        to_s: f64,
    },
    /// An encoder lost counts or turned on its shaft.
    #[error(
        "the encoder of joint {joint} slips: {at_s:.2} s after the first sample its angle jumps by {by_mrad:+.2} mrad \
         against the robot and stays there; check its coupling and cable, and record again"
    )]
    EncoderSlip {
        /// Bar joint, 1 to 5.
        joint: u8,
        /// When \[s\].
        at_s: f64,
        /// By how much \[mrad\].
        by_mrad: f64,
    },
    /// A joint of the robot is no longer where its log says.
    #[error(
        "the log of the robot's joint {joint} steps: from {at_s:.2} s after the first sample on it reports {by_mrad:+.2} mrad more \
         than before against the bar; look for a collision, a restart of the controller or a belt that slipped, and record again"
    )]
    JointStep {
        /// Joint of the robot, from 1.
        joint: u8,
        /// When \[s\].
        at_s: f64,
        /// By how much the log reports more \[mrad\].
        by_mrad: f64,
    },
    /// The bar does not stand where it stood.
    #[error(
        "the base of the bar moves: from {at_s:.2} s after the first sample on it stands {by_mm:.2} mm from where it stood; \
         fasten it, and record again"
    )]
    BaseMoved {
        /// When \[s\].
        at_s: f64,
        /// How far \[mm\].
        by_mm: f64,
    },
    /// Even with all numbers of the geometry moved within their tolerances the angles do not fit.
    #[error(
        "the logs belong together, but the angles stay {spreads} mrad from any geometry near the nominal one, at most \
         {limit_mrad} is allowed; robot, tool, plate or bar are configured otherwise than in the cell, or something \
         is loose; compare the configuration with the cell, and try what is bolted on"
    )]
    PoorFit {
        /// Spread by encoder.
        spreads: String,
        /// Threshold \[mrad\].
        limit_mrad: f64,
    },
    /// One of the above, found by comparing the angles with the geometry that fits best.
    #[error("{error}")]
    WithDeviations {
        /// What is wrong.
        error: Box<PrepareError>,
        /// What it rests on.
        deviations: Box<Deviations>,
    },
    /// The force on the bar cannot be used.
    #[error(transparent)]
    Force(#[from] ForceError),
    /// No samples to fit.
    #[error(
        "the matched part of the logs is too short or too near to singular poses of the bar to compare angles; record \
         a motion over more of the sphere"
    )]
    NothingToFit,
    /// A joint of the bar hardly moves.
    #[error(
        "joint {joint} of the bar travels only {travel_deg:.1} deg, at least {needed_deg} are needed to tell its zero \
         from the robot's geometry; turn the flange more, about all axes"
    )]
    LittleTravel {
        /// Bar joint, 1 to 5.
        joint: u8,
        /// Its travel over the samples kept \[deg\].
        travel_deg: f64,
        /// Threshold \[deg\].
        needed_deg: f64,
    },
    /// The robot moved on a circle or stood.
    #[error(
        "the motion excites too little: the robot's positions span no sphere (they lie on a line, a circle or in one place); \
         move the bar over a good part of its sphere, with all joints"
    )]
    LittleMotion,
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

/// `joints 1, 4 and 6`, from joints counted from 0.
fn of_joints(joints: Option<&[usize]>) -> String {
    let names: Vec<String> = joints.unwrap_or_default().iter().map(|joint| (joint + 1).to_string()).collect();
    match names.split_last() {
        None => "joints as they mirror it".into(),
        Some((only, [])) => format!("joint {only}"),
        Some((last, others)) => format!("joints {} and {last}", others.join(", ")),
    }
}
