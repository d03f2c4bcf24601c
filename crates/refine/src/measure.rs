//! Rows of a knot's measurements: the filter's own models at the knot's state, propagated to the time of the
//! measurement, with the columns that only a whole flight can determine: delays, mount, places, focal length, read-out,
//! iron.

use nalgebra::{Vector2, Vector3};

use windhover_estimate::batch::{Linear, columns};

use crate::block::Block;
use crate::front::Shape;
use crate::motion::Pushed;
use crate::unknowns::{Place, constant, knot};
use crate::values::Knot;

/// A knot's state a time `dt` after it, where a measurement is predicted.
pub(crate) struct Instant<'a> {
    /// The state at that time.
    pub(crate) state: &'a Knot,
    /// Acceleration at the knot.
    pub(crate) pushed: &'a Pushed,
    pub(crate) dt: f64,
    /// InitialValues column of the knot, and of the landmark.
    pub(crate) at: usize,
    pub(crate) landmark_at: usize,
    pub(crate) shape: Shape,
    pub(crate) places: &'a [Place],
    pub(crate) estimated: &'a [bool],
}

/// Rows over every column of the front, of which few are not zero.
#[derive(Clone, Debug)]
pub(crate) struct Rows {
    width: usize,
    rows: Vec<f64>,
    touched: Vec<bool>,
}

impl Rows {
    pub(crate) fn new(shape: Shape) -> Self {
        Self { width: shape.len(), rows: Vec::new(), touched: vec![false; shape.len()] }
    }

    pub(crate) fn begin(&mut self, m: usize) {
        self.rows.clear();
        self.rows.resize(m * self.width, 0.0);
        self.touched.fill(false);
    }

    fn add(&mut self, row: usize, column: usize, value: f64) {
        self.rows[row * self.width + column] += value;
        self.touched[column] = true;
    }

    fn write_block(&self, block: &mut Block, m: usize) {
        block.begin(m);
        block.over(self.touched.iter().enumerate().filter(|(_, touched)| **touched).map(|(i, _)| i));
        for row in 0..m {
            for place in 0..block.columns.len() {
                let column = block.columns[place];
                *block.at(row, place) = self.rows[row * self.width + column];
            }
        }
    }
}

/// One component's derivatives by the state at the instant.
struct ByState {
    position: Vector3<f64>,
    velocity: Vector3<f64>,
    attitude: Vector3<f64>,
    rate: Vector3<f64>,
}

impl ByState {
    fn of(linear: &Linear<'_>, row: usize) -> Self {
        let mut all = [[0.0; 3]; 4];
        let ranges = [columns::POSITION, columns::VELOCITY, columns::ATTITUDE, columns::RATE];
        for (column, value) in linear.columns().iter().zip(linear.row(row)) {
            for (range, three) in ranges.iter().zip(&mut all) {
                if range.contains(column) {
                    three[column - range.start] += value;
                }
            }
        }
        let [position, velocity, attitude, rate] = all.map(Vector3::from);
        Self { position, velocity, attitude, rate }
    }
}

