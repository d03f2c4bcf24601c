//! A vehicle's state at another time than that of its estimate, and its motion as vectors.

use std::collections::VecDeque;

use nalgebra::{SMatrix, Vector3};

use windhover_base::geo::wrap_angle;
use windhover_base::msg::TargetState;
use windhover_base::time::{MonoTime, Span};

/// Time over which the change of speed is fitted.
const FITTED: Span = Span::from_ns(600_000_000);
/// Fewest speeds for a fit.
const FEWEST: usize = 4;
const SHORTEST_S: f64 = 0.25;
/// Largest acceleration or deceleration of a ground vehicle, m/s².
const HARDEST_MPS2: f64 = 8.0;

/// Rate of a vehicle's speed: the slope of its recent estimates.
#[derive(Clone, PartialEq, Debug, Default)]
pub struct SpeedRate {
    /// Time, speed, its variance.
    lately: VecDeque<(MonoTime, f64, f64)>,
}

impl SpeedRate {
    /// Takes the speed at `t`.
    pub fn take(&mut self, t: MonoTime, state: &TargetState) {
        let variance = state.covariance.map_or(0.0, |p| p[(3, 3)].max(0.0));
        self.lately.push_back((t, state.speed_mps, variance));
        self.lately.retain(|(at, ..)| t - *at <= FITTED);
    }

    /// Drops the history: the vehicle was out of sight.
    pub fn clear(&mut self) {
        self.lately.clear();
    }

    /// v̇, m/s². The least-squares slope b with sigma σ_b, as b³/(b² + σ_b²): a slope below its noise is nearly zero.
    pub fn mps2(&self) -> f64 {
        let (Some((last, ..)), n) = (self.lately.back(), self.lately.len()) else { return 0.0 };
        let at = |t: MonoTime| (t - *last).s();
        let mean =
            |of: &dyn Fn(&(MonoTime, f64, f64)) -> f64| self.lately.iter().map(of).sum::<f64>() / n as f64;
        let (t, v, variance) = (mean(&|s| at(s.0)), mean(&|s| s.1), mean(&|s| s.2));
        let across: f64 = self.lately.iter().map(|s| (at(s.0) - t).powi(2)).sum();
        let along: f64 = self.lately.iter().map(|s| (at(s.0) - t) * (s.1 - v)).sum();
        let span_s = self.lately.front().map_or(0.0, |s| -at(s.0));
        if n < FEWEST || span_s < SHORTEST_S {
            return 0.0;
        }
        let (slope, slope_variance) = (along / across, variance / across);
        let sure = slope * slope / (slope * slope + slope_variance).max(1e-12);
        (slope * sure).clamp(-HARDEST_MPS2, HARDEST_MPS2)
    }
}

/// The state a time Δ = `by` later, on an arc whose speed changes by `rate_mps2` until it stops: `ψ' = ψ + ω Δ`, `v' =
/// v + v̇ Δ`, and the rear axle moves `(v + v')/2 Δ` along the chord of the arc. Latitude and longitude stay unchanged.
pub fn ahead(state: &TargetState, rate_mps2: f64, reference_m: f64, by: Span) -> TargetState {
    let dt = by.s();
    let mut speed = state.speed_mps + rate_mps2 * dt;
    if speed * state.speed_mps < 0.0 {
        speed = 0.0;
    }
    let turn = state.yaw_rate_radps * dt;
    let heading = state.heading_rad + turn;
    let half = 0.5 * turn;
    let chord = if half.abs() > 1e-6 { half.sin() / half } else { 1.0 };
    let along = 0.5 * (state.speed_mps + speed) * dt * chord;
    let (s0, c0) = state.heading_rad.sin_cos();
    let (s1, c1) = heading.sin_cos();
    let (sm, cm) = (state.heading_rad + half).sin_cos();
    let mut f = SMatrix::<f64, 5, 5>::identity();
    f[(0, 2)] = -along * sm;
    f[(1, 2)] = along * cm;
    f[(0, 3)] = dt * cm;
    f[(1, 3)] = dt * sm;
    f[(2, 4)] = dt;
    TargetState {
        north_m: state.north_m + along * cm + reference_m * (c1 - c0),
        east_m: state.east_m + along * sm + reference_m * (s1 - s0),
        heading_rad: wrap_angle(heading),
        speed_mps: speed,
        covariance: state.covariance.map(|p| f * p * f.transpose()),
        ..*state
    }
}

