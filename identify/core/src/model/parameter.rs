//! All parameters of robot and instruments. [`ParameterId`] identifies a parameter, converts it to and from its name in
//! files and reports, and finds its number in a [`Geometry`].
//!
//! The macro `parameters!` below contains a table in which each row defines a block of parameters. A row contains the
//! indices of the block's parameters with their ranges, the names, the common properties (owner, group, unit), and an
//! expression for the number in the geometry. The macro creates a variant of [`ParameterId`] from each row. A new term or
//! instrument needs a new row here, and its twist where residuals are computed ([`crate::cost`]).

use std::collections::HashMap;
use std::fmt;
use std::str::FromStr;
use std::sync::LazyLock;

use nalgebra::Vector3;
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::geometry::DIRECTION_JOINTS;
use super::{Coordinate, Geometry, JointTerm, ModelError, Phase, TermGroup, Waves};
use crate::kinematics::{AXES_MAX, BAR_JOINTS, LinkParameter, ROD_LINK};

/// A coordinate axis of the root frame or of the flange.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Axis {
    /// The first axis, `x`.
    X,
    /// The second axis, `y`.
    Y,
    /// The third axis, `z`.
    Z,
}

impl Axis {
    /// All axes in the order x, y, z.
    pub const ALL: [Self; 3] = [Self::X, Self::Y, Self::Z];

    /// Index of the axis, 0 to 2.
    pub const fn index(self) -> usize {
        self as usize
    }

    /// Unit vector along the axis.
    pub fn unit(self) -> Vector3<f64> {
        Vector3::ith(self.index(), 1.0)
    }

    pub(super) const fn letter(self) -> char {
        match self {
            Self::X => 'x',
            Self::Y => 'y',
            Self::Z => 'z',
        }
    }
}

/// One of the four parameters of a face.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum FaceNumber {
    /// Component of the normal: `nx`, `ny`, `nz`. The largest component is fixed at one.
    Normal(Axis),
    /// Distance of the plane from the origin: `d`.
    Distance,
}

impl FaceNumber {
    /// All four parameters of a face.
    pub const ALL: [Self; 4] =
        [Self::Normal(Axis::X), Self::Normal(Axis::Y), Self::Normal(Axis::Z), Self::Distance];

    /// Index in [`Self::ALL`], 0 to 3.
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

/// The component of the set-up to which a parameter belongs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Owner {
    /// The robot: its links and joint errors.
    Robot,
    /// The clocks of the two logs.
    Clocks,
    /// The ball-bar, its base or its encoders.
    BallBar,
    /// A draw-wire or telescoping bar.
    Wire,
    /// A tracker or its probe.
    Tracker,
    /// The scale of a tracker or a wire.
    Scale,
    /// A ball and its sockets.
    Contact,
    /// A probe tip and the faces that it touches.
    Touch,
}

/// Type of a parameter. It determines the prior knowledge about the parameter.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Group {
    /// Manufactured dimension of a link. The prior is the tolerance of the dimension.
    Link,
    /// Alternative parametrisation that replaces another parameter. It is estimated only if it is selected by name.
    InPlaceOfAnother,
    /// Location, mounting or counter origin, without prior.
    Placement,
    /// Relative error of an instrument's lengths. The prior is the specified uncertainty of the instrument.
    Scale,
    /// Shift or skew of a clock.
    Clock,
    /// Response to an axial force.
    Force,
    /// Amplitude of an optional error term.
    Term(TermGroup),
}

/// SI unit of a parameter, and the unit in which the parameter is displayed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unit {
    /// Metres, displayed in mm.
    Metre,
    /// Radians, displayed in mrad.
    Radian,
    /// Seconds, displayed in ms.
    Second,
    /// Ratio, displayed in ppm.
    Ratio,
    /// Deflection of an axis per metre of its load's lever arm \[rad/m\], displayed in mrad/m. It is the
    /// compliance \[rad/(N m)\] times the weight \[N\].
    RadianPerMetre,
    /// Metres per newton, displayed in um/N.
    MetrePerNewton,
}

