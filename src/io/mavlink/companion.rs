//! Messages to the helicopter's own autopilot apart from the vehicles: heartbeat, time, and requests for messages.

use mavlink::MessageData as _;
use mavlink::dialects::development::*;

use windhover_base::time::{MonoTime, RemoteClock, Span, UtcTime};
use windhover_decode::{MavlinkFrame, is_autopilot, timesync_asked, timesync_question};

use super::messages;
use super::packet::{self, Sender, Signature, SigningKey};

/// MAV_COMP_ID_ONBOARD_COMPUTER.
const COMPANION: u8 = 191;
/// MAV_COMP_ID_AUTOPILOT1.
const AUTOPILOT: u8 = 1;
/// Messages that are used, and the rate of each, a second. ArduPilot has SCALED_IMU, PX4 HIGHRES_IMU.
const WANTED: [(u32, f32); 6] = [
    (ATTITUDE_QUATERNION_DATA::ID, 25.0),
    (SCALED_IMU_DATA::ID, 50.0),
    (HIGHRES_IMU_DATA::ID, 50.0),
    (GPS_RAW_INT_DATA::ID, 10.0),
    (GLOBAL_POSITION_INT_DATA::ID, 10.0),
    (SYSTEM_TIME_DATA::ID, 1.0),
];

/// Our side of the connection to the autopilot.
#[derive(Clone, Debug, Default)]
pub struct Companion {
    wanted: Option<u8>,
    configure: bool,
    system: Option<u8>,
    /// Another autopilot that was received and reported.
    another: Option<u8>,
    clock: RemoteClock,
    restarts: u32,
    configured: bool,
    sequence: u8,
    signed_with: Option<(SigningKey, u8)>,
    stamp: u64,
    notes: Vec<String>,
}

impl Companion {
    /// For this system; for the first autopilot that is received where `None`.
    pub fn new(wanted: Option<u8>, configure: bool) -> Self {
        Self { wanted, configure, ..Self::default() }
    }

    /// Signs its messages with this key, under this link id.
    pub fn signing(self, signed_with: Option<(SigningKey, u8)>) -> Self {
        Self { signed_with, ..self }
    }

    /// Handles a frame received at `t`; returns whether it is the autopilot's. Appends the answers.
    pub fn receive(&mut self, frame: &MavlinkFrame, t: MonoTime, out: &mut Vec<Vec<u8>>) -> bool {
        if is_autopilot(frame) && self.wanted.is_none_or(|wanted| wanted == frame.system) {
            let system = *self.system.get_or_insert_with(|| {
                self.notes.push(format!("system {} is used", frame.system));
                frame.system
            });
            if system != frame.system && self.another != Some(frame.system) {
                self.another = Some(frame.system);
                let words = format!("system {} is an autopilot too, and is ignored", frame.system);
                self.notes.push(words);
            }
        }
        if self.system != Some(frame.system) || frame.component != AUTOPILOT {
            return false;
        }
        match &frame.message {
            MavMessage::TIMESYNC(sync) if sync.tc1 == 0 => self.tell_time(sync.ts1, t, out),
            MavMessage::TIMESYNC(sync) => {
                if let Some(sent) = timesync_asked(sync.ts1) {
                    self.clock.exchanged(sent, Span::from_ns(sync.tc1), t);
                }
            }
            MavMessage::SYSTEM_TIME(time) => self.beat(time.time_boot_ms, t),
            MavMessage::ATTITUDE(attitude) => self.beat(attitude.time_boot_ms, t),
            MavMessage::GLOBAL_POSITION_INT(place) => self.beat(place.time_boot_ms, t),
            _ => {}
        }
        true
    }

    fn beat(&mut self, time_boot_ms: u32, t: MonoTime) {
        self.clock.observe(Span::from_ns(i64::from(time_boot_ms) * 1_000_000), t);
        if self.clock.restarts() != self.restarts {
            self.restarts = self.clock.restarts();
            self.configured = false;
            self.notes.push("it was restarted, or its clock stepped".into());
        }
    }

