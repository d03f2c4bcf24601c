//! The filter's start: the helicopter's state from a fix and a compass reading.

use nalgebra::Rotation3;

use windhover_base::geo::{ned_from_body_321, tilt_from_down};
use windhover_base::msg::{AttitudeSample, GnssEpoch};
use windhover_base::time::MonoTime;

use super::aid::compass::true_heading;
use super::aid::gnss;
use super::blocks::{Block, own};
use super::models::Models;
use super::own::{Own, slow_start_vars};
use super::state::{Rejections, State};

/// Variance of a position that is about to be read off the receiver, m².
pub(crate) const ANYWHERE_VAR: f64 = 1e4;
/// Tilt at the start, one sigma, rad: what a helicopter may fly with whatever its compass says.
const START_TILT: f64 = 0.1;
/// What a heading reading may have changed since it was taken, one sigma, rad.
pub(crate) const START_HEADING: f64 = 0.1;
/// Angular rate at the start, one sigma, rad/s.
const START_RATE: f64 = 0.3;

/// Starts the helicopter's state; `false` where the fix has no position or the reading no heading.
pub(crate) fn start(
    state: &mut State,
    t: MonoTime,
    epoch: &GnssEpoch,
    compass: &AttitudeSample,
    models: &Models,
) -> bool {
    let position = gnss::position(epoch, models).filter(|position| position.is_credible());
    let (Some(position), Some(heading)) = (position, compass.heading) else { return false };
    let down = compass.tilt.and_then(|tilt| models.convention.down_in_body(tilt));
    let (pitch, roll) = down.map_or((0.0, 0.0), |d| tilt_from_down(&d));
    let heading = true_heading(heading, compass.heading_is_true, models);
    let attitude: Rotation3<f64> = ned_from_body_321(heading, pitch, roll);
    let velocity = gnss::velocity(epoch).filter(|velocity| velocity.is_credible());
    state.clear();
    state.own = Own {
        position: position.ned_m - attitude * models.antenna_at,
        velocity: velocity.map(|velocity| velocity.ned_mps).unwrap_or_default(),
        ned_from_body: attitude,
        ..Own::default()
    };
    state.t = t;
    state.alive = true;
    state.rejections = Rejections::default();
    let level: Block<2> = own::ATTITUDE.part(0);
    let (side, thrust) = (state.learnt.side_force_var, state.learnt.thrust_var);
    let p = &mut state.cov;
    // Position starts wide and is tied to the receiver's bias by the first update.
    p.set_diagonal(own::POSITION, &[ANYWHERE_VAR; 3]);
    p.set_diagonal(own::VELOCITY, &[if velocity.is_some() { 1.0 } else { 100.0 }; 3]);
    p.set_diagonal(level, &[START_TILT.powi(2); 2]);
    p.set_diagonal(own::TURN, &[models.heading_bias_var + START_HEADING.powi(2)]);
    p.set_diagonal(own::RATE, &[START_RATE * START_RATE; 3]);
    p.set_diagonal(own::FORCE, &[side, side, thrust]);
    p.set_diagonal(own::SLOW, &slow_start_vars(models));
    // Heading is the reading less the bias: where the one errs, so does the other.
    let (turn, bias) = (own::TURN.column(0), own::HEADING_BIAS.column(0));
    p.set(turn, bias, -models.heading_bias_var);
    p.set(bias, turn, -models.heading_bias_var);
    true
}
