//! A flight's messages as the measurements for calibration and refinement.

use std::collections::BTreeMap;

use nalgebra::{Matrix2, Vector2, Vector3};
use prost_types::Timestamp;

use super::flight::Flight;
use crate::io::proto::{host_time, windhover as wh};
use crate::io::records::to_attitude;
use windhover_base::msg::TagFamily;
use windhover_base::msg::{
    FeatureTrack, FixKind, FrameObservations, GnssEpoch, MarkerDetection, MarkerId, Stamped,
};
use windhover_base::time::{MonoTime, Span, UtcTime};
use windhover_calibrate::boresight::Recording;

/// The raw measurements of a flight, stamped with their times of validity.
pub fn recording(flight: &Flight) -> Recording {
    Recording {
        gnss: flight.epochs.iter().map(|e| stamped(&e.timestamp, &e.heard, epoch(e))).collect(),
        attitude: flight.attitudes.iter().map(|a| stamped(&a.timestamp, &a.heard, to_attitude(a))).collect(),
        frames: flight
            .detections
            .iter()
            .map(|d| (host_time(d.timestamp.as_ref()), d.markers.iter().filter_map(marker).collect()))
            .collect(),
    }
}

/// All inputs for a refinement of the whole flight.
pub fn whole(flight: &Flight) -> windhover_refine::Recording {
    let mut arrivals: BTreeMap<u32, MonoTime> = BTreeMap::new();
    for (number, arrival) in flight.frames.iter().enumerate() {
        arrivals.insert(number as u32, arrival.t_recv);
    }
    let frame = |d: &wh::Detections| {
        let t_valid = host_time(d.timestamp.as_ref());
        let features = d.features.iter().map(|f| FeatureTrack {
            id: f.id,
            px: Vector2::new(f.u, f.v),
            sigma_px: f.sigma_px,
        });
        let markers = d.markers.iter().filter_map(marker).collect();
        // Where the frame itself is not in the recording, its detections were made at about this time.
        let t_recv = arrivals.get(&d.frame).copied().filter(|t| *t >= t_valid).unwrap_or(t_valid + LOOKED_AT);
        let value = FrameObservations { frame: d.frame, markers, features: features.collect() };
        Stamped { t_valid, t_recv, seq: 0, value }
    };
    let Recording { gnss, attitude, .. } = recording(flight);
    windhover_refine::Recording {
        epochs: gnss,
        readings: attitude,
        frames: flight.detections.iter().map(frame).collect(),
        positions: Vec::new(),
        surveyed: Vec::new(),
    }
}

/// Time from a frame's exposure to its detection, where that is not recorded.
const LOOKED_AT: Span = Span::from_ns(60_000_000);

fn stamped<T>(t: &Option<Timestamp>, received: &Option<Timestamp>, value: T) -> Stamped<T> {
    Stamped { t_valid: host_time(t.as_ref()), t_recv: host_time(received.as_ref()), seq: 0, value }
}

fn epoch(e: &wh::GnssEpoch) -> GnssEpoch {
    let fix = match (e.fix, e.rtk()) {
        (2, _) => FixKind::TwoD,
        (3, wh::Rtk::None) => FixKind::ThreeD,
        (3, wh::Rtk::Float) => FixKind::RtkFloat,
        (3, wh::Rtk::Fixed) => FixKind::RtkFixed,
        _ => FixKind::None,
    };
    let velocity = match e.vel_ned_mps[..] {
        [north, east] => Some(Vector3::new(north, east, 0.0)),
        [north, east, down] => Some(Vector3::new(north, east, down)),
        _ => None,
    };
    GnssEpoch {
        utc: e.utc_ns.map(UtcTime::from_unix_ns),
        fix,
        lat_deg: e.lat_deg,
        lon_deg: e.lon_deg,
        alt_msl_m: e.alt_msl_m,
        geoid_m: e.geoid_m,
        vel_ned_mps: velocity,
        vel_has_down: e.vel_ned_mps.len() == 3,
        hpe_m: e.hpe_m,
        vpe_m: e.vpe_m,
        position_sigma_m: three(&e.position_sigma_m),
        velocity_sigma_mps: three(&e.velocity_sigma_mps),
        sats: e.sats,
        hdop: e.hdop,
        ..GnssEpoch::default()
    }
}

fn three(values: &[f64]) -> Option<Vector3<f64>> {
    <[f64; 3]>::try_from(values).ok().map(Vector3::from)
}

/// `None` for kinds and families that this version does not know.
fn marker(m: &wh::Marker) -> Option<MarkerDetection> {
    let id = match m.kind.as_str() {
        "apriltag" => MarkerId::Tag { family: m.family.parse::<TagFamily>().ok()?, id: m.id },
        "disc" => MarkerId::Disc { target: m.target as usize, marker: m.id as usize },
        _ => return None,
    };
    let corner = |k: usize| Some(Vector2::new(*m.corners.get(2 * k)?, *m.corners.get(2 * k + 1)?));
    let covariance = |k: usize| {
        let at = |n: usize| m.covariance_px2.get(3 * k + n).copied().unwrap_or(0.0);
        Matrix2::new(at(0), at(1), at(1), at(2))
    };
    let corners_px = match [corner(0), corner(1), corner(2), corner(3)] {
        [Some(a), Some(b), Some(c), Some(d)] => Some([a, b, c, d]),
        _ => None,
    };
    let of_corners: [Matrix2<f64>; 4] = std::array::from_fn(covariance);
    let tag = corners_px.is_some();
    Some(MarkerDetection {
        marker: id,
        center_px: Vector2::new(m.center_u, m.center_v),
        center_cov_px2: if tag { of_corners.iter().sum::<Matrix2<f64>>() / 16.0 } else { covariance(0) },
        corners_px,
        corner_cov_px2: if tag { of_corners } else { [Matrix2::zeros(); 4] },
        hamming: m.hamming as u8,
        margin: m.margin,
        size_px: m.size_px,
    })
}

#[cfg(test)]
mod tests {
    use prost::Message as _;

    use super::*;
    use crate::io::records::OutputEncoder;
    use windhover_base::msg::{Output, SensorReading};
    use windhover_base::time::MonoTime;

    #[test]
    fn every_kind_of_fix_comes_back_from_the_flight() {
        for fix in [FixKind::None, FixKind::TwoD, FixKind::ThreeD, FixKind::RtkFloat, FixKind::RtkFixed] {
            let t = MonoTime::from_ns(5);
            let value = GnssEpoch { fix, ..GnssEpoch::default() };
            let reading = SensorReading::Gnss(Stamped { t_valid: t, t_recv: t, seq: 0, value });
            let mut records = Vec::new();
            OutputEncoder::new(&[]).output(&Output::Reading(reading), t, &mut records);
            let message = wh::GnssEpoch::decode(&records[0].data[..]).expect("just encoded");
            assert_eq!(epoch(&message).fix, fix);
        }
    }
}
