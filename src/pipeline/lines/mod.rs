//! What sources deliver, put in time: bytes or samples in, stamped measurements out. One file a line; one that takes bytes
//! has a row in [`SourceLines::of`].

mod compass;
mod gps;
mod samples;

pub(super) use compass::CompassLine;
pub(super) use gps::GpsLine;
pub(super) use samples::{Sample, SampleLine};

use windhover_base::msg::{Delivery, SensorReading, Source};
use windhover_base::settings::Rig;
use windhover_base::time::{MonoTime, Span};
use windhover_decode::DecodeCounts;

/// A decoder, and the clock that puts what it decodes in time.
pub(super) trait SourceLine {
    /// Takes the bytes that one read returned at `t_recv`.
    fn push(&mut self, bytes: &[u8], t_recv: MonoTime, seq: u64, out: &mut Vec<SensorReading>);

    /// Time has come to `now`: what waited for more bytes waits no longer.
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
}

impl SourceLines {
    pub(super) fn new(rig: &Rig) -> Self {
        Self {
            gps: GpsLine::new(&rig.gps),
            compass: CompassLine::new(&rig.compass),
            imu: rig.imu.map(|imu| SampleLine::new(imu.latency_ms)),
            attitude: rig.attitude.map(|attitude| SampleLine::new(attitude.latency_ms)),
        }
    }

    /// The line of a source; `None` where it does not deliver bytes, or is not configured.
    pub(super) fn of(&mut self, source: Source) -> Option<&mut dyn SourceLine> {
        match source {
            Source::Gps => Some(&mut self.gps),
            Source::Compass => Some(&mut self.compass),
            Source::Camera | Source::Imu | Source::Attitude => None,
        }
    }

    /// The line of a source of samples; `None` where it delivers something else, or is not configured.
    pub(super) fn samples(&mut self, source: Source) -> Option<&mut SampleLine> {
        match source {
            Source::Imu => self.imu.as_mut(),
            Source::Attitude => self.attitude.as_mut(),
            Source::Gps | Source::Compass | Source::Camera => None,
        }
    }

    /// Whether something is to come from a source.
    pub(super) fn awaits(&mut self, source: Source) -> bool {
        match source.delivers() {
            Delivery::Bytes => self.of(source).is_some(),
            Delivery::Frames => true,
            Delivery::Inertial | Delivery::Attitude => self.samples(source).is_some(),
        }
    }
}

/// How many pieces were refused, and the reasons, with the fields left out of the others.
pub(super) fn refused(counts: &DecodeCounts) -> (u64, String) {
    let reasons = counts.refusals().map(|(why, n)| format!("{n} {}", why.words()));
    let fields = counts.left_out().map(|(field, n)| format!("{n} without {field}"));
    (counts.refused_total(), reasons.chain(fields).collect::<Vec<_>>().join(", "))
}

/// Time on the wire: ten bits a byte (8N1).
fn on_the_wire(bytes: usize, baud: u32) -> Span {
    Span::from_s(bytes as f64 * 10.0 / f64::from(baud.max(1)))
}
