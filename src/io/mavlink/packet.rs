//! MAVLink 2 frames: header, truncated payload, checksum, optional signature.
//!
//! Source: <https://mavlink.io/en/guide/serialization.html>, <https://mavlink.io/en/guide/message_signing.html>.

use windhover_base::time::UtcTime;

/// First byte of a MAVLink 2 frame.
pub const MAGIC: u8 = 0xfd;
/// Bytes of the header, the magic included.
const HEADER: usize = 10;
/// Bytes of the checksum.
const CHECKSUM: usize = 2;
/// Bytes of a signature block.
const SIGNATURE: usize = 13;
/// Flag of the header: a signature follows.
const SIGNED: u8 = 0x01;
/// Signatures count in units of 10 µs from 2015-01-01T00:00:00Z.
const SIGNATURE_EPOCH_UNIX_NS: i64 = 1_420_070_400 * 1_000_000_000;

/// CRC-16/MCRF4XX, "X.25" in MAVLink's words.
const CRC: crc::Crc<u16> = crc::Crc::<u16>::new(&crc::CRC_16_MCRF4XX);

/// A signing key: 32 secret bytes.
#[derive(Clone, PartialEq, Eq)]
pub struct SigningKey(pub [u8; 32]);

impl std::fmt::Debug for SigningKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("SigningKey(…)")
    }
}

impl SigningKey {
    /// From 64 hexadecimal digits; `None` for anything else.
    pub fn from_hex(text: &str) -> Option<Self> {
        let text = text.trim().as_bytes();
        let mut key = [0; 32];
        if text.len() != 64 {
            return None;
        }
        for (byte, digits) in key.iter_mut().zip(text.chunks_exact(2)) {
            let [high, low] = [digits[0], digits[1]].map(|d| char::from(d).to_digit(16));
            *byte = (high? * 16 + low?) as u8;
        }
        Some(Self(key))
    }

    /// First 48 bits of SHA-256(key, frame up to the checksum's end, link id, time stamp).
    fn sign(&self, frame: &[u8], link_id_and_time: &[u8]) -> [u8; 6] {
        let mut context = ring::digest::Context::new(&ring::digest::SHA256);
        context.update(&self.0);
        context.update(frame);
        context.update(link_id_and_time);
        let mut first = [0; 6];
        first.copy_from_slice(&context.finish().as_ref()[..6]);
        first
    }
}

/// A message's place in the dialect.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Kind {
    /// Message id, 24 bits.
    pub id: u32,
    /// Seed of the checksum, from the message's definition.
    pub crc_extra: u8,
}

/// Who sends.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Sender {
    /// System id.
    pub system: u8,
    /// Component id.
    pub component: u8,
}

/// Puts a frame together.
pub fn encode(sequence: u8, sender: Sender, kind: Kind, payload: &[u8], signed: bool) -> Vec<u8> {
    // Trailing zeros are left out; one byte stays.
    let used = payload.iter().rposition(|b| *b != 0).map_or(1, |last| last + 1).min(payload.len());
    let id = kind.id.to_le_bytes();
    let flags = if signed { SIGNED } else { 0 };
    let mut frame = vec![MAGIC, used as u8, flags, 0, sequence, sender.system, sender.component];
    frame.extend_from_slice(&id[..3]);
    frame.extend_from_slice(&payload[..used]);
    let checksum = checksum(&frame, kind.crc_extra);
    frame.extend_from_slice(&checksum.to_le_bytes());
    frame
}

/// Checksum of a frame without it, over everything but the magic and then the message's seed.
fn checksum(frame: &[u8], crc_extra: u8) -> u16 {
    let mut digest = CRC.digest();
    digest.update(&frame[1..]);
    digest.update(&[crc_extra]);
    digest.finalize()
}

/// Appends the signature to a frame made with `signed`.
pub fn sign(frame: &mut Vec<u8>, key: &SigningKey, link_id: u8, time_stamp: u64) {
    let mut block = [0; 7];
    block[0] = link_id;
    block[1..].copy_from_slice(&time_stamp.to_le_bytes()[..6]);
    let signature = key.sign(frame, &block);
    frame.extend_from_slice(&block);
    frame.extend_from_slice(&signature);
}

/// A signature's time stamp for a UTC time.
pub fn time_stamp(utc: UtcTime) -> u64 {
    u64::try_from((utc.unix_ns() - SIGNATURE_EPOCH_UNIX_NS) / 10_000).unwrap_or(0)
}

/// Why bytes are no frame to be believed.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Refused {
    /// Too short, another version, or a length that does not fit.
    Malformed,
    /// Not signed, though a key is set.
    Unsigned,
    /// The signature is not of our key.
    WrongKey,
    /// Not later than one already seen, or a minute old.
    Replayed,
}

