//! What a receiver on this computer gets for a vehicle that is seen, then covered, and for a camera that fails.

use std::net::UdpSocket;

use mavlink::MessageData as _;
use mavlink::dialects::development::*;
use nalgebra::{SMatrix, UnitQuaternion, Vector3};

use super::vehicle::tests::state_of;
use super::*;
use crate::config::{Config, MavlinkConfig, MavlinkMessage};
use windhover_base::geo::Geodetic;
use windhover_base::msg::{
    AutopilotPosition, EstimatorOutput, GnssEpoch, Ownship, SensorReading, Stamped, TargetEstimate,
    TrackStatus,
};

const START: MonoTime = MonoTime::from_ns(1_000_000_000);
const DATUM: Geodetic = Geodetic { lat_deg: 30.0, lon_deg: -85.0, height_m: 6.0 };

/// A sender of two targets, and the socket that it sends to.
struct Bench {
    sender: MavlinkSender,
    receiver: UdpSocket,
}

impl Bench {
    fn new() -> Self {
        Self::sending(MavlinkConfig::default().messages)
    }

    fn sending(messages: Vec<MavlinkMessage>) -> Self {
        Self::of(MavlinkConfig { messages, ..MavlinkConfig::default() })
    }

    fn of(mavlink: MavlinkConfig) -> Self {
        let receiver = UdpSocket::bind("127.0.0.1:0").expect("a socket");
        receiver.set_nonblocking(true).expect("set");
        let address = receiver.local_addr().expect("an address").to_string();
        let send_to = vec![address];
        let mavlink = MavlinkConfig { enabled: true, send_to, ..mavlink };
        let mut config = Config::parse(include_str!("../../../config/windhover.toml")).expect("valid");
        config.mavlink = mavlink;
        config.target.push(config.target[0].clone());
        let mut sender = MavlinkSender::open(&config, ToAutopilot::default()).expect("opened");
        let names = sender.unresolved(START).expect("to be resolved");
        sender.found(look_up(names));
        sender.output(&Output::Datum(START, DATUM));
        Self { sender, receiver }
    }

    fn estimate(&mut self, s: f64, status: TrackStatus, relative_sigma_m: f64) {
        let state = state_of(8.5, Some(relative_sigma_m));
        let state = (status != TrackStatus::Lost).then_some(state);
        let estimate =
            TargetEstimate { t_valid: START + Span::from_s(s), frame: 1, target: 0, status, state };
        self.sender.output(&Output::Estimator(EstimatorOutput::Estimate(estimate)));
    }

    fn own(&mut self, s: f64) {
        let own = Ownship {
            t_valid: START + Span::from_s(s),
            frame: None,
            position_ned_m: Vector3::new(-2.0, 2.0, -10.0),
            velocity_ned_mps: Vector3::zeros(),
            ned_from_body: UnitQuaternion::from_euler_angles(0.0, 0.0, std::f64::consts::FRAC_PI_2),
            lat_deg: 0.0,
            lon_deg: 0.0,
            height_m: 16.0,
            covariance: SMatrix::identity(),
        };
        self.sender.output(&Output::Estimator(EstimatorOutput::Ownship(own)));
    }

    /// The autopilot's position is this place of the datum's frame and this altitude.
    fn autopilot(&mut self, s: f64, north_m: f64, east_m: f64, alt_msl_m: f64) {
        let frame = windhover_base::geo::LocalFrame::new(DATUM);
        let place = frame.geodetic(&Vector3::new(north_m, east_m, 0.0));
        let value = AutopilotPosition {
            boot: Span::from_s(100.0 + s),
            lat_deg: place.lat_deg,
            lon_deg: place.lon_deg,
            alt_msl_m,
            vel_ned_mps: Vector3::zeros(),
        };
        let t = START + Span::from_s(s);
        let stamped = Stamped { t_valid: t, t_recv: t, seq: 0, value };
        self.sender.output(&Output::Reading(SensorReading::Autopilot(stamped)));
    }

