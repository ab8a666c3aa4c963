//! Costs of the ball-bar: what of the chain that it closes is compared, and what its angles are worth.

pub(in crate::cost) mod angle_noise;
pub(in crate::cost) mod closure;
pub(in crate::cost) mod fill_in;
pub(in crate::cost) mod length;
pub(in crate::cost) mod pose;
pub(in crate::cost) mod position;
pub(in crate::cost) mod position_angles;
pub(in crate::cost) mod transform;
