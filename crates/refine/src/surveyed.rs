//! Markers at rest whose positions are known: control points.
//!
//! A marker at (x, y) of a target at north N, east E and heading ψ is at `N + x cos ψ − y sin ψ`, `E + x sin ψ + y cos ψ`.
//! Its height is not used: targets stand on the ground of the configuration.

use windhover_base::geo::LocalFrame;
use windhover_base::settings::Rig;
use windhover_estimate::batch::{Predictor, TAG_COLUMNS};

use crate::block::Block;
use crate::front::Shape;
use crate::recording::Recording;
use crate::unknowns::{Prior, constant, knot};
use crate::values::{Knot, Values};

/// A control point of one flight.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(crate) struct ControlPoint {
    pub(crate) target: usize,
    /// In the target's frame as configured, forward and right, m.
    point: [f64; 2],
    /// The first constant of its tag, and whether its place is estimated.
    tag: Option<(usize, bool)>,
    /// Where it is, north and east, m, and one sigma.
    place: [f64; 2],
    sigma_m: f64,
}

/// The control points of each recording.
pub(crate) fn control_points(
    rig: &Rig,
    predictor: &Predictor,
    frame: &LocalFrame,
    recordings: &[Recording],
    priors: &[Prior],
) -> Vec<Vec<ControlPoint>> {
    let tags = predictor.tags();
    let of_recording = |recording: &Recording| {
        let points = recording.surveyed.iter().filter_map(|surveyed| {
            let (target, marker) = predictor.find(surveyed.marker)?;
            let [x, y, _] = rig.target.get(target)?.marker.get(marker)?.position_m;
            let tag = tags.iter().position(|tag| *tag == (target, marker)).map(|slot| {
                let first = constant::TAGS + TAG_COLUMNS * slot;
                (first, priors[first + 1].is_estimated())
            });
            let ned = frame.ned(surveyed.at);
            let place = [ned.x, ned.y];
            Some(ControlPoint { target, point: [x, y], tag, place, sigma_m: surveyed.sigma_m })
        });
        points.collect()
    };
    recordings.iter().map(of_recording).collect()
}

impl ControlPoint {
    /// Writes its rows at a knot whose unknowns begin at `at`.
    pub(crate) fn write(
        &self,
        state: &Knot,
        values: &Values,
        (shape, at): (Shape, usize),
        block: &mut Block,
    ) {
        let t = state.target(self.target);
        let (s, c) = t[knot::HEADING].sin_cos();
        let [mut x, mut y] = self.point;
        if let Some((first, _)) = self.tag {
            (x, y) = (x + values.constants[first + 1], y + values.constants[first + 2]);
        }
        let from_axle = [c * x - s * y, s * x + c * y];
        let at = at + knot::target(self.target);
        let free = self.tag.filter(|(_, free)| *free).map(|(first, _)| shape.constants_at() + first + 1);
        block.begin(2);
        block.over(
            [at, at + 1, at + knot::HEADING].into_iter().chain(free.into_iter().flat_map(|i| [i, i + 1])),
        );
        let by = 1.0 / self.sigma_m;
        let turned = [-from_axle[1], from_axle[0]];
        let by_place = [[c, -s], [s, c]];
        for row in 0..2 {
            block.right[row] = by * (self.place[row] - t[row] - from_axle[row]);
            *block.at(row, row) = by;
            *block.at(row, 2) = by * turned[row];
            if free.is_some() {
                (0..2).for_each(|i| *block.at(row, 3 + i) = by * by_place[row][i]);
            }
        }
    }
}
