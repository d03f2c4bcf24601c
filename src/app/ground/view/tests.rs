//! What the station shows of a payload as time passes.

use std::time::Duration;

use super::*;
use crate::io::link::Channel;
use crate::io::proto::timestamp;

fn arrival(
    (topic, schema_name): (&str, &str),
    t: MonoTime,
    message: &impl prost::Message,
    arrived: Instant,
) -> Arrival {
    let (topic, schema_name) = (topic.to_owned(), schema_name.to_owned());
    Arrival {
        payload: "alpha".into(),
        run: 1,
        flight: "boot-1".into(),
        number: 0,
        channel: Arc::new(Channel { topic, schema_name, schema: Vec::new() }),
        log_time: t,
        publish_time: t,
        data: message.encode_to_vec(),
        live: true,
        arrived,
    }
}

fn at(s: f64) -> MonoTime {
    MonoTime::from_ns(0) + Span::from_s(s)
}

fn state(s: f64, status: wh::TrackStatus, arrived: Instant) -> Arrival {
    let state = wh::TargetState {
        timestamp: Some(timestamp(at(s))),
        target: "ugv".into(),
        status: status.into(),
        known: true,
        lat_deg: 30.0,
        lon_deg: -85.0,
        ..Default::default()
    };
    arrival(("/target/ugv/state", "windhover.TargetState"), at(s), &state, arrived)
}

fn status() -> PayloadStatus {
    PayloadStatus {
        name: "alpha".into(),
        connected: true,
        address: ([127, 0, 0, 1], 7447).into(),
        rtt_ms: 1.0,
        silent: Duration::ZERO,
        software: "windhover".into(),
        live: 1,
        bytes: 100,
        progress: Default::default(),
    }
}

#[test]
fn a_vehicle_without_news_is_lost_in_every_output() {
    let mut view = View::default();
    let came = Instant::now();
    view.record(&state(100.0, wh::TrackStatus::Tracking, came));
    let line = view.line(&status(), came);
    assert!(line.contains("ugv tracking N 0.00"), "{line}");
    assert!(view.vehicles(came)[0].is_current());
    // When nothing is received any more, whatever the payload's clock shows.
    let now = came + Duration::from_secs(35);
    let line = view.line(&status(), now);
    assert!(line.contains("ugv lost, last known 35 s ago"), "{line}");
    assert!(!line.contains("N 0.00"), "{line}");
    let vehicle = &view.vehicles(now)[0];
    assert_eq!((vehicle.status, vehicle.is_current(), vehicle.age.s().round()), ("lost", false, 35.0));
    // A page that is opened then gets the age of everything.
    let link: Value = serde_json::from_str(&view.link(&[status()], 1.0, now)).expect("JSON");
    assert_eq!(link["payloads"][0]["now"].as_f64().map(f64::round), Some(135_000.0));
    assert_eq!(view.history().last().map(|text| text.contains("\"k\":\"link\"")), Some(true));
}

#[test]
fn a_camera_that_dies_makes_the_vehicle_old_while_health_goes_on() {
    let mut view = View::default();
    let came = Instant::now();
    view.record(&state(100.0, wh::TrackStatus::Tracking, came));
    let utc_minus_host_ns = Some(1_795_000_000_000_000_000);
    let health =
        wh::Health { timestamp: Some(timestamp(at(110.0))), utc_minus_host_ns, ..Default::default() };
    view.record(&arrival(("/health", "windhover.Health"), at(110.0), &health, came));
    let vehicle = &view.vehicles(came)[0];
    assert_eq!((vehicle.status, vehicle.age.s().round()), ("lost", 10.0));
    assert_eq!(vehicle.utc.map(UtcTime::unix_ns), Some(1_795_000_100_000_000_000));
    let link: Value = serde_json::from_str(&view.link(&[status()], 1.0, came)).expect("JSON");
    assert_eq!(link["payloads"][0]["utc_ms"], json!(1_795_000_000_000.0));
}
