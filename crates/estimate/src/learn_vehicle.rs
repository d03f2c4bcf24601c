//! Intensities of the vehicles' motion, fitted in flight.
//!
//! The smoother, which knows what was measured later, shows the filter's errors; a walk is right if these errors agree
//! with the filter's variances.

use super::blocks::TargetBlock;
use super::delayed::DelayedCopy;
use super::fitted::{Learning, MOST, STILL};
use super::standstill::{REST_S, Standstill, Unrest};
use super::state::State;

impl State {
    /// Fits the targets' intensities. Call once a frame, after its fusion.
    pub(crate) fn learn_targets(&mut self, learning: &Learning) {
        let now = self.t;
        let since_s = (now - self.learnt.t_target).s().clamp(0.0, 0.2);
        self.learnt.t_target = now;
        if !learning.on {
            return;
        }
        for i in 0..self.targets.len() {
            if self.targets[i].life.is_held() && self.targets[i].last_seen == now {
                self.learn_rest(learning, i, since_s);
                for k in 0..2 {
                    self.learn_target(learning, i, k, since_s);
                }
            }
        }
    }

    /// Fits the walk of target `i`'s speed (`k` = 0) or yaw rate (`k` = 1).
    ///
    /// Twice the filter's memory `P/q` ago (at least two frames, at most the interval) it had a value and a variance;
    /// since then the smoother has moved that value, and the expected size of this change is known: `P_f − P_s`, and
    /// more where motion is smooth ([`more_than_found`]). The logarithm of the intensity moves by what the ratio of the
    /// two differs from one, so that the mean ratio over time is one.
    fn learn_target(&mut self, learning: &Learning, i: usize, k: usize, since_s: f64) {
        let column = self.layout().target(i).motion().column(k);
        let row = TargetBlock::alone(i).motion().column(k);
        let start = learning.start.target_q[i][k];
        let q = self.walk_seen(i, k, start);
        let memory_s = self.cov.at(column, column) / q;
        self.targets[i].memory_s[k] = memory_s;
        let target = &self.targets[i];
        // A target started again since then has nothing in common with its copy.
        let usable = || self.copies.iter().filter(|c| c.in_use && c.t < self.t && c.t >= target.tied_since);
        let Some(last) = usable().map(|copy| copy.t).max() else { return };
        let frame_s = (self.t - last).s();
        let lag_s = (LAG * memory_s).min(learning.interval.s()).max(2.0 * frame_s);
        let misfit = |copy: &&DelayedCopy| ((self.t - copy.t).s() - lag_s).abs();
        let Some(copy) = usable().min_by(|a, b| misfit(a).total_cmp(&misfit(b))) else { return };
        let age_s = (self.t - copy.t).s();
        if age_s < 0.75 * lag_s {
            return;
        }
        let (value, var) = copy.filtered[i][k];
        let found = var - copy.cov.at(row, row);
        if found < LEAST_FOUND * var {
            return;
        }
        let due = found * (1.0 + more_than_found(memory_s, age_s, frame_s));
        let ratio = (copy.mean[row] - value).powi(2) / due;
        let gain = since_s / learning.over_s.max(MEMORIES * memory_s);
        if ratio.is_finite() && ratio > 0.0 {
            // Never beyond what explains this one.
            let grown = q * (gain * (ratio - 1.0)).min(ratio.ln().max(0.0)).exp();
            let least = self.least_walk();
            self.learnt.target_q[i][k] = grown.clamp(start * least * least, start * MOST * MOST);
            self.targets[i].fitted_memory_s[k] = memory_s;
        }
    }

    /// A vehicle that has stood still for a second is treated as standing: its intensities fall fast. The fit alone
    /// would take long, because increments below the noise have little information.
    ///
    /// The test is `(v̂, ω̂) P⁻¹ (v̂, ω̂)ᵀ`, two on average for a vehicle at rest. One that creeps slower than
    /// can be seen fails it as soon as the smaller intensity has sharpened the estimate.
    fn learn_rest(&mut self, learning: &Learning, i: usize, since_s: f64) {
        let at = self.layout().target(i);
        let (vv, ww) = (self.cov.var(at.speed()), self.cov.var(at.yaw_rate()));
        let vw = self.cov.at(at.speed().column(0), at.yaw_rate().column(0));
        let least = self.least_walk();
        let target = &mut self.targets[i];
        let [.., v, w] = target.mean;
        let test = (v * v * ww - 2.0 * v * w * vw + w * w * vv) / (vv * ww - vw * vw).max(1e-18);
        target.standstill.take(test, since_s);
        if target.standstill.stands() {
            let keep = (-since_s / REST_S).exp();
            for (q, start) in self.learnt.target_q[i].iter_mut().zip(&learning.start.target_q[i]) {
                *q = (*q * keep).max(start * least * least);
            }
        }
    }

