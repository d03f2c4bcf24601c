//! KLV keys, lengths and values (SMPTE ST 336, MISB ST 0107, ST 1201).

/// A local set being written.
#[derive(Clone, Debug, Default)]
pub(super) struct LocalSet(pub Vec<u8>);

impl LocalSet {
    /// Adds an item.
    pub(super) fn item(&mut self, tag: u32, value: &[u8]) {
        oid(tag, &mut self.0);
        length(value.len(), &mut self.0);
        self.0.extend_from_slice(value);
    }

    /// Adds an item where its value is known.
    pub(super) fn known<const N: usize>(&mut self, tag: u32, value: Option<[u8; N]>) {
        if let Some(value) = value {
            self.item(tag, &value);
        }
    }
}

/// A length in BER: short up to 127, long beyond.
pub(super) fn length(length: usize, out: &mut Vec<u8>) {
    if length < 128 {
        out.push(length as u8);
        return;
    }
    let bytes = length.to_be_bytes();
    let from = bytes.iter().position(|byte| *byte != 0).unwrap_or(bytes.len() - 1);
    out.push(0x80 | (bytes.len() - from) as u8);
    out.extend_from_slice(&bytes[from..]);
}

/// A number in BER-OID: seven bits a byte, all but the last marked.
pub(super) fn oid(number: u32, out: &mut Vec<u8>) {
    for shift in [28, 21, 14, 7] {
        if number >> shift > 0 {
            out.push(0x80 | (number >> shift & 0x7f) as u8);
        }
    }
    out.push((number & 0x7f) as u8);
}

/// An unsigned number in the fewest bytes.
pub(super) fn shortest(number: u64) -> Vec<u8> {
    let bytes = number.to_be_bytes();
    let from = bytes.iter().position(|byte| *byte != 0).unwrap_or(bytes.len() - 1);
    bytes[from..].to_vec()
}

/// Maps `low..=high` to all values of N bytes; `None` outside.
pub(super) fn unsigned<const N: usize>(figure: f64, low: f64, high: f64) -> Option<[u8; N]> {
    let most = 2f64.powi(8 * N as i32) - 1.0;
    let share = (figure - low) / (high - low);
    if !(0.0..=1.0).contains(&share) {
        return None;
    }
    last_bytes(((share * most).round() as u64).to_be_bytes())
}

/// Maps `-limit..=limit` to the values of N bytes except the least, which means an error; `None` outside.
pub(super) fn signed<const N: usize>(figure: f64, limit: f64) -> Option<[u8; N]> {
    let most = 2f64.powi(8 * N as i32 - 1) - 1.0;
    let share = figure / limit;
    if !(-1.0..=1.0).contains(&share) {
        return None;
    }
    last_bytes(((share * most).round() as i64).to_be_bytes())
}

fn last_bytes<const N: usize>(bytes: [u8; 8]) -> Option<[u8; N]> {
    bytes[8 - N..].try_into().ok()
}

/// ST 1201's mapping IMAPB(low, high, N): a step is a power of two, zero is exact; outside, and for NaN, the special
/// value "not a number".
pub(super) fn imapb<const N: usize>(figure: f64, low: f64, high: f64) -> [u8; N] {
    let bits = 8 * N as i32 - 1;
    let scale = 2f64.powi(bits - (high - low).log2().ceil() as i32);
    let zero = if low < 0.0 && high > 0.0 { scale * low - (scale * low).floor() } else { 0.0 };
    let value = match (low..=high).contains(&figure) {
        true => (scale * (figure - low) + zero).floor() as u64,
        // Positive quiet NaN: 1101 0000 …
        false => 0xd0 << (8 * (N - 1)),
    };
    last_bytes(value.to_be_bytes()).expect("N bytes of eight")
}

/// Key, length, the set, and at the end its checksum: the sum of all preceding words, including the checksum's own tag
/// and length.
pub(super) fn sealed(key: &[u8; 16], set: LocalSet) -> Vec<u8> {
    let mut packet = key.to_vec();
    length(set.0.len() + 4, &mut packet);
    packet.extend(set.0);
    packet.extend([1, 2]);
    let sum = packet
        .iter()
        .enumerate()
        .fold(0u16, |sum, (at, byte)| sum.wrapping_add(u16::from(*byte) << if at % 2 == 0 { 8 } else { 0 }));
    packet.extend(sum.to_be_bytes());
    packet
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_are_those_of_the_standards_examples() {
        // ST 0601: heading 159.974365°, latitude 60.176822966978335°, altitude 14190.72 m.
        assert_eq!(unsigned(159.974365, 0.0, 360.0), Some([0x71, 0xc2]));
        assert_eq!(signed(60.176822966978335, 90.0), Some([0x55, 0x95, 0xb6, 0x6d]));
        assert_eq!(unsigned(14190.7195, -900.0, 19000.0), Some([0xc2, 0x21]));
        assert_eq!(signed::<4>(90.1, 90.0), None);
        // ST 1201: IMAPB(−900, 19000, 2): steps of half a metre; zero is exact.
        assert_eq!(imapb(-900.0, -900.0, 19000.0), [0, 0]);
        assert_eq!(imapb(0.0, -900.0, 19000.0), [0x03, 0x84]);
        assert_eq!(imapb(f64::NAN, 0.0, 650.0), [0xd0, 0]);
        let mut out = Vec::new();
        oid(74, &mut out);
        oid(300, &mut out);
        length(127, &mut out);
        length(300, &mut out);
        assert_eq!(out, [74, 0x82, 44, 127, 0x82, 1, 44]);
    }
}