    /// The messages of these kinds that are sent at `s`, of the first target or the camera.
    fn messages(&mut self, s: f64) -> Vec<MavMessage> {
        self.sender.send(START + Span::from_s(s));
        let (mut buffer, mut frames) = ([0; 512], Vec::new());
        while let Ok(length) = self.receiver.recv(&mut buffer) {
            MavlinkFrames::default().push(&buffer[..length], &mut frames);
        }
        frames.into_iter().filter(|frame| frame.system != 43).map(|frame| frame.message).collect()
    }

    /// The frames sent at `s`: system, sequence, message, payload.
    fn sent(&mut self, s: f64) -> Vec<(u8, u8, u32, Vec<u8>)> {
        self.sender.send(START + Span::from_s(s));
        let mut buffer = [0; 512];
        let mut all = Vec::new();
        while let Ok(length) = self.receiver.recv(&mut buffer) {
            let b = &buffer[..length];
            let id = u32::from_le_bytes([b[7], b[8], b[9], 0]);
            all.push((b[5], b[4], id, b[10..10 + usize::from(b[1])].to_vec()));
        }
        all
    }
}

/// MAV_STATE of the first target's heartbeat, where there is one, and whether a position of it was sent.
fn first_target(sent: &[(u8, u8, u32, Vec<u8>)]) -> (Option<u8>, bool) {
    let first = |id| sent.iter().find(move |(system, _, kind, _)| (*system, *kind) == (42, id));
    (first(0).map(|(.., payload)| payload[7]), first(33).is_some() && first(144).is_some())
}

const ACTIVE: Option<u8> = Some(4);
const CRITICAL: Option<u8> = Some(5);
const STANDBY: Option<u8> = Some(3);

#[test]
fn a_dead_camera_ends_the_positions_and_the_heartbeats_tell() {
    let mut bench = Bench::new();
    assert_eq!(first_target(&bench.sent(0.0)), (STANDBY, false));
    bench.estimate(1.0, TrackStatus::Tracking, 0.1);
    assert_eq!(first_target(&bench.sent(1.05)), (ACTIVE, true));
    // When no more outputs come, then the last state is not sent without end.
    assert_eq!(first_target(&bench.sent(1.4)), (None, true));
    assert_eq!(first_target(&bench.sent(2.1)), (STANDBY, false));
    assert_eq!(first_target(&bench.sent(32.1)), (STANDBY, false));
}

/// A slow rate is that of positions; a listener still gets a heartbeat once a second.
#[test]
fn a_slow_rate_slows_no_heartbeat() {
    let mut bench = Bench::of(MavlinkConfig { rate_hz: 0.2, ..MavlinkConfig::default() });
    let (mut beats, mut positions, mut s) = (0, 0, 0.0);
    let step = bench.sender.every().s();
    while s < 30.0 {
        bench.estimate(s, TrackStatus::Tracking, 0.1);
        let (beat, position) = first_target(&bench.sent(s + 0.01));
        (beats, positions) = (beats + u32::from(beat == ACTIVE), positions + u32::from(position));
        s += step;
    }
    assert!(
        (29..=31).contains(&beats) && (5..=7).contains(&positions),
        "{beats} beats, {positions} positions"
    );
}

#[test]
fn a_covered_tag_is_predicted_for_a_second() {
    let mut bench = Bench::new();
    bench.estimate(1.0, TrackStatus::Tracking, 0.1);
    assert_eq!(first_target(&bench.sent(1.0)), (ACTIVE, true));
    bench.estimate(1.9, TrackStatus::Coasting, 0.3);
    assert_eq!(first_target(&bench.sent(2.0)), (CRITICAL, true));
    bench.estimate(3.0, TrackStatus::Coasting, 0.5);
    assert_eq!(first_target(&bench.sent(3.0)), (STANDBY, false));
    bench.estimate(4.0, TrackStatus::Tracking, 0.1);
    assert_eq!(first_target(&bench.sent(4.0)), (ACTIVE, true));
}

