//! Readings of a compass, with their times of arrival.

use windhover_base::geo::Tilt;
use windhover_base::msg::{AttitudeSample, InertialSample};
use windhover_base::time::MonoTime;

use crate::counts::DecodeCounts;
use crate::lines::LineSpan;

/// One reading as the device reports it, degrees; `None` where not given or not valid.
///
/// ```
/// use windhover_decode::CompassReading;
///
/// // A tilt is used only where both angles are valid.
/// let reading = CompassReading { heading_deg: Some(90.0), pitch_deg: Some(1.0), ..CompassReading::default() };
/// let sample = reading.sample();
/// assert!(reading.is_valid() && sample.tilt.is_none());
/// assert_eq!(sample.heading, Some(std::f64::consts::FRAC_PI_2));
/// ```
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub struct CompassReading {
    /// Heading, 0 to 360.
    pub heading_deg: Option<f64>,
    /// Whether the heading is already true.
    pub heading_is_true: bool,
    /// Whether the heading is relative to an arbitrary direction, so that it cannot be used.
    pub heading_is_free: bool,
    /// Pitch, nose up positive.
    pub pitch_deg: Option<f64>,
    /// Roll, right side down positive.
    pub roll_deg: Option<f64>,
    /// Whether the device's own flags made a part of this reading invalid.
    pub flagged: bool,
    /// Rates of turn and specific forces in the same reading, in the device's axes forward, right, down.
    pub inertial: Option<InertialSample>,
}

impl CompassReading {
    /// The reading for the estimator: radians, tilt only where both angles are valid.
    pub fn sample(&self) -> AttitudeSample {
        let tilt = self.pitch_deg.zip(self.roll_deg);
        AttitudeSample {
            heading: self.heading_deg.filter(|_| !self.heading_is_free).map(f64::to_radians),
            heading_is_true: self.heading_is_true,
            tilt: tilt.map(|(pitch, roll)| Tilt { pitch: pitch.to_radians(), roll: roll.to_radians() }),
        }
    }

    /// Whether it has rates or forces, and no part of an attitude.
    pub fn is_inertial_only(&self) -> bool {
        let angles = [self.heading_deg, self.pitch_deg, self.roll_deg];
        self.inertial.is_some() && !self.flagged && angles.iter().all(Option::is_none)
    }

    /// Whether the device marked nothing in it as invalid, and it is not empty.
    pub fn is_valid(&self) -> bool {
        !self.flagged && (self.heading_deg.is_some() || self.pitch_deg.is_some() || self.roll_deg.is_some())
    }
}

/// A reading and its time of arrival.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct ReceivedAttitude {
    /// The reading for the estimator.
    pub sample: AttitudeSample,
    /// The reading as the device reported it.
    pub reading: CompassReading,
    /// When the read returned that completed it.
    pub t_recv: MonoTime,
    /// When the read returned that completed its first sentence or packet.
    pub t_first: MonoTime,
    /// Length of that on the wire.
    pub bytes: usize,
    /// Bytes of that read after it. Its last byte ended no later than `t_first` minus the transmission time of these.
    pub bytes_after: usize,
}

/// Stamps a reading from its first and last sentence.
pub(super) fn received(
    reading: CompassReading,
    first: LineSpan,
    last: LineSpan,
    counts: &mut DecodeCounts,
) -> ReceivedAttitude {
    counts.flagged += u64::from(reading.flagged);
    ReceivedAttitude {
        sample: reading.sample(),
        reading,
        t_recv: last.t_last,
        t_first: first.t_last,
        bytes: first.bytes,
        bytes_after: first.bytes_after,
    }
}