/// Velocity of the reported point, north, east, down, m/s: `(v cos ψ − a ω sin ψ, v sin ψ + a ω cos ψ, 0)`.
pub fn velocity(state: &TargetState, reference_m: f64) -> Vector3<f64> {
    let (s, c) = state.heading_rad.sin_cos();
    let across = reference_m * state.yaw_rate_radps;
    Vector3::new(state.speed_mps * c - across * s, state.speed_mps * s + across * c, 0.0)
}

/// Acceleration of the reported point, north, east, down, m/s²: along `v̇ − a ω²`, across to the right `v ω`.
pub fn acceleration(state: &TargetState, rate_mps2: f64, reference_m: f64) -> Vector3<f64> {
    let (s, c) = state.heading_rad.sin_cos();
    let omega = state.yaw_rate_radps;
    let (along, across) = (rate_mps2 - reference_m * omega * omega, state.speed_mps * omega);
    Vector3::new(along * c - across * s, along * s + across * c, 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::mavlink::vehicle::tests::state_of;

    fn moving(speed_mps: f64, yaw_rate_radps: f64) -> TargetState {
        TargetState { north_m: 0.0, east_m: 0.0, speed_mps, yaw_rate_radps, ..state_of(0.0, None) }
    }

    #[test]
    fn an_arc_is_followed_and_its_point_ahead_of_the_axle_with_it() {
        let (state, reference_m) = (moving(2.0, 0.5), 0.7);
        // A quarter of a second in one step, or in many.
        let whole = ahead(&state, 0.8, reference_m, Span::from_ms(250.0));
        let mut parts = state;
        for _ in 0..250 {
            let north_east = velocity(&parts, reference_m) * 1e-3;
            parts = TargetState {
                north_m: parts.north_m + north_east.x,
                east_m: parts.east_m + north_east.y,
                heading_rad: parts.heading_rad + parts.yaw_rate_radps * 1e-3,
                speed_mps: parts.speed_mps + 0.8e-3,
                ..parts
            };
        }
        let off = (whole.north_m - parts.north_m).hypot(whole.east_m - parts.east_m);
        assert!(off < 1e-3 && (whole.speed_mps - 2.2).abs() < 1e-12, "{off} {whole:?}");
        let (before, after) = (velocity(&state, reference_m), velocity(&whole, reference_m));
        let middle = ahead(&state, 0.8, reference_m, Span::from_ms(125.0));
        let computed = acceleration(&middle, 0.8, reference_m);
        assert!(((after - before) / 0.25 - computed).norm() < 0.01, "{computed}");
    }

    #[test]
    fn what_brakes_does_not_go_backwards() {
        assert_eq!(ahead(&moving(0.3, 0.0), -2.0, 0.0, Span::from_s(1.0)).speed_mps, 0.0);
        assert_eq!(ahead(&moving(-0.3, 0.0), 2.0, 0.0, Span::from_s(1.0)).speed_mps, 0.0);
    }

    #[test]
    fn the_change_of_speed_is_sent_where_it_exceeds_its_noise() {
        let rate = |change: f64, variance: f64| {
            let mut rate = SpeedRate::default();
            for k in 0..20 {
                let t = f64::from(k) / 15.0;
                let noise = variance.sqrt() * f64::from(k % 3 - 1);
                let covariance = Some(SMatrix::identity() * variance);
                let state = TargetState { covariance, ..moving(1.0 + change * t + noise, 0.0) };
                rate.take(MonoTime::default() + Span::from_s(t), &state);
            }
            rate.mps2()
        };
        assert!((rate(1.4, 0.0) - 1.4).abs() < 1e-6);
        assert!(rate(0.0, 0.04 * 0.04).abs() < 0.05);
        assert!((rate(1.4, 0.03 * 0.03) - 1.4).abs() < 0.2);
        assert_eq!(SpeedRate::default().mps2(), 0.0);
    }
}
