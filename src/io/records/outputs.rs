//! Outputs as records: our own messages, and Foxglove's where a schema exists.

use std::collections::BTreeMap;

use nalgebra::{UnitQuaternion, Vector3};
use prost::Message;
use prost_types::Timestamp;

use super::{Record, Schema, topic};
use crate::config::Config;
use crate::io::proto::{foxglove as fox, timestamp, windhover as wh};
use windhover_base::geo::rot_z;
use windhover_base::msg::{
    AttitudeSample, FeatureTrack, FixKind, FusionResult, GnssEpoch, Health, MarkerDetection, MarkerId,
    Notice, NoticeKind, Output, Ownship, SourceHealth, Stamped, TargetEstimate, TrackStatus,
};
use windhover_base::time::MonoTime;

/// What only a daemon knows of itself (card, link, computer), by name.
#[derive(Clone, Default, PartialEq, Debug)]
pub struct DaemonFigures {
    /// Figures; the name tells the unit.
    pub figures: BTreeMap<String, f64>,
    /// States in a word.
    pub words: BTreeMap<String, String>,
}

/// Turns outputs into records.
pub struct Recorder {
    config: Config,
    datum_height_m: f64,
    /// What the next health message tells of the daemon.
    pub figures: DaemonFigures,
}

impl Recorder {
    /// For outputs of a pipeline with this configuration.
    pub fn new(config: &Config) -> Self {
        Self { config: config.clone(), datum_height_m: 0.0, figures: DaemonFigures::default() }
    }

