//! Sway of a vehicle on its springs: its tags move about while its wheels roll on.
//!
//! A vehicle that rolls (φ, about its forward axis), pitches (θ, about its right axis) and heaves (d, downwards) on its springs
//! moves a point `p` of its body by `(φ, θ, 0) × p + (0, 0, d)`, some centimetres on the roof, with periods of half a second
//! to some seconds, and comes back. Three states of each vehicle, each an Ornstein–Uhlenbeck process, `ẋ = −x/τ + w`.
//! A vehicle that does not sway has them at zero, with no variance at all.
//!
//! Whether it sways is judged by what a rolling vehicle does not do: move across its heading, or up and down. Each of these
//! displacements since the track began is high-passed twice. Of a displacement that comes back, both filters keep about the
//! same energy; of a slide or of a walk the slower filter keeps several times as much. A vehicle just found is presumed to
//! sway a little until it is judged: what its tags show of the helicopter's tilt and of its own heading would otherwise be
//! believed to the last pixel.

use nalgebra::{Matrix3, SMatrix, Vector3};

use super::blocks::{SWAY, own};
use super::core::Core;
use super::delayed;
use super::models::Models;
use super::slip::Across;
use super::state::State;

/// Correlation time of the displacement, s: that of oscillations with periods of 0.5 to 2 s.
pub(crate) const CORRELATION_S: f64 = 0.25;
/// Time constants of the two high-pass filters, s.
const FAST_S: f64 = 0.15;
const SLOW_S: f64 = 1.5;
/// Share of the variance of such an oscillation that the fast filter keeps.
const FAST_KEEPS: f64 = 0.4;
/// Time over which energies are averaged, s, and for how long they must have been before they are judged.
const OVER_S: f64 = 3.0;
const JUDGED_S: f64 = 1.5;
/// Energy of the slow filter over that of the fast one: 3 to 5 of such an oscillation, 20 and more of a slide.
const COMES_BACK: f64 = 12.0;
/// How much more energy than the filter's own uncertainty explains is not noise.
const LEAST_RATIO: f64 = 1.5;
/// Nothing is taken before a place is known well enough to be expected to move by less than this, m.
const SETTLED_M: f64 = 0.005;
/// Displacement below which it is closed, and above which it is opened; the most there is, m.
const SIGMAS_M: (f64, f64, f64) = (0.002, 0.004, 0.15);

/// Displacement that is presumed of a vehicle just found, m.
const PRESUMED_M: f64 = 0.005;
/// The most that a body tilts, rad.
const MOST_TILT: f64 = 0.15;

/// ∂(displacement of a point of the body)/∂(roll, pitch, heave).
pub(crate) fn derivative(point: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, point.z, 0.0, -point.z, 0.0, 0.0, point.y, -point.x, 1.0)
}

/// What a vehicle that rolls along does not do: displacements of its tags in one direction that come back.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
struct Displacements {
    /// Since the track began, high-passed; what the filter expects of the variance of the fast one.
    fast_m: f64,
    slow_m: f64,
    expected_var: f64,
    /// Means of both: where heading is off, a vehicle rolls steadily across it.
    mean_m: [f64; 2],
    /// Mean squares of both, and of what is expected, m².
    energy: [f64; 3],
    /// For how long they have been taken, at most [`OVER_S`].
    taken_s: f64,
    /// The variance that they have shown, m²; 0 where they showed none.
    var: f64,
}

impl Displacements {
    /// Takes what is displaced since the frame before, and the variance that was due; whether it may be judged.
    fn take(&mut self, moved_m: f64, due: f64, since_s: f64) -> bool {
        let keep = |over_s: f64| (-since_s / over_s).exp();
        self.fast_m = keep(FAST_S) * (self.fast_m + moved_m);
        self.slow_m = keep(SLOW_S) * (self.slow_m + moved_m);
        self.expected_var = keep(FAST_S).powi(2) * (self.expected_var + due);
        if self.taken_s == 0.0 && self.expected_var > SETTLED_M.powi(2) {
            (self.fast_m, self.slow_m) = (0.0, 0.0);
            return false;
        }
        self.taken_s = (self.taken_s + since_s).min(OVER_S);
        let share = (since_s / self.taken_s).min(1.0);
        for (mean, x) in self.mean_m.iter_mut().zip([self.fast_m, self.slow_m]) {
            *mean += share * (x - *mean);
        }
        let [fast, slow] = [self.fast_m - self.mean_m[0], self.slow_m - self.mean_m[1]];
        let now = [fast * fast, slow * slow, self.expected_var];
        self.energy.iter_mut().zip(now).for_each(|(mean, x)| *mean += share * (x - *mean));
        self.is_judged()
    }

