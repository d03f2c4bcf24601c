//! A reading of the compass, or of the second source of attitude: heading and tilt as the filter means them.

use nalgebra::{Matrix3, SMatrix, Vector3};

use windhover_base::geo::Tilt;
use windhover_base::msg::{AttitudeSample, Disposition};

use super::Aid;
use super::heading::Heading;
use super::tilt::TiltReading;
use crate::blocks::own;
use crate::core::Core;
use crate::measurement::Measurement;
use crate::models::Models;
use crate::own::{COMPASS, Own, SECOND};

/// What one compass reading counts in a sliding mean, s: the interval of a 30 Hz compass.
pub(super) const SAMPLE_GAIN_S: f64 = 1.0 / 30.0;

/// True heading of the aircraft from what the compass reports.
pub(crate) fn true_heading(heading: f64, is_true: bool, models: &Models) -> f64 {
    heading + if is_true { 0.0 } else { models.declination } + models.yaw_offset
}

/// Makes of `z`, which depends on attitude by `d_attitude`, what it is a delay τ earlier: `z − τ ∂z/∂δ R ω`. Over tens of
/// milliseconds rates hardly change. Only the compass has a delay beside that configured.
pub(super) fn set_delay<const M: usize>(
    z: &mut Measurement,
    source: usize,
    own: &Own,
    d_attitude: &SMatrix<f64, M, 3>,
) {
    if source != COMPASS {
        return;
    }
    let (rotation, delay_s): (&Matrix3<f64>, f64) = (own.rotation(), own.compass_delay_s);
    let change = d_attitude * (rotation * own.rate);
    z.block(own::COMPASS_DELAY, &-change);
    z.block(own::RATE, &(d_attitude * rotation * -delay_s));
    for (residual, change) in z.residual.iter_mut().zip(change.iter()) {
        *residual += delay_s * change;
    }
}

/// Fuses one reading of the compass: heading, then tilt.
pub(crate) fn fuse(core: &mut Core, sample: &AttitudeSample) {
    let models = &core.models;
    let heading = sample.heading.map(|heading| true_heading(heading, sample.heading_is_true, models));
    let down = sample.tilt.map(|tilt| down_in_body(tilt, models));
    fuse_reading::<COMPASS>(core, heading, down);
}

/// Fuses one reading of the second source of attitude, which is mounted along the body's axes.
pub(crate) fn fuse_second(core: &mut Core, sample: &AttitudeSample) {
    let Models { declination, second_convention, .. } = core.models;
    let heading =
        sample.heading.map(|heading| heading + if sample.heading_is_true { 0.0 } else { declination });
    let down = sample.tilt.map(|tilt| second_convention.down_in_body(tilt));
    fuse_reading::<SECOND>(core, heading, down);
}

/// Fuses true heading and down in the body frame; the inner `None` is a tilt that no attitude has.
fn fuse_reading<const WHICH: usize>(
    core: &mut Core,
    heading: Option<f64>,
    down: Option<Option<Vector3<f64>>>,
) {
    if let (Some(heading), Some(Some(down))) = (heading, down) {
        core.state.tilt[WHICH].reading(core.state.t, heading, &down);
    }
    if let Some(heading) = heading {
        Heading::<WHICH>(heading).fuse(core);
    }
    match down {
        Some(Some(down)) => TiltReading::<WHICH> { down }.fuse(core),
        Some(None) => core.refuse(TiltReading::<WHICH>::SOURCE, Disposition::Invalid),
        None => {}
    }
}

/// Down in the body frame as the compass reports it; `None` where no attitude has these angles.
pub(crate) fn down_in_body(tilt: Tilt, models: &Models) -> Option<Vector3<f64>> {
    let (pitch, roll) = (tilt.pitch - models.pitch_offset, tilt.roll - models.roll_offset);
    models.convention.down_in_body(Tilt { pitch, roll })
}
