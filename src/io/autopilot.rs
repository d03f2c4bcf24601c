//! The connection to the helicopter's autopilot as a task: a serial line or a UDP port, in both directions.

use std::collections::VecDeque;
use std::convert::Infallible;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::net::UdpSocket;
use tokio::sync::Notify;

use super::clock::HostClock;
use super::device::{Backoff, Fault, NoteKind, Report, Reports, wait_for};
use super::mavlink::companion::Companion;
use super::mavlink::packet::{self, SigningKey};
use super::serial::{Line, SerialSettings};
use windhover_base::settings::Framing;
use windhover_decode::{MavlinkFrame, MavlinkFrames};

/// Frames that wait while the line accepts none; the oldest is dropped first.
const WAITING: usize = 64;
/// Bytes one read can return.
const READ_BYTES: usize = 4096;

/// How the autopilot is reached.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum AutopilotAddress {
    /// Over a serial line.
    Serial {
        /// Its device.
        device: String,
        /// Its speed.
        baud: u32,
    },
    /// At this local UDP address.
    Udp(String),
}

/// The settings of the task.
#[derive(Clone, Debug)]
pub struct AutopilotSettings {
    /// How it is reached.
    pub reached: AutopilotAddress,
    /// Its system id; where `None`, the first system that is received.
    pub system_id: Option<u8>,
    /// Whether the messages that are used are requested from it.
    pub configure: bool,
    /// Frames that are not signed with it are refused.
    pub key: Option<SigningKey>,
    /// Link id of our signatures.
    pub signing_link_id: u8,
}

/// Frames on their way to the autopilot. Copies share the same queue; no call waits.
#[derive(Clone, Debug, Default)]
pub struct ToAutopilot {
    frames: Arc<Mutex<VecDeque<Vec<u8>>>>,
    come: Arc<Notify>,
}

impl ToAutopilot {
    /// Queues a frame.
    pub fn send(&self, frame: &[u8]) {
        let mut frames = self.frames.lock().unwrap_or_else(PoisonError::into_inner);
        if frames.len() == WAITING {
            frames.pop_front();
        }
        frames.push_back(frame.to_vec());
        drop(frames);
        self.come.notify_one();
    }

