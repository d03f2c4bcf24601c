//! ROS 2 without ROS: its messages in CDR, their definitions, and bags of them.

mod bag;
mod cdr;
mod definitions;
mod encodings;
mod messages;
#[cfg(feature = "zenoh")]
pub mod rmw;

pub use bag::{Bag, FILES as BAG_FILES};
pub use definitions::RosType;
pub use encodings::{encoding_name, frame_encoding};
pub use messages::{
    AprilTag, AprilTagDetectionArray, CameraInfo, CompressedImage, DiagnosticArray, DiagnosticStatus, Header,
    Image, Imu, Log, NavSatFix, Odometry, RosMessage, TfMessage, Transform,
};

use windhover_base::time::MonoTime;

/// A serialised message to be written.
#[derive(Clone, PartialEq, Debug)]
pub struct RosRecord {
    /// Topic, with its leading slash.
    pub topic: String,
    /// Its type.
    pub kind: RosType,
    /// Time of reception, host time.
    pub log_time: MonoTime,
    /// Time of validity, host time.
    pub publish_time: MonoTime,
    /// The message in CDR, with its encapsulation header.
    pub data: Vec<u8>,
}

impl RosRecord {
    /// The record of a message.
    pub fn new<M: RosMessage>(
        topic: impl Into<String>,
        log: MonoTime,
        publish: MonoTime,
        message: &M,
    ) -> Self {
        let data = message.to_cdr();
        Self { topic: topic.into(), kind: M::TYPE, log_time: log, publish_time: publish, data }
    }

    /// Whether a late subscriber still gets the last message: for constant messages.
    pub fn is_latched(&self) -> bool {
        self.topic == "/tf_static"
    }
}