    /// Records that every file begins with: intrinsics and the camera's mount.
    pub fn opening(&self, t: MonoTime) -> Vec<Record> {
        let camera = &self.config.camera;
        let k = &camera.intrinsics;
        let calibration = fox::CameraCalibration {
            timestamp: Some(timestamp(t)),
            frame_id: "camera".into(),
            width: camera.width,
            height: camera.height,
            distortion_model: "plumb_bob".into(),
            d: k.distortion.to_vec(),
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

    /// Appends the records of an output; `log` is when the event that caused it was heard.
    pub fn output(&mut self, output: &Output, log: MonoTime, out: &mut Vec<Record>) {
        match output {
            Output::Datum(t, datum) => {
                self.datum_height_m = datum.height_m;
                let message = wh::Datum {
                    timestamp: Some(timestamp(*t)),
                    lat_deg: datum.lat_deg,
                    lon_deg: datum.lon_deg,
                    height_m: datum.height_m,
                };
                out.push(record(topic::DATUM.into(), Schema::Datum, log, *t, &message));
            }
            Output::Fix(epoch) => fix(epoch, log, out),
            Output::Attitude(sample) => out.push(attitude(sample, log)),
            Output::Detections { frame, t_valid, markers, features } => {
                let whole = detections(*frame, *t_valid, markers, features);
                out.push(record(topic::CAMERA_DETECTIONS.into(), Schema::Detections, log, *t_valid, &whole));
                let overlay = annotations(*t_valid, markers, features);
                let name = topic::CAMERA_ANNOTATIONS.into();
                out.push(record(name, Schema::ImageAnnotations, log, *t_valid, &overlay));
            }
            Output::Ownship(own) => {
                out.push(record(topic::OWNSHIP.into(), Schema::Ownship, log, own.t_valid, &ownship(own)));
                let tf = transform(own.t_valid, "ned", "body", own.position_ned_m, &own.ned_from_body);
                out.push(record(topic::TF.into(), Schema::FrameTransform, log, own.t_valid, &tf));
            }
            Output::Estimate(estimate) => self.estimate(estimate, log, out),
            Output::Smoothed(e) => self.state(topic::target_smoothed(self.name(e)), e, log, out),
            Output::Paper(e) => self.state(topic::target_paper(self.name(e)), e, log, out),
            Output::Fusion(result) => out.push(fusion(result, log)),
            Output::Notice(notice) => {
                out.push(record(topic::LOG.into(), Schema::Log, log, notice.t, &log_message(notice)));
            }
            Output::Health(now) => {
                let mut message = health(now, &self.config);
                message.figures.extend(self.figures.figures.clone());
                message.words.extend(self.figures.words.clone());
                out.push(record(topic::HEALTH.into(), Schema::Health, log, now.t, &message));
            }
        }
    }

    fn name(&self, estimate: &TargetEstimate) -> &str {
        &self.config.target[estimate.target].name
    }

    fn state(&self, topic: String, estimate: &TargetEstimate, log: MonoTime, out: &mut Vec<Record>) {
        let message = target_state(estimate, self.name(estimate));
        out.push(record(topic, Schema::TargetState, log, estimate.t_valid, &message));
    }

    fn estimate(&self, estimate: &TargetEstimate, log: MonoTime, out: &mut Vec<Record>) {
        self.state(topic::target_state(self.name(estimate)), estimate, log, out);
        let Some(state) = &estimate.state else { return };
        let name = self.name(estimate);
        let t = estimate.t_valid;
        let covariance = state.covariance.map_or(Vec::new(), |p| {
            // LocationFix wants east, north, up.
            vec![p[(1, 1)], p[(0, 1)], 0.0, p[(0, 1)], p[(0, 0)], 0.0, 0.0, 0.0, 0.0]
        });
        let known = if covariance.is_empty() {
            fox::location_fix::PositionCovarianceType::Unknown
        } else {
            fox::location_fix::PositionCovarianceType::Approximated
        };
        let location = fox::LocationFix {
            timestamp: Some(timestamp(t)),
            frame_id: format!("target/{name}"),
            latitude: state.lat_deg,
            longitude: state.lon_deg,
            altitude: self.datum_height_m,
            position_covariance: covariance,
            position_covariance_type: known.into(),
            ..Default::default()
        };
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

fn stamp(t: MonoTime) -> Option<Timestamp> {
    Some(timestamp(t))
}

fn transform(
    t: MonoTime,
    parent: &str,
    child: &str,
    at: Vector3<f64>,
    parent_from_child: &UnitQuaternion<f64>,
) -> fox::FrameTransform {
    let q = parent_from_child.quaternion();
    fox::FrameTransform {
        timestamp: stamp(t),
        parent_frame_id: parent.into(),
        child_frame_id: child.into(),
        translation: Some(fox::Vector3 { x: at.x, y: at.y, z: at.z }),
        rotation: Some(fox::Quaternion { x: q.i, y: q.j, z: q.k, w: q.w }),
    }
}

fn fix_number(fix: FixKind) -> u32 {
    match fix {
        FixKind::None => 0,
        FixKind::TwoD => 2,
        FixKind::ThreeD => 3,
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

fn attitude(sample: &Stamped<AttitudeSample>, log: MonoTime) -> Record {
    let s = &sample.value;
    let message = wh::Attitude {
        timestamp: stamp(sample.t_valid),
        heading_rad: s.heading,
        heading_is_true: s.heading_is_true,
        pitch_rad: s.tilt.map(|t| t.pitch),
        roll_rad: s.tilt.map(|t| t.roll),
        heard: stamp(sample.t_recv),
    };
    record(topic::COMPASS_ATTITUDE.into(), Schema::Attitude, log, sample.t_valid, &message)
}

/// Everything seen in a frame, as a message.
pub fn detections(
    frame: u32,
    t: MonoTime,
    markers: &[MarkerDetection],
    features: &[FeatureTrack],
) -> wh::Detections {
    let feature = |f: &FeatureTrack| wh::Feature { id: f.id, u: f.px.x, v: f.px.y, sigma_px: f.sigma_px };
    wh::Detections {
        timestamp: stamp(t),
        frame,
        markers: markers.iter().map(marker).collect(),
        features: features.iter().map(feature).collect(),
    }
}

fn marker(m: &MarkerDetection) -> wh::Marker {
    let (kind, family, id, target) = match m.marker {
        MarkerId::Tag { family, id } => ("apriltag", family.name(), id, 0),
        MarkerId::Disc { target, marker } => ("disc", "", marker as u32, target as u32),
    };
    let covariances = match m.corners_px {
        Some(_) => &m.corner_cov_px2[..],
        None => std::slice::from_ref(&m.center_cov_px2),
    };
    wh::Marker {
        kind: kind.into(),
        family: family.into(),
        id,
        hamming: u32::from(m.hamming),
        margin: m.margin,
        center_u: m.center_px.x,
        center_v: m.center_px.y,
        corners: m.corners_px.iter().flatten().flat_map(|c| [c.x, c.y]).collect(),
        covariance_px2: covariances.iter().flat_map(|p| [p[(0, 0)], p[(0, 1)], p[(1, 1)]]).collect(),
        size_px: m.size_px,
        target,
    }
}

/// Overlays: tags as outlines with their number, discs as circles, features as points. Foxglove puts
/// the centre of the top-left pixel at (0.5, 0.5).
fn annotations(t: MonoTime, markers: &[MarkerDetection], features: &[FeatureTrack]) -> fox::ImageAnnotations {
    let at = |u: f64, v: f64| fox::Point2 { x: u + 0.5, y: v + 0.5 };
    let colour = |r, g, b| Some(fox::Color { r, g, b, a: 1.0 });
    let mut overlay = fox::ImageAnnotations { timestamp: stamp(t), ..Default::default() };
    for m in markers {
        match (m.marker, m.corners_px) {
            (MarkerId::Tag { id, .. }, Some(corners)) => {
                overlay.points.push(fox::PointsAnnotation {
                    timestamp: stamp(t),
                    r#type: fox::points_annotation::Type::LineLoop.into(),
                    points: corners.iter().map(|c| at(c.x, c.y)).collect(),
                    outline_color: colour(0.1, 0.9, 0.3),
                    thickness: 2.0,
                    ..Default::default()
                });
                overlay.texts.push(fox::TextAnnotation {
                    timestamp: stamp(t),
                    position: Some(at(m.center_px.x, m.center_px.y)),
                    text: id.to_string(),
                    font_size: 14.0,
                    text_color: colour(0.1, 0.9, 0.3),
                    ..Default::default()
                });
            }
            _ => overlay.circles.push(fox::CircleAnnotation {
                timestamp: stamp(t),
                position: Some(at(m.center_px.x, m.center_px.y)),
                diameter: m.size_px,
                thickness: 2.0,
                outline_color: colour(0.1, 0.9, 0.3),
                ..Default::default()
            }),
        }
    }
    if !features.is_empty() {
        overlay.points.push(fox::PointsAnnotation {
            timestamp: stamp(t),
            r#type: fox::points_annotation::Type::Points.into(),
            points: features.iter().map(|f| at(f.px.x, f.px.y)).collect(),
            outline_color: colour(1.0, 0.7, 0.1),
            thickness: 3.0,
            ..Default::default()
        });
    }
    overlay
}

/// The helicopter's own state, as a message.
pub fn ownship(own: &Ownship) -> wh::Ownship {
    let q = own.ned_from_body.quaternion();
    wh::Ownship {
        timestamp: stamp(own.t_valid),
        frame: own.frame,
        lat_deg: own.lat_deg,
        lon_deg: own.lon_deg,
        height_m: own.height_m,
        north_m: own.position_ned_m.x,
        east_m: own.position_ned_m.y,
        down_m: own.position_ned_m.z,
        vn_mps: own.velocity_ned_mps.x,
        ve_mps: own.velocity_ned_mps.y,
        vd_mps: own.velocity_ned_mps.z,
        qw: q.w,
        qx: q.i,
        qy: q.j,
        qz: q.k,
        position_sigma_m: own.position_sigma_m.as_slice().to_vec(),
        attitude_sigma_rad: own.attitude_sigma_rad.as_slice().to_vec(),
    }
}

fn status(status: TrackStatus) -> wh::TrackStatus {
    match status {
        TrackStatus::Lost => wh::TrackStatus::Lost,
        TrackStatus::Acquiring => wh::TrackStatus::Acquiring,
        TrackStatus::Tracking => wh::TrackStatus::Tracking,
        TrackStatus::Coasting => wh::TrackStatus::Coasting,
    }
}

/// A target's estimate, as a message.
pub fn target_state(estimate: &TargetEstimate, name: &str) -> wh::TargetState {
    let mut message = wh::TargetState {
        timestamp: stamp(estimate.t_valid),
        frame: estimate.frame,
        target: name.into(),
        status: status(estimate.status).into(),
        known: estimate.state.is_some(),
        ..Default::default()
    };
    if let Some(s) = &estimate.state {
        message.north_m = s.north_m;
        message.east_m = s.east_m;
        message.heading_rad = s.heading_rad;
        message.speed_mps = s.speed_mps;
        message.yaw_rate_radps = s.yaw_rate_radps;
        message.lat_deg = s.lat_deg;
        message.lon_deg = s.lon_deg;
        if let Some(p) = &s.covariance {
            message.covariance =
                (0..5).flat_map(|row| (row..5).map(move |column| p[(row, column)])).collect();
        }
    }
    message
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

fn log_message(notice: &Notice) -> fox::Log {
    let level = match notice.kind {
        NoticeKind::FixLost
        | NoticeKind::SourceSilent
        | NoticeKind::TargetLost
        | NoticeKind::FilterReset
        | NoticeKind::FrameUnusable
        | NoticeKind::Dropped
        | NoticeKind::ClockJump
        | NoticeKind::TerrainMissing
        | NoticeKind::BytesRefused => fox::log::Level::Warning,
        _ => fox::log::Level::Info,
    };
    fox::Log {
        timestamp: stamp(notice.t),
        level: level.into(),
        message: notice.detail.clone(),
        name: notice.kind.name().into(),
        ..Default::default()
    }
}

/// Health, as a message.
pub fn health(now: &Health, config: &Config) -> wh::Health {
    let source = |s: &SourceHealth| wh::SourceHealth {
        name: s.source.name().into(),
        rate_hz: s.rate_hz,
        age_ms: s.age.map_or(-1.0, |age| age.ms()),
        total: s.total,
        refused: s.refused,
        dropped: s.dropped,
    };
    let targets = now.targets.iter().map(|t| {
        let name = &config.target[t.last.target].name;
        wh::TargetHealth {
            name: name.clone(),
            status: status(t.last.status).into(),
            frames_seen: t.frames_seen,
            state: Some(target_state(&t.last, name)),
        }
    });
    wh::Health {
        timestamp: stamp(now.t),
        sources: now.sources.iter().map(source).collect(),
        targets: targets.collect(),
        fix: fix_number(now.fix),
        sats: now.sats.unwrap_or(0),
        clock_sigma_ms: now.clock_sigma.map_or(-1.0, |s| s.ms()),
        dispositions: now.dispositions.iter().map(|(d, n)| (d.name().to_owned(), *n)).collect(),
        ..Default::default()
    }
}
