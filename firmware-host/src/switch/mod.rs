//! Changing sensors: where the target lies in the other picture ([`homography`]), when to change
//! ([`policy`]), and whether a sensor's pictures can be used at all ([`health`]).

pub mod health;
pub mod homography;
pub mod policy;
pub mod scene;

pub use health::{Condition, HealthLimits, Watch};
pub use homography::{Homography, Pair, RegistrationError};
pub use policy::{Policy, Reason, SwitchPlan};
pub use scene::Scene;

#[cfg(test)]
mod tests;
