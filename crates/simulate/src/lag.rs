//! Response of a first-order filter to a motion.

use nalgebra::Vector3;
use windhover_base::time::{MonoTime, Span};

/// Number of past times that represent the whole past.
const MOMENTS: u32 = 24;

/// `∫ e^{−u/τ}/τ f(t − u) du` with time constant `tau_s`: the mean over the middles of equal shares of that weight. Its
/// gain at the period 2π τ is within some percent of the filter's. `f(t)` itself where `tau_s` is 0.
pub(super) fn filtered(tau_s: f64, t: MonoTime, f: impl Fn(MonoTime) -> Vector3<f64>) -> Vector3<f64> {
    if tau_s == 0.0 {
        return f(t);
    }
    let past = |k: u32| -tau_s * (1.0 - (f64::from(k) + 0.5) / f64::from(MOMENTS)).ln();
    let sum: Vector3<f64> = (0..MOMENTS).map(|k| f(t - Span::from_s(past(k)))).sum();
    sum / f64::from(MOMENTS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ramp_lags_by_the_time_constant_and_a_swing_loses_what_it_must() {
        let start = MonoTime::from_ns(10_000_000_000);
        let ramp = |t: MonoTime| Vector3::x() * (t - start).s();
        let lag = -filtered(0.2, start, ramp).x;
        assert!((lag - 0.2).abs() < 0.006, "{lag}");
        let swing = |t: MonoTime| {
            let (s, c) = (5.0 * (t - start).s()).sin_cos();
            Vector3::new(c, s, 0.0)
        };
        // Gain 1/√(1 + (ω τ)²), phase −atan(ω τ), with ω τ = 1.
        let left = filtered(0.2, start, swing);
        assert!((left.norm() - 0.5_f64.sqrt()).abs() < 0.02, "{left}");
        assert!((left.y.atan2(left.x) + std::f64::consts::FRAC_PI_4).abs() < 0.03, "{left}");
    }
}
