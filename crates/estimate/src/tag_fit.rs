//! What a vehicle's tags are beside their configuration: size, place and turn of each, as states of the filter.
//!
//! The configuration is believed, with no variance at all, until detections contradict it; then the states open, and the
//! same measurements that contradicted each other settle them:
//!
//! - **A tag outside the gate while another one of its vehicle is seen**, four frames in a row or half of many: its own size, place
//!   and turn open. So do the two directions in which nobody can tell who is wrong: everything seen by the tags larger
//!   or smaller (height, places, velocities), and all tags turned on the vehicle (its heading). Along them no pixel
//!   changes, so that they are opened without forgetting anything; the receiver's velocity and the way the vehicle
//!   drives settle them.
//! - **The receiver's velocity over that which is seen is not one** ([`ScaleTest`]): the first of these directions opens.

use nalgebra::{Matrix3x4, Rotation3, Vector3};

use windhover_base::msg::{FusionSource, MarkerPair, MisfitCause};
use windhover_base::time::MonoTime;

use super::blocks::{TAG_FIT, TagFitBlock, own};
use super::core::Core;
use super::matrix::Shear;
use super::measurement::Measurement;
use super::models::Marker;
use super::size_test::SizeTest;
use super::state::State;
use super::update::Outcome;

/// What opens a tag: a frame in which it contradicts another one counts two, one in which it does not takes one off. Four in a
/// row do, and so does half of them, as where fitted noise has begun to cover the contradiction.
const CONTRADICTIONS: u32 = 8;
/// Sigmas of a tag that is found to be otherwise than configured: its size (share), its place (m), its turn (rad).
const OTHERWISE: [f64; TAG_FIT] = [0.05, 0.05, 0.05, 0.09];
/// Sigmas of the scale of all that is seen, and of the turn of all tags on the vehicle (rad).
const SCALE_SIGMA: f64 = 0.03;
const TURN_SIGMA: f64 = 0.04;
/// Least that is reported: share of a size, m, rad; and how well it must be known.
const LEAST_REPORTED: [f64; 3] = [0.005, 0.01, 0.005];
const REPORTED_SIGMAS: f64 = 3.0;
const WELL_KNOWN: [f64; 3] = [0.004, 0.01, 0.005];

/// What one tag is beside its configuration.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub(crate) struct TagFit {
    /// Logarithm of its size over that configured; place forward and right of that configured, m; turn clockwise, rad.
    pub(crate) mean: [f64; TAG_FIT],
    /// How much speaks for it being outside the gate beside another tag.
    contradicted: u32,
    /// Whether it was opened by itself, and with all others along scale and turn.
    open: bool,
    /// Its size beside that of the first tag of its frame, and whether it alone was opened by that.
    pub(crate) size: SizeTest,
    size_open: bool,
    scale_open: bool,
    turn_open: bool,
}

impl TagFit {
    /// Whether size, place and turn of its own are open.
    pub(crate) fn is_open(&self) -> bool {
        self.open
    }

    /// Whether it is thought to be otherwise than configured.
    pub(crate) fn differs(&self) -> bool {
        self.open || self.size_open
    }
}

/// The direction in which all that is seen is larger, which no pixel shows.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(crate) struct Scale {
    /// The column of the size that stands for it: of a tag whose own size is not open.
    column: usize,
    /// By how much the ground scales where the tags scale by one: it lies deeper.
    share: f64,
}

/// A tag's corners as they are by its fit, and their derivatives by it, in the vehicle frame.
pub(crate) fn corners(
    fit: &[f64; TAG_FIT],
    center: &Vector3<f64>,
    configured: &[Vector3<f64>; 4],
) -> [(Vector3<f64>, Matrix3x4<f64>); 4] {
    let [size, forward, right, turn] = *fit;
    let turned = Rotation3::from_axis_angle(&Vector3::z_axis(), turn);
    configured.map(|corner| {
        let arm = turned * (corner - center) * size.exp();
        let swung = Vector3::new(-arm.y, arm.x, 0.0);
        let derivative = Matrix3x4::from_columns(&[arm, Vector3::x(), Vector3::y(), swung]);
        (center + Vector3::new(forward, right, 0.0) + arm, derivative)
    })
}

