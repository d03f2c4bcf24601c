//! An autopilot's messages as ArduPilot and PX4 send them, and bytes that are not messages.

use ::mavlink::dialects::development::*;
use ::mavlink::{MAVLinkV2MessageRaw, MavHeader};
use nalgebra::Vector3;
use proptest::prelude::*;

use super::*;
use windhover_base::msg::FixKind;
use windhover_base::time::{MonoTime, Span};

fn at(s: f64) -> MonoTime {
    MonoTime::from_ns(1_700_000_000_000_000_000) + Span::from_s(s)
}

fn frame(system_id: u32, component_id: u8, message: &MavMessage) -> Vec<u8> {
    let mut raw = MAVLinkV2MessageRaw::new();
    raw.serialize_message(MavHeader { system_id, component_id, sequence: 3 }, message);
    raw.raw_bytes().to_vec()
}

fn heartbeat() -> MavMessage {
    MavMessage::HEARTBEAT(HEARTBEAT_DATA {
        mavtype: MavType::MAV_TYPE_HELICOPTER,
        autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
        mavlink_version: 3,
        ..HEARTBEAT_DATA::DEFAULT
    })
}

fn attitude(time_boot_ms: u32, yaw: f32) -> MavMessage {
    MavMessage::ATTITUDE(ATTITUDE_DATA {
        time_boot_ms,
        roll: 0.1,
        pitch: -0.2,
        yaw,
        ..ATTITUDE_DATA::DEFAULT
    })
}

/// A decoder that uses system 1, started 100 s before `at(0)`.
fn following() -> AutopilotDecoder {
    let mut decoder = AutopilotDecoder::new(None);
    decoder.push(&frame(1, 1, &heartbeat()), at(0.0), &mut Vec::new());
    assert_eq!(decoder.system(), Some(1));
    decoder
}

fn received(decoder: &mut AutopilotDecoder, message: &MavMessage, t: MonoTime) -> Vec<ReceivedAutopilot> {
    let mut out = Vec::new();
    decoder.push(&frame(1, 1, message), t, &mut out);
    out
}

#[test]
fn only_the_autopilot_is_decoded() {
    let mut decoder = following();
    let mut out = Vec::new();
    // A ground station, another helicopter, a camera of the same one.
    for (system, component) in [(255, 190), (2, 1), (1, 100)] {
        decoder.push(&frame(system, component, &attitude(100_000, 0.5)), at(0.0), &mut out);
    }
    assert_eq!(out, []);
    decoder.push(&frame(1, 1, &attitude(100_000, 0.5)), at(0.002), &mut out);
    let AutopilotMeasurement::Attitude(sample) = out[0].measurement else { panic!("{out:?}") };
    assert!(sample.heading_is_true && (sample.heading.expect("reported") - 0.5).abs() < 1e-6);
    let tilt = sample.tilt.expect("reported");
    assert!((tilt.pitch + 0.2).abs() < 1e-6 && (tilt.roll - 0.1).abs() < 1e-6);
    // With a configured system id, only that system is used.
    let mut second = AutopilotDecoder::new(Some(2));
    second.push(&frame(1, 1, &attitude(100_000, 0.5)), at(0.0), &mut Vec::new());
    assert_eq!(second.counts().used, 0);
}

#[test]
fn quaternions_are_preferred_and_forces_are_in_si_units() {
    let mut decoder = following();
    let q = nalgebra::UnitQuaternion::from_euler_angles(0.1, -0.2, 2.0);
    let quaternion = MavMessage::ATTITUDE_QUATERNION(ATTITUDE_QUATERNION_DATA {
        time_boot_ms: 100_000,
        q1: q.w as f32,
        q2: q.i as f32,
        q3: q.j as f32,
        q4: q.k as f32,
        rollspeed: 0.3,
        ..ATTITUDE_QUATERNION_DATA::DEFAULT
    });
    let out = received(&mut decoder, &quaternion, at(0.0));
    let [ReceivedAutopilot { measurement: AutopilotMeasurement::Attitude(sample), .. }, rates] = out[..]
    else {
        panic!("{out:?}")
    };
    assert!((sample.heading.expect("reported") - 2.0).abs() < 1e-6, "{sample:?}");
    let AutopilotMeasurement::Inertial(rates) = rates.measurement else { panic!("{out:?}") };
    assert!(rates.force_mps2.is_none() && (rates.rate_rps.expect("reported").x - 0.3).abs() < 1e-6);
    assert_eq!(received(&mut decoder, &attitude(100_100, 0.0), at(0.1)), []);
    let imu = MavMessage::SCALED_IMU(SCALED_IMU_DATA {
        time_boot_ms: 100_150,
        zacc: -1_000,
        xgyro: 500,
        ..SCALED_IMU_DATA::DEFAULT
    });
    let out = received(&mut decoder, &imu, at(0.15));
    let AutopilotMeasurement::Inertial(sample) = out[0].measurement else { panic!("{out:?}") };
    let (rate, force) = sample.rate_rps.zip(sample.force_mps2).expect("both");
    assert!((rate - Vector3::new(0.5, 0.0, 0.0)).norm() < 1e-9);
    assert!((force - Vector3::new(0.0, 0.0, -9.806_65)).norm() < 1e-9);
    // From here on the IMU's own rates are used, not the attitude's.
    assert_eq!(received(&mut decoder, &quaternion, at(0.2)).len(), 1);
}

