//! One function for each message of a vehicle, in the units of MAVLink's definitions (`common.xml`, `development.xml`).

use mavlink::dialects::development::*;
use nalgebra::{UnitQuaternion, Vector3};

use windhover_base::msg::TrackStatus;
use windhover_base::time::Span;

use super::report::{Sighting, VehicleReport, level, wxyz};
use crate::config::LandingFrame;

/// Version field of HEARTBEAT.
const VERSION: u8 = 3;
/// FOLLOW_TARGET contains position (bit 0), velocity (1), acceleration (2), attitude and rates (3).
const FOLLOW_CAPABILITIES: u8 = 0b1111;

/// HEARTBEAT of a vehicle with this track: active while it is seen, critical while it is predicted.
pub fn heartbeat(status: TrackStatus) -> MavMessage {
    let system_status = match status {
        TrackStatus::Tracking => MavState::MAV_STATE_ACTIVE,
        TrackStatus::Coasting => MavState::MAV_STATE_CRITICAL,
        TrackStatus::Acquiring | TrackStatus::Lost => MavState::MAV_STATE_STANDBY,
    };
    beat(MavType::MAV_TYPE_GROUND_ROVER, MavAutopilot::MAV_AUTOPILOT_GENERIC, system_status)
}

/// HEARTBEAT of a component that is not an autopilot.
pub fn heartbeat_of(mavtype: MavType) -> MavMessage {
    beat(mavtype, MavAutopilot::MAV_AUTOPILOT_INVALID, MavState::MAV_STATE_ACTIVE)
}

fn beat(mavtype: MavType, autopilot: MavAutopilot, system_status: MavState) -> MavMessage {
    MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        custom_mode: 0,
        mavtype,
        autopilot,
        base_mode: MavModeFlag::empty(),
        system_status,
        mavlink_version: VERSION,
    })
}

/// GLOBAL_POSITION_INT: altitude of the ground under the vehicle; its height above the ground is 0.
pub fn global_position_int(report: &VehicleReport) -> MavMessage {
    let v = report.velocity();
    let centi = |mps: f64| (mps * 100.0).round().clamp(-32_768.0, 32_767.0) as i16;
    let heading = report.state.heading_rad.to_degrees().rem_euclid(360.0);
    MavMessage::GLOBAL_POSITION_INT(GLOBAL_POSITION_INT_DATA {
        time_boot_ms: ms(report.now) as u32,
        lat: degrees_e7(report.place_deg.0),
        lon: degrees_e7(report.place_deg.1),
        alt: (report.alt_msl_m * 1e3).round() as i32,
        relative_alt: 0,
        vx: centi(v.x),
        vy: centi(v.y),
        vz: centi(v.z),
        hdg: ((heading * 100.0).round() as u32 % 36_000) as u16,
    })
}

/// ATTITUDE: level, as assumed for a ground vehicle.
pub fn attitude(report: &VehicleReport) -> MavMessage {
    MavMessage::ATTITUDE(ATTITUDE_DATA {
        time_boot_ms: ms(report.now) as u32,
        yaw: report.state.heading_rad as f32,
        yawspeed: report.state.yaw_rate_radps as f32,
        ..ATTITUDE_DATA::DEFAULT
    })
}

/// FOLLOW_TARGET. `position_cov` is the one-sigma of the horizontal position in metres, 0 (no height), 0.
pub fn follow_target(report: &VehicleReport) -> MavMessage {
    MavMessage::FOLLOW_TARGET(FOLLOW_TARGET_DATA {
        timestamp: ms(report.now),
        lat: degrees_e7(report.place_deg.0),
        lon: degrees_e7(report.place_deg.1),
        alt: report.alt_msl_m as f32,
        vel: floats(&report.velocity()),
        acc: floats(&report.acceleration()),
        attitude_q: wxyz(&level(report.state.heading_rad)),
        rates: [0.0, 0.0, report.state.yaw_rate_radps as f32],
        position_cov: [report.sigma_m as f32, 0.0, 0.0],
        est_capabilities: FOLLOW_CAPABILITIES,
        ..FOLLOW_TARGET_DATA::DEFAULT
    })
}

