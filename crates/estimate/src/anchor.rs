//! A receiver that jumps for good: the whole scene is anchored anew, unless its bias explains the jump.
//!
//! What is seen of vehicles and ground says nothing of absolute position, so helicopter, targets and
//! features move together and keep all they know of each other; only where they lie is unknown again.

use nalgebra::{Vector2, Vector3};

use super::aid::gps_position::GpsPosition;
use super::blocks::{Block, own};
use super::core::Core;
use super::fit::{Fit, WATCHED_POSITION};
use super::matrix::Shear;
use super::start::ANYWHERE_VAR;
use super::state::State;

/// Sigmas of the receiver's error within which a jump is one of its bias.
const BIAS_SIGMAS: f64 = 5.0;
/// Height counts as seen where its variance is below this share of that of the receiver's bias.
const SEEN_SHARE: f64 = 0.25;

impl Core {
    /// Horizontal error of the receiver that the fix in `z` implies.
    pub(crate) fn receiver_error(&self) -> Vector2<f64> {
        Vector2::new(self.z.residual[0], self.z.residual[1]) + self.state.own.gps_bias.xy()
    }

    /// After too many fixes in a row outside the gate: what the bias allows is its own, anything beyond
    /// is another place, believed once two fixes in a row (`before` is the error implied by the one
    /// before this) agree about it.
    pub(crate) fn follow_jump(&mut self, fix: &GpsPosition, before: &Vector2<f64>) {
        // Fusing it at low weight has moved the state.
        if !self.expect_aid(fix) {
            return;
        }
        let error = self.receiver_error();
        let allowed_m = BIAS_SIGMAS * (self.models.gps_bias_var[0] + self.models.gps_noise_var).sqrt();
        let bias_var: [f64; 3] = self.models.gps_bias_var.into();
        if error.norm() <= allowed_m {
            // The receiver's error has jumped: its bias is unknown again, position is not.
            self.forget_misfit();
            self.state.renew(own::GPS_BIAS, &bias_var.map(|v| v * BIAS_SIGMAS.powi(2)));
            return;
        }
        if !((error - before).norm() <= allowed_m) {
            return;
        }
        self.forget_misfit();
        let moved = Vector3::new(error.x, error.y, self.follow_height(&error, fix.has_height));
        let state = &mut self.state;
        state.translate(&moved);
        state.loosen(&bias_var);
        state.own.gps_bias.x = 0.0;
        state.own.gps_bias.y = 0.0;
        state.anchored = Some((state.t, moved));
        // The innovation is zero now: this ties position, bias and all else that makes a fix together.
        self.fuse_aid_as_it_is(fix);
    }

    /// What the fixes that have just been explained said of the receiver counts no more.
    fn forget_misfit(&mut self) {
        self.state.rejections.gps_position = 0;
        self.state.past_bias.in_use = false;
        self.state.fits[WATCHED_POSITION] = Fit::default();
    }

    /// How far down the scene moves along with the horizontal `error`. Height over the ground is seen
    /// wherever tags are: then it stays, and the receiver's vertical bias takes the jump.
    fn follow_height(&mut self, error: &Vector2<f64>, has_height: bool) -> f64 {
        let (position, bias): (Block<1>, Block<1>) = (own::POSITION.part(2), own::GPS_BIAS.part(2));
        let bias_var = self.models.gps_bias_var[2];
        let residual = self.z.residual[2];
        let implied = residual + self.state.own.gps_bias.z;
        let seen = self.state.cov.var(position) < SEEN_SHARE * bias_var;
        if has_height && !seen && implied.abs() > BIAS_SIGMAS * bias_var.sqrt() {
            self.state.own.gps_bias.z = 0.0;
            self.state.renew(position, &[ANYWHERE_VAR]);
            self.state.renew(bias, &[bias_var]);
            // Where they lie was read off the height that has just been given up.
            (0..self.state.features.len()).for_each(|slot| self.drop_feature(slot));
            return implied;
        }
        let (ground, p) = (&self.models.ground, self.state.own.position);
        let rise =
            if seen { ground.down_m(p.x + error.x, p.y + error.y) - ground.down_m(p.x, p.y) } else { 0.0 };
        if has_height {
            self.state.own.gps_bias.z += residual - rise;
            self.state.renew(bias, &[bias_var * BIAS_SIGMAS.powi(2)]);
        }
        rise
    }
}

impl State {
    /// Moves everything that has a place; nothing else changes.
    fn translate(&mut self, by: &Vector3<f64>) {
        self.own.position += by;
        let shift = |place: &mut [f64]| place.iter_mut().zip(by).for_each(|(x, by)| *x += by);
        for target in self.targets.iter_mut().filter(|t| t.life.is_held()) {
            shift(&mut target.mean[..2]);
            if let Some(first) = target.life.first_mut() {
                shift(&mut first.place);
            }
            if let Some(twin) = &mut target.twin {
                shift(&mut twin.place);
            }
        }
        for feature in self.features.iter_mut().filter(|f| f.id.is_some()) {
            shift(&mut feature.mean);
        }
    }

    /// Opens horizontal position and the receiver's bias (to its prior) while everything else keeps its
    /// place relative to the helicopter: places are made relative, position is forgotten, and they are
    /// made absolute again.
    fn loosen(&mut self, bias_var: &[f64; 3]) {
        self.tie_places(-1.0);
        let (place, bias): (Block<2>, Block<2>) = (own::POSITION.part(0), own::GPS_BIAS.part(0));
        self.renew(place, &[ANYWHERE_VAR; 2]);
        self.renew(bias, &[bias_var[0], bias_var[1]]);
        self.tie_places(1.0);
    }

    /// Adds `factor` times the helicopter's horizontal error to that of every target and feature.
    fn tie_places(&mut self, factor: f64) {
        let layout = self.layout();
        let mut shear = Shear::none(layout.len());
        for axis in 0..2 {
            shear.begin(own::POSITION.column(axis));
            for (slot, place) in layout.places().enumerate() {
                let in_use = match slot.checked_sub(layout.targets) {
                    Some(feature) => self.features[feature].id.is_some(),
                    None => self.targets[slot].life.is_held(),
                };
                if in_use {
                    shear.give(place.column(axis), factor);
                }
            }
            self.shear(&shear);
        }
    }
}
