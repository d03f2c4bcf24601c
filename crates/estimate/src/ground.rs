//! Ground features: what is at rest on the ground is fused, everything else is not.
//!
//! Anything with corners may be followed: people, another vehicle, the vehicle itself with its tag unread. What moves
//! turns heading by degrees, so a feature must prove that it is ground:
//!
//! | from | what happens | to |
//! |---|---|---|
//! | free slot | a track that is not refused and not beside one in use | on probation: its place is read off the first pixel |
//! | on probation | where it was expected, for [`PROBATION`], less where others judge it | proven |
//! | on probation, proven | elsewhere than expected twice in a row | refused: its track never comes back |
//! | any | not followed into this frame | free slot |
//!
//! On probation a feature is only compared, over a baseline that grows with time. Of the proven ones of a frame those
//! are fused that agree with each other ([`Innovations`]) and are more than half of them. Where velocity by the receiver
//! contradicts what features carry, they are all refused ([`Core::distrust_ground`]).

use nalgebra::{Matrix2, Vector2};

use windhover_base::msg::{FeatureTrack, FusionSource};

use super::aid::Aid;
use super::aid::feature::FeaturePixel;
use super::begin::ground_point;
use super::consensus::Innovations;
use super::core::Core;
use super::matrix::{Grid, axpy};
use super::measurement::Measurement;
use super::models::Models;
use super::shake::WITNESSES;
use super::state::{Feature, GUESSED_VAR, State};

/// How long a feature must stay at its place, s, and the number of frames after the first in which it must be seen,
/// where no proven features can be compared: a person who walks slowly moves half a metre in this time.
const PROBATION: (f64, u32) = (0.8, 3);
/// The same where [`JUDGES`] proven features agree on how the helicopter moved: a walk of one frame is ten pixels,
/// compared with their tenth of one. Features of rendered ground exist for a second or two, so that waiting would lose
/// a third of them.
const JUDGED_PROBATION: (f64, u32) = (0.1, 1);
/// What ground may seem to move by: m/s, and as a share of the helicopter's own speed (ground that is not level: 2 % is a
/// quarter of a metre at 12 m). What creeps slower than this does no harm that the gate would not find.
const SEEMING_MPS: f64 = 0.02;
const SEEMING_SHARE: f64 = 0.02;
/// Frames in a row elsewhere than expected that refuse a feature.
const REFUSALS: u32 = 2;
/// Nearer to each other than this two tracks are of one corner, px.
const ONE_CORNER_PX: f64 = 12.0;
/// Time over which the share of what moves is kept, s.
const MOVERS_OVER_S: f64 = 3.0;
/// Proven features in agreement that the others are judged by.
const JUDGES: usize = 3;

/// The tracks that were refused last.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
pub(crate) struct RefusedTracks {
    ids: [Option<u64>; 32],
    next: usize,
}

impl RefusedTracks {
    /// Whether a track was refused.
    pub(crate) fn contains(&self, id: u64) -> bool {
        self.ids.contains(&Some(id))
    }

    /// The tracks.
    pub(crate) fn iter(&self) -> impl Iterator<Item = u64> + '_ {
        self.ids.iter().flatten().copied()
    }

    fn add(&mut self, id: u64) {
        self.ids[self.next] = Some(id);
        self.next = (self.next + 1) % self.ids.len();
    }
}

/// Room to compare the features of a frame in.
#[derive(Clone, Debug)]
pub(crate) struct GroundWork {
    innovations: Innovations,
    /// The slots that are compared, with what each should show.
    slots: Vec<usize>,
    expected: Vec<Measurement>,
    /// `H P`: two rows a slot.
    projected: Grid,
}

impl GroundWork {
    pub(crate) fn new(features: usize, states: usize) -> Self {
        Self {
            innovations: Innovations::with_room(features),
            slots: Vec::with_capacity(features),
            expected: vec![Measurement::default(); features],
            projected: Grid::zeros(2 * features, states),
        }
    }
}

impl Core {
    /// Ground features of a frame: those in use are fused, compared or given up, and free slots taken.
    pub(crate) fn fuse_features(&mut self, tracks: &[FeatureTrack], since_s: f64) {
        for slot in 0..self.state.features.len() {
            self.follow_feature(slot, tracks);
        }
        let (agreed, disagreement) = self.fuse_proven(tracks);
        let of_others = self.compare_others(tracks, agreed >= JUDGES);
        self.judge_shake(disagreement.or(of_others), agreed, since_s);
        self.state.note_movers(tracks);
        for slot in 0..self.state.features.len() {
            if self.state.features[slot].id.is_none()
                && let Some(track) = next_feature(&self.state, &self.models, tracks)
            {
                self.start_feature(slot, &track);
            }
        }
    }