impl Instant<'_> {
    /// Writes rows of a linearised measurement; returns the rate of change of each component.
    pub(crate) fn write(&self, linear: &Linear<'_>, rows: &mut Rows) -> Vec<f64> {
        rows.begin(linear.len());
        (0..linear.len()).map(|row| self.write_row((linear, row), row, rows)).collect()
    }

    /// Writes the two components of a point of the picture at `row`, with the camera's deviation from its configuration; `target`
    /// is the vehicle that it is on.
    pub(crate) fn write_point(
        &self,
        linear: &Linear<'_>,
        row: usize,
        target: Option<usize>,
        (seen, shake, lens): (&Vector2<f64>, &[f64], &Lens),
        rows: &mut Rows,
    ) {
        let flow = [0, 1].map(|i| {
            let moved = target.map_or(0.0, |target| self.target((linear, i), row + i, target, rows));
            self.write_row((linear, i), row + i, rows) + moved
        });
        let displaced = [0, 1].map(|i| self.displaced(linear, i, shake));
        self.camera(linear, row, flow, (seen, displaced, lens), rows);
    }

    fn write_row(&self, (linear, i): (&Linear<'_>, usize), row: usize, rows: &mut Rows) -> f64 {
        for (column, value) in linear.columns().iter().zip(linear.row(i)) {
            match self.places[*column] {
                Place::Knot(i) => rows.add(row, self.at + i, *value),
                Place::Constant(i) => rows.add(row, self.shape.constants_at() + i, *value),
                Place::Landmark(i) => rows.add(row, self.landmark_at + i, *value),
                Place::Shake(i) => rows.add(row, self.shape.shake_at() + i, *value),
                Place::Known(_) | Place::Nowhere => {}
            }
        }
        let by = ByState::of(linear, i);
        let turned = self.state.attitude.matrix().transpose() * by.attitude;
        let (v, rate, spin) =
            (self.state.three(knot::VELOCITY), self.state.three(knot::RATE), self.state.three(knot::SPIN));
        let dt = self.dt;
        if dt != 0.0 {
            for i in 0..3 {
                rows.add(row, self.at + knot::VELOCITY + i, by.position[i] * dt);
                rows.add(row, self.at + knot::RATE + i, turned[i] * dt);
                rows.add(row, self.at + knot::SPIN + i, 0.5 * turned[i] * dt * dt + by.rate[i] * dt);
            }
            for (column, d) in &self.pushed.1 {
                let moved = by.velocity.dot(d) * dt;
                match self.places[*column] {
                    Place::Knot(i) => rows.add(row, self.at + i, moved),
                    Place::Constant(i) => rows.add(row, self.shape.constants_at() + i, moved),
                    Place::Landmark(_) | Place::Shake(_) | Place::Known(_) | Place::Nowhere => {}
                }
            }
        }
        by.position.dot(&v) + by.velocity.dot(&self.pushed.0) + turned.dot(&rate) + by.rate.dot(&spin)
    }

    /// Adds the effect of a target's motion until that time on a component, at `row` of the rows; returns its rate of change.
    fn target(&self, (linear, i): (&Linear<'_>, usize), row: usize, target: usize, rows: &mut Rows) -> f64 {
        let mut by = [0.0; 5];
        for (column, value) in linear.columns().iter().zip(linear.row(i)) {
            if let Place::Knot(i) = self.places[*column]
                && (knot::target(target)..knot::target(target) + 5).contains(&i)
            {
                by[i - knot::target(target)] += value;
            }
        }
        let t = self.state.target(target);
        let (s, c) = t[knot::HEADING].sin_cos();
        let (at, dt, speed) = (self.at + knot::target(target), self.dt, t[knot::SPEED]);
        if dt != 0.0 {
            rows.add(row, at + knot::HEADING, (by[1] * c - by[0] * s) * speed * dt);
            rows.add(row, at + knot::SPEED, (by[0] * c + by[1] * s) * dt);
            rows.add(row, at + knot::YAW_RATE, by[2] * dt);
            rows.add(row, at + knot::ACCELERATION, by[3] * dt);
            rows.add(row, at + knot::YAW_ACCELERATION, by[4] * dt);
        }
        by.iter().zip(self.state.target_flow(target)).map(|(by, flow)| by * flow).sum()
    }

    /// Adds a constant's derivative to a component, where it is estimated.
    pub(crate) fn constant(&self, row: usize, which: usize, value: f64, rows: &mut Rows) {
        if self.estimated[which] {
            rows.add(row, self.shape.constants_at() + which, value);
        }
    }

    /// Adds the effect of a delay on the time of a measurement: `sign` of it later.
    pub(crate) fn timed(&self, flows: &[f64], delay: usize, sign: f64, rows: &mut Rows) {
        flows.iter().enumerate().for_each(|(row, flow)| self.constant(row, delay, sign * flow, rows));
    }

    /// By how much a camera that shakes displaces a component, px.
    fn displaced(&self, linear: &Linear<'_>, i: usize, shake: &[f64]) -> f64 {
        let of_shake = |(column, by): (&usize, &f64)| match self.places[*column] {
            Place::Shake(k) => by * shake[k],
            _ => 0.0,
        };
        linear.columns().iter().zip(linear.row(i)).map(of_shake).sum()
    }

    /// Adds the camera's deviation from its configuration to the two components of a pixel that begin at `row`; `flow`
    /// is their rate of change, `seen` where it is, and `displaced` what of that is a camera that shakes.
    fn camera(
        &self,
        linear: &Linear<'_>,
        row: usize,
        flow: [f64; 2],
        (seen, displaced, lens): (&Vector2<f64>, [f64; 2], &Lens),
        rows: &mut Rows,
    ) {
        let r = self.state.attitude.matrix();
        let share = lens.share(seen.y);
        for k in 0..2 {
            let by = ByState::of(linear, k);
            // The position's column is −∂px/∂point; of the camera's place in the body the same, turned.
            let at = r.transpose() * by.position;
            let mount = r.transpose() * by.attitude + at.cross(&lens.camera_at);
            for i in 0..3 {
                self.constant(row + k, constant::CAMERA_AT + i, at[i], rows);
                self.constant(row + k, constant::MOUNT + i, mount[i], rows);
            }
            // Displacements are no directions that the lens enlarges: to take them as such is to find it longer, since smaller
            // ones fit what is expected of them better.
            let from_principal = seen[k] - linear.residual(k) - displaced[k] - lens.principal_px[k];
            self.constant(row + k, constant::FOCAL, from_principal, rows);
            self.constant(row + k, constant::READOUT, share * flow[k], rows);
        }
    }

    /// Adds the antenna's deviation from its configuration: `R l` to a position, `R (ω × l)` to a velocity.
    pub(crate) fn antenna(&self, linear: &Linear<'_>, rows: &mut Rows) {
        let r = self.state.attitude.matrix();
        let rate = self.state.three(knot::RATE);
        for row in 0..linear.len() {
            let by = ByState::of(linear, row);
            let at = r.transpose() * by.position;
            let swung = (r.transpose() * by.velocity).cross(&rate);
            for i in 0..3 {
                self.constant(row, constant::ANTENNA_AT + i, at[i] + swung[i], rows);
            }
        }
    }
}

/// Quantities on which the camera's constants depend.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Lens {
    pub(crate) principal_px: Vector2<f64>,
    pub(crate) height_px: f64,
    /// Where it is in the body, m.
    pub(crate) camera_at: Vector3<f64>,
    /// From the exposure of the first row to that of the last, s.
    pub(crate) readout_s: f64,
}

