//! What a receiver on this computer gets of a vehicle that is seen, covered, and of a camera that dies.

use std::net::UdpSocket;

use super::vehicle::tests::state_of;
use super::*;
use crate::config::Config;
use windhover_base::msg::TargetEstimate;

const START: MonoTime = MonoTime::from_ns(1_000_000_000);

/// A sender of two targets, and the socket that it sends to.
struct Bench {
    sender: MavlinkSender,
    receiver: UdpSocket,
}

impl Bench {
    fn new() -> Self {
        let receiver = UdpSocket::bind("127.0.0.1:0").expect("a socket");
        receiver.set_nonblocking(true).expect("set");
        let address = receiver.local_addr().expect("an address").to_string();
        let mavlink = MavlinkConfig { enabled: true, send_to: vec![address], ..MavlinkConfig::default() };
        let config = Config::parse(include_str!("../../../config/windhover.toml")).expect("valid");
        let targets = [config.target[0].clone(), config.target[0].clone()];
        let mut sender = MavlinkSender::open(&mavlink, &targets, &config.ground).expect("opened");
        let names = sender.unresolved(START).expect("to be looked up");
        sender.found(look_up(names));
        sender.output(&Output::Datum(START, Geodetic { lat_deg: 30.0, lon_deg: -85.0, height_m: 6.0 }));
        Self { sender, receiver }
    }

    fn estimate(&mut self, s: f64, status: TrackStatus, relative_sigma_m: f64) {
        let state = state_of(8.5, Some(relative_sigma_m));
        let state = (status != TrackStatus::Lost).then_some(state);
        let estimate =
            TargetEstimate { t_valid: START + Span::from_s(s), frame: 1, target: 0, status, state };
        self.sender.output(&Output::Estimator(EstimatorOutput::Estimate(estimate)));
    }

    /// What is sent at `s`: system, sequence, message, payload.
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

/// MAV_STATE of the first target's heartbeat, where there is one, and whether a position of it went out.
fn told(sent: &[(u8, u8, u32, Vec<u8>)]) -> (Option<u8>, bool) {
    let first = |id| sent.iter().find(move |(system, _, kind, _)| (*system, *kind) == (42, id));
    (first(0).map(|(.., payload)| payload[7]), first(33).is_some() && first(144).is_some())
}

const ACTIVE: Option<u8> = Some(4);
const CRITICAL: Option<u8> = Some(5);
const STANDBY: Option<u8> = Some(3);

#[test]
fn a_dead_camera_ends_the_positions_and_the_heartbeats_tell() {
    let mut bench = Bench::new();
    assert_eq!(told(&bench.sent(0.0)), (STANDBY, false));
    bench.estimate(1.0, TrackStatus::Tracking, 0.1);
    assert_eq!(told(&bench.sent(1.05)), (ACTIVE, true));
    // When nothing more comes, then the last state is not sent for ever.
    assert_eq!(told(&bench.sent(1.4)), (None, true));
    assert_eq!(told(&bench.sent(2.1)), (STANDBY, false));
    assert_eq!(told(&bench.sent(32.1)), (STANDBY, false));
}

#[test]
fn a_covered_tag_is_predicted_for_a_second() {
    let mut bench = Bench::new();
    bench.estimate(1.0, TrackStatus::Tracking, 0.1);
    assert_eq!(told(&bench.sent(1.0)), (ACTIVE, true));
    bench.estimate(1.9, TrackStatus::Coasting, 0.3);
    assert_eq!(told(&bench.sent(2.0)), (CRITICAL, true));
    bench.estimate(3.0, TrackStatus::Coasting, 0.5);
    assert_eq!(told(&bench.sent(3.0)), (STANDBY, false));
    bench.estimate(4.0, TrackStatus::Tracking, 0.1);
    assert_eq!(told(&bench.sent(4.0)), (ACTIVE, true));
}

#[test]
fn what_is_not_known_well_enough_is_no_position() {
    let mut bench = Bench::new();
    bench.estimate(1.0, TrackStatus::Tracking, 2.5);
    assert_eq!(told(&bench.sent(1.0)), (STANDBY, false));
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
