//! The present values of all unknowns, and a knot's state shortly before or after it.

use nalgebra::{Rotation3, Vector3};

use windhover_estimate::batch::{Predictor, SHAKE_COLUMNS};

use crate::unknowns::{Place, knot};

/// Helicopter and targets at one instant.
#[derive(Clone, Debug)]
pub(crate) struct Knot {
    pub(crate) attitude: Rotation3<f64>,
    /// By the places of [`knot`]; those of the attitude are zero.
    pub(crate) x: Vec<f64>,
}

impl Knot {
    pub(crate) fn three(&self, at: usize) -> Vector3<f64> {
        Vector3::from_column_slice(&self.x[at..at + 3])
    }

    pub(crate) fn target(&self, i: usize) -> &[f64] {
        &self.x[knot::target(i)..][..knot::TARGET]
    }

    /// Moves it by a step.
    pub(crate) fn step(&mut self, dx: &[f64]) {
        let turn = Vector3::from_column_slice(&dx[knot::ATTITUDE..knot::ATTITUDE + 3]);
        self.attitude = Rotation3::new(turn) * self.attitude;
        self.attitude.renormalize();
        self.x.iter_mut().zip(dx).for_each(|(x, d)| *x += d);
        self.x[knot::ATTITUDE..knot::ATTITUDE + 3].fill(0.0);
    }

    /// The state a time `dt` later, with this acceleration.
    pub(crate) fn after(&self, dt: f64, acceleration: &Vector3<f64>) -> Self {
        let mut next = self.clone();
        let (v, rate, spin) = (self.three(knot::VELOCITY), self.three(knot::RATE), self.three(knot::SPIN));
        for i in 0..3 {
            next.x[knot::POSITION + i] += v[i] * dt + 0.5 * acceleration[i] * dt * dt;
            next.x[knot::VELOCITY + i] += acceleration[i] * dt;
            next.x[knot::RATE + i] += spin[i] * dt;
        }
        next.attitude *= Rotation3::new(rate * dt + spin * (0.5 * dt * dt));
        let targets = (self.x.len() - knot::TARGETS) / knot::TARGET;
        for i in 0..targets {
            let flow = self.target_flow(i);
            let bend = self.target_bend(i);
            let at = knot::target(i);
            let changes = flow.iter().zip(bend).map(|(rate, bend)| dt * (rate + 0.5 * dt * bend));
            next.x[at..at + 5].iter_mut().zip(changes).for_each(|(x, change)| *x += change);
        }
        next
    }

    /// Rates of change of a target's north, east, heading, speed and yaw rate.
    pub(crate) fn target_flow(&self, i: usize) -> [f64; 5] {
        let t = self.target(i);
        let (s, c) = t[knot::HEADING].sin_cos();
        let speed = t[knot::SPEED];
        [speed * c, speed * s, t[knot::YAW_RATE], t[knot::ACCELERATION], t[knot::YAW_ACCELERATION]]
    }

    /// Rates of change of these rates.
    pub(crate) fn target_bend(&self, i: usize) -> [f64; 5] {
        let t = self.target(i);
        let (s, c) = t[knot::HEADING].sin_cos();
        let (along, across) = (t[knot::ACCELERATION], t[knot::SPEED] * t[knot::YAW_RATE]);
        let turn = t[knot::YAW_ACCELERATION];
        [along * c - across * s, along * s + across * c, turn, t[knot::JERK], t[knot::YAW_JERK]]
    }
}

/// All unknowns.
#[derive(Clone, Debug)]
pub(crate) struct Values {
    pub(crate) knots: Vec<Knot>,
    /// North and east of each ground feature.
    pub(crate) landmarks: Vec<[f64; 2]>,
    pub(crate) constants: Vec<f64>,
    /// Displacement of the frame at each knot by a camera that shakes; empty where it does not.
    pub(crate) shakes: Vec<[f64; SHAKE_COLUMNS]>,
}

/// What a measurement depends on beside a knot's state and the constants.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Aside {
    pub(crate) landmark: [f64; 2],
    pub(crate) shake: [f64; SHAKE_COLUMNS],
}

impl Aside {
    pub(crate) const NONE: Self = Self { landmark: [0.0; 2], shake: [0.0; SHAKE_COLUMNS] };
}

impl Values {
    /// The displacement of the frame at a knot.
    pub(crate) fn shake(&self, k: usize) -> [f64; SHAKE_COLUMNS] {
        self.shakes.get(k).copied().unwrap_or([0.0; SHAKE_COLUMNS])
    }

    /// Sets the models to a knot's state.
    pub(crate) fn put(
        &self,
        state: &Knot,
        aside: &Aside,
        places: &[Place],
        means: &mut [f64],
        predictor: &mut Predictor,
    ) {
        for (mean, place) in means.iter_mut().zip(places) {
            *mean = match *place {
                Place::Knot(i) => state.x[i],
                Place::Constant(i) | Place::Known(i) => self.constants[i],
                Place::Landmark(i) => aside.landmark[i],
                Place::Shake(i) => aside.shake[i],
                Place::Nowhere => 0.0,
            };
        }
        predictor.put(&state.attitude, means);
    }
}
