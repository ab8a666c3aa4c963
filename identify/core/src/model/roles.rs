//! [`Model`] contains the parameters of a calibration with their roles (free, fixed, considered, with prior). It assigns the
//! estimated parameters to columns of the solve, and creates a [`Geometry`] from the values of the columns.

use nalgebra::Vector3;

use super::{DriveTrain, Face, Geometry, Group, JointErrors, Owner, ParameterId, Placement};
use crate::kinematics::Chain;
use crate::solver::Prior;

/// How the solve treats a parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Role {
    /// Estimated from the samples, without prior.
    Free,
    /// Constant. The value is exact or arbitrary.
    Fixed,
    /// Constant, but uncertain. The uncertainty of the value adds to that of the estimated parameters.
    Considered {
        /// Standard deviation of the value, SI.
        sigma: f64,
    },
    /// Estimated from the samples and a prior.
    Prior {
        /// Expected value, SI.
        value: f64,
        /// Standard deviation of the prior, SI.
        sigma: f64,
    },
}

impl Role {
    /// Whether the solve estimates the value of the parameter.
    pub const fn is_estimated(self) -> bool {
        matches!(self, Self::Free | Self::Prior { .. })
    }
}

/// One parameter of a model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Parameter {
    /// Identifier of the parameter.
    pub id: ParameterId,
    /// Value from the data sheet or first estimate, SI. It is the reference in reports.
    pub nominal: f64,
    /// Start value of the solve, or the constant value if the parameter is not estimated, SI.
    pub value: f64,
    /// How the solve treats the parameter.
    pub role: Role,
}

/// A parameter is unknown, or a prior is invalid.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ModelError {
    /// No parameter has this name.
    #[error(
        "no parameter is called `{name}`; {} The page \"Parameters of the model\" of the documentation lists all \
         names",
        nearest.as_ref().map_or_else(
            || "names are such as `ra1`, `rtheta6` and `ox`.".to_owned(),
            |nearest| format!("did you mean `{nearest}`?")
        )
    )]
    UnknownName {
        /// The name as given.
        name: String,
        /// The most similar known name.
        nearest: Option<String>,
    },
    /// The model does not have this parameter.
    #[error("this model has no parameter `{id}`; remove it from the selection")]
    NotInModel {
        /// The parameter that is missing.
        id: ParameterId,
    },
    /// A prior needs a finite value and a positive standard deviation.
    #[error("the prior of `{id}` is {value} +- {sigma}; give finite numbers and a sigma above zero")]
    BadPrior {
        /// Parameter of the prior.
        id: ParameterId,
        /// Expected value as given, SI.
        value: f64,
        /// Standard deviation as given, SI.
        sigma: f64,
    },
}

/// A parameter fixed at its value in a geometry. `None` if the geometry does not contain the parameter.
fn fixed_parameter(structure: &mut Geometry, id: ParameterId) -> Option<Parameter> {
    let value = *structure.parameter_mut(id)?;
    Some(Parameter { id, nominal: value, value, role: Role::Fixed })
}

/// Parameters in blocks, their roles, and the geometry that they describe.
///
/// In a new model, all parameters are fixed at their nominal values. Call [`Model::select`], [`Model::free_only`] or
/// [`Model::set_role`] to change this.
#[derive(Debug, Clone, PartialEq)]
pub struct Model {
    /// Geometry with the right number of links, stations and so on. The values of `parameters` replace the
    /// numbers in this geometry.
    structure: Geometry,
    /// All parameters, in the order of their identifiers.
    parameters: Vec<Parameter>,
    /// For each column, the index of its parameter in `parameters`.
    columns: Vec<usize>,
}

impl Model {
    /// A model of a geometry, with the parameters that belong to these owners.
    fn new(structure: Geometry, owners: &[Owner]) -> Self {
        let mut model = Self { structure, parameters: Vec::new(), columns: Vec::new() };
        model.replace_parameters(|id| owners.contains(&id.owner()));
        model
    }

