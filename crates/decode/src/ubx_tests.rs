//! Packets of u-blox as receivers send them, alone and among sentences.

use nalgebra::Vector3;
use proptest::prelude::*;

use super::gnss::{GnssDecoder, ReceivedEpoch};
use super::sentence::framed;
use super::ubx::ubx_framed;
use super::{DecodeCounts, Refusal};
use windhover_base::msg::FixKind;
use windhover_base::settings::GpsFormat;
use windhover_base::time::MonoTime;

/// NAV-PVT of 2026-11-18 15:04:`second` plus `nanoseconds`, with this fix type and flags.
fn pvt(second: u8, nanoseconds: i32, fix: u8, flags: u8) -> Vec<u8> {
    let mut payload = vec![0; 92];
    payload[4..11].copy_from_slice(&[0xEA, 0x07, 11, 18, 15, 4, second]);
    payload[11] = 0b111;
    payload[16..20].copy_from_slice(&nanoseconds.to_le_bytes());
    payload[20..22].copy_from_slice(&[fix, flags]);
    payload[23] = 17;
    for (at, value) in [
        (24, -91_833_333), // longitude, 1e-7 degrees
        (28, 387_033_333), // latitude
        (32, 93_000),      // height above the ellipsoid, mm
        (36, 43_000),      // above mean sea level
        (40, 800),         // horizontal accuracy
        (44, 1_200),       // vertical
        (48, -1_500),      // velocity north, mm/s
        (52, 2_000),       // east
        (56, -250),        // down
        (60, 2_500),       // ground speed
        (64, -5_313_000),  // heading of motion, 1e-5 degrees
    ] {
        payload[at..at + 4].copy_from_slice(&i32::to_le_bytes(value));
    }
    ubx_framed(1, 7, &payload)
}

fn decode(format: GpsFormat, bytes: &[u8]) -> (Vec<ReceivedEpoch>, DecodeCounts) {
    let (mut decoder, mut out) = (GnssDecoder::patient().of_format(format), Vec::new());
    decoder.push(bytes, MonoTime::default(), &mut out);
    decoder.flush(&mut out);
    (out, decoder.counts().clone())
}

#[test]
fn a_position_has_everything() {
    let (epochs, counts) = decode(GpsFormat::Ubx, &pvt(5, 200_000_123, 3, 1));
    let epoch = epochs[0].epoch;
    assert_eq!((epochs.len(), counts.used), (1, 1), "{counts}");
    assert_eq!(epoch.utc.expect("dated").to_string(), "2026-11-18T15:04:05.200Z");
    assert_eq!((epoch.fix, epoch.sats, epoch.alt_msl_m), (FixKind::ThreeD, Some(17), Some(43.0)));
    assert_eq!((epoch.hpe_m, epoch.vpe_m, epoch.vel_has_down), (Some(0.8), Some(1.2), true));
    let near = |value: Option<f64>, wanted: f64| (value.expect("given") - wanted).abs() < 1e-9;
    assert!(
        near(epoch.lat_deg, 38.703_333_3) && near(epoch.lon_deg, -9.183_333_3) && near(epoch.geoid_m, 50.0)
    );
    assert!(near(epoch.speed_mps, 2.5) && near(epoch.course_deg, 306.87));
    let velocity = epoch.vel_ned_mps.expect("given");
    assert_eq!((velocity.x, velocity.y, velocity.z), (-1.5, 2.0, -0.25));
}

#[test]
fn what_is_no_fix_is_none() {
    let kind = |fix, flags| decode(GpsFormat::Auto, &pvt(5, 0, fix, flags)).0[0].epoch.fix;
    assert_eq!((kind(3, 1), kind(2, 1), kind(4, 1)), (FixKind::ThreeD, FixKind::TwoD, FixKind::ThreeD));
    for (fix, flags) in [(0, 1), (1, 1), (5, 1), (3, 0), (9, 1), (255, 0xFF)] {
        let (epochs, _) = decode(GpsFormat::Auto, &pvt(5, 0, fix, flags));
        assert_eq!((epochs[0].epoch.fix, epochs[0].epoch.utc), (FixKind::None, None), "{fix} {flags}");
    }
}