    /// Least factor on the configured walks of a vehicle. Where no ground is seen beside it, its own place is what tilt is
    /// known by: one that is certain to stand would then leave its driving off to the helicopter's tilt.
    fn least_walk(&self) -> f64 {
        let ground = self.features.iter().filter(|feature| feature.proven).count();
        if ground >= GROUND { STILL } else { STILL_ALONE }
    }

    /// A target that stood has begun to move, as far as is measured: as [`Self::wake`] has it.
    pub(crate) fn rouse(&mut self, learning: &Learning, i: usize) {
        self.targets[i].unrest = Unrest::default();
        self.wake(learning, i);
    }

    /// A target whose markers have all left the gate moves otherwise than it did. One that stood has begun to move:
    /// its intensities are what is configured again, and its motion is as uncertain as they make it in half a second.
    /// Of one that moves both are raised a little; where the next frame finds it out of the gate too, it is as with
    /// one that stood.
    pub(crate) fn wake(&mut self, learning: &Learning, i: usize) {
        let motion = self.layout().target(i).motion();
        let target = &mut self.targets[i];
        let anew = target.standstill.stands() || target.life.refusals() > 1;
        if anew {
            target.standstill = Standstill::MOVES;
        }
        for (k, start) in learning.start.target_q[i].iter().enumerate() {
            let column = motion.column(k);
            let (q, var) = (&mut self.learnt.target_q[i][k], self.cov.at(column, column));
            let (woken, more) = if anew { (*start, 0.5 * *start) } else { (RAISE * *q, (RAISE - 1.0) * var) };
            if *q < *start {
                *q = woken.min(*start);
                self.cov.add(column, column, more);
            }
        }
    }
}

/// Features that show the helicopter's motion by themselves; least factor on walks where there are fewer.
const GROUND: usize = 3;
const STILL_ALONE: f64 = 0.2;

/// By what factor variances of a vehicle's motion are raised when it moves otherwise than was expected.
const RAISE: f64 = 4.0;

/// How much later than the filter's memory P/q an estimate is compared with what became of it.
const LAG: f64 = 2.0;
/// Fewest memories over which it is fitted: values nearer to each other have the same information.
const MEMORIES: f64 = 4.0;
/// Least share of a variance that must have been found out since.
const LEAST_FOUND: f64 = 0.2;
/// By what share more than a smoother finds out an honest estimate of a memory of `memory_s` turns out to
/// be off after `age_s`: nothing where motion is a walk. Where it is smooth the estimate trails, which no
/// later noise takes part in: of a target whose acceleration lasts for a few memories
/// `E[(filtered − smoothed)²]` exceeds `P_f − P_s` by `min(0.27 age/T, 0.42 + 0.17 frame/T)`
/// (`proof_of_how_much_more_a_smooth_motion_shows`).
/// A vehicle is smooth over times short against its own response, and walks over long ones.
fn more_than_found(memory_s: f64, age_s: f64, frame_s: f64) -> f64 {
    let smooth = (0.27 * age_s).min(0.42 * memory_s + 0.17 * frame_s) / memory_s;
    smooth / (1.0 + memory_s / RESPONSE_S)
}

