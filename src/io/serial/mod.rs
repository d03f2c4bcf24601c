//! One serial line on its own thread: open, read, tell, and open again when it went away.

mod garbled;
mod garmin;
mod garmin_speed;

use std::io::{ErrorKind as IoKind, Read, Write};
use std::path::Path;
use std::time::Duration;

use serialport::TTYPort;

use super::clock::HostClock;
use super::device::{Backoff, Fault, FaultKind, NAP, NoteKind, Report, Stop};
use garbled::TextShare;
use garmin::GarminSetup;
use garmin_speed::Settling;

/// What a line is and how it is set.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct SerialSettings {
    /// Path of the device; opened anew by this name each time, so a `by-id` path survives renumbering.
    pub device: String,
    /// Line speed, bits a second.
    pub baud: u32,
    /// Whether what arrives is text: then bytes that are not tell of a wrong line speed.
    pub text: bool,
    /// Configure a Garmin receiver each time the line is opened.
    pub configure_garmin: bool,
}

/// Bytes one read can return; a line at 2 Mbit/s fills it in 20 ms.
const READ_BYTES: usize = 4096;

/// Reads the line until the end is asked for. Runs on the calling thread; everything it has to say
/// goes through `tell`, at least every 100 ms.
pub fn run(settings: &SerialSettings, clock: HostClock, stop: &Stop, tell: &dyn Fn(Report)) {
    let mut backoff = Backoff::new();
    while !stop.asked() {
        let fault = match open(settings) {
            Ok(port) => {
                tell(Report::Up(format!("{} at {} baud", settings.device, settings.baud)));
                match read_until_lost(port, settings, clock, stop, tell, &mut backoff) {
                    Some(fault) => fault,
                    None => return,
                }
            }
            Err(fault) => fault,
        };
        tell(Report::Down(fault));
        backoff.wait(stop, tell);
    }
}

/// Opens the line for this program alone. A device that is busy, missing, forbidden or no serial
/// line is told apart.
fn open(settings: &SerialSettings) -> Result<TTYPort, Fault> {
    let device = settings.device.as_str();
    if settings.baud == 0 {
        return Err(Fault::new(FaultKind::Unsuitable, device, "line speed 0 hangs up; set baud"));
    }
    // The serial library folds several errors into one; the plain system calls tell them apart.
    std::fs::metadata(device).map_err(|e| Fault::from_io(device, &e))?;
    let builder = serialport::new(device, settings.baud).timeout(NAP);
    TTYPort::open(&builder).map_err(|error| fault_from_open(device, settings.baud, &error))
}

fn fault_from_open(device: &str, baud: u32, error: &serialport::Error) -> Fault {
    use serialport::ErrorKind;
    match error.kind() {
        ErrorKind::NoDevice => {
            Fault::new(FaultKind::Busy, device, "another program holds the port; stop that program")
        }
        ErrorKind::Io(IoKind::NotFound) => {
            Fault::new(FaultKind::Missing, device, "not there; is it plugged in?")
        }
        ErrorKind::Io(IoKind::PermissionDenied) => Fault::new(
            FaultKind::Denied,
            device,
            "permission denied; add this user to the group that owns it (dialout)",
        ),
        _ if !Path::new(device).exists() => {
            Fault::new(FaultKind::Missing, device, "not there; is it plugged in?")
        }
        ErrorKind::InvalidInput => {
            Fault::new(FaultKind::Unsuitable, device, format!("{error}; does it do {baud} baud?"))
        }
        _ => Fault::new(FaultKind::Failed, device, format!("cannot be opened as a serial line: {error}")),
    }
}

/// Reads until the line is lost (the fault) or the end is asked for (`None`).
fn read_until_lost(
    mut port: TTYPort,
    settings: &SerialSettings,
    clock: HostClock,
    stop: &Stop,
    tell: &dyn Fn(Report),
    backoff: &mut Backoff,
) -> Option<Fault> {
    let mut buffer = vec![0; READ_BYTES];
    let mut share = TextShare::default();
    let mut setup = None;
    if settings.configure_garmin {
        if let Err(fault) = (Settling { port: &mut port, settings, clock, stop, tell }).settle() {
            return Some(fault);
        }
        setup = Some(GarminSetup::new());
    }
    while !stop.asked() {
        let now = clock.now();
        if let Some(step) = setup.as_mut().map(|setup| setup.due(now))
            && let Err(fault) = garmin_step(step, &mut port, settings, tell, &mut setup)
        {
            return Some(fault);
        }
        match port.read(&mut buffer) {
            Ok(0) => return Some(unplugged(&settings.device)),
            Ok(count) => {
                let bytes = &buffer[..count];
                tell(Report::Bytes(clock.now(), bytes.to_vec()));
                backoff.reset();
                if let Some(setup) = &mut setup {
                    setup.heard(bytes);
                }
                if settings.text
                    && let Some(percent) = share.garbled(bytes)
                {
                    let text = format!(
                        "{percent} % of what {} sends is no text; is its line speed {} baud?",
                        settings.device, settings.baud
                    );
                    tell(Report::Note(NoteKind::Garbled, 1, text));
                }
            }
            Err(error) if matches!(error.kind(), IoKind::TimedOut | IoKind::Interrupted) => {}
            Err(_) => return Some(unplugged(&settings.device)),
        }
        tell(Report::Beat);
    }
    None
}

/// Does one step of a receiver's configuration; the setup ends itself when it is through.
fn garmin_step(
    step: garmin::Step,
    port: &mut TTYPort,
    settings: &SerialSettings,
    tell: &dyn Fn(Report),
    setup: &mut Option<GarminSetup>,
) -> Result<(), Fault> {
    match step {
        garmin::Step::Wait => {}
        garmin::Step::Send(sentence) => {
            port.write_all(sentence.as_bytes()).map_err(|_| unplugged(&settings.device))?;
        }
        garmin::Step::Accepted(count) => {
            tell(Report::Note(NoteKind::Configured, count, format!("{count} settings accepted")));
            *setup = None;
        }
        garmin::Step::Refused(what) => {
            tell(Report::Note(NoteKind::NotConfigured, 1, what));
            *setup = None;
        }
    }
    Ok(())
}

fn unplugged(device: &str) -> Fault {
    Fault::new(FaultKind::Unplugged, device, "the line went away; waiting for it to come back")
}

/// How long a receiver has to answer a configuration sentence.
const GARMIN_ANSWER: Duration = Duration::from_millis(1500);

#[cfg(test)]
mod tests;