impl Unit {
    /// Symbol of the SI unit, symbol of the displayed unit, and the factor from the SI unit to the displayed unit.
    const fn symbols(self) -> (&'static str, &'static str, f64) {
        match self {
            Self::Metre => ("m", "mm", 1e3),
            Self::Radian => ("rad", "mrad", 1e3),
            Self::Second => ("s", "ms", 1e3),
            Self::Ratio => ("1", "ppm", 1e6),
            Self::RadianPerMetre => ("rad/m", "mrad/m", 1e3),
            Self::MetrePerNewton => ("m/N", "um/N", 1e6),
        }
    }

    /// Factor from the SI unit to the displayed unit.
    pub const fn display_factor(self) -> f64 {
        self.symbols().2
    }

    /// Symbol of the displayed unit.
    pub const fn display_symbol(self) -> &'static str {
        self.symbols().1
    }

    /// A magnitude with its displayed unit, rounded to four significant digits.
    pub fn display(self, si: f64) -> String {
        let displayed = si * self.display_factor();
        // Parsing the rounded text removes trailing zeros.
        let rounded = format!("{displayed:.3e}").parse().unwrap_or(displayed);
        format!("{rounded} {}", self.display_symbol())
    }

    /// Symbol of the SI unit, `1` for ratios.
    pub const fn si_symbol(self) -> &'static str {
        self.symbols().0
    }
}

/// The properties that all parameters of a block have in common.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ParameterBlock {
    /// The component of the set-up to which the parameters belong.
    pub owner: Owner,
    /// Type of the parameters, which determines the prior knowledge.
    pub group: Group,
    /// SI unit and display unit.
    pub unit: Unit,
    /// Whether every run has a separate value, because of a new set-up or a new counter origin.
    pub of_run: bool,
    /// Whether a model contains the parameters only on request. If not, a model contains them whenever its geometry does.
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

