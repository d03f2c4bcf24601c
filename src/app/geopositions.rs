//! Raw geo-positions of a flight's markers against the truth, as the paper compared them: the latest fix extrapolated
//! by its velocity, the latest compass sample, one pixel; no filter.

use nalgebra::Vector3;

use super::flight::Flight;
use super::recording::recording;
use super::truth::Truth;
use windhover_base::geo::{Geodetic, Ground, LocalFrame, Tilt, locate, rot_z};
use windhover_base::msg::{AttitudeSample, GnssEpoch, MarkerDetection, MarkerId, Stamped};
use windhover_base::settings::{MarkerConfig, Rig};

/// Largest slant range used, metres.
const LIMIT_M: f64 = 500.0;
/// A fix or sample older than this is not extrapolated, seconds.
const OLDEST_S: f64 = 1.0;

/// (north, east) errors, metres, of every detection of a marker of the first target. The truth is that of the target's
/// reference point, or, where it is a single surveyed row, of that point at rest.
pub fn errors(
    flight: &Flight,
    (rig, ground_msl_m): (&Rig, f64),
    declination_rad: f64,
    truth: &Truth,
) -> Vec<[f64; 2]> {
    let recording = recording(flight);
    let Some(target) = rig.target.first() else { return Vec::new() };
    let mut found = Vec::new();
    let (mut fixes, mut samples) = (recording.gnss.iter().peekable(), recording.attitude.iter().peekable());
    let (mut fix, mut sample) = (None, None);
    let numbers = flight.detections.iter().map(|d| d.frame);
    for ((t, markers), number) in recording.frames.iter().zip(numbers) {
        while let Some(next) = fixes.next_if(|f| f.t_valid <= *t) {
            fix = Some(next);
        }
        while let Some(next) = samples.next_if(|s| s.t_valid <= *t) {
            sample = Some(next);
        }
        let (Some(fix), Some(sample), Some(row)) = (fix, sample, truth.at(number)) else { continue };
        if (*t - fix.t_valid).s() > OLDEST_S || (*t - sample.t_valid).s() > OLDEST_S {
            continue;
        }
        let age_s = (*t - fix.t_valid).s();
        for seen in markers {
            let Some(marker) = target.marker.iter().find(|m| is(m, seen)) else { continue };
            let heading = row.heading_rad.unwrap_or(0.0);
            let from_reference = Vector3::from(marker.position_m) - Vector3::x() * target.reference_m;
            let offset = rot_z(heading) * from_reference;
            let at = Geodetic { lat_deg: row.lat_deg, lon_deg: row.lon_deg, height_m: 0.0 };
            found.extend(error(
                (rig, ground_msl_m),
                declination_rad,
                fix,
                (age_s, sample),
                seen,
                (marker, offset, at),
            ));
        }
    }
    found
}

fn is(marker: &MarkerConfig, seen: &MarkerDetection) -> bool {
    matches!(seen.marker, MarkerId::Tag { family, id } if marker.family == Some(family) && marker.id == Some(id))
}

fn error(
    (rig, ground_msl_m): (&Rig, f64),
    declination_rad: f64,
    fix: &Stamped<GnssEpoch>,
    (age_s, sample): (f64, &Stamped<AttitudeSample>),
    seen: &MarkerDetection,
    (marker, offset, truth): (&MarkerConfig, Vector3<f64>, Geodetic),
) -> Option<[f64; 2]> {
    let compass = &rig.compass;
    let (heading, tilt) = (sample.value.heading?, sample.value.tilt?);
    let declination = if sample.value.heading_is_true { 0.0 } else { declination_rad };
    let level = Tilt {
        pitch: tilt.pitch - compass.pitch_offset_deg.to_radians(),
        roll: tilt.roll - compass.roll_offset_deg.to_radians(),
    };
    let heading = heading + declination + compass.yaw_offset_deg.to_radians();
    let ned_from_body = compass.angles.ned_from_body(heading, level)?;
    let (lat_deg, lon_deg, alt) = (fix.value.lat_deg?, fix.value.lon_deg?, fix.value.alt_msl_m?);
    // The local frame of the truth, at the ground: heights are above mean sea level on both sides.
    let frame = LocalFrame::new(Geodetic { height_m: ground_msl_m, ..truth });
    let antenna = frame.ned(Geodetic { lat_deg, lon_deg, height_m: alt })
        + fix.value.vel_ned_mps.unwrap_or_default() * age_s;
    let lever = rig.camera.mount.position() - Vector3::from(rig.gps.antenna_position_m);
    let eye = antenna + ned_from_body * lever;
    let ned_from_camera = ned_from_body * rig.camera.mount.body_from_camera();
    let ground = Ground::Flat { down_m: 0.0 };
    let above_m = -marker.position_m[2];
    let at =
        locate(&rig.camera.intrinsics, &eye, &ned_from_camera, seen.center_px, &ground, above_m, LIMIT_M);
    let off = at.ok()?.ned_m - offset;
    Some([off.x, off.y])
}
