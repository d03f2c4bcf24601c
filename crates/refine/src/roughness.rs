//! Covariances where motion is smoother, or rougher, than its model.
//!
//! The covariance P of a least-squares estimate has two parts: errors of the measurements, and motion that the smooth
//! model does not follow. With the whitened rows F of a kind of motion and `G = F P Fᵀ`, scaling the information of
//! these rows by α changes P by `∂P/∂ln α = −P Fᵀ F P`: this is the part of motion. It is right where the rows'
//! true values w have the covariance of the model at the frequencies at which measurements begin to outweigh the model.
//! A vehicle that is driven smoothly has almost nothing there, although the intensity of the model fits it as a
//! whole. With `cov w = κ I` the sum of squares S = |F x̂|² responds to α by
//!
//! `E[∂S/∂ln α] = −2 (tr G²(1 − G) + κ tr G(1 − G)²)`,
//!
//! from which κ follows, and the consistent covariance is `P + (κ − 1) P Fᵀ F P` (that of an estimator whose model is not
//! the true one: White 1982). Derivatives by α are differences of three solutions.

use windhover_estimate::Site;

use crate::block::{Noise, Source};
use crate::covariance_pass::{PassResult, look};
use crate::noise::Components;
use crate::problem::Pass;
use crate::recording::Recording;
use crate::result::Refined;
use crate::solve::{Unsolved, Watch, factorise};
use crate::values::Values;

/// Step of ln α.
const STEP: f64 = 0.3;
/// Weight of the model's own κ = 1, in rows.
const OF_MODEL: f64 = 2.0;
/// Limits of κ.
const LIMITS: (f64, f64) = (0.0, 5.0);

/// A kind of motion with a κ of its own.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Kind {
    Vehicles,
    Own,
}

impl Kind {
    fn sources(self, targets: usize) -> Vec<Source> {
        use Source as S;
        match self {
            Self::Vehicles => (0..targets).flat_map(|t| [S::Drive(t), S::Turn(t)]).collect(),
            Self::Own => vec![S::TiltMotion, S::YawMotion, S::Gust, S::Thrust, S::Vibration],
        }
    }
}

/// What a solution shows of a kind of motion: its sum of squares in the rows of α = 1, and the expected one.
#[derive(Clone, Copy, Debug)]
struct Response {
    found: f64,
    due: f64,
}

impl Response {
    fn of(components: &Components, sources: &[Source], alpha: f64) -> Self {
        let [found, due] = components.sums_of(sources);
        Self { found: found / alpha, due }
    }
}

/// Replaces the covariances of a result by consistent ones.
pub(crate) fn make_consistent(
    pass: &mut Pass<'_>,
    values: &Values,
    noise: &Noise,
    looked: &mut PassResult,
    (site, recordings): (&Site, &[Recording]),
    watch: Watch<'_>,
) -> Result<(), Unsolved> {
    let targets = pass.problem.targets;
    for kind in [Kind::Vehicles, Kind::Own] {
        let sources = kind.sources(targets);
        let at = Response::of(&looked.components, &sources, 1.0);
        if at.due <= 0.0 {
            continue;
        }
        let mut scaled = |by: f64, watch: Watch<'_>| -> Result<(Refined, Response), Unsolved> {
            let alpha = by.exp();
            let noise = noise.scaled(&sources, 1.0 / alpha);
            let factors = factorise(pass, values, &noise, 0.0, watch)?;
            let more = look(pass, &factors, values, &noise, site, recordings)?;
            Ok((more.refined, Response::of(&more.components, &sources, alpha)))
        };
        let (looser, less) = scaled(-STEP, watch)?;
        let (tighter, more) = scaled(STEP, watch)?;
        let kappa = kappa(less, at, more);
        looked.refined.add_covariances(&looser, &tighter, (kappa - 1.0) / (2.0 * STEP));
    }
    Ok(())
}

/// κ from the responses at −STEP, 0 and STEP of ln α.
fn kappa(less: Response, at: Response, more: Response) -> f64 {
    let first = (less.due - more.due) / (2.0 * STEP);
    let second = -(more.due - 2.0 * at.due + less.due) / STEP.powi(2);
    // tr G²(1 − G) and tr G(1 − G)².
    let (of_noise, of_motion) = (0.5 * (first - second), 0.5 * (first + second));
    if of_motion <= 0.0 {
        return 1.0;
    }
    let found = (less.found - more.found) / (4.0 * STEP) - of_noise;
    ((found + OF_MODEL) / (of_motion + OF_MODEL)).clamp(LIMITS.0, LIMITS.1)
}

impl Refined {
    /// Adds `by` times the difference of the covariances of two results, as far as variances remain positive.
    fn add_covariances(&mut self, plus: &Self, minus: &Self, by: f64) {
        for ((_, own), ((_, plus), (_, minus))) in self.own.iter_mut().zip(plus.own.iter().zip(&minus.own)) {
            own.covariance += (plus.covariance - minus.covariance) * by;
        }
        for ((_, e), ((_, plus), (_, minus))) in
            self.targets.iter_mut().zip(plus.targets.iter().zip(&minus.targets))
        {
            let of = |e: &windhover_base::msg::TargetEstimate| e.state.and_then(|state| state.covariance);
            if let Some(state) = e.state.as_mut()
                && let (Some(covariance), Some(plus), Some(minus)) =
                    (state.covariance.as_mut(), of(plus), of(minus))
            {
                *covariance += (plus - minus) * by;
            }
        }
        for (constant, (plus, minus)) in
            self.constants.iter_mut().zip(plus.constants.iter().zip(&minus.constants))
        {
            let change = (plus.sigma.powi(2) - minus.sigma.powi(2)) * by;
            constant.sigma = (constant.sigma.powi(2) + change).max(0.0).sqrt();
        }
    }
}
