//! A flight as messages of ROS 2: its outputs, frames and samples, in REP-103's axes and REP-105's frames.
//!
//! | frame | axes | origin |
//! |---|---|---|
//! | `earth` | ECEF | the Earth's centre |
//! | `map` | east, north, up | the datum |
//! | `base_link` | forward, left, up | the helicopter's body frame |
//! | `NAME/base_link` | forward, left, up | the reference point of target NAME, on the ground |
//! | `camera_optical_frame` | right, down, along the optical axis | the camera |
//! | `imu_link`, `gps_link` | the sensor's own; as `base_link` | the body frame; the antenna |
//!
//! Where several helicopters are in one graph, topics and frames of each begin with its name, but `earth` and the
//! topics that ROS has once: `/tf`, `/tf_static`, `/diagnostics`, `/rosout`.

mod camera;
mod health;
mod motion;
mod names;
mod sensors;

use std::collections::BTreeMap;

use nalgebra::{UnitQuaternion, Vector3};
use prost::{DecodeError, Message as _};

use crate::config::Config;
use crate::io::proto::windhover as wh;
use crate::io::proto::{foxglove as fox, host_time};
use crate::io::records::topic;
use crate::io::ros::{CameraInfo, Header, RosRecord, TfMessage, Transform};
pub use names::RosNames;
use windhover_base::geo::{Geodetic, LocalFrame};
use windhover_base::msg::{Event, EventBody};
use windhover_base::settings::ImuConfig;
use windhover_base::time::MonoTime;

/// East, north, up at the datum.
const MAP: &str = "map";
/// The helicopter.
const BASE_LINK: &str = "base_link";
const CAMERA: &str = "camera_optical_frame";
const IMU: &str = "imu_link";
const GPS: &str = "gps_link";

/// Variance of a quantity that is not estimated, as in drivers of mobile robots: finite, so that covariances stay
/// invertible.
const NOT_ESTIMATED: f64 = 1e6;

/// Converts recorded messages to messages of ROS 2, in the same order.
pub struct RosTranslator {
    helicopter: Option<String>,
    imu: Option<ImuConfig>,
    antenna_m: [f64; 3],
    references_m: BTreeMap<String, f64>,
    names: RosNames,
    datum: Option<LocalFrame>,
    lens: Option<CameraInfo>,
    statics: BTreeMap<String, Transform>,
}

impl RosTranslator {
    /// A translator for a flight of this configuration.
    pub fn new(config: Option<&Config>) -> Self {
        let reference =
            |target: &windhover_base::settings::TargetConfig| (target.name.clone(), target.reference_m);
        Self {
            helicopter: None,
            imu: config.and_then(|config| config.imu),
            antenna_m: config.map_or([0.0; 3], |config| config.gps.antenna_position_m),
            references_m: config
                .map_or(BTreeMap::new(), |config| config.target.iter().map(reference).collect()),
            names: RosNames::with("target_"),
            datum: None,
            lens: None,
            statics: BTreeMap::new(),
        }
    }

    /// A translator for a helicopter among others: topics and frames begin with its name, in characters of ROS.
    pub fn of_helicopter(name: &str) -> Self {
        Self { helicopter: Some(name.to_owned()), ..Self::new(None) }
    }

    fn topic(&self, topic: &str) -> String {
        self.helicopter.as_ref().map_or_else(|| topic.to_owned(), |name| format!("/{name}{topic}"))
    }

    fn frame(&self, frame: &str) -> String {
        self.helicopter.as_ref().map_or_else(|| frame.to_owned(), |name| format!("{name}/{frame}"))
    }

    /// Appends the messages of an event: frames, and samples of rates and forces.
    pub fn event(&mut self, event: &Event, out: &mut Vec<RosRecord>) {
        match &event.body {
            EventBody::Frame(frame) => self.image(frame, event.t_recv, out),
            EventBody::Inertial { sample, .. } => self.inertial(sample, event.t_recv, out),
            _ => {}
        }
    }