/// Whether the receiver's velocity is a multiple of that which is seen: `Σ r·v/S` over `√Σ v·v/S` is normal where it is
/// not.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub(crate) struct ScaleTest {
    score: f64,
    information: f64,
    last: Option<MonoTime>,
}

/// Memory of the test, s, and the value that no flight reaches whose scale is right.
const SCALE_TEST_S: f64 = 15.0;
const SCALE_TEST_LIMIT: f64 = 6.0;
/// One fix counts no more than this many sigmas.
const SCALE_TEST_MOST: f64 = 3.0;

impl ScaleTest {
    /// Takes a velocity's innovation; whether the scale is wrong beyond doubt.
    fn take(&mut self, t: MonoTime, z: &Measurement, outcome: &Outcome, velocity: &Vector3<f64>) -> bool {
        let since_s = self.last.map_or(0.0, |last| (t - last).s().clamp(0.0, SCALE_TEST_S));
        self.last = Some(t);
        let keep = (-since_s / SCALE_TEST_S).exp();
        let (mut score, mut information) = (0.0, 0.0);
        for i in 0..2 {
            let var = outcome.innovation_var[i];
            score += z.residual[i] * velocity[i] / var;
            information += velocity[i] * velocity[i] / var;
        }
        let most = SCALE_TEST_MOST * information.sqrt();
        self.score = keep * self.score + score.clamp(-most, most);
        self.information = keep * self.information + information;
        self.information > 0.0 && self.score.abs() > SCALE_TEST_LIMIT * self.information.sqrt()
    }
}

impl Core {
    /// A tag was fused in a frame that shows another one of its vehicle as well.
    pub(crate) fn judge_tag(&mut self, target: usize, marker: usize, inside: bool) {
        let Some(slot) = self.models.targets[target].markers[marker].fit else { return };
        // A body that pitches makes its tags contradict each other as well, until it is known to.
        let sway = &self.state.targets[target].sway;
        if self.at_truth || sway.is_open() && !sway.is_judged() {
            return;
        }
        let fit = &mut self.state.tags[slot];
        fit.contradicted = if inside { fit.contradicted.saturating_sub(1) } else { fit.contradicted + 2 };
        if fit.contradicted < CONTRADICTIONS || fit.open {
            return;
        }
        fit.open = true;
        let block = self.state.layout().tag(slot).all();
        self.state.cov.add_diagonal(block, &OTHERWISE.map(|sigma| sigma * sigma));
        self.open_scale(target);
        self.open_turn(target);
    }

    /// Opens the sizes of two tags that contradict each other. By the first of them everything else is scaled: if it is the
    /// wrong one, all of this is larger but the vehicle. Where the tags lie on it shows which.
    pub(crate) fn open_sizes(&mut self, target: usize, first: usize, second: usize) {
        let size = |slot: usize| self.state.layout().tag(slot).all().part::<1>(0);
        let (of_first, of_second) = (size(first), size(second));
        let mut along = std::mem::take(&mut self.along);
        if self.scale_direction(target, &mut along).is_some() {
            for marker in self.models.targets[target].markers.iter().filter_map(|marker| marker.fit) {
                along[self.state.layout().tag(marker).all().range()].fill(0.0);
            }
            along[of_first.column(0)] = 1.0;
            self.state.add_direction(&along, OTHERWISE[0]);
            self.state.cov.add_diagonal(of_second, &[OTHERWISE[0] * OTHERWISE[0]]);
            [first, second].iter().for_each(|slot| self.state.tags[*slot].size_open = true);
        }
        self.along = along;
    }

    /// A velocity of the receiver was compared with what is seen.
    pub(crate) fn judge_scale(&mut self, outcome: &Outcome) {
        let velocity = self.state.own.velocity;
        let t = self.state.t;
        let seen: f64 =
            self.state.targets.iter().map(|target| (t - target.last_seen).s()).fold(f64::MAX, f64::min);
        if self.at_truth || seen > 1.0 || !outcome.ratio.is_finite() {
            return;
        }
        if self.state.scale_test.take(t, &self.z, outcome, &velocity) {
            self.state.scale_test = ScaleTest::default();
            (0..self.state.targets.len()).for_each(|target| self.open_scale(target));
        }
    }

