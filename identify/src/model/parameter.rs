//! Names and units of parameters.

use std::fmt;
use std::str::FromStr;

use super::{BarWaves, Coordinate, Harmonic, JointTerm, JointWaves, ModelError, Phase};
use crate::kinematics::{AXES_MAX, BAR_JOINTS, LinkParameter, ROD_LINK};

/// A coordinate axis of the root frame or of the flange.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Axis {
    /// x
    X,
    /// y
    Y,
    /// z
    Z,
}

impl Axis {
    /// All three.
    pub const ALL: [Self; 3] = [Self::X, Self::Y, Self::Z];

    /// 0 to 2.
    pub const fn index(self) -> usize {
        self as usize
    }

    pub(super) const fn letter(self) -> char {
        match self {
            Self::X => 'x',
            Self::Y => 'y',
            Self::Z => 'z',
        }
    }
}

/// One parameter of the closed chain. Links count from 0 here, from 1 in names.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum ParameterId {
    /// Of the robot's link: `ra1`, `rd1`, `ralpha1`, `rtheta1`, `rbeta2`.
    Robot {
        /// Link from 0.
        link: usize,
        /// Which of its numbers.
        parameter: LinkParameter,
    },
    /// Of the ball-bar's link: `ba1`, `bd1`, `balpha1`, `btheta1`.
    Bar {
        /// Link from 0.
        link: usize,
        /// Which of its numbers.
        parameter: LinkParameter,
    },
    /// Place of the bar's base: `ox`, `oy`, `oz`.
    Base(Axis),
    /// Rotation of the bar's base about x, then y: `orx`, `ory`.
    BaseRotation(Axis),
    /// How much longer the bar is for each newton along it: `bcompliance`.
    BarCompliance,
    /// How much longer it is on one side of its play than in the middle, by the sign of the force: `bplay`.
    BarPlay,
    /// How much longer the bar is in some directions, a whole number of times per turn of its first two joints: `bdsin2_1`
    /// (sine of twice joint 1's reading) .. `bdcos3_2`.
    BarWave {
        /// Joint from 0.
        joint: usize,
        /// Waves per turn.
        order: u8,
        /// Sine or cosine.
        phase: Phase,
    },
    /// Error of a bar encoder that repeats with its turns: `bsin1_1` (sine of once joint 1's reading) .. `bcos2_5`.
    Harmonic {
        /// Joint from 0.
        joint: usize,
        /// Which wave.
        harmonic: Harmonic,
    },
    /// What is added to a bar encoder's angle after its counter lost its origin during the run, beside `btheta`: `boffset1_2`
    /// (encoder 2 after the first loss).
    EncoderOffset {
        /// Which origin, from 1: 0 is that of `btheta`.
        origin: usize,
        /// Joint from 0.
        joint: usize,
    },
    /// Error of a robot axis that repeats with its motion: `rsin1_1` (sine of once drive 1's angle) .. `rtool_5`.
    Joint {
        /// Axis from 0.
        axis: usize,
        /// Which term.
        term: JointTerm,
    },
    /// Error of a robot axis that comes back a whole number of times per turn, more than twice: `rsin17_1` (sine of 17
    /// times drive 1's angle).
    JointWave {
        /// Axis from 0.
        axis: usize,
        /// Waves per turn.
        order: u8,
        /// Sine or cosine.
        phase: Phase,
    },
    /// Robot clock minus bar clock at the reference time.
    ClockShift,
    /// How much faster the robot's clock runs.
    ClockSkew,
    /// Where a wire or telescoping bar is attached, in the flange frame: `attachment_x` ..., in the second place `attachment2_x`
    Attachment {
        /// Place on the flange from 0.
        target: usize,
        /// Which coordinate.
        axis: Axis,
    },
    /// Where it is anchored, in the robot's base: `anchor_x` ..., in the second place `anchor2_x`
    Anchor {
        /// Place in the cell from 0.
        station: usize,
        /// Which coordinate.
        axis: Axis,
    },
    /// Added to the distance to give the measured length.
    LengthOffset,
    /// Where a tracker stands, in the robot's base: `tracker_x` .. `tracker_rz`, in its second station `tracker2_x` ...
    Tracker {
        /// Station from 0.
        station: usize,
        /// Which of its numbers.
        coordinate: Coordinate,
    },
    /// Where what the tracker sees is, in the flange frame: `probe_x` .. `probe_rz`, the second target `probe2_x` ...
    Probe {
        /// Target from 0.
        target: usize,
        /// Which of its numbers.
        coordinate: Coordinate,
    },
    /// Centre of a ball that is seated in sockets, in the flange frame: `ball_x` ...
    Ball(Axis),
    /// Where the ball's centre is when it is seated in a socket, in the robot's base: `socket1_x` ...
    Socket {
        /// Socket from 0, at most [`ParameterId::SOCKETS_MAX`] of them.
        socket: usize,
        /// Which coordinate.
        axis: Axis,
    },
}