#[test]
fn sentences_beside_it_are_of_the_same_epoch() {
    let sentences = |second: u8| {
        let time = format!("1504{second:02}.00");
        [
            "GNRMC,TIME,A,3842.20000,N,00911.00000,W,4.86,306.9,181126,,,A,V",
            "GNGGA,TIME,3842.20000,N,00911.00000,W,1,17,0.6,43.0,M,50.0,M,,",
        ]
        .map(|body| framed(&body.replace("TIME", &time)) + "\r\n")
        .concat()
        .into_bytes()
    };
    for packet_first in [true, false] {
        // The packet's nanoseconds are the receiver's clock error: the time is that of the sentences.
        let burst = |second| {
            let (packet, text) = (pvt(second, -300_000, 3, 1), sentences(second));
            if packet_first { [packet, text].concat() } else { [text, packet].concat() }
        };
        let bytes: Vec<u8> = (5..12).flat_map(burst).collect();
        let (epochs, counts) = decode(GpsFormat::Auto, &bytes);
        assert_eq!((epochs.len(), counts.used, counts.refused_total()), (7, 21, 0), "{counts}");
        for received in &epochs {
            assert_eq!((received.epoch.hdop, received.epoch.hpe_m), (Some(0.6), Some(0.8)));
            assert!((received.epoch.lat_deg.expect("given") - 38.703_333_3).abs() < 1e-9);
        }
        let (of_text, counts) = decode(GpsFormat::Nmea, &bytes);
        assert!(of_text.iter().all(|received| received.epoch.hpe_m.is_none()), "{counts}");
        assert_eq!(decode(GpsFormat::Ubx, &bytes).0.len(), 7);
    }
}

#[test]
fn other_packets_are_passed_over_and_damage_is_counted() {
    let mut damaged = pvt(6, 0, 3, 1);
    damaged[40] ^= 4;
    let bytes = [
        ubx_framed(1, 0x35, &[7; 300]),
        pvt(5, 0, 3, 1),
        damaged,
        ubx_framed(2, 0x15, &[0xB5; 900]),
        pvt(7, 0, 3, 1),
    ]
    .concat();
    let (epochs, counts) = decode(GpsFormat::Auto, &bytes);
    assert_eq!((epochs.len(), counts.used, counts.ignored), (2, 2, 2), "{counts}");
    assert_eq!(counts.refused(Refusal::BadChecksum), 1, "{counts}");
    let wrong_length = ubx_framed(1, 7, &[0; 20]);
    assert_eq!(decode(GpsFormat::Auto, &wrong_length).1.refused(Refusal::Malformed), 1);
}

