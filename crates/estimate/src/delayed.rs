//! Delayed state copies: some states as they were at one instant, kept up with all that is measured after it.
//!
//! Only a copy's own covariance and that with the present state are needed: fixed-point smoothing.

use windhover_base::msg::TrackStatus;
use windhover_base::time::{MonoTime, Span};

use super::blocks::{Block, Layout, TARGET, TargetBlock, own};
use super::matrix::Grid;
use super::state::State;

/// A copy of some states.
#[derive(Clone, Debug, Default)]
pub(crate) struct DelayedCopy {
    /// Whether it is kept up; everything else counts only then.
    pub(crate) in_use: bool,
    /// When the states were as they are here.
    pub(crate) t: MonoTime,
    pub(crate) frame: u32,
    pub(crate) mean: Vec<f64>,
    pub(crate) cov: Grid,
    /// Covariance with the present state: a row for each state copied.
    pub(crate) cross: Grid,
    /// Of a copy of the targets: what became of each track then.
    pub(crate) status: Vec<TrackStatus>,
    /// Likewise: speed and yaw rate as filtered then, with their variances.
    pub(crate) filtered: Vec<[(f64, f64); 2]>,
}

impl DelayedCopy {
    /// Room for a copy of all targets.
    pub(crate) fn of_targets(layout: Layout) -> Self {
        Self {
            status: vec![TrackStatus::Lost; layout.targets],
            filtered: vec![[(0.0, 0.0); 2]; layout.targets],
            ..Self::of_states(TARGET * layout.targets, layout.len())
        }
    }

    /// Room for a copy of so many states of `n`.
    pub(crate) fn of_states(states: usize, n: usize) -> Self {
        Self {
            mean: vec![0.0; states],
            cov: Grid::zeros(states, states),
            cross: Grid::zeros(states, n),
            ..Self::default()
        }
    }

    /// Copies without allocating where the sizes match.
    pub(crate) fn copy_from(&mut self, other: &Self) {
        self.in_use = other.in_use;
        if !other.in_use {
            return;
        }
        self.t = other.t;
        self.frame = other.frame;
        self.mean.clone_from(&other.mean);
        self.cov.copy_from(&other.cov);
        self.cross.copy_from(&other.cross);
        self.status.clone_from(&other.status);
        self.filtered.clone_from(&other.filtered);
    }

    /// Copies the covariance of the states from the first of `block` on.
    fn take<const N: usize>(&mut self, cov: &Grid, block: Block<N>) {
        let (first, m) = (block.column(0), self.mean.len());
        for i in 0..m {
            let row = cov.row(first + i);
            self.cross.row_mut(i).copy_from_slice(row);
            self.cov.row_mut(i).copy_from_slice(&row[first..first + m]);
        }
    }
}

impl State {
    /// The copies that are kept up.
    pub(crate) fn copies_in_use(&mut self) -> impl Iterator<Item = &mut DelayedCopy> {
        in_use(&mut self.copies, [&mut self.past_motion, &mut self.past_bias])
    }

    /// Starts a copy of the targets at the present instant, in the oldest place.
    pub(crate) fn copy_targets(&mut self, frame: u32, keep: Span) {
        for copy in &mut self.copies {
            copy.in_use &= self.t - copy.t <= keep;
        }
        let age = |i: &usize| (self.copies[*i].in_use, self.copies[*i].t, *i);
        let Some(slot) = (0..self.copies.len()).min_by_key(age) else { return };
        let layout = self.layout();
        let copy = &mut self.copies[slot];
        for (i, target) in self.targets.iter().enumerate() {
            copy.mean[TargetBlock::alone(i).all().range()].copy_from_slice(&target.mean);
            copy.status[i] = target.life.status();
            let motion = layout.target(i).motion();
            copy.filtered[i] = std::array::from_fn(|k| {
                (target.mean[3 + k], self.cov.at(motion.column(k), motion.column(k)))
            });
        }
        (copy.in_use, copy.t, copy.frame) = (true, self.t, frame);
        copy.take(&self.cov, layout.target(0).all());
    }

    /// Starts a copy of what the fitted intensities drive at the present instant.
    pub(crate) fn copy_motion(&mut self) {
        let (now, copy) = (self.own.motion(), &mut self.past_motion);
        copy.mean.copy_from_slice(&now);
        (copy.in_use, copy.t) = (true, self.t);
        copy.take(&self.cov, own::MOTION);
    }

    /// Starts a copy of the receiver's horizontal error at the present instant.
    pub(crate) fn copy_bias(&mut self) {
        let (now, copy) = (self.own.gps_bias.xy(), &mut self.past_bias);
        copy.mean.copy_from_slice(now.as_slice());
        (copy.in_use, copy.t) = (true, self.t);
        copy.take(&self.cov, own::GPS_BIAS);
    }
}

/// Those of a state's copies that are kept up, for where the rest of the state is borrowed too.
pub(crate) fn in_use<'a>(
    copies: &'a mut [DelayedCopy],
    past: [&'a mut DelayedCopy; 2],
) -> impl Iterator<Item = &'a mut DelayedCopy> {
    copies.iter_mut().chain(past).filter(|copy| copy.in_use)
}
