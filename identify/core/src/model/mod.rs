//! The quantities of a calibration: observations, named parameters with roles, and the geometry that the parameters
//! describe. [`Model`] is the only place that assigns parameters to columns of the solve.

mod geometry;
mod joint_errors;
mod joint_term;
mod observation;
mod parameter;
mod roles;
mod selection;
mod term_group;
mod tracker;
mod waves;

pub use geometry::{
    BarElongation, BasePlacement, ClockRelation, ContactGeometry, Face, Geometry, MovingJoints,
    TouchGeometry, WireGeometry,
};
pub use joint_errors::{BACKLASH_SPEED_RAD_S, DriveState, DriveTrain, JointErrors};
pub use joint_term::{JointTerm, Load, Period};
pub use observation::{BarForce, JointState, Observation, PerObservation, RobotMotion};
pub use parameter::{Axis, Column, FaceNumber, Group, Owner, ParameterBlock, ParameterId, Unit, further};
pub use roles::{Model, ModelError, Parameter, Role};
pub use selection::{Selection, thesis_fixed};
pub use term_group::TermGroup;
pub use tracker::{Coordinate, Placement, SetUp, TrackerGeometry};
pub use waves::{Phase, Waves};
