//! Measurement models: each file predicts one measurement `z = h(x) + noise`, with the blocks of its Jacobian, its
//! noise, how that noise is learnt, and what a series of refusals means.
//!
//! A new sensor is a file here that implements [`Aid`], a variant of [`FusionSource`], and an arm in `sources.rs`.
//! `jacobians.rs` holds every Jacobian against finite differences.

pub(crate) mod compass;
pub(crate) mod disc;
pub(crate) mod feature;
pub(crate) mod gnss;
pub(crate) mod gps_position;
pub(crate) mod gps_velocity;
pub(crate) mod heading;
pub(crate) mod pixel;
pub(crate) mod rate;
pub(crate) mod specific_force;
pub(crate) mod tag;
pub(crate) mod tilt;

use windhover_base::msg::{Disposition, FusionSource};

use super::core::Core;
use super::measurement::Measurement;
use super::models::Models;
use super::state::State;
use super::update::Outcome;

/// A measured value with its model.
pub(crate) trait Aid {
    /// What it is counted and reported as.
    const SOURCE: FusionSource;

    /// Writes innovation, Jacobian blocks and noise into `z`.
    ///
    /// # Errors
    /// Says why the measurement cannot be predicted at this state.
    fn linearise(&self, state: &State, models: &Models, z: &mut Measurement) -> Result<(), Disposition>;
}

impl Core {
    /// Fuses a measurement through the gate and reports it; `None` where it cannot be predicted.
    pub(crate) fn fuse_aid<A: Aid>(&mut self, aid: &A) -> Option<Outcome> {
        self.expect_aid(aid).then(|| self.fuse_gated(A::SOURCE))
    }

    /// Fuses, without gate or report, what a prior was just made from.
    pub(crate) fn fuse_aid_as_it_is<A: Aid>(&mut self, aid: &A) {
        if self.expect_aid(aid) {
            self.fuse(A::SOURCE, None);
        }
    }

    /// Writes a measurement into `self.z`; reports it if it cannot be predicted.
    pub(crate) fn expect_aid<A: Aid>(&mut self, aid: &A) -> bool {
        let expected = self.linearise(aid);
        if let Err(why) = expected {
            self.refuse(A::SOURCE, why);
        }
        expected.is_ok()
    }

    /// Writes a measurement into `self.z`.
    ///
    /// # Errors
    /// The reason why it cannot be predicted.
    pub(crate) fn linearise<A: Aid>(&mut self, aid: &A) -> Result<(), Disposition> {
        aid.linearise(&self.state, &self.models, &mut self.z)
    }
}

/// Refusals in a row after another measurement of this ratio to the gate.
fn counted(so_far: u32, ratio: f64) -> u32 {
    if ratio <= 1.0 { 0 } else { so_far + 1 }
}