    /// Model of a robot and a ball-bar. Its parameters are the links of both, the bar's base (nominal position from `bar`),
    /// elongation by force and direction, encoder harmonics, error terms of the robot's axes, and the clocks.
    pub fn ball_bar(robot: &Chain, bar: &Chain) -> Self {
        let structure = Geometry::new(robot.clone(), Some(bar));
        Self::new(structure, &[Owner::Robot, Owner::Clocks, Owner::BallBar])
    }

    /// Model of a robot without instrument, with the clock of its log.
    pub fn alone(robot: &Chain) -> Self {
        Self::new(Geometry::new(robot.clone(), None), &[Owner::Robot, Owner::Clocks])
    }

    /// Replaces the parameters for which `wanted` is true by the parameters of the geometry, fixed at their values there.
    fn replace_parameters(&mut self, wanted: impl Fn(ParameterId) -> bool) {
        self.parameters.retain(|parameter| !wanted(parameter.id));
        for id in ParameterId::all().filter(|id| !id.block().on_request && wanted(*id)) {
            self.parameters.extend(fixed_parameter(&mut self.structure, id));
        }
        self.sort_parameters();
    }

    /// Sorts the parameters. If a parameter occurs twice, the first occurrence is kept, which is the older one.
    fn sort_parameters(&mut self) {
        self.parameters.sort_by_key(|parameter| parameter.id);
        self.parameters.dedup_by_key(|parameter| parameter.id);
        self.update_columns();
    }

    /// The model with other drives than [`DriveTrain::direct`]. Error terms that are possible with these drives are
    /// added, fixed at zero.
    #[must_use]
    pub fn with_drives(mut self, drives: DriveTrain) -> Self {
        self.structure.joints = JointErrors::none(drives);
        self.replace_parameters(|id| matches!(id, ParameterId::Joint { .. }));
        self
    }

    /// The model with additional parameters that are present only on request, fixed at zero. Parameters that are impossible
    /// for the robot or the bar are ignored. Values and roles of all other parameters stay unchanged.
    #[must_use]
    pub fn with(mut self, more: impl IntoIterator<Item = ParameterId>) -> Self {
        for id in more.into_iter().filter(|id| id.block().on_request) {
            self.parameters.extend(fixed_parameter(&mut self.structure, id));
        }
        self.sort_parameters();
        self
    }

    /// The model with a number of set-ups of an instrument, all fixed at zero. The two numbers are the stations and
    /// targets of a tracker, or the anchors and attachments of a wire. For sockets and faces only the first number
    /// is used, because there is only one ball or tip.
    #[must_use]
    pub fn with_set_ups(mut self, owner: Owner, [stations, targets]: [usize; 2]) -> Self {
        let Geometry { tracker, wire, contact, touch, .. } = &mut self.structure;
        match owner {
            Owner::Tracker => {
                tracker.places = vec![Placement::default(); stations];
                tracker.probes = vec![Placement::default(); targets];
            }
            Owner::Wire => {
                wire.anchors_m = vec![Vector3::zeros(); stations];
                wire.attachments_m = vec![Vector3::zeros(); targets];
            }
            Owner::Contact => contact.sockets_m = vec![Vector3::zeros(); stations],
            Owner::Touch => touch.faces = vec![Face::default(); stations],
            _ => return self,
        }
        self.replace_parameters(|id| id.is_of(owner));
        self
    }

    /// The model without clock parameters, for measurements without time stamps.
    #[must_use]
    pub fn without_clocks(mut self) -> Self {
        self.parameters.retain(|parameter| parameter.id.group() != Group::Clock);
        self.update_columns();
        self
    }

    /// Chain of the robot. Only the number and types of links, the base and the end are valid. For a chain with the
    /// values of the parameters, use [`Self::geometry`].
    pub fn robot(&self) -> &Chain {
        &self.structure.robot
    }

    /// Number of axes of the robot.
    pub fn axes(&self) -> usize {
        self.structure.robot.links.len()
    }

    /// All parameters in the order of their identifiers.
    pub fn parameters(&self) -> &[Parameter] {
        &self.parameters
    }

    /// Identifiers of all parameters, in the order of [`Self::parameters`].
    pub fn ids(&self) -> Vec<ParameterId> {
        self.parameters.iter().map(|parameter| parameter.id).collect()
    }

