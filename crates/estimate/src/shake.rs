//! Vibration of the camera: frames, and the rows of a frame, are turned by what no motion of the helicopter explains.
//!
//! A helicopter shakes its camera at 15 to 50 Hz by a tenth of a degree: two pixels, differently in each frame, and in rows that
//! are exposed some milliseconds apart. The states of a frame are its roll about the optical axis, and how far the picture is
//! displaced at six rows; between these it is a Gaussian process in time with a squared-exponential covariance. They begin
//! anew with every frame and are forgotten after it.
//!
//! Their variance follows from the states themselves, by their own posterior means. A camera that does not shake has them at
//! zero, without variance. It is presumed to shake until features have shown that it does not. Later it is found to shake where a
//! majority of the ground features of a frame cannot be explained by one motion of the helicopter; a minority moves by
//! itself (`ground.rs`).

use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

use super::blocks::{Block, SHAKE, SHAKE_NODES as NODES, own};
use super::core::Core;
use super::models::Models;
use super::state::State;

/// Place of the roll among the states; displacements along x and along y come first.
const ROLL: usize = 2 * NODES;

/// Correlation time of the vibration, s: that of oscillations of 30 Hz.
const CORRELATION_S: f64 = 0.0045;
/// The same as a share of a frame's height: what the nodes resolve, and rows that are exposed at once.
const LENGTHS: (f64, f64) = (0.2, 2.0);
/// Variance at a node that no other shares: keeps the covariance regular.
const ALONE: f64 = 1e-3;

/// Fewest features whose agreement says something.
pub(crate) const WITNESSES: usize = 4;
/// Mean of the majority's normalised square from which on the camera shakes: 0.6 where it does not.
const SHAKES: f64 = 1.6;
/// One frame counts at most so much: a gust is no vibration.
const MOST_OF_ONE: f64 = 6.0;
/// Time over which it is averaged, s, and over which the variance is.
const OVER_S: f64 = 1.0;
const FIT_OVER_S: f64 = 0.5;
/// Share of its degrees of freedom that measurements must show of a frame for it to say something, and the most that one frame
/// changes.
const LEAST_SHOWN: f64 = 0.04;
const MOST_RATIO: f64 = 4.0;
/// How the variance changes by a frame that shows too little.
const UNSEEN_RATIO: f64 = 0.7;
/// Share of the tracks that were refused from which on it is not they that move.
const MOSTLY: f64 = 0.6;
/// Shorter than this from the first row to the last, s, all rows are exposed at once: they may be exposed one after the other where
/// it is longer with so many sigmas added, and are with so many taken off; and by how much that time is doubted, s.
const MAY_ROLL_S: f64 = 0.004;
const MAY_ROLL_SIGMAS: f64 = 3.0;
const ROLLS_SIGMAS: f64 = 2.0;
const READOUT_DOUBT_S: f64 = 0.006;
/// That most tracks are refused is a reason to doubt it so often, s: people may be all that is seen.
const DOUBTED_EVERY_S: f64 = 8.0;
/// It is presumed for so long, s, and until the time from the first row to the last is known so well, s.
const PRESUMED_S: f64 = 3.0;
const READOUT_KNOWN_S: f64 = 0.0015;
/// What heading may be off by, as it was found by rows whose times were not known, rad.
const HEADING_SIGMA: f64 = 0.01;
/// Least variance of displacement over that of roll: what shakes about one axis shakes about the others.
const WITH_ROLL: f64 = 0.3;
/// Displacement that is presumed where it is found to shake; below which it does not; the most there is, px.
const PRESUMED_PX: f64 = 1.0;
const LEAST_PX: f64 = 0.06;
const MOST_PX: f64 = 2.5;