    /// Whether they were taken for long enough.
    fn is_judged(&self) -> bool {
        self.taken_s >= JUDGED_S
    }

    /// The variance that they show; 0 where they show none.
    fn shown(&self) -> f64 {
        let [fast, slow, expected] = self.energy;
        let var = (fast - expected).max(0.0) / FAST_KEEPS;
        let (close, open, most) = SIGMAS_M;
        let least = if self.var > 0.0 { close } else { open };
        let beyond = self.var > 0.0 || fast > LEAST_RATIO * expected;
        let comes_back = slow < COMES_BACK * fast;
        if beyond && comes_back && var > least * least { var.min(most * most) } else { 0.0 }
    }
}

/// Sway of one vehicle.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub(crate) struct Sway {
    /// Roll and pitch of the body, rad, and how much lower it is, m.
    pub(crate) mean: [f64; SWAY],
    /// Variance of the displacement of its tags by its angles, and of its heave, without any measurement, m²; 0 where the
    /// vehicle is not taken to sway.
    var: [f64; 2],
    /// Displacements of its tags to the right and downwards after the last frame, m.
    last_m: [f64; 2],
    /// Likewise, beyond what rolling makes of them.
    displaced: [Displacements; 2],
}

impl Sway {
    /// Of a vehicle of which nothing is known yet: it may sway.
    pub(crate) fn presumed() -> Self {
        Self { var: [PRESUMED_M * PRESUMED_M; 2], ..Self::default() }
    }

    /// Whether the vehicle is taken to sway.
    pub(crate) fn is_open(&self) -> bool {
        self.var[1] > 0.0
    }

    /// Whether it was seen for long enough to be judged.
    pub(crate) fn is_judged(&self) -> bool {
        self.displaced.iter().all(Displacements::is_judged)
    }

    /// Standard deviation of its markers' displacement, m; `None` where it was not seen to sway.
    pub(crate) fn shown_m(&self) -> Option<f64> {
        let [across, down] = self.displaced.map(|displaced| displaced.var);
        (across.max(down) > 0.0).then(|| (across + down).sqrt())
    }

    /// Variances of the states without any measurement, of a vehicle whose tags are so high, m.
    fn variances(&self, height_m: f64) -> [f64; SWAY] {
        let angle_var = (self.var[0] / height_m.powi(2)).min(MOST_TILT.powi(2));
        [angle_var, angle_var, self.var[1]]
    }

    /// By how much a point of the body is displaced, vehicle frame, m.
    pub(crate) fn displaced(&self, point: &Vector3<f64>) -> Vector3<f64> {
        derivative(point) * Vector3::from(self.mean)
    }

    /// Derivatives of a point as those of the point displaced.
    pub(crate) fn carried<const N: usize>(&self, d_point: &SMatrix<f64, 3, N>) -> SMatrix<f64, 3, N> {
        let [roll, pitch, _] = self.mean;
        d_point + Vector3::new(roll, pitch, 0.0).cross_matrix() * d_point
    }

    /// Takes a frame's displacements to the right and downwards beside those of the states, and what was due of them;
    /// whether what is taken of the vehicle has changed from or to nothing.
    fn take(&mut self, moved_m: [f64; 2], due: [f64; 2], since_s: f64, height_m: f64) -> bool {
        let now = [height_m * self.mean[0], self.mean[2]];
        let mut judged = false;
        for (k, displaced) in self.displaced.iter_mut().enumerate() {
            judged |= displaced.take(moved_m[k] + now[k] - self.last_m[k], due[k], since_s);
        }
        self.last_m = now;
        if !judged {
            return false;
        }
        for displaced in self.displaced.iter_mut().filter(|displaced| displaced.is_judged()) {
            displaced.var = displaced.shown();
        }
        let before = self.var;
        // What is not judged yet is presumed as before.
        let presumed = PRESUMED_M * PRESUMED_M;
        let [across, down] =
            self.displaced.map(|displaced| if displaced.is_judged() { displaced.var } else { presumed });
        self.var = [across, down.max(across)];
        (0..2).any(|k| (before[k] > 0.0) != (self.var[k] > 0.0))
    }
}

