//! Rates, forces and a second attitude beside the receiver and the compass: from a capture to the filter.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::Vector3;
use prost::Message as _;
use windhover::app::replay;
use windhover::config::Config;
use windhover::io::capture::{CaptureReader, CaptureWriter, attached_config};
use windhover::io::proto::windhover as wh;
use windhover_base::geo::Tilt;
use windhover_base::msg::{AttitudeSample, Event, EventBody, InertialSample, Source};
use windhover_base::settings::{AttitudeConfig, ImuConfig};
use windhover_base::time::Span;

/// The small capture without frames, with level samples of both sources at 50 and 10 Hz; its configuration.
fn record(path: &Path) -> Config {
    let whole = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/captures/follow.mcap");
    let text = attached_config(&whole).unwrap().expect("the capture has its configuration");
    let mut config = Config::parse(&text).unwrap();
    config.imu = Some(ImuConfig { roll_deg: 180.0, force_noise_mps2: 3.0, ..ImuConfig::default() });
    config.attitude = Some(AttitudeConfig { tilt_noise_deg: 10.0, ..AttitudeConfig::default() });
    let events_of_capture = CaptureReader::open(&whole).unwrap().filter_map(|item| item.event);
    let mut events: Vec<Event> =
        events_of_capture.filter(|e| !matches!(e.body, EventBody::Frame(_))).collect();
    let (first, last) = (events[0].t_recv, events[events.len() - 1].t_recv);
    let inertial = InertialSample { rate_rps: Some(Vector3::zeros()), force_mps2: Some(Vector3::z() * 9.8) };
    let tilt = Some(Tilt { pitch: 0.0, roll: 0.0 });
    let attitude = AttitudeSample { heading: None, heading_is_true: true, tilt };
    for k in 0..(50.0 * (last - first).s()) as u32 {
        let t_recv = first + Span::from_s(0.02 * f64::from(k));
        events.push(Event {
            t_recv,
            seq: 0,
            body: EventBody::Inertial { source: Source::Imu, sample: inertial },
        });
        if k % 5 == 0 {
            let body = EventBody::Attitude { source: Source::Attitude, sample: attitude };
            events.push(Event { t_recv, seq: 0, body });
        }
    }
    events.sort_by_key(|event| event.t_recv);
    let mut writer = CaptureWriter::create(path, &config.to_toml().unwrap(), first).unwrap();
    events.iter().for_each(|event| writer.write(event).unwrap());
    writer.finish().unwrap();
    config
}

#[test]
fn samples_reach_the_filter_and_health() {
    let dir = tempfile::tempdir().unwrap();
    let (capture, flight) = (dir.path().join("capture.mcap"), dir.path().join("flight.mcap"));
    let config = record(&capture);
    assert_eq!(replay::config_of(&capture).unwrap(), config, "the sections are attached");
    replay::replay(&capture, &config, Some(&flight), false, &mut |_| {}).unwrap();
    let (mut counts, mut fused, mut health) = (BTreeMap::new(), BTreeMap::new(), Vec::new());
    for item in CaptureReader::open(&flight).unwrap() {
        *counts.entry(item.raw.channel.topic.clone()).or_insert(0) += 1;
        match item.raw.channel.topic.as_str() {
            "/fusion" => {
                let result = wh::Fusion::decode(&item.raw.data[..]).unwrap();
                if result.disposition == "fused" {
                    *fused.entry(result.source).or_insert(0) += 1;
                }
            }
            "/health" => health.push(wh::Health::decode(&item.raw.data[..]).unwrap()),
            _ => {}
        }
    }
    // The flight has every sample, and health tells their rates.
    assert!(counts["/imu/samples"] > 280 && counts["/attitude/samples"] > 55, "{counts:?}");
    let last = health.last().expect("once a second");
    let rate = |name: &str| last.sources.iter().find(|s| s.name == name).map(|s| s.rate_hz);
    assert!(rate("imu").is_some_and(|hz| (48.0..=52.0).contains(&hz)), "{:?}", last.sources);
    assert!(rate("attitude").is_some_and(|hz| (9.0..=11.0).contains(&hz)), "{:?}", last.sources);
    // Rates and forces are fused some ten times a second, whatever their rate is, and so is the attitude.
    for source in ["imu_rate", "imu_force", "attitude_tilt"] {
        let n = fused.get(source).copied().unwrap_or(0);
        assert!((20..=60).contains(&n), "{source}: {fused:?}");
    }
}