/// Vibration of the camera.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub(crate) struct Shake {
    /// Of the frame at hand: displacement in normalised coordinates at the nodes, roll in rad.
    pub(crate) mean: [f64; SHAKE],
    /// Variances of displacement and of roll without any measurement, rad²; 0 where the camera is not taken to shake.
    displacement_var: f64,
    roll_var: f64,
    /// Whether the states of a frame have begun.
    begun: bool,
    /// The covariance between nodes over the variance, inverted, and its correlation length as a share of the frame's height.
    inverse: SMatrix<f64, NODES, NODES>,
    length: f64,
    /// Focal length that displacements are multiplied by, px: one that is itself estimated would be made larger by displacements
    /// that are expected to be small.
    focal_px: Vector2<f64>,
    /// Whether the read-out time was not known since it was doubted last.
    unsettled: bool,
    /// Whether enough features were fused in the frame at hand.
    witnessed: bool,
    /// Mean of what majorities of features are off by.
    disagreement: f64,
    /// For how long the camera was taken to shake, s.
    open_s: f64,
    /// Time since rows were doubted last, s.
    undoubted_s: f64,
    /// For how long disagreement was taken, s.
    taken_s: f64,
}

/// The displacement of a point, with its derivatives by the states.
pub(crate) struct Displaced {
    pub(crate) by_px: Vector2<f64>,
    pub(crate) derivative: SMatrix<f64, 2, SHAKE>,
    /// What lies between the nodes, px².
    pub(crate) noise_px2: Matrix2<f64>,
}

/// Row of a node as a share of the frame's height, −½ at the top.
fn node(k: usize) -> f64 {
    k as f64 / (NODES - 1) as f64 - 0.5
}

/// Correlation length as a share of a frame's height, with this time from the first row to the last.
fn length(readout_s: f64) -> f64 {
    (CORRELATION_S / readout_s.abs().max(1e-4)).clamp(LENGTHS.0, LENGTHS.1)
}

impl Shake {
    /// Of a camera of which nothing is known yet.
    pub(crate) fn presumed(models: &Models) -> Self {
        let var = (PRESUMED_PX / models.camera.fx).powi(2);
        Self { displacement_var: var, roll_var: var, unsettled: true, ..Self::default() }
    }

    /// Of a frame whose displacements a batch estimates: it has their variance, and leaves out what lies between the nodes.
    pub(crate) fn of_batch(readout_s: f64, models: &Models) -> Self {
        let focal_px = Vector2::new(models.camera.fx, models.camera.fy);
        let mut shake = Self { length: length(readout_s), focal_px, ..Self::default() };
        if let Some(inverse) = shake.kernel().try_inverse() {
            (shake.begun, shake.inverse) = (true, inverse);
        }
        shake
    }

    /// Whether the frame at hand has displacements of its own.
    pub(crate) fn is_open(&self) -> bool {
        self.begun
    }

    /// Whether the camera is taken to shake.
    fn shakes(&self) -> bool {
        self.displacement_var > 0.0 || self.roll_var > 0.0
    }

    /// Whether the camera was taken to shake for so long that the flight has shown it.
    pub(crate) fn is_shown(&self) -> bool {
        self.shakes() && self.open_s >= PRESUMED_S
    }

    /// Displacement of a row in normalised coordinates, and roll, rad, one sigma; 0 where there is none.
    pub(crate) fn sigmas(&self) -> [f64; 2] {
        [self.displacement_var.sqrt(), self.roll_var.sqrt()]
    }

    fn correlation(&self, between: f64) -> f64 {
        (-0.5 * (between / self.length).powi(2)).exp()
    }

    /// Covariance between nodes over the variance.
    pub(crate) fn kernel(&self) -> SMatrix<f64, NODES, NODES> {
        let own = |a: usize, b: usize| if a == b { ALONE } else { 0.0 };
        SMatrix::from_fn(|a, b| self.correlation(node(a) - node(b)) + own(a, b))
    }

    /// Displacement of a point seen at `px`, in the row at this share of the frame's height.
    pub(crate) fn displaced(&self, models: &Models, px: &Vector2<f64>, share: f64) -> Displaced {
        let (lens, focal) = (&models.camera, &self.focal_px);
        let to_nodes = SVector::<f64, NODES>::from_fn(|k, _| self.correlation(share - node(k)));
        let weights = self.inverse * to_nodes;
        let left = (1.0 - weights.dot(&to_nodes)).max(0.0) * self.displacement_var;
        let mut derivative = SMatrix::<f64, 2, SHAKE>::zeros();
        for k in 0..NODES {
            derivative[(0, k)] = focal.x * weights[k];
            derivative[(1, NODES + k)] = focal.y * weights[k];
        }
        derivative[(0, ROLL)] = -focal.x * (px.y - lens.cy) / focal.y;
        derivative[(1, ROLL)] = focal.y * (px.x - lens.cx) / focal.x;
        Displaced {
            by_px: derivative * SVector::from(self.mean),
            derivative,
            noise_px2: Matrix2::new(focal.x * focal.x, 0.0, 0.0, focal.y * focal.y) * left,
        }
    }
}

