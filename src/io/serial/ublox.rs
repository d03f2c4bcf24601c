//! Configures a u-blox receiver over its line and checks its acknowledgements.
//!
//! From the ninth generation on a setting is a key and a value (UBX-CFG-VALSET). A packet is refused as a whole where
//! one of its keys is not known. Ports differ between modules, so each port has its own packet, and one of them must be
//! accepted. Older receivers use UBX-CFG-RATE and UBX-CFG-MSG, for the port over which they arrive. All settings go to
//! the receiver's volatile memory. Source: u-blox's interface descriptions.

use super::{ANSWER, Step};
use windhover_base::time::MonoTime;
use windhover_decode::{ubx_framed, ubx_packets};

/// Classes and identities.
const CFG: u8 = 0x06;
const CFG_VALSET: u8 = 0x8A;
const CFG_MSG: u8 = 0x01;
const CFG_RATE: u8 = 0x08;
const ACK: u8 = 0x05;
const NAV_PVT: (u8, u8) = (0x01, 0x07);
const NAV_COV: (u8, u8) = (0x01, 0x36);
const NAV_RELPOSNED: (u8, u8) = (0x01, 0x3C);
/// Class of standard sentences, and how many of its identities are switched off: GGA, GLL, GSA, GSV, RMC, VTG.
const SENTENCES: (u8, u8) = (0xF0, 6);

/// Keys of the rate: between measurements, ms, and measurements to a solution.
const KEY_RATE_MEAS: u32 = 0x3021_0001;
const KEY_RATE_NAV: u32 = 0x3021_0002;
/// A port's keys: UBX out, sentences out, NAV-PVT, NAV-COV, NAV-RELPOSNED.
const PORTS: [[u32; 5]; 3] = [
    [0x1074_0001, 0x1074_0002, 0x2091_0007, 0x2091_0084, 0x2091_008E],
    [0x1076_0001, 0x1076_0002, 0x2091_0008, 0x2091_0085, 0x2091_008F],
    [0x1078_0001, 0x1078_0002, 0x2091_0009, 0x2091_0086, 0x2091_0090],
];

/// Whether the receiver must accept a packet.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Need {
    /// It must be accepted.
    Must,
    /// One of several consecutive ones must be accepted.
    OneOf,
    /// It may be refused: not every receiver has the setting.
    May,
}

/// A packet that is acknowledged.
#[derive(Clone, Debug)]
struct Request {
    identity: u8,
    payload: Vec<u8>,
    need: Need,
    what: &'static str,
}

/// Walks through the configuration, one packet at a time.
#[derive(Debug)]
pub(super) struct UbloxSetup {
    rate_hz: f64,
    keep_text: bool,
    /// Whether it accepts keys; otherwise the messages of older receivers follow.
    has_keys: bool,
    requests: std::vec::IntoIter<Request>,
    asked: Option<(Request, MonoTime)>,
    received: Vec<u8>,
    accepted: u32,
    /// For a group of which one must be accepted: whether one was.
    one_of: Option<(bool, &'static str)>,
}

impl UbloxSetup {
    pub(super) fn new(rate_hz: f64, keep_text: bool) -> Self {
        let requests = by_keys(rate_hz, keep_text).into_iter();
        let (asked, received, one_of) = (None, Vec::new(), None);
        Self { rate_hz, keep_text, has_keys: true, requests, asked, received, accepted: 0, one_of }
    }

    /// Adds bytes that the receiver sent.
    pub(super) fn received(&mut self, bytes: &[u8]) {
        const KEEP: usize = 4096;
        self.received.extend_from_slice(bytes);
        let excess = self.received.len().saturating_sub(KEEP);
        self.received.drain(..excess);
    }

