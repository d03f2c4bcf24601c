//! Tells a wrong line speed by what arrives: text read at the wrong speed is not text, and holds no sound sentence.

use super::garmin::bodies;

/// Counts bytes that have no place in a text protocol, and looks for what only the right speed gives.
#[derive(Debug, Default)]
pub(super) struct TextShare {
    heard: Vec<u8>,
    /// Windows without anything sound since the last that had something.
    unsound: u32,
    was_sound: bool,
}

/// Bytes judged at a time: about a second of NMEA at 4800 baud.
const WINDOW: usize = 400;
/// Share of odd bytes above which a window counts as garbled, percent. At half or double the line
/// speed more than half of the bytes are odd; line noise spoils a few in a hundred.
const GARBLED_PERCENT: usize = 25;
/// Windows that a device which was understood may fill with binary packets of its own between two sentences:
/// raw measurements of a second.
const UNSOUND_MAX: u32 = 20;
/// Longest that a packet or sentence over the end of a window is waited for.
const KEPT: usize = 1_100;

impl TextShare {
    /// Takes bytes in; at the end of a window gives the share of odd bytes in percent where the window
    /// is garbled. A device that mixes binary packets into its text is not: a sound sentence or packet
    /// tells that the speed is right.
    pub(super) fn garbled(&mut self, bytes: &[u8]) -> Option<usize> {
        self.heard.extend_from_slice(bytes);
        // What may be a device of packets is looked at in pieces that hold a whole one.
        let window = if self.heard.contains(&0xB5) { WINDOW + KEPT } else { WINDOW };
        if self.heard.len() < window {
            return None;
        }
        let odd =
            self.heard.iter().filter(|byte| !matches!(byte, b' '..=b'~' | b'\r' | b'\n' | b'\t')).count();
        let percent = odd * 100 / self.heard.len();
        if percent >= GARBLED_PERCENT && holds_anything_sound(&self.heard) {
            (self.was_sound, self.unsound) = (true, 0);
        } else {
            self.unsound += 1;
        }
        self.heard.clear();
        let is_mixed = self.was_sound && self.unsound <= UNSOUND_MAX;
        (percent >= GARBLED_PERCENT && !is_mixed).then_some(percent)
    }
}

fn holds_anything_sound(bytes: &[u8]) -> bool {
    bodies(&String::from_utf8_lossy(bytes)).next().is_some() || holds_a_packet(bytes)
}

/// Whether there is a packet of u-blox receivers: two marks, class and identity, length, payload, and the
/// Fletcher sum over all but the marks.
fn holds_a_packet(bytes: &[u8]) -> bool {
    bytes.windows(6).enumerate().any(|(at, head)| {
        let &[0xB5, 0x62, _, _, low, high] = head else { return false };
        let end = at + 6 + usize::from(u16::from_le_bytes([low, high]));
        let sum = bytes.get(at + 2..end).map(|summed| {
            summed.iter().fold((0u8, 0u8), |(a, b), byte| {
                let a = a.wrapping_add(*byte);
                (a, b.wrapping_add(a))
            })
        });
        sum.zip(bytes.get(end..end + 2)).is_some_and(|((a, b), told)| told == [a, b])
    })
}

#[cfg(test)]
mod tests {
    use super::*;

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

    /// A packet of u-blox with a payload that is no text.
    fn packet(length: u16) -> Vec<u8> {
        let mut packet = vec![1, 7];
        packet.extend_from_slice(&length.to_le_bytes());
        packet.extend((0..length).map(|n| n.wrapping_mul(91) as u8));
        let sum = packet.iter().fold((0u8, 0u8), |(a, b), byte| {
            let a = a.wrapping_add(*byte);
            (a, b.wrapping_add(a))
        });
        [&[0xB5, 0x62], packet.as_slice(), &[sum.0, sum.1]].concat()
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
            // The same line at a wrong speed after that is told, once it has lasted.
            let noise: Vec<u8> =
                (0..60_000u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
            assert!(noise.chunks(61).any(|read| share.garbled(read).is_some()));
        }
    }
}