    /// A time request of the autopilot is answered in its own time: then all stamps are on one clock, and its estimate
    /// of the difference is zero.
    fn tell_time(&mut self, ts1: i64, t: MonoTime, out: &mut Vec<Vec<u8>>) {
        let Some(remote) = self.clock.remote(t).filter(|_| self.clock.is_exchanged()) else { return };
        let answer = TIMESYNC_DATA { tc1: remote.ns(), ts1, ..TIMESYNC_DATA::DEFAULT };
        self.put(&MavMessage::TIMESYNC(answer), t, out);
    }

    /// Messages sent once a second; none before the autopilot was received.
    pub fn every_second(&mut self, now: MonoTime, out: &mut Vec<Vec<u8>>) {
        let Some(system) = self.system else { return };
        self.put(&messages::heartbeat_of(MavType::MAV_TYPE_ONBOARD_CONTROLLER), now, out);
        let question = TIMESYNC_DATA {
            tc1: 0,
            ts1: timesync_question(now),
            target_system: system,
            target_component: AUTOPILOT,
        };
        self.put(&MavMessage::TIMESYNC(question), now, out);
        if self.configure && !self.configured {
            self.configured = true;
            for (id, hz) in WANTED {
                self.put(&interval(system, id, hz), now, out);
            }
        }
    }

    /// Notes for the operator.
    pub fn notes(&mut self) -> Vec<String> {
        std::mem::take(&mut self.notes)
    }

    fn put(&mut self, message: &MavMessage, now: MonoTime, out: &mut Vec<Vec<u8>>) {
        let Some(system) = self.system else { return };
        let sender = Sender { system, component: COMPANION };
        // Host time is near UTC where the computer's clock was set; stamps never go back.
        self.stamp = packet::time_stamp(UtcTime::from_unix_ns(now.ns())).max(self.stamp + 1);
        let time_stamp = self.stamp;
        let signature =
            self.signed_with.as_ref().map(|(key, link_id)| Signature { key, link_id: *link_id, time_stamp });
        out.push(packet::encode(self.sequence, sender, message, signature));
        self.sequence = self.sequence.wrapping_add(1);
    }
}

