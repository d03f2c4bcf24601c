//! States as Cursor on Target's events, in XML.
//!
//! Source: MITRE, Cursor on Target Message Router User's Guide, and its `event` schema, version 2.0.

use crate::app::ground::view::{Helicopter, Vehicle};
use crate::text::xml;
use windhover_base::time::{Span, UtcTime};

/// A report older than this is not a current position.
const STALE: Span = Span::from_ns(5_000_000_000);
/// Cursor on Target's value for an unknown error.
const UNKNOWN_M: &str = "9999999.0";

/// The content of a report.
struct Report<'a> {
    uid: String,
    kind: &'static str,
    callsign: &'a str,
    place: [f64; 3],
    /// One sigma: circular, linear; `None` where not known.
    errors_m: [Option<f64>; 2],
    course_deg: f64,
    speed_mps: f64,
    remarks: &'a str,
    at: UtcTime,
}

impl Report<'_> {
    fn event(&self, now: UtcTime) -> String {
        let [ce, le] = self.errors_m.map(|error| match error {
            Some(m) if m.is_finite() => format!("{m:.2}"),
            _ => UNKNOWN_M.to_owned(),
        });
        let [lat, lon, hae] = self.place;
        let stale = UtcTime::from_unix_ns(self.at.unix_ns().saturating_add(STALE.ns()));
        format!(
            "<?xml version=\"1.0\" encoding=\"UTF-8\"?><event version=\"2.0\" uid=\"{}\" type=\"{}\" how=\"m-f\" \
             time=\"{now}\" start=\"{}\" stale=\"{stale}\"><point lat=\"{lat:.9}\" lon=\"{lon:.9}\" hae=\"{hae:.3}\" \
             ce=\"{ce}\" le=\"{le}\"/><detail><contact callsign=\"{}\"/><track course=\"{:.2}\" speed=\"{:.3}\"/>\
             <remarks>{}</remarks></detail></event>",
            xml(&self.uid),
            self.kind,
            self.at,
            xml(self.callsign),
            self.course_deg.rem_euclid(360.0),
            self.speed_mps,
            xml(self.remarks)
        )
    }
}

/// The UTC at which a state of this age was valid: by the receiver, else by this computer's clock.
fn time_of(utc: Option<UtcTime>, age: Span, now: UtcTime) -> UtcTime {
    utc.unwrap_or_else(|| UtcTime::from_unix_ns(now.unix_ns().saturating_sub(age.ns())))
}

/// The larger one-sigma of a horizontal covariance.
fn circular_m(nn: f64, ne: f64, ee: f64) -> f64 {
    let (mean, half) = ((nn + ee) / 2.0, ((nn - ee) / 2.0).hypot(ne));
    (mean + half).max(0.0).sqrt()
}

/// A vehicle's report; `None` where its state is not a current position.
pub(super) fn of_vehicle(vehicle: &Vehicle, now: UtcTime) -> Option<String> {
    let s = &vehicle.state;
    if !vehicle.is_current() {
        return None;
    }
    let ce = match s.covariance[..] {
        [nn, ne, _, _, _, ee, ..] => Some(circular_m(nn, ne, ee)),
        _ => None,
    };
    // A vehicle that reverses moves against its heading.
    let back = if s.speed_mps < 0.0 { 180.0 } else { 0.0 };
    let report = Report {
        uid: format!("windhover.{}.{}", vehicle.payload, vehicle.target),
        kind: "a-f-G-E-V",
        callsign: &vehicle.target,
        place: [s.lat_deg, s.lon_deg, s.height_m],
        errors_m: [ce, None],
        course_deg: s.heading_rad.to_degrees() + back,
        speed_mps: s.speed_mps.abs(),
        remarks: vehicle.status,
        at: time_of(vehicle.utc, vehicle.age, now),
    };
    Some(report.event(now))
}

/// A helicopter's report.
pub(super) fn of_helicopter(helicopter: &Helicopter, now: UtcTime) -> String {
    let own = &helicopter.state;
    // Upper triangle of 9×9: north 0, north-east 1, east 9, down 17.
    let (ce, le) = match (&own.covariance[..], &own.position_sigma_m[..]) {
        (p, _) if p.len() == 45 => (Some(circular_m(p[0], p[1], p[9])), Some(p[17].max(0.0).sqrt())),
        (_, [n, e, d]) => (Some(n.max(*e)), Some(*d)),
        _ => (None, None),
    };
    let report = Report {
        uid: format!("windhover.{}", helicopter.payload),
        kind: "a-f-A-M-H-Q",
        callsign: &helicopter.payload,
        place: [own.lat_deg, own.lon_deg, own.height_m],
        errors_m: [ce, le],
        course_deg: own.ve_mps.atan2(own.vn_mps).to_degrees(),
        speed_mps: own.vn_mps.hypot(own.ve_mps),
        remarks: "watching",
        at: time_of(helicopter.utc, helicopter.age, now),
    };
    report.event(now)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::proto::windhover::{Ownship, TargetState};

    fn vehicle(status: &'static str) -> Vehicle {
        let mut covariance = vec![0.0; 15];
        (covariance[0], covariance[1], covariance[5]) = (4.0, 1.5, 4.0);
        let state = TargetState {
            lat_deg: 47.5,
            lon_deg: 8.25,
            height_m: 512.25,
            heading_rad: 0.5,
            speed_mps: -2.0,
            covariance,
            ..TargetState::default()
        };
        Vehicle {
            payload: "bird".into(),
            target: "a<b".into(),
            state,
            status,
            age: Span::from_s(0.5),
            utc: Some(UtcTime::from_unix_ns(1_795_046_445_250_000_000)),
            receiver: None,
            trail: Vec::new(),
        }
    }

    #[test]
    fn a_report_says_where_how_well_and_until_when() {
        let now = UtcTime::from_unix_ns(1_795_046_446_000_000_000);
        let event = of_vehicle(&vehicle("tracking"), now).expect("it is current");
        for part in [
            "uid=\"windhover.bird.a&lt;b\" type=\"a-f-G-E-V\"",
            "start=\"2026-11-19T00:00:45.250Z\" stale=\"2026-11-19T00:00:50.250Z\"",
            "lat=\"47.500000000\" lon=\"8.250000000\" hae=\"512.250\" ce=\"2.35\" le=\"9999999.0\"",
            "course=\"208.65\" speed=\"2.000\"",
        ] {
            assert!(event.contains(part), "{part}: {event}");
        }
        assert!(of_vehicle(&vehicle("lost"), now).is_none());
        let unset = Vehicle { utc: None, ..vehicle("tracking") };
        let event = of_vehicle(&unset, now).expect("it is current");
        assert!(event.contains("start=\"2026-11-19T00:00:45.500Z\""), "{event}");
        let state = Ownship {
            position_sigma_m: vec![1.0, 2.0, 3.0],
            vn_mps: 3.0,
            ve_mps: -4.0,
            ..Ownship::default()
        };
        let own = Helicopter { payload: "bird".into(), state, age: Span::ZERO, utc: None };
        let event = of_helicopter(&own, now);
        assert!(
            event.contains("ce=\"2.00\" le=\"3.00\"") && event.contains("course=\"306.87\" speed=\"5.000\""),
            "{event}"
        );
    }
}
