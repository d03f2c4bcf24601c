//! Whether measurements fit their configured accuracy: for each source of own motion a running mean and spread of
//! normalised innovations.
//!
//! Where model and noise are right, `νᵀ S⁻¹ ν / m` has a mean of one at most (less where a sensor's slow error is
//! allowed for and small) and `ν/√S` one of zero. The scale of tilt does not show here (gusts absorb it): see
//! `kind.rs`.

use windhover_base::msg::{FusionSource, MisfitCause};
use windhover_base::time::MonoTime;

use super::core::Core;
use super::matrix::MAX_MEASURED;
use super::own::{COMPASS, SECOND};
use super::state::State;

/// Time over which the means are taken, s.
const OVER_S: f64 = 30.0;
/// Longest that one innovation counts for, s.
const LONGEST_S: f64 = 1.0;
/// The most that one counts: a single wild measurement is no misfit.
const MOST: f64 = 20.0;
/// Mean square above which the stated variances are enlarged, and above which a misfit is reported.
const INFLATE: f64 = 1.3;
const TELL: f64 = 2.0;
/// Mean innovation over its spread from which a misfit is reported.
const TELL_MEAN: f64 = 0.7;
/// Time of observation before anything is reported, s.
const SEEN_S: f64 = 20.0;

/// Innovations before this time of observation are those of a filter that settles, s.
const SETTLED_S: f64 = 5.0;
/// The most that an innovation counts in the correlation, in sigmas.
const COLOUR_MOST: f64 = 3.0;
/// The largest correlation that noise is enlarged for.
const MOST_CORRELATION: f64 = 0.6;
/// Sigmas from which a correlation counts, and over how many more it comes to count as a whole.
const SURE: (f64, f64) = (2.0, 1.0);

/// The sources that are looked at.
pub(crate) const WATCHED: [FusionSource; 8] = [
    FusionSource::GpsPosition,
    FusionSource::GpsVelocity,
    FusionSource::CompassHeading,
    FusionSource::CompassTilt,
    FusionSource::AttitudeHeading,
    FusionSource::AttitudeTilt,
    FusionSource::ImuRate,
    FusionSource::ImuForce,
];

/// Index of fixes among them.
pub(crate) const WATCHED_POSITION: usize = 0;

/// How one source fits.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(crate) struct Fit {
    /// Mean of the normalised square of innovations, a component.
    pub(crate) square: f64,
    /// Mean of each component over its spread.
    mean: [f64; 3],
    last: Option<MonoTime>,
    seen_s: f64,
    colour: Colour,
}

/// Correlation of a source's successive innovations. Where model and noise are right, they are white.
#[derive(Clone, Copy, PartialEq, Debug, Default)]
struct Colour {
    /// The innovation before, each component over its sigma.
    before: [f64; 3],
    /// Means of the product of successive ones and of the square, of all components.
    product: f64,
    square: f64,
    /// Number of products in the means.
    count: f64,
}

impl Colour {
    /// Takes an innovation, each component over its sigma and less its mean; `window` is the number of products that the means hold.
    fn take(&mut self, innovation: &[f64], window: f64) {
        for (one, before) in innovation.iter().zip(&mut self.before) {
            self.count = (self.count + 1.0).min(window);
            self.product += (one * *before - self.product) / self.count;
            self.square += (one * one - self.square) / self.count;
            *before = *one;
        }
    }

    /// The correlation, or zero where it is within two sigmas of it. Innovations that are smaller than their sigma correlate by the
    /// share of their variance that there is.
    fn correlation(&self) -> f64 {
        let (correlation, sigma) = (self.product / self.square.max(1.0), 1.0 / self.count.max(1.0).sqrt());
        correlation.min(MOST_CORRELATION) * (correlation / sigma - SURE.0).clamp(0.0, SURE.1) / SURE.1
    }
}

impl Default for Fit {
    fn default() -> Self {
        Self { square: 1.0, mean: [0.0; 3], last: None, seen_s: 0.0, colour: Colour::default() }
    }
}

