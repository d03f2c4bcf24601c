//! How a vehicle's speed and yaw rate walk at present: as was fitted while it was seen, and more out of sight.

use super::Intensities;
use crate::fitted::SHORTEST_S;
use crate::models::Models;
use crate::state::State;
use crate::track::BLINK_S;

impl State {
    /// How target `i`'s speed (`k` = 0) or yaw rate (`k` = 1) walks while it is seen: as was fitted, which is true at
    /// the scale of the memory the filter had then. Where it remembers for longer now (a marker is hidden) and nothing
    /// is fitted, motion, smoother than a walk, goes farther: its intensity grows as the memory does.
    pub(crate) fn walk_seen(&self, i: usize, k: usize, most: f64) -> f64 {
        let (target, learnt) = (&self.targets[i], self.learnt.target_q[i][k]);
        if target.fitted_memory_s[k] <= 0.0 {
            return learnt;
        }
        (learnt * (target.memory_s[k] / target.fitted_memory_s[k]).max(1.0)).min(most).max(learnt)
    }

    /// How target `i` walks at present. What was fitted is true at the scale of the filter's memory T; motion is
    /// smoother than a walk, so that over a longer time t out of sight its increments grow as `q t²/T`, a walk of
    /// intensity `2 q t/T`, until it may do whatever is configured.
    fn present_walks(&self, i: usize, models: &Models) -> [f64; 2] {
        let target = &self.targets[i];
        let away_s = (self.t - target.last_seen).s();
        std::array::from_fn(|k| {
            let most = models.target_walks[k];
            let seen = self.walk_seen(i, k, most);
            if away_s < BLINK_S {
                return seen;
            }
            let grown = seen * (2.0 * away_s / target.memory_s[k].max(SHORTEST_S)).max(1.0);
            grown.min(most).max(seen)
        })
    }

    /// Intensities of target `i`'s walks, bounded by what its model of motion allows at the present speed.
    pub(crate) fn intensities(&self, i: usize, models: &Models) -> Intensities {
        let [speed_q, yaw_rate_q] = self.present_walks(i, models);
        let speed2 = self.targets[i].mean[3].powi(2) + self.cov.var(self.layout().target(i).speed());
        let bounded = !self.targets[i].spin.is_free();
        let most = models.targets[i].motion.model().most_yaw_rate_q(speed2).filter(|_| bounded);
        let yaw_rate_q = most.map_or(yaw_rate_q, |most| yaw_rate_q.min(most));
        let slip_q = models.slip_q * self.targets[i].slip.factor();
        Intensities { speed_q, yaw_rate_q, slip_q }
    }
}
