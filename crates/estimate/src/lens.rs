//! A lens that is not as configured.
//!
//! The errors of its first four distortion terms are states ([`own::LENS`]). That of k1 is open from the start, by as much as a calibration
//! may be off; pixels that move through the picture show it within seconds. One that comes out beyond that is of another
//! lens, or of none that was calibrated: then all four are open.

use nalgebra::{Matrix2, Matrix2x4, Vector2, Vector4};

use windhover_base::geo::{CameraModel, LensModel};
use windhover_base::msg::{FusionSource, MisfitCause};
use windhover_base::time::MonoTime;

use super::blocks::{Block, own};
use super::core::Core;
use super::models::Models;
use super::own::Own;
use super::slow::LENS_K1_SIGMA;
use super::state::{State, Target};

/// Sigmas of a calibration beyond which it is of another lens; while it is not known whether vehicles sway.
const BEYOND: f64 = 2.5;
const FAR_BEYOND: f64 = 4.0;
/// Errors of k1, k2, p1, p2 then, one sigma: those of most lenses whose distortion is left out.
const OTHERWISE: [f64; 4] = [0.15, 0.15, 0.003, 0.003];
/// What heading may be off by where the lens was another one, rad.
const HEADING_SIGMA: f64 = 0.035;
/// Its errors are looked at again so often, s; a movement of k1 beyond so many of its sigmas says that they are larger than
/// believed, by this share of the above.
const CHECKED_EVERY_S: f64 = 0.7;
const MOVED_SIGMAS: f64 = 3.0;
const AGAIN: f64 = 0.3;
/// Until pixels move by less than this between two such looks, heading is doubted, px.
const SETTLED_PX: f64 = 0.2;
/// It is reported from this many of its sigmas on, and from this error of k1 on.
const REPORTED_SIGMAS: f64 = 5.0;
const REPORTED: f64 = 0.02;

/// A lens that is another one than configured, as it was found to be.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LensCheck {
    t: MonoTime,
    /// Its errors then, and the sigma of the first.
    lens: Vector4<f64>,
    k1_sigma: f64,
    /// Whether it no longer changed then.
    settled: bool,
}

impl LensCheck {
    /// By how much pixels at half a focal length from the axis moved since.
    fn moved_px(&self, now: &Self, focal_px: f64) -> f64 {
        let moved = now.lens - self.lens;
        (focal_px * (moved[0] * 0.125 + moved[1] * 0.031)).abs()
    }
}

impl Models {
    /// The camera with its lens as it is found to be.
    pub(crate) fn lens(&self, own: &Own) -> CameraModel {
        let mut lens = self.camera;
        lens.distortion.iter_mut().zip(own.lens.iter()).for_each(|(configured, error)| *configured += error);
        lens
    }
}

/// ∂px/∂(k1, k2, p1, p2), of a fisheye ∂px/∂(k1, k2, k3, k4), at normalised undistorted coordinates.
pub(crate) fn d_lens(lens: &CameraModel, ray: &Vector2<f64>) -> Matrix2x4<f64> {
    let (x, y, r2) = (ray.x, ray.y, ray.norm_squared());
    let by = match lens.model {
        LensModel::Brown => {
            let both = 2.0 * x * y;
            Matrix2x4::from_columns(&[
                ray * r2,
                ray * (r2 * r2),
                Vector2::new(both, r2 + 2.0 * y * y),
                Vector2::new(r2 + 2.0 * x * x, both),
            ])
        }
        LensModel::Fisheye => {
            let r = r2.sqrt();
            // Towards the axis all of them vanish.
            let outwards = ray / r.max(f64::MIN_POSITIVE.sqrt());
            let angle = r.atan();
            Matrix2x4::from_columns(&[3, 5, 7, 9].map(|power| outwards * angle.powi(power)))
        }
    };
    Matrix2::new(lens.fx, lens.fx * lens.skew, 0.0, lens.fy) * by
}