    /// Adds the direction in which all that is seen by a target's tags is larger: no pixel changes along it.
    fn open_scale(&mut self, target: usize) {
        let slots = || self.models.targets[target].markers.iter().filter_map(|marker| marker.fit);
        let held = self.state.targets[target].life.is_held();
        if !held || slots().any(|slot| self.state.tags[slot].scale_open) {
            return;
        }
        let mut along = std::mem::take(&mut self.along);
        if let Some(share) = self.scale_direction(target, &mut along) {
            self.state.add_direction(&along, SCALE_SIGMA);
            slots().for_each(|slot| self.state.tags[slot].scale_open = true);
            let size = |slot: usize| self.state.layout().tag(slot).all().column(0);
            let reference = slots().min_by_key(|slot| self.state.tags[*slot].differs());
            self.state.scale = self.state.scale.or(reference.map(|slot| Scale { column: size(slot), share }));
        }
        self.along = along;
    }

    /// The direction in which all that is seen by a target's tags is larger about the camera, if there is one. The
    /// ground lies deeper than the tags: with the same rise of the camera it scales by less, by the share that is given.
    pub(crate) fn scale_direction(&self, target: usize, along: &mut [f64]) -> Option<f64> {
        let (models, state) = (&self.models, &self.state);
        let fitted = || models.targets[target].markers.iter().filter_map(|m| m.fit.map(|slot| (m, slot)));
        let (first, _) = fitted().next()?;
        let layout = state.layout();
        along.fill(0.0);
        let camera = state.own.position + state.own.ned_from_body * models.camera_at;
        let depth_m = models.ground.down_m(camera.x, camera.y) + first.center.z - camera.z;
        let share = depth_m / (depth_m - first.center.z);
        along[own::POSITION.column(2)] = -depth_m;
        // What the receiver has shown of height is the sum of the two.
        along[own::GPS_BIAS.column(2)] = depth_m;
        let velocity = state.own.velocity;
        along[own::VELOCITY.range()].copy_from_slice((velocity * share).as_slice());
        let targets = state.targets.iter().enumerate().filter(|(_, t)| t.life.is_held());
        let places = targets.clone().map(|(i, t)| (layout.target(i).place(), [t.mean[0], t.mean[1]], 1.0));
        let features = state.features.iter().enumerate().filter(|(_, f)| f.id.is_some());
        let features = features.map(|(i, f)| (layout.feature(i), f.mean, share));
        for (at, [north, east], scale) in places.chain(features) {
            along[at.range()].copy_from_slice(&[scale * (north - camera.x), scale * (east - camera.y)]);
        }
        for (i, t) in targets {
            let ahead = velocity.x * t.mean[2].cos() + velocity.y * t.mean[2].sin();
            along[layout.target(i).speed().column(0)] = t.mean[3] - (1.0 - share) * ahead;
        }
        for (marker, slot) in fitted() {
            let larger = [1.0, marker.center.x, marker.center.y, 0.0];
            along[layout.tag(slot).all().range()].copy_from_slice(&larger);
        }
        Some(share)
    }

    /// Adds the direction in which all tags are turned on their vehicle: its heading is less by as much.
    fn open_turn(&mut self, target: usize) {
        let slots = || self.models.targets[target].markers.iter().filter_map(|marker| marker.fit);
        if slots().any(|slot| self.state.tags[slot].turn_open) {
            return;
        }
        let mut along = std::mem::take(&mut self.along);
        self.turn_direction(target, &mut along);
        self.state.add_direction(&along, TURN_SIGMA);
        slots().for_each(|slot| self.state.tags[slot].turn_open = true);
        self.along = along;
    }

    /// The direction in which all tags of a target are turned on it.
    pub(crate) fn turn_direction(&self, target: usize, along: &mut [f64]) {
        let layout = self.state.layout();
        along.fill(0.0);
        along[layout.target(target).heading().column(0)] = -1.0;
        let markers = self.models.targets[target].markers.iter();
        for (marker, slot) in markers.filter_map(|m| m.fit.map(|slot| (m, slot))) {
            let swung = [0.0, -marker.center.y, marker.center.x, 1.0];
            along[layout.tag(slot).all().range()].copy_from_slice(&swung);
        }
    }

