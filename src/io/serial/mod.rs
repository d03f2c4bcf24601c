//! One line as a task: open, wait for bytes, report them, and reopen when the line disappeared. It may be a serial
//! line, a connection (`tcp://HOST:PORT`, also to gpsd) or a listening port (`udp://ADDRESS:PORT`).

mod garbled;
mod garmin;
mod garmin_speed;
mod line;
mod network;
mod dialogue;
mod ublox;
mod ublox_speed;

use std::convert::Infallible;
use std::time::Duration;

use super::clock::HostClock;
use super::device::{Backoff, Fault, FaultKind, NoteKind, Report, Reports, wait_for};
use dialogue::Dialogue;
use garbled::TextShare;
use garmin::GarminSetup;
pub(super) use line::Line;
use ublox::UbloxSetup;
use windhover_base::settings::Framing;
use windhover_base::time::{MonoTime, Span};

/// A line and its settings.
#[derive(Clone, PartialEq, Debug)]
pub struct SerialSettings {
    /// Path of the device, or its address on the network; reopened by this name each time, so a `by-id` path survives
    /// renumbering.
    pub device: String,
    /// Line speed, bits a second.
    pub baud: u32,
    /// Whether the protocol is text: then other bytes indicate a wrong line speed.
    pub text: bool,
    /// Data bits, parity and stop bits.
    pub framing: Framing,
    /// How the receiver at the other end is configured each time the line is opened.
    pub setup: Option<Setup>,
}

/// How a receiver is configured.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Setup {
    /// A Garmin receiver.
    Garmin,
    /// A u-blox receiver: its rate of solutions; its NMEA sentences are switched off unless they are kept.
    Ublox {
        /// Solutions a second.
        rate_hz: f64,
        /// Whether NMEA sentences stay as they are.
        keep_text: bool,
    },
}

/// Most bytes of one read; a line at 2 Mbit/s fills it in 20 ms.
const READ_BYTES: usize = 4096;

/// How long a receiver has to answer its configuration.
const ANSWER: Span = Span::from_ns(1_500_000_000);

/// Reads the line without end; dropping the future closes it.
pub async fn run(settings: &SerialSettings, clock: HostClock, reports: Reports<'_>) -> Infallible {
    let mut backoff = Backoff::new();
    loop {
        let fault = match Line::open(settings).await {
            Ok(line) => {
                reports(Report::Up(match network::is_network(&settings.device) {
                    true => settings.device.clone(),
                    false => format!("{} at {} baud", settings.device, settings.baud),
                }));
                let mut reader = Reader { line, settings, clock, reports };
                let fault = match reader.read(&mut backoff).await {
                    Ok(never) => match never {},
                    Err(fault) => fault,
                };
                reader.line.close().await;
                fault
            }
            Err(fault) => fault,
        };
        reports(Report::Down(fault));
        backoff.wait(reports).await;
    }
}

/// An open line and the state for reading it.
struct Reader<'a> {
    line: Line,
    settings: &'a SerialSettings,
    clock: HostClock,
    reports: Reports<'a>,
}

impl Reader<'_> {
    /// Reads until the line is lost.
    async fn read(&mut self, backoff: &mut Backoff) -> Result<Infallible, Fault> {
        let mut setup = None;
        if let Some(kind) = self.settings.setup {
            let (settings, clock, reports) = (self.settings, self.clock, self.reports);
            let talk = Dialogue { line: &mut self.line, settings, clock, reports };
            setup = Some(match kind {
                Setup::Garmin => {
                    garmin_speed::settle(talk).await?;
                    Running::Garmin(GarminSetup::new())
                }
                Setup::Ublox { rate_hz, keep_text } => {
                    ublox_speed::settle(talk).await?;
                    Running::Ublox(UbloxSetup::new(rate_hz, keep_text))
                }
            });
        }
        let mut buffer = vec![0; READ_BYTES];
        let mut share = TextShare::default();
        loop {
            let answer_by = match &mut setup {
                Some(running) => self.configure(running).await?,
                None => None,
            };
            if answer_by.is_none() {
                setup = None;
            }
            let Some(count) = self.read_by(answer_by, &mut buffer).await? else { continue };
            let bytes = &buffer[..count];
            (self.reports)(Report::Bytes(self.clock.now(), bytes.to_vec()));
            backoff.reset();
            if let Some(setup) = &mut setup {
                setup.received(bytes);
            }
            self.judge(&mut share, bytes);
        }
    }

    /// Waits for bytes; `None` where none came until `limit`.
    async fn read_by(&mut self, limit: Option<MonoTime>, buffer: &mut [u8]) -> Result<Option<usize>, Fault> {
        let left = limit.map_or(Duration::MAX, |limit| left(limit, self.clock));
        let read = wait_for(self.line.read(buffer), self.reports);
        tokio::time::timeout(left, read).await.ok().transpose()
    }

    /// Reports received bytes that are not text on a text line.
    fn judge(&self, share: &mut TextShare, bytes: &[u8]) {
        if self.settings.text
            && !network::is_network(&self.settings.device)
            && let Some(percent) = share.garbled(bytes)
        {
            let (device, baud) = (&self.settings.device, self.settings.baud);
            let text = format!(
                "{percent} % of the bytes from {device} are not text; is its line speed {baud} baud?"
            );
            (self.reports)(Report::Note(NoteKind::Garbled, 1, text));
        }
    }

    /// Continues a receiver's configuration; returns the time limit of its answer, `None` where the configuration has
    /// ended.
    async fn configure(&mut self, setup: &mut Running) -> Result<Option<MonoTime>, Fault> {
        loop {
            let note = match setup.due(self.clock.now()) {
                Step::Wait(limit) => return Ok(Some(limit)),
                Step::Send(bytes) => {
                    self.line.write(&bytes).await?;
                    continue;
                }
                Step::Accepted(count) => {
                    Report::Note(NoteKind::Configured, count, format!("{count} settings accepted"))
                }
                Step::Refused(what) => Report::Note(NoteKind::NotConfigured, 1, what),
            };
            (self.reports)(note);
            return Ok(None);
        }
    }
}

/// The next step in configuring a receiver.
#[derive(Clone, PartialEq, Eq, Debug)]
enum Step {
    /// Wait until the receiver answers, or until this time.
    Wait(MonoTime),
    /// Write these bytes.
    Send(Vec<u8>),
    /// Complete: this many settings were accepted.
    Accepted(u32),
    /// The receiver refused or ignored a setting.
    Refused(String),
}

/// A configuration in progress.
enum Running {
    Garmin(GarminSetup),
    Ublox(UbloxSetup),
}

impl Running {
    fn received(&mut self, bytes: &[u8]) {
        match self {
            Self::Garmin(setup) => setup.received(bytes),
            Self::Ublox(setup) => setup.received(bytes),
        }
    }

    fn due(&mut self, now: MonoTime) -> Step {
        match self {
            Self::Garmin(setup) => setup.due(now),
            Self::Ublox(setup) => setup.due(now),
        }
    }
}

/// Time left until `limit`.
fn left(limit: MonoTime, clock: HostClock) -> Duration {
    Duration::from_nanos(u64::try_from((limit - clock.now()).ns()).unwrap_or(0))
}

fn unplugged(device: &str) -> Fault {
    Fault::new(FaultKind::Unplugged, device, "the line disappeared; waiting for it to return")
}

#[cfg(test)]
mod tests;
