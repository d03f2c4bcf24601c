//! Sources that deliver samples: gives them times; impossible samples are refused and counted.

use nalgebra::Vector3;

use windhover_base::msg::{AttitudeSample, InertialSample, Stamped};
use windhover_base::time::{MonoTime, Span};

/// Limits of plausible samples: no helicopter turns faster than this, rad/s, or accelerates more, m/s².
const RATE_MAX: f64 = 100.0;
const FORCE_MAX: f64 = 500.0;

/// Something that a source of samples delivers.
pub(in crate::pipeline) trait Sample: Copy {
    /// Whether it has a value at all, and only physically possible values.
    fn can_be(&self) -> bool;
}

impl Sample for InertialSample {
    fn can_be(&self) -> bool {
        let within = |value: Option<Vector3<f64>>, most: f64| {
            value.is_none_or(|v| v.iter().all(|x| x.is_finite()) && v.norm() <= most)
        };
        let says = self.rate_rps.is_some() || self.force_mps2.is_some();
        says && within(self.rate_rps, RATE_MAX) && within(self.force_mps2, FORCE_MAX)
    }
}

impl Sample for AttitudeSample {
    fn can_be(&self) -> bool {
        let angles = [self.heading, self.tilt.map(|t| t.pitch), self.tilt.map(|t| t.roll)];
        angles.iter().any(Option::is_some) && angles.iter().flatten().all(|angle| angle.is_finite())
    }
}

/// Samples to their time of validity.
pub(in crate::pipeline) struct SampleLine {
    latency: Span,
    refused: u64,
}

impl SampleLine {
    /// For a source whose samples arrive this much after their time of validity.
    pub(super) fn new(latency_ms: f64) -> Self {
        Self { latency: Span::from_ms(latency_ms), refused: 0 }
    }

    /// Gives a sample its time; `None` if the sample is impossible.
    pub(in crate::pipeline) fn stamp<T: Sample>(
        &mut self,
        sample: &T,
        t_recv: MonoTime,
        seq: u64,
    ) -> Option<Stamped<T>> {
        if !sample.can_be() {
            self.refused += 1;
            return None;
        }
        Some(Stamped { t_valid: t_recv - self.latency, t_recv, seq, value: *sample })
    }

    /// Number of impossible samples so far.
    pub(in crate::pipeline) fn refused(&self) -> u64 {
        self.refused
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use windhover_base::geo::Tilt;

    #[test]
    fn samples_are_valid_a_latency_before_they_are_received() {
        let mut line = SampleLine::new(20.0);
        let sample = InertialSample { rate_rps: Some(Vector3::x()), force_mps2: None };
        let stamped = line.stamp(&sample, MonoTime::from_ns(50_000_000), 7).expect("it can be");
        assert_eq!((stamped.t_valid, stamped.seq, stamped.value), (MonoTime::from_ns(30_000_000), 7, sample));
        assert_eq!(line.refused(), 0);
    }

    #[test]
    fn what_cannot_be_is_refused_and_counted() {
        let mut line = SampleLine::new(0.0);
        let rate = |rate| InertialSample { rate_rps: Some(rate), force_mps2: None };
        let odd = [
            InertialSample::default(),
            rate(Vector3::new(f64::NAN, 0.0, 0.0)),
            rate(Vector3::x() * 200.0),
            InertialSample { rate_rps: None, force_mps2: Some(Vector3::x() * 1e4) },
        ];
        assert!(odd.iter().all(|sample| line.stamp(sample, MonoTime::default(), 0).is_none()));
        let tilt = Some(Tilt { pitch: f64::INFINITY, roll: 0.0 });
        for sample in [AttitudeSample::default(), AttitudeSample { tilt, ..AttitudeSample::default() }] {
            assert!(line.stamp(&sample, MonoTime::default(), 0).is_none());
        }
        assert_eq!(line.refused(), 6);
    }
}