#[test]
fn what_cannot_be_costs_only_itself() {
    let with = |at: usize, value: i32| {
        let mut payload = pvt(5, 0, 3, 1)[6..98].to_vec();
        payload[at..at + 4].copy_from_slice(&value.to_le_bytes());
        ubx_framed(1, 7, &payload)
    };
    for (at, value) in [(24, 1_800_000_001), (24, -2_000_000_000), (28, 900_000_001), (28, i32::MIN)] {
        let (epochs, counts) = decode(GpsFormat::Ubx, &with(at, value));
        let epoch = epochs[0].epoch;
        assert_eq!((epochs.len(), epoch.lat_deg, epoch.lon_deg), (1, None, None), "{value}: {counts}");
        // An epoch without a place is no fix, unless a sentence beside it has the place.
        assert_eq!((epoch.sats, epoch.fix), (Some(17), FixKind::None));
        let sentence =
            framed("GNRMC,150405.00,A,3842.20000,N,00911.00000,W,4.86,306.9,181126,,,A,V") + "\r\n";
        let (epochs, counts) = decode(GpsFormat::Auto, &[with(at, value), sentence.into_bytes()].concat());
        let epoch = epochs[0].epoch;
        assert_eq!((epochs.len(), epoch.fix, epoch.sats), (1, FixKind::ThreeD, Some(17)), "{counts}");
        assert!((epoch.lat_deg.expect("of the sentence") - 38.703_333_3).abs() < 1e-6);
        assert_eq!((epoch.vel_ned_mps.is_some(), epoch.hpe_m), (true, Some(0.8)));
        let counts = decode(GpsFormat::Ubx, &with(at, value)).1;
        assert_eq!(counts.left_out().collect::<Vec<_>>(), [("NAV-PVT position", 1)]);
        assert_eq!((counts.used, counts.refused_total()), (1, 0), "{counts}");
    }
    // Without its time a packet has no epoch; sentences beside it have.
    let mut payload = pvt(5, 0, 3, 1)[6..98].to_vec();
    payload[8] = 25;
    let (_, counts) = decode(GpsFormat::Ubx, &ubx_framed(1, 7, &payload));
    assert!(counts.left_out().any(|(name, n)| name == "NAV-PVT time" && n == 1), "{counts}");
    // A variance that is no number costs its kind alone.
    let mut covariance = vec![0; 64];
    covariance[5..7].copy_from_slice(&[1, 1]);
    for (at, variance) in [(16, f32::NAN), (28, 4.0), (36, 9.0), (40, 0.01), (52, 0.01), (60, 0.04)] {
        covariance[at..at + 4].copy_from_slice(&variance.to_le_bytes());
    }
    let (epochs, counts) =
        decode(GpsFormat::Ubx, &[pvt(5, 0, 3, 1), ubx_framed(1, 0x36, &covariance)].concat());
    assert_eq!(counts.left_out().collect::<Vec<_>>(), [("NAV-COV position", 1)], "{counts}");
    let sigma = epochs[0].epoch.velocity_sigma_mps.expect("of the velocity");
    assert!((sigma - Vector3::new(0.1, 0.1, 0.2)).norm() < 1e-6, "{sigma}");
}

#[test]
fn the_seventh_generation_is_read() {
    let long = pvt(5, 0, 3, 1);
    let (epochs, counts) = decode(GpsFormat::Auto, &ubx_framed(1, 7, &long[6..90]));
    assert_eq!((epochs.len(), epochs[0].epoch.fix), (1, FixKind::ThreeD), "{counts}");
}

#[test]
fn accuracies_and_rtk_are_reported() {
    let epoch = |packets: &[Vec<u8>]| decode(GpsFormat::Auto, &packets.concat()).0[0].epoch;
    let with = |flags: u8, speed_accuracy_mm: u32| {
        let mut payload = pvt(5, 0, 3, flags)[6..98].to_vec();
        payload[68..72].copy_from_slice(&speed_accuracy_mm.to_le_bytes());
        ubx_framed(1, 7, &payload)
    };
    let alone = epoch(&[with(1, 120)]);
    let of = |v: Option<Vector3<f64>>| v.expect("reported");
    assert_eq!(of(alone.position_sigma_m), Vector3::new(0.8, 0.8, 1.2));
    assert_eq!(of(alone.velocity_sigma_mps), Vector3::repeat(0.12));
    assert_eq!(epoch(&[with(1, 0)]).velocity_sigma_mps, None, "zero is no accuracy");
    assert_eq!(epoch(&[with(0x41, 9)]).fix, FixKind::RtkFloat);
    assert_eq!(epoch(&[with(0x81, 9)]).fix, FixKind::RtkFixed);
    let covered = epoch(&[with(1, 120), cov([1, 1], [0.25, 0.5, 4.0], [0.01, 0.04, 0.09])]);
    assert_eq!(of(covered.position_sigma_m), Vector3::new(0.5, 0.5f64.sqrt(), 2.0));
    let near = |v: Vector3<f64>, wanted: Vector3<f64>| (v - wanted).norm() < 1e-6;
    assert!(near(of(covered.velocity_sigma_mps), Vector3::new(0.1, 0.2, 0.3)));
    let half = epoch(&[with(1, 120), cov([0, 1], [0.25; 3], [0.01; 3])]);
    assert_eq!(of(half.position_sigma_m), Vector3::new(0.8, 0.8, 1.2), "an invalid half is left out");
    for odd in [f32::NAN, f32::INFINITY, -1.0, 0.0] {
        let packets = [with(1, 120), cov([1, 1], [odd; 3], [0.01; 3])].concat();
        let (epochs, counts) = decode(GpsFormat::Auto, &packets);
        assert_eq!(counts.left_out().collect::<Vec<_>>(), [("NAV-COV position", 1)], "{odd}");
        assert!(near(of(epochs[0].epoch.velocity_sigma_mps), Vector3::repeat(0.1)), "{odd}");
    }
    assert_eq!(epoch(&[pvt(5, 0, 0, 0), cov([1, 1], [0.25; 3], [0.01; 3])]).position_sigma_m, None);
}