    /// Gives a slot up whose track has ended, or has run onto the corner of another.
    fn follow_feature(&mut self, slot: usize, tracks: &[FeatureTrack]) {
        let Some(id) = self.state.features[slot].id else { return };
        let before = self.state.features[..slot].iter().filter_map(|f| of_id(tracks, f.id?));
        match of_id(tracks, id) {
            Some(track) if before.clone().all(|other| (other.px - track.px).norm() >= ONE_CORNER_PX) => {}
            Some(_) => self.refuse_feature(slot),
            None => self.drop_feature(slot),
        }
    }

    /// Fuses those of the proven features that agree; how many, and how far a majority disagrees.
    fn fuse_proven(&mut self, tracks: &[FeatureTrack]) -> (usize, Option<f64>) {
        let n = self.expect_features(tracks, true);
        let disagreement = self.disagreement(n);
        let agreed = self.ground.innovations.agreeing(self.models.gates[2]);
        // Without a majority it is not known which of them are ground.
        let believed = 2 * agreed > n;
        for k in 0..n {
            let slot = self.ground.slots[k];
            let agrees = believed && self.ground.innovations.agrees(k);
            let inside = agrees && self.fuse_feature(slot, tracks);
            self.judge_feature(slot, inside, PROBATION);
        }
        (if believed { agreed } else { 0 }, disagreement)
    }

    /// Fuses a proven feature; whether it was inside the gate.
    fn fuse_feature(&mut self, slot: usize, tracks: &[FeatureTrack]) -> bool {
        let track = self.state.features[slot].id.and_then(|id| of_id(tracks, id));
        let outcome = track.and_then(|track| pixel_of(&self.state, slot, track).fuse(self));
        outcome.is_some_and(|outcome| outcome.ratio <= 1.0)
    }

    /// How far a majority of the `n` features that were expected last is from one motion; `None` of too few.
    fn disagreement(&mut self, n: usize) -> Option<f64> {
        (n >= WITNESSES).then(|| self.ground.innovations.majority_square())
    }

    /// Compares the features on probation: with what the proven ones made of the state, or else with each other; then how far
    /// a majority of them disagrees.
    fn compare_others(&mut self, tracks: &[FeatureTrack], judged: bool) -> Option<f64> {
        let n = self.expect_features(tracks, false);
        let gate = self.models.gates[2];
        let mut disagreement = None;
        if judged {
            self.ground.innovations.inside(gate);
        } else {
            disagreement = self.disagreement(n);
            // All of them may be on the same vehicle; the helicopter's own motion shows it.
            self.ground.innovations.agreeing(gate);
            self.ground.innovations.keep_inside(gate);
        }
        let agreed = (0..n).filter(|k| self.ground.innovations.agrees(*k)).count();
        let believed = judged || 2 * agreed > n;
        let probation = if judged { JUDGED_PROBATION } else { PROBATION };
        for k in 0..n {
            let slot = self.ground.slots[k];
            self.judge_feature(slot, believed && self.ground.innovations.agrees(k), probation);
            if judged && self.state.features[slot].proven {
                self.fuse_feature(slot, tracks);
            }
        }
        disagreement
    }

    /// Updates a feature by a frame: it is proven once it has stayed at its place long enough, and refused when seen
    /// elsewhere twice in a row.
    fn judge_feature(&mut self, slot: usize, inside: bool, probation: (f64, u32)) {
        let t = self.state.t;
        let feature = &mut self.state.features[slot];
        if !inside {
            feature.rejected += 1;
            if feature.rejected >= REFUSALS {
                self.refuse_feature(slot);
            }
            return;
        }
        feature.rejected = 0;
        feature.stood += 1;
        if (t - feature.since).s() >= probation.0 && feature.stood >= probation.1 {
            feature.proven = true;
        }
    }

    /// Writes what the proven features, or those on probation, should show, with their joint covariance; how many.
    fn expect_features(&mut self, tracks: &[FeatureTrack], proven: bool) -> usize {
        self.ground.slots.clear();
        for slot in 0..self.state.features.len() {
            let feature = &self.state.features[slot];
            let Some(track) = feature.id.and_then(|id| of_id(tracks, id)) else { continue };
            if feature.proven != proven {
                continue;
            }
            let pixel = pixel_of(&self.state, slot, track);
            let z = &mut self.ground.expected[self.ground.slots.len()];
            match pixel.linearise(&self.state, &self.models, z) {
                Ok(()) if z.is_finite() => self.ground.slots.push(slot),
                _ => self.drop_feature(slot),
            }
        }
        let n = self.ground.slots.len();
        self.ground.join(&self.state.cov, n, self.at_truth);
        n
    }