/// LANDING_TARGET at the frame's exposure: the vector to the vehicle, and the same as angles of a camera that looks
/// down with its top forward (`tan angle_x = right/down`, `tan angle_y = −forward/down`).
pub fn landing_target(report: &VehicleReport, seen: &Sighting, frame: LandingFrame) -> MavMessage {
    let (from_ned, frame) = match frame {
        LandingFrame::Body => (seen.ned_from_body.inverse(), MavFrame::MAV_FRAME_BODY_FRD),
        LandingFrame::Local => {
            (level(heading_of(&seen.ned_from_body)).inverse(), MavFrame::MAV_FRAME_LOCAL_FRD)
        }
    };
    let at = from_ned * seen.offset_ned_m;
    let distance = at.norm();
    let size = 2.0 * (0.5 * report.size_m).atan2(distance.max(0.1));
    MavMessage::LANDING_TARGET(LANDING_TARGET_DATA {
        time_usec: us(seen.at),
        angle_x: at.y.atan2(at.z) as f32,
        angle_y: (-at.x).atan2(at.z) as f32,
        distance: distance as f32,
        size_x: size as f32,
        size_y: size as f32,
        target_num: report.number,
        frame,
        x: at.x as f32,
        y: at.y as f32,
        z: at.z as f32,
        q: wxyz(&(from_ned * level(seen.heading_rad))),
        mavtype: LandingTargetType::LANDING_TARGET_TYPE_VISION_FIDUCIAL,
        position_valid: MavBool::MAV_BOOL_TRUE,
    })
}

/// TARGET_RELATIVE at the frame's exposure: from the helicopter, in north, east, down.
pub fn target_relative(report: &VehicleReport, seen: &Sighting) -> MavMessage {
    let (across, down) = (seen.sigma_m.0 as f32, seen.sigma_m.1 as f32);
    MavMessage::TARGET_RELATIVE(TARGET_RELATIVE_DATA {
        timestamp: us(seen.at),
        x: seen.offset_ned_m.x as f32,
        y: seen.offset_ned_m.y as f32,
        z: seen.offset_ned_m.z as f32,
        pos_std: [across, across, down],
        yaw_std: report.sigmas()[0] as f32,
        q_target: wxyz(&level(seen.heading_rad)),
        q_sensor: [0.0; 4],
        id: report.number,
        frame: TargetObsFrame::TARGET_OBS_FRAME_LOCAL_OFFSET_NED,
        mavtype: LandingTargetType::LANDING_TARGET_TYPE_VISION_FIDUCIAL,
    })
}

/// TARGET_ABSOLUTE at the moment of sending; velocity and acceleration are in the vehicle's own axes.
pub fn target_absolute(report: &VehicleReport) -> MavMessage {
    let q = level(report.state.heading_rad);
    let [_, speed, _] = report.sigmas();
    let place = report.sigma_m as f32;
    MavMessage::TARGET_ABSOLUTE(TARGET_ABSOLUTE_DATA {
        timestamp: us(report.now),
        lat: degrees_e7(report.place_deg.0),
        lon: degrees_e7(report.place_deg.1),
        alt: report.alt_msl_m as f32,
        vel: floats(&(q.inverse() * report.velocity())),
        acc: floats(&(q.inverse() * report.acceleration())),
        q_target: wxyz(&q),
        rates: [0.0, 0.0, report.state.yaw_rate_radps as f32],
        position_std: [place, place],
        vel_std: [speed as f32, speed as f32, 0.0],
        acc_std: [0.0; 3],
        id: report.number,
        sensor_capabilities: TargetAbsoluteSensorCapabilityFlags::all(),
    })
}