#[test]
fn what_is_not_known_well_enough_is_no_position() {
    let mut bench = Bench::new();
    bench.estimate(1.0, TrackStatus::Tracking, 2.5);
    assert_eq!(first_target(&bench.sent(1.0)), (STANDBY, false));
}

#[test]
fn each_system_counts_its_own_messages_and_the_ground_is_the_terrain_there() {
    let mut bench = Bench::new();
    bench.estimate(1.0, TrackStatus::Tracking, 0.1);
    let sent: Vec<_> = [1.0, 1.2, 2.0].into_iter().flat_map(|s| bench.sent(s)).collect();
    for system in [42, 43] {
        let numbers: Vec<u8> = sent.iter().filter(|(of, ..)| *of == system).map(|(_, n, ..)| *n).collect();
        let whole: Vec<u8> = (0..).take(numbers.len()).collect();
        assert_eq!(numbers, whole, "system {system}");
    }
    let (.., position) = sent.iter().find(|(.., id, _)| *id == 33).expect("a position");
    assert_eq!(
        i32::from_le_bytes([position[12], position[13], position[14], position[15]]),
        35_500,
        "33 m, and 2.5 m higher"
    );
}

#[test]
fn after_a_restart_nothing_is_sent_before_it_is_known_anew() {
    let mut bench = Bench::new();
    bench.estimate(1.0, TrackStatus::Tracking, 0.1);
    assert_eq!(first_target(&bench.sent(1.0)), (ACTIVE, true));
    // When the program starts again, then it is on standby, and counts from the first message again.
    let mut again = Bench::new();
    let sent = again.sent(2.0);
    assert_eq!(first_target(&sent), (STANDBY, false));
    assert_eq!(sent[0].1, 0);
    again.estimate(3.0, TrackStatus::Acquiring, 0.1);
    assert_eq!(first_target(&again.sent(3.0)), (STANDBY, false));
    again.estimate(4.0, TrackStatus::Tracking, 0.1);
    assert_eq!(first_target(&again.sent(4.0)), (ACTIVE, true));
}

#[test]
fn after_a_cut_of_the_link_the_present_is_sent_and_nothing_of_before() {
    let mut bench = Bench::new();
    bench.estimate(1.0, TrackStatus::Tracking, 0.1);
    assert_eq!(first_target(&bench.sent(1.0)), (ACTIVE, true));
    let address = bench.receiver.local_addr().expect("an address");
    bench.receiver = UdpSocket::bind("127.0.0.1:0").expect("another");
    for tenths in 11..40 {
        let s = 0.1 * f64::from(tenths);
        bench.estimate(s, TrackStatus::Tracking, 0.1);
        bench.sender.send(START + Span::from_s(s));
    }
    bench.receiver = UdpSocket::bind(address).expect("the same address again");
    bench.receiver.set_nonblocking(true).expect("set");
    bench.estimate(4.0, TrackStatus::Tracking, 0.1);
    let sent = bench.sent(4.0);
    assert!(first_target(&sent).1);
    let positions = sent.iter().filter(|(system, _, kind, _)| (*system, *kind) == (42, 33)).count();
    assert_eq!(positions, 1, "one, of the present: {sent:?}");
}

#[test]
fn the_state_is_brought_to_the_moment_of_sending() {
    let mut bench = Bench::new();
    bench.estimate(1.0, TrackStatus::Tracking, 0.1);
    let messages = bench.messages(1.2);
    let position = messages.iter().find_map(|m| match m {
        MavMessage::GLOBAL_POSITION_INT(position) => Some(position),
        _ => None,
    });
    let position = position.expect("a position");
    // It was at (1, 2) and drives at 1 m/s on 0.1 rad.
    let frame = windhover_base::geo::LocalFrame::new(DATUM);
    let place = frame.geodetic(&Vector3::new(1.0 + 0.2 * 0.1_f64.cos(), 2.0 + 0.2 * 0.1_f64.sin(), 0.0));
    assert!((f64::from(position.lat) - place.lat_deg * 1e7).abs() < 1.0, "{position:?}");
    assert!((f64::from(position.lon) - place.lon_deg * 1e7).abs() < 1.0, "{position:?}");
    assert_eq!((position.vx, position.vy, position.vz), (100, 10, 0));
    assert_eq!(position.hdg, 573);
}