/// Time within which a vehicle follows its driver, s: a steering gear takes about a quarter of a second, a drive
/// that has a mass to move two thirds; this is between them (their geometric mean is 0.41 s).
const RESPONSE_S: f64 = 0.4;

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix2, RowVector2, Vector2};

    use super::*;

    /// A steady-state filter of place and speed whose place is measured each frame, with its smoother: intensity of the
    /// walk one, frames one second apart, so that the length of its memory in frames depends only on the noise's
    /// variance.
    struct SteadyState {
        noise_var: f64,
        transition: Matrix2<f64>,
        gain: Vector2<f64>,
        filtered: Matrix2<f64>,
        innovation_var: f64,
    }

    impl SteadyState {
        fn new(noise_var: f64) -> Self {
            let transition = Matrix2::new(1.0, 1.0, 0.0, 1.0);
            let walk = Matrix2::new(1.0 / 3.0, 0.5, 0.5, 1.0);
            let mut this = Self {
                noise_var,
                transition,
                gain: Vector2::zeros(),
                filtered: Matrix2::identity() * (1.0 + noise_var),
                innovation_var: 1.0,
            };
            for _ in 0..20_000 {
                let predicted = transition * this.filtered * transition.transpose() + walk;
                this.innovation_var = predicted[(0, 0)] + noise_var;
                this.gain = predicted.column(0) / this.innovation_var;
                this.filtered = predicted - this.gain * predicted.row(0);
            }
            this
        }

        fn memory(&self) -> f64 {
            self.filtered[(1, 1)]
        }

        /// What is left of an error after a frame.
        fn keep(&self) -> Matrix2<f64> {
            Matrix2::identity() - self.gain * RowVector2::new(1.0, 0.0)
        }

        /// By what share `E[(filtered − smoothed)²]` of speed exceeds `P_f − P_s` after so many frames, and the share
        /// of `P_f` that `P_f − P_s` is; of a target at a constant acceleration that makes the filter consistent.
        fn excess(&self, frames: usize) -> (f64, f64) {
            let pushed = Vector2::new(0.5, 1.0);
            let step = self.keep() * self.transition;
            // The error's mean at an acceleration of one, and its covariance from noise alone.
            let trail =
                (Matrix2::identity() - step).try_inverse().expect("a stable filter") * self.keep() * pushed;
            let noise_in = self.gain * self.gain.transpose() * self.noise_var;
            let mut noise = Matrix2::zeros();
            for _ in 0..20_000 {
                noise = step * noise * step.transpose() + noise_in;
            }
            let acceleration2 = (self.filtered[(1, 1)] - noise[(1, 1)]) / trail.y.powi(2);
            let innovation = (self.transition * trail + pushed).x;
            // The smoother moves speed by Σ g ν; ν in terms of the first error and of each frame's noise.
            let mut cross = self.filtered * self.transition.transpose();
            let (mut moved, mut found) = (0.0, 0.0);
            let (mut by_error, mut error) = (RowVector2::zeros(), Matrix2::identity());
            let mut by_noise: Vec<(f64, Vector2<f64>)> = Vec::new();
            for _ in 0..frames {
                let g = cross[(1, 0)] / self.innovation_var;
                let seen = self.transition.row(0).into_owned();
                moved += g * innovation;
                found += g * g * self.innovation_var;
                by_error += g * seen * error;
                by_noise.iter_mut().for_each(|(weight, left)| *weight += g * (seen * *left).x);
                by_noise.iter_mut().for_each(|(_, left)| *left = step * *left);
                by_noise.push((g, -self.gain));
                error = step * error;
                cross = cross * self.keep().transpose() * self.transition.transpose();
            }
            let from_noise = (by_error * noise * by_error.transpose()).x
                + self.noise_var * by_noise.iter().map(|(weight, _)| weight * weight).sum::<f64>();
            let squared = from_noise + acceleration2 * moved * moved;
            (squared / found - 1.0, found / self.filtered[(1, 1)])
        }
    }

    /// Noise of a place over six decades: memories from a third of a frame to fourteen frames.
    const NOISE_VARS: [f64; 7] = [1e-2, 1e-1, 1.0, 1e1, 1e2, 1e3, 1e4];

    /// The constants of `more_than_found` are those of an acceleration that lasts for a few memories: 0.75 to 1.3 of
    /// what one that lasts for ever gives (0.30 age/T, then 0.54 + 0.2 frame/T).
    #[test]
    #[ignore = "a proof of fitted constants"]
    fn proof_of_how_much_more_a_smooth_motion_shows() {
        for noise_var in NOISE_VARS {
            let filter = SteadyState::new(noise_var);
            let memory = filter.memory();
            for ages in [0.5, 1.0, 2.0, 3.0] {
                let frames = (ages * memory).round().max(2.0);
                let (excess, _) = filter.excess(frames as usize);
                // A response of endless length: motion is smooth over any memory.
                let smooth = more_than_found(memory, frames, 1.0) * (1.0 + memory / RESPONSE_S);
                println!(
                    "T {memory:.2} frames, age {frames} frames: {excess:.3}, by the constants {smooth:.3}"
                );
                let ratio = smooth / excess;
                assert!((0.75..1.3).contains(&ratio), "T {memory}, age {frames}: {smooth} of {excess}");
            }
        }
    }

    /// After [`LAG`] memories the smoother has found out nearly all that it ever will, three quarters of the variance:
    /// comparing later would only be later.
    #[test]
    #[ignore = "a proof of fitted constants"]
    fn proof_that_two_memories_are_late_enough() {
        for noise_var in NOISE_VARS {
            let filter = SteadyState::new(noise_var);
            let frames = |memories: f64| (memories * filter.memory()).round().max(2.0) as usize;
            let ((_, found), (_, ever)) = (filter.excess(frames(LAG)), filter.excess(frames(8.0)));
            println!("T {:.2} frames: {found:.3} of {ever:.3}", filter.memory());
            assert!(found > 0.93 * ever, "{found} of {ever}");
            assert!(ever < 0.76 && found > LEAST_FOUND, "{found} of {ever}");
        }
    }
}
