//! Formats with rates and forces.

use nalgebra::Vector3;

use super::format_tests::{all, said};
use super::*;

/// A record of WitMotion.
fn wit(kind: u8, figures: [i16; 3]) -> Vec<u8> {
    let mut record = vec![0x55, kind];
    figures.iter().for_each(|figure| record.extend(figure.to_le_bytes()));
    record.extend([0x12, 0x34]);
    record.push(record.iter().fold(0u8, |sum, byte| sum.wrapping_add(*byte)));
    record
}

/// Degrees in WitMotion's unit.
fn steps(degrees: f64) -> i16 {
    (degrees / 180.0 * 32_768.0).round() as i16
}

#[test]
fn witmotion_tells_angles_rates_and_forces() {
    let angles = |x: f64, y: f64, z: f64| wit(0x53, [steps(x), steps(y), steps(z)]);
    for (bytes, wanted) in [
        (angles(0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        (angles(0.0, 0.0, -90.0), (90.0, 0.0, 0.0)),
        (angles(5.0, 0.0, 30.0), (330.0, 5.0, 0.0)),
        (angles(0.0, -7.0, 0.0), (0.0, 0.0, -7.0)),
    ] {
        let (out, _) = all(CompassFormat::Witmotion, &bytes);
        let reported = (out[0].heading_deg, out[0].pitch_deg, out[0].roll_deg);
        let near = |reported: Option<f64>, wanted: f64| {
            let off = reported.expect("reported") - wanted;
            (off - 360.0 * (off / 360.0).round()).abs() < 0.01
        };
        assert!(
            near(reported.0, wanted.0) && near(reported.1, wanted.1) && near(reported.2, wanted.2),
            "{reported:?} {wanted:?}"
        );
    }
    // At rest the specific force is up: one g about z. A turn to the right seen from above is negative about z.
    let stream =
        [wit(0x51, [0, 0, 2_048]), wit(0x52, [0, 0, -1_638]), wit(0x54, [1, 2, 3]), angles(0.0, 0.0, 0.0)];
    let mut bytes = vec![0x55, 0x55, 0x53];
    bytes.extend(stream.concat());
    bytes.extend(angles(0.0, 0.0, 10.0));
    let (out, counts) = all(CompassFormat::Witmotion, &bytes);
    assert_eq!((out.len(), counts.used, counts.ignored, counts.noise_bytes), (2, 2, 3, 3), "{counts}");
    let inertial = out[0].inertial.expect("reported");
    let (force, rate) = (inertial.force_mps2.expect("reported"), inertial.rate_rps.expect("reported"));
    assert!((force.z + 9.806_65).abs() < 1e-9 && force.xy().norm() < 1e-9, "{force}");
    assert!((rate.z.to_degrees() - 100.0).abs() < 0.05 && rate.xy().norm() < 1e-9, "{rate}");
    assert_eq!(out[1].inertial, None, "a gathered value is used once");
}

#[test]
fn bno08x_tells_tilt_and_a_yaw_that_is_no_heading() {
    let record = |angles: [i16; 3]| {
        let mut record = vec![0xAA, 0xAA, 0xDE];
        angles.iter().for_each(|angle| record.extend(angle.to_le_bytes()));
        record.extend([0x00, 0x00, 0x00, 0x00, 0xE8, 0x03, 0, 0, 0]);
        record.push(record[2..].iter().fold(0u8, |sum, byte| sum.wrapping_add(*byte)));
        record
    };
    let mut damaged = record([100, 200, 300]);
    damaged[7] ^= 1;
    let bytes = [vec![0xAA], record([-9_000, 250, -1_050]), damaged, record([0, 0, 0])].concat();
    let (mut decoder, mut received) = (CompassDecoder::new(CompassFormat::Bno08xRvc), Vec::new());
    decoder.push(&bytes, MonoTime::default(), &mut received);
    let (first, counts) = (received[0], decoder.counts());
    let near = |reported: Option<f64>, wanted: f64| (reported.expect("reported") - wanted).abs() < 1e-9;
    assert!(near(first.reading.heading_deg, 270.0) && near(first.reading.pitch_deg, 2.5));
    assert!(near(first.reading.roll_deg, -10.5) && first.reading.is_valid());
    assert_eq!(
        (first.sample.heading, first.sample.tilt.is_some()),
        (None, true),
        "yaw has an arbitrary zero"
    );
    assert_eq!((received.len(), counts.refused(Refusal::BadChecksum) > 0), (2, true), "{counts}");
    let (mut decoder, mut received) = (CompassDecoder::new(CompassFormat::Bno08xRvc), Vec::new());
    decoder.push(&record([20_000, 250, -30_000]), MonoTime::default(), &mut received);
    let left_out: Vec<_> = decoder.counts().left_out().collect();
    assert_eq!((received.len(), left_out), (1, vec![("RVC roll", 1), ("RVC yaw", 1)]));
    assert_eq!((received[0].reading.heading_deg, received[0].reading.roll_deg), (None, None));
    assert!(near(received[0].reading.pitch_deg, 2.5));
    assert!(all(CompassFormat::Bno08xRvc, &record([20_000; 3])).1.refused(Refusal::OutOfRange) > 0);
}

#[test]
fn vectornav_tells_rates_and_forces() {
    let reported =
        |body: &str| said(CompassFormat::Vectornav, body).expect("sound").expect("reported").inertial;
    let vnymr =
        "VNYMR,+085.123,-000.900,+000.800,+01.06,-00.25,+03.06,+00.005,+00.344,-09.758,-0.001,+0.002,-0.003";
    let inertial = reported(vnymr).expect("reported");
    assert_eq!(inertial.force_mps2, Some(Vector3::new(0.005, 0.344, -9.758)));
    assert_eq!(inertial.rate_rps, Some(Vector3::new(-0.001, 0.002, -0.003)));
    let vnqmr = "VNQMR,0,0,0,1,1.0,2.0,3.0,0.1,0.2,-9.8,0.01,0.02,0.03";
    assert_eq!(reported(vnqmr).expect("reported").rate_rps, Some(Vector3::new(0.01, 0.02, 0.03)));
    assert_eq!((reported("VNYPR,+085.1,-000.9,+000.8"), reported("VNYMR,1,2,3,,,,,,,,,")), (None, None));
}
