//! How helicopter and targets move from one knot to the next.
//!
//! Real motion is smooth. Angular acceleration of the helicopter, acceleration and yaw acceleration of a target are driven by
//! white noise, and forget themselves over some seconds (Singer 1970): over the interval of knots a jerk of white noise. Of
//! a triple (x, ẋ, ẍ) with ẍ' = e^(−h/τ) ẍ
//!
//! `x' = x + h ẋ + τ² (h/τ − 1 + e^(−h/τ)) ẍ`, `ẋ' = ẋ + τ (1 − e^(−h/τ)) ẍ`,
//! `Q = q [h⁵/20 h⁴/8 h³/6; h⁴/8 h³/3 h²/2; h³/6 h²/2 h]`.
//!
//! The helicopter's place and velocity follow its acceleration a, the filter's own model of thrust, wind and drag:
//! `v' = v + h/2 (a + a')`, `p' = p + h/2 (v + v') − h²/12 (a' − a)`.

use nalgebra::{Matrix3, Vector3};

use windhover_base::geo::{skew, wrap_angle};

use crate::block::{Block, Noise, Source};
use crate::front::Shape;
use crate::unknowns::{Place, knot};
use crate::values::Knot;

/// Over how long angular acceleration of the helicopter is remembered, s, and acceleration of a target.
const SPIN_TAU_S: f64 = 1.0;
const DRIVE_TAU_S: f64 = 2.0;
/// Vibration and what is finer than a gust straight into velocity, m/s per √s.
const VELOCITY_WALK: f64 = 0.02;
/// Slow force of the wind, m/s² per √s.
const WIND_WALK: f64 = 0.1;
/// Side slip of what does not move at all, m²/s.
const STILL_Q: f64 = 1e-12;

/// Figures of processes that are not fitted.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Processes {
    pub(crate) gust_tau_s: f64,
    pub(crate) thrust_tau_s: f64,
    /// Variance, rad², and correlation time, s.
    pub(crate) tilt_error: (f64, f64),
    /// Variances, m², and correlation time, s.
    pub(crate) gps_bias: ([f64; 3], f64),
    pub(crate) slip_q: f64,
}

/// Acceleration of a knot with its derivatives, by the filter's columns.
pub(crate) type Pushed = (Vector3<f64>, [(usize, Vector3<f64>); 14]);

/// Two neighbouring knots.
pub(crate) struct Link<'a> {
    pub(crate) from: &'a Knot,
    pub(crate) to: &'a Knot,
    pub(crate) pushed: (&'a Pushed, &'a Pushed),
    pub(crate) h: f64,
    /// First columns of the two.
    pub(crate) at: (usize, usize),
    pub(crate) shape: Shape,
    pub(crate) places: &'a [Place],
    pub(crate) noise: &'a Noise,
    pub(crate) processes: &'a Processes,
}

/// Transition of a triple.
struct Triple {
    /// Of the first by the third, of the second by the third, of the third by itself.
    by_third: [f64; 3],
    h: f64,
}

impl Triple {
    fn new(h: f64, tau_s: f64) -> Self {
        let (share, decay) = (h / tau_s, (-h / tau_s).exp());
        Self { by_third: [tau_s * tau_s * (share - 1.0 + decay), tau_s * (1.0 - decay), decay], h }
    }

    /// Covariance of unit intensity, row by row.
    fn covariance(&self) -> [f64; 9] {
        let h = self.h;
        let (a, b, c) = (h.powi(5) / 20.0, h.powi(4) / 8.0, h.powi(3) / 6.0);
        [a, b, c, b, h.powi(3) / 3.0, h * h / 2.0, c, h * h / 2.0, h]
    }
}

