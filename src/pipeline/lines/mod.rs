//! Gives data of every source its time of validity: bytes or samples in, stamped measurements out. There is one file
//! for each line; a line that takes bytes has a row in [`SourceLines::of`].

mod autopilot;
mod compass;
mod gps;
mod samples;

pub(super) use autopilot::AutopilotLine;
pub(super) use compass::CompassLine;
pub(super) use gps::GpsLine;
pub(super) use samples::{Sample, SampleLine};

use windhover_base::msg::{Delivery, SensorReading, Source};
use windhover_base::settings::{AutopilotUse, Framing, Rig};
use windhover_base::time::{MonoTime, Span};
use windhover_decode::DecodeCounts;

/// A decoder, and the clock that gives times to what it decodes.
pub(super) trait SourceLine {
    /// Takes the bytes that one read returned at `t_recv`.
    fn push(&mut self, bytes: &[u8], t_recv: MonoTime, seq: u64, out: &mut Vec<SensorReading>);

    /// Time has advanced to `now`: data that waited for more bytes is released.
    fn tick(&mut self, _now: MonoTime, _seq: u64, _out: &mut Vec<SensorReading>) {}

    /// No more bytes follow.
    fn finish(&mut self, _out: &mut Vec<SensorReading>) {}

    /// Counts of what was decoded and refused so far.
    fn counts(&self) -> &DecodeCounts;
}

/// The lines of a pipeline.
pub(super) struct SourceLines {
    pub(super) gps: GpsLine,
    pub(super) compass: CompassLine,
    pub(super) imu: Option<SampleLine>,
    pub(super) attitude: Option<SampleLine>,
    autopilot: Option<AutopilotLine>,
    has_gps: bool,
    has_compass: bool,
    /// Whether receiver and compass share one line.
    is_shared: bool,
}

impl SourceLines {
    pub(super) fn new(rig: &Rig) -> Self {
        Self {
            gps: GpsLine::new(&rig.gps),
            compass: CompassLine::new(&rig.compass, rig.imu.map_or(0.0, |imu| imu.latency_ms)),
            imu: rig
                .imu
                .filter(|_| !by_autopilot(rig, AutopilotUse::Imu) && !rig.compass.imu)
                .map(|i| SampleLine::new(i.latency_ms)),
            attitude: rig
                .attitude
                .filter(|_| !by_autopilot(rig, AutopilotUse::Attitude))
                .map(|attitude| SampleLine::new(attitude.latency_ms)),
            autopilot: rig.autopilot.as_ref().map(|autopilot| AutopilotLine::new(autopilot, rig)),
            has_gps: rig.gps.is_there(),
            has_compass: rig.compass.is_there(),
            is_shared: rig.compass_is_receivers(),
        }
    }

    /// The line of a source; `None` where it does not deliver bytes, or is not configured.
    pub(super) fn of(&mut self, source: Source) -> Option<&mut dyn SourceLine> {
        match source {
            Source::Gps if self.has_gps => Some(&mut self.gps),
            Source::Compass if self.has_compass => Some(&mut self.compass),
            Source::Autopilot => self.autopilot.as_mut().map(|line| line as &mut dyn SourceLine),
            Source::Gps | Source::Compass | Source::Camera | Source::Imu | Source::Attitude => None,
        }
    }

    /// The other source that the bytes of this one also contain.
    pub(super) fn beside(&self, source: Source) -> Option<Source> {
        (source == Source::Gps && self.is_shared).then_some(Source::Compass)
    }

    /// The line of a source of samples; `None` where it delivers something else, or is not configured.
    pub(super) fn samples(&mut self, source: Source) -> Option<&mut SampleLine> {
        match source {
            Source::Imu => self.imu.as_mut(),
            Source::Attitude => self.attitude.as_mut(),
            Source::Gps | Source::Compass | Source::Camera | Source::Autopilot => None,
        }
    }

    /// Whether data of a source is expected.
    pub(super) fn awaits(&mut self, source: Source) -> bool {
        match source.delivers() {
            Delivery::Bytes => self.of(source).is_some(),
            Delivery::Frames => true,
            Delivery::Inertial | Delivery::Attitude => self.samples(source).is_some(),
        }
    }
}

/// Whether an autopilot delivers this quantity.
fn by_autopilot(rig: &Rig, what: AutopilotUse) -> bool {
    rig.autopilot.as_ref().is_some_and(|autopilot| autopilot.gives(what))
}

/// Number of refused pieces, and the reasons, together with the fields left out of accepted ones.
pub(super) fn refused(counts: &DecodeCounts) -> (u64, String) {
    let reasons = counts.refusals().map(|(why, n)| format!("{n} {}", why.words()));
    let fields = counts.left_out().map(|(field, n)| format!("{n} without {field}"));
    (counts.refused_total(), reasons.chain(fields).collect::<Vec<_>>().join(", "))
}

/// Transmission time of bytes on a serial line.
#[derive(Clone, Copy)]
struct Wire {
    bits_a_byte: u32,
    baud: u32,
}

impl Wire {
    fn new(framing: Framing, baud: u32) -> Self {
        Self { bits_a_byte: framing.bits(), baud: baud.max(1) }
    }

    fn time(self, bytes: usize) -> Span {
        Span::from_s(bytes as f64 * f64::from(self.bits_a_byte) / f64::from(self.baud))
    }
}
