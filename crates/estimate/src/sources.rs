//! What the filter takes, a row a source: the measurement in a form that is recycled, and the file that fuses it.

use windhover_base::msg::{AttitudeSample, FrameObservations, GnssEpoch, InertialSample};
use windhover_base::time::MonoTime;

use super::aid::rate::Rate;
use super::aid::specific_force::SpecificForce;
use super::aid::{compass, gnss};
use super::core::Core;

/// Which part of an [`AnyMeasurement`] counts.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub(crate) enum Kind {
    #[default]
    Nothing,
    Gnss,
    Attitude,
    SecondAttitude,
    Inertial,
    Frame,
}

/// A measurement of any source, in a form that is recycled.
#[derive(Clone, Debug)]
pub(crate) struct AnyMeasurement {
    pub(crate) kind: Kind,
    pub(crate) gnss: GnssEpoch,
    pub(crate) attitude: AttitudeSample,
    /// A block, in body axes.
    pub(crate) inertial: InertialSample,
    pub(crate) frame: FrameObservations,
}

impl Default for AnyMeasurement {
    /// With room for a frame, whatever it is first used for.
    fn default() -> Self {
        let frame = FrameObservations {
            frame: 0,
            markers: Vec::with_capacity(ROOM),
            features: Vec::with_capacity(ROOM),
        };
        Self {
            kind: Kind::Nothing,
            gnss: GnssEpoch::default(),
            attitude: AttitudeSample::default(),
            inertial: InertialSample::default(),
            frame,
        }
    }
}

/// Markers or features of a frame that fit without allocating.
const ROOM: usize = 16;

impl Core {
    /// Carries the state to `t` and fuses what was true then.
    pub(crate) fn process(&mut self, t: MonoTime, measurement: &AnyMeasurement) {
        self.state.propagate(t, &self.models);
        match measurement.kind {
            Kind::Nothing => {}
            Kind::Gnss => gnss::fuse(self, &measurement.gnss),
            Kind::Attitude => compass::fuse(self, &measurement.attitude),
            Kind::SecondAttitude => compass::fuse_second(self, &measurement.attitude),
            Kind::Inertial => self.fuse_inertial(&measurement.inertial),
            Kind::Frame => self.fuse_frame(&measurement.frame),
        }
        self.state.learn(&self.models, &self.learning);
        self.learn_receiver_error();
    }

    fn fuse_inertial(&mut self, block: &InertialSample) {
        if let Some(rate) = block.rate_rps {
            Rate(rate).fuse(self);
        }
        if let Some(force) = block.force_mps2 {
            SpecificForce(force).fuse(self);
        }
    }
}
