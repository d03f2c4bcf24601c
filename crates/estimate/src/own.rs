//! The helicopter and its sensors' slow errors.
//!
//! A slow error more is a field of [`Own`], a block in `blocks.rs` and a row of [`SLOW`]: where it starts and how it
//! wanders. Everything else (injection, prediction, start, warm start) goes by the table. The measurement models in
//! `aid` that it explains take it from there.

use nalgebra::{Matrix3, Rotation3, Vector2, Vector3};

use super::blocks::{Block, own};
use super::models::Models;

/// Standard gravity, m/s².
pub(crate) const GRAVITY: f64 = 9.806_65;

/// The means.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Own {
    /// Of the body frame's origin, NED, m.
    pub(crate) position: Vector3<f64>,
    pub(crate) velocity: Vector3<f64>,
    pub(crate) ned_from_body: Rotation3<f64>,
    pub(crate) rate: Vector3<f64>,
    pub(crate) force: Vector3<f64>,
    pub(crate) gps_bias: Vector3<f64>,
    pub(crate) heading_bias: f64,
    pub(crate) tilt_gain: f64,
    pub(crate) tilt_bias: Vector2<f64>,
    pub(crate) gps_delay_s: f64,
    pub(crate) drag_per_s: f64,
}

impl Default for Own {
    fn default() -> Self {
        Self {
            position: Vector3::zeros(),
            velocity: Vector3::zeros(),
            ned_from_body: Rotation3::identity(),
            rate: Vector3::zeros(),
            force: Vector3::new(0.0, 0.0, -GRAVITY),
            gps_bias: Vector3::zeros(),
            heading_bias: 0.0,
            tilt_gain: 1.0,
            tilt_bias: Vector2::zeros(),
            gps_delay_s: 0.0,
            drag_per_s: 0.0,
        }
    }
}

/// Number of slow states.
pub(crate) const SLOW_STATES: usize = own::LEN - own::FORCE.end();

/// How a slow state moves.
enum Wander {
    /// Not at all.
    Constant,
    /// A random walk, units per √s.
    Walk(f64),
    /// Gauss–Markov about zero: correlation time, s. Its variance is that it starts with.
    Reverts(fn(&Models) -> f64),
}

/// A slow state of up to three components.
struct Slow {
    first: usize,
    mean: for<'a> fn(&'a mut Own) -> &'a mut [f64],
    start_var: fn(&Models) -> [f64; 3],
    wander: Wander,
}

/// The slow states in the order of their columns.
const SLOW: [Slow; 6] = [
    Slow {
        first: place(own::GPS_BIAS),
        mean: |own| own.gps_bias.as_mut_slice(),
        start_var: |models| models.gps_bias_var.into(),
        wander: Wander::Reverts(|models| models.tau.gps_bias_s),
    },
    Slow {
        first: place(own::HEADING_BIAS),
        mean: |own| std::slice::from_mut(&mut own.heading_bias),
        start_var: |models| [models.heading_bias_var; 3],
        // A tenth of a degree over 100 s would be 2e-4.
        wander: Wander::Walk(3e-4),
    },
    Slow {
        first: place(own::TILT_GAIN),
        mean: |own| std::slice::from_mut(&mut own.tilt_gain),
        // From a sensor that reads nothing to one that reads all.
        start_var: |_| [0.5f64.powi(2); 3],
        wander: Wander::Walk(0.005),
    },
    Slow {
        first: place(own::TILT_BIAS),
        mean: |own| own.tilt_bias.as_mut_slice(),
        // 0.4°: data sheets allow 0.2° to 0.5°.
        start_var: |_| [0.007f64.powi(2); 3],
        wander: Wander::Walk(3e-4),
    },
    Slow {
        first: place(own::GPS_DELAY),
        mean: |own| std::slice::from_mut(&mut own.gps_delay_s),
        start_var: |models| [models.gps_delay_var; 3],
        wander: Wander::Walk(2e-4),
    },
    Slow {
        first: place(own::DRAG),
        mean: |own| std::slice::from_mut(&mut own.drag_per_s),
        // Of a small helicopter 0.1 to 0.3 is usual.
        start_var: |_| [0.2f64.powi(2); 3],
        wander: Wander::Constant,
    },
];

/// Where a block begins among the slow states.
const fn place<const N: usize>(block: Block<N>) -> usize {
    block.column(0) - own::SLOW.column(0)
}

