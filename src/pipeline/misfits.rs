//! Misfits as they are reported to the operator: once, again when the figure has changed, and ended when they are not
//! found any more.

use std::mem::discriminant;

use super::misfit_words::words;
use windhover_base::msg::{MarkerPair, Misfit, MisfitCause, MisfitWords};
use windhover_base::settings::Rig;
use windhover_base::time::{MonoTime, Span};

/// A misfit that was not found for this long has ended.
const OVER: Span = Span::from_ns(10_000_000_000);
/// The same misfit is reported again no sooner than after this.
const AGAIN: Span = Span::from_ns(10_000_000_000);
/// … and only if its figure has changed by this share of its distance from the figure of a perfect fit.
const CHANGED: f64 = 0.25;

/// All present misfits.
pub(super) struct Misfits {
    rig: Rig,
    found: Vec<Found>,
}

struct Found {
    misfit: Misfit,
    last: MonoTime,
    reported: MonoTime,
    reported_figure: f64,
}

impl Misfits {
    /// For this rig, without misfits.
    pub(super) fn new(rig: &Rig) -> Self {
        Self { rig: rig.clone(), found: Vec::new() }
    }

    /// Takes a misfit that the filter found; returns its texts if it is to be reported.
    pub(super) fn take(&mut self, misfit: &Misfit, now: MonoTime) -> Option<MisfitWords> {
        self.forget(now);
        match self.found.iter_mut().find(|found| same(&found.misfit, misfit)) {
            Some(found) => {
                (found.misfit, found.last) = (*misfit, now);
                let moved = (misfit.figure - found.reported_figure).abs();
                let off = (found.reported_figure - where_it_fits(misfit.cause)).abs();
                if now - found.reported < AGAIN || moved <= CHANGED * off {
                    return None;
                }
                (found.reported, found.reported_figure) = (now, misfit.figure);
            }
            None => {
                let (last, reported, reported_figure) = (now, now, misfit.figure);
                self.found.push(Found { misfit: *misfit, last, reported, reported_figure });
            }
        }
        Some(words(misfit, &self.rig))
    }

    /// The present misfits, the longest known first.
    pub(super) fn now(&mut self, now: MonoTime) -> Vec<MisfitWords> {
        self.forget(now);
        self.found.iter().map(|found| words(&found.misfit, &self.rig)).collect()
    }

    fn forget(&mut self, now: MonoTime) {
        self.found.retain(|found| now - found.last <= OVER);
    }
}

/// Whether two are the same misfit, whatever the figure.
fn same(a: &Misfit, b: &Misfit) -> bool {
    a.source == b.source
        && discriminant(&a.cause) == discriminant(&b.cause)
        && place(a.cause) == place(b.cause)
}

/// The target, and its marker, to which a cause belongs.
const fn place(cause: MisfitCause) -> (Option<usize>, Option<usize>) {
    match cause {
        MisfitCause::MarkerSize(MarkerPair { target, marker, .. })
        | MisfitCause::MarkerPlace(MarkerPair { target, marker, .. })
        | MisfitCause::MarkerTurn(MarkerPair { target, marker, .. }) => (Some(target), Some(marker)),
        MisfitCause::TargetTurns { target }
        | MisfitCause::TargetSways { target }
        | MisfitCause::TargetSlides { target } => (Some(target), None),
        _ => (None, None),
    }
}

