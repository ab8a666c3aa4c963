//! Which parameters are free, which are fixed, which have a prior; names to columns and back.

use nalgebra::Vector3;

use super::{Axis, DriveTrain, Geometry, JointErrors, Owner, ParameterId, Placement};
use crate::kinematics::{BAR_JOINTS, Chain, LinkParameter};
use crate::solver::Prior;

/// What the solve does with a parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Role {
    /// Found from the samples alone.
    Free,
    /// Stays at its value, which is exact or a matter of choice.
    Fixed,
    /// Stays at its value, which may be wrong: what is estimated beside it is less certain for that.
    Considered {
        /// Standard deviation, SI.
        sigma: f64,
    },
    /// Found from the samples and from what is known about it.
    Prior {
        /// Expected value, SI.
        value: f64,
        /// Standard deviation, SI.
        sigma: f64,
    },
}

impl Role {
    /// The solve finds its value.
    pub const fn is_estimated(self) -> bool {
        matches!(self, Self::Free | Self::Prior { .. })
    }
}

/// One parameter of a model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Parameter {
    /// Which.
    pub id: ParameterId,
    /// Data sheet or first guess: what reports compare with, SI.
    pub nominal: f64,
    /// Where the solve starts, or where the parameter stays if fixed, SI.
    pub value: f64,
    /// What the solve does with it.
    pub role: Role,
}

/// A parameter that does not exist or a prior that is none.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ModelError {
    /// No parameter has this name.
    #[error(
        "no parameter is called `{name}`; names are ra1 rd1 ralpha1 rtheta1 .. 6, rbeta1 .. 6, ba1 bd1 balpha1 \
         btheta1 .. 5, ox oy oz orx ory, bcompliance bplay, bdsin2_1 bdcos2_1 .. bdcos3_2, bsin1_1 bcos1_1 bsin2_1 bcos2_1 boffset1_1 .. 5, rsin1_1 rcos1_1 rsin2_1 rcos2_1 \
         rsinc_1 rcosc_1 rsinm_1 rcosm_1 rsinj1_2 rcosj1_2 rsinj2_2 rcosj2_2 rsin3_1 rcos3_1 .. rcos127_1 rbacklash_1 rratio_1 .. 6, relbow_2 rwrist_2 rwrist_3 rtool_2 rtool_3 rtool_5 (axes up to 8 where the robot has them), \
         clock_shift clock_skew, attachment_x anchor_x attachment2_x anchor2_x .. anchor99_z, length_offset, \
         tracker_x tracker_rx probe_x probe_rx .. z, tracker2_x probe2_x .. tracker99_rz probe99_rz, ball_x .. z, socket1_x .. socket99_z"
    )]
    UnknownName {
        /// As given.
        name: String,
    },
    /// The model does not have this parameter.
    #[error("this model has no parameter `{id}`; take it out of the selection")]
    NotInModel {
        /// Which.
        id: ParameterId,
    },
    /// A prior needs a finite value and a positive standard deviation.
    #[error("the prior of `{id}` is {value} +- {sigma}; give finite numbers and a sigma above zero")]
    BadPrior {
        /// Which.
        id: ParameterId,
        /// As given.
        value: f64,
        /// As given.
        sigma: f64,
    },
}

/// Parameters in blocks, their roles, and the geometry they describe.
///
/// A model starts with everything fixed at its nominal value; select, free or set priors from there.
#[derive(Debug, Clone, PartialEq)]
pub struct Model {
    structure: Geometry,
    parameters: Vec<Parameter>,
    /// Parameter of each column.
    columns: Vec<usize>,
}

fn robot_ids(robot: &Chain) -> impl Iterator<Item = ParameterId> + '_ {
    let standard = (0..robot.links.len()).flat_map(|link| {
        ParameterId::STANDARD.into_iter().map(move |parameter| ParameterId::Robot { link, parameter })
    });
    let hayati =
        (0..robot.links.len()).map(|link| ParameterId::Robot { link, parameter: LinkParameter::Beta });
    standard.chain(hayati)
}

impl Model {
    fn new(structure: Geometry, ids: impl IntoIterator<Item = ParameterId>) -> Self {
        let mut values = structure.clone();
        let parameters = ids
            .into_iter()
            .filter_map(|id| {
                let nominal = *values.parameter_mut(id)?;
                Some(Parameter { id, nominal, value: nominal, role: Role::Fixed })
            })
            .collect();
        Self { structure, parameters, columns: Vec::new() }
    }