    /// A parameter by its identifier. `None` if the model does not contain it.
    pub fn parameter(&self, id: ParameterId) -> Option<&Parameter> {
        self.parameters.get(self.index_of(id)?)
    }

    /// Role of a parameter. `None` if the model does not contain it.
    pub fn role(&self, id: ParameterId) -> Option<Role> {
        Some(self.parameter(id)?.role)
    }

    fn index_of(&self, id: ParameterId) -> Option<usize> {
        self.parameters.binary_search_by_key(&id, |parameter| parameter.id).ok()
    }

    fn parameter_mut(&mut self, id: ParameterId) -> Result<&mut Parameter, ModelError> {
        let index = self.index_of(id).ok_or(ModelError::NotInModel { id })?;
        Ok(&mut self.parameters[index])
    }

    /// Sets the start value or constant value of a parameter.
    ///
    /// # Errors
    /// [`ModelError::NotInModel`] if the model does not contain the parameter.
    pub fn set_value(&mut self, id: ParameterId, value: f64) -> Result<(), ModelError> {
        self.parameter_mut(id)?.value = value;
        Ok(())
    }

    /// Sets the parameters for which `is_reset` is true to their nominal values.
    pub fn reset_to_nominal(&mut self, is_reset: impl Fn(ParameterId) -> bool) {
        for parameter in self.parameters.iter_mut().filter(|parameter| is_reset(parameter.id)) {
            parameter.value = parameter.nominal;
        }
    }

    /// Sets the role of a parameter.
    ///
    /// # Errors
    /// [`ModelError::NotInModel`] if the model does not contain the parameter, [`ModelError::BadPrior`] if the standard
    /// deviation is invalid.
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
        self.update_columns();
        Ok(())
    }

    fn update_columns(&mut self) {
        let parameters = self.parameters.iter().enumerate();
        let estimated = parameters.filter(|(_, parameter)| parameter.role.is_estimated());
        self.columns = estimated.map(|(index, _)| index).collect();
    }

    /// The model with new roles for parameters that have the role [`Role::Considered`]. `role` receives such a parameter and
    /// its standard deviation, and returns the new role, or `None` for no change.
    #[must_use]
    pub fn with_considered(&self, role: impl Fn(&Parameter, f64) -> Option<Role>) -> Self {
        let mut model = self.clone();
        for parameter in &mut model.parameters {
            if let Role::Considered { sigma } = parameter.role {
                parameter.role = role(parameter, sigma).unwrap_or(parameter.role);
            }
        }
        model.update_columns();
        model
    }

    /// Sets the role of several parameters, see [`Model::set_role`].
    ///
    /// # Errors
    /// The errors of [`Model::set_role`].
    pub fn set_roles(
        &mut self,
        ids: impl IntoIterator<Item = ParameterId>,
        role: Role,
    ) -> Result<(), ModelError> {
        ids.into_iter().try_for_each(|id| self.set_role(id, role))
    }

    /// Frees some parameters and fixes all others.
    pub fn free_only(&mut self, is_free: impl Fn(ParameterId) -> bool) {
        for parameter in &mut self.parameters {
            parameter.role = if is_free(parameter.id) { Role::Free } else { Role::Fixed };
        }
        self.update_columns();
    }

    /// The parameter of each column of the solve.
    pub fn columns(&self) -> impl ExactSizeIterator<Item = &Parameter> {
        self.columns.iter().map(|&index| &self.parameters[index])
    }

    /// Column of a parameter. `None` if the parameter is not estimated or absent.
    pub fn column_of(&self, id: ParameterId) -> Option<usize> {
        self.columns.binary_search(&self.index_of(id)?).ok()
    }

    /// Start values of the columns.
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

    /// Geometry with the values `x` for the columns. If `x` is shorter than the list of columns, the remaining columns have
    /// the value in the model, as have all parameters that are not estimated.
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
        geometry.joints.drop_zeros();
        geometry
    }

    /// Uses a solution as new start values.
    pub fn adopt(&mut self, x: &[f64]) {
        for (&index, &x) in self.columns.iter().zip(x) {
            self.parameters[index].value = x;
        }
    }
}
