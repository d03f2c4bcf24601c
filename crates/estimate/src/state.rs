//! The joint state: helicopter, sensors' slow errors, targets, ground features, their covariance, and
//! the delayed copies that make the smoothed output.

use nalgebra::{Vector2, Vector3};

use windhover_base::time::{MonoTime, Span};

use super::blocks::{Block, FEATURE, Layout, TARGET, own};
use super::delayed::DelayedCopy;
use super::fit::{Fit, WATCHED};
use super::fitted::Learnt;
use super::ground::RefusedTracks;
use super::height::HeightCheck;
use super::kind::TiltWatch;
use super::lens::LensCheck;
use super::matrix::{Grid, Shear};
use super::own::{Own, Senses};
use super::shake::Shake;
use super::slip::Slip;
use super::spin::Spin;
use super::standstill::{Standstill, Unrest};
use super::sway::Sway;
use super::tag_fit::{Scale, ScaleTest, TagFit};
use super::track::Life;
use super::twins::Twin;

/// Variance of the place of something just found, m². Its guess is made from where the helicopter is thought to be, so
/// as a prior it must say nothing of where that is: with 30 m each new ground feature said a little, and a
/// thousand of them twice what the receiver does.
pub(crate) const GUESSED_VAR: f64 = 1e5;

/// For so long what a marker showed keeps the forces and the sensors' errors in place.
const SEEN: Span = Span::from_ns(2_000_000_000);

/// One vehicle: rear axle north, east, heading, speed, yaw rate, and its track.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Target {
    pub(crate) mean: [f64; TARGET],
    pub(crate) life: Life,
    pub(crate) last_seen: MonoTime,
    /// Nothing ties it to delayed copies from before this time: it was started or placed anew then.
    pub(crate) tied_since: MonoTime,
    pub(crate) standstill: Standstill,
    /// Over how long the filter remembers its speed and its yaw rate, s, and did when their walks were last fitted
    /// (zero where they have not been).
    pub(crate) memory_s: [f64; 2],
    pub(crate) fitted_memory_s: [f64; 2],
    /// A copy of one of its markers on another vehicle.
    pub(crate) twin: Option<Twin>,
    /// Whether, and for how long, it has turned tighter than its model of motion allows.
    pub(crate) spin: Spin,
    pub(crate) turn_judged: MonoTime,
    pub(crate) slip: Slip,
    pub(crate) sway: Sway,
    /// Whether it is about to move again, where it stands.
    pub(crate) unrest: Unrest,
}

/// One ground feature.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Feature {
    pub(crate) id: Option<u64>,
    pub(crate) mean: [f64; FEATURE],
    /// When it was found.
    pub(crate) since: MonoTime,
    /// Whether it has stood long enough to be ground.
    pub(crate) proven: bool,
    /// Frames in which it was where it was expected.
    pub(crate) stood: u32,
    /// Frames in a row in which it was not.
    pub(crate) rejected: u32,
}

/// Measurements in a row outside the gate, per source of the helicopter's own.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Rejections {
    pub(crate) gps_position: u32,
    /// Horizontal error of the receiver that the last fix implied, m.
    pub(crate) gps_error: Vector2<f64>,
    pub(crate) gps_velocity: u32,
    /// Of the compass and of the second source of attitude.
    pub(crate) heading: [u32; 2],
    pub(crate) tilt: [u32; 2],
    pub(crate) rate: u32,
}