/// The command that requests a message at an interval.
fn interval(system: u8, id: u32, hz: f32) -> MavMessage {
    MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
        command: MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL,
        param1: id as f32,
        param2: 1e6 / hz,
        target_system: system,
        target_component: AUTOPILOT,
        ..COMMAND_LONG_DATA::DEFAULT
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use windhover_decode::MavlinkFrames;

    fn at(s: f64) -> MonoTime {
        MonoTime::from_ns(1_700_000_000_000_000_000) + Span::from_s(s)
    }

    fn frames(bytes: &[Vec<u8>]) -> Vec<MavlinkFrame> {
        let mut out = Vec::new();
        bytes.iter().for_each(|frame| MavlinkFrames::default().push(frame, &mut out));
        out
    }

    fn of(system: u8, message: &MavMessage) -> MavlinkFrame {
        let bytes = packet::encode(0, Sender { system, component: AUTOPILOT }, message, None);
        frames(&[bytes]).remove(0)
    }

    fn heartbeat() -> MavMessage {
        MavMessage::HEARTBEAT(HEARTBEAT_DATA {
            autopilot: MavAutopilot::MAV_AUTOPILOT_PX4,
            mavtype: MavType::MAV_TYPE_HELICOPTER,
            ..HEARTBEAT_DATA::DEFAULT
        })
    }

    #[test]
    fn nothing_is_sent_before_the_first_frame_and_then_its_time_is_requested() {
        let mut companion = Companion::new(None, true);
        let mut said = Vec::new();
        companion.every_second(at(0.0), &mut said);
        assert!(said.is_empty());
        assert!(companion.receive(&of(3, &heartbeat()), at(0.5), &mut said));
        companion.every_second(at(1.0), &mut said);
        let said = frames(&said);
        assert_eq!(said.len(), 2 + WANTED.len());
        assert!(said.iter().all(|frame| (frame.system, frame.component) == (3, COMPANION)));
        let MavMessage::TIMESYNC(question) = &said[1].message else { panic!("{said:?}") };
        // Its request is answered in its own time, once that is known.
        let mut out = Vec::new();
        let its = MavMessage::TIMESYNC(TIMESYNC_DATA { ts1: 7, ..TIMESYNC_DATA::DEFAULT });
        companion.receive(&of(3, &its), at(1.001), &mut out);
        assert!(out.is_empty());
        let answer = TIMESYNC_DATA { tc1: 50_000_000_000, ts1: question.ts1, ..TIMESYNC_DATA::DEFAULT };
        companion.receive(&of(3, &MavMessage::TIMESYNC(answer)), at(1.004), &mut out);
        companion.receive(&of(3, &its), at(2.002), &mut out);
        let MavMessage::TIMESYNC(answer) = &frames(&out)[0].message else { panic!("{out:?}") };
        assert_eq!(answer.ts1, 7);
        assert!((answer.tc1 - 51_000_000_000).abs() < 1_000_000, "{}", answer.tc1);
    }

    #[test]
    fn with_a_key_all_that_is_said_is_signed() {
        let key = SigningKey([5; 32]);
        let mut companion = Companion::new(None, true).signing(Some((key.clone(), 2)));
        let mut said = Vec::new();
        companion.receive(&of(3, &heartbeat()), at(0.5), &mut said);
        companion.every_second(at(1.0), &mut said);
        let stamps: Vec<u64> =
            said.iter().map(|frame| packet::verify(frame, &key).expect("signed").2).collect();
        assert!(stamps.len() > 2 && stamps.is_sorted_by(|a, b| a < b), "{stamps:?}");
    }

    #[test]
    fn another_autopilot_is_reported_and_not_used() {
        let mut companion = Companion::new(None, false);
        assert!(companion.receive(&of(1, &heartbeat()), at(0.0), &mut Vec::new()));
        assert!(!companion.receive(&of(2, &heartbeat()), at(0.1), &mut Vec::new()));
        assert!(!companion.receive(&of(2, &heartbeat()), at(1.1), &mut Vec::new()));
        assert_eq!(companion.notes().len(), 2);
        let mut second = Companion::new(Some(2), false);
        assert!(!second.receive(&of(1, &heartbeat()), at(0.0), &mut Vec::new()));
        assert!(second.receive(&of(2, &heartbeat()), at(0.1), &mut Vec::new()));
    }

    #[test]
    fn one_that_restarts_is_reported_and_asked_for_its_messages_again() {
        let mut companion = Companion::new(None, true);
        let time = |boot_ms| {
            MavMessage::SYSTEM_TIME(SYSTEM_TIME_DATA { time_boot_ms: boot_ms, ..SYSTEM_TIME_DATA::DEFAULT })
        };
        let mut requests = Vec::new();
        companion.receive(&of(3, &heartbeat()), at(0.0), &mut Vec::new());
        for second in 0..20_u32 {
            let s = f64::from(second);
            // After ten seconds it counts from zero.
            let boot_ms = 1_000 * if second < 10 { 500 + second } else { second - 10 };
            companion.receive(&of(3, &time(boot_ms)), at(s), &mut Vec::new());
            let mut said = Vec::new();
            companion.every_second(at(s + 0.1), &mut said);
            requests.push(said.len() > 2);
        }
        let asked: Vec<usize> = (0..20).filter(|second| requests[*second]).collect();
        assert_eq!(asked, [0, 12], "at the start, and with the third message that shows it");
        assert!(companion.notes().iter().any(|note| note.contains("restarted")));
    }
}