    fn take(&self) -> VecDeque<Vec<u8>> {
        std::mem::take(&mut *self.frames.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

/// Receives from the autopilot without end, and sends it the queued frames; dropping the future closes the connection.
pub async fn run(
    settings: &AutopilotSettings,
    outgoing: &ToAutopilot,
    clock: HostClock,
    reports: Reports<'_>,
) -> Infallible {
    let mut backoff = Backoff::new();
    loop {
        let fault = match Port::open(&settings.reached).await {
            Ok(port) => {
                reports(Report::Up(port.words()));
                let signed_with = settings.key.clone().map(|key| (key, settings.signing_link_id));
                let companion = Companion::new(settings.system_id, settings.configure).signing(signed_with);
                let frames = MavlinkFrames::default();
                let mut link = AutopilotLink { port, companion, frames, settings, clock, reports };
                let fault = match link.serve(outgoing, &mut backoff).await {
                    Ok(never) => match never {},
                    Err(fault) => fault,
                };
                link.port.close().await;
                fault
            }
            Err(fault) => fault,
        };
        reports(Report::Down(fault));
        backoff.wait(reports).await;
    }
}

/// An open connection to the autopilot.
enum Port {
    Serial(Line, String),
    Udp { socket: UdpSocket, address: String, peer: Option<SocketAddr>, from: Option<SocketAddr> },
}

impl Port {
    async fn open(reached: &AutopilotAddress) -> Result<Self, Fault> {
        match reached {
            AutopilotAddress::Serial { device, baud } => {
                let settings = SerialSettings {
                    device: device.clone(),
                    baud: *baud,
                    framing: Framing::default(),
                    text: false,
                    setup: None,
                };
                let line = Line::open(&settings).await?;
                Ok(Self::Serial(line, format!("{device} at {baud} baud")))
            }
            AutopilotAddress::Udp(address) => {
                let socket = UdpSocket::bind(address).await.map_err(|e| Fault::from_io(address, &e))?;
                Ok(Self::Udp { socket, address: address.clone(), peer: None, from: None })
            }
        }
    }

    fn words(&self) -> String {
        match self {
            Self::Serial(_, words) => words.clone(),
            Self::Udp { address, .. } => format!("udp://{address}"),
        }
    }

    async fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Fault> {
        match self {
            Self::Serial(line, _) => line.read(buffer).await,
            Self::Udp { socket, address, from, .. } => {
                let (count, sender) =
                    socket.recv_from(buffer).await.map_err(|e| Fault::from_io(address, &e))?;
                *from = Some(sender);
                Ok(count)
            }
        }
    }

    /// Sets the sender of the last datagram as the autopilot's address.
    fn answer_there(&mut self) {
        if let Self::Udp { peer, from, .. } = self {
            *peer = *from;
        }
    }

    async fn write(&mut self, frame: &[u8]) -> Result<(), Fault> {
        match self {
            Self::Serial(line, _) => line.write(frame).await,
            // A datagram that cannot be sent is lost, as any datagram may be.
            Self::Udp { socket, peer, .. } => {
                if let Some(peer) = peer {
                    let _ = socket.send_to(frame, *peer).await;
                }
                Ok(())
            }
        }
    }

    async fn close(self) {
        if let Self::Serial(line, _) = self {
            line.close().await;
        }
    }
}

struct AutopilotLink<'a> {
    port: Port,
    companion: Companion,
    frames: MavlinkFrames,
    settings: &'a AutopilotSettings,
    clock: HostClock,
    reports: Reports<'a>,
}

impl AutopilotLink<'_> {
    async fn serve(&mut self, outgoing: &ToAutopilot, backoff: &mut Backoff) -> Result<Infallible, Fault> {
        let mut second = tokio::time::interval(Duration::from_secs(1));
        second.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
        let mut buffer = vec![0; READ_BYTES];
        loop {
            let mut answers = Vec::new();
            tokio::select! {
                count = wait_for(self.port.read(&mut buffer), self.reports) => {
                    let count = count?;
                    backoff.reset();
                    self.take(&buffer[..count], &mut answers);
                }
                _ = second.tick() => self.companion.every_second(self.clock.now(), &mut answers),
                () = outgoing.come.notified() => answers.extend(outgoing.take()),
            }
            for frame in answers {
                self.port.write(&frame).await?;
            }
            for note in self.companion.notes() {
                (self.reports)(Report::Note(NoteKind::Autopilot, 1, note));
            }
        }
    }

    /// Bytes are passed on unchanged; with a key, only frames that are signed with it.
    fn take(&mut self, bytes: &[u8], answers: &mut Vec<Vec<u8>>) {
        let t = self.clock.now();
        let mut received = Vec::new();
        self.frames.push(bytes, &mut received);
        if let Some(key) = &self.settings.key {
            let before = received.len();
            received.retain(|frame| packet::verify(&frame.bytes, key).is_ok());
            if received.len() < before {
                let words = "frames that are not signed with mavlink.signing_key are refused".to_owned();
                (self.reports)(Report::Note(NoteKind::Autopilot, (before - received.len()) as u32, words));
            }
        }
        let mut its = false;
        for frame in &received {
            its |= self.companion.receive(frame, t, answers);
        }
        if its {
            self.port.answer_there();
        }
        let whole =
            |received: &[MavlinkFrame]| received.iter().flat_map(|frame| frame.bytes.clone()).collect();
        let believed: Vec<u8> = if self.settings.key.is_some() { whole(&received) } else { bytes.to_vec() };
        if !believed.is_empty() {
            (self.reports)(Report::Bytes(t, believed));
        }
    }
}

#[cfg(test)]
mod tests {
    use mavlink::dialects::development::*;
    use tokio::sync::mpsc;