impl Lens {
    /// The share of the frame's height at which a row is, −½ at the top.
    fn share(&self, v_px: f64) -> f64 {
        v_px / (self.height_px - 1.0) - 0.5
    }

    /// How long after the middle row a row is exposed, s.
    pub(crate) fn after_s(&self, v_px: f64) -> f64 {
        self.share(v_px) * self.readout_s
    }
}

/// Iron's heading error and its derivatives: sine and cosine of the heading, and of twice the heading.
pub(crate) fn iron(heading: f64) -> [f64; 4] {
    let ((s, c), (s2, c2)) = (heading.sin_cos(), (2.0 * heading).sin_cos());
    [s, c, s2, c2]
}

/// Converts rows and residuals to a block of unit variance, `factor` on the variance of the noise; `false` where the
/// noise is not valid.
pub(crate) fn finish(
    rows: &Rows,
    linear_noise: impl Fn(usize, usize) -> f64,
    residual: &[f64],
    factor: f64,
    block: &mut Block,
) -> bool {
    let m = residual.len();
    rows.write_block(block, m);
    block.right.copy_from_slice(residual);
    let mut covariance: Vec<f64> = (0..m * m).map(|k| linear_noise(k / m, k % m) * factor).collect();
    block.whiten(&mut covariance)
}
