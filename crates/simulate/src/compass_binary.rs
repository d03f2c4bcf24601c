//! Compass readings as packets and records.

use nalgebra::{Matrix3, Rotation3, Vector3};

/// CRC-16 of PNI's binary packets: polynomial 0x1021, start 0 (XMODEM).
const PNI_CRC: crc::Crc<u16> = crc::Crc::<u16>::new(&crc::CRC_16_XMODEM);
/// kDataResp and the components sent.
const PNI_DATA_RESPONSE: u8 = 5;
const PNI_HEADING: u8 = 5;
const PNI_DISTORTION: u8 = 8;
const PNI_PITCH: u8 = 24;
const PNI_ROLL: u8 = 25;

/// A binary packet: length of the whole, frame, count of components, components, checksum.
pub(super) fn write_pni(heading: f64, pitch: f64, roll: f64, valid: bool, line: &mut Vec<u8>) {
    let mut packet = vec![0, 0, PNI_DATA_RESPONSE, 4];
    for (component, degrees) in [(PNI_HEADING, heading), (PNI_PITCH, pitch), (PNI_ROLL, roll)] {
        packet.push(component);
        packet.extend_from_slice(&(degrees as f32).to_be_bytes());
    }
    packet.extend_from_slice(&[PNI_DISTORTION, u8::from(!valid)]);
    let length = (packet.len() + 2) as u16;
    packet[..2].copy_from_slice(&length.to_be_bytes());
    let sum = PNI_CRC.checksum(&packet);
    packet.extend_from_slice(&sum.to_be_bytes());
    line.extend_from_slice(&packet);
}

/// NAV-RELPOSNED with a true heading; an invalid one has no flags.
pub(super) fn write_ubx(heading: f64, valid: bool, line: &mut Vec<u8>) {
    let mut packet = vec![0xB5, 0x62, 0x01, 0x3C, 64, 0];
    packet.resize(6 + 64, 0);
    packet[6] = 1;
    packet[6 + 24..6 + 28].copy_from_slice(&((heading * 1e5).round() as i32).to_le_bytes());
    // Fix, differential, relative position, fixed ambiguities, heading.
    let flags: u32 = if valid { 0x117 } else { 0x003 };
    packet[6 + 60..].copy_from_slice(&flags.to_le_bytes());
    let sum = packet[2..].iter().fold([0u8; 2], |[a, b], byte| {
        let a = a.wrapping_add(*byte);
        [a, b.wrapping_add(a)]
    });
    packet.extend_from_slice(&sum);
    line.extend_from_slice(&packet);
}

/// WitMotion's record of angles: about x right, y forward, z up, in that order from east, north, up.
pub(super) fn write_witmotion(heading: f64, pitch: f64, roll: f64, line: &mut Vec<u8>) {
    let ned_from_body =
        Rotation3::from_euler_angles(roll.to_radians(), pitch.to_radians(), heading.to_radians());
    let up_of = |body: Vector3<f64>| {
        let ned = ned_from_body * body;
        Vector3::new(ned.y, ned.x, -ned.z)
    };
    let axes = [up_of(Vector3::y()), up_of(Vector3::x()), up_of(-Vector3::z())];
    let (x, y, z) = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&axes)).euler_angles();
    let mut record = vec![0x55, 0x53];
    for angle in [x, y, z] {
        let steps = (angle / std::f64::consts::PI * 32_768.0).round();
        record.extend_from_slice(&(steps.min(32_767.0) as i16).to_le_bytes());
    }
    record.extend_from_slice(&[0, 0]);
    record.push(record.iter().fold(0u8, |sum, byte| sum.wrapping_add(*byte)));
    line.extend_from_slice(&record);
}

/// A record of the BNO08x's UART-RVC mode.
pub(super) fn write_rvc(heading: f64, pitch: f64, roll: f64, line: &mut Vec<u8>) {
    let mut record = vec![0xAA, 0xAA, 0];
    let yaw = if heading > 180.0 { heading - 360.0 } else { heading };
    for degrees in [yaw, pitch, roll] {
        record.extend_from_slice(&((degrees * 100.0).round() as i16).to_le_bytes());
    }
    record.extend_from_slice(&[0, 0, 0, 0, 0xE8, 0x03, 0, 0, 0]);
    record.push(record[2..].iter().fold(0u8, |sum, byte| sum.wrapping_add(*byte)));
    line.extend_from_slice(&record);
}