/// The whole filter state at one instant.
#[derive(Clone, Debug, Default)]
pub(crate) struct State {
    pub(crate) t: MonoTime,
    /// Whether the helicopter's own state is known.
    pub(crate) alive: bool,
    pub(crate) own: Own,
    /// Columns of the helicopter's part.
    pub(crate) own_columns: usize,
    pub(crate) targets: Vec<Target>,
    pub(crate) features: Vec<Feature>,
    /// What tags are beside their configuration.
    pub(crate) tags: Vec<TagFit>,
    pub(crate) scale_test: ScaleTest,
    /// The scale of all that is seen, once it is open.
    pub(crate) scale: Option<Scale>,
    /// Whether the receiver's velocity contradicts that vehicles in view stand.
    pub(crate) unrest: Unrest,
    /// Share of the tracked features that move, over the last seconds.
    pub(crate) moving_share: f64,
    pub(crate) movers_noted: MonoTime,
    pub(crate) shake: Shake,
    /// Share of the last markers that were outside the gate.
    pub(crate) markers_outside: f64,
    /// Tracks that are of no ground.
    pub(crate) refused_tracks: RefusedTracks,
    pub(crate) cov: Grid,
    /// Targets as they were at recent frames.
    pub(crate) copies: Vec<DelayedCopy>,
    /// Rates and forces as they were a moment ago, to fit their intensity from.
    pub(crate) past_motion: DelayedCopy,
    /// The receiver's horizontal error as it was some seconds ago, likewise.
    pub(crate) past_bias: DelayedCopy,
    pub(crate) learnt: Learnt,
    /// What the sensors are taken to be.
    pub(crate) senses: Senses,
    /// What the tilt sensors of the compass and of the second source of attitude are found to feel.
    pub(crate) tilt: [TiltWatch; 2],
    /// How the sources of own motion fit, by [`WATCHED`].
    pub(crate) fits: [Fit; WATCHED.len()],
    pub(crate) rejections: Rejections,
    /// What tags have shown of height before they were fused.
    pub(crate) height: HeightCheck,
    /// By how much lower than configured the ground lies, m: the receiver's heights are over that.
    pub(crate) ground_lower_m: f64,
    /// The lens where it was found to be another one than configured.
    pub(crate) lens_open: Option<LensCheck>,
    /// Whether the antenna's place was found to be measured wrongly.
    pub(crate) antenna_anywhere: bool,
    /// By how much earlier than stamped frames are true, as was found out, s.
    pub(crate) camera_late_s: f64,
    /// When the scene was last anchored anew, and by how much it moved.
    pub(crate) anchored: Option<(MonoTime, Vector3<f64>)>,
}

impl State {
    pub(crate) fn new(
        layout: Layout,
        copies: usize,
        learnt: Learnt,
        senses: Senses,
        tilt: [TiltWatch; 2],
    ) -> Self {
        let n = layout.len();
        Self {
            own_columns: layout.own,
            targets: vec![Target::default(); layout.targets],
            features: vec![Feature::default(); layout.features],
            tags: vec![TagFit::default(); layout.tags],
            cov: Grid::zeros(n, n),
            copies: vec![DelayedCopy::of_targets(layout); copies],
            past_motion: DelayedCopy::of_states(own::MOTION.range().len(), n),
            past_bias: DelayedCopy::of_states(2, n),
            learnt,
            senses,
            tilt,
            ..Self::default()
        }
    }

    /// Copies without allocating where the sizes match.
    pub(crate) fn copy_from(&mut self, other: &Self) {
        self.copy_present(other);
        self.copies.resize_with(other.copies.len(), DelayedCopy::default);
        for (mine, theirs) in self.copies.iter_mut().zip(&other.copies) {
            mine.copy_from(theirs);
        }
        self.past_motion.copy_from(&other.past_motion);
        self.past_bias.copy_from(&other.past_bias);
        self.rejections = other.rejections;
        self.anchored = other.anchored;
        self.height = other.height;
        self.tilt = other.tilt;
    }

    /// Copies all but the delayed copies, to look ahead with; without allocating where the sizes match.
    pub(crate) fn copy_present(&mut self, other: &Self) {
        self.t = other.t;
        self.alive = other.alive;
        self.own = other.own;
        (self.ground_lower_m, self.camera_late_s) = (other.ground_lower_m, other.camera_late_s);
        (self.antenna_anywhere, self.lens_open) = (other.antenna_anywhere, other.lens_open);
        self.own_columns = other.own_columns;
        self.senses = other.senses;
        self.fits = other.fits;
        self.targets.clone_from(&other.targets);
        self.features.clone_from(&other.features);
        self.tags.clone_from(&other.tags);
        (self.scale_test, self.scale, self.unrest) = (other.scale_test, other.scale, other.unrest);
        (self.moving_share, self.movers_noted) = (other.moving_share, other.movers_noted);
        self.markers_outside = other.markers_outside;
        self.shake = other.shake;
        self.refused_tracks = other.refused_tracks;
        self.cov.copy_from(&other.cov);
        self.learnt.copy_from(&other.learnt);
    }

