//! Protobuf messages of the pipeline's outputs: our own, and Foxglove's where a schema exists.

use nalgebra::{SMatrix, UnitQuaternion, Vector3};
use prost_types::Timestamp;

use crate::io::proto::{foxglove as fox, timestamp, windhover as wh};
use windhover_base::msg::{
    AttitudeSample, FeatureTrack, FixKind, Health, InertialSample, MarkerDetection, MarkerId, MisfitWords,
    Notice, NoticeKind, Ownship, SourceHealth, TargetEstimate, TargetState, TrackStatus,
};
use windhover_base::time::MonoTime;

pub(super) fn stamp(t: MonoTime) -> Option<Timestamp> {
    Some(timestamp(t))
}

/// A transform between frames.
pub fn transform(
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

pub(super) fn fix_number(fix: FixKind) -> u32 {
    match fix {
        FixKind::None => 0,
        FixKind::TwoD => 2,
        FixKind::ThreeD | FixKind::RtkFloat | FixKind::RtkFixed => 3,
    }
}

pub(super) fn rtk(fix: FixKind) -> wh::Rtk {
    match fix {
        FixKind::RtkFloat => wh::Rtk::Float,
        FixKind::RtkFixed => wh::Rtk::Fixed,
        FixKind::None | FixKind::TwoD | FixKind::ThreeD => wh::Rtk::None,
    }
}

/// All detections of a frame, as a message.
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

/// Overlays: tags as outlines with their number, discs as circles, features as points. In Foxglove the centre of the
/// top-left pixel is (0.5, 0.5).
pub(super) fn annotations(
    t: MonoTime,
    markers: &[MarkerDetection],
    features: &[FeatureTrack],
) -> fox::ImageAnnotations {
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

/// An attitude as a device reported it, valid at `t`.
pub(super) fn attitude(t: MonoTime, t_recv: MonoTime, sample: &AttitudeSample) -> wh::Attitude {
    wh::Attitude {
        timestamp: stamp(t),
        heading_rad: sample.heading,
        heading_is_true: sample.heading_is_true,
        pitch_rad: sample.tilt.map(|t| t.pitch),
        roll_rad: sample.tilt.map(|t| t.roll),
        heard: stamp(t_recv),
    }
}

/// Rates and forces as a sensor reported them, received at `t`.
pub(super) fn inertial(t: MonoTime, sample: &InertialSample) -> wh::Inertial {
    let figures = |value: Option<Vector3<f64>>| value.map_or(Vec::new(), |v| v.as_slice().to_vec());
    wh::Inertial {
        timestamp: stamp(t),
        rate_rps: figures(sample.rate_rps),
        force_mps2: figures(sample.force_mps2),
    }
}

/// A target's place for maps; `frame_id` is its own frame.
pub fn location(t: MonoTime, frame_id: &str, state: &TargetState) -> fox::LocationFix {
    let covariance = state.covariance.map_or(Vec::new(), |p| {
        // LocationFix has the order east, north, up.
        vec![p[(1, 1)], p[(0, 1)], 0.0, p[(0, 1)], p[(0, 0)], 0.0, 0.0, 0.0, 0.0]
    });
    let known = if covariance.is_empty() {
        fox::location_fix::PositionCovarianceType::Unknown
    } else {
        fox::location_fix::PositionCovarianceType::Approximated
    };
    fox::LocationFix {
        timestamp: stamp(t),
        frame_id: frame_id.into(),
        latitude: state.lat_deg,
        longitude: state.lon_deg,
        altitude: state.height_m,
        position_covariance: covariance,
        position_covariance_type: known.into(),
        ..Default::default()
    }
}

/// The helicopter's own state, as a message.
pub fn ownship(own: &Ownship) -> wh::Ownship {
    let q = own.ned_from_body.quaternion();
    wh::Ownship {
        timestamp: stamp(own.t_valid),
        frame: own.frame.unwrap_or(0),
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
        position_sigma_m: own.position_sigma_m().as_slice().to_vec(),
        attitude_sigma_rad: own.attitude_sigma_rad().as_slice().to_vec(),
        covariance: upper_triangle(&own.covariance),
        between_frames: own.frame.is_none(),
    }
}

/// Row by row.
fn upper_triangle<const N: usize>(p: &SMatrix<f64, N, N>) -> Vec<f64> {
    (0..N).flat_map(|row| (row..N).map(move |column| p[(row, column)])).collect()
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
        message.height_m = s.height_m;
        message.relative_sigma_m = s.relative_sigma_m;
        if let Some(p) = &s.covariance {
            message.covariance = upper_triangle(p);
        }
    }
    message
}

pub(super) fn log_message(notice: &Notice) -> fox::Log {
    let level = match notice.kind {
        NoticeKind::FixLost
        | NoticeKind::SourceSilent
        | NoticeKind::TargetLost
        | NoticeKind::FilterReset
        | NoticeKind::FrameUnusable
        | NoticeKind::FrameDamaged
        | NoticeKind::Dropped
        | NoticeKind::ClockJump
        | NoticeKind::PositionsUnused
        | NoticeKind::PulseUnused
        | NoticeKind::TerrainMissing
        | NoticeKind::ModelMisfit
        | NoticeKind::MarkerSeenTwice
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

fn misfit(words: &MisfitWords) -> wh::Misfit {
    let MisfitWords { source, kind, figure, cause, advice } = words.clone();
    wh::Misfit { source, kind: kind.into(), figure, cause, advice }
}

/// Health, as a message; `names` are the targets'.
pub fn health(now: &Health, names: &[String]) -> wh::Health {
    let source = |s: &SourceHealth| wh::SourceHealth {
        name: s.source.name().into(),
        rate_hz: s.rate_hz,
        age_ms: s.age.map_or(-1.0, |age| age.ms()),
        total: s.total,
        refused: s.refused,
        dropped: s.dropped,
    };
    let targets = now.targets.iter().map(|t| {
        let name = &names[t.last.target];
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
        hdop: now.hdop,
        geoid_m: now.geoid_m,
        clock_sigma_ms: now.clock_sigma.map_or(-1.0, |s| s.ms()),
        utc_minus_host_ns: now.utc_minus_host.map(|ahead| ahead.ns()),
        misfits: now.misfits.iter().map(misfit).collect(),
        dispositions: now.dispositions.iter().map(|(d, n)| (d.name().to_owned(), *n)).collect(),
        ..Default::default()
    }
}