impl Own {
    /// Acceleration in NED: `R f + g − c v`, where the drag of the wind is part of f.
    pub(crate) fn acceleration(&self) -> Vector3<f64> {
        self.ned_from_body * self.force + Vector3::new(0.0, 0.0, GRAVITY) - self.velocity * self.drag_per_s
    }

    /// `ned_from_body` as a matrix.
    pub(crate) fn rotation(&self) -> &Matrix3<f64> {
        self.ned_from_body.matrix()
    }

    /// Velocity of a point at `lever_m` in the body frame: `v + R (ω × l)`.
    pub(crate) fn velocity_of(&self, lever_m: &Vector3<f64>) -> Vector3<f64> {
        self.velocity + self.ned_from_body * self.rate.cross(lever_m)
    }

    /// Moves it by an error-state step.
    pub(crate) fn inject(&mut self, dx: &[f64]) {
        self.position += own::POSITION.of(dx);
        self.velocity += own::VELOCITY.of(dx);
        self.ned_from_body = Rotation3::new(own::ATTITUDE.of(dx)) * self.ned_from_body;
        self.rate += own::RATE.of(dx);
        self.force += own::FORCE.of(dx);
        self.change_slow(|i, mean| *mean += dx[own::SLOW.column(i)]);
    }

    /// Whether every mean is a number.
    pub(crate) fn is_finite(&self) -> bool {
        let vectors = [&self.position, &self.velocity, &self.rate, &self.force];
        vectors.iter().all(|v| v.iter().all(|x| x.is_finite()))
            && self.slow().iter().all(|x| x.is_finite())
            && self.rotation().iter().all(|x| x.is_finite())
    }

    /// The slow states in the order of their columns.
    pub(crate) fn slow(mut self) -> [f64; SLOW_STATES] {
        let mut means = [0.0; SLOW_STATES];
        self.change_slow(|i, mean| means[i] = *mean);
        means
    }

    /// Gives each slow state, with its place among them, to a function.
    pub(crate) fn change_slow(&mut self, mut change: impl FnMut(usize, &mut f64)) {
        for slow in &SLOW {
            (slow.mean)(self).iter_mut().enumerate().for_each(|(i, mean)| change(slow.first + i, mean));
        }
    }
}

/// Variances that the slow states start with.
pub(crate) fn slow_start_vars(models: &Models) -> [f64; SLOW_STATES] {
    by_row(|slow| (slow.start_var)(models))
}

/// Factors on the slow states' errors over a time: below one of those that revert.
pub(crate) fn slow_decays(models: &Models, dt_s: f64) -> [f64; SLOW_STATES] {
    by_row(|slow| [slow.decay(models, dt_s); 3])
}

/// Variances that the slow states gain over a time.
pub(crate) fn slow_growth(models: &Models, dt_s: f64) -> [f64; SLOW_STATES] {
    by_row(|slow| match slow.wander {
        Wander::Constant => [0.0; 3],
        Wander::Walk(walk) => [walk.powi(2) * dt_s; 3],
        Wander::Reverts(_) => {
            let decay = slow.decay(models, dt_s);
            (slow.start_var)(models).map(|var| var * (1.0 - decay * decay))
        }
    })
}

impl Slow {
    fn decay(&self, models: &Models, dt_s: f64) -> f64 {
        match self.wander {
            Wander::Reverts(tau_s) => (-dt_s / tau_s(models)).exp(),
            Wander::Constant | Wander::Walk(_) => 1.0,
        }
    }
}

fn by_row(values: impl Fn(&Slow) -> [f64; 3]) -> [f64; SLOW_STATES] {
    let mut all = [0.0; SLOW_STATES];
    for (k, slow) in SLOW.iter().enumerate() {
        let end = SLOW.get(k + 1).map_or(SLOW_STATES, |next| next.first);
        let row = values(slow);
        all[slow.first..end].copy_from_slice(&row[..end - slow.first]);
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_has_every_slow_state_once_and_in_order() {
        let mut own = Own::default();
        let mut places = Vec::new();
        own.change_slow(|i, mean| {
            places.push(i);
            *mean = i as f64;
        });
        assert_eq!(places, (0..SLOW_STATES).collect::<Vec<_>>());
        assert_eq!(own.drag_per_s, (SLOW_STATES - 1) as f64);
        assert_eq!(own.slow()[place(own::GPS_DELAY)], own.gps_delay_s);
    }
}
