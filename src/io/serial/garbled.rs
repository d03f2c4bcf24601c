//! Detects a wrong line speed from the received bytes: text read at the wrong speed is not text, and has no valid
//! sentence.

use super::garmin::bodies;
use windhover_decode::ubx_packets;

/// Counts bytes that do not occur in a text protocol, and looks for valid sentences or packets, which only the right
/// speed gives.
#[derive(Debug, Default)]
pub(super) struct TextShare {
    window: Vec<u8>,
    /// Windows without anything valid since the last that had something valid.
    unsound: u32,
    /// Windows with both binary bytes and something valid.
    mixed: u32,
}

/// Bytes judged at a time: about a second of NMEA at 4800 baud.
const WINDOW: usize = 400;
/// Share of non-text bytes above which a window counts as garbled, percent. At half or double the line speed more than
/// half of the bytes are not text; line noise changes a few in a hundred.
const GARBLED_PERCENT: usize = 25;
/// Windows that a device with valid sentences may fill with its own binary packets between two sentences: raw
/// measurements of a second.
const UNSOUND_MAX: u32 = 20;
/// Mixed windows from which on a device is known to send packets too: a burst of noise after good sentences makes one.
const MIXES: u32 = 2;
/// Longest wait for the rest of a packet or sentence at the end of a window.
const KEPT: usize = 1_100;

impl TextShare {
    /// Adds bytes; at the end of a window returns the share of non-text bytes in percent where the window is garbled. A
    /// device that mixes binary packets into its text is not garbled: a valid sentence or packet shows that the speed
    /// is right.
    pub(super) fn garbled(&mut self, bytes: &[u8]) -> Option<usize> {
        self.window.extend_from_slice(bytes);
        // The bytes of a device that may send packets are examined in pieces that contain a whole one.
        let length = if self.window.contains(&0xB5) { WINDOW + KEPT } else { WINDOW };
        if self.window.len() < length {
            return None;
        }
        let odd =
            self.window.iter().filter(|byte| !matches!(byte, b' '..=b'~' | b'\r' | b'\n' | b'\t')).count();
        let percent = odd * 100 / self.window.len();
        let is_packets = percent >= GARBLED_PERCENT && holds_packets(&self.window);
        if is_packets || percent >= GARBLED_PERCENT && holds_a_sentence(&self.window) {
            (self.mixed, self.unsound) = (self.mixed.saturating_add(1), 0);
        } else {
            self.unsound += 1;
        }
        self.window.clear();
        let is_mixed = is_packets || self.mixed >= MIXES && self.unsound <= UNSOUND_MAX;
        (percent >= GARBLED_PERCENT && !is_mixed).then_some(percent)
    }
}

fn holds_a_sentence(bytes: &[u8]) -> bool {
    bodies(&String::from_utf8_lossy(bytes)).next().is_some()
}

/// Whether these are packets of a u-blox receiver: a complete one, or the start of one beside a valid sentence.
fn holds_packets(bytes: &[u8]) -> bool {
    let is_marked = bytes.windows(2).any(|pair| pair == [0xB5, 0x62]);
    is_marked && (ubx_packets(bytes).next().is_some() || holds_a_sentence(bytes))
}

#[cfg(test)]
mod tests {
    use super::*;
    use windhover_decode::ubx_framed;

    #[test]
    fn text_passes_and_noise_does_not() {
        let mut share = TextShare::default();
        let line = b"$GPRMC,162254.00,A,3723.02837,N,12159.39853,W,0.820,188.36,110706,,,A*74\r\n";
        assert!((0..20).all(|_| share.garbled(line).is_none()));
        let noise: Vec<u8> = (0..WINDOW + KEPT).map(|i| (i * 37 % 256) as u8).collect();
        let mut share = TextShare::default();
        assert!(share.garbled(&noise).is_some_and(|percent| percent > 40));
        assert!(share.garbled(&line[..40]).is_none(), "a window starts anew after it was judged");
    }

    #[test]
    fn rubbish_after_good_sentences_is_garbled() {
        let line = b"$GPRMC,162254.00,A,3723.02837,N,12159.39853,W,0.820,188.36,110706,,,A*74\r\n";
        for ahead in 0..12 {
            let mut share = TextShare::default();
            assert!((0..ahead).all(|_| share.garbled(line).is_none()));
            let is_reported = [0xff; 900].chunks(61).any(|read| share.garbled(read).is_some());
            assert!(is_reported, "{ahead} sentences before");
            let mut share = TextShare::default();
            assert!((0..ahead).all(|_| share.garbled(line).is_none()));
            assert!(share.garbled(&[0xff; 900]).is_some(), "in one read, {ahead} sentences before");
        }
    }

    /// A packet of u-blox with a binary payload.
    fn packet(length: u16) -> Vec<u8> {
        let payload: Vec<u8> = (0..length).map(|n| n.wrapping_mul(91) as u8).collect();
        ubx_framed(1, 7, &payload)
    }

    #[test]
    fn packets_between_sentences_are_not_garbled() {
        let line = b"$GPRMC,162254.00,A,3723.02837,N,12159.39853,W,0.820,188.36,110706,,,A*74\r\n";
        for (length, packets, lines) in [(92, 1, 1), (92, 5, 0), (900, 1, 1), (300, 6, 1), (900, 4, 1)] {
            let mut share = TextShare::default();
            for _ in 0..40 {
                let burst = [packet(length).repeat(packets), line.repeat(lines)].concat();
                for read in burst.chunks(61) {
                    assert_eq!(share.garbled(read), None, "{packets} packets of {length}, {lines} lines");
                }
            }
            // A wrong speed of the same line afterwards is reported, once it has lasted.
            let noise: Vec<u8> =
                (0..60_000u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
            assert!(noise.chunks(61).any(|read| share.garbled(read).is_some()));
        }
    }
}