/// Defines all parameters. Each row is a block with these entries: fields with their ranges, name, common properties,
/// and the expression for the number in `Geometry`.
macro_rules! parameters {
    ($(
        $(#[doc = $doc:literal])*
        $block:ident $({ $( $(#[$field_doc:meta])* $field:ident: $type:ty = $values:expr, )* })?
            called $name:expr,
            is $common:expr,
            at |$geometry:ident| $number:expr;
    )*) => {
        /// Identifier of a parameter, in the order of reports. Links, axes and other indices count from 0 in the identifier,
        /// and from 1 in the name.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub enum ParameterId {
            $( $(#[doc = $doc])* $block $({ $( $(#[$field_doc])* $field: $type, )* })?, )*
        }

        impl ParameterId {
            fn name(self) -> String {
                match self { $( Self::$block { $($($field),*)? } => $name.to_string(), )* }
            }

            /// Description of the parameter's block: the doc comment of the block's row in the table of parameters.
            pub fn meaning(self) -> &'static str {
                match self { $( Self::$block { .. } => concat!($($doc),*).trim_ascii(), )* }
            }

            /// The properties that all parameters of the block have in common.
            #[allow(unused_variables, reason = "most blocks have all in common")]
            pub const fn block(self) -> ParameterBlock {
                match self { $( Self::$block { $($($field),*)? } => $common, )* }
            }

            /// All parameters that have a name.
            pub fn all() -> impl Iterator<Item = Self> {
                // The list is created only once, because it has thousands of entries and each new model iterates over it.
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
            /// The number in the geometry that belongs to a parameter. `None` if the link, joint or station does not exist.
            pub fn parameter_mut(&mut self, id: ParameterId) -> Option<&mut f64> {
                match id { $( ParameterId::$block { $($($field),*)? } => { let $geometry = self; $number } )* }
            }
        }
    };
    // Appends all parameters of a block to the list. Each field of the block becomes a loop; the last field is the innermost
    // loop.
    (each $all:ident $block:ident [$($field:ident)*]) => { $all.push(Self::$block { $($field),* }) };
    (each $all:ident $block:ident [$($done:ident)*] $field:ident = $values:expr; $($rest:tt)*) => {
        for $field in $values { parameters!(each $all $block [$($done)* $field] $($rest)*); }
    };
}

parameters! {
    /// Denavit-Hartenberg parameter of a robot link, such as `ra1`, `rd1`, `ralpha1`, `rtheta1` or `rbeta2`.
    Robot {
        /// Index of the link, from 0.
        link: usize = 0..AXES_MAX,
        /// DH parameter of the link.
        parameter: LinkParameter = LinkParameter::ALL,
    }
        called format!("r{}{}", parameter.name(), link + 1),
        is ParameterBlock::of_link(Owner::Robot, parameter),
        at |geometry| geometry.robot.links.get_mut(link).map(|link| link.number_mut(parameter));

    /// Error of a robot axis in addition to its link parameters, such as `rsin1_1` (sine of drive 1's angle) or `rtool_5`.
    Joint {
        /// Index of the axis, from 0.
        axis: usize = 0..AXES_MAX,
        /// Error term of the axis.
        term: JointTerm = JointTerm::ALL,
    }
        called format_args!("r{term}_{}", axis + 1),
        is ParameterBlock::new(Owner::Robot, Group::Term(term.group()), term.unit()),
        at |geometry| geometry.joints.amplitude_mut(axis, term);

    /// Periodic error of a robot axis with three or more waves per turn, such as `rsin17_1` (sine of 17 times drive 1's angle).
    JointWave {
        /// Index of the axis, from 0.
        axis: usize = 0..AXES_MAX,
        /// Number of waves per turn.
        order: u8 = Waves::OF_AXIS,
        /// Sine or cosine component.
        phase: Phase = Phase::ALL,
    }
        called format_args!("r{phase}{order}_{}", axis + 1),
        is ParameterBlock::new(Owner::Robot, Group::Term(TermGroup::LineSpectrum), Unit::Radian).on_request(),
        at |geometry| if geometry.joints.drives.turns(axis) {
            geometry.axis_waves.get_mut(axis).map(|waves| waves.amplitude_mut(order, phase))
        } else {
            None
        };

    /// Denavit-Hartenberg parameter of a link of the ball-bar, such as `ba1`, `bd1`, `balpha1` or `btheta1`. `btheta` is
    /// the offset of the link's encoder.
    Bar {
        /// Index of the link, from 0.
        link: usize = 0..BAR_JOINTS,
        /// DH parameter of the link.
        parameter: LinkParameter = LinkParameter::STANDARD,
    }
        called format!("b{}{}", parameter.name(), link + 1),
        is match parameter {
            LinkParameter::Theta => {
                ParameterBlock::new(Owner::BallBar, Group::Placement, Unit::Radian).of_run()
            }
            _ => ParameterBlock::of_link(Owner::BallBar, parameter),
        },
        at |geometry| geometry.bar_links.get_mut(link).map(|link| link.number_mut(parameter));

    /// Position of the bar's base in the robot's base frame: `ox`, `oy`, `oz`.
    Base {
        /// Coordinate of the position.
        axis: Axis = Axis::ALL,
    }
        called format_args!("o{}", axis.letter()),
        is ParameterBlock::new(Owner::BallBar, Group::Placement, Unit::Metre).of_run(),
        at |geometry| geometry.base.origin_m.get_mut(axis.index());

    /// Rotation of the bar's base about x, then about y: `orx`, `ory`. A rotation about z would
    /// have the same effect as `btheta1`.
    BaseRotation {
        /// Axis of the rotation.
        axis: Axis = [Axis::X, Axis::Y],
    }
        called format_args!("or{}", axis.letter()),
        is ParameterBlock::new(Owner::BallBar, Group::Placement, Unit::Radian).of_run(),
        at |geometry| match axis {
            Axis::X => Some(&mut geometry.base.rx_rad),
            Axis::Y => Some(&mut geometry.base.ry_rad),
            Axis::Z => None,
        };

    /// Periodic error of a bar encoder, such as `bsin1_1` (sine of joint 1's reading) or `bcos2_5`.
    EncoderWave {
        /// Index of the joint, from 0.
        joint: usize = 0..BAR_JOINTS,
        /// Number of waves per turn.
        order: u8 = Waves::OF_ENCODER,
        /// Sine or cosine component.
        phase: Phase = Phase::ALL,
    }
        called format_args!("b{phase}{order}_{}", joint + 1),
        is ParameterBlock::new(Owner::BallBar, Group::Term(TermGroup::EncoderHarmonics), Unit::Radian).of_run(),
        at |geometry| geometry.encoder_waves.get_mut(joint).map(|waves| waves.amplitude_mut(order, phase));

    /// Offset of a bar encoder in addition to `btheta`, after the counter lost its origin during the run, such as
    /// `boffset1_2` (encoder 2 after the first loss).
    EncoderOffset {
        /// Index of the counter origin, from 1; origin 0 uses `btheta` alone.
        origin: usize = 1..=ParameterId::LAST_ORIGIN,
        /// Index of the joint, from 0.
        joint: usize = 0..BAR_JOINTS,
    }
        called format_args!("boffset{origin}_{}", joint + 1),
        is ParameterBlock::new(Owner::BallBar, Group::Placement, Unit::Radian).of_run().on_request(),
        at |geometry| geometry.offset_of_origin_mut(origin, joint);

    /// Elongation of the bar per newton of axial force: `bcompliance`.
    BarCompliance
        called "bcompliance",
        is ParameterBlock::new(Owner::BallBar, Group::Force, Unit::MetrePerNewton),
        at |geometry| Some(&mut geometry.elongation.compliance_m_per_n);

    /// Half of the bar's axial play: the bar is longer by `bplay` under tension, and shorter under compression.
    BarPlay
        called "bplay",
        is ParameterBlock::new(Owner::BallBar, Group::Force, Unit::Metre),
        at |geometry| Some(&mut geometry.elongation.play_m);

    /// Periodic elongation of the bar with the angle of one of its first two joints, such as `bdsin2_1` (sine of twice
    /// joint 1's reading) or `bdcos3_2`.
    BarWave {
        /// Index of the joint, from 0.
        joint: usize = 0..DIRECTION_JOINTS,
        /// Number of waves per turn.
        order: u8 = Waves::OF_LENGTH,
        /// Sine or cosine component.
        phase: Phase = Phase::ALL,
    }
        called format_args!("bd{phase}{order}_{}", joint + 1),
        is ParameterBlock::new(Owner::BallBar, Group::Term(TermGroup::BarLength), Unit::Metre).of_run(),
        at |geometry| geometry.bar_waves.get_mut(joint).map(|waves| waves.amplitude_mut(order, phase));

    /// Attachment point of a wire or telescoping bar in the flange frame: `attachment_x` ... A second
    /// attachment point has `attachment2_x` ...
    Attachment {
        /// Index of the attachment point on the flange, from 0.
        target: usize = 0..ParameterId::SET_UPS_MAX,
        /// Coordinate of the point.
        axis: Axis = Axis::ALL,
    }
        called format_args!("attachment{}_{}", further(target), axis.letter()),
        is ParameterBlock::new(Owner::Wire, Group::Placement, Unit::Metre),
        at |geometry| geometry.wire.attachments_m.get_mut(target)?.get_mut(axis.index());

    /// Anchor point of the wire in the robot's base frame: `anchor_x` ... A second anchor point has `anchor2_x` ...
    Anchor {
        /// Index of the anchor point in the cell, from 0.
        station: usize = 0..ParameterId::SET_UPS_MAX,
        /// Coordinate of the point.
        axis: Axis = Axis::ALL,
    }
        called format_args!("anchor{}_{}", further(station), axis.letter()),
        is ParameterBlock::new(Owner::Wire, Group::Placement, Unit::Metre),
        at |geometry| geometry.wire.anchors_m.get_mut(station)?.get_mut(axis.index());

    /// Measured length minus the distance between anchor and attachment point: `length_offset`.
    LengthOffset
        called "length_offset",
        is ParameterBlock::new(Owner::Wire, Group::Placement, Unit::Metre),
        at |geometry| Some(&mut geometry.wire.offset_m);

    /// Pose of a tracker in the robot's base frame: `tracker_x` .. `tracker_rz`. The rotation is a rotation vector (axis times
    /// angle). A second station of the tracker has `tracker2_x` ...
    Tracker {
        /// Index of the station, from 0.
        station: usize = 0..ParameterId::SET_UPS_MAX,
        /// Coordinate of the pose.
        coordinate: Coordinate = Coordinate::ALL,
    }
        called format_args!("tracker{}_{coordinate}", further(station)),
        is ParameterBlock::placed(Owner::Tracker, coordinate),
        at |geometry| Some(geometry.tracker.places.get_mut(station)?.coordinate_mut(coordinate));

    /// Pose of the tracker's target in the flange frame: `probe_x` .. `probe_rz`. The rotation is a rotation vector (axis times
    /// angle). A second target has `probe2_x` ...
    Probe {
        /// Index of the target, from 0.
        target: usize = 0..ParameterId::SET_UPS_MAX,
        /// Coordinate of the pose.
        coordinate: Coordinate = Coordinate::ALL,
    }
        called format_args!("probe{}_{coordinate}", further(target)),
        is ParameterBlock::placed(Owner::Tracker, coordinate),
        at |geometry| Some(geometry.tracker.probes.get_mut(target)?.coordinate_mut(coordinate));

    /// Relative error of the lengths of a wire, or of the positions of a tracker about the origin of its frame: measured =
    /// (1 + `scale`) * true. It is positive if the instrument reads too long.
    Scale
        called "scale",
        is ParameterBlock::new(Owner::Scale, Group::Scale, Unit::Ratio),
        at |geometry| Some(&mut geometry.scale);

    /// Centre of the ball in the flange frame: `ball_x` ...
    Ball {
        /// Coordinate of the centre.
        axis: Axis = Axis::ALL,
    }
        called format_args!("ball_{}", axis.letter()),
        is ParameterBlock::new(Owner::Contact, Group::Placement, Unit::Metre),
        at |geometry| geometry.contact.ball_m.get_mut(axis.index());

    /// Position of the ball's centre in the robot's base frame when the ball is seated in a socket: `socket1_x` ...
    Socket {
        /// Index of the socket, from 0.
        socket: usize = 0..ParameterId::SOCKETS_MAX,
        /// Coordinate of the position.
        axis: Axis = Axis::ALL,
    }
        called format_args!("socket{}_{}", socket + 1, axis.letter()),
        is ParameterBlock::new(Owner::Contact, Group::Placement, Unit::Metre),
        at |geometry| geometry.contact.sockets_m.get_mut(socket)?.get_mut(axis.index());

    /// Centre of the tip's ball in the flange frame: `tip_x` ...
    Tip {
        /// Coordinate of the centre.
        axis: Axis = Axis::ALL,
    }
        called format_args!("tip_{}", axis.letter()),
        is ParameterBlock::new(Owner::Touch, Group::Placement, Unit::Metre),
        at |geometry| geometry.touch.tip_m.get_mut(axis.index());

    /// Plane in which the tip's centre lies while the tip touches a face, `n.x = d` in the robot's base frame: `face1_nx`,
    /// `face1_ny`, `face1_nz`, `face1_d`.
    Face {
        /// Index of the face, from 0.
        face: usize = 0..ParameterId::SET_UPS_MAX,
        /// Component of the normal, or the distance.
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

    /// Robot clock minus bar clock at the reference time, relative to the first estimate. `clocks[]` has the sum of both.
    ClockShift
        called "clock_shift",
        is ParameterBlock::new(Owner::Clocks, Group::Clock, Unit::Second),
        at |geometry| Some(&mut geometry.clock.shift_s);

    /// Rate of the robot's clock relative to the bar's clock, minus one.
    ClockSkew
        called "clock_skew",
        is ParameterBlock::new(Owner::Clocks, Group::Clock, Unit::Ratio),
        at |geometry| Some(&mut geometry.clock.skew);
}

impl ParameterId {
    /// Number of sockets that have parameters.
    pub const SOCKETS_MAX: usize = 99;
    /// Number of tracker stations that have parameters, and likewise of wire anchors, flange targets and faces.
    pub const SET_UPS_MAX: usize = 99;
    /// Last counter origin that has parameters. If a run loses the origin more often, the preparation determines the
    /// later offsets, and the solve does not change them.
    pub const LAST_ORIGIN: usize = 99;
    /// Length of the ball-bar: `bd3`.
    pub const ROD: Self = Self::Bar { link: ROD_LINK, parameter: LinkParameter::D };

    /// Length of the offset plate between the last of the robot's `axes` axes and axis 5 of the ball-bar. It is
    /// `ra6` for six axes.
    pub const fn plate(axes: usize) -> Self {
        Self::Robot { link: axes.saturating_sub(1), parameter: LinkParameter::A }
    }

    /// Lengths of the bar that are measured separately. Each has its own uncertainty.
    pub const fn known_lengths(axes: usize) -> [Self; 2] {
        [Self::plate(axes), Self::ROD]
    }

    /// The component of the set-up to which the parameter belongs.
    pub const fn owner(self) -> Owner {
        self.block().owner
    }

    /// Type of the parameter, which determines the prior knowledge.
    pub const fn group(self) -> Group {
        self.block().group
    }

    /// The group of the error term. `None` for geometry and clocks.
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

    /// Index (from 0) of the ball-bar's link to which the parameter belongs. `None` if it belongs to no link.
    pub const fn bar_link(self) -> Option<usize> {
        match self {
            Self::Bar { link, .. } => Some(link),
            Self::BarCompliance | Self::BarPlay | Self::BarWave { .. } => Some(ROD_LINK),
            _ => None,
        }
    }

    /// Whether the parameter belongs to this instrument. For trackers and wires this includes the scale.
    pub fn is_of(self, instrument: Owner) -> bool {
        let has_scale = matches!(instrument, Owner::Tracker | Owner::Wire);
        self.owner() == instrument || self == Self::Scale && has_scale
    }

    /// Whether the parameter can affect this instrument's measurements, because it belongs to the robot, the
    /// clocks or the instrument.
    pub fn affects(self, instrument: Owner) -> bool {
        self.is_of(instrument) || matches!(self.owner(), Owner::Robot | Owner::Clocks)
    }

    /// Index (from 0) of the robot's axis or the bar's joint whose error the term describes. `None` for geometry and clocks.
    pub const fn axis(self) -> Option<usize> {
        match self {
            Self::Joint { axis, .. } | Self::JointWave { axis, .. } => Some(axis),
            Self::EncoderWave { joint, .. } | Self::BarWave { joint, .. } => Some(joint),
            _ => None,
        }
    }

    /// All parameters of a group of error terms.
    pub fn of_term(group: TermGroup) -> impl Iterator<Item = Self> {
        Self::all().filter(move |id| id.term() == Some(group))
    }

    /// Waves of all robot axes up to order `last`, including axes that a robot may not have.
    pub fn joint_waves(last: u8) -> impl Iterator<Item = Self> {
        Self::of_term(TermGroup::LineSpectrum)
            .filter(move |id| matches!(id, Self::JointWave { order, .. } if *order <= last))
    }
}

/// A column of a solution: a parameter, and the data set to which its value belongs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Column {
    /// Parameter whose value is in the column.
    pub id: ParameterId,
    /// Index of the data set, from 0. It is 0 for a parameter that the data sets share.
    pub data_set: usize,
}

/// The name of the parameter. For data sets after the first, the number of the data set follows: `ox@2`.
impl fmt::Display for Column {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.data_set {
            0 => write!(f, "{}", self.id),
            later => write!(f, "{}@{}", self.id, later + 1),
        }
    }
}

/// Suffix of a station or target in names: its number, counted from 1. It is empty for the first one.
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

impl Serialize for ParameterId {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for ParameterId {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        String::deserialize(deserializer)?.parse().map_err(D::Error::custom)
    }
}