impl Fit {
    /// Takes the innovation of a measurement of `m` components: its normalised square, and each component with its variance;
    /// and whether no marker was seen lately.
    pub(crate) fn take(
        &mut self,
        t: MonoTime,
        squared: f64,
        innovation: &[f64; MAX_MEASURED],
        var: &[f64; MAX_MEASURED],
        m: usize,
        is_blind: bool,
    ) {
        let since_s = self.last.map_or(0.0, |last| (t - last).s().clamp(0.0, LONGEST_S));
        self.last = Some(t);
        if !squared.is_finite() {
            return;
        }
        self.seen_s += since_s;
        let gain = 1.0 - (-since_s / OVER_S).exp();
        self.square += gain * ((squared / m as f64).min(MOST) - self.square);
        let mut ones = [0.0; 3];
        for i in 0..m.min(3) {
            let one = (innovation[i] / var[i].sqrt()).clamp(-MOST.sqrt(), MOST.sqrt());
            self.mean[i] += gain * (one - self.mean[i]);
            ones[i] = (one - self.mean[i]).clamp(-COLOUR_MOST, COLOUR_MOST);
        }
        if self.seen_s > SETTLED_S && since_s > 0.0 && !is_blind {
            self.colour.take(&ones[..m.min(3)], m.min(3) as f64 * OVER_S / since_s);
        }
    }

    /// Factor on the noise of this source by which successive errors that are alike count: `(1 + ρ)/(1 − ρ)`, the ratio of the
    /// variance of a mean of a first-order autoregressive sequence to that of a white one.
    pub(crate) fn colour_factor(&self) -> f64 {
        let correlation = self.colour.correlation();
        (1.0 + correlation) / (1.0 - correlation)
    }

    /// Factor on the reported variances of what this source measures: one where it fits.
    pub(crate) fn inflation(&self) -> f64 {
        (self.square / INFLATE).max(1.0)
    }

    /// The misfit to report; `noise_factor` is the factor by which its noise was already found larger than configured.
    pub(crate) fn misfit(&self, noise_factor: f64) -> Option<(MisfitCause, f64)> {
        if self.seen_s < SEEN_S {
            return None;
        }
        let square = self.square * noise_factor.max(1.0);
        let mean = self.mean.into_iter().max_by(|a, b| a.abs().total_cmp(&b.abs())).unwrap_or(0.0);
        if square > TELL {
            Some((MisfitCause::Noise, square))
        } else if mean.abs() > TELL_MEAN {
            Some((MisfitCause::Bias, mean))
        } else {
            None
        }
    }
}

impl State {
    /// Factor on the noise of a source whose successive errors are alike; one where they are not. Without a marker, innovations
    /// are correlated by what the filter does not know of tilt and forces: they show nothing of the source then.
    pub(crate) fn colour_factor(&self, source: FusionSource) -> f64 {
        if self.is_blind() {
            return 1.0;
        }
        let fits = WATCHED.iter().zip(&self.fits);
        fits.filter(|(watched, _)| **watched == source)
            .map(|(_, fit)| fit.colour_factor())
            .fold(1.0, f64::max)
    }

    /// Factors on the reported variances of position, velocity and attitude: one where their sources fit.
    pub(crate) fn misfit_factors(&self) -> [f64; 3] {
        let of = |sources: &[FusionSource]| {
            let fits = WATCHED.iter().zip(&self.fits).filter(|(source, _)| sources.contains(source));
            fits.map(|(_, fit)| fit.inflation()).fold(1.0, f64::max)
        };
        [
            of(&[FusionSource::GpsPosition]),
            of(&[FusionSource::GpsVelocity]),
            of(&[
                FusionSource::CompassHeading,
                FusionSource::CompassTilt,
                FusionSource::AttitudeHeading,
                FusionSource::AttitudeTilt,
            ]),
        ]
    }
}

