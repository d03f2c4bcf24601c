//! A tag on a vehicle: its four corners at once, each through lens, mount, lever arms and the ground under the vehicle.

use nalgebra::{Matrix2, Matrix2x5, Matrix3x4, Vector2, Vector3};

use windhover_base::geo::rot_z;
use windhover_base::msg::{Disposition, FusionSource};

use super::Aid;
use super::pixel::{self, CameraColumns, Curvature, Moment};
use crate::blocks::{TagFitBlock, own};
use crate::core::Core;
use crate::fitted::blend_factor;
use crate::measurement::Measurement;
use crate::models::Models;
use crate::shape;
use crate::state::State;
use crate::sway;
use crate::tag_fit;
use crate::update::REFUSE_RATIO;

/// A point of a vehicle as it was seen.
#[derive(Clone, Copy)]
pub(super) struct Sighting<'a> {
    /// In the vehicle frame, m.
    pub(super) point: Vector3<f64>,
    /// Its derivative by the fit of its tag.
    pub(super) d_fit: Option<Matrix3x4<f64>>,
    pub(super) px: &'a Vector2<f64>,
    pub(super) cov_px2: &'a Matrix2<f64>,
}

/// The corners of a tag.
#[derive(Clone, Copy)]
pub(crate) struct Tag<'a> {
    pub(crate) target: usize,
    /// Centre and corners in the vehicle frame as configured, m.
    pub(crate) center: &'a Vector3<f64>,
    pub(crate) points: &'a [Vector3<f64>; 4],
    /// Which of the fitted tags it is.
    pub(crate) fit: Option<usize>,
    pub(crate) corners_px: &'a [Vector2<f64>; 4],
    pub(crate) cov_px2: &'a [Matrix2<f64>; 4],
}

impl Aid for Tag<'_> {
    const SOURCE: FusionSource = FusionSource::Marker;

    fn linearise(&self, state: &State, models: &Models, z: &mut Measurement) -> Result<(), Disposition> {
        let fit = self.fit.map(|slot| tag_fit::block(state, slot));
        linearise_points(self.target, fit, self.sighted(state).into_iter(), state, models, z)
    }
}

impl Tag<'_> {
    /// Its corners as they are fitted, with their pixels.
    fn sighted(&self, state: &State) -> [Sighting<'_>; 4] {
        let fitted = |slot: usize| {
            tag_fit::corners(&state.tags[slot].mean, self.center, self.points).map(|(p, d)| (p, Some(d)))
        };
        let points = self.fit.map_or_else(|| self.points.map(|point| (point, None)), fitted);
        std::array::from_fn(|i| {
            let (point, d_fit) = points[i];
            Sighting { point, d_fit, px: &self.corners_px[i], cov_px2: &self.cov_px2[i] }
        })
    }
}

/// One corner of a tag.
#[derive(Clone, Copy)]
pub(crate) struct TagCorner<'a>(pub(crate) Tag<'a>, pub(crate) usize);

impl Aid for TagCorner<'_> {
    const SOURCE: FusionSource = FusionSource::Marker;

    fn linearise(&self, state: &State, models: &Models, z: &mut Measurement) -> Result<(), Disposition> {
        let Self(tag, corner) = self;
        let fit = tag.fit.map(|slot| tag_fit::block(state, slot));
        let seen = tag.sighted(state)[*corner];
        linearise_points(tag.target, fit, std::iter::once(seen), state, models, z)
    }
}