/// What is known of a vehicle before a frame is fused.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Before {
    across: Across,
    /// The helicopter's height, and its variance.
    down_m: f64,
    down_var: f64,
    since_s: f64,
}

impl Core {
    /// What [`Self::judge_vehicle`] compares with: before target `i` is fused.
    pub(crate) fn before_fusion(&self, i: usize) -> Before {
        Before {
            across: self.state.across(i),
            down_m: self.state.own.position.z,
            down_var: self.state.cov.var(own::POSITION.part(2)),
            since_s: (self.state.t - self.state.targets[i].last_seen).s().clamp(0.0, 0.2),
        }
    }

    /// Judges by what a frame has made of where target `i` was whether it slips or sways.
    pub(crate) fn judge_vehicle(&mut self, i: usize, before: &Before) {
        if !self.learning.on || self.at_truth || !self.models.targets[i].moves() {
            return;
        }
        self.state.learn_slip(i, &before.across, before.since_s);
        let moved = before.across.moved(&self.state.across(i));
        // A body that is lower than it was looks like a helicopter that is higher.
        let sunk = before.down_m - self.state.own.position.z;
        // What a slip that has been fitted to the same displacements adds is no reason to expect them.
        let slip = self.state.targets[i].slip.factor();
        let due = (before.across.var() - self.state.across_var(i, &before.across)).max(0.0) / slip;
        let due_down = (before.down_var - self.state.cov.var(own::POSITION.part(2))).max(0.0);
        let height_m = self.models.targets[i].markers_height_m;
        let sway = &mut self.state.targets[i].sway;
        if sway.take([moved, sunk], [due, due_down], before.since_s, height_m) {
            self.state.renew_sway(i, &self.models);
        }
    }
}

impl State {
    /// Carries the covariance of sways on: `row ← row Fᵀ` for all rows of a grid.
    pub(crate) fn carry_sways(&mut self, dt: f64, with_copies: bool) {
        let (decay, layout) = ((-dt / CORRELATION_S).exp(), self.layout());
        let Self { cov, copies, past_motion, past_bias, targets, .. } = self;
        for (i, _) in targets.iter().enumerate().filter(|(_, target)| target.sway.is_open()) {
            let crosses = delayed::in_use(copies, [past_motion, past_bias]).map(|copy| &mut copy.cross);
            for grid in std::iter::once(&mut *cov).chain(crosses.filter(|_| with_copies)) {
                for row in 0..grid.rows() {
                    grid.row_mut(row)[layout.sway(i).range()].iter_mut().for_each(|x| *x *= decay);
                }
            }
        }
    }

    /// Adds the variance that sways gain over a step, and carries their means on.
    pub(crate) fn advance_sways(&mut self, dt: f64, models: &Models) {
        let (decay, layout) = ((-dt / CORRELATION_S).exp(), self.layout());
        for (i, target) in self.targets.iter_mut().enumerate().filter(|(_, target)| target.sway.is_open()) {
            target.sway.mean.iter_mut().for_each(|x| *x *= decay);
            let variances = target.sway.variances(models.targets[i].markers_height_m);
            self.cov.add_diagonal(layout.sway(i), &variances.map(|var| var * (1.0 - decay * decay)));
        }
    }

    /// Forgets how target `i` is displaced.
    pub(crate) fn renew_sway(&mut self, i: usize, models: &Models) {
        let variances = self.targets[i].sway.variances(models.targets[i].markers_height_m);
        (self.targets[i].sway.mean, self.targets[i].sway.last_m) = ([0.0; SWAY], [0.0; 2]);
        self.renew(self.layout().sway(i), &variances);
    }
}