#[test]
fn the_vehicle_is_reported_relative_to_the_autopilots_own_position() {
    // Given an autopilot whose receiver differs from ours by 2 m east, and whose altitude shows the ground 5 m lower
    // than configured.
    let mut bench = Bench::sending(vec![MavlinkMessage::FollowTarget, MavlinkMessage::LandingTarget]);
    for k in 0..10 {
        let s = 0.1 * f64::from(k);
        bench.autopilot(s, -2.0, 4.0, 38.0);
        bench.own(s + 0.05);
    }
    bench.own(1.0);
    bench.estimate(1.0, TrackStatus::Tracking, 0.1);
    let messages = bench.messages(1.0);
    let follow = messages.iter().find_map(|m| match m {
        MavMessage::FOLLOW_TARGET(follow) => Some(follow),
        _ => None,
    });
    let follow = follow.expect("it is used");
    let frame = windhover_base::geo::LocalFrame::new(DATUM);
    let place = frame.geodetic(&Vector3::new(1.0, 4.0, 0.0));
    assert!((f64::from(follow.lon) - place.lon_deg * 1e7).abs() < 2.0, "2 m farther east: {follow:?}");
    // The helicopter is 16 m high by our datum, the vehicle 8.5: 7.5 m below the autopilot's own 38 m.
    assert!((follow.alt - 30.5).abs() < 1e-3, "{}", follow.alt);
    assert!((follow.position_cov[0] - 0.1).abs() < 1e-6, "relative to the helicopter");
    assert_eq!(follow.timestamp, 101_000, "on the autopilot's clock");
    let landing = messages.iter().find_map(|m| match m {
        MavMessage::LANDING_TARGET(landing) => Some(landing),
        _ => None,
    });
    // It is 3 m north of the helicopter, which points east: 3 m to its left, 7.5 m below.
    let landing = landing.expect("it is relative to the helicopter");
    let reported = Vector3::new(landing.x, landing.y, landing.z);
    assert!((reported - Vector3::new(0.0, -3.0, 7.5)).norm() < 1e-3, "{reported}");
    assert_eq!((landing.time_usec, landing.frame), (101_000_000, MavFrame::MAV_FRAME_BODY_FRD));
    assert!((landing.angle_x.tan() + 3.0 / 7.5).abs() < 1e-5 && landing.angle_y.abs() < 1e-5);
}

#[test]
fn a_foreign_system_with_our_id_is_reported_and_we_stand_back() {
    let mut bench = Bench::new();
    bench.estimate(1.0, TrackStatus::Tracking, 0.1);
    let own = bench.sent(1.0);
    assert_eq!(first_target(&own), (ACTIVE, true));
    let beat = messages::heartbeat(TrackStatus::Tracking);
    let mut answers = Vec::new();
    let foreign = packet::encode(200, Sender { system: 42, component: 1 }, &beat, None);
    let ours = bench.sender.sent.len();
    bench.sender.datagram(&foreign, START + Span::from_s(1.2), None, &mut answers);
    bench.estimate(2.0, TrackStatus::Tracking, 0.1);
    let after = bench.sent(2.0);
    assert!(after.iter().all(|(system, ..)| *system == 43), "{after:?}");
    assert!(ours > 0 && bench.sender.counts().foreign == 1);
    let news = bench.sender.news();
    assert!(news[0].fault.as_ref().is_some_and(|fault| fault.contains("another system uses id 42")));
    bench.estimate(12.0, TrackStatus::Tracking, 0.1);
    assert_eq!(first_target(&bench.sent(12.0)), (ACTIVE, true));
}

