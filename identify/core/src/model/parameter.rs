//! All parameters, in blocks: one row says what a block is called, whose it is, what kind of number, and where it stands.
//!
//! A new term or instrument is a new row here, and what moves with it where residuals are ([`crate::cost`]).

use std::collections::HashMap;
use std::fmt;
use std::str::FromStr;
use std::sync::LazyLock;

use super::geometry::DIRECTION_JOINTS;
use super::{Coordinate, Geometry, JointTerm, ModelError, Phase, TermGroup, Waves};
use crate::kinematics::{AXES_MAX, BAR_JOINTS, DhLink, LinkParameter, ROD_LINK};

/// A coordinate axis of the root frame or of the flange.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
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

/// One of the numbers of a face.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum FaceNumber {
    /// Of its normal: `nx`, `ny`, `nz`. The largest is one, and stays.
    Normal(Axis),
    /// Its distance from the origin: `d`.
    Distance,
}

impl FaceNumber {
    /// All four numbers of a face.
    pub const ALL: [Self; 4] =
        [Self::Normal(Axis::X), Self::Normal(Axis::Y), Self::Normal(Axis::Z), Self::Distance];

    /// Place among them, 0 to 3.
    pub const fn index(self) -> usize {
        match self {
            Self::Normal(axis) => axis.index(),
            Self::Distance => Axis::ALL.len(),
        }
    }

    const fn unit(self) -> Unit {
        match self {
            Self::Normal(_) => Unit::Radian,
            Self::Distance => Unit::Metre,
        }
    }
}

impl fmt::Display for FaceNumber {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Normal(axis) => write!(f, "n{}", axis.letter()),
            Self::Distance => f.write_str("d"),
        }
    }
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
    /// A tip and the faces that it touches.
    Touch,
}

/// What kind of number a parameter is, from which follows what is known of it before anything is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Group {
    /// Of a link as it was made, within a tolerance.
    Link,
    /// A second way to say what another number says: opted into by name, in place of that.
    InPlaceOfAnother,
    /// Where something stands, how it is mounted or what it counts from: anywhere.
    Placement,
    /// Of a clock.
    Clock,
    /// What a force does.
    Force,
    /// An error that is there or not.
    Term(TermGroup),
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
    /// Radians per newton metre times newtons: by how much an axis deflects for each metre of its load's lever, read in
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

/// What the parameters of a block have in common.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ParameterBlock {
    /// Whose they are.
    pub owner: Owner,
    /// What kind of number.
    pub group: Group,
    /// SI unit and display unit.
    pub unit: Unit,
    /// Another number in every run: set up anew, or counted from a new zero.
    pub of_run: bool,
    /// A model has them where they are asked for; all others where its geometry has them.
    pub on_request: bool,
}

impl ParameterBlock {
    const fn new(owner: Owner, group: Group, unit: Unit) -> Self {
        let of_run = !matches!(owner, Owner::Robot | Owner::BallBar);
        Self { owner, group, unit, of_run, on_request: false }
    }

    const fn of_run(self) -> Self {
        Self { of_run: true, ..self }
    }

    const fn on_request(self) -> Self {
        Self { on_request: true, ..self }
    }

    const fn of_link(owner: Owner, parameter: LinkParameter) -> Self {
        match parameter {
            LinkParameter::A | LinkParameter::D => Self::new(owner, Group::Link, Unit::Metre),
            LinkParameter::Alpha | LinkParameter::Theta => Self::new(owner, Group::Link, Unit::Radian),
            LinkParameter::Beta => Self::new(owner, Group::InPlaceOfAnother, Unit::Radian),
        }
    }

    const fn placed(owner: Owner, coordinate: Coordinate) -> Self {
        match coordinate {
            Coordinate::Position(_) => Self::new(owner, Group::Placement, Unit::Metre),
            Coordinate::Rotation(_) => Self::new(owner, Group::Placement, Unit::Radian),
        }
    }
}

