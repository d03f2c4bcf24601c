//! Rates and forces in blocks of a tenth of a second.
//!
//! Vibration of a rotorcraft is several m/s², and not white: a filter that takes every sample for an independent one is
//! sure of what it is not. A block is true at its middle.

use nalgebra::{Rotation3, Vector3};

use windhover_base::msg::{InertialSample, Stamped};
use windhover_base::time::{MonoTime, Span};

/// Length of a block.
const BLOCK: Span = Span::from_ns(100_000_000);
/// A block with a gap longer than this is dropped.
const GAP: Span = Span::from_ns(50_000_000);

/// A sum of vectors.
#[derive(Clone, Copy, Debug, Default)]
struct Sum {
    sum: Vector3<f64>,
    n: f64,
}

impl Sum {
    fn take(&mut self, value: Option<Vector3<f64>>) {
        if let Some(value) = value {
            self.sum += value;
            self.n += 1.0;
        }
    }

    fn mean(&self) -> Option<Vector3<f64>> {
        (self.n > 0.0).then(|| self.sum / self.n)
    }
}

/// Collects samples.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Blocks {
    first: Option<MonoTime>,
    last: MonoTime,
    rate: Sum,
    force: Sum,
}

impl Blocks {
    /// Takes a sample in sensor axes; gives the block that it ends, in body axes.
    pub(crate) fn take(
        &mut self,
        sample: &Stamped<InertialSample>,
        body_from_imu: &Rotation3<f64>,
    ) -> Option<Stamped<InertialSample>> {
        let t = sample.t_valid;
        let first = match self.first {
            Some(first) if t >= self.last && t - self.last <= GAP => first,
            _ => {
                *self = Self { first: Some(t), ..Self::default() };
                t
            }
        };
        self.last = t;
        let finite = |v: &Vector3<f64>| v.iter().all(|x| x.is_finite());
        self.rate.take(sample.value.rate_rps.filter(finite));
        self.force.take(sample.value.force_mps2.filter(finite));
        if t - first < BLOCK {
            return None;
        }
        let of_body = |sum: &Sum| sum.mean().map(|mean| body_from_imu * mean);
        let value = InertialSample { rate_rps: of_body(&self.rate), force_mps2: of_body(&self.force) };
        // The last sample of a block is the first of the next one's time, and is counted in one only.
        *self = Self { first: Some(t), last: t, ..Self::default() };
        let t_valid = first + Span::from_s(0.5 * (t - first).s());
        Some(Stamped { t_valid, t_recv: sample.t_recv, seq: sample.seq, value })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(t_ms: f64, rate: f64) -> Stamped<InertialSample> {
        let t = MonoTime::from_ns(1_000_000_000) + Span::from_ms(t_ms);
        let value = InertialSample { rate_rps: Some(Vector3::new(rate, 0.0, 0.0)), force_mps2: None };
        Stamped { t_valid: t, t_recv: t, seq: 0, value }
    }

    #[test]
    fn a_block_is_the_mean_at_its_middle_in_body_axes() {
        let (mut blocks, turned) =
            (Blocks::default(), Rotation3::from_euler_angles(0.0, 0.0, 0.5 * std::f64::consts::PI));
        let done: Vec<_> =
            (0..=20).filter_map(|k| blocks.take(&at(10.0 * f64::from(k), f64::from(k)), &turned)).collect();
        assert_eq!(done.len(), 2);
        let rate = done[0].value.rate_rps.expect("rates");
        assert!((rate - Vector3::new(0.0, 5.0, 0.0)).norm() < 1e-12, "{rate}");
        assert!((done[0].t_valid - MonoTime::from_ns(1_050_000_000)).abs().ms() < 1e-6);
        assert!(done[0].value.force_mps2.is_none());
    }

    #[test]
    fn a_gap_begins_a_new_block_and_wrong_numbers_are_left_out() {
        let (mut blocks, same) = (Blocks::default(), Rotation3::identity());
        for t_ms in [0.0, 20.0, 40.0, 300.0, 320.0, 340.0] {
            assert!(blocks.take(&at(t_ms, f64::NAN), &same).is_none());
        }
        for t_ms in [360.0, 380.0] {
            blocks.take(&at(t_ms, 1.0), &same);
        }
        let block = blocks.take(&at(400.0, 1.0), &same).expect("a tenth of a second since the gap");
        assert_eq!(block.value.rate_rps, Some(Vector3::new(1.0, 0.0, 0.0)));
    }
}