/// What a parameter belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Owner {
    /// The robot: its links and the errors of its joints.
    Robot,
    /// The clocks of two logs.
    Clocks,
    /// The ball-bar, its base or its encoders.
    BallBar,
    /// A draw-wire or telescoping bar.
    Wire,
    /// A tracker or its probe.
    Tracker,
    /// A ball and its sockets.
    Contact,
}

/// What a parameter is measured in, and how people read it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unit {
    /// Metres, read in mm.
    Metre,
    /// Radians, read in mrad.
    Radian,
    /// Seconds, read in ms.
    Second,
    /// Ratio, read in ppm.
    Ratio,
    /// Radians per newton metre times newtons: by how much an axis gives way for each metre of its load's lever, read in
    /// mrad/m.
    RadianPerMetre,
    /// Metres per newton, read in um/N.
    MetrePerNewton,
}

impl Unit {
    /// Displayed number for one of the SI unit.
    pub const fn display_factor(self) -> f64 {
        match self {
            Self::Metre | Self::Radian | Self::Second | Self::RadianPerMetre => 1e3,
            Self::Ratio | Self::MetrePerNewton => 1e6,
        }
    }

    /// Symbol of the displayed unit.
    pub const fn display_symbol(self) -> &'static str {
        match self {
            Self::Metre => "mm",
            Self::Radian => "mrad",
            Self::Second => "ms",
            Self::Ratio => "ppm",
            Self::RadianPerMetre => "mrad/m",
            Self::MetrePerNewton => "um/N",
        }
    }

    /// A size for a person, four digits at most, with its unit.
    pub fn display(self, si: f64) -> String {
        let displayed = si * self.display_factor();
        // The shortest text of the number that four digits leave.
        let rounded = format!("{displayed:.3e}").parse().unwrap_or(displayed);
        format!("{rounded} {}", self.display_symbol())
    }

    /// Symbol of the SI unit, `1` for ratios.
    pub const fn si_symbol(self) -> &'static str {
        match self {
            Self::Metre => "m",
            Self::Radian => "rad",
            Self::Second => "s",
            Self::Ratio => "1",
            Self::RadianPerMetre => "rad/m",
            Self::MetrePerNewton => "m/N",
        }
    }
}

/// `a`, `d`, `alpha`, `theta` or `beta`.
pub const fn link_parameter_name(parameter: LinkParameter) -> &'static str {
    match parameter {
        LinkParameter::A => "a",
        LinkParameter::D => "d",
        LinkParameter::Alpha => "alpha",
        LinkParameter::Theta => "theta",
        LinkParameter::Beta => "beta",
    }
}

impl ParameterId {
    /// The standard numbers of a link, in the order of the thesis' tables.
    pub(super) const STANDARD: [LinkParameter; 4] =
        [LinkParameter::A, LinkParameter::D, LinkParameter::Alpha, LinkParameter::Theta];

