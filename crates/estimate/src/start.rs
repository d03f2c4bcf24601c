//! The filter's start: the helicopter's state from a fix and a compass reading.

use nalgebra::Vector3;

use windhover_base::msg::{AttitudeSample, GnssEpoch};
use windhover_base::time::MonoTime;

use super::aid::compass::{down_in_body, true_heading};
use super::aid::gnss;
use super::blocks::{Block, own};
use super::models::Models;
use super::own::{COMPASS, Own, SECOND};
use super::slow::{START_DRAG_PER_S, Terms};
use super::state::{Rejections, State};

/// Variance of a position that is about to be read off the receiver, m².
pub(crate) const ANYWHERE_VAR: f64 = 1e4;
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
    let heading = true_heading(heading, compass.heading_is_true, models);
    let down = compass.tilt.and_then(|tilt| down_in_body(tilt, models));
    if let Some(down) = &down {
        state.tilt[COMPASS].reading(t, heading, down);
    }
    let attitude = state.tilt[COMPASS].attitude(heading, &down.unwrap_or(Vector3::z()));
    let velocity = gnss::velocity(epoch).filter(|velocity| velocity.is_credible());
    state.clear();
    state.own = Own {
        position: position.ned_m - attitude * models.antenna_at,
        velocity: velocity.map(|velocity| velocity.ned_mps).unwrap_or_default(),
        ned_from_body: attitude,
        tilt_gain: state.tilt[COMPASS].share,
        drag_per_s: START_DRAG_PER_S,
        ..Own::default()
    };
    state.own.second.tilt_gain = state.tilt[SECOND].share;
    state.t = t;
    state.alive = true;
    state.rejections = Rejections::default();
    let level: Block<2> = own::ATTITUDE.part(0);
    state.sense();
    state.senses.of_fix(epoch.fix, epoch.position_sigma_m, state.learnt.receiver.factor(), models);
    state.senses.hold_bias(t);
    let tilt_var = state.tilt[COMPASS].tilt_var();
    let slow_vars = Terms { models, learnt: &state.learnt, senses: &state.senses }.start_vars();
    let slow = state.layout().slow();
    let p = &mut state.cov;
    // Position starts wide and is tied to the receiver's bias by the first update.
    p.set_diagonal(own::POSITION, &[ANYWHERE_VAR; 3]);
    p.set_diagonal(own::VELOCITY, &[if velocity.is_some() { 1.0 } else { 100.0 }; 3]);
    p.set_diagonal(level, &[tilt_var; 2]);
    p.set_diagonal(own::TURN, &[models.heading_bias_var[COMPASS] + START_HEADING.powi(2)]);
    p.set_diagonal(own::RATE, &[START_RATE * START_RATE; 3]);
    p.add_to_diagonal(slow, &slow_vars);
    p.set_diagonal(own::TILT_GAIN, &[state.tilt[COMPASS].share_sigma.powi(2)]);
    // Heading is the reading less the bias: where the one errs, so does the other.
    let (turn, bias) = (own::TURN.column(0), own::HEADING_BIAS.column(0));
    p.set(turn, bias, -models.heading_bias_var[COMPASS]);
    p.set(bias, turn, -models.heading_bias_var[COMPASS]);
    true
}
