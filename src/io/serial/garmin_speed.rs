//! Brings a Garmin receiver to the line speed of the configuration: finds the speed it speaks, tells it the
//! other, restarts it. One that was left in its binary mode answers no sentence: it is told to speak NMEA first.
//!
//! Source: Garmin GPS 18x technical specifications, "Sensor Configuration Information (PGRMC)": field 10 is
//! the line speed, which takes effect after a reset (`PGRMI`, field 7 = R).

use super::garmin::{bodies, sentence};
use super::{Line, READ_BYTES, SerialSettings, left};
use crate::io::clock::HostClock;
use crate::io::device::{Fault, NoteKind, Report, Reports, wait_for};
use windhover_base::time::Span;

/// Speeds a receiver may speak and their codes in PGRMC, factory settings first.
const SPEEDS: [(u32, u8); 4] = [(19_200, 5), (4_800, 3), (38_400, 8), (9_600, 4)];

/// How long a receiver has to say a sentence: it speaks once a second, or answers at once.
const LISTEN: Span = Span::from_ns(1_500_000_000);

/// Asks for the present configuration: also a receiver whose sentences are all off answers.
const QUERY: &str = "PGRMCE";

/// Ends the binary mode: Garmin's packet 10 (line command) that asks for NMEA, between its frame's bytes.
const SPEAK_NMEA: [u8; 8] = [0x10, 0x0A, 0x02, 0x26, 0x00, 0xCE, 0x10, 0x03];

/// Restarts the receiver.
const RESET: &str = "PGRMI,,,,,,,R";

/// The line while its speed is settled.
pub(super) struct Settling<'a> {
    pub(super) line: &'a mut Line,
    pub(super) settings: &'a SerialSettings,
    pub(super) clock: HostClock,
    pub(super) reports: Reports<'a>,
}

impl Settling<'_> {
    /// Leaves the line at the configured speed, and the receiver too where it can be brought there.
    pub(super) async fn settle(mut self) -> Result<(), Fault> {
        let wanted = self.settings.baud;
        if self.speaks().await? {
            return Ok(());
        }
        let Some(code) = SPEEDS.iter().find(|(speed, _)| *speed == wanted).map(|(_, code)| *code) else {
            return Ok(());
        };
        for (speed, _) in SPEEDS.iter().filter(|(speed, _)| *speed != wanted) {
            self.line.set_speed(*speed).await?;
            if !self.speaks().await? {
                continue;
            }
            let body = format!("PGRMC,,,,,,,,,,{code}");
            self.send(&body).await?;
            let heard = self.listen(|text| answered(text, code)).await?;
            self.send(RESET).await?;
            // Its echo still comes at the old speed; the new one holds after the reset.
            self.listen(|text| bodies(text).any(|body| body.starts_with("PGRMI"))).await?;
            let text = format!("the receiver spoke at {speed} baud and was told to speak at {wanted}");
            let note = if heard { NoteKind::Configured } else { NoteKind::NotConfigured };
            (self.reports)(Report::Note(note, 1, text));
            break;
        }
        self.line.set_speed(wanted).await
    }

    /// Whether sentences arrive at the line's present speed, also after the way out of binary mode.
    async fn speaks(&mut self) -> Result<bool, Fault> {
        self.send(QUERY).await?;
        if self.listen(holds_a_sentence).await? {
            return Ok(true);
        }
        self.line.write(&SPEAK_NMEA).await?;
        self.send(QUERY).await?;
        let speaks = self.listen(holds_a_sentence).await?;
        if speaks {
            let text = "the receiver was in binary mode and was told to speak NMEA".to_owned();
            (self.reports)(Report::Note(NoteKind::Configured, 1, text));
        }
        Ok(speaks)
    }

    async fn send(&mut self, body: &str) -> Result<(), Fault> {
        self.line.write(sentence(body).as_bytes()).await
    }

    /// Reads the line for a while; whether `enough` was read.
    async fn listen(&mut self, enough: impl Fn(&str) -> bool + Send) -> Result<bool, Fault> {
        let limit = self.clock.now() + LISTEN;
        let (mut text, mut buffer) = (String::new(), vec![0; READ_BYTES]);
        loop {
            let read = wait_for(self.line.read(&mut buffer), self.reports);
            let Ok(read) = tokio::time::timeout(left(limit, self.clock), read).await else {
                return Ok(false);
            };
            text.push_str(&String::from_utf8_lossy(&buffer[..read?]));
            if enough(&text) {
                return Ok(true);
            }
        }
    }
}

fn holds_a_sentence(text: &str) -> bool {
    bodies(text).next().is_some()
}

/// Whether the receiver echoed the new speed.
fn answered(text: &str, code: u8) -> bool {
    bodies(text).any(|body| {
        body.starts_with("PGRMC,") && body.split(',').nth(10).is_some_and(|field| field == code.to_string())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sentences_are_told_from_noise() {
        assert!(holds_a_sentence(&format!("\u{fffd}x${}", sentence("GPRMC,1").trim_start_matches('$'))));
        assert!(!holds_a_sentence("$GPRMC,1*00\r\n$GP"));
        assert!(answered(&sentence("PGRMC,A,,100,,,,,,A,8,,2,4,"), 8));
        assert!(!answered(&sentence("PGRMC,A,,100,,,,,,A,5,,2,4,"), 8));
    }
}