impl State {
    /// Before a frame: displacements of their own.
    pub(crate) fn begin_shake(&mut self, readout_s: f64, models: &Models) {
        let shake = &mut self.shake;
        shake.focal_px = Vector2::new(models.camera.fx, models.camera.fy);
        shake.length = length(readout_s);
        let kernel = shake.kernel();
        let Some(inverse) = kernel.try_inverse() else { return };
        (shake.begun, shake.inverse, shake.mean) = (true, inverse, [0.0; SHAKE]);
        let (displacement_var, roll_var) = (shake.displacement_var, shake.roll_var);
        let at = self.layout().shake();
        for axis in 0..2 {
            let nodes: Block<NODES> = at.part(axis * NODES);
            self.cov.add_square(nodes, &(kernel * displacement_var));
        }
        self.cov.add(at.column(ROLL), at.column(ROLL), roll_var);
    }

    /// After a frame: its displacements are forgotten; what they were moved by.
    fn forget_shake(&mut self) -> [Shown; 2] {
        let at = self.layout().shake();
        let shown = self.shake_shown(at);
        self.renew(at, &[0.0; SHAKE]);
        (self.shake.begun, self.shake.mean) = (false, [0.0; SHAKE]);
        shown
    }

    /// Whether the camera was presumed to shake for long enough, and the times of its rows are known.
    fn shake_is_settled(&self) -> bool {
        self.shake.open_s >= PRESUMED_S && self.cov.sigma(own::READOUT, 0) < READOUT_KNOWN_S
    }

    /// Moves the variances to what a frame has shown.
    fn fit_shake(&mut self, shown: [Shown; 2], rolls: bool, since_s: f64, focal_px: f64) {
        let held = !self.shake_is_settled();
        // Meanwhile it may only be found to be more, where rows are exposed one after the other beyond doubt.
        if held && !rolls {
            return;
        }
        let least_ratio = if held { 1.0 } else { 0.0 };
        let gain = (since_s / FIT_OVER_S).min(0.5);
        let shake = &mut self.shake;
        for (var, shown) in [&mut shake.displacement_var, &mut shake.roll_var].into_iter().zip(shown) {
            fit(var, shown, (gain, least_ratio), focal_px);
        }
        // Where all rows are exposed at once, displacement looks like the helicopter's own motion, of which more is expected.
        shake.displacement_var = shake.displacement_var.max(WITH_ROLL * shake.roll_var);
    }

    /// What displacement and roll were moved by.
    fn shake_shown(&self, at: Block<SHAKE>) -> [Shown; 2] {
        let (shake, roll) = (&self.shake, at.column(ROLL));
        let mut of_rows = Shown { square: 0.0, left: 0.0, freedom: 2.0 * NODES as f64 };
        for first in [0, NODES] {
            let nodes: Block<NODES> = at.part(first);
            let mean = SVector::<f64, NODES>::from_fn(|k, _| shake.mean[first + k]);
            of_rows.square += mean.dot(&(shake.inverse * mean));
            of_rows.left += (shake.inverse * self.cov.block(nodes, nodes)).trace();
        }
        let square = shake.mean[ROLL].powi(2);
        [of_rows, Shown { square, left: self.cov.at(roll, roll), freedom: 1.0 }]
    }
}

/// What some of the states were moved by: the square of the posterior mean, and the trace of the posterior covariance, both
/// against the prior's correlations, rad².
#[derive(Clone, Copy)]
struct Shown {
    square: f64,
    left: f64,
    freedom: f64,
}

