//! Which target a marker belongs to, and markers that are seen at two places of one frame.

use windhover_base::msg::{FrameObservations, MarkerDetection, MarkerId};
use windhover_base::settings::{MarkerConfig, Rig, TargetConfig};
use windhover_base::time::{MonoTime, Span};

use super::misfit_words::marker_name;

/// The same marker is reported again no sooner than after this time.
const AGAIN: Span = Span::from_ns(10_000_000_000);

/// The markers of a rig, as they are seen.
pub(super) struct SeenMarkers {
    rig: Rig,
    /// Markers seen twice, and when each was last reported.
    reported: Vec<(MarkerId, MonoTime)>,
}

impl SeenMarkers {
    pub(super) fn new(rig: &Rig) -> Self {
        Self { rig: rig.clone(), reported: Vec::new() }
    }

    /// Index of the target that a detection belongs to.
    pub(super) fn target_of(&self, seen: &MarkerDetection) -> Option<usize> {
        self.place_of(seen.marker).map(|(target, _)| target)
    }

    /// Indices of target and marker in the configuration.
    fn place_of(&self, marker: MarkerId) -> Option<(usize, usize)> {
        match marker {
            MarkerId::Disc { target, marker } => Some((target, marker)),
            MarkerId::Tag { family, id } => {
                let is_it = |m: &MarkerConfig| m.family == Some(family) && m.id == Some(id);
                let of = |target: &TargetConfig| target.marker.iter().position(is_it);
                let found = |(index, target)| Some((index, of(target)?));
                self.rig.target.iter().enumerate().find_map(found)
            }
        }
    }

    /// The report of target markers that are seen more than once in a frame.
    pub(super) fn twice(&mut self, frame: &FrameObservations, now: MonoTime) -> Vec<String> {
        let mut words = Vec::new();
        for (number, first) in frame.markers.iter().enumerate() {
            let again = frame.markers[number + 1..].iter().find(|other| other.marker == first.marker);
            let (Some(again), Some((target, marker))) = (again, self.place_of(first.marker)) else {
                continue;
            };
            if self.is_news(first.marker, now) {
                words.push(format!(
                    "{} of {} is seen twice in frame {}, {:.0} px apart: something else carries the same marker, \
                     or mirrors it",
                    marker_name(&self.rig, target, marker),
                    self.rig.target[target].name,
                    frame.frame,
                    (again.center_px - first.center_px).norm()
                ));
            }
        }
        words
    }

    fn is_news(&mut self, marker: MarkerId, now: MonoTime) -> bool {
        match self.reported.iter_mut().find(|(of, _)| *of == marker) {
            Some((_, last)) if now - *last < AGAIN => false,
            Some((_, last)) => {
                *last = now;
                true
            }
            None => {
                self.reported.push((marker, now));
                true
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix2, Vector2};

    use super::*;
    use crate::config::Config;
    use windhover_base::msg::TagFamily;

    fn tag(id: u32, u: f64) -> MarkerDetection {
        MarkerDetection {
            marker: MarkerId::Tag { family: TagFamily::Tag36h11, id },
            center_px: Vector2::new(u, 100.0),
            center_cov_px2: Matrix2::identity(),
            corners_px: None,
            corner_cov_px2: [Matrix2::zeros(); 4],
            hamming: 0,
            margin: 50.0,
            size_px: 40.0,
        }
    }

    #[test]
    fn a_marker_at_two_places_is_reported_every_ten_seconds() {
        let config = Config::parse(include_str!("../../config/windhover.toml")).expect("valid");
        let mut seen = SeenMarkers::new(&config.rig());
        let at = |s: f64| MonoTime::from_ns(0) + Span::from_s(s);
        let frame = |markers| FrameObservations { frame: 7, markers, features: Vec::new() };
        assert!(seen.twice(&frame(vec![tag(0, 10.0), tag(1, 300.0)]), at(0.0)).is_empty());
        let doubled = frame(vec![tag(0, 10.0), tag(1, 300.0), tag(0, 350.0)]);
        let words = seen.twice(&doubled, at(1.0));
        assert!(
            words.len() == 1 && words[0].starts_with("tag 0 of ugv is seen twice in frame 7, 340 px"),
            "{words:?}"
        );
        assert!(seen.twice(&doubled, at(5.0)).is_empty());
        assert_eq!(seen.twice(&doubled, at(11.0)).len(), 1);
        // Tags that belong to no target are not reported.
        assert!(seen.twice(&frame(vec![tag(99, 10.0), tag(99, 300.0)]), at(20.0)).is_empty());
    }
}