    fn start_feature(&mut self, slot: usize, track: &FeatureTrack) {
        let own = &self.state.own;
        let Some(found) = ground_point(own, &self.models, track.px, 0.0) else { return };
        let feature = &mut self.state.features[slot];
        *feature = Feature {
            id: Some(track.id),
            mean: [found.x, found.y],
            since: self.state.t,
            ..Feature::default()
        };
        self.state.renew(self.state.layout().feature(slot), &[GUESSED_VAR; 2]);
        match self.linearise(&pixel_of(&self.state, slot, track)) {
            Ok(()) => _ = self.fuse(FusionSource::Feature, None),
            Err(_) => self.drop_feature(slot),
        }
    }

    /// Gives a slot up for good: its track is of something that moves.
    fn refuse_feature(&mut self, slot: usize) {
        if let Some(id) = self.state.features[slot].id {
            self.state.refused_tracks.add(id);
        }
        self.drop_feature(slot);
    }

    pub(crate) fn drop_feature(&mut self, slot: usize) {
        self.state.features[slot] = Feature::default();
        self.state.renew(self.state.layout().feature(slot), &[0.0; 2]);
    }

    /// The receiver contradicts the velocity that the features carry: what they ride on moves.
    pub(crate) fn distrust_ground(&mut self) {
        for slot in 0..self.state.features.len() {
            if self.state.features[slot].id.is_some() {
                self.refuse_feature(slot);
            }
        }
    }
}

impl State {
    /// Time since the frame before, s, at most some seconds.
    pub(crate) fn since_frame(&self) -> f64 {
        (self.t - self.movers_noted).s().clamp(0.0, MOVERS_OVER_S)
    }

    /// Keeps the share of a frame's tracks that move.
    fn note_movers(&mut self, tracks: &[FeatureTrack]) {
        let since_s = self.since_frame();
        self.movers_noted = self.t;
        let moving = tracks.iter().filter(|track| self.refused_tracks.contains(track.id)).count();
        let share = moving as f64 / tracks.len().max(1) as f64;
        self.moving_share += since_s / MOVERS_OVER_S * (share - self.moving_share);
    }
}

impl GroundWork {
    /// `S = H P Hᵀ + R` of the first `n` measurements expected, jointly.
    fn join(&mut self, cov: &Grid, n: usize, at_truth: bool) {
        self.innovations.begin(n);
        for (i, z) in self.expected[..n].iter().enumerate() {
            let value = Vector2::new(z.residual[0], z.residual[1]);
            self.innovations.set_value(i, if at_truth { Vector2::zeros() } else { value });
            for component in 0..2 {
                let out = self.projected.row_mut(2 * i + component);
                out.fill(0.0);
                for (h, column) in z.row(component).iter().zip(z.columns()) {
                    axpy(out, *h, cov.row(*column));
                }
            }
        }
        for i in 0..n {
            for (j, z) in self.expected[..n].iter().enumerate() {
                let shared = Matrix2::from_fn(|a, b| {
                    let row = self.projected.row(2 * i + a);
                    z.row(b).iter().zip(z.columns()).map(|(h, column)| h * row[*column]).sum::<f64>()
                });
                let noise = Matrix2::from_fn(|a, b| if i == j { z.noise[a][b] } else { 0.0 });
                self.innovations.set_cov(i, j, &(shared + noise));
            }
        }
    }
}

fn of_id(tracks: &[FeatureTrack], id: u64) -> Option<&FeatureTrack> {
    tracks.iter().find(|track| track.id == id)
}

/// Where the feature in a slot was seen; one on probation may seem to move a little since it was found.
fn pixel_of(state: &State, slot: usize, track: &FeatureTrack) -> FeaturePixel {
    let feature = &state.features[slot];
    let seeming_mps = SEEMING_MPS + SEEMING_SHARE * state.own.velocity.norm();
    let slack_m = if feature.proven { 0.0 } else { seeming_mps * (state.t - feature.since).s() };
    FeaturePixel { slot, px: track.px, sigma_px: track.sigma_px, slack_m }
}

/// The track not yet used that lies farthest from those in use: spread is what separates turning from moving.
fn next_feature(state: &State, models: &Models, tracks: &[FeatureTrack]) -> Option<FeatureTrack> {
    let used = |id: u64| state.features.iter().any(|f| f.id == Some(id));
    let lone = |track: &FeatureTrack| {
        let others = tracks.iter().filter(|other| used(other.id));
        others.map(|o| (o.px - track.px).norm()).fold(f64::INFINITY, f64::min)
    };
    let fit = |track: &&FeatureTrack| {
        !used(track.id)
            && !state.refused_tracks.contains(track.id)
            && track.sigma_px.is_finite()
            && track.sigma_px > 0.0
            && track.px.iter().all(|x| x.is_finite())
            && lone(track) >= ONE_CORNER_PX
            && models.camera.normalised(track.px).is_some()
    };
    tracks.iter().filter(fit).max_by(|a, b| lone(a).total_cmp(&lone(b)).then(b.id.cmp(&a.id))).copied()
}