#[test]
fn fixes_and_its_own_position() {
    let mut decoder = following();
    received(&mut decoder, &attitude(100_000, 0.0), at(0.0));
    let time = SYSTEM_TIME_DATA { time_unix_usec: 1_800_000_000_000_000, time_boot_ms: 100_100 };
    received(&mut decoder, &MavMessage::SYSTEM_TIME(time), at(0.1));
    let fix = MavMessage::GPS_RAW_INT(GPS_RAW_INT_DATA {
        time_usec: 100_200_000,
        fix_type: GpsFixType::GPS_FIX_TYPE_RTK_FIXED,
        lat: 301_234_567,
        lon: -857_654_321,
        alt: 33_250,
        alt_ellipsoid: 6_250,
        eph: 90,
        vel: 250,
        cog: 9_000,
        satellites_visible: 14,
        h_acc: 20,
        v_acc: 30,
        ..GPS_RAW_INT_DATA::DEFAULT
    });
    let out = received(&mut decoder, &fix, at(0.25));
    let AutopilotMeasurement::Gnss(epoch) = out[0].measurement else { panic!("{out:?}") };
    assert!((out[0].t - at(0.2)).abs() < Span::from_ms(1.0), "by its own clock: {:?}", out[0].t);
    assert_eq!((epoch.fix, epoch.sats), (FixKind::RtkFixed, Some(14)));
    assert_eq!(epoch.utc.map(|utc| utc.unix_ns()), Some(1_800_000_000_100_000_000));
    assert!((epoch.geoid_m.expect("reported") + 27.0).abs() < 1e-9);
    assert!((epoch.vel_ned_mps.expect("reported") - Vector3::new(0.0, 2.5, 0.0)).norm() < 1e-9);
    assert!((epoch.hpe_m.expect("reported") - 0.02).abs() < 1e-9 && !epoch.vel_has_down);
    assert_eq!(received(&mut decoder, &fix, at(0.35)), [], "the same fix again");
    let nowhere = MavMessage::GLOBAL_POSITION_INT(GLOBAL_POSITION_INT_DATA {
        time_boot_ms: 100_400,
        ..Default::default()
    });
    assert_eq!(received(&mut decoder, &nowhere, at(0.4)), []);
    let place = MavMessage::GLOBAL_POSITION_INT(GLOBAL_POSITION_INT_DATA {
        time_boot_ms: 100_500,
        lat: 301_234_567,
        lon: -857_654_321,
        alt: 45_000,
        vx: 120,
        ..GLOBAL_POSITION_INT_DATA::DEFAULT
    });
    let out = received(&mut decoder, &place, at(0.5));
    let AutopilotMeasurement::Position(position) = out[0].measurement else { panic!("{out:?}") };
    assert_eq!((position.boot, position.alt_msl_m), (Span::from_s(100.5), 45.0));
}

#[test]
fn questions_for_the_time_put_its_clock_on_ours() {
    let mut decoder = following();
    let asked = question(at(1.0));
    let answer =
        |ts1| MavMessage::TIMESYNC(TIMESYNC_DATA { tc1: 101_005_000_000, ts1, ..TIMESYNC_DATA::DEFAULT });
    // An answer to another system's request is not ours.
    received(&mut decoder, &answer(asked - 1), at(1.010));
    assert!(!decoder.clock().is_exchanged());
    received(&mut decoder, &answer(asked), at(1.010));
    assert!(decoder.clock().is_exchanged());
    // A message that took 200 ms is stamped as well as any other.
    let out = received(&mut decoder, &attitude(102_000, 0.0), at(2.2));
    assert!((out[0].t - at(2.0)).abs() < Span::from_ms(0.01), "{:?}", out[0].t - at(2.0));
}

#[test]
fn an_autopilot_that_starts_anew_is_followed() {
    let mut decoder = following();
    assert_eq!(received(&mut decoder, &attitude(100_000, 0.0), at(0.0)).len(), 2);
    let mut after = 0;
    for k in 0..10_u32 {
        let t = at(5.0 + 0.1 * f64::from(k));
        after += received(&mut decoder, &attitude(100 * k, 0.0), t).len();
    }
    assert_eq!((after, decoder.clock().restarts()), (16, 1));
}