    /// Sockets that have parameters.
    pub const SOCKETS_MAX: usize = 99;
    /// Stations of a tracker or anchors of a wire, and targets on a flange, that have parameters.
    pub const SET_UPS_MAX: usize = 99;
    /// Origins of counters that have parameters of their own: a run that loses more keeps what the preparation found.
    pub const LAST_ORIGIN: usize = 99;
    /// Length of the ball-bar: `bd3`.
    pub const ROD: Self = Self::Bar { link: ROD_LINK, parameter: LinkParameter::D };

    /// Lengths that are measured apart from the robot, each with its own uncertainty.
    pub const KNOWN_LENGTHS: [Self; 2] = [Self::PLATE, Self::ROD];

    /// Offset plate between axis 6 of the robot and axis 5 of the ball-bar: `ra6`.
    pub const PLATE: Self = Self::Robot { link: 5, parameter: LinkParameter::A };

    /// What the bar's length owes to a force along it.
    pub const OF_FORCE: [Self; 2] = [Self::BarCompliance, Self::BarPlay];

    /// The link of the ball-bar that the parameter belongs to, from 0.
    pub const fn bar_link(self) -> Option<usize> {
        match self {
            Self::Bar { link, .. } => Some(link),
            Self::BarCompliance | Self::BarPlay | Self::BarWave { .. } => Some(ROD_LINK),
            _ => None,
        }
    }

    /// What it belongs to.
    pub const fn owner(self) -> Owner {
        match self {
            Self::Robot { .. } | Self::Joint { .. } | Self::JointWave { .. } => Owner::Robot,
            Self::ClockShift | Self::ClockSkew => Owner::Clocks,
            Self::Bar { .. } | Self::Base(_) | Self::BaseRotation(_) => Owner::BallBar,
            Self::BarCompliance | Self::BarPlay | Self::BarWave { .. } => Owner::BallBar,
            Self::Harmonic { .. } | Self::EncoderOffset { .. } => Owner::BallBar,
            Self::Attachment { .. } | Self::Anchor { .. } | Self::LengthOffset => Owner::Wire,
            Self::Tracker { .. } | Self::Probe { .. } => Owner::Tracker,
            Self::Ball(_) | Self::Socket { .. } => Owner::Contact,
        }
    }

    /// It changes what an instrument measures, as far as its owner says: the robot's, the clocks' and the instrument's own.
    pub fn is_seen_by(self, instrument: Owner) -> bool {
        let owner = self.owner();
        owner == instrument || matches!(owner, Owner::Robot | Owner::Clocks)
    }

    /// SI unit and display unit.
    pub const fn unit(self) -> Unit {
        match self {
            Self::Robot { parameter, .. } | Self::Bar { parameter, .. } => match parameter {
                LinkParameter::A | LinkParameter::D => Unit::Metre,
                LinkParameter::Alpha | LinkParameter::Theta | LinkParameter::Beta => Unit::Radian,
            },
            Self::Base(_) | Self::Attachment { .. } | Self::Anchor { .. } | Self::LengthOffset => Unit::Metre,
            Self::Ball(_) | Self::Socket { .. } => Unit::Metre,
            Self::Tracker { coordinate, .. } | Self::Probe { coordinate, .. } => match coordinate {
                Coordinate::Position(_) => Unit::Metre,
                Coordinate::Rotation(_) => Unit::Radian,
            },
            Self::BarPlay | Self::BarWave { .. } => Unit::Metre,
            Self::BarCompliance => Unit::MetrePerNewton,
            Self::BaseRotation(_) | Self::Harmonic { .. } | Self::EncoderOffset { .. } => Unit::Radian,
            Self::JointWave { .. } => Unit::Radian,
            Self::Joint { term, .. } => match term {
                JointTerm::Ratio => Unit::Ratio,
                JointTerm::Delay => Unit::Second,
                JointTerm::Compliance(_) => Unit::RadianPerMetre,
                _ => Unit::Radian,
            },
            Self::ClockShift => Unit::Second,
            Self::ClockSkew => Unit::Ratio,
        }
    }