    /// What the tags of the targets are found to be, one measured against another.
    pub(crate) fn tag_misfits(&self) -> impl Iterator<Item = (FusionSource, MisfitCause, f64)> {
        let all = self.models.targets.iter().enumerate().flat_map(|(target, model)| {
            model.markers.iter().enumerate().map(move |(marker, m)| (target, marker, m))
        });
        all.filter_map(|(target, marker, model)| {
            let opened = model.fit.is_some_and(|slot| self.state.tags[slot].differs());
            let (against, reference) = opened.then(|| self.reference(target, marker)).flatten()?;
            // Of two whose sizes alone were opened only one may be wrong.
            if self.doubt(model) < self.doubt(reference) {
                return None;
            }
            let pair = MarkerPair { target, marker, against };
            Some(self.state.apart(model, reference).map(move |(k, figure)| match k {
                0 => (FusionSource::Marker, MisfitCause::MarkerSize(pair), figure.exp()),
                1 => (FusionSource::Marker, MisfitCause::MarkerPlace(pair), figure),
                _ => (FusionSource::Marker, MisfitCause::MarkerTurn(pair), figure),
            }))
        })
        .flatten()
    }

    /// Another tag of the vehicle to measure against: the one that is most likely as configured.
    fn reference(&self, target: usize, marker: usize) -> Option<(usize, &Marker)> {
        let others = self.models.targets[target].markers.iter().enumerate();
        let fitted = others.filter(|(i, m)| *i != marker && m.fit.is_some());
        fitted.min_by(|(_, a), (_, b)| self.doubt(a).total_cmp(&self.doubt(b)))
    }

    /// How much speaks against a tag being as configured; less where its size alone was opened, with another one's.
    fn doubt(&self, marker: &Marker) -> f64 {
        match marker.fit.map(|slot| &self.state.tags[slot]) {
            Some(tag) if tag.open => 1.0,
            Some(tag) if tag.size_open => tag.mean[0].abs().min(0.5),
            _ => 0.0,
        }
    }
}

impl State {
    /// `P ← P + σ² u uᵀ`.
    pub(crate) fn add_direction(&mut self, along: &[f64], sigma: f64) {
        for (i, a) in along.iter().enumerate().filter(|(_, a)| **a != 0.0) {
            for (j, b) in along.iter().enumerate().filter(|(_, b)| **b != 0.0) {
                self.cov.add(i, j, sigma * sigma * a * b);
            }
        }
    }

    /// What carries the covariance over to the estimate that an update has just moved by `dx`, where scale is open: the direction
    /// that no pixel shows depends on the estimate, as with heading ([`Self::keep_heading_unobserved`]). What an update moves
    /// by Δ is larger by Δ times the error of scale.
    pub(crate) fn keep_scale_unobserved(&self, dx: &[f64], shear: &mut Shear) {
        let Some(Scale { column, share }) = self.scale else { return shear.begin(own::TURN.column(0)) };
        shear.begin(column);
        let layout = self.layout();
        let moved = own::POSITION.of(dx);
        shear.give(own::POSITION.column(2), moved.z);
        shear.give(own::GPS_BIAS.column(2), -moved.z);
        let faster = own::VELOCITY.of(dx);
        (0..3).for_each(|axis| shear.give(own::VELOCITY.column(axis), share * faster[axis]));
        for (slot, place) in layout.places().enumerate() {
            let scale = if slot < layout.targets { 1.0 } else { share };
            let by = place.of(dx) - moved.xy();
            (0..2).for_each(|axis| shear.give(place.column(axis), scale * by[axis]));
        }
        for (i, target) in self.targets.iter().enumerate() {
            let (s, c) = target.mean[2].sin_cos();
            let by = (faster.x * c + faster.y * s) * (share - 1.0);
            let speed = layout.target(i).speed();
            shear.give(speed.column(0), speed.of(dx).x + by);
        }
    }