/// ODOMETRY of the vehicle: NED of the datum, velocity in its own axes.
pub fn odometry(report: &VehicleReport, down_m: f64) -> MavMessage {
    let q = level(report.state.heading_rad);
    let v = q.inverse() * report.velocity();
    let mut pose = [0.0; 21];
    let mut motion = [0.0; 21];
    if let Some(p) = &report.state.covariance {
        // Upper triangle row by row of (x, y, z, roll, pitch, yaw): x and y are at 0, 1 and 6, yaw at 5, 10 and 20.
        for (at, (i, j)) in [(0, (0, 0)), (1, (0, 1)), (6, (1, 1)), (5, (0, 2)), (10, (1, 2)), (20, (2, 2))] {
            pose[at] = p[(i, j)] as f32;
        }
        motion[0] = p[(3, 3)] as f32;
        motion[20] = p[(4, 4)] as f32;
    }
    MavMessage::ODOMETRY(ODOMETRY_DATA {
        time_usec: us(report.now),
        x: report.state.north_m as f32,
        y: report.state.east_m as f32,
        z: down_m as f32,
        q: wxyz(&q),
        vx: v.x as f32,
        vy: v.y as f32,
        vz: v.z as f32,
        yawspeed: report.state.yaw_rate_radps as f32,
        pose_covariance: pose,
        velocity_covariance: motion,
        frame_id: MavFrame::MAV_FRAME_LOCAL_NED,
        child_frame_id: MavFrame::MAV_FRAME_BODY_FRD,
        estimator_type: MavEstimatorType::MAV_ESTIMATOR_TYPE_VISION,
        ..ODOMETRY_DATA::DEFAULT
    })
}

/// Whether the camera tracks, and how.
fn tracking(report: &VehicleReport) -> CameraTrackingStatusFlags {
    match report.seen {
        true => CameraTrackingStatusFlags::CAMERA_TRACKING_STATUS_FLAGS_ACTIVE,
        false => CameraTrackingStatusFlags::CAMERA_TRACKING_STATUS_FLAGS_COASTING,
    }
}

/// CAMERA_TRACKING_GEO_STATUS.
pub fn camera_tracking_geo_status(report: &VehicleReport) -> MavMessage {
    let v = report.velocity();
    let [heading, speed, _] = report.sigmas();
    MavMessage::CAMERA_TRACKING_GEO_STATUS(CAMERA_TRACKING_GEO_STATUS_DATA {
        lat: degrees_e7(report.place_deg.0),
        lon: degrees_e7(report.place_deg.1),
        alt: report.alt_msl_m as f32,
        h_acc: report.sigma_m as f32,
        v_acc: f32::NAN,
        vel_n: v.x as f32,
        vel_e: v.y as f32,
        vel_d: v.z as f32,
        vel_acc: speed as f32,
        dist: report.sighting.map_or(f32::NAN, |seen| seen.offset_ned_m.norm() as f32),
        hdg: report.state.heading_rad as f32,
        hdg_acc: heading as f32,
        tracking_status: tracking(report),
        camera_device_id: 0,
    })
}

/// CAMERA_TRACKING_IMAGE_STATUS: a box around the vehicle's markers.
pub fn camera_tracking_image_status(report: &VehicleReport) -> MavMessage {
    let [left, top, right, bottom] = report.in_picture.unwrap_or([f32::NAN; 4]);
    let mode = match report.in_picture {
        Some(_) => CameraTrackingMode::CAMERA_TRACKING_MODE_RECTANGLE,
        None => CameraTrackingMode::CAMERA_TRACKING_MODE_NONE,
    };
    MavMessage::CAMERA_TRACKING_IMAGE_STATUS(CAMERA_TRACKING_IMAGE_STATUS_DATA {
        point_x: 0.5 * (left + right),
        point_y: 0.5 * (top + bottom),
        radius: 0.5 * (right - left),
        rec_top_x: left,
        rec_top_y: top,
        rec_bottom_x: right,
        rec_bottom_y: bottom,
        tracking_status: tracking(report),
        tracking_mode: mode,
        target_data: CameraTrackingTargetData::CAMERA_TRACKING_TARGET_DATA_IN_STATUS,
        camera_device_id: 0,
    })
}

/// Whole milliseconds, to the nearest.
fn ms(t: Span) -> u64 {
    u64::try_from((t.ns() + 500_000) / 1_000_000).unwrap_or(0)
}

fn us(t: Span) -> u64 {
    u64::try_from(t.ns() / 1_000).unwrap_or(0)
}

fn degrees_e7(degrees: f64) -> i32 {
    (degrees * 1e7).round() as i32
}

fn floats(v: &Vector3<f64>) -> [f32; 3] {
    [v.x, v.y, v.z].map(|x| x as f32)
}

fn heading_of(ned_from_body: &UnitQuaternion<f64>) -> f64 {
    ned_from_body.euler_angles().2
}