    /// Appends the messages of an output, by its topic. A message that is not an output, or has no values, makes none.
    ///
    /// # Errors
    /// The data is not a message of the topic's schema.
    pub fn output(
        &mut self,
        name: &str,
        log: MonoTime,
        data: &[u8],
        out: &mut Vec<RosRecord>,
    ) -> Result<(), DecodeError> {
        match name {
            topic::DATUM => self.datum(&wh::Datum::decode(data)?, log, out),
            topic::OWNSHIP => self.ownship(&wh::Ownship::decode(data)?, log, out),
            topic::OWNSHIP_REFINED => self.ownship_refined(&wh::Ownship::decode(data)?, log, out),
            topic::GPS_EPOCH => self.fix(&wh::GnssEpoch::decode(data)?, log, out),
            topic::CAMERA_CALIBRATION => {
                self.lens = Some(self.lens_of(fox::CameraCalibration::decode(data)?))
            }
            topic::TF => self.mount(&fox::FrameTransform::decode(data)?, log, out),
            topic::CAMERA_DETECTIONS => out.push(self.detections(&wh::Detections::decode(data)?, log)),
            topic::HEALTH => out.push(self.diagnostics(&wh::Health::decode(data)?, log)),
            topic::LOG => out.push(self.log(fox::Log::decode(data)?, log)),
            _ => {
                if let Some((_, what)) = name.strip_prefix("/target/").and_then(|rest| rest.rsplit_once('/'))
                {
                    match what {
                        "state" | "coasting" => self.target(&wh::TargetState::decode(data)?, "", log, out),
                        "smoothed" => self.target(&wh::TargetState::decode(data)?, "_smoothed", log, out),
                        "refined" => self.target(&wh::TargetState::decode(data)?, "_refined", log, out),
                        _ => {}
                    }
                }
            }
        }
        Ok(())
    }

    fn datum(&mut self, datum: &wh::Datum, log: MonoTime, out: &mut Vec<RosRecord>) {
        if !datum.is_sound() {
            return;
        }
        let origin = Geodetic { lat_deg: datum.lat_deg, lon_deg: datum.lon_deg, height_m: datum.height_m };
        let frame = LocalFrame::new(origin);
        let at = origin.to_ecef();
        // The columns of earth_from_map are the directions of steps of a metre east, north and up.
        let step = |ned: Vector3<f64>| frame.geodetic(&ned).to_ecef() - at;
        let axes = [Vector3::y(), Vector3::x(), -Vector3::z()].map(step);
        let matrix = nalgebra::Rotation3::from_basis_unchecked(&axes);
        let earth_from_map = Transform {
            header: Header::new(host_time(datum.timestamp.as_ref()), "earth"),
            child_frame_id: self.frame(MAP),
            translation: at,
            rotation: UnitQuaternion::from_rotation_matrix(&matrix),
        };
        self.datum = Some(frame);
        self.constant(earth_from_map, log, out);
    }

    /// The camera's mount; transforms of helicopter and targets come from their states.
    fn mount(&mut self, tf: &fox::FrameTransform, log: MonoTime, out: &mut Vec<RosRecord>) {
        if (tf.parent_frame_id.as_str(), tf.child_frame_id.as_str()) != ("body", "camera") {
            return;
        }
        let (at, q) = (tf.translation.unwrap_or_default(), tf.rotation.unwrap_or_default());
        let body_from_camera = nalgebra::Quaternion::new(q.w, q.x, q.y, q.z);
        let Some(body_from_camera) = UnitQuaternion::try_new(body_from_camera, 1e-6) else { return };
        let mount = Transform {
            header: Header::new(host_time(tf.timestamp.as_ref()), self.frame(BASE_LINK)),
            child_frame_id: self.frame(CAMERA),
            translation: motion::flu(&Vector3::new(at.x, at.y, at.z)),
            rotation: motion::flu_from_frd() * body_from_camera,
        };
        self.constant(mount, log, out);
    }

    /// A constant transform. Every message contains all so far, because a late subscriber gets only the last one.
    fn constant(&mut self, transform: Transform, log: MonoTime, out: &mut Vec<RosRecord>) {
        let stamp = transform.header.stamp;
        self.statics.insert(transform.child_frame_id.clone(), transform);
        let all = TfMessage(self.statics.values().cloned().collect());
        out.push(RosRecord::new("/tf_static", log, stamp, &all));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_map_stands_upright_on_the_earth() {
        let mut out = Vec::new();
        let mut ros = RosTranslator::new(None);
        let datum = wh::Datum { lat_deg: 0.0, lon_deg: 90.0, height_m: 10.0, ..Default::default() };
        ros.datum(&datum, MonoTime::from_ns(5), &mut out);
        let map = &ros.statics[MAP];
        assert!((map.translation - Vector3::new(0.0, 6_378_147.0, 0.0)).norm() < 1e-6);
        let up = map.rotation * Vector3::z() - Vector3::y();
        let east = map.rotation * Vector3::x() + Vector3::x();
        assert!(up.norm() < 1e-6 && east.norm() < 1e-6, "{up} {east}");
    }
}