/// The figure of a perfect fit: one for a ratio, zero for a difference.
const fn where_it_fits(cause: MisfitCause) -> f64 {
    match cause {
        MisfitCause::TiltKind(_)
        | MisfitCause::Noise
        | MisfitCause::MarkerSize(_)
        | MisfitCause::Wanders
        | MisfitCause::TargetTurns { .. }
        | MisfitCause::TargetSlides { .. } => 1.0,
        _ => 0.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;
    use windhover_base::msg::{FeltTilt, FusionSource};
    use windhover_base::settings::TiltKind;

    fn rig() -> Rig {
        Config::parse(include_str!("../../config/windhover.toml")).expect("the shipped configuration").rig()
    }

    fn at(s: f64) -> MonoTime {
        MonoTime::from_ns(0) + Span::from_s(s)
    }

    fn misfit(source: FusionSource, cause: MisfitCause, figure: f64) -> Misfit {
        Misfit { t: at(0.0), source, figure, cause }
    }

    #[test]
    fn it_is_reported_once_again_where_it_changes_and_is_over_when_it_is_not_found() {
        let mut misfits = Misfits::new(&rig());
        let noise = |figure| misfit(FusionSource::GpsVelocity, MisfitCause::Noise, figure);
        let reports: Vec<f64> = (0..40)
            .map(f64::from)
            .filter(|s| misfits.take(&noise(if *s < 20.0 { 3.0 } else { 4.0 }), at(*s)).is_some())
            .collect();
        assert_eq!(reports, [0.0, 20.0], "found every second for forty");
        assert_eq!(misfits.now(at(49.0)).len(), 1);
        assert!(misfits.now(at(49.5)).is_empty(), "not found for more than ten seconds");
        assert!(misfits.take(&noise(4.0), at(60.0)).is_some(), "it is news again");
    }

    #[test]
    fn every_source_and_marker_is_reported_for_itself() {
        let mut misfits = Misfits::new(&rig());
        let size = |marker| MisfitCause::MarkerSize(MarkerPair { target: 0, marker, against: 1 - marker });
        for one in [
            misfit(FusionSource::GpsVelocity, MisfitCause::Noise, 3.0),
            misfit(FusionSource::GpsPosition, MisfitCause::Noise, 3.0),
            misfit(FusionSource::GpsPosition, MisfitCause::Bias, 0.9),
            misfit(FusionSource::Marker, size(0), 1.05),
            misfit(FusionSource::Marker, size(1), 0.95),
        ] {
            assert!(misfits.take(&one, at(0.0)).is_some(), "{one:?}");
            assert!(misfits.take(&one, at(1.0)).is_none(), "{one:?}");
        }
        assert_eq!(misfits.now(at(1.0)).len(), 5);
    }

    #[test]
    fn words_name_source_figure_cause_and_what_to_do() {
        let mut rig = rig();
        rig.compass.tilt = TiltKind::Gravity;
        let said = |source, cause, figure| words(&misfit(source, cause, figure), &rig);
        let pair = MarkerPair { target: 0, marker: 1, against: 0 };
        let size = said(FusionSource::Marker, MisfitCause::MarkerSize(pair), 0.95);
        assert_eq!((size.source.as_str(), size.figure.as_str()), ("ugv tag 1", "-5.0 %"));
        assert_eq!(size.cause, "tag 1 is 5.0 % smaller than configured, measured against tag 0");
        assert!(size.advice.contains("0.456 m"), "{}", size.advice);
        let tilt = said(FusionSource::CompassTilt, MisfitCause::TiltKind(FeltTilt::Attitude), 0.753);
        assert_eq!((tilt.source.as_str(), tilt.figure.as_str()), ("compass.tilt", "slope 0.75"));
        assert!(tilt.cause.contains("AHRS") && tilt.cause.contains("gravity"), "{}", tilt.cause);
        assert_eq!(tilt.advice, "set compass.tilt = \"inertial\"");
        let turn = said(FusionSource::Marker, MisfitCause::MarkerTurn(pair), 0.087_266);
        assert_eq!(turn.figure, "5.0 deg");
        let late = said(FusionSource::Feature, MisfitCause::Late, 0.04);
        assert_eq!(
            (late.figure.as_str(), late.advice.as_str()),
            ("40 ms", "change camera.exposure_offset_ms by -40")
        );
        let height = said(FusionSource::Marker, MisfitCause::Height, 10.04);
        assert!(height.cause.contains("10.0 m higher") && height.source == "ground", "{height:?}");
    }
}
