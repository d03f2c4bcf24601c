//! Rows of a frame: markers and ground features, and how a camera that shakes displaces them.
//!
//! Rows of a rolling shutter are exposed one after the other: every point is predicted from the knot's state at the time of its
//! own row. So what is absolute (time, the camera's mount against its attitude) remains as unknown as it is: a model that is
//! linear in that time would show it by what it leaves out.

use nalgebra::Vector2;

use windhover_base::msg::MarkerDetection;
use windhover_estimate::batch::SHAKE_NODES as NODES;

use crate::block::{Block, Noise, Source};
use crate::measure;
use crate::plan::FeatureSeen;
use crate::problem::{Origin, Pass};
use crate::values::{Aside, Values};

/// A point of the picture.
#[derive(Clone, Copy)]
enum Point<'a> {
    /// Of a marker on a vehicle.
    Marker { target: usize, seen: &'a MarkerDetection, i: usize },
    /// Of the ground, with the sigma of its pixel.
    Feature { place: usize, sigma_px: f64 },
}

/// Residuals and noise of the points of a block.
#[derive(Default)]
struct Points {
    residual: Vec<f64>,
    noise: Vec<[f64; 4]>,
}

impl Points {
    /// Covariance of two components: points are independent of each other.
    fn noise(&self, a: usize, b: usize) -> f64 {
        if a / 2 == b / 2 { self.noise[a / 2][2 * (a % 2) + b % 2] } else { 0.0 }
    }
}

impl Pass<'_> {
    pub(crate) fn frame(
        &mut self,
        k: usize,
        values: &Values,
        noise: &Noise,
        take: &mut dyn FnMut(Origin, &Block),
    ) {
        let problem = self.problem;
        let stop = &problem.plan.stops[k];
        let Some(index) = stop.frame else { return };
        let seen = &problem.recordings[stop.flight].frames[index].value;
        for marker in &seen.markers {
            let Some((target, _)) = self.predictor.find(marker.marker) else { continue };
            if stop.held[target] {
                self.marker(k, values, noise, (target, marker), take);
            }
        }
        for followed in stop.features.iter().filter(|followed| !problem.dropped[followed.landmark]) {
            let feature = &seen.features[followed.index];
            self.feature(k, values, noise, (followed, &feature.px, feature.sigma_px), take);
        }
        self.shake(k, values, noise, take);
    }

    fn marker(
        &mut self,
        k: usize,
        values: &Values,
        noise: &Noise,
        (target, seen): (usize, &MarkerDetection),
        take: &mut dyn FnMut(Origin, &Block),
    ) {
        let origin = Origin { marker: Some(seen.marker), ..Origin::of(Source::Marker(target)) };
        let aside = Aside { shake: values.shake(k), ..Aside::NONE };
        let px = self.predictor.marker_px(seen);
        self.rows.begin(2 * px.len());
        let mut points = Points::default();
        for (i, px) in px.iter().enumerate() {
            if self.point(k, values, &aside, (px, Point::Marker { target, seen, i }), &mut points).is_none() {
                return;
            }
        }
        let factor = noise.of(origin.source);
        let noise = |a, b| points.noise(a, b);
        if measure::finish(&self.rows, noise, &points.residual, factor, &mut self.block) {
            take(origin, &self.block);
        }
    }

    fn feature(
        &mut self,
        k: usize,
        values: &Values,
        noise: &Noise,
        (followed, px, sigma_px): (&FeatureSeen, &Vector2<f64>, f64),
        take: &mut dyn FnMut(Origin, &Block),
    ) {
        let FeatureSeen { landmark, place, .. } = *followed;
        let aside = Aside { landmark: values.landmarks[landmark], shake: values.shake(k) };
        self.rows.begin(2);
        let mut points = Points::default();
        if self.point(k, values, &aside, (px, Point::Feature { place, sigma_px }), &mut points).is_none() {
            return;
        }
        let (factor, noise) = (noise.of(Source::Feature), |a, b| points.noise(a, b));
        if measure::finish(&self.rows, noise, &points.residual, factor, &mut self.block) {
            take(Origin { landmark: Some(landmark), ..Origin::of(Source::Feature) }, &self.block);
        }
    }

    /// Writes the rows of one point, seen at `px`, behind those that are there; `None` where it cannot be in view.
    fn point(
        &mut self,
        k: usize,
        values: &Values,
        aside: &Aside,
        (px, point): (&Vector2<f64>, Point<'_>),
        points: &mut Points,
    ) -> Option<()> {
        let (problem, after_s) = (self.problem, self.lens.after_s(px.y));
        let state = self.state_at(k, values, after_s);
        values.put(&state, aside, &problem.places, &mut self.means, &mut self.predictor);
        let (linear, target) = match point {
            Point::Marker { target, seen, i } => (self.predictor.marker_point(seen, i), Some(target)),
            Point::Feature { sigma_px, .. } => (self.predictor.feature(px, sigma_px), None),
        };
        let linear = linear.filter(|linear| linear.is_finite())?;
        let mut instant = problem.instant(k, &state, &self.pushed[k], after_s, &self.estimated);
        if let Point::Feature { place, .. } = point {
            instant.landmark_at = problem.shape.landmark_at(place);
        }
        instant.write_point(
            &linear,
            points.residual.len(),
            target,
            (px, &aside.shake, &self.lens),
            &mut self.rows,
        );
        points.residual.extend([linear.residual(0), linear.residual(1)]);
        points.noise.push([(0, 0), (0, 1), (1, 0), (1, 1)].map(|(a, b)| linear.noise(a, b)));
        Some(())
    }

    /// What is known of a frame's displacement before it is seen: its variance, and how far it lasts from row to row.
    fn shake(&mut self, k: usize, values: &Values, noise: &Noise, take: &mut dyn FnMut(Origin, &Block)) {
        let shape = self.problem.shape;
        if shape.shake == 0 {
            return;
        }
        let (at, displaced) = (shape.shake_at(), values.shake(k));
        let kernel = self.predictor.shake_kernel();
        let figure = noise.of(Source::Shake);
        for first in [0, NODES] {
            let covariance = (0..NODES * NODES).map(|i| kernel[(i / NODES, i % NODES)] * figure).collect();
            self.displacement((at, first), &displaced[first..first + NODES], covariance);
            take(Origin::of(Source::Shake), &self.block);
        }
        let roll = 2 * NODES;
        self.displacement((at, roll), &displaced[roll..], vec![noise.of(Source::ShakeRoll)]);
        take(Origin::of(Source::ShakeRoll), &self.block);
    }

    /// Components of the displacement from `first` on, with zero as their expected value.
    fn displacement(&mut self, (at, first): (usize, usize), values: &[f64], mut covariance: Vec<f64>) {
        let block = &mut self.block;
        block.begin(values.len());
        block.over((0..values.len()).map(|i| at + first + i));
        for (i, value) in values.iter().enumerate() {
            *block.at(i, i) = 1.0;
            block.right[i] = -value;
        }
        let regular = block.whiten(&mut covariance);
        debug_assert!(regular, "a covariance over a positive variance");
    }
}