    /// Forgets targets, features, covariance and delayed copies; the helicopter's mean is the caller's.
    pub(crate) fn clear(&mut self) {
        self.targets.fill(Target::default());
        self.features.fill(Feature::default());
        self.tags.fill(TagFit::default());
        self.scale = None;
        self.shake = Shake::default();
        (self.antenna_anywhere, self.lens_open) = (false, None);
        self.cov.fill(0.0);
        (self.past_motion.in_use, self.past_bias.in_use) = (false, false);
        self.copies.iter_mut().for_each(|copy| copy.in_use = false);
    }

    /// Which part lies where.
    pub(crate) fn layout(&self) -> Layout {
        Layout {
            own: self.own_columns,
            targets: self.targets.len(),
            features: self.features.len(),
            tags: self.tags.len(),
        }
    }

    /// Forgets some states and gives them variances of their own.
    pub(crate) fn renew<const N: usize>(&mut self, block: Block<N>, variances: &[f64; N]) {
        self.cov.forget(block);
        self.cov.set_diagonal(block, variances);
        self.copies_in_use().for_each(|copy| copy.cross.forget_columns(block));
    }

    /// Moves the mean by an error-state step.
    pub(crate) fn inject(&mut self, dx: &[f64]) {
        let layout = self.layout();
        self.own.inject(dx, layout);
        let add = |mean: &mut [f64], step: &[f64]| mean.iter_mut().zip(step).for_each(|(x, d)| *x += d);
        for (i, target) in self.targets.iter_mut().enumerate() {
            add(&mut target.mean, &dx[layout.target(i).all().range()]);
            add(&mut target.sway.mean, &dx[layout.sway(i).range()]);
        }
        add(&mut self.shake.mean, &dx[layout.shake().range()]);
        for (i, feature) in self.features.iter_mut().enumerate() {
            add(&mut feature.mean, &dx[layout.feature(i).range()]);
        }
        for (i, tag) in self.tags.iter_mut().enumerate() {
            add(&mut tag.mean, &dx[layout.tag(i).all().range()]);
        }
    }

    /// What carries the covariance over to the estimate that an update has just moved by `dx`.
    ///
    /// What is seen of vehicles and ground says nothing of absolute heading: turning helicopter,
    /// velocity and everything seen about the vertical together changes no pixel. In error states
    /// that direction is `(e_D × p̂, e_D × v̂, 1, e_D × d̂, …)`; it depends on the estimate, so an update
    /// that moves p̂ by Δ leaves the covariance with the old one, and the filter gains heading it never
    /// measured. Adding `e_D × Δ` times the heading error to each horizontal vector's error keeps the
    /// direction where it belongs (the error of an invariant filter, restricted to the vertical axis:
    /// Barrau and Bonnabel 2017).
    pub(crate) fn keep_heading_unobserved(&self, dx: &[f64], shear: &mut Shear) {
        shear.begin(own::TURN.column(0));
        let level: [Block<2>; 4] = [own::POSITION.part(0), own::VELOCITY.part(0), own::WIND, own::GUST];
        for block in level.into_iter().chain(self.layout().places()) {
            let moved = block.of(dx);
            shear.give(block.column(0), -moved.y);
            shear.give(block.column(1), moved.x);
        }
    }

    /// Adds multiples of one state's error to those of others.
    pub(crate) fn shear(&mut self, shear: &Shear) {
        self.cov.shear(shear);
        self.copies_in_use().for_each(|copy| copy.cross.shear_columns(shear));
    }

    /// The columns that have a variance lie before this one: tags come last, and most are as configured.
    pub(crate) fn width(&self) -> usize {
        let uncertain = |column: &usize| self.cov.at(*column, *column) != 0.0;
        (0..self.cov.rows()).rev().find(uncertain).map_or(0, |last| last + 1)
    }

    /// Whether no marker has been seen for so long that own motion stands on GPS and compass alone (or on ground features,
    /// which show no tilt by themselves).
    pub(crate) fn is_blind(&self) -> bool {
        !self.targets.iter().any(|target| target.life.is_held() && self.t - target.last_seen <= SEEN)
    }

    /// Whether every mean is a number and every variance a number not below zero.
    pub(crate) fn is_sound(&self) -> bool {
        let diagonal = (0..self.cov.rows()).all(|i| {
            let variance = self.cov.at(i, i);
            variance.is_finite() && variance >= 0.0
        });
        diagonal && self.own.is_finite() && self.targets.iter().all(|t| t.mean.iter().all(|x| x.is_finite()))
    }
}