    /// Robot and ball-bar: both sets of links, the bar's base (its nominal place is that of `bar`),
    /// how its length follows force and direction, the encoders' harmonics, terms of the robot's axes and the clocks.
    pub fn ball_bar(robot: &Chain, bar: &Chain) -> Self {
        let bar_ids = (0..bar.links.len()).flat_map(|link| {
            ParameterId::STANDARD.into_iter().map(move |parameter| ParameterId::Bar { link, parameter })
        });
        let ids = robot_ids(robot)
            .chain(bar_ids)
            .chain(Axis::ALL.map(ParameterId::Base))
            .chain([ParameterId::BaseRotation(Axis::X), ParameterId::BaseRotation(Axis::Y)])
            .chain(ParameterId::harmonics())
            .chain(ParameterId::joint_terms())
            .chain([ParameterId::ClockShift, ParameterId::ClockSkew])
            .chain(ParameterId::OF_FORCE)
            .chain(ParameterId::bar_waves());
        Self::new(Geometry::new(robot.clone(), Some(bar)), ids)
    }

    /// Robot and a wire or telescoping bar of measured length: attachment, anchor, offset, terms of the robot's axes and the
    /// clocks.
    pub fn measured_length(robot: &Chain) -> Self {
        Self::alone(robot).with_set_ups(Owner::Wire, [1, 1])
    }

    /// Robot and a tracker that follows a probe on its flange: where the tracker stands, how the probe is mounted, and
    /// the clocks.
    pub fn measured_pose(robot: &Chain) -> Self {
        Self::alone(robot).with_set_ups(Owner::Tracker, [1, 1])
    }

    /// A robot whose log has a clock.
    fn alone(robot: &Chain) -> Self {
        let ids = robot_ids(robot)
            .chain(ParameterId::joint_terms())
            .chain([ParameterId::ClockShift, ParameterId::ClockSkew]);
        Self::new(Geometry::new(robot.clone(), None), ids)
    }

    /// Robot and a ball on its flange that is seated in so many sockets: where the ball and the sockets are.
    pub fn contact(robot: &Chain, sockets: usize) -> Self {
        let mut structure = Geometry::new(robot.clone(), None);
        structure.contact.sockets_m = vec![Vector3::zeros(); sockets];
        let ids = robot_ids(robot).chain(ParameterId::contact(sockets)).chain(ParameterId::joint_terms());
        Self::new(structure, ids)
    }

    /// The same with drives other than [`DriveTrain::direct`]: terms that they can have join the parameters, fixed at zero.
    pub fn with_drives(self, drives: DriveTrain) -> Self {
        let ids: Vec<ParameterId> = self.parameters.iter().map(|parameter| parameter.id).collect();
        let at = ids.iter().position(|id| matches!(id, ParameterId::Joint { .. })).unwrap_or(ids.len());
        let (before, after) = ids.split_at(at);
        let others = after.iter().copied().filter(|id| !matches!(id, ParameterId::Joint { .. }));
        let all = before.iter().copied().chain(ParameterId::joint_terms()).chain(others);
        let structure = Geometry { joints: JointErrors::none(drives), ..self.structure };
        Self::new(structure, all)
    }

    /// The same with waves of the robot's axes ([`ParameterId::JointWave`]) among the parameters, fixed at zero, where it has
    /// such an axis; values and roles stay.
    #[must_use]
    pub fn with_joint_waves(mut self, waves: impl IntoIterator<Item = ParameterId>) -> Self {
        for id in waves {
            let known = self.structure.parameter_mut(id).is_some() && self.parameter(id).is_none();
            if matches!(id, ParameterId::JointWave { .. }) && known {
                self.parameters.push(Parameter { id, nominal: 0.0, value: 0.0, role: Role::Fixed });
            }
        }
        self
    }

    /// The same with so many stations and targets of a tracker, or anchors and attachments of a wire, all fixed at zero.
    #[must_use]
    pub fn with_set_ups(mut self, owner: Owner, [stations, targets]: [usize; 2]) -> Self {
        let Geometry { tracker, wire, .. } = &mut self.structure;
        let ids: Vec<ParameterId> = match owner {
            Owner::Tracker => {
                tracker.places.resize(stations, Placement::default());
                tracker.probes.resize(targets, Placement::default());
                ParameterId::tracker(stations, targets).collect()
            }
            Owner::Wire => {
                wire.anchors_m.resize(stations, Vector3::zeros());
                wire.attachments_m.resize(targets, Vector3::zeros());
                ParameterId::wire(stations, targets).collect()
            }
            _ => return self,
        };
        self.parameters.retain(|parameter| parameter.id.owner() != owner);
        let fixed = |id| Parameter { id, nominal: 0.0, value: 0.0, role: Role::Fixed };
        let links =
            self.parameters.iter().take_while(|one| matches!(one.id, ParameterId::Robot { .. })).count();
        self.parameters.splice(links..links, ids.into_iter().map(fixed));
        self.find_columns();
        self
    }