    /// What to do at `now`.
    pub(super) fn due(&mut self, now: MonoTime) -> Step {
        loop {
            let Some((request, since)) = &self.asked else {
                match self.ask(now) {
                    Some(step) => return step,
                    None => continue,
                }
            };
            let taken = self.answer(request.identity);
            if taken.is_none() && now < *since + ANSWER {
                return Step::Wait(*since + ANSWER);
            }
            let (need, what) = (request.need, request.what);
            self.asked = None;
            self.accepted += u32::from(taken == Some(true));
            if need == Need::OneOf {
                let before = self.one_of.is_some_and(|(taken, _)| taken);
                self.one_of = Some((before || taken == Some(true), what));
            }
            if need == Need::Must && taken != Some(true) {
                if self.has_keys {
                    self.has_keys = false;
                    self.requests = by_messages(self.rate_hz, self.keep_text).into_iter();
                    continue;
                }
                let did = if taken.is_some() { "refused" } else { "did not answer" };
                return Step::Refused(format!("the receiver {did} {what}; is it a u-blox?"));
            }
        }
    }

    /// The next packet, or the end; `None` where the result of a group has to be checked first.
    fn ask(&mut self, now: MonoTime) -> Option<Step> {
        let next = self.requests.next();
        if next.as_ref().is_none_or(|next| next.need != Need::OneOf)
            && let Some((false, what)) = self.one_of.take()
        {
            return Some(Step::Refused(format!("no port of the receiver accepts {what}")));
        }
        let Some(request) = next else { return Some(Step::Accepted(self.accepted)) };
        let packet = ubx_framed(CFG, request.identity, &request.payload);
        self.received.clear();
        self.asked = Some((request, now));
        Some(Step::Send(packet))
    }

