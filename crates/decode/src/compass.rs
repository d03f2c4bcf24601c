//! Compass bytes to attitude samples, in every supported format.

use super::counts::{DecodeCounts, Refusal};
use super::frame::{LineFramer, LineSpan, LineStart};
use super::{compass_text, pni};
use windhover_base::geo::Tilt;
use windhover_base::msg::AttitudeSample;
use windhover_base::settings::CompassFormat;
use windhover_base::time::MonoTime;

/// One reading as the device gives it, degrees; `None` where not given or not valid.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct CompassReading {
    /// Heading, 0 to 360.
    pub heading_deg: Option<f64>,
    /// Whether the heading is already true.
    pub heading_is_true: bool,
    /// Pitch, nose up positive.
    pub pitch_deg: Option<f64>,
    /// Roll, right side down positive.
    pub roll_deg: Option<f64>,
    /// Whether the device's own flags made something of this reading invalid.
    pub flagged: bool,
}

impl CompassReading {
    /// The reading as what the estimator takes: radians, tilt only where both angles are valid.
    pub fn sample(&self) -> AttitudeSample {
        let tilt = self.pitch_deg.zip(self.roll_deg);
        AttitudeSample {
            heading: self.heading_deg.map(f64::to_radians),
            heading_is_true: self.heading_is_true,
            tilt: tilt.map(|(pitch, roll)| Tilt { pitch: pitch.to_radians(), roll: roll.to_radians() }),
        }
    }

    /// Whether nothing in it was called invalid by the device, and there is something in it.
    pub fn is_valid(&self) -> bool {
        !self.flagged && (self.heading_deg.is_some() || self.pitch_deg.is_some() || self.roll_deg.is_some())
    }
}

/// A reading and when it was heard.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct HeardAttitude {
    /// The reading as the estimator takes it.
    pub sample: AttitudeSample,
    /// The reading as the device gives it.
    pub reading: CompassReading,
    /// When the read returned that completed it.
    pub t_recv: MonoTime,
    /// Its length on the wire.
    pub bytes: usize,
    /// Bytes of that read after it. Its last byte ended no later than `t_recv` less the
    /// transmission time of these.
    pub bytes_after: usize,
}

/// Reads a digital compass.
#[derive(Clone, Debug)]
pub struct CompassDecoder {
    format: CompassFormat,
    counts: DecodeCounts,
    lines: LineFramer,
    packets: pni::PacketFramer,
    /// Whether the device was seen to send checksums: then a line without one is damaged.
    has_checksums: bool,
}

impl CompassDecoder {
    /// A decoder for one format.
    pub fn new(format: CompassFormat) -> Self {
        let start = if format == CompassFormat::Os5000 { LineStart::Any } else { LineStart::Dollar };
        Self {
            format,
            counts: DecodeCounts::default(),
            lines: LineFramer::new(start),
            packets: pni::PacketFramer::default(),
            has_checksums: false,
        }
    }

    /// Takes the bytes one read returned at `t_recv`; appends the samples they complete to `out`.
    pub fn push(&mut self, bytes: &[u8], t_recv: MonoTime, out: &mut Vec<HeardAttitude>) {
        if self.format == CompassFormat::Pni {
            self.packets.push(bytes, t_recv, &mut self.counts, out);
            return;
        }
        let (format, has_checksums) = (self.format, &mut self.has_checksums);
        self.lines.push(bytes, t_recv, &mut self.counts, |line, counts| {
            if line.text.contains(&b'*') {
                *has_checksums = true;
            } else if *has_checksums || !compass_text::may_lack_checksum(format) {
                return counts.refuse(Refusal::NoChecksum);
            }
            match compass_text::read(format, line.text) {
                Ok(Some(reading)) => out.push(heard(reading, line.span, counts)),
                Ok(None) => counts.ignored += 1,
                Err(why) => counts.refuse(why),
            }
        });
    }

    /// What was made of the bytes so far.
    pub const fn counts(&self) -> &DecodeCounts {
        &self.counts
    }
}

/// Stamps a reading and counts it.
pub(super) fn heard(reading: CompassReading, span: LineSpan, counts: &mut DecodeCounts) -> HeardAttitude {
    counts.used += 1;
    counts.flagged += u64::from(reading.flagged);
    HeardAttitude {
        sample: reading.sample(),
        reading,
        t_recv: span.t_last,
        bytes: span.bytes,
        bytes_after: span.bytes_after,
    }
}

#[cfg(test)]
mod tests {
    use super::super::sentence::framed;
    use super::*;

    fn readings(format: CompassFormat, bytes: &[u8]) -> (Vec<HeardAttitude>, DecodeCounts) {
        let (mut decoder, mut out) = (CompassDecoder::new(format), Vec::new());
        decoder.push(bytes, MonoTime::from_ns(5), &mut out);
        (out, decoder.counts().clone())
    }

    #[test]
    fn a_sample_has_radians_and_its_place_in_time() {
        let bytes = format!("junk{}\r\n$C", framed("C180.0P-2.0R1.0"));
        let (out, counts) = readings(CompassFormat::Tcm2, bytes.as_bytes());
        assert_eq!(out.len(), 1, "{counts}");
        let tilt = out[0].sample.tilt.expect("both angles are given");
        assert!((out[0].sample.heading.expect("given") - std::f64::consts::PI).abs() < 1e-12);
        assert!(
            (tilt.pitch + 2f64.to_radians()).abs() < 1e-12 && (tilt.roll - 1f64.to_radians()).abs() < 1e-12
        );
        assert_eq!((out[0].bytes, out[0].bytes_after, counts.noise_bytes), (20, 3, 4));
    }

    #[test]
    fn bare_lines_count_only_from_a_device_that_never_sends_checksums() {
        let (out, _) = readings(CompassFormat::Os5000, b"12.5,1.0,-2.0,20.0\r\n");
        assert_eq!(out[0].reading.heading_deg, Some(12.5));
        let mixed = format!("{}\r\n12.5,1.0,-2.0,20.0\r\n", framed("OHPR,12.5,1.0,-2.0,20.0"));
        let (out, counts) = readings(CompassFormat::Os5000, mixed.as_bytes());
        assert_eq!((out.len(), counts.refused(Refusal::NoChecksum)), (1, 1), "{counts}");
    }

    #[test]
    fn tilt_needs_both_angles() {
        let reading = CompassReading { pitch_deg: Some(1.0), ..CompassReading::default() };
        assert!(reading.sample().tilt.is_none() && reading.is_valid());
    }
}