    use super::*;
    use crate::io::mavlink::packet::{Sender, Signature};

    const SENDER: Sender = Sender { system: 1, component: 1 };

    fn heartbeat() -> MavMessage {
        MavMessage::HEARTBEAT(HEARTBEAT_DATA {
            mavtype: MavType::MAV_TYPE_HELICOPTER,
            autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
            ..HEARTBEAT_DATA::DEFAULT
        })
    }

    /// The task's reports for these datagrams, and what it sends within a moment.
    async fn served(key: Option<SigningKey>, datagrams: Vec<Vec<u8>>) -> (Vec<Report>, Vec<MavlinkFrame>) {
        let port = UdpSocket::bind("127.0.0.1:0").await.expect("a port").local_addr().expect("an address");
        let autopilot = UdpSocket::bind("127.0.0.1:0").await.expect("a socket");
        let settings = AutopilotSettings {
            reached: AutopilotAddress::Udp(port.to_string()),
            system_id: None,
            configure: false,
            key,
            signing_link_id: 1,
        };
        let (sender, mut given) = mpsc::unbounded_channel();
        let reports = move |report| drop(sender.send(report));
        let outgoing = ToAutopilot::default();
        let flying = async {
            for datagram in datagrams {
                tokio::time::sleep(Duration::from_millis(100)).await;
                autopilot.send_to(&datagram, port).await.expect("sent");
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
            outgoing.send(b"to the autopilot");
            let (mut frames, mut all, mut buffer) = (MavlinkFrames::default(), Vec::new(), [0; 512]);
            let wait = Duration::from_millis(1_500);
            while let Ok(Ok(count)) = tokio::time::timeout(wait, autopilot.recv(&mut buffer)).await {
                frames.push(&buffer[..count], &mut all);
                if all.len() >= 2 {
                    break;
                }
            }
            all
        };
        let clock = HostClock::start();
        let received = tokio::select! {
            never = run(&settings, &outgoing, clock, &reports) => match never {},
            received = flying => received,
        };
        let mut all = Vec::new();
        while let Ok(report) = given.try_recv() {
            if !matches!(report, Report::Beat) {
                all.push(report);
            }
        }
        (all, received)
    }

    fn bytes(reports: &[Report]) -> Vec<Vec<u8>> {
        let of =
            |report: &Report| if let Report::Bytes(_, bytes) = report { Some(bytes.clone()) } else { None };
        reports.iter().filter_map(of).collect()
    }

    #[tokio::test]
    async fn frames_are_passed_on_unchanged_and_their_time_is_requested() {
        let beat = packet::encode(0, SENDER, &heartbeat(), None);
        let (reports, received) = served(None, vec![beat.clone()]).await;
        assert_eq!(bytes(&reports), [beat]);
        assert!(
            received
                .iter()
                .any(|frame| matches!(&frame.message, MavMessage::TIMESYNC(sync) if sync.tc1 == 0))
        );
        assert!(received.iter().all(|frame| (frame.system, frame.component) == (1, 191)));
    }

    #[tokio::test]
    async fn with_a_key_only_frames_signed_with_it_are_used() {
        let (key, wrong) = (SigningKey([1; 32]), SigningKey([2; 32]));
        let signed = |key, time_stamp| {
            let signature = Signature { key, link_id: 0, time_stamp };
            packet::encode(0, SENDER, &heartbeat(), Some(signature))
        };
        let good = signed(&key, 1);
        let sent = vec![packet::encode(0, SENDER, &heartbeat(), None), signed(&wrong, 1), good.clone()];
        let (reports, _) = served(Some(key), sent).await;
        assert_eq!(bytes(&reports), [good]);
        let refused = |report: &&Report| matches!(report, Report::Note(NoteKind::Autopilot, _, words) if words.contains("not signed"));
        assert_eq!(reports.iter().filter(refused).count(), 2);
    }
}
