//! A lens that is not as configured.
//!
//! The errors of its distortion are states ([`own::LENS`]). That of k1 is open from the start, by as much as a calibration
//! may be off; pixels that move through the picture show it within seconds. One that comes out beyond that is of another
//! lens, or of none that was calibrated: then all four are open.

use nalgebra::{Matrix2, Matrix2x4, Vector2};

use windhover_base::geo::CameraModel;
use windhover_base::msg::{FusionSource, MisfitCause};

use super::blocks::own;
use super::core::Core;
use super::models::Models;
use super::own::{LENS_K1_SIGMA, Own};

/// Sigmas of a calibration beyond which it is of another lens.
const BEYOND: f64 = 2.5;
/// Errors of k1, k2, p1, p2 then, one sigma: those of most lenses whose distortion is left out.
const OTHERWISE: [f64; 4] = [0.15, 0.15, 0.003, 0.003];
/// It is reported from this many of its sigmas on, and from this error of k1 on.
const REPORTED_SIGMAS: f64 = 5.0;
const REPORTED: f64 = 0.02;

impl Models {
    /// The camera with its lens as it is found to be.
    pub(crate) fn lens(&self, own: &Own) -> CameraModel {
        let mut lens = self.camera;
        lens.distortion.iter_mut().zip(own.lens.iter()).for_each(|(configured, error)| *configured += error);
        lens
    }
}

/// ∂px/∂(k1, k2, p1, p2) at normalised undistorted coordinates.
pub(crate) fn d_lens(lens: &CameraModel, ray: &Vector2<f64>) -> Matrix2x4<f64> {
    let (x, y, r2) = (ray.x, ray.y, ray.norm_squared());
    let both = 2.0 * x * y;
    Matrix2::new(lens.fx, lens.fx * lens.skew, 0.0, lens.fy)
        * Matrix2x4::new(
            x * r2,
            x * r2 * r2,
            both,
            r2 + 2.0 * x * x,
            y * r2,
            y * r2 * r2,
            r2 + 2.0 * y * y,
            both,
        )
}

impl Core {
    /// After a frame: whether the lens is another one.
    pub(crate) fn judge_lens(&mut self) {
        let state = &mut self.state;
        if !self.at_truth && !state.lens_open && state.own.lens[0].abs() > BEYOND * LENS_K1_SIGMA {
            state.lens_open = true;
            state.cov.add_diagonal(own::LENS, &OTHERWISE.map(|sigma| sigma * sigma));
        }
    }

    /// The lens, where it is not as configured beyond doubt: the error of its k1.
    pub(crate) fn lens_misfit(&self) -> Option<(FusionSource, MisfitCause, f64)> {
        let (off, sigma) = (self.state.own.lens[0], self.state.cov.sigma(own::LENS, 0));
        let beyond = off.abs() > REPORTED.max(REPORTED_SIGMAS * sigma);
        beyond.then_some((FusionSource::Marker, MisfitCause::Lens, off))
    }
}