    /// Harmonics of all bar encoders.
    pub fn harmonics() -> impl Iterator<Item = Self> {
        let of = |joint| Harmonic::ALL.into_iter().map(move |harmonic| Self::Harmonic { joint, harmonic });
        (0..BAR_JOINTS).flat_map(of)
    }

    /// All waves of the bar's length.
    pub fn bar_waves() -> impl Iterator<Item = Self> {
        let of = |joint| {
            (BarWaves::FIRST..=BarWaves::LAST).flat_map(move |order| {
                Phase::ALL.into_iter().map(move |phase| Self::BarWave { joint, order, phase })
            })
        };
        (0..BarWaves::JOINTS).flat_map(of)
    }

    /// Zeros of all bar encoders in the origins from 1 to `last`, at most [`Self::LAST_ORIGIN`].
    pub fn zeros(last: usize) -> impl Iterator<Item = Self> {
        let of = |origin| (0..BAR_JOINTS).map(move |joint| Self::EncoderOffset { origin, joint });
        (1..=last.min(Self::LAST_ORIGIN)).flat_map(of)
    }

    /// Where a tracker stands in its stations and where its targets are: positions, then rotations, of each.
    pub fn tracker(stations: usize, targets: usize) -> impl Iterator<Item = Self> {
        let places = (0..stations.min(Self::SET_UPS_MAX))
            .flat_map(|station| Coordinate::ALL.map(|coordinate| Self::Tracker { station, coordinate }));
        let probes = (0..targets.min(Self::SET_UPS_MAX))
            .flat_map(|target| Coordinate::ALL.map(|coordinate| Self::Probe { target, coordinate }));
        places.chain(probes)
    }

    /// Where a wire is anchored and attached, and what its lengths begin with.
    pub fn wire(anchors: usize, attachments: usize) -> impl Iterator<Item = Self> {
        let attachments = (0..attachments.min(Self::SET_UPS_MAX))
            .flat_map(|target| Axis::ALL.map(|axis| Self::Attachment { target, axis }));
        let anchors = (0..anchors.min(Self::SET_UPS_MAX))
            .flat_map(|station| Axis::ALL.map(|axis| Self::Anchor { station, axis }));
        attachments.chain(anchors).chain([Self::LengthOffset])
    }

    /// A ball and the sockets that it is seated in.
    pub fn contact(sockets: usize) -> impl Iterator<Item = Self> {
        let of = |socket| Axis::ALL.map(|axis| Self::Socket { socket, axis });
        Axis::ALL.map(Self::Ball).into_iter().chain((0..sockets.min(Self::SOCKETS_MAX)).flat_map(of))
    }

    /// Terms of all robot axes, whether a robot has them or not.
    pub fn joint_terms() -> impl Iterator<Item = Self> {
        let of = |axis| JointTerm::ALL.into_iter().map(move |term| Self::Joint { axis, term });
        (0..AXES_MAX).flat_map(of)
    }

    /// Waves of all robot axes, whether a robot has them or not, from [`JointWaves::FIRST`] up to `last` per turn.
    pub fn joint_waves(last: u8) -> impl Iterator<Item = Self> {
        let of = move |axis| {
            (JointWaves::FIRST..=last.min(JointWaves::LAST)).flat_map(move |order| {
                Phase::ALL.into_iter().map(move |phase| Self::JointWave { axis, order, phase })
            })
        };
        (0..AXES_MAX).flat_map(of)
    }

    /// The wave of an axis with this name; none for any other name. There are too many to look through.
    fn joint_wave_named(name: &str) -> Option<Self> {
        let (phase, numbers) = Phase::ALL.into_iter().find_map(|phase| {
            let rest = name.strip_prefix('r')?.strip_prefix(&phase.to_string())?;
            Some((phase, rest.split_once('_')?))
        })?;
        let (order, axis) = (numbers.0.parse().ok()?, numbers.1.parse::<usize>().ok()?.checked_sub(1)?);
        let known = (JointWaves::FIRST..=JointWaves::LAST).contains(&order) && axis < AXES_MAX;
        let id = Self::JointWave { axis, order, phase };
        // Numbers can be written in other ways.
        (known && id.to_string() == name).then_some(id)
    }