impl Core {
    /// Sources of own motion that do not fit their configured accuracy: the cause, and the figure that shows it.
    pub(crate) fn misfits(&self) -> impl Iterator<Item = (FusionSource, MisfitCause, f64)> {
        let Core { state, learning, .. } = self;
        let (now, start) = (&state.learnt, &learning.start);
        let noise_factors = [
            now.gps_factor,
            now.gps_velocity_factor,
            now.heading_var[COMPASS] / start.heading_var[COMPASS],
            now.tilt_var[COMPASS] / start.tilt_var[COMPASS],
            now.heading_var[SECOND] / start.heading_var[SECOND],
            now.tilt_var[SECOND] / start.tilt_var[SECOND],
            1.0,
            now.force_factor,
        ];
        let kinds = [FusionSource::CompassTilt, FusionSource::AttitudeTilt].into_iter().zip(&state.tilt);
        let kinds = kinds.filter_map(|(source, watch)| {
            let felt = watch.found().filter(|_| watch.is_misnamed())?;
            Some((source, MisfitCause::TiltKind(felt), watch.slope()))
        });
        let fits = WATCHED.into_iter().zip(&state.fits).zip(noise_factors);
        let noise = fits.filter_map(|((source, fit), factor)| {
            fit.misfit(factor).map(|(cause, figure)| (source, cause, figure))
        });
        kinds.chain(noise)
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use rand_distr::{Distribution, StandardNormal};
    use windhover_base::time::Span;

    use super::*;

    /// Feeds innovations of two components at 5 Hz for a minute; `next` makes each from the one before.
    fn taken(mut next: impl FnMut(u32, &mut [f64])) -> Fit {
        let (mut fit, mut innovation) = (Fit::default(), [0.0; MAX_MEASURED]);
        for k in 0..300 {
            next(k, &mut innovation[..2]);
            let squared = innovation[0].powi(2) + innovation[1].powi(2);
            let t = MonoTime::from_ns(1_000_000_000) + Span::from_s(0.2 * f64::from(k));
            fit.take(t, squared, &innovation, &[1.0; MAX_MEASURED], 2, false);
        }
        fit
    }

    /// Innovations of a sigma this large and a mean this large.
    fn fed(sigma: f64, mean: f64) -> Fit {
        taken(|k, innovation| {
            // Two components of a deterministic sequence of unit variance.
            let angle = 2.4 * f64::from(k);
            innovation[0] = mean + sigma * 2f64.sqrt() * angle.sin();
            innovation[1] = mean + sigma * 2f64.sqrt() * angle.cos();
        })
    }

    /// A first-order autoregressive sequence of unit variance with this correlation.
    fn coloured(correlation: f64) -> Fit {
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        taken(|_, innovation| {
            for one in innovation {
                let new: f64 = StandardNormal.sample(&mut rng);
                *one = correlation * *one + (1.0 - correlation * correlation).sqrt() * new;
            }
        })
    }

    #[test]
    fn what_fits_is_not_spoken_of() {
        let fit = fed(1.0, 0.0);
        assert!(fit.misfit(1.0).is_none() && fit.inflation() == 1.0, "{fit:?}");
    }

    #[test]
    fn noise_and_bias_are_reported_with_their_figures() {
        let noisy = fed(2.0, 0.0);
        let (cause, figure) = noisy.misfit(1.0).expect("twice the noise");
        assert!(cause == MisfitCause::Noise && (3.0..4.2).contains(&figure), "{figure}");
        assert!(noisy.inflation() > 2.0);
        let (cause, figure) = fed(0.5, -1.0).misfit(1.0).expect("off to one side");
        assert!(cause == MisfitCause::Bias && (-1.0..-0.8).contains(&figure), "{figure}");
        // The noise that the filter has learnt counts too.
        assert!(fed(1.0, 0.0).misfit(4.0).is_some());
    }

    #[test]
    fn innovations_that_are_alike_enlarge_the_noise_and_white_ones_do_not() {
        for white in [fed(1.0, 0.0), fed(2.0, 0.0), fed(0.5, -1.0), coloured(0.0), coloured(-0.4)] {
            assert_eq!(white.colour_factor(), 1.0, "{white:?}");
        }
        // (1 + ρ)/(1 − ρ) of 0.4 and of the most that is believed, 0.6.
        assert!((1.6..3.2).contains(&coloured(0.4).colour_factor()), "{}", coloured(0.4).colour_factor());
        assert_eq!(coloured(0.95).colour_factor(), 4.0);
    }

    #[test]
    fn a_single_wild_measurement_says_nothing() {
        let mut fit = fed(1.0, 0.0);
        let t = MonoTime::from_ns(62_000_000_000);
        fit.take(t, 1e9, &[1e4; MAX_MEASURED], &[1.0; MAX_MEASURED], 2, false);
        assert!(fit.misfit(1.0).is_none(), "{fit:?}");
    }
}