#[test]
fn what_cannot_be_costs_only_itself() {
    let parts = |messages: &[ReceivedAutopilot]| {
        let (mut attitude, mut inertial) = (None, None);
        for one in messages {
            match one.measurement {
                AutopilotMeasurement::Attitude(sample) => {
                    attitude = Some((sample.heading.is_some(), sample.tilt.is_some()))
                }
                AutopilotMeasurement::Inertial(sample) => {
                    inertial = Some((sample.rate_rps.is_some(), sample.force_mps2.is_some()))
                }
                _ => {}
            }
        }
        (attitude, inertial)
    };
    for odd in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e9] {
        let mut decoder = following();
        let of = |roll, yaw, rollspeed| {
            let sound = ATTITUDE_DATA { time_boot_ms: 100_000, ..ATTITUDE_DATA::DEFAULT };
            MavMessage::ATTITUDE(ATTITUDE_DATA { roll, yaw, rollspeed, ..sound })
        };
        let mut shown = |message| parts(&received(&mut decoder, &message, at(0.0)));
        assert_eq!(shown(of(0.1, odd, 0.0)), (Some((false, true)), Some((true, false))), "{odd}");
        assert_eq!(shown(of(odd, 0.5, 0.0)), (Some((true, false)), Some((true, false))), "{odd}");
        assert_eq!(shown(of(odd, odd, 0.0)), (None, Some((true, false))), "{odd}");
        if !odd.is_finite() {
            assert_eq!(shown(of(0.1, 0.5, odd)), (Some((true, true)), None), "{odd}");
        }
        assert_eq!(decoder.counts().refused_total(), 0, "{}", decoder.counts());
        assert!(decoder.counts().left_out().count() >= 2, "{}", decoder.counts());
    }
    let mut decoder = following();
    let nothing = MavMessage::ATTITUDE(ATTITUDE_DATA {
        time_boot_ms: 100_000,
        roll: f32::NAN,
        yaw: f32::NAN,
        yawspeed: f32::NAN,
        ..ATTITUDE_DATA::DEFAULT
    });
    assert_eq!(received(&mut decoder, &nothing, at(0.0)), []);
    assert_eq!(decoder.counts().refused(crate::Refusal::OutOfRange), 1);
    // A quaternion that is none leaves the rates.
    let zero = MavMessage::ATTITUDE_QUATERNION(ATTITUDE_QUATERNION_DATA {
        time_boot_ms: 100_000,
        ..Default::default()
    });
    assert_eq!(parts(&received(&mut decoder, &zero, at(0.0))), (None, Some((true, false))));
    let imu = |xgyro, zacc| {
        MavMessage::HIGHRES_IMU(HIGHRES_IMU_DATA {
            time_usec: 100_000_000,
            xgyro,
            zacc,
            ..HIGHRES_IMU_DATA::DEFAULT
        })
    };
    assert_eq!(parts(&received(&mut decoder, &imu(f32::NAN, -9.8), at(0.0))).1, Some((false, true)));
    assert_eq!(parts(&received(&mut decoder, &imu(0.1, f32::NAN), at(0.0))).1, Some((true, false)));
    // A place beyond the pole is no fix; the satellites are counted.
    let fix = MavMessage::GPS_RAW_INT(GPS_RAW_INT_DATA {
        time_usec: 100_000_000,
        fix_type: GpsFixType::GPS_FIX_TYPE_3D_FIX,
        lat: 910_000_000,
        vel: 250,
        cog: 9_000,
        satellites_visible: 9,
        ..GPS_RAW_INT_DATA::DEFAULT
    });
    let messages = received(&mut decoder, &fix, at(0.0));
    let epoch = messages.iter().find_map(|one| match &one.measurement {
        AutopilotMeasurement::Gnss(epoch) => Some(*epoch),
        _ => None,
    });
    let epoch = epoch.expect("a fix without its place");
    assert_eq!((epoch.lat_deg, epoch.lon_deg, epoch.fix, epoch.sats), (None, None, FixKind::None, Some(9)));
}

#[test]
fn noise_is_passed_over() {
    let mut decoder = following();
    // A frame among noise, in parts, and with one bit of another changed.
    let good = frame(1, 1, &attitude(100_100, 0.5));
    let mut bad = good.clone();
    bad[12] ^= 1;
    let bytes = [b"ArduPilot\xfd\xfe\x00".as_slice(), &bad, &good, &[0; 300]].concat();
    let mut out = Vec::new();
    for byte in bytes {
        decoder.push(&[byte], at(0.1), &mut out);
    }
    assert_eq!(out.len(), 2, "{out:?}");
    assert!(decoder.counts().refused(crate::Refusal::BadChecksum) >= 1);
}

proptest! {
    #[test]
    fn any_bytes_in_any_parts_make_no_panic(parts in prop::collection::vec(prop::collection::vec(any::<u8>(), 0..300), 0..8)) {
        let mut decoder = AutopilotDecoder::new(Some(1));
        let mut out = Vec::new();
        for (k, part) in parts.iter().enumerate() {
            decoder.push(part, at(k as f64), &mut out);
        }
    }

    #[test]
    fn any_payload_of_a_known_message_makes_no_panic(id in 0_u32..512, payload in prop::collection::vec(any::<u8>(), 255)) {
        use ::mavlink::{MavlinkVersion, Message as _};
        if let Ok(message) = MavMessage::parse(MavlinkVersion::V2, id, &payload) {
            let mut decoder = AutopilotDecoder::new(Some(1));
            decoder.push(&frame(1, 1, &message), at(0.0), &mut Vec::new());
        }
    }
}