    /// Every parameter that has a name, but waves of the robot's axes.
    fn all_but_joint_waves() -> impl Iterator<Item = Self> {
        let robot = (0..AXES_MAX).flat_map(|link| {
            let with_hayati = Self::STANDARD.into_iter().chain([LinkParameter::Beta]);
            with_hayati.map(move |parameter| Self::Robot { link, parameter })
        });
        let bar = (0..BAR_JOINTS)
            .flat_map(|link| Self::STANDARD.into_iter().map(move |parameter| Self::Bar { link, parameter }));
        robot
            .chain(bar)
            .chain(Axis::ALL.map(Self::Base))
            .chain([Self::BaseRotation(Axis::X), Self::BaseRotation(Axis::Y)])
            .chain(Self::OF_FORCE)
            .chain(Self::bar_waves())
            .chain(Self::harmonics())
            .chain(Self::zeros(Self::LAST_ORIGIN))
            .chain(Self::joint_terms())
            .chain([Self::ClockShift, Self::ClockSkew])
            .chain(Self::wire(Self::SET_UPS_MAX, Self::SET_UPS_MAX))
            .chain(Self::tracker(Self::SET_UPS_MAX, Self::SET_UPS_MAX))
            .chain(Self::contact(Self::SOCKETS_MAX))
    }

    /// Every parameter that has a name.
    pub fn all() -> impl Iterator<Item = Self> {
        Self::all_but_joint_waves().chain(Self::joint_waves(JointWaves::LAST))
    }
}

/// The number of a station or target in names, from 1; the first has none.
pub fn further(number: usize) -> String {
    if number == 0 { String::new() } else { (number + 1).to_string() }
}

impl fmt::Display for ParameterId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Robot { link, parameter } => write!(f, "r{}{}", link_parameter_name(parameter), link + 1),
            Self::Bar { link, parameter } => write!(f, "b{}{}", link_parameter_name(parameter), link + 1),
            Self::Base(axis) => write!(f, "o{}", axis.letter()),
            Self::BaseRotation(axis) => write!(f, "or{}", axis.letter()),
            Self::BarCompliance => f.write_str("bcompliance"),
            Self::BarPlay => f.write_str("bplay"),
            Self::BarWave { joint, order, phase } => write!(f, "bd{phase}{order}_{}", joint + 1),
            Self::Harmonic { joint, harmonic } => write!(f, "b{harmonic}_{}", joint + 1),
            Self::EncoderOffset { origin, joint } => write!(f, "boffset{origin}_{}", joint + 1),
            Self::JointWave { axis, order, phase } => write!(f, "r{phase}{order}_{}", axis + 1),
            Self::Joint { axis, term } => write!(f, "r{term}_{}", axis + 1),
            Self::ClockShift => f.write_str("clock_shift"),
            Self::ClockSkew => f.write_str("clock_skew"),
            Self::Attachment { target, axis } => {
                write!(f, "attachment{}_{}", further(target), axis.letter())
            }
            Self::Anchor { station, axis } => write!(f, "anchor{}_{}", further(station), axis.letter()),
            Self::LengthOffset => f.write_str("length_offset"),
            Self::Tracker { station, coordinate } => write!(f, "tracker{}_{coordinate}", further(station)),
            Self::Probe { target, coordinate } => write!(f, "probe{}_{coordinate}", further(target)),
            Self::Ball(axis) => write!(f, "ball_{}", axis.letter()),
            Self::Socket { socket, axis } => write!(f, "socket{}_{}", socket + 1, axis.letter()),
        }
    }
}

impl FromStr for ParameterId {
    type Err = ModelError;

    fn from_str(name: &str) -> Result<Self, ModelError> {
        Self::joint_wave_named(name)
            .or_else(|| Self::all_but_joint_waves().find(|id| id.to_string() == name))
            .ok_or_else(|| ModelError::UnknownName { name: name.to_owned() })
    }
}
