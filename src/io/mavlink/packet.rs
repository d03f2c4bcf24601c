//! MAVLink 2 frames: encoded, signed and verified with the `mavlink` crate.
//!
//! Source: <https://mavlink.io/en/guide/serialization.html>, <https://mavlink.io/en/guide/message_signing.html>.

use mavlink::dialects::development::MavMessage;
use mavlink::{MAVLinkV2MessageRaw, MavHeader};

use windhover_base::time::UtcTime;

/// First byte of a MAVLink 2 frame.
const MAGIC: u8 = 0xfd;
/// Bytes of the header, including the magic byte.
const HEADER: usize = 10;
/// Bytes of the checksum.
const CHECKSUM: usize = 2;
/// Bytes of a signature block.
const SIGNATURE: usize = 13;
/// Flag of the header: a signature follows.
const SIGNED: u8 = 0x01;
/// Signatures count in units of 10 µs from 2015-01-01T00:00:00Z.
const SIGNATURE_EPOCH_UNIX_NS: i64 = 1_420_070_400 * 1_000_000_000;

/// A signing key: 32 secret bytes.
#[derive(Clone, PartialEq, Eq)]
pub struct SigningKey(pub [u8; 32]);

impl std::fmt::Debug for SigningKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("SigningKey(…)")
    }
}

impl SigningKey {
    /// A key from 64 hexadecimal digits; `None` for anything else.
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

    /// First 48 bits of SHA-256 over key, frame, link id and time stamp.
    fn signature(&self, raw: &MAVLinkV2MessageRaw) -> [u8; 6] {
        let mut first = [0; 6];
        raw.calculate_signature(&self.0, &mut first);
        first
    }
}

/// The sender of a frame.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Sender {
    /// System id.
    pub system: u8,
    /// Component id.
    pub component: u8,
}

/// How a frame is signed.
#[derive(Clone, Copy, Debug)]
pub struct Signature<'a> {
    /// The secret.
    pub key: &'a SigningKey,
    /// Link id of the signature.
    pub link_id: u8,
    /// Time stamp, units of 10 µs since 2015; each greater than the one before.
    pub time_stamp: u64,
}

/// Encodes a frame, signed where `signature` is given.
pub fn encode(
    sequence: u8,
    sender: Sender,
    message: &MavMessage,
    signature: Option<Signature<'_>>,
) -> Vec<u8> {
    let header = MavHeader { system_id: sender.system.into(), component_id: sender.component, sequence };
    let mut raw = MAVLinkV2MessageRaw::new();
    match signature {
        None => raw.serialize_message(header, message),
        Some(Signature { key, link_id, time_stamp }) => {
            raw.serialize_message_for_signing(header, message);
            *raw.signature_link_id_mut() = link_id;
            raw.signature_timestamp_bytes_mut().copy_from_slice(&time_stamp.to_le_bytes()[..6]);
            let value = key.signature(&raw);
            raw.signature_value_mut().copy_from_slice(&value);
        }
    }
    raw.raw_bytes().to_vec()
}

/// A signature's time stamp for a UTC time.
pub fn time_stamp(utc: UtcTime) -> u64 {
    u64::try_from((utc.unix_ns() - SIGNATURE_EPOCH_UNIX_NS) / 10_000).unwrap_or(0)
}

/// Why a frame is refused.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Refused {
    /// Too short, another version, or a length that does not fit.
    Malformed,
    /// Not signed, though a key is set.
    Unsigned,
    /// The signature is of another key.
    WrongKey,
    /// Not later than one already received, or a minute old.
    Replayed,
}

/// Checks that a datagram is one signed frame; returns its sender, message id and time stamp. The checksum needs the
/// message's definition and is covered by the signature anyway.
pub fn verify(datagram: &[u8], key: &SigningKey) -> Result<(Sender, u32, u64), Refused> {
    let &[MAGIC, length, incompatible, ..] = datagram else {
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
    let mut raw = MAVLinkV2MessageRaw::new();
    raw.as_mut_slice()[..datagram.len()].copy_from_slice(datagram);
    if key.signature(&raw) != raw.signature_value() {
        return Err(Refused::WrongKey);
    }
    let sender = Sender { system: datagram[5], component: raw.component_id() };
    Ok((sender, raw.message_id(), raw.signature_timestamp()))
}

#[cfg(test)]
mod tests {
    use mavlink::dialects::development::{HEARTBEAT_DATA, MavAutopilot, MavModeFlag, MavState, MavType};
    use proptest::prelude::*;

    use super::*;

    const SENDER: Sender = Sender { system: 42, component: 1 };

    fn heartbeat() -> MavMessage {
        MavMessage::HEARTBEAT(HEARTBEAT_DATA {
            custom_mode: 0,
            mavtype: MavType::MAV_TYPE_GROUND_ROVER,
            autopilot: MavAutopilot::MAV_AUTOPILOT_GENERIC,
            base_mode: MavModeFlag::empty(),
            system_status: MavState::MAV_STATE_ACTIVE,
            mavlink_version: 3,
        })
    }

    fn signed(key: &SigningKey) -> Vec<u8> {
        let signature = Signature { key, link_id: 3, time_stamp: 0x0102_0304_0506 };
        encode(7, SENDER, &heartbeat(), Some(signature))
    }

    #[test]
    fn heartbeats_are_byte_for_byte_what_pymavlink_makes() {
        // pymavlink 2.4.50: MAVLink_heartbeat_message(10, 0, 0, 0, 4, 3), sequence 7, system 42, component 1.
        let want = hex("fd090000072a01000000000000000a00000403489d");
        assert_eq!(encode(7, SENDER, &heartbeat(), None), want);
        // The same with key 0707…07, link id 3, time stamp 0x010203040506.
        let want = hex("fd090100072a01000000000000000a00000403af650306050403020162df0c2c8a33");
        assert_eq!(signed(&SigningKey([7; 32])), want);
    }

    fn hex(text: &str) -> Vec<u8> {
        let digits: Vec<u32> = text.chars().filter_map(|c| c.to_digit(16)).collect();
        digits.chunks(2).map(|d| (d[0] * 16 + d[1]) as u8).collect()
    }

    #[test]
    fn signatures_are_believed_from_our_key_only() {
        let key = SigningKey([7; 32]);
        let frame = signed(&key);
        assert_eq!(verify(&frame, &key), Ok((SENDER, 0, 0x0102_0304_0506)));
        assert_eq!(verify(&frame, &SigningKey([8; 32])), Err(Refused::WrongKey));
        for at in 1..frame.len() {
            let mut changed = frame.clone();
            changed[at] ^= 0x10;
            assert!(verify(&changed, &key).is_err(), "byte {at} changed");
        }
        let unsigned = encode(1, SENDER, &heartbeat(), None);
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
