//! How everything moves from one instant to the next, and how uncertainty grows with it.
//!
//! The helicopter is in `helicopter.rs`, its sensors' slow errors in the table of `slow.rs`; a model of a vehicle's
//! motion is a file that implements [`VehicleMotion`] and a row of [`Motion`]. Ground features stand still.

mod ackermann;
mod fixed;
mod helicopter;
mod rolling;
mod unicycle;
mod walks;

use windhover_base::settings::{TargetConfig, TargetModel};
use windhover_base::time::MonoTime;

use super::blocks::{TARGET, TargetBlock};
use super::delayed;
use super::matrix::Grid;
use super::models::Models;
use super::slow::Terms;
use super::state::State;

use ackermann::Ackermann;
use fixed::Fixed;
use helicopter::Step;
use unicycle::Unicycle;

/// Longest step, seconds: the linearisation holds over it.
const MAX_STEP_S: f64 = 0.05;

/// Intensities of the walks that drive a vehicle, units²/s.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Intensities {
    /// Of speed, (m/s)²/s.
    pub(crate) speed_q: f64,
    /// Of yaw rate, (rad/s)²/s.
    pub(crate) yaw_rate_q: f64,
    /// Of a side slip straight into the place, m²/s.
    pub(crate) slip_q: f64,
}

/// A model of how a vehicle moves; the state is north, east, heading, speed, yaw rate of the rear axle.
pub(crate) trait VehicleMotion {
    /// Whether it moves at all. What does not is never lost, and has neither speed nor yaw rate.
    fn moves(&self) -> bool;

    /// The largest intensity of the yaw rate's walk at a squared speed; `None` where speed does not bound it.
    fn most_yaw_rate_q(&self, speed2: f64) -> Option<f64>;

    /// The tightest turn it can drive, 1/m; `None` where it may turn on the spot.
    fn tightest_turn(&self) -> Option<f64> {
        None
    }

    /// Carries the mean on; by itself, as a vehicle that rolls where it points.
    fn advance(&self, mean: &mut [f64; TARGET], dt: f64) {
        rolling::advance(mean, dt);
    }

    /// `row ← row Fᵀ` for all rows of the grids, in the columns of `at`; F is taken at `mean`, and is that of
    /// [`Self::advance`].
    fn carry(
        &self,
        mean: &[f64; TARGET],
        dt: f64,
        at: TargetBlock,
        grids: &mut dyn Iterator<Item = &mut Grid>,
    ) {
        rolling::carry(mean, dt, at, grids);
    }

    /// Adds Q of the step from `mean`.
    fn add_noise(&self, mean: &[f64; TARGET], dt: f64, walks: Intensities, at: TargetBlock, p: &mut Grid) {
        rolling::add_noise(mean, dt, walks, at, p);
    }
}

/// The models of motion: a row each.
#[derive(Clone, Debug)]
pub(crate) enum Motion {
    Ackermann(Ackermann),
    Unicycle(Unicycle),
    Fixed(Fixed),
}

impl Motion {
    /// As configured.
    pub(crate) fn new(config: &TargetConfig) -> Self {
        match config.model {
            TargetModel::Ackermann => Self::Ackermann(Ackermann::new(config.wheelbase_m.unwrap_or(0.0))),
            TargetModel::Unicycle => Self::Unicycle(Unicycle),
            TargetModel::Static => Self::Fixed(Fixed),
        }
    }

    /// The model's file.
    pub(crate) fn model(&self) -> &dyn VehicleMotion {
        match self {
            Self::Ackermann(model) => model,
            Self::Unicycle(model) => model,
            Self::Fixed(model) => model,
        }
    }
}

impl State {
    /// Carries mean and covariance on to `t`; does nothing where `t` is not later.
    pub(crate) fn propagate(&mut self, t: MonoTime, models: &Models) {
        let mut left = (t - self.t).s();
        while left > 0.0 {
            let dt = left.min(MAX_STEP_S);
            self.step(dt, models);
            left -= dt;
        }
        self.t = self.t.max(t);
    }

    fn step(&mut self, dt: f64, models: &Models) {
        let terms = Terms { models, learnt: &self.learnt, senses: &self.senses };
        let step = Step::new(&self.own, self.layout(), dt, &terms);
        self.carry(&step, models, true);
        // P Fᵀ is done; F (P Fᵀ) is the same on the rows of its transpose.
        self.cov.transpose();
        self.carry(&step, models, false);
        let terms = Terms { models, learnt: &self.learnt, senses: &self.senses };
        step.add_noise(&terms, &mut self.cov);
        for i in 0..self.targets.len() {
            if self.targets[i].life.is_held() {
                let (walks, at) = (self.intensities(i, models), self.layout().target(i));
                let mean = &self.targets[i].mean;
                models.targets[i].motion.model().add_noise(mean, dt, walks, at, &mut self.cov);
            }
        }
        self.advance_sways(dt, models);
        step.advance(&mut self.own);
        for (target, model) in self.targets.iter_mut().zip(&models.targets) {
            if target.life.is_held() {
                model.motion.model().advance(&mut target.mean, dt);
            }
        }
    }

    /// `row ← row Fᵀ` for the covariance and, if asked for, for that of delayed copies with the present state.
    fn carry(&mut self, step: &Step, models: &Models, with_copies: bool) {
        let layout = self.layout();
        let Self { cov, copies, past_motion, past_bias, targets, .. } = self;
        if with_copies {
            delayed::in_use(copies, [past_motion, past_bias]).for_each(|copy| step.carry(&mut copy.cross));
        }
        step.carry(cov);
        for (i, target) in targets.iter().enumerate().filter(|(_, target)| target.life.is_held()) {
            let crosses = delayed::in_use(copies, [past_motion, past_bias]).map(|copy| &mut copy.cross);
            let mut grids = std::iter::once(&mut *cov).chain(crosses.filter(|_| with_copies));
            models.targets[i].motion.model().carry(&target.mean, step.dt(), layout.target(i), &mut grids);
        }
        self.carry_sways(step.dt(), with_copies);
    }
}
