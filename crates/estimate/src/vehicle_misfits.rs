//! What does not fit of the vehicles, their tags and the ground about them, as it is reported.

use windhover_base::msg::{FusionSource, MisfitCause};

use super::core::Core;
use super::state::State;

/// Markers over which the share of those outside the gate is kept (some five seconds of two tags), and the share beyond
/// which it is reported. A flight that fits has a few in a thousand, one with 3 % of gross errors 3 %.
const MARKERS: f64 = 100.0;
const OUTSIDE_SHARE: f64 = 0.12;
/// Share of the tracked features that move, beyond which it is reported.
const MOVING_SHARE: f64 = 0.2;

impl Core {
    /// What does not fit: its source, what it is, and the figure that shows it.
    pub(crate) fn vehicle_misfits(&self) -> impl Iterator<Item = (FusionSource, MisfitCause, f64)> {
        let state = &self.state;
        let height =
            state.height.placed.map(|(_, _, rise_m)| (FusionSource::Marker, MisfitCause::Height, rise_m));
        let share = state.moving_share;
        let moving =
            (share > MOVING_SHARE).then_some((FusionSource::Feature, MisfitCause::MovingGround, share));
        let turns = state.targets.iter().enumerate().filter(|(_, target)| target.spin.is_free());
        let turns = turns.map(|(target, track)| {
            (FusionSource::Marker, MisfitCause::TargetTurns { target }, track.spin.over_the_bound())
        });
        let targets = || state.targets.iter().enumerate();
        let sways = targets().filter_map(|(target, track)| {
            let sigma_m = track.sway.shown_m()?;
            Some((FusionSource::Marker, MisfitCause::TargetSways { target }, sigma_m))
        });
        let slides = targets().filter_map(|(target, track)| {
            let times = track.slip.shown().filter(|_| track.sway.shown_m().is_none())?;
            Some((FusionSource::Marker, MisfitCause::TargetSlides { target }, times))
        });
        let share = state.markers_outside;
        let outside = (share > OUTSIDE_SHARE).then_some((FusionSource::Marker, MisfitCause::Outside, share));
        height
            .into_iter()
            .chain(self.clock_misfit())
            .chain(self.antenna_misfit())
            .chain(self.low_pass_misfit())
            .chain(self.lens_misfit())
            .chain(self.readout_misfit())
            .chain(self.receiver_misfit())
            .chain(outside)
            .chain(moving)
            .chain(turns)
            .chain(sways)
            .chain(slides)
            .chain(self.tag_misfits())
    }
}

impl State {
    /// Keeps the share of markers outside the gate.
    pub(crate) fn note_marker(&mut self, outside: bool) {
        self.markers_outside += (f64::from(u8::from(outside)) - self.markers_outside) / MARKERS;
    }
}