/// One row for each block: its numbers and their ranges, name, what it has in common, where the number stands.
macro_rules! parameters {
    ($(
        $(#[$doc:meta])*
        $block:ident $({ $( $(#[$field_doc:meta])* $field:ident: $type:ty = $values:expr, )* })?
            called $name:expr,
            is $common:expr,
            at |$geometry:ident| $number:expr;
    )*) => {
        /// One parameter, in the order of reports. Links, axes and all else count from 0 here, from 1 in names.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub enum ParameterId {
            $( $(#[$doc])* $block $({ $( $(#[$field_doc])* $field: $type, )* })?, )*
        }

        impl ParameterId {
            fn name(self) -> String {
                match self { $( Self::$block { $($($field),*)? } => $name.to_string(), )* }
            }

            /// What it has in common with others.
            #[allow(unused_variables, reason = "most blocks have all in common")]
            pub const fn block(self) -> ParameterBlock {
                match self { $( Self::$block { $($($field),*)? } => $common, )* }
            }

            /// Every parameter that has a name.
            pub fn all() -> impl Iterator<Item = Self> {
                // There are thousands, and each model that is made goes through them.
                static ALL: LazyLock<Vec<ParameterId>> = LazyLock::new(ParameterId::list);
                ALL.iter().copied()
            }

            fn list() -> Vec<Self> {
                let mut all = Vec::new();
                $( parameters!(each all $block [] $($( $field = $values; )*)?); )*
                all
            }
        }

        impl Geometry {
            /// The number that a parameter names; none for a link, a joint or a station that is not there.
            pub fn parameter_mut(&mut self, id: ParameterId) -> Option<&mut f64> {
                match id { $( ParameterId::$block { $($($field),*)? } => { let $geometry = self; $number } )* }
            }
        }
    };
    (each $all:ident $block:ident [$($field:ident)*]) => { $all.push(Self::$block { $($field),* }) };
    (each $all:ident $block:ident [$($done:ident)*] $field:ident = $values:expr; $($rest:tt)*) => {
        for $field in $values { parameters!(each $all $block [$($done)* $field] $($rest)*); }
    };
}

parameters! {
    /// Of the robot's link: `ra1`, `rd1`, `ralpha1`, `rtheta1`, `rbeta2`.
    Robot {
        /// Link.
        link: usize = 0..AXES_MAX,
        /// Which of its numbers.
        parameter: LinkParameter = LinkParameter::ALL,
    }
        called format!("r{}{}", parameter.name(), link + 1),
        is ParameterBlock::of_link(Owner::Robot, parameter),
        at |geometry| geometry.robot.links.get_mut(link).map(|link| of_link(link, parameter));

    /// Error of a robot axis that repeats with its motion: `rsin1_1` (sine of once drive 1's angle) .. `rtool_5`.
    Joint {
        /// Axis.
        axis: usize = 0..AXES_MAX,
        /// Which term.
        term: JointTerm = JointTerm::ALL,
    }
        called format_args!("r{term}_{}", axis + 1),
        is ParameterBlock::new(Owner::Robot, Group::Term(term.group()), term.unit()),
        at |geometry| geometry.joints.amplitude_mut(axis, term);

    /// Error of a robot axis that comes back a whole number of times per turn, more than twice: `rsin17_1` (sine of 17
    /// times drive 1's angle).
    JointWave {
        /// Axis.
        axis: usize = 0..AXES_MAX,
        /// Waves per turn.
        order: u8 = Waves::OF_AXIS,
        /// Sine or cosine.
        phase: Phase = Phase::ALL,
    }
        called format_args!("r{phase}{order}_{}", axis + 1),
        is ParameterBlock::new(Owner::Robot, Group::Term(TermGroup::LineSpectrum), Unit::Radian).on_request(),
        at |geometry| if geometry.joints.drives.turns(axis) {
            geometry.axis_waves.get_mut(axis).map(|waves| waves.amplitude_mut(order, phase))
        } else {
            None
        };

    /// Of the ball-bar's link: `ba1`, `bd1`, `balpha1`, `btheta1`; the last is the zero of its encoder.
    Bar {
        /// Link.
        link: usize = 0..BAR_JOINTS,
        /// Which of its numbers.
        parameter: LinkParameter = LinkParameter::STANDARD,
    }
        called format!("b{}{}", parameter.name(), link + 1),
        is match parameter {
            LinkParameter::Theta => {
                ParameterBlock::new(Owner::BallBar, Group::Placement, Unit::Radian).of_run()
            }
            _ => ParameterBlock::of_link(Owner::BallBar, parameter),
        },
        at |geometry| geometry.bar_links.get_mut(link).map(|link| of_link(link, parameter));

    /// Place of the bar's base: `ox`, `oy`, `oz`.
    Base {
        /// Which coordinate.
        axis: Axis = Axis::ALL,
    }
        called format_args!("o{}", axis.letter()),
        is ParameterBlock::new(Owner::BallBar, Group::Placement, Unit::Metre).of_run(),
        at |geometry| geometry.base.origin_m.get_mut(axis.index());

    /// Rotation of the bar's base about x, then y: `orx`, `ory`. About z it would be `btheta1` a second time.
    BaseRotation {
        /// About which axis.
        axis: Axis = [Axis::X, Axis::Y],
    }
        called format_args!("or{}", axis.letter()),
        is ParameterBlock::new(Owner::BallBar, Group::Placement, Unit::Radian).of_run(),
        at |geometry| match axis {
            Axis::X => Some(&mut geometry.base.rx_rad),
            Axis::Y => Some(&mut geometry.base.ry_rad),
            Axis::Z => None,
        };

    /// Error of a bar encoder that repeats with its turns: `bsin1_1` (sine of once joint 1's reading) .. `bcos2_5`.
    EncoderWave {
        /// Joint.
        joint: usize = 0..BAR_JOINTS,
        /// Waves per turn.
        order: u8 = Waves::OF_ENCODER,
        /// Sine or cosine.
        phase: Phase = Phase::ALL,
    }
        called format_args!("b{phase}{order}_{}", joint + 1),
        is ParameterBlock::new(Owner::BallBar, Group::Term(TermGroup::EncoderHarmonics), Unit::Radian).of_run(),
        at |geometry| geometry.encoder_waves.get_mut(joint).map(|waves| waves.amplitude_mut(order, phase));

    /// What is added to a bar encoder's angle after its counter lost its origin during the run, beside `btheta`: `boffset1_2`
    /// (encoder 2 after the first loss).
    EncoderOffset {
        /// Which origin, from 1: 0 is that of `btheta`.
        origin: usize = 1..=ParameterId::LAST_ORIGIN,
        /// Joint.
        joint: usize = 0..BAR_JOINTS,
    }
        called format_args!("boffset{origin}_{}", joint + 1),
        is ParameterBlock::new(Owner::BallBar, Group::Placement, Unit::Radian).of_run().on_request(),
        at |geometry| geometry.offset_of_origin_mut(origin, joint);

    /// How much longer the bar is for each newton along it: `bcompliance`.
    BarCompliance
        called "bcompliance",
        is ParameterBlock::new(Owner::BallBar, Group::Force, Unit::MetrePerNewton),
        at |geometry| Some(&mut geometry.elongation.compliance_m_per_n);

    /// How much longer it is on one side of its play than in the middle, by the sign of the force: `bplay`.
    BarPlay
        called "bplay",
        is ParameterBlock::new(Owner::BallBar, Group::Force, Unit::Metre),
        at |geometry| Some(&mut geometry.elongation.play_m);

    /// How much longer the bar is in some directions, a whole number of times per turn of its first two joints: `bdsin2_1`
    /// (sine of twice joint 1's reading) .. `bdcos3_2`.
    BarWave {
        /// Joint.
        joint: usize = 0..DIRECTION_JOINTS,
        /// Waves per turn.
        order: u8 = Waves::OF_LENGTH,
        /// Sine or cosine.
        phase: Phase = Phase::ALL,
    }
        called format_args!("bd{phase}{order}_{}", joint + 1),
        is ParameterBlock::new(Owner::BallBar, Group::Term(TermGroup::BarLength), Unit::Metre).of_run(),
        at |geometry| geometry.bar_waves.get_mut(joint).map(|waves| waves.amplitude_mut(order, phase));

    /// Where a wire or telescoping bar is attached, in the flange frame: `attachment_x` ..., in the second place `attachment2_x`
    Attachment {
        /// Place on the flange.
        target: usize = 0..ParameterId::SET_UPS_MAX,
        /// Which coordinate.
        axis: Axis = Axis::ALL,
    }
        called format_args!("attachment{}_{}", further(target), axis.letter()),
        is ParameterBlock::new(Owner::Wire, Group::Placement, Unit::Metre),
        at |geometry| geometry.wire.attachments_m.get_mut(target)?.get_mut(axis.index());

    /// Where it is anchored, in the robot's base: `anchor_x` ..., in the second place `anchor2_x`
    Anchor {
        /// Place in the cell.
        station: usize = 0..ParameterId::SET_UPS_MAX,
        /// Which coordinate.
        axis: Axis = Axis::ALL,
    }
        called format_args!("anchor{}_{}", further(station), axis.letter()),
        is ParameterBlock::new(Owner::Wire, Group::Placement, Unit::Metre),
        at |geometry| geometry.wire.anchors_m.get_mut(station)?.get_mut(axis.index());

    /// Added to the distance to give the measured length.
    LengthOffset
        called "length_offset",
        is ParameterBlock::new(Owner::Wire, Group::Placement, Unit::Metre),
        at |geometry| Some(&mut geometry.wire.offset_m);

    /// Where a tracker stands, in the robot's base: `tracker_x` .. `tracker_rz`, in its second station `tracker2_x` ...
    Tracker {
        /// Station.
        station: usize = 0..ParameterId::SET_UPS_MAX,
        /// Which of its numbers.
        coordinate: Coordinate = Coordinate::ALL,
    }
        called format_args!("tracker{}_{coordinate}", further(station)),
        is ParameterBlock::placed(Owner::Tracker, coordinate),
        at |geometry| Some(geometry.tracker.places.get_mut(station)?.coordinate_mut(coordinate));

    /// Where what the tracker sees is, in the flange frame: `probe_x` .. `probe_rz`, the second target `probe2_x` ...
    Probe {
        /// Target.
        target: usize = 0..ParameterId::SET_UPS_MAX,
        /// Which of its numbers.
        coordinate: Coordinate = Coordinate::ALL,
    }
        called format_args!("probe{}_{coordinate}", further(target)),
        is ParameterBlock::placed(Owner::Tracker, coordinate),
        at |geometry| Some(geometry.tracker.probes.get_mut(target)?.coordinate_mut(coordinate));

    /// Centre of a ball that is seated in sockets, in the flange frame: `ball_x` ...
    Ball {
        /// Which coordinate.
        axis: Axis = Axis::ALL,
    }
        called format_args!("ball_{}", axis.letter()),
        is ParameterBlock::new(Owner::Contact, Group::Placement, Unit::Metre),
        at |geometry| geometry.contact.ball_m.get_mut(axis.index());

    /// Where the ball's centre is when it is seated in a socket, in the robot's base: `socket1_x` ...
    Socket {
        /// Socket.
        socket: usize = 0..ParameterId::SOCKETS_MAX,
        /// Which coordinate.
        axis: Axis = Axis::ALL,
    }
        called format_args!("socket{}_{}", socket + 1, axis.letter()),
        is ParameterBlock::new(Owner::Contact, Group::Placement, Unit::Metre),
        at |geometry| geometry.contact.sockets_m.get_mut(socket)?.get_mut(axis.index());

    /// Centre of a tip that touches faces, in the flange frame: `tip_x` ...
    Tip {
        /// Which coordinate.
        axis: Axis = Axis::ALL,
    }
        called format_args!("tip_{}", axis.letter()),
        is ParameterBlock::new(Owner::Touch, Group::Placement, Unit::Metre),
        at |geometry| geometry.touch.tip_m.get_mut(axis.index());

    /// Where that centre is when it touches a face, `n.x = d` in the robot's base: `face1_nx`, `face1_ny`, `face1_nz`, `face1_d`
    Face {
        /// Number of the face, from 0.
        face: usize = 0..ParameterId::SET_UPS_MAX,
        /// Which of its numbers.
        number: FaceNumber = FaceNumber::ALL,
    }
        called format_args!("face{}_{number}", face + 1),
        is ParameterBlock::new(Owner::Touch, Group::Placement, number.unit()),
        at |geometry| {
            let face = geometry.touch.faces.get_mut(face)?;
            Some(match number {
                FaceNumber::Normal(axis) => &mut face.normal[axis.index()],
                FaceNumber::Distance => &mut face.distance_m,
            })
        };

    /// Robot clock minus bar clock at the reference time.
    ClockShift
        called "clock_shift",
        is ParameterBlock::new(Owner::Clocks, Group::Clock, Unit::Second),
        at |geometry| Some(&mut geometry.clock.shift_s);

    /// How much faster the robot's clock runs.
    ClockSkew
        called "clock_skew",
        is ParameterBlock::new(Owner::Clocks, Group::Clock, Unit::Ratio),
        at |geometry| Some(&mut geometry.clock.skew);
}

impl ParameterId {
    /// Sockets that have parameters.
    pub const SOCKETS_MAX: usize = 99;
    /// Stations of a tracker, anchors of a wire, targets on a flange and faces, that have parameters.
    pub const SET_UPS_MAX: usize = 99;
    /// Origins of counters that have parameters of their own: a run that loses more keeps what the preparation found.
    pub const LAST_ORIGIN: usize = 99;
    /// Length of the ball-bar: `bd3`.
    pub const ROD: Self = Self::Bar { link: ROD_LINK, parameter: LinkParameter::D };

    /// Offset plate between the last of `axes` axes of the robot and axis 5 of the ball-bar: `ra6` of six.
    pub const fn plate(axes: usize) -> Self {
        Self::Robot { link: axes.saturating_sub(1), parameter: LinkParameter::A }
    }

    /// Lengths of the bar that are measured separately, each with its own uncertainty.
    pub const fn known_lengths(axes: usize) -> [Self; 2] {
        [Self::plate(axes), Self::ROD]
    }

    /// What it belongs to.
    pub const fn owner(self) -> Owner {
        self.block().owner
    }

    /// What kind of number it is.
    pub const fn group(self) -> Group {
        self.block().group
    }

    /// The kind of error that it is a part of; none for geometry and clocks.
    pub const fn term(self) -> Option<TermGroup> {
        match self.group() {
            Group::Term(group) => Some(group),
            _ => None,
        }
    }

    /// SI unit and display unit.
    pub const fn unit(self) -> Unit {
        self.block().unit
    }

    /// The link of the ball-bar that the parameter belongs to, from 0.
    pub const fn bar_link(self) -> Option<usize> {
        match self {
            Self::Bar { link, .. } => Some(link),
            Self::BarCompliance | Self::BarPlay | Self::BarWave { .. } => Some(ROD_LINK),
            _ => None,
        }
    }

    /// It changes what an instrument measures, as far as its owner says: the robot's, the clocks' and the instrument's own.
    pub fn affects(self, instrument: Owner) -> bool {
        let owner = self.owner();
        owner == instrument || matches!(owner, Owner::Robot | Owner::Clocks)
    }

    /// All parameters of a kind of error.
    pub fn of_term(group: TermGroup) -> impl Iterator<Item = Self> {
        Self::all().filter(move |id| id.term() == Some(group))
    }

    /// Waves of all robot axes, whether a robot has them or not, up to `last` per turn.
    pub fn joint_waves(last: u8) -> impl Iterator<Item = Self> {
        Self::of_term(TermGroup::LineSpectrum)
            .filter(move |id| matches!(id, Self::JointWave { order, .. } if *order <= last))
    }
}

fn of_link(link: &mut DhLink, parameter: LinkParameter) -> &mut f64 {
    match parameter {
        LinkParameter::A => &mut link.a_m,
        LinkParameter::D => &mut link.d_m,
        LinkParameter::Alpha => &mut link.alpha_rad,
        LinkParameter::Theta => &mut link.theta_rad,
        LinkParameter::Beta => &mut link.beta_rad,
    }
}

/// The number of a station or target in names, from 1; the first has none.
pub fn further(number: usize) -> String {
    if number == 0 { String::new() } else { (number + 1).to_string() }
}

impl fmt::Display for ParameterId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.name())
    }
}

impl FromStr for ParameterId {
    type Err = ModelError;

    fn from_str(name: &str) -> Result<Self, ModelError> {
        static NAMED: LazyLock<HashMap<String, ParameterId>> =
            LazyLock::new(|| ParameterId::all().map(|id| (id.name(), id)).collect());
        NAMED.get(name).copied().ok_or_else(|| {
            let known: Vec<String> = Self::all().map(Self::name).collect();
            let nearest = shared::config::nearest(name, known.iter().map(String::as_str));
            ModelError::UnknownName { name: name.to_owned(), nearest: nearest.map(str::to_owned) }
        })
    }
}
