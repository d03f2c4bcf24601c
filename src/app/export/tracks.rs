//! The tracks of a flight: targets and helicopter, as positions over time.

use std::collections::BTreeMap;

use prost::Message as _;

use crate::io::mcap_read::McapReader;
use crate::io::proto::windhover::{Ownship, TargetState};
use crate::io::proto::{host_time, windhover::TrackStatus};
use crate::io::records::topic;
use crate::text::finite;
use windhover_base::time::MonoTime;

/// One position of a track.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(super) struct Point {
    pub(super) t: MonoTime,
    pub(super) lat_deg: f64,
    pub(super) lon_deg: f64,
    pub(super) height_m: Option<f64>,
    pub(super) heading_deg: f64,
    pub(super) speed_mps: Option<f64>,
    pub(super) yaw_rate_dps: Option<f64>,
    pub(super) sigma_m: Option<f64>,
}

impl Point {
    /// Whether it is a valid place and heading on the Earth.
    fn is_a_place(&self) -> bool {
        self.lat_deg.abs() <= 90.0 && self.lon_deg.abs() <= 180.0 && self.heading_deg.is_finite()
    }
}

/// Tracks by name: `target/NAME` and `helicopter`, in order of time; only states that were tracked or predicted and are
/// valid places on the Earth.
pub(super) fn read(reader: &mut McapReader) -> BTreeMap<String, Vec<Point>> {
    let mut tracks: BTreeMap<String, Vec<Point>> = BTreeMap::new();
    for message in reader.by_ref() {
        let name = message.channel.topic.as_str();
        if name == topic::OWNSHIP {
            if let Ok(own) = Ownship::decode(&message.data[..]) {
                tracks.entry("helicopter".into()).or_default().push(ownship_point(&own));
            }
        } else if name.starts_with("/target/")
            && name.ends_with("/state")
            && let Ok(state) = TargetState::decode(&message.data[..])
            && state.known
            && matches!(state.status(), TrackStatus::Tracking | TrackStatus::Coasting)
        {
            tracks.entry(format!("target/{}", state.target)).or_default().push(target_point(&state));
        }
    }
    for points in tracks.values_mut() {
        points.retain(Point::is_a_place);
        points.sort_by_key(|point| point.t);
    }
    tracks.retain(|_, points| !points.is_empty());
    tracks
}

fn ownship_point(o: &Ownship) -> Point {
    let heading = (2.0 * (o.qw * o.qz + o.qx * o.qy)).atan2(1.0 - 2.0 * (o.qy * o.qy + o.qz * o.qz));
    Point {
        t: host_time(o.timestamp.as_ref()),
        lat_deg: o.lat_deg,
        lon_deg: o.lon_deg,
        height_m: finite(o.height_m),
        heading_deg: heading.to_degrees().rem_euclid(360.0),
        speed_mps: finite(o.vn_mps.hypot(o.ve_mps)),
        yaw_rate_dps: None,
        sigma_m: o
            .position_sigma_m
            .first()
            .zip(o.position_sigma_m.get(1))
            .and_then(|(n, e)| finite(n.hypot(*e))),
    }
}

fn target_point(s: &TargetState) -> Point {
    // Terms 0 and 5 of the upper triangle are the variances of north and east.
    let variance = s.covariance.first().zip(s.covariance.get(5)).map(|(n, e)| n + e);
    Point {
        t: host_time(s.timestamp.as_ref()),
        lat_deg: s.lat_deg,
        lon_deg: s.lon_deg,
        height_m: None,
        heading_deg: s.heading_rad.to_degrees().rem_euclid(360.0),
        speed_mps: finite(s.speed_mps),
        yaw_rate_dps: finite(s.yaw_rate_radps.to_degrees()),
        sigma_m: variance.map(f64::sqrt).and_then(finite),
    }
}
