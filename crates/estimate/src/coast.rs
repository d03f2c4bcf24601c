//! What is known of the targets while no frame comes: predicted, and lost in its time.

use windhover_base::msg::EstimatorOutput;
use windhover_base::time::MonoTime;

use super::filter::Estimator;
use super::track::Circumstances;

impl Estimator {
    /// Gives one estimate a target at `now` as a frame without sightings would give it, and does not change the filter:
    /// frames that arrive late are still inserted at their time. `frame` is the number of the last one.
    pub fn coast(&mut self, now: MonoTime, frame: u32, out: &mut Vec<EstimatorOutput>) {
        let Self { core, ahead, .. } = self;
        ahead.copy_present(&core.state);
        if ahead.alive {
            ahead.propagate(now, &core.models);
        }
        for index in 0..ahead.targets.len() {
            let target = &mut ahead.targets[index];
            let circumstances = Circumstances {
                away: ahead.t - target.last_seen,
                lost_after: core.models.targets[index].moves().then_some(core.lost_after),
                heading_doubtful: false,
            };
            target.life = target.life.unseen(&circumstances);
            out.push(EstimatorOutput::Coasted(ahead.estimate(&core.models, index, frame, now)));
        }
    }
}
