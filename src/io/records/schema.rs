//! The schemas of recorded messages.

use crate::io::proto;

/// A protobuf schema.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum Schema {
    /// `windhover.SerialBytes`
    SerialBytes,
    /// `windhover.SourceEvent`
    SourceEvent,
    /// `foxglove.CompressedImage`
    CompressedImage,
    /// `foxglove.CompressedVideo`
    CompressedVideo,
    /// `foxglove.RawImage`
    RawImage,
    /// `foxglove.LocationFix`
    LocationFix,
    /// `foxglove.FrameTransform`
    FrameTransform,
    /// `foxglove.CameraCalibration`
    CameraCalibration,
    /// `foxglove.ImageAnnotations`
    ImageAnnotations,
    /// `foxglove.Log`
    Log,
    /// `windhover.TargetState`
    TargetState,
    /// `windhover.Ownship`
    Ownship,
    /// `windhover.Datum`
    Datum,
    /// `windhover.Detections`
    Detections,
    /// `windhover.GnssEpoch`
    GnssEpoch,
    /// `windhover.Attitude`
    Attitude,
    /// `windhover.Inertial`
    Inertial,
    /// `windhover.Fusion`
    Fusion,
    /// `windhover.Health`
    Health,
    /// `windhover.WarmState`
    WarmState,
    /// `windhover.Refined`
    Refined,
}

impl Schema {
    /// Its full name.
    pub const fn name(self) -> &'static str {
        match self {
            Self::SerialBytes => "windhover.SerialBytes",
            Self::SourceEvent => "windhover.SourceEvent",
            Self::CompressedImage => "foxglove.CompressedImage",
            Self::CompressedVideo => "foxglove.CompressedVideo",
            Self::RawImage => "foxglove.RawImage",
            Self::LocationFix => "foxglove.LocationFix",
            Self::FrameTransform => "foxglove.FrameTransform",
            Self::CameraCalibration => "foxglove.CameraCalibration",
            Self::ImageAnnotations => "foxglove.ImageAnnotations",
            Self::Log => "foxglove.Log",
            Self::TargetState => "windhover.TargetState",
            Self::Ownship => "windhover.Ownship",
            Self::Datum => "windhover.Datum",
            Self::Detections => "windhover.Detections",
            Self::GnssEpoch => "windhover.GnssEpoch",
            Self::Attitude => "windhover.Attitude",
            Self::Inertial => "windhover.Inertial",
            Self::Fusion => "windhover.Fusion",
            Self::Health => "windhover.Health",
            Self::WarmState => "windhover.WarmState",
            Self::Refined => "windhover.Refined",
        }
    }

    /// The schema of that full name.
    pub fn named(name: &str) -> Option<Self> {
        const ALL: [Schema; 21] = [
            Schema::SerialBytes,
            Schema::SourceEvent,
            Schema::CompressedImage,
            Schema::CompressedVideo,
            Schema::RawImage,
            Schema::LocationFix,
            Schema::FrameTransform,
            Schema::CameraCalibration,
            Schema::ImageAnnotations,
            Schema::Log,
            Schema::TargetState,
            Schema::Ownship,
            Schema::Datum,
            Schema::Detections,
            Schema::GnssEpoch,
            Schema::Attitude,
            Schema::Inertial,
            Schema::Fusion,
            Schema::Health,
            Schema::WarmState,
            Schema::Refined,
        ];
        ALL.into_iter().find(|schema| schema.name() == name)
    }

    /// The descriptor set that is stored in a file with messages of this schema.
    pub fn descriptor(self) -> Vec<u8> {
        let package = self.name().split_once('.').map_or("", |(package, _)| package);
        proto::schema_of_package(package)
    }
}