    /// Whether the last packet was acknowledged or refused.
    fn answer(&self, identity: u8) -> Option<bool> {
        let of = |(class, id, payload): (u8, u8, &[u8])| {
            (class == ACK && payload.starts_with(&[CFG, identity])).then_some(id == 1)
        };
        ubx_packets(&self.received).find_map(of)
    }
}

/// Between measurements, ms.
fn period_ms(rate_hz: f64) -> u16 {
    (1_000.0 / rate_hz).round().clamp(25.0, 65_535.0) as u16
}

/// By keys: the rate, then each port.
fn by_keys(rate_hz: f64, keep_text: bool) -> Vec<Request> {
    let valset = |pairs: &[(u32, &[u8])], need, what| {
        // Version, volatile memory, two reserved bytes.
        let mut payload = vec![0, 1, 0, 0];
        for (key, value) in pairs {
            payload.extend_from_slice(&key.to_le_bytes());
            payload.extend_from_slice(value);
        }
        Request { identity: CFG_VALSET, payload, need, what }
    };
    let period = period_ms(rate_hz).to_le_bytes();
    let mut all = vec![valset(&[(KEY_RATE_MEAS, &period), (KEY_RATE_NAV, &[1, 0])], Need::Must, "the rate")];
    for [ubx, _, pvt, ..] in PORTS {
        all.push(valset(&[(ubx, &[1]), (pvt, &[1])], Need::OneOf, "NAV-PVT"));
    }
    for [_, sentences, _, cov, relative] in PORTS {
        all.push(valset(&[(cov, &[1])], Need::May, "NAV-COV"));
        all.push(valset(&[(relative, &[1])], Need::May, "NAV-RELPOSNED"));
        if !keep_text {
            all.push(valset(&[(sentences, &[0])], Need::May, "sentences"));
        }
    }
    all
}

/// By messages for the present port.
fn by_messages(rate_hz: f64, keep_text: bool) -> Vec<Request> {
    let message = |(class, identity): (u8, u8), rate: u8, need, what| Request {
        identity: CFG_MSG,
        payload: vec![class, identity, rate],
        need,
        what,
    };
    let mut rate = period_ms(rate_hz).to_le_bytes().to_vec();
    // One solution for each measurement, in UTC.
    rate.extend([1, 0, 0, 0]);
    let mut all = vec![
        Request { identity: CFG_RATE, payload: rate, need: Need::Must, what: "the rate" },
        message(NAV_PVT, 1, Need::Must, "NAV-PVT"),
        message(NAV_COV, 1, Need::May, "NAV-COV"),
        message(NAV_RELPOSNED, 1, Need::May, "NAV-RELPOSNED"),
    ];
    if !keep_text {
        let (class, count) = SENTENCES;
        all.extend((0..count).map(|identity| message((class, identity), 0, Need::May, "sentences")));
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use windhover_base::time::Span;

    /// Runs the setup against a receiver that answers a packet's identity and payload with yes, no or not at all.
    fn run(keep_text: bool, answer: impl Fn(u8, &[u8]) -> Option<bool>) -> (Step, Vec<Vec<u8>>) {
        let (mut setup, mut sent) = (UbloxSetup::new(5.0, keep_text), Vec::new());
        for pass in 0..2_000 {
            match setup.due(MonoTime::from_ns(0) + Span::from_ms(f64::from(pass) * 50.0)) {
                Step::Wait(_) => {}
                Step::Send(packet) => {
                    let (class, identity, payload) = ubx_packets(&packet).next().expect("a packet");
                    assert_eq!(class, CFG);
                    // Between solutions, in two reads, after an answer to another packet.
                    setup.received(&ubx_framed(1, 7, &[0; 92]));
                    setup.received(&ubx_framed(ACK, 1, &[CFG, 0x77]));
                    if let Some(yes) = answer(identity, payload) {
                        let packet = ubx_framed(ACK, u8::from(yes), &[CFG, identity]);
                        setup.received(&packet[..4]);
                        setup.received(&packet[4..]);
                    }
                    sent.push(packet);
                }
                end => return (end, sent),
            }
        }
        panic!("the setup did not end");
    }

    #[test]
    fn a_receiver_of_keys_is_set_by_port() {
        // It has no second serial port, and no second antenna.
        let key =
            |payload: &[u8], at: usize| u32::from_le_bytes(payload[at..at + 4].try_into().expect("a key"));
        let knows = |key: u32| ![0x1076_0001, 0x2091_0085, 0x1076_0002].contains(&key) && key & 0xFF < 0x8D;
        let (end, sent) = run(false, |identity, payload| {
            (identity == CFG_VALSET).then(|| payload[..4] == [0, 1, 0, 0] && knows(key(payload, 4)))
        });
        assert_eq!(end, Step::Accepted(1 + 2 + 2 + 2));
        assert_eq!(
            sent[0][10..],
            ubx_framed(CFG, CFG_VALSET, &[0, 1, 0, 0, 1, 0, 0x21, 0x30, 200, 0, 2, 0, 0x21, 0x30, 1, 0])
                [10..]
        );
        assert_eq!((sent.len(), run(true, |_, _| Some(true)).1.len()), (13, 10), "sentences are kept");
    }

    #[test]
    fn an_older_receiver_is_set_by_message() {
        for to_keys in [None, Some(false)] {
            let (end, sent) = run(false, |identity, payload| match identity {
                CFG_VALSET => to_keys,
                CFG_MSG => Some(payload[..2] != [0x01, 0x3C]),
                _ => Some(identity == CFG_RATE && payload == [200, 0, 1, 0, 0, 0]),
            });
            assert_eq!((end, sent.len()), (Step::Accepted(1 + 2 + 6), 1 + 1 + 3 + 6));
        }
    }

    #[test]
    fn another_receiver_is_reported() {
        let (silent, sent) = run(false, |_, _| None);
        assert!(
            matches!(&silent, Step::Refused(why) if why.contains("did not answer the rate")),
            "{silent:?}"
        );
        assert_eq!(sent.len(), 2);
        let (old, _) =
            run(false, |identity, payload| Some(identity == CFG_RATE || payload[..2] == [0xF0, 0]));
        assert!(matches!(&old, Step::Refused(why) if why.contains("refused NAV-PVT")), "{old:?}");
        let (no_port, _) = run(false, |_, payload| Some(payload[4..8] == KEY_RATE_MEAS.to_le_bytes()));
        assert!(matches!(&no_port, Step::Refused(why) if why.contains("no port")), "{no_port:?}");
    }
}
