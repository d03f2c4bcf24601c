//! The GPIO line of a camera's trigger, watched through its chip's character device (Linux `/dev/gpiochipN`).

use std::convert::Infallible;
use std::time::Duration;

use gpiocdev::Request;
use gpiocdev::line::{EdgeDetection, EventClock};
use tokio::io::Interest;

use super::clock::HostClock;
use super::device::{Fault, FaultKind, Report, Reports, register, wait_for, watch_line};
use windhover_base::settings::GpioLine;
use windhover_base::time::MonoTime;

/// Watches the line without end; `pulse` gets the kernel's stamp of each edge that makes it active.
pub async fn run(
    line: &GpioLine,
    clock: HostClock,
    reports: Reports<'_>,
    pulse: &(dyn Fn(MonoTime) + Sync),
) -> Infallible {
    let asked = line.clone();
    let watched = async |request| {
        reports(Report::Up(format!("pulses of {line}")));
        let Err(error) = watch(request, clock, reports, pulse).await;
        Fault::new(FaultKind::Unplugged, &line.to_string(), error.to_string())
    };
    watch_line(move || request(&asked), watched, reports).await
}

async fn watch(
    request: Request,
    clock: HostClock,
    reports: Reports<'_>,
    pulse: &(dyn Fn(MonoTime) + Sync),
) -> gpiocdev::Result<Infallible> {
    let request = register(request, Interest::READABLE)?;
    loop {
        // Cleared first: an edge from here on wakes again.
        wait_for(request.readable(), reports).await?.clear_ready();
        while request.get_ref().has_edge_event()? {
            let edge = request.get_ref().read_edge_event()?;
            pulse(clock.from_monotonic(Duration::from_nanos(edge.timestamp_ns)));
        }
    }
}

fn request(line: &GpioLine) -> Result<Request, Fault> {
    // The library has one error for all causes; the system call distinguishes a missing chip from a forbidden one.
    std::fs::File::open(&line.chip).map_err(|error| Fault::from_io(&line.chip, &error))?;
    let mut builder = Request::builder();
    builder.on_chip(&line.chip).with_consumer("windhover").with_line(line.line).as_input();
    if line.active_low {
        builder.as_active_low();
    }
    builder.with_edge_detection(EdgeDetection::RisingEdge).with_event_clock(EventClock::Monotonic);
    builder.request().map_err(|error| Fault::new(FaultKind::Unsuitable, &line.to_string(), error.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_gpio_chip_is_reported() {
        let kind = |chip: &str| {
            let line = GpioLine { chip: chip.into(), line: 3, active_low: false };
            request(&line).err().map(|fault| fault.kind)
        };
        assert_eq!(kind("/dev/gpiochip99"), Some(FaultKind::Missing));
        assert_eq!(kind("/dev/null"), Some(FaultKind::Unsuitable));
    }
}
