//! Which states a measurement does not move: slow errors of force and sensors that own motion alone would explain its
//! misfits with.
//!
//! A real rotorcraft answers gusts with tilt, so that "thrust along the axis" is wrong by some 0.3 m/s² at every time scale.
//! Whatever slow state GPS and compass may move takes that up: the scale of tilt falls by a fifth, the receiver's delay
//! wanders by 0.2 s. So without a marker in view GPS and compass count what is not known of these states, and leave them.
//! Markers see tilt itself: they move everything, and for two seconds after one everything else does.
//!
//! Ground features show tilt by the plane that they lie on, and nobody knows how level it is, nor whether some of them stand on a
//! parked vehicle: half a metre of height seen from ten is 5 % of what the helicopter moves, which tilt and heading take up
//! (hovering over a vehicle whose tags are not read, tilt was off by 1.4° with a sigma of 0.2°). Without a marker they do not move tilt.

use windhover_base::msg::FusionSource;

use super::blocks::own;
use super::kind::{Felt, TiltWatch};
use super::state::State;
use super::update::Held;

/// The share of the tilt that is read: a product with tilt, never found out by one linear step.
const ALWAYS: Held = Held::NONE.and(own::TILT_GAIN).and(own::SECOND_TILT_GAIN);
/// All slow errors of force, tilt reading and IMU, and the receiver's delay.
const BLIND: Held = ALWAYS
    .and(own::GPS_DELAY)
    .and(own::VELOCITY_DELAY)
    .and(own::COMPASS_DELAY)
    .and(own::ARM)
    .and(own::READOUT)
    .and(own::DRAG)
    .and(own::TRIM)
    .and(own::TILT_BIAS)
    .and(own::TILT_ERROR)
    .and(own::RATE_BIAS)
    .and(own::FORCE_BIAS)
    .and(own::SECOND_TILT_BIAS)
    .and(own::SECOND_TILT_ERROR);
/// Tilt too: of ground features.
const LEVEL: Held = BLIND.and(own::ATTITUDE.part::<2>(0));
/// Heading too: a tilt known to some degrees only is no regressor of heading.
const WITHOUT_TILT: Held = BLIND.and(own::TURN).and(own::HEADING_BIAS).and(own::SECOND_HEADING_BIAS);

impl State {
    /// The states that a measurement of this source leaves as they are.
    pub(crate) fn held(&self, source: FusionSource) -> Held {
        // A sensor without any reading shows nothing.
        let shows = |watch: &TiltWatch| {
            watch.last_down().is_some() && matches!(watch.felt, Felt::Attitude | Felt::Share)
        };
        let poor_tilt = !self.tilt.iter().any(shows);
        let held = match source {
            FusionSource::Marker => Held::NONE,
            FusionSource::Feature if !self.is_blind() => Held::NONE,
            _ if !self.is_blind() => ALWAYS,
            FusionSource::Feature => LEVEL,
            FusionSource::CompassHeading | FusionSource::AttitudeHeading => BLIND,
            _ if poor_tilt => WITHOUT_TILT,
            _ => BLIND,
        };
        held.before(self.layout().own)
    }
}
