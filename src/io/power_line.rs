//! A GPIO line that signals a power failure, watched through its chip's character device (Linux `/dev/gpiochipN`).

use std::convert::Infallible;
use std::time::Duration;

use gpiocdev::Request;
use gpiocdev::line::{EdgeDetection, Value};
use tokio::io::Interest;

use super::device::{Fault, FaultKind, OwnsDescriptor, Report, Reports, register, wait_for, watch_line};
use windhover_base::settings::GpioLine;

/// Reading period for a line whose controller raises no interrupts.
const READING: Duration = Duration::from_secs(1);

/// The requested line.
enum Requested {
    /// Its controller reports edges.
    Edges(Request),
    /// Its controller raises no interrupts for it: the line is read periodically.
    Level(Request),
}

// SAFETY: a request owns the descriptor that the kernel gave for it until it is dropped.
unsafe impl OwnsDescriptor for Request {}

/// Watches the line without end; `active` gets its level whenever it may have changed, and `false` where it is lost.
pub async fn run(line: &GpioLine, reports: Reports<'_>, active: &(dyn Fn(bool) + Sync)) -> Infallible {
    let asked = line.clone();
    let watched = async |requested| {
        let Err(error) = watch(line, requested, reports, active).await;
        fault(line, &error)
    };
    // A line that is not there signals nothing.
    let lost = |report| {
        if matches!(report, Report::Down(_)) {
            active(false);
        }
        reports(report);
    };
    watch_line(move || request(&asked), watched, &lost).await
}

async fn watch(
    line: &GpioLine,
    requested: Requested,
    reports: Reports<'_>,
    active: &(dyn Fn(bool) + Sync),
) -> gpiocdev::Result<Infallible> {
    let level = |request: &Request| -> gpiocdev::Result<()> {
        active(request.value(line.line)? == Value::Active);
        Ok(())
    };
    match requested {
        Requested::Edges(request) => {
            let request = register(request, Interest::READABLE)?;
            reports(Report::Up("waits for its edges".into()));
            loop {
                level(request.get_ref())?;
                // Cleared first: an edge from here on wakes again.
                wait_for(request.readable(), reports).await?.clear_ready();
                while request.get_ref().has_edge_event()? {
                    request.get_ref().read_edge_event()?;
                }
            }
        }
        Requested::Level(request) => {
            reports(Report::Up("its controller reports no edges: read once a second".into()));
            loop {
                level(&request)?;
                wait_for(tokio::time::sleep(READING), reports).await;
            }
        }
    }
}

fn request(line: &GpioLine) -> Result<Requested, Fault> {
    // The library has one error for all causes; the system call distinguishes a missing chip from a forbidden one.
    std::fs::File::open(&line.chip).map_err(|error| Fault::from_io(&line.chip, &error))?;
    let mut builder = Request::builder();
    builder.on_chip(&line.chip).with_consumer("windhover").with_line(line.line).as_input();
    if line.active_low {
        builder.as_active_low();
    }
    if let Ok(request) = builder.clone().with_edge_detection(EdgeDetection::BothEdges).request() {
        return Ok(Requested::Edges(request));
    }
    builder.request().map(Requested::Level).map_err(|error| fault(line, &error))
}

fn fault(line: &GpioLine, error: &gpiocdev::Error) -> Fault {
    Fault::new(FaultKind::Unsuitable, &line.to_string(), error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kind(chip: &str) -> Option<FaultKind> {
        let line = GpioLine { chip: chip.into(), line: 3, active_low: true };
        request(&line).err().map(|fault| fault.kind)
    }

    #[test]
    fn what_is_no_gpio_chip_is_reported() {
        assert_eq!(kind("/dev/gpiochip99"), Some(FaultKind::Missing));
        assert_eq!(kind("/dev/null"), Some(FaultKind::Unsuitable));
    }
}
