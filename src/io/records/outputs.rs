//! Outputs as records: the messages of an output, and their topics.

use std::collections::BTreeMap;

use nalgebra::{UnitQuaternion, Vector3};
use prost::Message;

use super::output_messages::{
    annotations, attitude, detections, fix_number, health, location, log_message, ownship, rtk, stamp,
    target_state, transform,
};
use super::{Record, Schema, topic};
use crate::io::proto::{foxglove as fox, timestamp, windhover as wh};
use windhover_base::geo::{LensModel, rot_z};
use windhover_base::msg::{
    AttitudeSample, EstimatorOutput, FusionResult, GnssEpoch, Output, SensorReading, Stamped, TargetEstimate,
};
use windhover_base::settings::{CameraConfig, TargetConfig};
use windhover_base::time::MonoTime;

/// Values that only a daemon has (card, link, computer), by name.
#[derive(Clone, Default, PartialEq, Debug)]
pub struct DaemonFigures {
    /// Numbers; the name contains the unit.
    pub figures: BTreeMap<String, f64>,
    /// States as text.
    pub words: BTreeMap<String, String>,
}

/// Records at the start of every file: intrinsics and the camera's mount.
pub fn opening(camera: &CameraConfig, t: MonoTime) -> Vec<Record> {
    let k = &camera.intrinsics;
    // Foxglove's names, which ROS's readers know too.
    let (distortion_model, terms) = match k.model {
        LensModel::Brown => ("plumb_bob", &k.distortion[..]),
        LensModel::Fisheye => ("kannala_brandt", &k.distortion[..4]),
    };
    let calibration = fox::CameraCalibration {
        timestamp: Some(timestamp(t)),
        frame_id: "camera".into(),
        width: camera.width,
        height: camera.height,
        distortion_model: distortion_model.into(),
        d: terms.to_vec(),
        k: vec![k.fx, k.fx * k.skew, k.cx, 0.0, k.fy, k.cy, 0.0, 0.0, 1.0],
        r: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p: vec![k.fx, 0.0, k.cx, 0.0, 0.0, k.fy, k.cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    };
    let body_from_camera = UnitQuaternion::from_rotation_matrix(&camera.mount.body_from_camera());
    let mount = transform(t, "body", "camera", camera.mount.position(), &body_from_camera);
    vec![
        record(topic::CAMERA_CALIBRATION.into(), Schema::CameraCalibration, t, t, &calibration),
        record(topic::TF.into(), Schema::FrameTransform, t, t, &mount),
    ]
}

/// Converts outputs to records.
pub struct OutputEncoder {
    targets: Vec<String>,
    /// The daemon's values for the next health message.
    pub figures: DaemonFigures,
}

impl OutputEncoder {
    /// An encoder for a pipeline with these targets.
    pub fn new(targets: &[TargetConfig]) -> Self {
        Self {
            targets: targets.iter().map(|target| target.name.clone()).collect(),
            figures: DaemonFigures::default(),
        }
    }

    /// Appends the records of an output; `log` is the reception of the event that caused it.
    pub fn output(&mut self, output: &Output, log: MonoTime, out: &mut Vec<Record>) {
        match output {
            Output::Datum(t, datum) => {
                let message = wh::Datum {
                    timestamp: Some(timestamp(*t)),
                    lat_deg: datum.lat_deg,
                    lon_deg: datum.lon_deg,
                    height_m: datum.height_m,
                };
                out.push(record(topic::DATUM.into(), Schema::Datum, log, *t, &message));
            }
            Output::Reading(SensorReading::Gnss(epoch)) => fix(epoch, log, out),
            Output::Reading(SensorReading::Attitude(sample)) => out.push(attitude_record(sample, log)),
            // Messages of an autopilot are recorded as bytes.
            Output::Reading(_) => {}
            Output::Detections { frame, t_valid, markers, features } => {
                let whole = detections(*frame, *t_valid, markers, features);
                out.push(record(topic::CAMERA_DETECTIONS.into(), Schema::Detections, log, *t_valid, &whole));
                let overlay = annotations(*t_valid, markers, features);
                let name = topic::CAMERA_ANNOTATIONS.into();
                out.push(record(name, Schema::ImageAnnotations, log, *t_valid, &overlay));
            }
            Output::Estimator(said) => self.estimator(said, log, out),
            Output::Paper(e) => self.state(topic::target_paper(self.name(e)), e, log, out),
            Output::Notice(notice) => {
                out.push(record(topic::LOG.into(), Schema::Log, log, notice.t, &log_message(notice)));
            }
            Output::Health(now) => {
                let mut message = health(now, &self.targets);
                message.figures.extend(self.figures.figures.clone());
                message.words.extend(self.figures.words.clone());
                out.push(record(topic::HEALTH.into(), Schema::Health, log, now.t, &message));
            }
        }
    }

    fn estimator(&self, said: &EstimatorOutput, log: MonoTime, out: &mut Vec<Record>) {
        match said {
            EstimatorOutput::Ownship(own) => {
                out.push(record(topic::OWNSHIP.into(), Schema::Ownship, log, own.t_valid, &ownship(own)));
                let tf = transform(own.t_valid, "ned", "body", own.position_ned_m, &own.ned_from_body);
                out.push(record(topic::TF.into(), Schema::FrameTransform, log, own.t_valid, &tf));
            }
            EstimatorOutput::Estimate(e) => {
                self.state(topic::target_state(self.name(e)), e, log, out);
                self.place(e, log, out);
            }
            EstimatorOutput::Coasted(e) => {
                self.state(topic::target_coasting(self.name(e)), e, log, out);
                self.place(e, log, out);
            }
            EstimatorOutput::Smoothed(e) => self.state(topic::target_smoothed(self.name(e)), e, log, out),
            EstimatorOutput::Fusion(result) => out.push(fusion(result, log)),
            // The pipeline's notice reports these.
            EstimatorOutput::Anchored { .. }
            | EstimatorOutput::Reset { .. }
            | EstimatorOutput::TiltFelt { .. }
            | EstimatorOutput::Misfit(_) => {}
        }
    }

    fn name(&self, estimate: &TargetEstimate) -> &str {
        &self.targets[estimate.target]
    }

    fn state(&self, topic: String, estimate: &TargetEstimate, log: MonoTime, out: &mut Vec<Record>) {
        let message = target_state(estimate, self.name(estimate));
        out.push(record(topic, Schema::TargetState, log, estimate.t_valid, &message));
    }

    /// A target's place, for maps and for viewers of transforms.
    fn place(&self, estimate: &TargetEstimate, log: MonoTime, out: &mut Vec<Record>) {
        let Some(state) = &estimate.state else { return };
        let name = self.name(estimate);
        let t = estimate.t_valid;
        let location = location(t, &format!("target/{name}"), state);
        out.push(record(topic::target_location(name), Schema::LocationFix, log, t, &location));
        let at = Vector3::new(state.north_m, state.east_m, 0.0);
        let turned = UnitQuaternion::from_rotation_matrix(&rot_z(state.heading_rad));
        let tf = transform(t, "ned", &format!("target/{name}"), at, &turned);
        out.push(record(topic::TF.into(), Schema::FrameTransform, log, t, &tf));
    }
}

fn record(topic: String, schema: Schema, log: MonoTime, publish: MonoTime, message: &impl Message) -> Record {
    Record {
        topic: topic.into(),
        schema,
        log_time: log,
        publish_time: publish,
        data: message.encode_to_vec(),
    }
}

fn fix(epoch: &Stamped<GnssEpoch>, log: MonoTime, out: &mut Vec<Record>) {
    let (t, e) = (epoch.t_valid, &epoch.value);
    let components = if e.vel_has_down { 3 } else { 2 };
    let message = wh::GnssEpoch {
        timestamp: stamp(t),
        utc_ns: e.utc.map(|utc| utc.unix_ns()),
        fix: fix_number(e.fix),
        lat_deg: e.lat_deg,
        lon_deg: e.lon_deg,
        alt_msl_m: e.alt_msl_m,
        geoid_m: e.geoid_m,
        vel_ned_mps: e.vel_ned_mps.map_or(Vec::new(), |v| v.iter().take(components).copied().collect()),
        hpe_m: e.hpe_m,
        vpe_m: e.vpe_m,
        sats: e.sats,
        hdop: e.hdop,
        heard: stamp(epoch.t_recv),
        rtk: rtk(e.fix).into(),
        position_sigma_m: e.position_sigma_m.map_or(Vec::new(), |v| v.iter().copied().collect()),
        velocity_sigma_mps: e.velocity_sigma_mps.map_or(Vec::new(), |v| v.iter().copied().collect()),
    };
    out.push(record(topic::GPS_EPOCH.into(), Schema::GnssEpoch, log, t, &message));
    let (Some(latitude), Some(longitude)) = (e.lat_deg, e.lon_deg) else { return };
    let location = fox::LocationFix {
        timestamp: stamp(t),
        frame_id: "gps".into(),
        latitude,
        longitude,
        altitude: e.alt_msl_m.unwrap_or(0.0) + e.geoid_m.unwrap_or(0.0),
        ..Default::default()
    };
    out.push(record(topic::GPS_FIX.into(), Schema::LocationFix, log, t, &location));
}

fn attitude_record(sample: &Stamped<AttitudeSample>, log: MonoTime) -> Record {
    let message = attitude(sample.t_valid, sample.t_recv, &sample.value);
    record(topic::COMPASS_ATTITUDE.into(), Schema::Attitude, log, sample.t_valid, &message)
}

fn fusion(result: &FusionResult, log: MonoTime) -> Record {
    let kept = result.dimension.min(result.innovation.len());
    let message = wh::Fusion {
        timestamp: stamp(result.t_valid),
        source: result.source.name().into(),
        disposition: result.disposition.name().into(),
        innovation: result.innovation[..kept].to_vec(),
        test_ratio: result.test_ratio,
    };
    record(topic::FUSION.into(), Schema::Fusion, log, result.t_valid, &message)
}