#[test]
fn our_own_frames_that_a_router_sends_back_are_no_foreign_system() {
    let mut bench = Bench::new();
    let beat = messages::heartbeat(TrackStatus::Lost);
    let ours = packet::encode(0, Sender { system: 42, component: 1 }, &beat, None);
    assert_eq!(first_target(&bench.sent(0.0)), (STANDBY, false));
    bench.sender.datagram(&ours, START + Span::from_s(0.1), None, &mut Vec::new());
    assert_eq!(bench.sender.counts().foreign, 0);
}

#[test]
fn a_ground_station_finds_a_camera_that_tracks() {
    let mut bench = Bench::sending(vec![MavlinkMessage::CameraTrackingGeoStatus]);
    let ask = |command, param1: u32| {
        MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
            command,
            param1: param1 as f32,
            target_system: 1,
            target_component: 100,
            ..COMMAND_LONG_DATA::DEFAULT
        })
    };
    let mut answers = Vec::new();
    let asked = ask(MavCmd::MAV_CMD_REQUEST_MESSAGE, CAMERA_INFORMATION_DATA::ID);
    let bytes = packet::encode(0, Sender { system: 255, component: 190 }, &asked, None);
    bench.sender.datagram(&bytes, START, None, &mut answers);
    let mut frames = Vec::new();
    answers.iter().for_each(|answer| MavlinkFrames::default().push(answer, &mut frames));
    let [ack, information] = &frames[..] else { panic!("{frames:?}") };
    assert_eq!((ack.system, ack.component), (1, 100));
    let MavMessage::COMMAND_ACK(ack) = &ack.message else { panic!("{ack:?}") };
    assert_eq!((ack.result, ack.target_system), (MavResult::MAV_RESULT_ACCEPTED, 255));
    let MavMessage::CAMERA_INFORMATION(information) = &information.message else { panic!("{frames:?}") };
    assert_eq!((information.resolution_h, information.resolution_v), (1280, 1024));
    assert!(information.flags.contains(CameraCapFlags::CAMERA_CAP_FLAGS_HAS_TRACKING_GEO_STATUS));
    // And its tracking status.
    bench.own(1.0);
    bench.estimate(1.0, TrackStatus::Tracking, 0.1);
    let messages = bench.messages(1.0);
    assert!(messages.iter().any(|m| matches!(m, MavMessage::CAMERA_TRACKING_GEO_STATUS(geo)
        if geo.tracking_status == CameraTrackingStatusFlags::CAMERA_TRACKING_STATUS_FLAGS_ACTIVE
            && (geo.dist - (9.0_f32 + 7.5 * 7.5).sqrt()).abs() < 1e-3)));
}

#[test]
fn signatures_never_go_back_when_the_receivers_time_does() {
    let key = SigningKey([7; 32]);
    let config = Config::parse(include_str!("../../../config/windhover.toml")).expect("valid");
    let mut encoder = MavlinkEncoder::new(
        &config.mavlink,
        &config.target,
        &config.ground,
        &config.camera,
        Some(key.clone()),
    );
    let mut stamps = Vec::new();
    for (s, utc_s) in [(0.0, 1_700_000_000), (1.0, 1_700_003_601), (2.0, 1_700_000_002), (3.0, 1_699_000_000)]
    {
        let t = START + Span::from_s(s);
        let value =
            GnssEpoch { utc: Some(UtcTime::from_unix_ns(utc_s * 1_000_000_000)), ..GnssEpoch::default() };
        encoder.output(&Output::Reading(SensorReading::Gnss(Stamped {
            t_valid: t,
            t_recv: t,
            seq: 0,
            value,
        })));
        let mut frames = Vec::new();
        encoder.tell(t, &mut frames);
        assert!(!frames.is_empty());
        stamps.extend(frames.iter().map(|frame| packet::verify(frame, &key).expect("signed").2));
    }
    assert!(stamps.is_sorted_by(|a, b| a < b), "{stamps:?}");
}