/// NAV-COV with these flags of validity and variances.
fn cov(valid: [u8; 2], position: [f32; 3], velocity: [f32; 3]) -> Vec<u8> {
    let mut payload = vec![0; 64];
    payload[5..7].copy_from_slice(&valid);
    for (at, variances) in [(16, position), (40, velocity)] {
        // NN NE ND EE ED DD
        for (place, variance) in [0, 3, 5].into_iter().zip(variances) {
            payload[at + 4 * place..at + 4 * place + 4].copy_from_slice(&variance.to_le_bytes());
        }
    }
    ubx_framed(1, 0x36, &payload)
}

#[test]
fn covariances_of_a_stream_are_of_their_epochs() {
    let burst = |second: u8| [pvt(second, 0, 3, 1), cov([1, 1], [f32::from(second); 3], [0.01; 3])].concat();
    let bytes: Vec<u8> = (5..30).flat_map(burst).collect();
    for mut decoder in [GnssDecoder::patient(), GnssDecoder::new()] {
        let mut out = Vec::new();
        for (n, packet) in bytes.chunks(100 + 72).enumerate() {
            decoder.push(
                packet,
                MonoTime::from_ns(1_795_014_245_000_000_000 + n as i64 * 1_000_000_000),
                &mut out,
            );
        }
        decoder.flush(&mut out);
        assert_eq!((out.len(), decoder.counts().refused_total()), (25, 0), "{}", decoder.counts());
        for (second, received) in (5..30).zip(&out) {
            let sigma = received.epoch.position_sigma_m.expect("reported").x;
            assert!((sigma - f64::from(second).sqrt()).abs() < 1e-6, "{second}: {sigma}");
        }
    }
}

/// TIM-TP of 2026-11-18 15:04:06 (week 2445) with these flags.
fn pulse(flags: u8) -> Vec<u8> {
    let mut payload = vec![0; 16];
    payload[..4].copy_from_slice(&(((3 * 24 + 15) * 3_600 + 4 * 60 + 6) * 1_000u32).to_le_bytes());
    payload[12..14].copy_from_slice(&2_445u16.to_le_bytes());
    payload[14] = flags;
    ubx_framed(0x0D, 1, &payload)
}

#[test]
fn a_pulse_tells_the_date_and_opens_nothing() {
    let rmc = |second: u8| {
        (framed(&format!("GNGGA,1504{second:02}.00,3842.2,N,00911.0,W,1,17,0.6,43.0,M,50.0,M,,")) + "\r\n")
            .into_bytes()
    };
    let (epochs, counts) = decode(GpsFormat::Auto, &[rmc(5), pulse(3), rmc(6), rmc(7)].concat());
    assert_eq!((epochs.len(), counts.used), (3, 4), "{counts}");
    assert_eq!(epochs[1].epoch.utc.expect("dated").to_string(), "2026-11-18T15:04:06.000Z");
    let (epochs, counts) = decode(GpsFormat::Auto, &[rmc(5), pulse(2), pulse(1), rmc(6)].concat());
    assert_eq!((epochs[1].epoch.utc, counts.ignored), (None, 2), "the receiver's own time is not UTC");
}