/// Moves a variance to what a frame shows. A posterior mean has the variance that the measurements took away, `E[m mᵀ] = P₀ − P`.
fn fit(var: &mut f64, shown: Shown, (gain, least_ratio): (f64, f64), focal_px: f64) {
    if *var <= 0.0 {
        return;
    }
    let expected = shown.freedom - shown.left / *var;
    let ratio = shown.square / *var / expected;
    // What is too small to be shown does no harm, and is let go.
    let ratio = if expected > LEAST_SHOWN * shown.freedom { ratio.min(MOST_RATIO) } else { UNSEEN_RATIO };
    if ratio.is_finite() {
        *var = (*var * (1.0 + gain * (ratio.max(least_ratio) - 1.0))).min((MOST_PX / focal_px).powi(2));
    }
    if *var < (LEAST_PX / focal_px).powi(2) {
        *var = 0.0;
    }
}

impl Core {
    /// Before a frame with so many tracks is fused. Markers alone do not tell vibration from the helicopter's motion.
    pub(crate) fn begin_shake(&mut self, tracks: usize) {
        if self.at_truth || !self.state.shake.shakes() || tracks.min(self.state.features.len()) < WITNESSES {
            return;
        }
        let [readout_s, sigma_s] = self.readout();
        self.state.begin_shake(readout_s.hypot(sigma_s), &self.models);
    }

    /// After a frame was fused.
    pub(crate) fn end_shake(&mut self, since_s: f64) {
        let rolls = self.rolls();
        if self.state.shake.is_open() {
            let witnessed = self.state.shake.witnessed || !self.may_roll();
            let shown = self.state.forget_shake();
            // Rows that are exposed at once can only be displaced together: they need no witnesses.
            if witnessed {
                self.state.shake.open_s += since_s;
                self.state.fit_shake(shown, rolls, since_s, self.models.camera.fx);
            }
        }
        let state = &mut self.state;
        let settled = state.shake_is_settled() && std::mem::take(&mut state.shake.unsettled);
        if settled && state.shake.shakes() && rolls {
            // Heading was found by rows whose times were not known.
            self.loosen_heading(HEADING_SIGMA);
        }
    }

    /// Takes how far a majority of a frame's features is from being explained by one motion, and how many were fused.
    pub(crate) fn judge_shake(&mut self, disagreement: Option<f64>, fused: usize, since_s: f64) {
        if self.at_truth || !self.learning.on {
            return;
        }
        let shake = &mut self.state.shake;
        shake.witnessed = fused >= WITNESSES;
        shake.taken_s = (shake.taken_s + since_s).min(OVER_S);
        shake.undoubted_s += since_s;
        if let Some(off) = disagreement {
            let off = off.min(MOST_OF_ONE);
            shake.disagreement += (since_s / shake.taken_s).min(1.0) * (off - shake.disagreement);
        }
        let may_roll = self.may_roll();
        let shake = &self.state.shake;
        let lost = may_roll && self.state.moving_share > MOSTLY && shake.undoubted_s >= DOUBTED_EVERY_S;
        if shake.taken_s >= OVER_S && (shake.disagreement > SHAKES || lost) {
            self.doubt_shake(may_roll);
        }
    }

    /// Time from the first row of a frame to the last, and its sigma, s.
    fn readout(&self) -> [f64; 2] {
        let readout_s = self.state.own.whole_readout_s(self.models.readout_s);
        [readout_s, self.state.cov.sigma(own::READOUT, 0)]
    }

    /// Whether rows are exposed one after the other, as far as it is known.
    fn rolls(&self) -> bool {
        let [readout_s, sigma_s] = self.readout();
        readout_s.abs() - ROLLS_SIGMAS * sigma_s > MAY_ROLL_S
    }

    /// Whether rows may be exposed one after the other.
    fn may_roll(&self) -> bool {
        let [readout_s, sigma_s] = self.readout();
        readout_s.abs() + MAY_ROLL_SIGMAS * sigma_s > MAY_ROLL_S
    }

    /// The ground does not agree with itself: the camera shakes, and what rows have shown of their times was wrong.
    fn doubt_shake(&mut self, may_roll: bool) {
        let state = &mut self.state;
        if !state.shake.shakes() {
            state.shake = Shake::presumed(&self.models);
        }
        (state.shake.taken_s, state.shake.disagreement) = (0.0, 0.0);
        if may_roll {
            state.shake.undoubted_s = 0.0;
            state.cov.add_diagonal(own::READOUT, &[READOUT_DOUBT_S * READOUT_DOUBT_S]);
            (state.shake.open_s, state.shake.unsettled, state.moving_share) = (0.0, true, 0.0);
        }
    }
}