/// Checks that a datagram is one signed frame; gives its sender, message id and time stamp. The checksum
/// needs the message's definition and is covered by the signature anyway.
pub fn verify(datagram: &[u8], key: &SigningKey) -> Result<(Sender, u32, u64), Refused> {
    let &[MAGIC, length, incompatible, _, _, system, component, i0, i1, i2, ..] = datagram else {
        return Err(Refused::Malformed);
    };
    let frame_length = HEADER + usize::from(length) + CHECKSUM;
    if incompatible & !SIGNED != 0 {
        return Err(Refused::Malformed);
    }
    if incompatible & SIGNED == 0 {
        let whole = datagram.len() == frame_length;
        return Err(if whole { Refused::Unsigned } else { Refused::Malformed });
    }
    if datagram.len() != frame_length + SIGNATURE {
        return Err(Refused::Malformed);
    }
    let (frame, block) = datagram.split_at(frame_length);
    if key.sign(frame, &block[..7]) != block[7..] {
        return Err(Refused::WrongKey);
    }
    let mut stamp = [0; 8];
    stamp[..6].copy_from_slice(&block[1..7]);
    Ok((Sender { system, component }, u32::from_le_bytes([i0, i1, i2, 0]), u64::from_le_bytes(stamp)))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const HEARTBEAT: Kind = Kind { id: 0, crc_extra: 50 };
    const SENDER: Sender = Sender { system: 42, component: 1 };

    #[test]
    fn a_heartbeat_is_byte_for_byte_what_pymavlink_makes() {
        // pymavlink 2.4.50: MAVLink_heartbeat_message(10, 0, 0, 0, 4, 3), sequence 7, system 42, component 1.
        let payload = [0, 0, 0, 0, 10, 0, 0, 4, 3];
        let want = hex("fd090000072a01000000000000000a00000403489d");
        assert_eq!(encode(7, SENDER, HEARTBEAT, &payload, false), want);
    }

    #[test]
    fn a_signed_heartbeat_is_byte_for_byte_what_pymavlink_makes() {
        // The same with key 0707…07, link id 3, time stamp 0x010203040506.
        let payload = [0, 0, 0, 0, 10, 0, 0, 4, 3];
        let mut frame = encode(7, SENDER, HEARTBEAT, &payload, true);
        sign(&mut frame, &SigningKey([7; 32]), 3, 0x0102_0304_0506);
        assert_eq!(frame, hex("fd090100072a01000000000000000a00000403af650306050403020162df0c2c8a33"));
    }

    #[test]
    fn the_checksum_of_the_standard_check_string() {
        assert_eq!(CRC.checksum(b"123456789"), 0x6f91);
    }

    fn hex(text: &str) -> Vec<u8> {
        let digits: Vec<u32> = text.chars().filter_map(|c| c.to_digit(16)).collect();
        digits.chunks(2).map(|d| (d[0] * 16 + d[1]) as u8).collect()
    }

    #[test]
    fn signatures_are_believed_from_our_key_only() {
        let key = SigningKey([7; 32]);
        let mut frame = encode(1, SENDER, HEARTBEAT, &[1, 2, 3], true);
        sign(&mut frame, &key, 3, 0x0102_0304_0506);
        assert_eq!(verify(&frame, &key), Ok((SENDER, 0, 0x0102_0304_0506)));
        assert_eq!(verify(&frame, &SigningKey([8; 32])), Err(Refused::WrongKey));
        for at in 1..frame.len() {
            let mut changed = frame.clone();
            changed[at] ^= 0x10;
            assert!(verify(&changed, &key).is_err(), "byte {at} changed");
        }
        let unsigned = encode(1, SENDER, HEARTBEAT, &[1, 2, 3], false);
        assert_eq!(verify(&unsigned, &key), Err(Refused::Unsigned));
    }

    #[test]
    fn keys_are_64_hexadecimal_digits() {
        let text = "00ff".repeat(16);
        assert_eq!(SigningKey::from_hex(&format!("{text}\n")).map(|k| (k.0[0], k.0[1])), Some((0, 255)));
        for bad in ["", "00", &"0g".repeat(32), &"0".repeat(65), &"é".repeat(32)] {
            assert_eq!(SigningKey::from_hex(bad), None, "{bad:?}");
        }
    }

    proptest! {
        #[test]
        fn any_bytes_are_refused_without_a_panic(bytes in prop::collection::vec(any::<u8>(), 0..320)) {
            prop_assert!(verify(&bytes, &SigningKey([1; 32])).is_err());
        }

        #[test]
        fn any_text_is_a_key_or_none(text in ".{0,80}") {
            let _ = SigningKey::from_hex(&text);
        }
    }
}