impl Link<'_> {
    /// Gives every block of the step.
    pub(crate) fn blocks(&self, block: &mut Block, take: &mut dyn FnMut(Source, &Block)) {
        self.path(block, take);
        self.attitude(block, take);
        let p = self.processes;
        let gust = 1.0 - (-2.0 * self.h / p.gust_tau_s).exp();
        self.reverting(knot::GUST, &[gust; 2], p.gust_tau_s, Source::Gust, block, take);
        let thrust = 1.0 - (-2.0 * self.h / p.thrust_tau_s).exp();
        self.reverting(knot::THRUST, &[thrust], p.thrust_tau_s, Source::Thrust, block, take);
        let (var, tau_s) = p.tilt_error;
        let grown = var * (1.0 - (-2.0 * self.h / tau_s).exp());
        self.reverting(knot::TILT_ERROR, &[grown; 2], tau_s, Source::Known, block, take);
        self.reverting(
            knot::WIND,
            &[WIND_WALK.powi(2) * self.h; 2],
            f64::INFINITY,
            Source::Known,
            block,
            take,
        );
        let (vars, tau_s) = p.gps_bias;
        let grown = vars.map(|var| var * (1.0 - (-2.0 * self.h / tau_s).exp()));
        self.reverting(knot::GPS_BIAS, &grown, tau_s, Source::Known, block, take);
    }

    /// Place and velocity of the helicopter.
    fn path(&self, block: &mut Block, take: &mut dyn FnMut(Source, &Block)) {
        let (h, (from, to)) = (self.h, (self.from, self.to));
        let (a, b) = (&self.pushed.0.0, &self.pushed.1.0);
        let (va, vb) = (from.three(knot::VELOCITY), to.three(knot::VELOCITY));
        let place = to.three(knot::POSITION) - from.three(knot::POSITION) - (va + vb) * (0.5 * h)
            + (b - a) * (h * h / 12.0);
        let velocity = vb - va - (a + b) * (0.5 * h);
        block.begin(6);
        let ends = [self.at.0, self.at.1];
        let own = |at: usize| {
            (knot::POSITION..knot::POSITION + 3)
                .chain(knot::VELOCITY..knot::VELOCITY + 3)
                .map(move |i| at + i)
        };
        let pushed = [self.pushed.0, self.pushed.1];
        let forces: Vec<usize> =
            (0..2).flat_map(|end| pushed[end].1.iter().map(move |(c, _)| self.column(end, *c))).collect();
        block.over(own(ends[0]).chain(own(ends[1])).chain(forces));
        for i in 0..3 {
            (block.right[i], block.right[3 + i]) = (-place[i], -velocity[i]);
            for (end, sign) in [(0, -1.0), (1, 1.0)] {
                *block.at(i, 6 * end + i) = sign;
                *block.at(i, 6 * end + 3 + i) = -0.5 * h;
                *block.at(3 + i, 6 * end + 3 + i) = sign;
                for (k, (_, d)) in pushed[end].1.iter().enumerate() {
                    *block.at(i, 12 + 14 * end + k) = sign * h * h / 12.0 * d[i];
                    *block.at(3 + i, 12 + 14 * end + k) = -0.5 * h * d[i];
                }
            }
        }
        let q = VELOCITY_WALK.powi(2);
        let sigma = [(q * h.powi(3) / 12.0).sqrt(), (q * h).sqrt()];
        let width = block.columns.len();
        for row in 0..6 {
            let by = 1.0 / sigma[row / 3];
            block.right[row] *= by;
            block.rows[row * width..][..width].iter_mut().for_each(|x| *x *= by);
        }
        take(Source::Known, block);
    }

    /// Where a column of the filter's stands, at either end.
    fn column(&self, end: usize, column: usize) -> usize {
        let at = if end == 0 { self.at.0 } else { self.at.1 };
        match self.places[column] {
            Place::Knot(i) => at + i,
            Place::Constant(i) => self.shape.constants_at() + i,
            Place::Landmark(_) | Place::Known(_) | Place::Nowhere => {
                unreachable!("forces depend on the helicopter's own unknowns")
            }
        }
    }

    /// Attitude, rate and angular acceleration, an axis of the body after another.
    fn attitude(&self, block: &mut Block, take: &mut dyn FnMut(Source, &Block)) {
        let (from, to, triple) = (self.from, self.to, Triple::new(self.h, SPIN_TAU_S));
        let turn = (from.attitude.inverse() * to.attitude).scaled_axis();
        let bend = skew(&(turn * 0.5));
        let by_to = (Matrix3::identity() + bend) * to.attitude.matrix().transpose();
        let by_from = -(Matrix3::identity() - bend) * from.attitude.matrix().transpose();
        let (rate, spin) = (from.three(knot::RATE), from.three(knot::SPIN));
        let (rate_to, spin_to) = (to.three(knot::RATE), to.three(knot::SPIN));
        let [turned, quicker, kept] = triple.by_third;
        for axis in 0..3 {
            let source = if axis < 2 { Source::TiltMotion } else { Source::YawMotion };
            block.begin(3);
            let own = |at: usize| {
                (0..3)
                    .map(move |i| at + knot::ATTITUDE + i)
                    .chain([at + knot::RATE + axis, at + knot::SPIN + axis])
            };
            block.over(own(self.at.0).chain(own(self.at.1)));
            for i in 0..3 {
                *block.at(0, i) = by_from[(axis, i)];
                *block.at(0, 5 + i) = by_to[(axis, i)];
            }
            set_triple(block, [None, Some(3), Some(4)], [None, Some(8), Some(9)], &triple);
            block.right[0] = -(turn[axis] - rate[axis] * self.h - turned * spin[axis]);
            block.right[1] = -(rate_to[axis] - rate[axis] - quicker * spin[axis]);
            block.right[2] = -(spin_to[axis] - kept * spin[axis]);
            self.finish(block, &triple.covariance(), source, take);
        }
    }

    /// What reverts to zero over a time, or walks: each component apart.
    fn reverting(
        &self,
        first: usize,
        grown: &[f64],
        tau_s: f64,
        source: Source,
        block: &mut Block,
        take: &mut dyn FnMut(Source, &Block),
    ) {
        let kept = (-self.h / tau_s).exp();
        for (i, grown) in grown.iter().enumerate() {
            block.begin(1);
            block.over([self.at.0 + first + i, self.at.1 + first + i]);
            (*block.at(0, 0), *block.at(0, 1)) = (-kept, 1.0);
            block.right[0] = -(self.to.x[first + i] - kept * self.from.x[first + i]);
            self.finish(block, &[*grown], source, take);
        }
    }

    /// A target: along its course, in its heading, and across (side slip).
    pub(crate) fn target(
        &self,
        target: usize,
        moves: bool,
        block: &mut Block,
        take: &mut dyn FnMut(Source, &Block),
    ) {
        let (a, b) = (self.from.target(target), self.to.target(target));
        let at = [self.at.0 + knot::target(target), self.at.1 + knot::target(target)];
        if !moves {
            return self.still(a, b, at, block, take);
        }
        let triple = Triple::new(self.h, DRIVE_TAU_S);
        let [run, quicker, kept] = triple.by_third;
        let turned = wrap_angle(b[knot::HEADING] - a[knot::HEADING]);
        let (s, c) = (a[knot::HEADING] + 0.5 * turned).sin_cos();
        let (north, east) = (b[0] - a[0], b[1] - a[1]);
        let (along, across) = (c * north + s * east, c * east - s * north);
        // Along: place, speed, acceleration.
        block.begin(3);
        let of = |at: usize| [0, 1, knot::HEADING, knot::SPEED, knot::ACCELERATION].map(move |i| at + i);
        block.over(of(at[0]).into_iter().chain(of(at[1])));
        for (end, sign) in [(0, -1.0), (1, 1.0)] {
            *block.at(0, 5 * end) = sign * c;
            *block.at(0, 5 * end + 1) = sign * s;
            *block.at(0, 5 * end + 2) = 0.5 * across;
        }
        set_triple(block, [None, Some(3), Some(4)], [None, Some(8), Some(9)], &triple);
        block.right[0] = -(along - a[knot::SPEED] * self.h - run * a[knot::ACCELERATION]);
        block.right[1] = -(b[knot::SPEED] - a[knot::SPEED] - quicker * a[knot::ACCELERATION]);
        block.right[2] = -(b[knot::ACCELERATION] - kept * a[knot::ACCELERATION]);
        self.finish(block, &triple.covariance(), Source::Drive(target), take);
        // Heading, yaw rate, yaw acceleration.
        block.begin(3);
        let of = |at: usize| [knot::HEADING, knot::YAW_RATE, knot::YAW_ACCELERATION].map(move |i| at + i);
        block.over(of(at[0]).into_iter().chain(of(at[1])));
        set_triple(block, [Some(0), Some(1), Some(2)], [Some(3), Some(4), Some(5)], &triple);
        block.right[0] = -(turned - a[knot::YAW_RATE] * self.h - run * a[knot::YAW_ACCELERATION]);
        block.right[1] = -(b[knot::YAW_RATE] - a[knot::YAW_RATE] - quicker * a[knot::YAW_ACCELERATION]);
        block.right[2] = -(b[knot::YAW_ACCELERATION] - kept * a[knot::YAW_ACCELERATION]);
        self.finish(block, &triple.covariance(), Source::Turn(target), take);
        // Across.
        block.begin(1);
        block.over([0, 1].into_iter().flat_map(|end| [0, 1, knot::HEADING].map(|i| at[end] + i)));
        for (end, sign) in [(0, -1.0), (1, 1.0)] {
            *block.at(0, 3 * end) = -sign * s;
            *block.at(0, 3 * end + 1) = sign * c;
            *block.at(0, 3 * end + 2) = -0.5 * along;
        }
        block.right[0] = -across;
        self.finish(block, &[self.processes.slip_q * self.h], Source::Known, take);
    }

    /// A target that lies where it lies.
    fn still(
        &self,
        a: &[f64],
        b: &[f64],
        at: [usize; 2],
        block: &mut Block,
        take: &mut dyn FnMut(Source, &Block),
    ) {
        for i in 0..knot::TARGET {
            block.begin(1);
            block.over([at[0] + i, at[1] + i]);
            (*block.at(0, 0), *block.at(0, 1)) = (-1.0, 1.0);
            let change = b[i] - a[i];
            block.right[0] = -if i == knot::HEADING { wrap_angle(change) } else { change };
            self.finish(block, &[STILL_Q], Source::Known, take);
        }
    }

    fn finish(
        &self,
        block: &mut Block,
        covariance: &[f64],
        source: Source,
        take: &mut dyn FnMut(Source, &Block),
    ) {
        let figure = self.noise.of(source);
        let mut covariance: Vec<f64> = covariance.iter().map(|c| c * figure).collect();
        if block.whiten(&mut covariance) {
            take(source, block);
        }
    }
}

/// The derivatives of a triple's three rows by its components, by the places of their columns at either end; `None` where they
/// are set elsewhere.
fn set_triple(block: &mut Block, from: [Option<usize>; 3], to: [Option<usize>; 3], triple: &Triple) {
    let [by_first, by_second, kept] = triple.by_third;
    let transition = [[-1.0, -triple.h, -by_first], [0.0, -1.0, -by_second], [0.0, 0.0, -kept]];
    for row in 0..3 {
        for component in 0..3 {
            if let Some(place) = from[component] {
                *block.at(row, place) = transition[row][component];
            }
            if let Some(place) = to[component] {
                *block.at(row, place) = if row == component { 1.0 } else { 0.0 };
            }
        }
    }
}
