//! A compass reading: heading and tilt as the filter means them.

use windhover_base::geo::Tilt;
use windhover_base::msg::{AttitudeSample, Disposition, FusionSource};

use super::heading::Heading;
use super::tilt::TiltReading;
use crate::core::Core;
use crate::models::Models;

/// What one compass reading counts in a sliding mean, s: the interval of a 30 Hz compass.
pub(super) const SAMPLE_GAIN_S: f64 = 1.0 / 30.0;

/// True heading of the aircraft from what the device reports.
pub(crate) fn true_heading(heading: f64, is_true: bool, models: &Models) -> f64 {
    heading + if is_true { 0.0 } else { models.declination } + models.yaw_offset
}

/// Fuses one reading: heading, then tilt.
pub(crate) fn fuse(core: &mut Core, sample: &AttitudeSample) {
    if let Some(heading) = sample.heading {
        Heading(true_heading(heading, sample.heading_is_true, &core.models)).fuse(core);
    }
    if let Some(tilt) = sample.tilt {
        let models = &core.models;
        let tilt = Tilt { pitch: tilt.pitch - models.pitch_offset, roll: tilt.roll - models.roll_offset };
        match models.convention.down_in_body(tilt) {
            Some(down) => TiltReading { down }.fuse(core),
            None => core.refuse(FusionSource::CompassTilt, Disposition::Invalid),
        }
    }
}
