//! Configures a Garmin receiver over its line and checks its answers.
//!
//! Source: Garmin GPS 18x technical specifications, "Received NMEA 0183 sentences". An echo of a
//! sentence means accepted; an echo with other values means refused.

use super::{ANSWER, Step};
use windhover_base::time::MonoTime;
use windhover_decode::{Sentence, framed};

/// Sentences sent, in order: all sentences off; position averaging off and NMEA 2.30 mode indicators
/// on (PGRMC1 fields 3 and 7: averaging would freeze a hovering helicopter); then those decoded on.
/// Bodies without `$` and checksum. `PGRMO` is not echoed by every firmware, so only `PGRMC1` must
/// be answered.
const SENTENCES: [(&str, bool); 7] = [
    ("PGRMO,,2", false),
    ("PGRMC1,1,1,1,,,,2", true),
    ("PGRMO,GPRMC,1", false),
    ("PGRMO,GPGGA,1", false),
    // Only GSA reports a two-dimensional fix; its GGA still has an altitude.
    ("PGRMO,GPGSA,1", false),
    ("PGRMO,PGRME,1", false),
    ("PGRMO,PGRMV,1", false),
];

/// Walks through the configuration, one sentence at a time.
#[derive(Debug)]
pub(super) struct GarminSetup {
    next: usize,
    asked: Option<MonoTime>,
    received: Vec<u8>,
    accepted: u32,
}

impl GarminSetup {
    pub(super) const fn new() -> Self {
        Self { next: 0, asked: None, received: Vec::new(), accepted: 0 }
    }

    /// Adds bytes that the receiver sent.
    pub(super) fn received(&mut self, bytes: &[u8]) {
        const KEEP: usize = 2048;
        self.received.extend_from_slice(bytes);
        let excess = self.received.len().saturating_sub(KEEP);
        self.received.drain(..excess);
    }

    /// What to do at `now`.
    pub(super) fn due(&mut self, now: MonoTime) -> Step {
        loop {
            let Some((body, must_answer)) = SENTENCES.get(self.next).copied() else {
                return Step::Accepted(self.accepted);
            };
            let Some(asked) = self.asked else {
                self.asked = Some(now);
                self.received.clear();
                return Step::Send(sentence(body).into_bytes());
            };
            match self.answer(body) {
                Some(true) => self.accepted += 1,
                Some(false) => {
                    return Step::Refused(format!("the receiver answered {body} with other values"));
                }
                None if now < asked + ANSWER => return Step::Wait(asked + ANSWER),
                None if must_answer => {
                    return Step::Refused(format!("the receiver did not answer {body}; is it a Garmin?"));
                }
                None => {}
            }
            self.advance();
        }
    }

    fn advance(&mut self) {
        self.next += 1;
        self.asked = None;
    }

    /// Whether the receiver echoed `body` (more fields at its end are accepted), with other values, or not at all
    /// (`None`).
    fn answer(&self, body: &str) -> Option<bool> {
        let text = String::from_utf8_lossy(&self.received);
        let name = body.split(',').next().unwrap_or(body);
        let echo = bodies(&text).find(|echo| echo.split(',').next() == Some(name))?;
        let same = body
            .split(',')
            .zip(echo.split(',').chain(std::iter::repeat("")))
            .all(|(asked, answered)| asked.is_empty() || asked == answered);
        Some(same)
    }
}

/// A sentence as it is sent.
pub(super) fn sentence(body: &str) -> String {
    framed(body) + "\r\n"
}

/// Bodies of the sentences in a text with correct checksums.
pub(super) fn bodies(text: &str) -> impl Iterator<Item = &str> {
    text.match_indices('$').filter_map(|(at, _)| {
        let rest = &text[at..];
        let line = rest.get(..rest.find('*')? + 3)?;
        Sentence::of_line(line.as_bytes()).ok().map(|sentence| sentence.body)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use windhover_base::time::Span;

    fn at(ms: f64) -> MonoTime {
        MonoTime::from_ns(0) + Span::from_ms(ms)
    }

    /// Runs the setup against a receiver that answers through `answer`.
    fn run(answer: impl Fn(&str) -> Option<String>) -> Step {
        let mut setup = GarminSetup::new();
        for pass in 0..1000 {
            match setup.due(at(f64::from(pass) * 50.0)) {
                Step::Wait(_) => {}
                Step::Send(sentence) => {
                    if let Some(echo) = answer(&String::from_utf8_lossy(&sentence)) {
                        setup.received(echo.as_bytes());
                    }
                }
                end => return end,
            }
        }
        panic!("the setup did not end");
    }

    #[test]
    fn sentences_carry_their_checksum() {
        assert_eq!(sentence("PGRMO,,2"), "$PGRMO,,2*75\r\n");
    }

    #[test]
    fn echoes_are_checked() {
        assert_eq!(run(|sentence| Some(sentence.to_owned())), Step::Accepted(7));
        let silent = run(|_| None);
        assert!(matches!(&silent, Step::Refused(why) if why.contains("did not answer PGRMC1")), "{silent:?}");
        let other = run(|s| bodies(s).next().map(|body| sentence(&body.replace("1,1,1,", "1,1,2,"))));
        assert!(matches!(&other, Step::Refused(why) if why.contains("other values")), "{other:?}");
        let damaged = run(|s| Some(s.replace("1,1,1,", "1,1,2,")));
        assert!(matches!(&damaged, Step::Refused(why) if why.contains("did not answer")), "{damaged:?}");
    }

    #[test]
    fn only_the_important_answer_is_required() {
        let step = run(|s| s.starts_with("$PGRMC1").then(|| s.to_owned()));
        assert_eq!(step, Step::Accepted(1));
    }
}
