//! The values that flow through the program: events in, measurements between, estimates out.

mod estimate;
mod event;
mod family;
mod health;
mod image;
mod measure;
mod notice;
mod output;
mod predict;
mod source;
mod warm_state;

pub use estimate::{
    Disposition, EstimatorOutput, FeltTilt, FusionResult, FusionSource, MarkerPair, Misfit, MisfitCause,
    Ownship, TargetEstimate, TargetState, TrackStatus,
};
pub use event::{Bayer, Event, EventBody, FrameEncoding, FramePayload};
pub use family::{FamilySpec, Form, TagFamily};
pub use health::{Health, SourceHealth, TargetHealth};
pub use image::{GrayImage, ImageView, RgbImage};
pub use measure::{
    AttitudeSample, AutopilotPosition, FeatureTrack, FixKind, FrameObservations, GnssEpoch, InertialSample,
    MarkerDetection, MarkerId, SensorReading, Stamped,
};
pub use notice::{MisfitWords, Notice, NoticeKind};
pub use output::{Output, TimedOutput};
pub use predict::{FramePrediction, MarkerPrediction};
pub use source::{Delivery, PerSource, Source};
pub use warm_state::{WARM_STATES, WarmArrival, WarmFilter, WarmSite, WarmState};
