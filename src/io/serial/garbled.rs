//! Tells a wrong line speed by what arrives: text read at the wrong speed is not text.

/// Counts bytes that have no place in a text protocol.
#[derive(Debug, Default)]
pub(super) struct TextShare {
    heard: u32,
    odd: u32,
}

/// Bytes judged at a time: about a second of NMEA at 4800 baud.
const WINDOW: u32 = 400;
/// Share of odd bytes above which a window counts as garbled, percent. At half or double the line
/// speed more than half of the bytes are odd; line noise spoils a few in a hundred.
const GARBLED_PERCENT: u32 = 25;

impl TextShare {
    /// Takes bytes in; at the end of a window gives the share of odd bytes in percent where the window
    /// is garbled.
    pub(super) fn garbled(&mut self, bytes: &[u8]) -> Option<u32> {
        for &byte in bytes {
            self.heard += 1;
            let text = matches!(byte, b' '..=b'~' | b'\r' | b'\n' | b'\t');
            self.odd += u32::from(!text);
        }
        if self.heard < WINDOW {
            return None;
        }
        let percent = self.odd * 100 / self.heard;
        *self = Self::default();
        (percent >= GARBLED_PERCENT).then_some(percent)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_passes_and_noise_does_not() {
        let mut share = TextShare::default();
        let line = b"$GPRMC,162254.00,A,3723.02837,N,12159.39853,W,0.820,188.36,110706,,,A*74\r\n";
        assert!((0..20).all(|_| share.garbled(line).is_none()));
        let noise: Vec<u8> = (0..WINDOW).map(|i| (i * 37 % 256) as u8).collect();
        let mut share = TextShare::default();
        assert!(share.garbled(&noise).is_some_and(|percent| percent > 40));
        assert!(share.garbled(&line[..40]).is_none(), "a window starts anew after it was judged");
    }
}