    /// The same with zeros of the bar's encoders after losses of the counters' origin, [`ParameterId::EncoderOffset`].
    #[must_use]
    pub fn with_encoder_offsets(mut self, zeros: impl IntoIterator<Item = ParameterId>) -> Self {
        for id in zeros {
            let ParameterId::EncoderOffset { origin, .. } = id else { continue };
            let known = &mut self.structure.origin_offsets_rad;
            known.resize(known.len().max(origin), [0.0; BAR_JOINTS]);
            self.parameters.push(Parameter { id, nominal: 0.0, value: 0.0, role: Role::Fixed });
        }
        self
    }

    /// Axes of the robot.
    pub fn axes(&self) -> usize {
        self.structure.robot.links.len()
    }

    /// All parameters in the order of their blocks.
    pub fn parameters(&self) -> &[Parameter] {
        &self.parameters
    }

    /// One parameter; none where the model does not have it.
    pub fn parameter(&self, id: ParameterId) -> Option<&Parameter> {
        self.parameters.iter().find(|parameter| parameter.id == id)
    }

    fn parameter_mut(&mut self, id: ParameterId) -> Result<&mut Parameter, ModelError> {
        let found = self.parameters.iter_mut().find(|parameter| parameter.id == id);
        found.ok_or(ModelError::NotInModel { id })
    }

    /// Sets where a parameter starts or stays.
    ///
    /// # Errors
    /// [`ModelError::NotInModel`].
    pub fn set_value(&mut self, id: ParameterId, value: f64) -> Result<(), ModelError> {
        self.parameter_mut(id)?.value = value;
        Ok(())
    }

    /// Sets what the solve does with a parameter.
    ///
    /// # Errors
    /// [`ModelError::NotInModel`], [`ModelError::BadPrior`].
    pub fn set_role(&mut self, id: ParameterId, role: Role) -> Result<(), ModelError> {
        let parameter = self.parameter_mut(id)?;
        let known = match role {
            Role::Free | Role::Fixed => None,
            Role::Prior { value, sigma } => Some((value, sigma)),
            Role::Considered { sigma } => Some((parameter.value, sigma)),
        };
        if let Some((value, sigma)) = known
            && !(value.is_finite() && sigma.is_finite() && sigma > 0.0)
        {
            return Err(ModelError::BadPrior { id, value, sigma });
        }
        parameter.role = role;
        self.find_columns();
        Ok(())
    }

    fn find_columns(&mut self) {
        let free = self.parameters.iter().enumerate().filter(|(_, one)| one.role.is_estimated());
        self.columns = free.map(|(index, _)| index).collect();
    }

    /// The same with another role for what is [`Role::Considered`] within a standard deviation, where `role` has one for it.
    #[must_use]
    pub fn with_considered(&self, role: impl Fn(&Parameter, f64) -> Option<Role>) -> Self {
        let mut model = self.clone();
        for parameter in &mut model.parameters {
            if let Role::Considered { sigma } = parameter.role {
                parameter.role = role(parameter, sigma).unwrap_or(parameter.role);
            }
        }
        model.find_columns();
        model
    }

    /// [`Model::set_role`] for several parameters at once.
    ///
    /// # Errors
    /// As [`Model::set_role`].
    pub fn set_roles(
        &mut self,
        ids: impl IntoIterator<Item = ParameterId>,
        role: Role,
    ) -> Result<(), ModelError> {
        ids.into_iter().try_for_each(|id| self.set_role(id, role))
    }

    /// The parameter of each column of the solve.
    pub fn columns(&self) -> impl ExactSizeIterator<Item = &Parameter> {
        self.columns.iter().map(|&index| &self.parameters[index])
    }

    /// The column of a parameter; none where it is fixed or absent.
    pub fn column_of(&self, id: ParameterId) -> Option<usize> {
        self.columns().position(|parameter| parameter.id == id)
    }

    /// Starting values of the columns.
    pub fn start(&self) -> Vec<f64> {
        self.columns().map(|parameter| parameter.value).collect()
    }

    /// Priors of the columns.
    pub fn priors(&self) -> Vec<Prior> {
        let prior = |(column, parameter): (usize, &Parameter)| match parameter.role {
            Role::Prior { value, sigma } => Some(Prior { column, value, sigma }),
            _ => None,
        };
        self.columns().enumerate().filter_map(prior).collect()
    }

    /// Geometry with the columns at `x` and everything else at its value; missing entries of `x` stay at theirs too.
    pub fn geometry(&self, x: &[f64]) -> Geometry {
        let mut geometry = self.structure.clone();
        for parameter in &self.parameters {
            if let Some(value) = geometry.parameter_mut(parameter.id) {
                *value = parameter.value;
            }
        }
        for (parameter, &x) in self.columns().zip(x) {
            if let Some(value) = geometry.parameter_mut(parameter.id) {
                *value = x;
            }
        }
        geometry
    }

    /// Takes a solution over as the values to start from.
    pub fn adopt(&mut self, x: &[f64]) {
        for (&index, &x) in self.columns.iter().zip(x) {
            self.parameters[index].value = x;
        }
    }
}