impl State {
    /// The direction in which the helicopter and all that is seen are turned about it, and the compass errs by as much: no
    /// pixel and no reading of the compass changes along it.
    fn heading_direction(&self, along: &mut [f64]) {
        along.fill(0.0);
        let (layout, us) = (self.layout(), self.own.position.xy());
        along[own::TURN.column(0)] = 1.0;
        along[own::HEADING_BIAS.column(0)] = -1.0;
        let mut turn = |block: Block<2>, [north, east]: [f64; 2]| {
            along[block.range()].copy_from_slice(&[-east, north]);
        };
        turn(own::VELOCITY.part(0), self.own.velocity.xy().into());
        turn(own::WIND, self.own.wind.into());
        turn(own::GUST, self.own.gust.into());
        for (i, target) in self.targets.iter().enumerate().filter(|(_, target)| target.life.is_held()) {
            turn(layout.target(i).place(), [target.mean[0] - us.x, target.mean[1] - us.y]);
        }
        for (i, feature) in self.features.iter().enumerate().filter(|(_, feature)| feature.id.is_some()) {
            turn(layout.feature(i), [feature.mean[0] - us.x, feature.mean[1] - us.y]);
        }
        for (i, _) in self.targets.iter().enumerate().filter(|(_, target)| target.life.is_held()) {
            along[layout.target(i).heading().column(0)] = 1.0;
        }
    }
}

impl Core {
    /// After a frame: whether the lens is another one.
    pub(crate) fn judge_lens(&mut self) {
        let state = &mut self.state;
        // A vehicle that sways bends what is seen of the lens, until it is known to.
        let judged = |target: &Target| !target.life.is_held() || target.sway.is_judged();
        let limit = if state.targets.iter().all(judged) { BEYOND } else { FAR_BEYOND };
        let now = LensCheck {
            t: state.t,
            lens: state.own.lens,
            k1_sigma: state.cov.sigma(own::LENS, 0),
            settled: false,
        };
        let share = match state.lens_open {
            _ if self.at_truth => return,
            None if now.lens[0].abs() < limit * LENS_K1_SIGMA => return,
            None => Some(1.0),
            Some(before) if (now.t - before.t).s() < CHECKED_EVERY_S => return,
            Some(before) if (now.lens[0] - before.lens[0]).abs() > MOVED_SIGMAS * before.k1_sigma => {
                Some(AGAIN)
            }
            Some(before) => {
                let settled = before.moved_px(&now, self.models.camera.fx) < SETTLED_PX;
                state.lens_open = Some(LensCheck { settled: before.settled || settled, ..now });
                if before.settled {
                    return;
                }
                None
            }
        };
        if let Some(share) = share {
            state.cov.add_diagonal(own::LENS, &OTHERWISE.map(|sigma| (share * sigma).powi(2)));
            state.lens_open = Some(LensCheck { k1_sigma: state.cov.sigma(own::LENS, 0), ..now });
            (0..self.state.features.len()).for_each(|slot| self.drop_feature(slot));
        }
        // Heading was found by the wrong lens, and the compass was judged by it.
        self.loosen_heading(HEADING_SIGMA);
    }

    /// The helicopter, all that is seen and the compass's error may be turned by `sigma` more than was believed, rad.
    pub(crate) fn loosen_heading(&mut self, sigma: f64) {
        let mut along = std::mem::take(&mut self.along);
        self.state.heading_direction(&mut along);
        self.state.add_direction(&along, sigma);
        self.along = along;
    }

    /// The lens, where it is not as configured beyond doubt: the error of its k1.
    pub(crate) fn lens_misfit(&self) -> Option<(FusionSource, MisfitCause, f64)> {
        let (off, sigma) = (self.state.own.lens[0], self.state.cov.sigma(own::LENS, 0));
        let beyond = off.abs() > REPORTED.max(REPORTED_SIGMAS * sigma);
        beyond.then_some((FusionSource::Marker, MisfitCause::Lens, off))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_move_by_their_derivatives_with_either_lens() {
        let brown = CameraModel {
            fx: 900.0,
            fy: 910.0,
            cx: 640.0,
            cy: 512.0,
            distortion: [-0.18, 0.1, 0.001, -0.002, 0.0],
            skew: 0.001,
            model: LensModel::Brown,
        };
        let fisheye = CameraModel { model: LensModel::Fisheye, ..brown };
        for lens in [brown, fisheye] {
            for ray in [Vector2::new(0.4, -0.3), Vector2::new(-0.05, 0.2), Vector2::zeros()] {
                for k in 0..4 {
                    let by = |step: f64| {
                        let mut moved = lens;
                        moved.distortion[k] += step;
                        moved.pixel_of(ray).0
                    };
                    let found = (by(1e-5) - by(-1e-5)) / 2e-5;
                    let error = (found - d_lens(&lens, &ray).column(k)).norm();
                    assert!(error < 1e-4 * (1.0 + found.norm()), "{ray}, term {k}: {error}");
                }
            }
        }
    }
}
