//! A GPIO line that tells of power going, read through its chip's character device (Linux `/dev/gpiochipN`).

use gpiocdev::Request;
use gpiocdev::line::Value;

use super::device::{Fault, FaultKind};
use crate::config::GoingLine;

/// The line: requested when it is read first, and again after it was lost.
#[derive(Debug)]
pub struct PowerLine {
    line: GoingLine,
    request: Option<Request>,
}

/// What reading the line gave.
#[derive(Clone, PartialEq, Eq, Debug)]
pub struct LineReading {
    /// Whether the line is active.
    pub set: bool,
    /// Whether the line was requested just now.
    pub opened: bool,
}

impl PowerLine {
    /// The line as configured.
    pub const fn new(line: GoingLine) -> Self {
        Self { line, request: None }
    }

    /// Reads the line: one system call, a few more where it has to be requested.
    pub fn read(&mut self) -> Result<LineReading, Fault> {
        let opened = self.request.is_none();
        let request = match self.request.take() {
            Some(request) => request,
            None => self.request()?,
        };
        let value = request.value(self.line.line).map_err(|error| self.fault(&error))?;
        self.request = Some(request);
        Ok(LineReading { set: value == Value::Active, opened })
    }

    fn request(&self) -> Result<Request, Fault> {
        // The library folds its errors into one; the plain system call tells a missing chip from a forbidden one.
        std::fs::File::open(&self.line.chip).map_err(|error| Fault::from_io(&self.line.chip, &error))?;
        let mut builder = Request::builder();
        builder.on_chip(&self.line.chip).with_consumer("windhover").with_line(self.line.line).as_input();
        if self.line.active_low {
            builder.as_active_low();
        }
        builder.request().map_err(|error| self.fault(&error))
    }

    fn fault(&self, error: &gpiocdev::Error) -> Fault {
        let device = format!("{} line {}", self.line.chip, self.line.line);
        Fault::new(FaultKind::Unsuitable, &device, error.to_string())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fault(chip: &str) -> FaultKind {
        let line = GoingLine { chip: chip.into(), line: 3, active_low: true };
        PowerLine::new(line).read().expect_err("no such line").kind
    }

    #[test]
    fn what_is_no_gpio_chip_is_told_and_tried_again() {
        assert_eq!(fault("/dev/gpiochip99"), FaultKind::Missing);
        assert_eq!(fault("/dev/null"), FaultKind::Unsuitable);
    }
}
