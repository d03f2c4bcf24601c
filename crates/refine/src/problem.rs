//! The least-squares problem: every block of a knot at the present values.

use windhover_base::geo::wrap_angle;
use windhover_base::msg::{FixKind, GnssEpoch, MarkerId};
use windhover_base::time::MonoTime;
use windhover_estimate::batch::Predictor;

use crate::block::{Block, Noise, Source};
use crate::front::{Front, Shape};
use crate::measure::{self, Instant, Lens, Rows};
use crate::motion::{Link, Processes, Pushed};
use crate::plan::{Plan, Stop};
use crate::recording::Recording;
use crate::surveyed::ControlPoint;
use crate::unknowns::{Place, Prior, constant, rig_offsets};
use crate::values::{Aside, Knot, Values};

/// The measurements and priors. Nothing here changes during the solution.
pub(crate) struct Problem<'a> {
    pub(crate) recordings: &'a [Recording],
    pub(crate) plan: Plan,
    pub(crate) shape: Shape,
    pub(crate) priors: Vec<Prior>,
    pub(crate) places: Vec<Place>,
    pub(crate) outside_places: Vec<Place>,
    pub(crate) targets: usize,
    /// Whether each target moves.
    pub(crate) moves: Vec<bool>,
    /// Height of the markers of each target that sways on its springs, m.
    pub(crate) sways: Vec<Option<f64>>,
    pub(crate) processes: Processes,
    /// Markers at known positions, of each recording.
    pub(crate) control_points: Vec<Vec<ControlPoint>>,
    /// Landmarks that were found not to be on the ground.
    pub(crate) dropped: Vec<bool>,
    /// Variance of the tilt readings' slow error that is not estimated, rad²: of attitude about north and east.
    pub(crate) considered_tilt_var: f64,
    /// Where the camera is configured to be in the body, m.
    pub(crate) camera_at: nalgebra::Vector3<f64>,
    pub(crate) gates: [f64; 9],
    /// Knots of a segment, of which all eliminations are kept at once.
    pub(crate) segment_len: usize,
}

impl Problem<'_> {
    /// Number of segments.
    pub(crate) fn segments(&self) -> usize {
        self.plan.stops.len().div_ceil(self.segment_len)
    }

    /// Knots of a segment.
    pub(crate) fn segment(&self, index: usize) -> std::ops::Range<usize> {
        let first = index * self.segment_len;
        first..(first + self.segment_len).min(self.plan.stops.len())
    }

    /// Whether the frame at a knot has a displacement of its own.
    pub(crate) fn is_displaced(&self, k: usize) -> bool {
        self.shape.shake > 0 && self.plan.stops[k].frame.is_some()
    }

    /// A knot's state at a measurement's time, `dt` after it.
    pub(crate) fn instant<'b>(
        &'b self,
        k: usize,
        state: &'b Knot,
        pushed: &'b Pushed,
        dt: f64,
        estimated: &'b [bool],
    ) -> Instant<'b> {
        let (shape, places) = (self.shape, &self.places[..]);
        Instant { state, pushed, dt, at: shape.knot_at(k), landmark_at: 0, shape, places, estimated }
    }
}

/// The measurement of a block.
#[derive(Clone, Copy, PartialEq, Debug)]
pub(crate) struct Origin {
    pub(crate) source: Source,
    pub(crate) marker: Option<MarkerId>,
    pub(crate) landmark: Option<usize>,
}

impl Origin {
    pub(crate) const fn of(source: Source) -> Self {
        Self { source, marker: None, landmark: None }
    }
}

/// Memory for the arithmetic of one pass.
pub(crate) struct Pass<'a> {
    pub(crate) problem: &'a Problem<'a>,
    pub(crate) predictor: Predictor,
    pub(crate) rows: Rows,
    pub(crate) block: Block,
    pub(crate) means: Vec<f64>,
    pub(crate) estimated: Vec<bool>,
    pub(crate) pushed: Vec<Pushed>,
    pub(crate) lens: Lens,
}

impl<'a> Pass<'a> {
    pub(crate) fn new(problem: &'a Problem<'a>, predictor: Predictor) -> Self {
        let estimated = problem.priors.iter().map(Prior::is_estimated).collect();
        let lens = Lens {
            principal_px: predictor.principal_point(),
            height_px: predictor.image_height_px(),
            camera_at: problem.camera_at,
            readout_s: 0.0,
        };
        Self {
            rows: Rows::new(problem.shape),
            block: Block::default(),
            means: vec![0.0; predictor.len()],
            estimated,
            pushed: Vec::with_capacity(problem.plan.stops.len()),
            lens,
            predictor,
            problem,
        }
    }