#[test]
fn sentences_of_errors_are_of_their_epoch_and_open_none() {
    let at = |second: u8, body: &str| {
        (framed(&body.replace("TIME", &format!("1504{second:02}.00"))) + "\r\n").into_bytes()
    };
    let gga = "GNGGA,TIME,3842.2,N,00911.0,W,1,17,0.6,43.0,M,50.0,M,,";
    let gst = "GNGST,TIME,1.2,1.5,0.9,30,0.8,0.9,1.7";
    let bytes = [at(5, gga), at(5, gst), at(6, gga), at(9, gst), at(7, gga), at(7, gst)].concat();
    let (epochs, counts) = decode(GpsFormat::Nmea, &bytes);
    let reported: Vec<bool> =
        epochs.iter().map(|received| received.epoch.position_sigma_m.is_some()).collect();
    assert_eq!((reported, counts.refused(Refusal::NoTime)), (vec![true, false, true], 1), "{counts}");
    assert_eq!(epochs[0].epoch.position_sigma_m, Some(Vector3::new(0.8, 0.9, 1.7)));
    for gst in ["GNGST,TIME,,,,,,,", "GNGST,TIME,1,,,,0.0,0.0,0.0", "GNGST,TIME,1,,,,x,1,1"] {
        let (epochs, counts) = decode(GpsFormat::Nmea, &[at(5, gga), at(5, gst)].concat());
        assert_eq!((epochs[0].epoch.position_sigma_m, counts.used), (None, 2), "{gst}");
    }
}

proptest! {
    #[test]
    fn any_payload_is_survived(
        which in 0usize..6,
        payload in prop::collection::vec(any::<u8>(), 0..120),
        sized: bool,
    ) {
        let (class, identity, length) = [(1, 7, 92), (1, 0x21, 20), (1, 0x3C, 64), (1, 7, 84), (1, 0x36, 64), (0x0D, 1, 16)][which];
        let mut payload = payload;
        if sized {
            payload.resize(length, 0xFF);
        }
        let bytes = ubx_framed(class, identity, &payload);
        for received in decode(GpsFormat::Auto, &bytes).0 {
            prop_assert!(received.epoch.lat_deg.is_none_or(|lat| (-90.0..=90.0).contains(&lat)));
            let sigmas = [received.epoch.position_sigma_m, received.epoch.velocity_sigma_mps];
            prop_assert!(sigmas.iter().flatten().flatten().all(|sigma| sigma.is_finite() && *sigma > 0.0));
            prop_assert!(received.epoch.course_deg.is_none_or(|course| (0.0..=360.0).contains(&course)));
        }
    }

    #[test]
    fn sentences_survive_whatever_looks_like_a_packet(
        noise in prop::collection::vec(prop_oneof![Just(0xB5u8), Just(0x62), Just(1), any::<u8>()], 0..60),
        sizes in prop::collection::vec(1usize..40, 1..20),
    ) {
        let line = framed("GPRMC,150405.0,A,3842.2,N,00911.0,W,0.1,,181126,,,A") + "\r\n";
        let bytes = [noise.as_slice(), b"\r\n", line.as_bytes(), &[0; 4200]].concat();
        let (mut decoder, mut out) = (GnssDecoder::patient(), Vec::new());
        let (mut rest, mut sizes) = (&bytes[..], sizes.iter().cycle());
        while !rest.is_empty() {
            let (read, after) = rest.split_at((*sizes.next().expect("endless")).min(rest.len()));
            decoder.push(read, MonoTime::default(), &mut out);
            rest = after;
        }
        decoder.flush(&mut out);
        prop_assert_eq!(out.len(), 1, "{}", decoder.counts());
    }
}