    /// Sizes of the fitted tags over those configured, in percent, with their sigmas.
    pub(crate) fn tags_in_words(&self) -> String {
        let sigma = |slot: usize| 100.0 * self.cov.sigma(self.layout().tag(slot).all(), 0);
        let words =
            |(slot, tag): (usize, &TagFit)| format!("{:.2}±{:.2} %", 100.0 * tag.mean[0], sigma(slot));
        self.tags.iter().enumerate().map(words).collect::<Vec<_>>().join(" ")
    }

    /// By what a tag differs from its configuration where another one is taken to be as configured: logarithm of
    /// the size (0), place in m (1), turn in rad (2); those that are well known and beyond doubt.
    fn apart(&self, tag: &Marker, reference: &Marker) -> impl Iterator<Item = (usize, f64)> {
        let arm = tag.center - reference.center;
        let layout = self.layout();
        // Combinations of the two fits: of the tag's own as they are, of the reference what it makes of the tag.
        let rows: [([f64; TAG_FIT], [f64; TAG_FIT]); 4] = [
            ([1.0, 0.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 0.0]),
            ([0.0, 1.0, 0.0, 0.0], [-arm.x, -1.0, 0.0, arm.y]),
            ([0.0, 0.0, 1.0, 0.0], [-arm.y, 0.0, -1.0, -arm.x]),
            ([0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0, -1.0]),
        ];
        let slots = tag.fit.zip(reference.fit);
        let found = slots.map(|(a, b)| {
            let (fa, fb) = (&self.tags[a].mean, &self.tags[b].mean);
            let (at, bt) = (layout.tag(a).all(), layout.tag(b).all());
            rows.map(|(x, y)| {
                let value: f64 = (0..TAG_FIT).map(|k| x[k] * fa[k] + y[k] * fb[k]).sum();
                let weight = |k: usize| if k < TAG_FIT { x[k] } else { y[k - TAG_FIT] };
                let column = |k: usize| if k < TAG_FIT { at.column(k) } else { bt.column(k - TAG_FIT) };
                let pairs = (0..2 * TAG_FIT).flat_map(|k| (0..2 * TAG_FIT).map(move |l| (k, l)));
                let var: f64 =
                    pairs.map(|(k, l)| weight(k) * weight(l) * self.cov.at(column(k), column(l))).sum();
                (value, var.max(0.0).sqrt())
            })
        });
        let three = found.map(|[size, x, y, turn]| {
            let place = (x.0.hypot(y.0), x.1.max(y.1));
            [size, place, turn]
        });
        let significant = |k: usize, (value, sigma): (f64, f64)| {
            let beyond = value.abs() > LEAST_REPORTED[k].max(REPORTED_SIGMAS * sigma);
            (beyond && sigma < WELL_KNOWN[k]).then_some((k, value))
        };
        let all = three.into_iter().flatten().enumerate();
        all.filter_map(move |(k, found)| significant(k, found))
    }
}

/// The columns of a tag's fit.
pub(crate) fn block(state: &State, slot: usize) -> TagFitBlock {
    state.layout().tag(slot)
}

#[cfg(test)]
mod tests {
    use super::*;

    const CENTER: Vector3<f64> = Vector3::new(1.0, 0.2, -0.5);

    fn square() -> [Vector3<f64>; 4] {
        [(0.2, -0.2), (0.2, 0.2), (-0.2, 0.2), (-0.2, -0.2)].map(|(x, y)| CENTER + Vector3::new(x, y, 0.0))
    }

    #[test]
    fn a_tag_as_configured_has_its_configured_corners() {
        for ((corner, _), configured) in corners(&[0.0; 4], &CENTER, &square()).iter().zip(square()) {
            assert!((corner - configured).norm() < 1e-12);
        }
    }

    #[test]
    fn corners_move_by_their_derivatives() {
        let fit = [0.04, 0.01, -0.03, 0.2];
        for k in 0..TAG_FIT {
            let by = |step: f64| {
                let mut moved = fit;
                moved[k] += step;
                corners(&moved, &CENTER, &square()).map(|(corner, _)| corner)
            };
            let (after, before) = (by(1e-6), by(-1e-6));
            for (i, (_, derivative)) in corners(&fit, &CENTER, &square()).iter().enumerate() {
                let found = (after[i] - before[i]) / 2e-6;
                assert!((found - derivative.column(k)).norm() < 1e-8, "corner {i} by {k}");
            }
        }
    }
}