    /// Prepares a pass at these values.
    pub(crate) fn begin(&mut self, values: &Values) {
        let offsets = rig_offsets(&values.constants);
        self.predictor.put_rig(&offsets);
        self.lens.camera_at = self.problem.camera_at + offsets.camera_at;
        self.lens.readout_s = self.predictor.readout_s() + offsets.readout_s;
        self.pushed.clear();
        for state in &values.knots {
            values.put(state, &Aside::NONE, &self.problem.places, &mut self.means, &mut self.predictor);
            self.pushed.push(self.predictor.acceleration());
        }
    }

    /// Adds the priors of the constants.
    pub(crate) fn constants(&self, values: &Values, front: &mut Front) -> f64 {
        let mut cost = 0.0;
        for (i, (prior, value)) in self.problem.priors.iter().zip(&values.constants).enumerate() {
            let column = self.problem.shape.constants_at() + i;
            if prior.is_estimated() {
                let information = prior.sigma.powi(-2);
                front.add_prior(column, information, prior.mean - value);
                cost += (prior.mean - value).powi(2) * information;
            } else {
                front.add_prior(column, 1.0, 0.0);
            }
        }
        cost
    }

    /// Passes on every block of knot `k`: its measurements, and the step to the next knot.
    pub(crate) fn blocks(
        &mut self,
        k: usize,
        values: &Values,
        noise: &Noise,
        take: &mut dyn FnMut(Origin, &Block),
    ) {
        self.epochs(k, values, noise, take);
        self.positions(k, values, take);
        self.surveyed(k, values, take);
        self.readings(k, values, noise, take);
        self.frame(k, values, noise, take);
        self.link(k, values, noise, take);
    }

    fn link(&mut self, k: usize, values: &Values, noise: &Noise, take: &mut dyn FnMut(Origin, &Block)) {
        let problem = self.problem;
        let Some(next) = problem.plan.stops.get(k + 1).filter(|next| !next.begins) else { return };
        let stop = &problem.plan.stops[k];
        let link = Link {
            from: &values.knots[k],
            to: &values.knots[k + 1],
            pushed: (&self.pushed[k], &self.pushed[k + 1]),
            h: (next.t - stop.t).s(),
            at: (problem.shape.knot_at(k), problem.shape.knot_at(k + 1)),
            shape: problem.shape,
            places: &problem.places,
            noise,
            window: stop.window,
            processes: &problem.processes,
        };
        let mut take = |source: Source, block: &Block| take(Origin::of(source), block);
        link.blocks(&mut self.block, &mut take);
        for target in 0..problem.targets {
            if stop.held[target] && next.held[target] && !next.taken_up[target] {
                link.target(target, problem.moves[target], &mut self.block, &mut take);
                if let Some(height_m) = problem.sways[target] {
                    link.sway(target, height_m, &mut self.block, &mut take);
                }
            }
        }
    }

    /// How long after a knot something was at this time by its own clock, s: knots are at the exposures of frames, which are
    /// earlier than their stamps by the camera's delay.
    pub(crate) fn after_knot(stop: &Stop, t: MonoTime, values: &Values) -> f64 {
        (t - stop.t).s() + values.constants[constant::CAMERA_DELAY]
    }

    /// The knot's state `dt` later.
    pub(crate) fn state_at(&self, k: usize, values: &Values, dt: f64) -> Knot {
        let state = &values.knots[k];
        if dt == 0.0 { state.clone() } else { state.after(dt, &self.pushed[k].0) }
    }

    /// Acceleration at a knot.
    pub(crate) fn pushed_at(&self, k: usize) -> &Pushed {
        &self.pushed[k]
    }

    fn epochs(&mut self, k: usize, values: &Values, noise: &Noise, take: &mut dyn FnMut(Origin, &Block)) {
        let problem = self.problem;
        let stop = &problem.plan.stops[k];
        for &index in &stop.epochs {
            let epoch = &problem.recordings[stop.flight].epochs[index];
            let dt = Self::after_knot(stop, epoch.t_valid, values);
            let state = self.state_at(k, values, dt);
            for source in [Source::GpsVelocity, Source::GpsPosition] {
                values.put(&state, &Aside::NONE, &problem.places, &mut self.means, &mut self.predictor);
                let linear = match source {
                    Source::GpsVelocity => self.predictor.gps_velocity(&epoch.value),
                    _ => self.predictor.gps_position(&epoch.value),
                };
                let Some(linear) = linear.filter(|linear| linear.is_finite()) else { continue };
                let instant = problem.instant(k, &state, &self.pushed[k], dt, &self.estimated);
                let flows = instant.write(&linear, &mut self.rows);
                instant.timed(&flows, constant::CAMERA_DELAY, 1.0, &mut self.rows);
                instant.antenna(&linear, &mut self.rows);
                let residual: Vec<f64> = (0..linear.len()).map(|i| linear.residual(i)).collect();
                let (noise, factor) = (|a, b| linear.noise(a, b), noise.of(source));
                if measure::finish(&self.rows, noise, &residual, factor, &mut self.block) {
                    take(Origin::of(source), &self.block);
                }
            }
        }
    }

