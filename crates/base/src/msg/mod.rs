//! What flows: events in, measurements between, estimates out. Values only.

mod estimate;
mod event;
mod family;
mod image;
mod measure;
mod predict;
mod warm;

pub use estimate::{
    Disposition, FusionResult, FusionSource, Ownship, TargetEstimate, TargetState, TrackStatus,
};
pub use event::{Event, EventBody, FrameEncoding, FramePayload, Source};
pub use family::TagFamily;
pub use image::{GrayImage, ImageView, RgbImage};
pub use measure::{
    AttitudeSample, FeatureTrack, FixKind, FrameObservations, GnssEpoch, MarkerDetection, MarkerId, Stamped,
};
pub use predict::{FramePrediction, MarkerPrediction};
pub use warm::{WARM_STATES, WarmArrival, WarmFilter, WarmSite, WarmState};