/// Writes points of a vehicle into `z`.
pub(super) fn linearise_points<'a>(
    target: usize,
    fit: Option<TagFitBlock>,
    seen: impl ExactSizeIterator<Item = Sighting<'a>>,
    state: &State,
    models: &Models,
    z: &mut Measurement,
) -> Result<(), Disposition> {
    let mean = &state.targets[target].mean;
    let curvature = Curvature::of(&state.cov, &state.own, models);
    let factor = state.learnt.marker_factor[target];
    z.begin(2 * seen.len());
    let camera = CameraColumns::touch(z, state);
    let vehicle = z.touch(state.layout().target(target).all());
    let fit = fit.map(|block| z.touch(block.all()));
    let body = &state.targets[target].sway;
    let swaying = body.is_open().then(|| z.touch(state.layout().sway(target)));
    let turned = rot_z(mean[2]);
    let [_, _, heading, speed, yaw_rate] = *mean;
    let (s, c) = heading.sin_cos();
    for (i, Sighting { point, d_fit, px, cov_px2 }) in seen.enumerate() {
        let (world, derivatives) = pixel::target_point(mean, models, &(point + body.displaced(&point)));
        let view = pixel::view(&state.own, models, &world).ok_or(Disposition::Invalid)?;
        let known = cov_px2 + Matrix2::identity() * models.marker_var_px2;
        let bent = curvature.noise_px2(&(world - state.own.position));
        // The point's velocity and its derivatives by speed, yaw rate and heading.
        let [north, east, turn] = derivatives;
        let ahead = north * c + east * s;
        let moment = Moment::of(&state.own, models, &view, &(ahead * speed + turn * yaw_rate), px);
        camera.set_point(z, i, px, (state, models), &view, &moment, &(known * factor), &bent);
        let later = moment.after_s;
        let sideways = (east * c - north * s) * (speed * later);
        let by = [north, east, turn + sideways, ahead * later, turn * later];
        z.set(2 * i, vehicle, &Matrix2x5::from_columns(&by.map(|d| view.d_point * d)));
        if let Some(columns) = swaying {
            z.set(2 * i, columns, &(view.d_point * turned * sway::derivative(&point)));
        }
        if let Some((columns, d_fit)) = fit.zip(d_fit) {
            z.set(2 * i, columns, &(view.d_point * turned * body.carried(&d_fit)));
        }
    }
    Ok(())
}

/// Sightings the fitted noise remembers: some seconds of one vehicle's tags.
const SAMPLES: f64 = 100.0;

impl Tag<'_> {
    /// Fuses it through the gate, with its noise raised to what its shape shows; whether it was inside. One that is
    /// outside while another tag of its vehicle is inside contradicts that one (`contradicts`), and is not fused: at any weight it would bend
    /// tilt and height until the two agree.
    pub(crate) fn fuse(&self, core: &mut Core, contradicts: bool) -> bool {
        if !core.expect_aid(self) {
            return false;
        }
        let worse = core.worse_than_assumed(self.target);
        core.z.scale_noise(worse);
        if contradicts && !core.at_truth && core.gate_ratio().is_none_or(|ratio| ratio > 1.0) {
            core.refuse(FusionSource::Marker, Disposition::GateRejected);
            core.state.note_marker(true);
            return false;
        }
        fuse_expected(core, self.target, worse)
    }
}

/// Fuses the marker that stands in `z` through the gate, its noise raised by a factor before; whether it was inside.
pub(super) fn fuse_expected(core: &mut Core, target: usize, worse: f64) -> bool {
    let settled = !core.z.unsettled;
    let outcome = core.fuse_gated(FusionSource::Marker);
    core.note_marker_unrest(target, &outcome);
    core.state.note_marker(outcome.ratio > 1.0);
    if settled && core.teaches(&outcome) {
        let factor = &mut core.state.learnt.marker_factor[target];
        blend_factor(factor, outcome.misfit * worse, SAMPLES, pixel::FACTORS);
    }
    outcome.ratio <= 1.0
}

impl Core {
    /// By what factor the variance of the tag's pixels in `self.z` is larger than assumed, by what its shape shows:
    /// 1 unless that is beyond the gate, or so far beyond that it is no tag of ours.
    fn worse_than_assumed(&self, target: usize) -> f64 {
        if self.at_truth {
            return 1.0;
        }
        let gate = self.models.gates[shape::LEFT];
        let pose = self.state.layout().target(target).pose();
        let rigid = [pose.column(0), pose.column(1), pose.column(2), own::POSITION.column(2)];
        let left =
            shape::left_over(&self.z, &rigid).filter(|left| (1.0..REFUSE_RATIO).contains(&(left / gate)));
        left.map_or(1.0, |left| left / shape::LEFT as f64)
    }
}