    /// Control points, where the estimation of their target begins: it does not move.
    fn surveyed(&mut self, k: usize, values: &Values, take: &mut dyn FnMut(Origin, &Block)) {
        let problem = self.problem;
        let (stop, at) = (&problem.plan.stops[k], problem.shape.knot_at(k));
        for point in problem.control_points[stop.flight].iter().filter(|p| stop.taken_up[p.target]) {
            point.write(&values.knots[k], values, (problem.shape, at), &mut self.block);
            take(Origin::of(Source::Outside), &self.block);
        }
    }

    fn positions(&mut self, k: usize, values: &Values, take: &mut dyn FnMut(Origin, &Block)) {
        let problem = self.problem;
        let (stop, places) = (&problem.plan.stops[k], &problem.outside_places[..]);
        for &index in &stop.positions {
            let outside = &problem.recordings[stop.flight].positions[index];
            let dt = Self::after_knot(stop, outside.t, values);
            let state = self.state_at(k, values, dt);
            values.put(&state, &Aside::NONE, places, &mut self.means, &mut self.predictor);
            let epoch = GnssEpoch {
                fix: FixKind::ThreeD,
                lat_deg: Some(outside.at.lat_deg),
                lon_deg: Some(outside.at.lon_deg),
                alt_msl_m: Some(outside.at.height_m),
                ..GnssEpoch::default()
            };
            let linear = self.predictor.gps_position(&epoch).filter(|linear| linear.is_finite());
            let Some(linear) = linear else { continue };
            let mut instant = problem.instant(k, &state, &self.pushed[k], dt, &self.estimated);
            instant.places = places;
            let flows = instant.write(&linear, &mut self.rows);
            instant.timed(&flows, constant::CAMERA_DELAY, 1.0, &mut self.rows);
            instant.antenna(&linear, &mut self.rows);
            let residual: Vec<f64> = (0..linear.len()).map(|i| linear.residual(i)).collect();
            let var = |a: usize, b: usize| if a == b { outside.sigma_m[a].powi(2) } else { 0.0 };
            if measure::finish(&self.rows, var, &residual, 1.0, &mut self.block) {
                take(Origin::of(Source::Outside), &self.block);
            }
        }
    }

    fn readings(&mut self, k: usize, values: &Values, noise: &Noise, take: &mut dyn FnMut(Origin, &Block)) {
        let problem = self.problem;
        let stop = &problem.plan.stops[k];
        let late_s = values.constants[constant::COMPASS_DELAY];
        for &index in &stop.readings {
            let reading = &problem.recordings[stop.flight].readings[index];
            let dt = Self::after_knot(stop, reading.t_valid, values) - late_s;
            let state = self.state_at(k, values, dt);
            let forward = state.attitude.matrix().column(0).into_owned();
            let iron = measure::iron(forward.y.atan2(forward.x));
            for source in [Source::Heading, Source::Tilt] {
                values.put(&state, &Aside::NONE, &problem.places, &mut self.means, &mut self.predictor);
                let linear = match source {
                    Source::Heading => self.predictor.heading(&reading.value),
                    _ => self.predictor.tilt(&reading.value),
                };
                let Some(linear) = linear.filter(|linear| linear.is_finite()) else { continue };
                let instant = problem.instant(k, &state, &self.pushed[k], dt, &self.estimated);
                let flows = instant.write(&linear, &mut self.rows);
                let mut residual: Vec<f64> = (0..linear.len()).map(|i| linear.residual(i)).collect();
                instant.timed(&flows, constant::CAMERA_DELAY, 1.0, &mut self.rows);
                instant.timed(&flows, constant::COMPASS_DELAY, -1.0, &mut self.rows);
                if source == Source::Heading {
                    for (i, by) in iron.iter().enumerate() {
                        residual[0] -= by * values.constants[constant::IRON + i];
                        instant.constant(0, constant::IRON + i, *by, &mut self.rows);
                    }
                    residual[0] = wrap_angle(residual[0]);
                }
                let (noise, factor) = (|a, b| linear.noise(a, b), noise.of(source));
                if measure::finish(&self.rows, noise, &residual, factor, &mut self.block) {
                    take(Origin::of(source), &self.block);
                }
            }
        }
    }
}
